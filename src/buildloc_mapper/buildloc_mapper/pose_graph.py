"""Pose graph over [x, y, theta, log s] per keyframe (paper, map stitching). The only module with gtsam."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from buildloc_msgs_py.types import FloatArray

from buildloc_mapper.config import MapperConfig
from buildloc_mapper.similarity import Similarity

FREE = 1e6  # metres or radians: a factor this wide says nothing
FIXED = 1e-6
RELINEARIZE = np.array([0.02, 0.02, 5e-4, 5e-4])  # metres, metres, radians, log scale: well below the sigmas
WILDFIRE = 1e-5  # the smallest step, in metres or radians, that is passed on through the graph
ROUNDS = 2  # of iSAM2 per keyframe
LOOP_ROUNDS = 6  # where a loop closure moves many


@dataclass(frozen=True)
class Edge:
    """Measured pose of keyframe ``later`` in keyframe ``earlier``, how many matches agree, and the (4, 4)
    covariance over x, y, yaw and log scale. Loop closures weigh more."""

    earlier: int
    later: int
    transform: Similarity
    inliers: int
    covariance: FloatArray
    loop: bool = False


@dataclass(frozen=True)
class Turn:
    """Yaw of keyframe ``later`` in keyframe ``earlier`` as the gimbal tells it, radians."""

    earlier: int
    later: int
    yaw_rad: float


def _pose(keyframe: int) -> int:
    return int(gtsam.symbol("x", keyframe))


def _drift(keyframe: int) -> int:
    """The altimeter's drift, of which the scale alone is free."""
    return int(gtsam.symbol("d", keyframe))


def _to_gtsam(pose: Similarity) -> gtsam.Similarity2:
    # gtsam scales after translating: p' = s (R p + t).
    translation = np.array([pose.x_m, pose.y_m]) / pose.scale
    return gtsam.Similarity2(gtsam.Rot2(pose.yaw_rad), translation, pose.scale)


def _from_gtsam(pose: gtsam.Similarity2) -> Similarity:
    scale = float(pose.scale())
    x, y = pose.translation()
    return Similarity(scale * float(x), scale * float(y), float(pose.rotation().theta()), scale)


def _sigmas(position_m: float, yaw_rad: float, log_scale: float) -> gtsam.noiseModel.Base:
    return gtsam.noiseModel.Diagonal.Sigmas(np.array([position_m, position_m, yaw_rad, log_scale]))


def _robust(noise: gtsam.noiseModel.Base, config: MapperConfig) -> gtsam.noiseModel.Base:
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(config.huber_k), noise)


def _edge_factor(edge: Edge, config: MapperConfig) -> gtsam.NonlinearFactor:
    # gtsam's error is a step from the measured pose in its own axes: the covariance is turned into them.
    c, s = math.cos(edge.transform.yaw_rad), math.sin(edge.transform.yaw_rad)
    turn = np.eye(4)
    turn[:2, :2] = np.array([[c, s], [-s, c]]) / edge.transform.scale
    turn /= config.loop_weight if edge.loop else 1.0
    noise = gtsam.noiseModel.Gaussian.Covariance(turn @ edge.covariance @ turn.T)
    return gtsam.BetweenFactorSimilarity2(
        _pose(edge.earlier), _pose(edge.later), _to_gtsam(edge.transform), _robust(noise, config)
    )


def _turn_factor(turn: Turn, config: MapperConfig) -> gtsam.NonlinearFactor:
    noise = _robust(_sigmas(FREE, math.radians(config.sigma_heading_deg), FREE), config)
    told = _to_gtsam(Similarity(0.0, 0.0, turn.yaw_rad, 1.0))
    return gtsam.BetweenFactorSimilarity2(_pose(turn.earlier), _pose(turn.later), told, noise)


def _altimeter_factors(
    keyframe: int, before: int | None, seconds: float, config: MapperConfig
) -> Iterable[gtsam.NonlinearFactor]:
    """The log scale of a keyframe is the altimeter's drift, a random walk, and noise.

    A constant bias is not in it: it scales the whole map, which no image can tell, and is added to the
    uncertainty of the scale instead. The drift is therefore counted from the first keyframe.
    """
    same = gtsam.Similarity2()
    noise = _robust(_sigmas(FREE, FREE, config.altitude_noise), config)
    yield gtsam.BetweenFactorSimilarity2(_drift(keyframe), _pose(keyframe), same, noise)
    if before is None:
        yield gtsam.PriorFactorSimilarity2(_drift(keyframe), same, _sigmas(FIXED, FIXED, FIXED))
        return
    walk = max(config.altitude_drift * math.sqrt(max(seconds, 0.0)), FIXED)
    yield gtsam.BetweenFactorSimilarity2(_drift(before), _drift(keyframe), same, _sigmas(FIXED, FIXED, walk))


def _anchor(keyframe: int) -> gtsam.NonlinearFactor:
    """Origin and heading of the map; its scale is the altimeter's."""
    return gtsam.PriorFactorSimilarity2(_pose(keyframe), gtsam.Similarity2(), _sigmas(FIXED, FIXED, FREE))


def _keyframe_factors(
    keyframe: int, before: int | None, stamps_ns: Mapping[int, int], config: MapperConfig
) -> Iterable[gtsam.NonlinearFactor]:
    if before is None:
        yield _anchor(keyframe)
    seconds = 0.0 if before is None else (stamps_ns[keyframe] - stamps_ns[before]) * 1e-9
    yield from _altimeter_factors(keyframe, before, seconds, config)


def _link_factors(
    edges: Iterable[Edge], turns: Iterable[Turn], config: MapperConfig
) -> Iterable[gtsam.NonlinearFactor]:
    yield from (_edge_factor(edge, config) for edge in edges)
    yield from (_turn_factor(turn, config) for turn in turns)


