"""A sliding window of keyframes fitted to the reference by least squares.

Unknown are the world poses (x, y, yaw) of K keyframes and two common scales: of what the frames saw, which
altimeter and roof height shift, and of the path between them. Known are which building of the reference each
observed one is, and, up to a random walk along the flight, the steps that the mapper measured. World frame,
metres and radians.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from buildloc_msgs_py.types import FloatArray, FrameObservation, Keyframe
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.geometry import Similarity, wrap
from buildloc_matcher.outline_fit import Walls, align

SHORTEST_STEP_M = 1.0
CAUCHY = 2.385  # 95 % as efficient as least squares where errors are normal
RAYLEIGH_MEDIAN = math.sqrt(2.0 * math.log(2.0))  # of the length of a plane vector of unit variance per axis
ROUNDS = 10
CONVERGED_M, CONVERGED_RAD = 0.02, 2e-4


@dataclass(frozen=True)
class Window:
    """K keyframes in the order of time with the N buildings that they saw.

    ``steps`` (K-1, 3) is the mapper's pose of each keyframe in the axes of the one before; ``frames`` (N,)
    the keyframe of an observation, rising, and ``level_m`` (N, 2) its place in the level camera frame;
    ``outlines_m`` (N, P, 2) points of its outline there, or None. ``start_m``, ``start_rad``: the standard
    deviations, per axis and of the heading, of where the last keyframe is thought to be.
    """

    stamps_ns: tuple[int, ...]
    steps: FloatArray
    frames: NDArray[np.int64]
    level_m: FloatArray
    outlines_m: FloatArray | None
    start_m: float
    start_rad: float

    def thinned(self, rows: NDArray[np.int64]) -> Window:
        """All keyframes with some of the observations, and half of the points of their outlines."""
        outlines = None if self.outlines_m is None else self.outlines_m[rows, ::2]
        return replace(self, frames=self.frames[rows], level_m=self.level_m[rows], outlines_m=outlines)


@dataclass(frozen=True)
class State:
    """Poses (K, 3) in the world, and the logarithms of the scale of frames and of path (2,)."""

    poses: FloatArray
    log_scales: FloatArray

    def moved(self, by: Similarity) -> State:
        """All keyframes moved as one rigid body."""
        yaws = self.poses[:, 2] + by.yaw_rad
        return replace(self, poses=np.column_stack([by.apply(self.poses[:, :2]), yaws]))


@dataclass(frozen=True)
class Pairs:
    """``rows`` (P,) of the window's observations, ``buildings`` (P,) of the reference that they are, where in
    the world the observations should lie (P, 2), and how well each pair tells that in any direction, (P, 2,
    2) from zero to the identity. ``covered`` (P,) is the share of an observation that the reference explains,
    ``seen`` how many of its buildings are among them."""

    rows: NDArray[np.int64]
    buildings: NDArray[np.int64]
    targets_m: FloatArray
    certainty: FloatArray
    covered: FloatArray
    seen: int

    def __len__(self) -> int:
        return len(self.rows)


@dataclass(frozen=True)
class Solution:
    """The fitted state, the covariance (3, 3) of its last pose, the pairs it rests on, their residuals
    (P, 2), and by how much the errors turned out larger than the parameters have them."""

    state: State
    covariance: FloatArray
    pairs: Pairs
    residuals_m: FloatArray
    growth: float


def make_window(begun: Start, observations: Sequence[FrameObservation]) -> Window:
    """The window of a start's keyframes, at least one; observations of other frames are left out."""
    of_frame = {o.stamp_ns: o for o in observations if len(o.centroids_m)}
    keyframes = begun.keyframes
    found = [of_frame.get(k.stamp_ns) for k in keyframes]
    seen = [np.empty((0, 2)) if one is None else one.centroids_m for one in found]
    outlines = [one.outlines_m for one in found if one is not None]
    known = [one for one in outlines if one is not None]
    poses = np.array([[k.x_m, k.y_m, k.yaw_rad] for k in keyframes])
    moves = np.diff(poses, axis=0)
    steps = np.column_stack([_turned(moves[:, :2], -poses[:-1, 2]), moves[:, 2]])
    frames = np.repeat(np.arange(len(keyframes)), [len(one) for one in seen])
    around = np.concatenate(known) if known and len(known) == len(outlines) else None
    stamps = tuple(k.stamp_ns for k in keyframes)
    return Window(stamps, steps, frames, np.concatenate(seen), around, begun.sigma_m, begun.sigma_rad)


