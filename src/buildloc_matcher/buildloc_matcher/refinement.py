"""Refinement to the metre: the last keyframes against the reference, one optimum, honest covariance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from buildloc_msgs_py.types import FloatArray, FrameObservation
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.evidence import GATE_SIGMAS, Ground
from buildloc_matcher.geometry import Similarity, fit_rigid, wrap
from buildloc_matcher.outline_fit import walls
from buildloc_matcher.point_grid import within
from buildloc_matcher.pursuit import Pose, drift_covariance
from buildloc_matcher.reference.buildings import OUTLINE_UNIT_M
from buildloc_matcher.window import (
    Pairing,
    Pairs,
    Solution,
    Start,
    State,
    Window,
    associate,
    associate_outlines,
    cauchy,
    make_window,
    placed,
    solve,
)

# Another optimum is sought within three sigma of the start, at least and at most so far.
RIVAL_M, MOST_RIVAL_M = 25.0, 90.0
RIVAL_CELL_M = 3.0
RIVAL_TURN_RAD = math.radians(4.0)
RIVALS = 8  # shifts tried
KEPT = (10, 5, 5)  # the best after each rigid step
SOME = 80  # observations: enough to tell one place from another
SAME_M = 2.0  # optima nearer than this, or than three sigma, are one
ONE_BUILDING_M = 3.0
CROWD = 4  # neighbours that tell how close houses stand
LATEST_BUILDINGS = 3  # that tell where the last keyframe is


@dataclass(frozen=True)
class Refined:
    """The last keyframe's camera at its capture time: ``position_m`` (2,) of the ground point below it and
    ``yaw_rad``, with ``covariance`` (3, 3) over east m, north m and yaw rad, in which the reference's own
    registration is counted. ``poses``: x, y and yaw in the world of every keyframe of the window, by stamp.
    The evidence: observations pooled, matched pairs, distinct reference buildings, and the residuals' RMS."""

    position_m: FloatArray
    yaw_rad: float
    covariance: FloatArray
    poses: Mapping[int, Pose]
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
    begun: Start, observations: Sequence[FrameObservation], reference: Ground, config: MatcherConfig
) -> Refined | Unrefined:
    """Correct where a start puts the last keyframes.

    All of them are moved as one first, by nearest neighbours within a distance that shrinks from
    ``refine_distance_m`` to ``refine_last_distance_m``; there and at places like it, outlines are put onto
    the walls of the reference, or centroids onto centroids; from the best place each keyframe is moved by
    itself (see :mod:`window`). Refused with fewer than three pairs, or where another place fits nearly as
    well.
    """
    window, state = make_window(begun, observations) if begun.keyframes else None, begun.state
    if window is None or not len(window.level_m):
        return NO_BUILDINGS
    points = placed(window, state)
    reach_m = min(max(RIVAL_M, 3.0 * begun.sigma_m), MOST_RIVAL_M)
    reach = reach_m + config.refine_distance_m
    rows = within(reference.grid, *(points.min(axis=0) - reach), *(points.max(axis=0) + reach))
    if len(rows) < 3:
        return NO_BUILDINGS
    tree = cKDTree(reference.buildings_m[rows])
    moved = state
    for distance_m in np.geomspace(
        config.refine_distance_m, config.refine_last_distance_m, config.refine_iterations
    ):
        moved = _moved_as_one(window, moved, associate(window, moved, tree, distance_m))
    starts = [moved, state, *(moved.moved(by) for by in _elsewhere(placed(window, moved), tree, reach_m))]
    for pairing in _pairings(window, reference, rows, tree, config):
        optima = _Optima(window, state, starts, pairing, config)
        solution = solve(window, optima.best, pairing, config)
        if solution is not None:
            break
    else:
        return NO_BUILDINGS
    rival_m = optima.rival_m(solution)
    if rival_m is not None:
        return Unrefined(f"refinement found two optima {rival_m:.1f} m apart that fit alike")
    covariance = solution.covariance / _certainty(solution, tree, config)
    covariance += registration_covariance(config)
    covariance += drift_covariance(_unseen_m(window, solution, config), config)
    position, yaw = solution.state.poses[-1, :2], float(wrap(solution.state.poses[-1, 2]))
    placed_at = zip(window.stamps_ns, solution.state.poses.tolist(), strict=True)
    poses = {stamp: (x, y, heading) for stamp, (x, y, heading) in placed_at}
    return Refined(
        position, yaw, covariance, poses,
        len(window.level_m), len(solution.pairs), solution.pairs.seen,
        math.sqrt(float(np.mean(np.sum(solution.residuals_m**2, axis=1)))),
    )  # fmt: skip