def _graph(factors: Iterable[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph


def _values(poses: Mapping[int, Similarity]) -> gtsam.Values:
    values = gtsam.Values()
    for keyframe, pose in poses.items():
        values.insert(_pose(keyframe), _to_gtsam(pose))
        values.insert(_drift(keyframe), gtsam.Similarity2())
    return values


class PoseGraph:
    """Keyframes of one connected map, in the frame of the first: iSAM2, so that a keyframe costs what it
    changes and not what was flown."""

    def __init__(self, config: MapperConfig) -> None:
        self._config = config
        self._stamps_ns: dict[int, int] = {}
        self._turns: list[Turn] = []
        self.edges: list[Edge] = []
        self.poses: dict[int, Similarity] = {}
        self._covariances: dict[int, FloatArray] = {}  # asked for since the last keyframe
        self._isam = gtsam.ISAM2(_parameters())

    def add(
        self,
        keyframe: int,
        stamp_ns: int,
        guess: Similarity,
        edges: Iterable[Edge],
        turns: Iterable[Turn] = (),
    ) -> None:
        """Add a keyframe later than all before, with its links to them; ``poses`` are optimised anew."""
        self._covariances.clear()
        before = next(reversed(self._stamps_ns), None)
        self._stamps_ns[keyframe] = stamp_ns
        factors = _keyframe_factors(keyframe, before, self._stamps_ns, self._config)
        self._update(factors, {keyframe: guess}, list(edges), list(turns))

    def link(self, edges: Iterable[Edge]) -> None:
        """Add links between keyframes that are here."""
        self._update([], {}, list(edges), [])

    def joined(self, younger: PoseGraph, transform: Similarity, edges: Iterable[Edge]) -> PoseGraph:
        """One graph of two and the links between them, ``transform`` being where the frame of the younger
        lies in this one's."""
        both = PoseGraph(self._config)
        both._stamps_ns = dict(sorted((self._stamps_ns | younger._stamps_ns).items()))
        guesses = self.poses | {k: transform.compose(pose) for k, pose in younger.poses.items()}
        every, turns = [*self.edges, *younger.edges, *edges], [*self._turns, *younger._turns]
        both._update(both._chain(), guesses, every, turns)
        return both

    def batch(self) -> dict[int, Similarity]:
        """Poses from all factors at once by Levenberg-Marquardt: what the incremental ones are held to."""
        graph = _graph([*self._chain(), *_link_factors(self.edges, self._turns, self._config)])
        params = gtsam.LevenbergMarquardtParams()
        params.setRelativeErrorTol(1e-12)
        params.setAbsoluteErrorTol(1e-12)
        params.setMaxIterations(300)  # Huber's weights settle slowly
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, _values(self.poses), params)
        return self._poses_of(optimizer.optimize())

    def covariance(self, keyframe: int) -> FloatArray:
        """(4, 4) of a keyframe's pose over x, y, yaw and log scale, as seen from the first keyframe; the
        altimeter's bias is not in it. It is computed once between two keyframes, when it is first
        asked for: links that come after make it smaller than it says."""
        if keyframe in self._covariances:
            return self._covariances[keyframe]
        pose = self.poses[keyframe]
        c, s = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
        turn = np.eye(4)
        turn[:2, :2] = np.array([[c, -s], [s, c]]) * pose.scale
        own_axes = self._isam.marginalCovariance(_pose(keyframe))
        self._covariances[keyframe] = np.asarray(turn @ own_axes @ turn.T, dtype=np.float64)
        return self._covariances[keyframe]

    def place_sigma_m(self, keyframe: int) -> float:
        """Standard deviation of a keyframe's place along the axis where it is largest."""
        return math.sqrt(float(np.linalg.eigvalsh(self.covariance(keyframe)[:2, :2])[-1]))

    def scale_sigma(self, keyframe: int) -> float:
        """Relative standard deviation of a keyframe's scale, the altimeter's bias included."""
        return math.hypot(math.sqrt(float(self.covariance(keyframe)[3, 3])), self._config.altitude_bias)

    def _chain(self) -> list[gtsam.NonlinearFactor]:
        """What every keyframe has without any link, in the order they were flown."""
        order = list(self._stamps_ns)
        return [
            factor
            for before, keyframe in zip([None, *order], order, strict=False)
            for factor in _keyframe_factors(keyframe, before, self._stamps_ns, self._config)
        ]

    def _update(
        self,
        factors: Iterable[gtsam.NonlinearFactor],
        guesses: Mapping[int, Similarity],
        edges: list[Edge],
        turns: list[Turn],
    ) -> None:
        graph = _graph([*factors, *_link_factors(edges, turns, self._config)])
        self._isam.update(graph, _values(guesses))
        for _ in range((LOOP_ROUNDS if any(edge.loop for edge in edges) else ROUNDS) - 1):
            self._isam.update()
        self.edges += edges
        self._turns += turns
        self.poses = self._poses_of(self._isam.calculateEstimate())

    def _poses_of(self, estimate: gtsam.Values) -> dict[int, Similarity]:
        return {k: _from_gtsam(estimate.atSimilarity2(_pose(k))) for k in self._stamps_ns}


def _parameters() -> gtsam.ISAM2Params:
    steps, thresholds = gtsam.ISAM2GaussNewtonParams(), gtsam.ISAM2ThresholdMap()
    steps.setWildfireThreshold(WILDFIRE)
    for variable in ("x", "d"):
        thresholds.insert((variable, RELINEARIZE))
    params = gtsam.ISAM2Params()
    params.setOptimizationParams(steps)
    params.setRelinearizeThreshold(thresholds)
    params.relinearizeSkip = 1
    return params
