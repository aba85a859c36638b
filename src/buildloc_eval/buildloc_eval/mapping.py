"""How metric the mapper's registration and trajectory are, on real flights with measured positions.

Every method of registration over consecutive images, the whole trajectory through the mapper, and beside
it plain consecutive chaining: no rectification, no refinement by the graph.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from buildloc_mapper.atlas import ORIGIN
from buildloc_mapper.config import MapperConfig
from buildloc_mapper.mapper import Mapper
from buildloc_mapper.registration import Link, Registration
from buildloc_mapper.similarity import Similarity
from buildloc_msgs_py.types import FloatArray, Frame, Mask
from evo.core.metrics import APE, PoseRelation
from evo.core.trajectory import PosePath3D

from buildloc_eval.html import write_report
from buildloc_eval.machine import machine
from buildloc_eval.realworld import data_folder
from buildloc_eval.survey import LEVEL, Survey, mirafiori, sheffield

NETWORKS = ("xfeat", "coarse_loftr")
COARSE_MAP_GSD_M = 2.0  # no buildings are mapped here: the masks are empty
QUICK_IMAGES = 60
BARS = {
    "mirafiori_pairs": 31,
    "mirafiori_translation_median_m": 0.12,
    "mirafiori_translation_p90_m": 0.2,
    "mirafiori_yaw_median_deg": 0.1,
    "mirafiori_trajectory_rmse_m": 0.3,
    "sheffield_images_in_one_map": 172,  # all; fewer in a quick run
    "sheffield_trajectory_rmse_m": 3.0,
}
OF_PAIRS = (
    "pairs_registered",
    "translation_median_m",
    "translation_p90_m",
    "yaw_median_deg",
    "yaw_p90_deg",
)
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Path2d:
    """Poses (N,) of images ``index`` (N,) in the frame of the first, and what happened on the way."""

    index: tuple[int, ...]
    poses: tuple[Similarity, ...]
    counts: dict[str, float]


def configs(data: Path) -> dict[str, MapperConfig]:
    """The mapper's config for every method whose weights are here."""
    found = {"sift": replace(MapperConfig(), map_gsd_m=COARSE_MAP_GSD_M)}
    for name in NETWORKS:
        weights = data / "models" / f"{name}.onnx"
        if weights.is_file():
            found[name] = replace(found["sift"], registration=name, registration_model=str(weights))
    return found


def unrectified(frame: Frame) -> Frame:
    """The frame as if its camera had no lens errors and looked straight down."""
    return replace(frame, camera=replace(frame.camera, distortion=()), attitude_xyzw=LEVEL)


def links(
    survey: Survey, config: MapperConfig, seen: Callable[[Frame], Frame]
) -> tuple[list[Link | None], dict[str, float]]:
    """Registration of every image in the one before it; None where it was rejected, counted by reason."""
    registration, rejected = Registration(config), Counter[str]()
    found: list[Link | None] = []
    prepare_s = register_s = 0.0
    before = None
    for index in range(len(survey)):
        frame = seen(survey.frame(index))
        started = time.perf_counter()
        now = registration.prepare(frame)
        prepare_s += time.perf_counter() - started
        if before is not None:
            started = time.perf_counter()
            answer = registration.register(before, now)
            register_s += time.perf_counter() - started
            found.append(answer if isinstance(answer, Link) else None)
            if not isinstance(answer, Link):
                rejected[f"rejected_{answer.reason}"] += 1
        before = now
    seconds = {
        "prepare_ms": 1e3 * prepare_s / len(survey), "register_ms": 1e3 * register_s / max(1, len(found))
    }  # fmt: skip
    return found, {**rejected, **seconds}


def _rotation(yaw_rad: float) -> FloatArray:
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s], [s, c]])


