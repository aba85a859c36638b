"""Registration of consecutive images against truth, by method, and constant errors of telemetry."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from buildloc_mapper.config import MapperConfig
from buildloc_mapper.registration import Link, Registration
from buildloc_mapper.similarity import Similarity
from buildloc_msgs_py.types import FloatArray, Frame

from buildloc_eval.flown import Flight, Path2d


def links(
    flight: Flight, config: MapperConfig, seen: Callable[[Frame], Frame]
) -> tuple[list[Link | None], dict[str, float]]:
    """Registration of every image in the one before it; None where it was rejected, counted by reason."""
    registration, rejected = Registration(config), Counter[str]()
    found: list[Link | None] = []
    prepare_s = register_s = 0.0
    before = None
    for index in range(len(flight)):
        frame = seen(flight.frame(index))
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
        "prepare_ms": 1e3 * prepare_s / len(flight), "register_ms": 1e3 * register_s / max(1, len(found))
    }  # fmt: skip
    return found, {**rejected, **seconds}


def chain(found: list[Link | None]) -> Path2d:
    """Consecutive links, one after the other, up to the first that is missing."""
    poses = [Similarity(0.0, 0.0, 0.0, 1.0)]
    for link in found:
        if link is None:
            break
        poses.append(poses[-1].compose(link.transform))
    return Path2d(tuple(range(len(poses))), tuple(poses), {})


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
    flight: Flight, yaw_rad: FloatArray, found: list[Link | None]
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
        true.append(flight.true_m[index + 1] - flight.true_m[index])
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