def _certainty(solution: Solution, tree: cKDTree, config: MatcherConfig) -> float:
    """The mean probability of the pairs to be of the same building: where houses stand as close as they are
    seen badly, the nearest is often another, and residuals do not show it."""
    places_m = tree.data[solution.pairs.buildings]
    away_m, _ = tree.query(places_m, k=min(CROWD + 1, tree.n))
    by_chance = CROWD / (math.pi * np.maximum(away_m[:, -1], 1.0) ** 2)
    variance = solution.growth**2 * (config.sigma_frame_m**2 + config.sigma_building_m**2)
    squared = np.sum(solution.residuals_m**2, axis=1)
    likely = np.exp(-0.5 * squared / variance) / (2.0 * math.pi * variance)
    return float(np.mean(likely / (likely + by_chance)))


def _unseen_m(window: Window, solution: Solution, config: MatcherConfig) -> float:
    """How far the last keyframe is along the path from the third-latest building that was found."""
    sigma_m = solution.growth * math.hypot(config.sigma_frame_m, config.sigma_building_m)
    near = np.hypot(*solution.residuals_m.T) < GATE_SIGMAS * sigma_m
    frames, buildings = window.frames[solution.pairs.rows[near]], solution.pairs.buildings[near]
    _, last = np.unique(buildings[::-1], return_index=True)  # of each building the latest frame
    seen = np.sort(frames[::-1][last])
    latest = seen[-min(LATEST_BUILDINGS, len(seen))] if len(seen) else 0
    return float(np.hypot(*window.steps[latest:, :2].T).sum())


def _pairings(
    window: Window, reference: Ground, rows: NDArray[np.int64], tree: cKDTree, config: MatcherConfig
) -> list[Pairing]:
    """Outlines to the walls, if both sides have some; where hardly any fits, centroids to the nearest."""
    nearest = partial(associate, reference=tree, distance_m=config.refine_last_distance_m)
    if window.outlines_m is None or reference.outlines is None:
        return [nearest]
    about = OUTLINE_UNIT_M * reference.outlines[rows].astype(np.float64)
    return [partial(associate_outlines, reference=walls(reference.buildings_m[rows, None] + about)), nearest]


def _moved_as_one(window: Window, state: State, pairs: Pairs) -> State:
    """The rigid step that brings all pairs together best; none for fewer than three."""
    if len(pairs) < 3:
        return state
    return state.moved(fit_rigid(placed(window, state)[pairs.rows], pairs.targets_m))


