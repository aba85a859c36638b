"""Maps without images: what a flight would have made of the buildings of a reference, errors and all.

Two sources of error lie between a reference and a map. The reference was digitised by somebody else than
nature: figures from PLATEAU against OpenStreetMap over Tokyo. And the drone misses, invents and shifts
buildings and bends the map along its path: levels 1 to 3, or what a segmenter was measured to do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from buildloc_matcher.reference.buildings import Buildings
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import FloatArray, LocalMap
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from buildloc_eval.segmentation_errors import read_errors

STEP_M = 5.0
LONGEST_PATH_M = 6_000.0
LEG_M = (250.0, 700.0)
HALF_SWATH_M = 70.0
STARTS_TRIED = 200
CARRIERS = 12


class ObservationError(BuildlocError):
    """No map can be made as asked."""


@dataclass(frozen=True)
class Digitiser:
    """How the world flown over differs from the reference.

    Shares without counterpart on either side; centroid offsets, log-normal with this median and spread of
    the logarithm; standard deviations of log area and of the four shape metrics.
    """

    reference_only: float = 0.10
    world_only: float = 0.21
    offset_median_m: float = 0.57
    offset_log_sigma: float = 0.755
    log_area_sigma: float = 0.16
    shape_sigma: tuple[float, float, float, float] = (0.052, 0.094, 0.057, 0.031)


@dataclass(frozen=True)
class Sensing:
    """What the drone does to the buildings it flies over: shares missed and invented, centroid jitter per
    axis, random walk of the heading over 10 m, standard deviation of the scale; bias and standard deviation
    of log area and standard deviations of the four shape metrics, beyond those of the digitiser."""

    missed: float
    false: float
    jitter_m: float
    heading_walk_deg: float
    scale_sigma: float
    log_area_bias: float = 0.0
    log_area_sigma: float = 0.0
    shape_sigma: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


Level = float | Literal["measured"]


def sensing(level: Level) -> Sensing:
    """Level n is n times level 1: 12 % missed, 8 % false, 1.2 m, 0.15 deg per 10 m, 1 %.

    "measured": what a single view of the segmenter does to buildings on ground it never saw (a merged one is
    missed too: its centroid is that of two), with the heading and scale of level 1. Raises ErrorModelError.
    """
    if level != "measured":
        return Sensing(0.12 * level, 0.08 * level, 1.2 * level, 0.15 * level, 0.01 * level)
    errors, one = read_errors(), sensing(1)
    return Sensing(
        min(errors.missed + errors.merged, 0.95), errors.false_share, errors.centroid_sigma_m,
        one.heading_walk_deg, one.scale_sigma,
        errors.log_area_bias, errors.log_area_sigma, errors.shape_sigma,
    )  # fmt: skip


@dataclass(frozen=True)
class ObservedMap:
    """A map in local metres, and the truth: where its buildings lie in the reference's frame, (N, 2)."""

    local_map: LocalMap
    true_m: FloatArray
    path_m: float

    @property
    def centre_m(self) -> FloatArray:
        """(2,) true place of the mean of the map's buildings, carried there by the buildings around it: in a
        map that bends, the mean of the true places lies elsewhere."""
        points = self.local_map.centroids_m
        return true_place(points, self.true_m, points.mean(axis=0))


def true_place(points_m: FloatArray, true_m: FloatArray, at_m: FloatArray) -> FloatArray:
    """(2,) where a place of a map truly lies, by the buildings (N, 2) around it and their true places."""
    near = np.argsort(np.sum((points_m - at_m) ** 2, axis=1))[:CARRIERS]
    source, target = points_m[near] @ (1.0, 1.0j), true_m[near] @ (1.0, 1.0j)
    middle, place = source.mean(), target.mean()
    turn = np.vdot(source - middle, target - place) / np.vdot(source - middle, source - middle).real
    moved = place + turn * (complex(at_m[0], at_m[1]) - middle)
    return np.array([moved.real, moved.imag])