@dataclass(frozen=True)
class Start:
    """Where a fit begins: keyframes in the order of time, where they are thought to be, and the standard
    deviations of the last one's place per axis and of its heading."""

    keyframes: tuple[Keyframe, ...]
    state: State
    sigma_m: float
    sigma_rad: float

    @property
    def covariance(self) -> FloatArray:
        """(3, 3) of the last pose over east, north and yaw."""
        return np.diag(np.square([self.sigma_m, self.sigma_m, self.sigma_rad]))


def start(
    coarse: Similarity, keyframes: Sequence[Keyframe], config: MatcherConfig, sigma_m: float = 0.0
) -> Start:
    """The last ``refine_frames`` keyframes where a similarity map -> world puts them; what frames saw keeps
    the altimeter's scale. ``sigma_m`` is the least that the place is taken to be uncertain by."""
    last = newest(keyframes, config.refine_frames)
    poses = np.array([[k.x_m, k.y_m, k.yaw_rad] for k in last]).reshape(-1, 3)
    placed = np.column_stack([coarse.apply(poses[:, :2]), poses[:, 2] + coarse.yaw_rad])
    state = State(placed, np.array([0.0, math.log(coarse.scale)]))
    sigma_m = max(sigma_m, config.refine_distance_m / 3.0)
    return Start(last, state, sigma_m, math.radians(config.rotation_tolerance_deg))


def frames_kept(config: MatcherConfig) -> int:
    """How many keyframes back a match is looked for that the flight can be followed from."""
    return 8 * config.refine_frames


def newest(keyframes: Sequence[Keyframe], count: int) -> tuple[Keyframe, ...]:
    """The last keyframes, in the order of time."""
    return tuple(sorted(keyframes, key=lambda k: k.stamp_ns)[-count:])


def placed(window: Window, state: State) -> FloatArray:
    """(N, 2) observed buildings in the world."""
    poses = state.poses[window.frames]
    return poses[:, :2] + math.exp(state.log_scales[0]) * _turned(window.level_m, poses[:, 2])


Pairing = Callable[[Window, State], Pairs]


def associate(window: Window, state: State, reference: cKDTree, distance_m: float) -> Pairs:
    """Nearest neighbours closer than the distance; of several of one frame the nearest has the building."""
    distance, nearest = reference.query(placed(window, state), distance_upper_bound=distance_m)
    rows = np.flatnonzero(np.isfinite(distance))
    rows = rows[np.argsort(distance[rows], kind="stable")]
    _, first = np.unique(window.frames[rows] * reference.n + nearest[rows], return_index=True)
    rows = np.sort(rows[first])
    buildings = nearest[rows]
    whole = np.broadcast_to(np.eye(2), (len(rows), 2, 2))
    seen = len(np.unique(buildings))
    return Pairs(rows, buildings, reference.data[buildings], whole, np.ones(len(rows)), seen)


def associate_outlines(window: Window, state: State, reference: Walls) -> Pairs:
    """The observations whose outlines lie on walls, each with the shift onto them."""
    assert window.outlines_m is not None
    poses, scale, count = state.poses[window.frames], math.exp(state.log_scales[0]), len(window.level_m)
    around = _turned(window.outlines_m.reshape(-1, 2), np.repeat(poses[:, 2], window.outlines_m.shape[1]))
    found = align(poses[:, None, :2] + scale * around.reshape(count, -1, 2), reference)
    rows = np.flatnonzero(found.buildings >= 0)
    targets = placed(window, state)[rows] + found.shifts_m[rows]
    certainty, covered, seen = found.certainty[rows], found.covered[rows], int(found.seen.sum())
    return Pairs(rows, found.buildings[rows], targets, certainty, covered, seen)


def cauchy(squared: FloatArray | float) -> FloatArray:
    """Robust cost, nats, of squared errors over their variance: half of them where they are small."""
    return np.asarray(0.5 * CAUCHY**2 * np.log1p(np.asarray(squared) / CAUCHY**2), dtype=np.float64)


