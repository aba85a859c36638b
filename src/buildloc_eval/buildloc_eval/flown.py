"""Trajectories of flights with known positions: through the mapper, chained plainly, and their errors."""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from buildloc.map_picture import MapPicture
from buildloc_mapper.config import MapperConfig
from buildloc_mapper.mapper import Mapper, MapUpdate
from buildloc_mapper.similarity import Similarity
from buildloc_msgs_py.types import FloatArray, Frame, Mask
from evo.core.metrics import APE, PoseRelation
from evo.core.trajectory import PosePath3D

from buildloc_eval.survey import LEVEL


class Flight(Protocol):
    """N images with telemetry, their building masks, and the truth the mapper never sees."""

    @property
    def name(self) -> str:
        """What the report calls it."""

    @property
    def true_m(self) -> FloatArray:
        """(N, 2) true places, east and north in metres."""

    def __len__(self) -> int: ...

    def frame(self, index: int) -> Frame:
        """An image with its telemetry."""

    def mask(self, index: int) -> Mask:
        """Its buildings."""


@dataclass(frozen=True)
class Path2d:
    """Poses (N,) of images ``index`` (N,) in the frame of the first, and what happened on the way."""

    index: tuple[int, ...]
    poses: tuple[Similarity, ...]
    counts: dict[str, float]


@dataclass(frozen=True)
class Aligned:
    """A trajectory's scores against truth, its aligned places (N, 2), and the similarity that aligned it."""

    scores: dict[str, Any]
    places_m: FloatArray
    to_world: Similarity


def unrectified(frame: Frame) -> Frame:
    """The frame as if its camera had no lens errors and looked straight down."""
    return replace(frame, camera=replace(frame.camera, distortion=()), attitude_xyzw=LEVEL)


def mapped(
    flight: Flight, config: MapperConfig, picture: MapPicture | None = None
) -> tuple[Path2d, MapUpdate | None]:
    """The flight through the mapper, and the last map; ``picture`` takes the images."""
    mapper, seconds = Mapper(config), list[float]()
    index_of = dict[int, int]()
    for index in range(len(flight)):
        frame, mask = flight.frame(index), flight.mask(index)
        index_of[frame.stamp_ns] = index
        if picture is not None:
            picture.add(frame)
        started = time.perf_counter()
        mapper.add(frame, mask)
        seconds.append(time.perf_counter() - started)
    update = mapper.finish()
    if update is None:
        return Path2d((), (), {}), None
    path = path_of(update, index_of)
    path.counts["median_ms_per_keyframe"] = 1e3 * float(np.median(seconds))
    return path, update


def path_of(update: MapUpdate, index_of: Mapping[int, int]) -> Path2d:
    """The keyframes of a map as images of a flight, whose numbers ``index_of`` gives by stamp, and the map's
    counts of links and submaps."""
    kept = ("loop_closures", "submaps", "unlinked", "joins", "scale_sigma")
    counts = {k: v for k, v in update.funnel.items() if k in kept or k.startswith("rejected_")}
    poses = tuple(Similarity(k.x_m, k.y_m, k.yaw_rad, k.scale) for k in update.keyframes)
    return Path2d(tuple(index_of[k.stamp_ns] for k in update.keyframes), poses, counts)


def _evo_path(places_m: FloatArray, yaw_rad: FloatArray) -> PosePath3D:
    """(N, 2) places and (N,) yaws in the plane as evo takes them."""
    half, none = yaw_rad / 2.0, np.zeros(len(yaw_rad))
    return PosePath3D(
        positions_xyz=np.column_stack([places_m, none]),
        orientations_quat_wxyz=np.column_stack([np.cos(half), none, none, np.sin(half)]),
    )


def align(flight: Flight, flown: Path2d, with_scale: bool) -> Aligned | None:
    """Evo's absolute position error after alignment; None for fewer than three images.

    ``scale`` of the scores is that of an alignment by similarity: metres of the world per metre of the map.
    """
    if len(flown.index) < 3:
        return None
    places = np.array([pose[:2] for pose in flown.poses])
    estimate = _evo_path(places, np.array([pose.yaw_rad for pose in flown.poses]))
    true = flight.true_m[list(flown.index)]
    reference = _evo_path(true, np.zeros(len(true)))
    _, _, scale = copy.deepcopy(estimate).align(reference, correct_scale=True)
    rotation, translation, used = estimate.align(reference, correct_scale=with_scale)
    metric = APE(PoseRelation.translation_part)
    metric.process_data((reference, estimate))
    rmse, median, largest = (float(metric.get_all_statistics()[k]) for k in ("rmse", "median", "max"))
    length = float(np.hypot(*np.diff(true, axis=0).T).sum())
    scores = {
        "images": len(flown.index), "of": len(flight),
        "share_of_images": len(flown.index) / len(flight), "length_m": length,
        "rmse_m": rmse, "rmse_percent": 100.0 * rmse / length, "median_m": median, "max_m": largest,
        "scale": float(scale), **flown.counts,
    }  # fmt: skip
    yaw = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
    to_world = Similarity(float(translation[0]), float(translation[1]), yaw, float(used))
    return Aligned(scores, np.asarray(estimate.positions_xyz[:, :2], dtype=np.float64), to_world)


def draw(path: Path, flight: Flight, aligned: dict[str, Aligned], title: str) -> None:
    """True path and aligned paths, east and north in metres."""
    figure, axes = plt.subplots(figsize=(9, 7))
    origin = flight.true_m[0]
    axes.plot(*(flight.true_m - origin).T, "k.-", lw=2.0, ms=4, label="truth")
    for name, path_of in aligned.items():
        axes.plot(*(path_of.places_m - origin).T, "-", lw=1.2, label=name)
    axes.set_aspect("equal")
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    axes.set_title(title)
    axes.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