@dataclass(frozen=True)
class Constants:
    """What the truth says is constantly wrong with what the mapper is told: the height above ground by a
    factor, the gimbal's heading by an angle, the camera's axis by an offset (right, up) on the ground."""

    height_factor: float
    heading_rad: float
    axis_m: FloatArray

    def correct(self, flown: Path2d) -> Path2d:
        """The path with height and axis put right; its heading is arbitrary anyway."""
        poses = []
        for pose in flown.poses:
            x, y = self.height_factor * np.array(pose[:2]) + _rotation(pose.yaw_rad) @ self.axis_m
            poses.append(pose._replace(x_m=float(x), y_m=float(y)))
        return Path2d(flown.index, tuple(poses), {})


def pair_scores(
    survey: Survey, yaw_rad: FloatArray, found: list[Link | None]
) -> tuple[dict[str, Any], Constants]:
    """Errors of consecutive images against truth, and the constants that explain most of them.

    The figures are of what registration and telemetry say. Those under ``fitted_to_truth`` are what is left
    once the constants are taken out: they tell what stands in the way, not what is reached.
    """
    told, true, turned, yaw_deg = [], [], [], []
    for index, link in enumerate(found):
        if link is None:
            continue
        to_world, after = _rotation(yaw_rad[index]), _rotation(yaw_rad[index + 1])
        told.append(to_world @ link.transform[:2])
        true.append(survey.true_m[index + 1] - survey.true_m[index])
        turned.append(after - to_world)
        error = link.transform.yaw_rad - (yaw_rad[index + 1] - yaw_rad[index])
        yaw_deg.append(abs(math.degrees(math.remainder(error, math.tau))))
    errors = np.linalg.norm(np.subtract(told, true), axis=1)
    design = np.concatenate(
        [np.column_stack([t, _rotation(math.pi / 2) @ t, a]) for t, a in zip(told, turned, strict=True)]
    )
    a, b, *offset = solution = np.linalg.lstsq(design, np.concatenate(true), rcond=None)[0]
    heading = math.atan2(b, a)
    constants = Constants(math.hypot(a, b), heading, _rotation(-heading) @ np.array(offset))
    left = np.linalg.norm((design @ solution - np.concatenate(true)).reshape(-1, 2), axis=1)
    scores = {
        "pairs": len(found),
        "pairs_registered": len(errors),
        "translation_median_m": float(np.median(errors)),
        "translation_p90_m": float(np.quantile(errors, 0.9)),
        "yaw_median_deg": float(np.median(yaw_deg)),
        "yaw_p90_deg": float(np.quantile(yaw_deg, 0.9)),
        "fitted_to_truth": {
            "height_factor": constants.height_factor,
            "heading_deg": math.degrees(heading),
            "axis_right_m": float(constants.axis_m[0]),
            "axis_up_m": float(constants.axis_m[1]),
            "translation_median_m": float(np.median(left)),
            "translation_p90_m": float(np.quantile(left, 0.9)),
        },
    }
    return scores, constants


def chain(found: list[Link | None]) -> Path2d:
    """Consecutive links, one after the other, up to the first that is missing."""
    poses = [ORIGIN]
    for link in found:
        if link is None:
            break
        poses.append(poses[-1].compose(link.transform))
    return Path2d(tuple(range(len(poses))), tuple(poses), {})