def solve(window: Window, state: State, pairing: Pairing, config: MatcherConfig) -> Solution | None:
    """Gauss-Newton with robust weights, paired anew in every round; None for fewer than three pairs.

    An observation of a building that is seen n times has the variance sigma_frame^2 + n sigma_building^2, so
    that all n together weigh what one of them without its own noise does. Errors that turn out larger than
    these widen the covariance, and the errors of the path by as much; smaller ones do not narrow it.
    """
    first, growth = state, 1.0
    for _ in range(ROUNDS):
        pairs = pairing(window, state)
        if len(pairs) < 3:
            return None
        fit = _Fit(window, state, first, pairs, growth, config)
        growth = fit.grown()
        step = np.linalg.solve(fit.information(fit.weights), fit.gradient()).astype(np.float64)
        state = State(state.poses + step[:-2].reshape(-1, 3), state.log_scales + step[-2:])
        moved = np.abs(step[:-2].reshape(-1, 3)).max(axis=0)
        if moved[:2].max() < CONVERGED_M and moved[2] < CONVERGED_RAD:
            break
    pairs = pairing(window, state)
    if len(pairs) < 3:
        return None
    fit = _Fit(window, state, first, pairs, growth, config)
    covariance, inflation = fit.covariance()
    return Solution(state, covariance, pairs, fit.residuals_m, growth * math.sqrt(inflation))


