"""Refinement to the metre: the last keyframes against the reference, one optimum, honest covariance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from buildloc_msgs_py.types import FloatArray, FrameObservation, Keyframe
from scipy.spatial import cKDTree

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.evidence import Ground
from buildloc_matcher.geometry import Similarity, fit_rigid, wrap
from buildloc_matcher.point_grid import within
from buildloc_matcher.window import (
    CAUCHY,
    Solution,
    State,
    Window,
    associate,
    make_window,
    placed,
    solve,
    start,
)

RIVAL_M = 20.0  # another optimum is sought within this distance
RIVAL_CELL_M = 3.0
RIVAL_TURN_RAD = math.radians(4.0)
RIVALS = 4  # shifts tried
RIVAL_ROUNDS = 4
RIVAL_POINTS = 150  # of the observations: enough to tell one place from another
SAME_M = 2.0  # optima nearer than this, or than three sigma, are one
ONE_BUILDING_M = 3.0


@dataclass(frozen=True)
class Refined:
    """The last keyframe's camera at its capture time: ``position_m`` (2,) of the ground point below it and
    ``yaw_rad``, with ``covariance`` (3, 3) over east m, north m and yaw rad, in which the reference's own
    registration is counted. ``poses``: (3,) x, y, yaw in the world of every keyframe of the window, by stamp.
    The evidence: observations pooled, matched pairs, distinct reference buildings, and the residuals' RMS."""

    position_m: FloatArray
    yaw_rad: float
    covariance: FloatArray
    poses: Mapping[int, FloatArray]
    observed: int
    pairs: int
    buildings: int
    rms_m: float


@dataclass(frozen=True)
class Unrefined:
    """No refined pose, and why."""

    reason: str


NO_BUILDINGS = Unrefined("refinement found no buildings of the recent frames in the reference")


def refine(
    coarse: Similarity,
    keyframes: Sequence[Keyframe],
    observations: Sequence[FrameObservation],
    reference: Ground,
    config: MatcherConfig,
) -> Refined | Unrefined:
    """Correct where ``coarse`` (map -> world) puts the last ``refine_frames`` keyframes.

    All of them are moved as one first, by nearest neighbours within a distance that shrinks from
    ``refine_distance_m`` to ``refine_last_distance_m``; then each by itself (see :mod:`window`). Refused with
    fewer than three pairs, or where the same buildings fit nearly as well at another place near by.
    """
    last = sorted(keyframes, key=lambda k: k.stamp_ns)[-config.refine_frames :]
    window = make_window(last, observations) if last else None
    if window is None or not len(window.level_m):
        return NO_BUILDINGS
    state = start(coarse, last)
    points = placed(window, state)
    reach = 2.0 * config.refine_distance_m
    rows = within(reference.grid, *(points.min(axis=0) - reach), *(points.max(axis=0) + reach))
    if len(rows) < 3:
        return NO_BUILDINGS
    tree = cKDTree(reference.buildings_m[rows])
    shrink = np.geomspace(config.refine_distance_m, config.refine_last_distance_m, config.refine_iterations)
    moved = _moved_as_one(window, state, tree, shrink)
    solution = moved and solve(window, moved, tree, config.refine_last_distance_m, config)
    if not solution:
        return NO_BUILDINGS
    covariance = solution.covariance + np.diag([*2 * [config.sigma_registration_m**2], 0.0])
    rival = _rival_m(window, solution, tree, config)
    if rival is not None:
        return Unrefined(f"refinement found two optima {rival:.1f} m apart that fit alike")
    position, yaw = solution.state.poses[-1, :2], float(wrap(solution.state.poses[-1, 2]))
    return Refined(
        position, yaw, covariance, dict(zip(window.stamps_ns, solution.state.poses, strict=True)),
        len(window.level_m), len(solution.pairs), len(np.unique(solution.pairs.buildings)),
        math.sqrt(float(np.mean(np.sum(solution.residuals_m**2, axis=1)))),
    )  # fmt: skip