class _Optima:
    """Where rigid steps lead from several starts, by some of the observations; and which fits best."""

    def __init__(
        self, window: Window, coarse: State, starts: Sequence[State], pairing: Pairing, config: MatcherConfig
    ) -> None:
        count = len(window.level_m)
        # Each building counts once, however many frames saw it.
        points = placed(window, starts[0])
        views = cKDTree(points).query_ball_point(points, ONE_BUILDING_M, return_length=True)
        few = np.linspace(0, count - 1, min(count, SOME)).astype(np.int64)
        self._window, self._weights = window.thinned(few), count / len(few) / views[few]
        self._coarse, self._config = coarse, config
        states = list(starts)
        for kept in KEPT:
            paired = [(state, pairing(self._window, state)) for state in states]
            paired.sort(key=lambda one: self._misfit(*one))
            states = [_moved_as_one(self._window, *one) for one in paired[:kept]]
        self._found = [(state, pairing(self._window, state)) for state in states]
        self._found.sort(key=lambda one: self._misfit(*one))
        self.best = self._found[0][0]

    def _misfit(self, state: State, pairs: Pairs, growth: float = 1.0) -> float:
        """Nats, of errors that are ``growth`` times as large as the parameters have them."""
        sigma_m = growth * math.hypot(self._config.sigma_frame_m, self._config.sigma_building_m)
        alone = cauchy((self._config.refine_last_distance_m / sigma_m) ** 2)
        apart = pairs.targets_m - placed(self._window, state)[pairs.rows]
        told = np.einsum("pi,pij,pj->p", apart, pairs.certainty, apart)
        costs = np.full(len(self._weights), alone)
        costs[pairs.rows] += pairs.covered * np.minimum(0.0, cauchy(told / sigma_m**2) - alone)
        away = (state.poses - self._coarse.poses)[-1]
        away[2] = wrap(away[2])
        away /= (self._window.start_m, self._window.start_m, self._window.start_rad)
        return float(self._weights @ costs + 0.5 * away @ away)

    def rival_m(self, solution: Solution) -> float | None:
        """How far from the best another optimum lies that fits nearly as well; None where there is none."""
        spread_m = math.sqrt(float(np.linalg.eigvalsh(solution.covariance[:2, :2])[-1]))
        points = placed(self._window, self.best)
        bar = self._misfit(*self._found[0], solution.growth) + self._config.min_optimum_lead
        for state, pairs in self._found[1:]:
            away = math.sqrt(float(np.mean(np.sum((placed(self._window, state) - points) ** 2, axis=1))))
            if away > max(SAME_M, 3.0 * spread_m) and self._misfit(state, pairs, solution.growth) < bar:
                return away
        return None


def _elsewhere(points_m: FloatArray, tree: cKDTree, reach_m: float) -> list[Similarity]:
    """Motions that lay many of the observed buildings (N, 2) onto some of the reference, as they are and
    turned either way, the most first: candidates for an optimum."""
    centre = points_m.mean(axis=0)
    anchor = (float(centre[0]), float(centre[1]))
    moves, counts = list[Similarity](), list[int]()
    for turn in (0.0, -RIVAL_TURN_RAD, RIVAL_TURN_RAD):
        turned = Similarity(anchor, anchor, turn).apply(points_m)
        near = tree.query_ball_point(turned, reach_m)
        which = np.repeat(np.arange(len(turned)), [len(one) for one in near])
        shifts = tree.data[np.concatenate(near).astype(np.int64)] - turned[which]
        cells, often = np.unique(np.round(shifts / RIVAL_CELL_M), axis=0, return_counts=True)
        for at in np.argsort(-often, kind="stable")[:RIVALS]:
            x, y = (centre + cells[at] * RIVAL_CELL_M).tolist()
            moves.append(Similarity(anchor, (x, y), turn))
            counts.append(int(often[at]))
    return [moves[at] for at in np.argsort(-np.array(counts), kind="stable")[:RIVALS]]


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


def registration_covariance(config: MatcherConfig) -> FloatArray:
    """(3, 3) over east, north and yaw of what all places found in the reference share."""
    return np.diag([*2 * [config.sigma_registration_m**2], 0.0])


def covariance_enu(pose_covariance: FloatArray, config: MatcherConfig) -> FloatArray:
    """(3, 3) m2, east, north, up, from that over east, north and yaw. The altitude is above ground, not
    above the ellipsoid: wide."""
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = pose_covariance[:2, :2]
    covariance[2, 2] = config.sigma_up_m**2
    return covariance