def fly_path(start_m: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Places (P, 2) every STEP_M: straight legs with turns of 30 to 120 deg."""
    steps = int(LONGEST_PATH_M / STEP_M)
    headings = np.empty(steps)
    heading, at = rng.uniform(-math.pi, math.pi), 0
    while at < steps:
        leg = int(rng.uniform(*LEG_M) / STEP_M)
        headings[at : at + leg] = heading
        heading += math.copysign(rng.uniform(math.radians(30.0), math.radians(120.0)), rng.uniform(-1.0, 1.0))
        at += leg
    along = np.cumsum(np.column_stack([np.cos(headings), np.sin(headings)]) * STEP_M, axis=0)
    return np.asarray(start_m + along)


def bend(path_m: FloatArray, model: Sensing, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """The path as a drifting map has it, and the heading error (P,) along it."""
    sigma = math.radians(model.heading_walk_deg) * math.sqrt(STEP_M / 10.0)
    drift = np.cumsum(rng.normal(0.0, sigma, len(path_m)))
    moves = np.diff(path_m, axis=0, prepend=path_m[:1])
    return np.cumsum(turned(moves, drift), axis=0), drift


def observe_map(
    reference: Buildings,
    tree: cKDTree,
    count: int,
    model: Sensing,
    rng: np.random.Generator,
    digitiser: Digitiser = Digitiser(),
) -> ObservedMap:
    """A map of ``count`` buildings somewhere over the reference, at any heading.

    Raises ObservationError when no start among many leads over enough buildings.
    """
    for _ in range(STARTS_TRIED):
        start = reference.centroids_m[rng.integers(len(reference))]
        path = fly_path(start, rng)
        found = _observe_along(reference, tree, path, count, model, rng, digitiser)
        if found is not None:
            return found
    raise ObservationError(f"no flight of {LONGEST_PATH_M:g} m meets {count} buildings; ask for fewer")


@dataclass(frozen=True)
class Met:
    """The first buildings of the map along a path: true places (N, 2) in the reference's frame, rows (N,) of
    the building whose size and shape each has, steps (N,) of the path where it is passed."""

    true_m: FloatArray
    source: NDArray[np.int64]
    along: NDArray[np.int64]


def met_along(
    reference: Buildings,
    tree: cKDTree,
    path: FloatArray,
    count: int,
    model: Sensing,
    rng: np.random.Generator,
    digitiser: Digitiser,
) -> Met | None:
    """Who a map of ``count`` buildings is made of; None where the path leads over too few."""
    near = np.unique(np.concatenate(tree.query_ball_point(path[::10], HALF_SWATH_M + 10 * STEP_M))).astype(
        int
    )
    if len(near) < count // 2:
        return None
    apart, along = cKDTree(path).query(reference.centroids_m[near])
    near, along = near[apart < HALF_SWATH_M], along[apart < HALF_SWATH_M]
    kept = rng.random(len(near)) >= digitiser.reference_only
    seen = kept & (rng.random(len(near)) >= model.missed)
    rows, along = near[seen], along[seen]
    # Buildings that the reference does not have, real ones and invented ones, by their share of all seen.
    extra_share = 1.0 - (1.0 - digitiser.world_only) * (1.0 - model.false)
    extras = round(len(rows) * extra_share / (1.0 - extra_share))
    if len(rows) + extras < count:
        return None
    true = reference.centroids_m[rows] + digitising_offsets(len(rows), digitiser, rng)
    extra_at = rng.integers(0, int(along.max()) + 1, extras)
    extra = path[extra_at] + rng.uniform(-HALF_SWATH_M, HALF_SWATH_M, (extras, 2))
    like = rng.integers(0, len(rows), extras)  # as large and as shaped as their neighbours
    true = np.concatenate([true, extra])
    source = np.concatenate([rows, rows[like]])
    along = np.concatenate([along, extra_at])
    first = np.sort(np.argsort(along, kind="stable")[:count])
    return Met(true[first], source[first], along[first])


def _observe_along(
    reference: Buildings,
    tree: cKDTree,
    path: FloatArray,
    count: int,
    model: Sensing,
    rng: np.random.Generator,
    digitiser: Digitiser,
) -> ObservedMap | None:
    met = met_along(reference, tree, path, count, model, rng, digitiser)
    if met is None:
        return None
    true, along = met.true_m, met.along
    bent, drift = bend(path, model, rng)
    placed = bent[along] + turned(true - path[along], drift[along])
    placed += rng.normal(0.0, model.jitter_m, placed.shape)
    yaw, scale = rng.uniform(-math.pi, math.pi), 1.0 + rng.normal(0.0, model.scale_sigma)
    local = scale * turned(placed - placed[0], yaw)
    areas, shapes = measured(reference, met.source, scale, model, digitiser, rng)
    ids = np.arange(count, dtype=np.int64)
    local_map = LocalMap.whole(0, ids, local, areas, shapes, np.ones_like(ids))
    return ObservedMap(local_map, true, float(along.max()) * STEP_M)


def turned(vectors: FloatArray, angle_rad: FloatArray | float) -> FloatArray:
    """Vectors (N, 2) turned counter-clockwise, by an angle (N,) each or by one."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.column_stack([c * vectors[:, 0] - s * vectors[:, 1], s * vectors[:, 0] + c * vectors[:, 1]])


def measured(
    reference: Buildings,
    source: NDArray[np.int64],
    scale: float,
    model: Sensing,
    digitiser: Digitiser,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Areas (N,) m2 and shapes (N, 4) that a map of this scale has of the buildings of these rows."""
    count = len(source)
    log_area_sigma = math.hypot(digitiser.log_area_sigma, model.log_area_sigma)
    log_areas = rng.normal(0.0, log_area_sigma, count) + model.log_area_bias
    areas = reference.areas_m2[source] * np.exp(log_areas) * scale**2
    noisy = reference.shapes[source] + rng.normal(
        0.0, np.hypot(digitiser.shape_sigma, model.shape_sigma), (count, 4)
    )
    return np.asarray(areas, dtype=np.float64), np.clip(noisy, 0.05, 1.0)


def digitising_offsets(count: int, digitiser: Digitiser, rng: np.random.Generator) -> FloatArray:
    """(count, 2) between the centroids of a building in two sources, m."""
    length = digitiser.offset_median_m * np.exp(rng.normal(0.0, digitiser.offset_log_sigma, count))
    angle = rng.uniform(-math.pi, math.pi, count)
    return np.column_stack([length * np.cos(angle), length * np.sin(angle)])