class _Fit:
    """One linearisation: residuals, robust weights and the normal equations over 3 K + 2 unknowns."""

    def __init__(
        self, window: Window, state: State, first: State, pairs: Pairs, growth: float, config: MatcherConfig
    ) -> None:
        self._state, self._first, self._config, self._window = state, first, config, window
        frames = window.frames[pairs.rows]
        turned = _turned(window.level_m[pairs.rows], state.poses[frames, 2])
        self._arms = math.exp(state.log_scales[0]) * turned
        self.residuals_m = pairs.targets_m - state.poses[frames, :2] - self._arms
        self._certainty = pairs.certainty
        _, self._building, seen = np.unique(pairs.buildings, return_inverse=True, return_counts=True)
        self._seen = seen.astype(np.float64)
        own, shared = config.sigma_frame_m**2, config.sigma_building_m**2
        self._growth = growth
        self._mean_variance = shared + own / self._seen
        self.variances = growth**2 * (own + self._seen[self._building] * shared)
        scale2 = growth**2 * (own + shared)
        told = np.einsum("pi,pij,pj->p", self.residuals_m, pairs.certainty, self.residuals_m)
        self.weights = 1.0 / (1.0 + told / (CAUCHY**2 * scale2))
        self._of_frame = (frames == np.arange(len(state.poses))[:, None]).astype(np.float64)
        self._steps, self._step_jacobian, self._step_information = self._walk(window)

    def _walk(self, window: Window) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residuals (R,), Jacobian (R, 3 K + 2) and information (R,) of the steps between keyframes."""
        poses, count = self._state.poses, len(self._state.poses)
        arms = math.exp(self._state.log_scales[1]) * _turned(window.steps[:, :2], poses[:-1, 2])
        moves = np.diff(poses, axis=0)
        residuals = np.column_stack([arms - moves[:, :2], wrap(window.steps[:, 2] - moves[:, 2])])
        jacobian = np.zeros((count - 1, 3, 3 * count + 2))
        row, axis = np.arange(count - 1)[:, None], np.arange(3)
        jacobian[row, axis, 3 * row + 3 + axis] = 1.0
        jacobian[row, axis, 3 * row + axis] = -1.0
        row = row[:, 0]
        jacobian[row, 0, 3 * row + 2], jacobian[row, 1, 3 * row + 2] = arms[:, 1], -arms[:, 0]
        jacobian[:, :2, -1] = -arms
        length = np.maximum(np.hypot(*window.steps[:, :2].T), SHORTEST_STEP_M)
        sigmas = np.array([self._config.walk_m, self._config.walk_m, math.radians(self._config.walk_deg)])
        information = 1.0 / (length[:, None] * (self._growth * sigmas) ** 2)
        return residuals.ravel(), jacobian.reshape(-1, 3 * count + 2), information.ravel()

    def _means(self, values: FloatArray) -> FloatArray:
        """Mean over the observations of each building."""
        return np.bincount(self._building, values, len(self._seen)) / self._seen

    def _unlikely(self) -> FloatArray:
        """(B,) squared mean residual of each building over its variance per axis, before any growth."""
        told = np.einsum("pij,pj->pi", self._certainty, self.residuals_m)
        squared = self._means(told[:, 0]) ** 2 + self._means(told[:, 1]) ** 2
        return np.asarray(squared / self._mean_variance)

    def grown(self) -> float:
        """How much larger than modelled the errors are, by their median; at least 1."""
        return max(1.0, math.sqrt(float(np.median(self._unlikely()))) / RAYLEIGH_MEDIAN)

    def _observed(self, weights: FloatArray) -> FloatArray:
        """Information (3 K + 2, 3 K + 2) of the observations with weights (P,)."""
        x, y = self._arms.T
        jacobian = np.zeros((len(x), 2, 4))
        jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
        jacobian[:, :, 2], jacobian[:, :, 3] = np.column_stack([-y, x]), self._arms
        weighted = (weights / self.variances)[:, None, None] * self._certainty @ jacobian
        blocks = np.einsum("pij,pik->pjk", jacobian, weighted)
        count = len(self._of_frame)
        blocks = (self._of_frame @ blocks.reshape(-1, 16)).reshape(count, 4, 4)
        information = np.zeros((3 * count + 2, 3 * count + 2))
        at = 3 * np.arange(count)[:, None] + np.arange(3)
        information[at[:, :, None], at[:, None, :]] = blocks[:, :3, :3]
        information[at, -2] = information[-2, at] = blocks[:, :3, 3]
        information[-2, -2] = blocks[:, 3, 3].sum()
        return information

    def _prior(self) -> FloatArray:
        """(3 K + 2,) information of the start, which is weak, about the last pose, and of both scales."""
        information = np.zeros(3 * len(self._of_frame) + 2)
        place, turn, scale = self._window.start_m, self._window.start_rad, self._config.sigma_scale
        information[-5:] = 1.0 / np.square([place, place, turn, scale, scale])
        return information

    def information(self, weights: FloatArray) -> FloatArray:
        """All information with these weights of the observations."""
        walked = (self._step_jacobian.T * self._step_information) @ self._step_jacobian
        return np.asarray(self._observed(weights) + walked + np.diag(self._prior()))

    def gradient(self) -> FloatArray:
        """(3 K + 2,) by which the normal equations give the step."""
        pulls = np.einsum("p,pij,pj->pi", self.weights / self.variances, self._certainty, self.residuals_m)
        turns = self._arms[:, 0] * pulls[:, 1] - self._arms[:, 1] * pulls[:, 0]
        per_frame = self._of_frame @ np.column_stack([pulls, turns])
        gradient = np.concatenate([per_frame.ravel(), [np.sum(self._arms * pulls), 0.0]])
        gradient += self._step_jacobian.T @ (self._step_information * self._steps)
        gone = np.concatenate([(self._first.poses - self._state.poses).ravel(), -self._state.log_scales])
        return np.asarray(gradient + self._prior() * gone)

    def covariance(self) -> tuple[FloatArray, float]:
        """(3, 3) of the last pose, and the factor by which the variance of observations was raised for it.

        The asymptotic covariance of an M-estimator: curvature w^2 instead of the weights w of the steps, and
        mean squared influence over it, per building, less the freedom that the poses take.
        """
        observed = self._observed(self.weights**2)
        rest = self.information(np.zeros_like(self.weights))
        weights2 = self._means(self.weights) ** 2
        taken = float(np.trace(np.linalg.solve(observed + rest, observed)))
        told = self._means(np.trace(self._certainty, axis1=1, axis2=2))
        curvature = float(np.sum(weights2 * told))
        influence = float(np.sum(weights2 * self._unlikely())) / self._growth**2
        inflation = max(1.0 / self._growth**2, influence / max(curvature - taken, 0.2 * curvature))
        covariance = np.linalg.inv(observed / inflation + rest)[-5:-2, -5:-2]
        return np.asarray(covariance, dtype=np.float64), inflation


def _turned(points_m: FloatArray, yaws_rad: FloatArray) -> FloatArray:
    """Points (N, 2), each turned by its own angle (N,)."""
    c, s = np.cos(yaws_rad), np.sin(yaws_rad)
    x, y = points_m.T
    return np.column_stack([c * x - s * y, s * x + c * y])
