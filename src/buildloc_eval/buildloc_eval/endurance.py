"""A long flight: what a keyframe costs at its beginning and its end, and how much memory the map takes."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from buildloc_mapper.config import MapperConfig

from buildloc_eval.cut import CutFlight, cut
from buildloc_eval.flight import FlightConfig, fly
from buildloc_eval.mapper_process import Load, map_all
from buildloc_eval.orthos import LabelledGround
from buildloc_eval.world import MirroredWorld

FLIGHT = FlightConfig(
    leg_m=1150.0, spacing_m=55.0, speed_mps=5.0, altitude_swing_m=10.5, tilt_deg=3.0, length_m=1e5
)
METRES_PER_KEYFRAME = 25.0
ENDS = 100  # keyframes at either end that are compared
AHEAD = 4  # keyframes that are rendered while the mapper works
DEADLINE_S = 300.0


def long_flight(ground: LabelledGround, keyframes: int, seed: int) -> CutFlight:
    """Back and forth over an orthophoto and its mirror image below it."""
    worlds = (MirroredWorld(world, down=2, across=1) for world in (ground.picture, ground.labels))
    picture, labels = worlds
    config = replace(FLIGHT, length_m=keyframes * METRES_PER_KEYFRAME)
    flight = cut("endurance", picture, labels, fly(picture.bounds_m, config, seed), config, seed)
    return replace(flight, stamps_ns=flight.stamps_ns[:keyframes], poses=flight.poses[:keyframes])


def endure(flight: CutFlight, config: MapperConfig, progress: Callable[[str], None]) -> Load:
    """Map a flight in a process of its own while this one renders it."""
    context = multiprocessing.get_context("spawn")
    shots = context.Queue(AHEAD)
    answer = context.Queue()
    process = context.Process(target=map_all, args=(config, shots, answer))
    process.start()
    for index in range(len(flight)):
        shots.put((flight.frame(index), flight.mask(index)), timeout=DEADLINE_S)
        if (index + 1) % ENDS == 0:
            progress(f"{index + 1} of {len(flight)} keyframes")
    shots.put(None, timeout=DEADLINE_S)
    load: Load = answer.get(timeout=DEADLINE_S)
    process.join()
    return load


def scores(flight: CutFlight, load: Load) -> dict[str, Any]:
    """Cost of a keyframe, first and last, and memory."""
    wall_ms, processor_ms = (1e3 * np.array(seconds) for seconds in (load.wall_s, load.processor_s))
    ends = min(ENDS, len(wall_ms) // 2)
    first, last = float(np.median(wall_ms[:ends])), float(np.median(wall_ms[-ends:]))
    return {
        "keyframes": len(wall_ms), "length_m": flight.length_m,
        "median_ms": float(np.median(wall_ms)), "p90_ms": float(np.quantile(wall_ms, 0.9)),
        "largest_ms": float(wall_ms.max()), "median_processor_ms": float(np.median(processor_ms)),
        "median_ms_of_first": first, "median_ms_of_last": last, "last_over_first": last / first,
        "first_and_last": ends, "peak_memory_mb": load.peak_mb, "memory_at_start_mb": load.resident_mb[0],
        "memory_at_end_mb": load.resident_mb[-1], "load_average": os.getloadavg()[0],
    }  # fmt: skip


def draw(load: Load, path: Path) -> None:
    """Time and memory over the flight."""
    figure, (above, below) = plt.subplots(2, 1, figsize=(9, 6), sharex=True)
    above.plot(1e3 * np.array(load.wall_s), ".", ms=3, label="wall")
    above.plot(1e3 * np.array(load.processor_s), ".", ms=3, label="processor")
    above.set_ylabel("ms per keyframe")
    above.set_ylim(bottom=0.0)
    above.legend()
    below.plot(load.resident_mb)
    below.set_ylabel("resident memory, MB")
    below.set_ylim(bottom=0.0)
    below.set_xlabel("keyframe")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