def mapped(survey: Survey, config: MapperConfig) -> Path2d:
    """The flight through the mapper, with empty masks: registration, loop closures and pose graph."""
    mapper, update, started = Mapper(config), None, time.perf_counter()
    empty = np.zeros((survey.camera.height, survey.camera.width), dtype=np.uint8)
    for index in range(len(survey)):
        frame = survey.frame(index)
        update = mapper.add(frame, Mask(frame.stamp_ns, frame.frame_id, empty)) or update
    if update is None:
        return Path2d((), (), {})
    kept = ("loop_closures", "restarts")
    counts = {k: v for k, v in update.funnel.items() if k in kept or k.startswith("rejected_")}
    counts["seconds_per_image"] = (time.perf_counter() - started) / len(survey)
    return Path2d(
        tuple(k.stamp_ns // 1_000_000_000 for k in update.keyframes),
        tuple(Similarity(k.x_m, k.y_m, k.yaw_rad, k.scale) for k in update.keyframes),
        counts,
    )


def _evo_path(places_m: FloatArray, yaw_rad: FloatArray) -> PosePath3D:
    """(N, 2) places and (N,) yaws in the plane as evo takes them."""
    half, none = yaw_rad / 2.0, np.zeros(len(yaw_rad))
    return PosePath3D(
        positions_xyz=np.column_stack([places_m, none]),
        orientations_quat_wxyz=np.column_stack([np.cos(half), none, none, np.sin(half)]),
    )


def trajectory_scores(survey: Survey, flown: Path2d, with_scale: bool) -> tuple[dict[str, Any], FloatArray]:
    """Evo's absolute position error after alignment, and the aligned places (N, 2)."""
    if len(flown.index) < 3:
        return {"images": len(flown.index)}, np.empty((0, 2))
    places = np.array([pose[:2] for pose in flown.poses])
    estimate = _evo_path(places, np.array([pose.yaw_rad for pose in flown.poses]))
    reference = _evo_path(survey.true_m[list(flown.index)], np.zeros(len(flown.index)))
    _, _, scale = estimate.align(reference, correct_scale=with_scale)
    metric = APE(PoseRelation.translation_part)
    metric.process_data((reference, estimate))
    scores: dict[str, Any] = {
        "images": len(flown.index), "of": len(survey),
        **{f"{name}_m": float(metric.get_all_statistics()[name]) for name in ("rmse", "median", "max")},
        **flown.counts,
    }  # fmt: skip
    if with_scale:
        scores["scale_of_alignment"] = float(scale)
    return scores, np.asarray(estimate.positions_xyz[:, :2], dtype=np.float64)


def draw(path: Path, survey: Survey, aligned: dict[str, FloatArray], title: str) -> None:
    """True path and aligned paths, east and north in metres."""
    figure, axes = plt.subplots(figsize=(9, 7))
    axes.plot(*survey.true_m.T, "k.-", lw=2.0, ms=4, label="measured")
    for name, places in aligned.items():
        axes.plot(*places.T, "-", lw=1.2, label=name)
    axes.set_aspect("equal")
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    axes.set_title(title)
    axes.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _flight(
    survey: Survey,
    methods: dict[str, MapperConfig],
    with_scale: bool,
    mapped_by: set[str],
    progress: Progress,
) -> tuple[dict[str, Any], dict[str, FloatArray]]:
    """Scores of a flight by method, and the aligned paths to draw."""
    results: dict[str, Any] = {"images": len(survey)}
    drawn: dict[str, FloatArray] = {}
    for name, config in methods.items():
        progress(f"{survey.name}: {name}")
        scores: dict[str, Any] = {}
        constants = None
        if survey.yaw_rad is not None:
            found, counts = links(survey, config, lambda frame: frame)
            pairs, constants = pair_scores(survey, survey.yaw_rad, found)
            scores["pairs"] = {**pairs, **counts}
        if name in mapped_by:
            flown = mapped(survey, config)
            scores["mapper"], drawn[f"mapper, {name}"] = trajectory_scores(survey, flown, with_scale)
            if constants is not None:
                left, _ = trajectory_scores(survey, constants.correct(flown), with_scale)
                scores["mapper"]["fitted_to_truth"] = left
            plain, _ = links(survey, config, unrectified)
            chained, drawn[f"plain chaining, {name}"] = trajectory_scores(survey, chain(plain), with_scale)
            scores["plain_chaining"] = chained
            if survey.yaw_rad is not None:
                scores["plain_pairs"], _ = pair_scores(survey, survey.yaw_rad, plain)
        results[name] = scores
    return results, drawn


def table(flights: dict[str, dict[str, Any]]) -> str:
    """One line per flight and method."""
    head = (
        "flight", "method", "pairs", "trans med", "p90 m", "yaw med", "p90 deg", "map rmse m", "images",
        "plain rmse m", "images",
    )  # fmt: skip
    lines: list[tuple[str, ...]] = [head]
    for flight, results in flights.items():
        for method, scores in results.items():
            if not isinstance(scores, dict):
                continue
            pairs, flown, plain = (scores.get(k, {}) for k in ("pairs", "mapper", "plain_chaining"))
            figures = [pairs.get(name) for name in OF_PAIRS]
            figures += [path.get(name) for path in (flown, plain) for name in ("rmse_m", "images")]
            shown = ["-" if v is None else f"{v:.3f}" if isinstance(v, float) else str(v) for v in figures]
            lines.append((flight, method, *shown))
    widths = [max(len(row[i]) for row in lines) for i in range(len(head))]
    return "\n".join("  ".join(f"{cell:>{w}}" for cell, w in zip(row, widths, strict=True)) for row in lines)


def reached(flights: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The bars of the default method: wanted, measured, whether it holds."""
    rtk, tilted = flights["mirafiori_rtk"]["sift"], flights["sheffield_flight"]["sift"]
    one_map = tilted["mapper"]["images"] if not tilted["mapper"].get("restarts") else 0
    measured = {
        "mirafiori_pairs": rtk["pairs"]["pairs_registered"],
        "mirafiori_translation_median_m": rtk["pairs"]["translation_median_m"],
        "mirafiori_translation_p90_m": rtk["pairs"]["translation_p90_m"],
        "mirafiori_yaw_median_deg": rtk["pairs"]["yaw_median_deg"],
        "mirafiori_trajectory_rmse_m": rtk["mapper"].get("rmse_m"),
        "sheffield_images_in_one_map": one_map,
        "sheffield_trajectory_rmse_m": tilted["mapper"].get("rmse_m"),
    }
    answers = {}
    for name, wanted in BARS.items():
        value = measured[name]
        bar = min(wanted, tilted["images"]) if name == "sheffield_images_in_one_map" else wanted
        held = value is not None and (value >= bar if isinstance(bar, int) else value <= bar)
        answers[name] = {"bar": bar, "measured": value, "held": held}
    return answers


def evaluate(out: Path, seed: int, quick: bool, progress: Progress) -> str:
    """Run both flights, write report.json and report.html; the table.

    Nothing here is random; ``seed`` is kept with the report. A quick run maps with SIFT alone, and the
    first images of the longer flight.
    """
    data, started = data_folder(), time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    methods = configs(data)
    mapped_by = {"sift"} if quick else set(methods)
    surveys = (mirafiori(data), sheffield(data, QUICK_IMAGES if quick else None))
    flights: dict[str, dict[str, Any]] = {}
    pictures: list[tuple[str, Path]] = []
    for survey in surveys:
        with_scale = survey.yaw_rad is None
        used = methods if survey.yaw_rad is not None else {n: c for n, c in methods.items() if n in mapped_by}
        flights[survey.name], drawn = _flight(survey, used, with_scale, mapped_by, progress)
        pictures.append((f"{survey.name} (real imagery)", out / f"{survey.name}.png"))
        alignment = "similarity" if with_scale else "rigid"
        draw(pictures[-1][1], survey, drawn, f"{survey.name}, real imagery, {alignment} alignment")
    report = {
        "evaluation": "mapping",
        "imagery": "real: mirafiori_rtk (RTK, gimbal yaw), sheffield_flight (EXIF GPS, tilt estimated)",
        "quick": quick,
        "bars_of_sift": reached(flights),
        "seed": seed,
        "seconds": time.perf_counter() - started,
        **machine(),
        "flights": flights,
        "config": dataclasses.asdict(methods["sift"]),
    }
    (out / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    write_report(
        out / "report.html", "Mapping: registration and trajectory on real imagery", report, pictures
    )
    return f"real imagery: mirafiori_rtk, sheffield_flight\n{table(flights)}\n{out / 'report.html'}"
