"""How long a frame takes from its JPEG to its buildings, stage by stage, and what memory that needs.

A module of its own, for the process whose memory is measured to load nothing else.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from buildloc_segmenter.config import SegmenterConfig
from buildloc_segmenter.instances import draw_mask, find_instances
from buildloc_segmenter.network import Network

from buildloc_eval.flight import FlightConfig, focal_px
from buildloc_eval.process_memory import peak_mb
from buildloc_eval.trained_on import trained_on

SIZE = (1280, 720)
CAMERA = FlightConfig()  # 105 m above ground
GSD_M = CAMERA.altitude_m / focal_px(CAMERA)
ORTHO_GSD_M = 0.16
FRAMES = 15
STAGES = ("decode", "resize and infer", "instances", "mask")


def frame_jpeg(imagery: Path) -> bytes:
    """A frame cut from the middle of a real suburb, at GSD_M."""
    ortho = np.asarray(cv2.imread(str(imagery / "barnarp" / "ortho.jpg")), dtype=np.uint8)
    width, height = (round(side * GSD_M / ORTHO_GSD_M) for side in SIZE)
    top, left = (ortho.shape[0] - height) // 2, (ortho.shape[1] - width) // 2
    frame = cv2.resize(ortho[top : top + height, left : left + width], SIZE, interpolation=cv2.INTER_CUBIC)
    return bytes(cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 85])[1])


def stages(network: Network, config: SegmenterConfig, jpeg: bytes) -> dict[str, float]:
    """Milliseconds of each stage for one frame."""
    clock = [time.perf_counter()]
    image = np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)
    clock.append(time.perf_counter())
    scores = network.scores(image, GSD_M)
    clock.append(time.perf_counter())
    limits = (config.min_component_m2, config.min_score)
    found = find_instances(scores.building, scores.core, scores.gsd_m, *limits, GSD_M)
    clock.append(time.perf_counter())
    draw_mask(found, SIZE)
    clock.append(time.perf_counter())
    return dict(zip(STAGES, (1e3 * np.diff(clock)).tolist(), strict=True))


def speed(jpeg: bytes, models: Sequence[str], config: SegmenterConfig) -> dict[str, Any]:
    """Median milliseconds by stage, CPU time and peak memory of each network (empty: the shipped one), in
    turns so that what else the machine does meets all; ``times the first`` compares the sum with that of the
    first."""
    networks = {model or "shipped": Network(replace(config, model=model)) for model in models}
    runs: dict[str, list[dict[str, float]]] = {name: [] for name in networks}
    busy: dict[str, list[float]] = {name: [] for name in networks}
    for turn in range(FRAMES + 1):
        for name, network in networks.items():
            before = time.process_time()
            found = stages(network, config, jpeg)
            if turn > 0:  # the first one loads
                runs[name].append(found)
                busy[name].append(1e3 * (time.process_time() - before))
    report: dict[str, Any] = {
        "load average": os.getloadavg()[0],
        "frame": f"{SIZE[0]}x{SIZE[1]} at {GSD_M:.3f} m",
    }
    first = 0.0
    for name, model in zip(networks, models, strict=True):
        median = {stage: float(np.median([run[stage] for run in runs[name]])) for stage in runs[name][0]}
        whole = float(np.median([sum(run.values()) for run in runs[name]]))
        first = first or whole
        memory = peak_mb(_segment, replace(config, model=model), jpeg)
        report[name] = {
            "ms": median, "ms_total": whole, "times the first": whole / first,
            "cpu_ms": float(np.median(busy[name])), "peak_memory_mb": memory,
            "quantised": "quantised" in (trained_on(networks[name].metadata) or {}),
        }  # fmt: skip
    return report


def speed_table(report: dict[str, Any]) -> list[str]:
    """For people."""
    return [
        f"{name}: {values['ms_total']:.0f} ms a frame ({values['times the first']:.2f} times the first), "
        + ", ".join(f"{stage} {ms:.0f}" for stage, ms in values["ms"].items())
        + f"; {values['cpu_ms']:.0f} ms of CPU time; peak memory {values['peak_memory_mb']:.0f} MB; "
        + f"load average {report['load average']:.1f}"
        for name, values in report.items()
        if isinstance(values, dict)
    ]


def _segment(config: SegmenterConfig, jpeg: bytes) -> None:
    """What the process does whose memory is measured."""
    network = Network(config)
    for _ in range(2):
        stages(network, config, jpeg)