def _moved_as_one(window: Window, state: State, tree: cKDTree, distances_m: FloatArray) -> State | None:
    """Rigid steps over all pairs while the distance shrinks; None for fewer than three pairs."""
    points = placed(window, state)
    for distance_m in distances_m:
        pairs = associate(window, points, tree, distance_m)
        if len(pairs) < 3:
            return None
        step = fit_rigid(points[pairs.rows], tree.data[pairs.buildings])
        points, state = step.apply(points), state.moved(step)
    return state


def _rival_m(window: Window, solution: Solution, tree: cKDTree, config: MatcherConfig) -> float | None:
    """How far away another pose fits nearly as well as the solution, or None where there is none."""
    points = placed(window, solution.state)
    apart_m = max(SAME_M, 3.0 * math.sqrt(float(np.linalg.eigvalsh(solution.covariance[:2, :2])[-1])))
    # Each building counts once, however many frames saw it.
    views = cKDTree(points).query_ball_point(points, ONE_BUILDING_M, return_length=True)
    few = np.linspace(0, len(points) - 1, min(len(points), RIVAL_POINTS)).astype(np.int64)
    points, weights = points[few], len(points) / len(few) / views[few]
    distance_m = config.refine_last_distance_m
    scale_m = solution.growth * math.hypot(config.sigma_frame_m, config.sigma_building_m)

    def misfit(at_m: FloatArray) -> float:
        distance, _ = tree.query(at_m)
        normalised = np.minimum(distance, distance_m) / (CAUCHY * scale_m)
        return float(weights @ (0.5 * CAUCHY**2 * np.log1p(normalised**2)))

    bar = misfit(points) + config.min_optimum_lead
    for begun in _elsewhere(points, tree):
        moved = begun.apply(points)
        for _ in range(RIVAL_ROUNDS):
            distance, nearest = tree.query(moved, distance_upper_bound=distance_m)
            near = np.isfinite(distance)
            if near.sum() < 3:
                break
            moved = fit_rigid(moved[near], tree.data[nearest[near]], weights[near]).apply(moved)
        away = math.sqrt(float(np.mean(np.sum((moved - points) ** 2, axis=1))))
        if apart_m < away and misfit(moved) < bar:
            return away
    return None


def _elsewhere(points_m: FloatArray, tree: cKDTree) -> list[Similarity]:
    """Motions that put many buildings of the reference onto others, and turns: candidates for an optimum."""
    centre = (float(points_m[:, 0].mean()), float(points_m[:, 1].mean()))
    pairs = tree.query_pairs(RIVAL_M, output_type="ndarray")
    shifts = tree.data[pairs[:, 1]] - tree.data[pairs[:, 0]]
    shifts = np.concatenate([shifts, -shifts])
    cells, counts = np.unique(np.round(shifts / RIVAL_CELL_M), axis=0, return_counts=True)
    often = cells[np.argsort(-counts, kind="stable")[:RIVALS]] * RIVAL_CELL_M
    moves = [Similarity(centre, (centre[0] + x, centre[1] + y), 0.0) for x, y in often.tolist()]
    return moves + [Similarity(centre, centre, turn) for turn in (-RIVAL_TURN_RAD, RIVAL_TURN_RAD)]


def horizontal_variance(
    position_m: FloatArray, matched_m: FloatArray, rms_m: float, config: MatcherConfig
) -> float:
    """Variance per axis, m2, of a place in a map that lies by distinct matched buildings (M, 2) alone.

    The residual variance over the square root of their number (errors of neighbours in a map that bends are
    not independent), with the lever arm to the position, and the registration of the reference.
    """
    centre = matched_m.mean(axis=0)
    spread = float(np.mean(np.sum((matched_m - centre) ** 2, axis=1)))
    lever = float(np.sum((position_m - centre) ** 2))
    residual = max(rms_m**2, 2.0 * config.sigma_building_m**2)
    variance = residual / math.sqrt(len(matched_m)) * (1.0 + lever / max(spread, 1.0))
    return variance + config.sigma_registration_m**2


def covariance_enu(pose_covariance: FloatArray, config: MatcherConfig) -> FloatArray:
    """(3, 3) m2, east, north, up, from that over east, north and yaw. The altitude is above ground, not
    above the ellipsoid: wide."""
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = pose_covariance[:2, :2]
    covariance[2, 2] = config.sigma_up_m**2
    return covariance
