"""Registers two keyframes: correspondences on level ground, a robust similarity, refined below the pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from buildloc_msgs_py.config import ConfigError
from buildloc_msgs_py.types import ByteArray, FloatArray, Frame
from numpy.typing import NDArray

from buildloc_mapper.appearance import LANDMARKS, signature
from buildloc_mapper.config import MapperConfig
from buildloc_mapper.level import LevelImage, level_image
from buildloc_mapper.matching import Matches, Method, Sift
from buildloc_mapper.similarity import Similarity, fit_similarity
from buildloc_mapper.subpixel import corners, track

METHODS = ("sift", "xfeat", "coarse_loftr", "loftr")
MIN_MATCHES = 3
RELIEF = 0.1  # standard deviation of the ground's slope, trees and roofs among it
MAJORITY = 0.5  # share of matches that must agree where tracking does not confirm them
JPEG_QUALITY = 90
FOLLOWED = 300  # corners that follow a motion which is known to some pixels
CELL_SPREAD = 1.0  # inlier distance of matched cells, in cells: both ends are right to half a cell


@dataclass(frozen=True)
class Prepared:
    """A frame as level ground, the corners (N, 2) px it can be refined by, and the method's features.

    ``signature`` (K, 32) are its most telling features, for :mod:`buildloc_mapper.appearance`.
    """

    level: LevelImage
    corners_uv: FloatArray
    features: Any
    signature: NDArray[np.float32]

    def packed(self) -> Packed:
        """The same in the memory that it may take for good."""
        quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        _, jpeg = cv2.imencode(".jpg", self.level.grey, quality)
        nothing = np.empty((0, 0), dtype=np.uint8)
        level = replace(self.level, grey=nothing)
        return Packed(np.asarray(jpeg, dtype=np.uint8), replace(self, level=level))


@dataclass(frozen=True)
class Guide:
    """A keyframe as frames are tracked against it: level ground, and corners (N, 2) px."""

    level: LevelImage
    corners_uv: FloatArray


@dataclass(frozen=True)
class Packed:
    """A prepared frame whose image is compressed."""

    jpeg: ByteArray
    rest: Prepared

    def unpacked(self) -> Prepared:
        """The prepared frame; its image has lost what JPEG loses, far below what moves a corner."""
        grey = np.asarray(cv2.imdecode(self.jpeg, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
        return replace(self.rest, level=replace(self.rest.level, grey=grey))


@dataclass(frozen=True)
class Link:
    """Relative pose of a keyframe in an earlier one, in metres, and how many matches agree with it.

    Images are already metric by their own altitudes, so the altitude ratio of the pair is divided out: the
    scale is 1 up to errors of altitude and terrain. ``covariance`` (4, 4) is that of the fit, over x, y,
    yaw, log scale; errors of telemetry are not in it (:func:`link_covariance`).
    """

    transform: Similarity
    inliers: int
    covariance: FloatArray


@dataclass(frozen=True)
class Rejection:
    """Why a pair was not linked: ``few_matches``, ``few_inliers``, ``scale`` or ``yaw``."""

    reason: str


def create_method(config: MapperConfig) -> Method:
    """The matching method that the config names. Raises BuildlocError: unknown, or weights that are none."""
    if config.registration not in METHODS:
        raise ConfigError(
            f"parameter registration = {config.registration!r} is unknown; choose {', '.join(METHODS)}"
        )
    if config.registration == "sift":
        return Sift(config.features, config.feature_width_px, config.match_ratio)
    # onnxruntime is loaded for the networks alone.
    if config.registration == "xfeat":
        from buildloc_mapper.xfeat import XFeat

        return XFeat(config.registration_model, config.features)
    if config.registration == "coarse_loftr":
        from buildloc_mapper.coarse_loftr import CoarseLoftr

        return CoarseLoftr(config.registration_model)
    from buildloc_mapper.loftr import Loftr

    return Loftr(config.registration_model)


class Registration:
    """Frames prepared once, pairs of them registered. Raises BuildlocError for a method it cannot have."""

    def __init__(self, config: MapperConfig) -> None:
        self._config = config
        self._method = create_method(config)
        self._landmarks = Sift(LANDMARKS, config.feature_width_px, config.match_ratio)

    def prepare(self, frame: Frame) -> Prepared:
        """Level ground and features of a frame."""
        level = level_image(frame, self._config.level_width_px)
        features = self._method.prepare(level.grey)
        described = features if isinstance(self._method, Sift) else self._landmarks.prepare(level.grey)
        return Prepared(level, corners(level), features, signature(described))

    def prepare_to_follow(self, frame: Frame) -> Guide:
        """Level ground and corners of a keyframe that others are to follow at camera rate."""
        level = level_image(frame, self._config.track_width_px)
        return Guide(level, corners(level))

    def register(
        self, earlier: Prepared, later: Prepared, turned_rad: float | None = None
    ) -> Link | Rejection:
        """The later keyframe's pose in the earlier one, or why the pair is rejected.

        ``turned_rad`` is the turn to try first by methods that know an up; None: the gimbal's.
        """
        try:
            return self._register(earlier, later, turned_rad)
        except cv2.error:  # keyframes that are linked already must not be lost for this pair
            return Rejection("opencv")

    def _register(self, earlier: Prepared, later: Prepared, turned_rad: float | None) -> Link | Rejection:
        if min(len(earlier.corners_uv), len(later.corners_uv)) < self._config.min_inliers:
            return Rejection("few_matches")
        turned = turn_told(earlier.level, later.level) if turned_rad is None else turned_rad
        answers: list[Rejection] = []
        for turn in sorted(self._method.turns, key=lambda turn: (turn - round(turned / (math.pi / 2))) % 4):
            answer = self._estimate(earlier, later, self._matches(earlier, later, turn))
            if isinstance(answer, Link):
                return answer
            answers.append(answer)
        return answers[0]

    def follow(self, earlier: Prepared | Guide, later: LevelImage, rough: Similarity) -> Link | Rejection:
        """The later image's pose in the earlier keyframe where it is known to some 15 pixels, by its corners
        alone: a fraction of the cost of :meth:`register`."""
        step = max(1, len(earlier.corners_uv) // FOLLOWED)
        try:
            followed = self._refine(earlier.level, earlier.corners_uv[::step], later, rough)
        except cv2.error:
            return Rejection("opencv")
        if followed is None:
            return Rejection("few_inliers")
        return self._fitted(*followed, rough, len(followed[0]), earlier.level, later)

    def _matches(self, earlier: Prepared, later: Prepared, turn: int) -> Matches:
        """Correspondences with the later image turned counter-clockwise by quarter turns."""
        if turn == 0:
            return self._method.match(earlier.features, later.features)
        image, offset = turn_image(later.level.grey, turn)
        found = self._method.match(earlier.features, self._method.prepare(image))
        back = turn_back(found.later_uv - offset, turn, later.level.grey.shape)
        return Matches(found.earlier_uv, back, found.cell_px)

    def _estimate(self, earlier: Prepared, later: Prepared, matches: Matches) -> Link | Rejection:
        config = self._config
        seen = earlier.level.sees(matches.earlier_uv) & later.level.sees(matches.later_uv)
        target = earlier.level.to_metres(matches.earlier_uv[seen])
        source = later.level.to_metres(matches.later_uv[seen])
        if len(source) < max(MIN_MATCHES, config.min_inliers):
            return Rejection("few_matches")
        cell_m = matches.cell_px * max(earlier.level.gsd_m, later.level.gsd_m)
        threshold_m = max(config.ransac_threshold_m, CELL_SPREAD * cell_m)
        rough, kept = robust_similarity(source, target, threshold_m)
        count = int(kept.sum())
        if count < config.min_inliers:
            return Rejection("few_inliers")
        if (wrong := self._implausible(rough, earlier.level, later.level)) is not None:
            return wrong
        fine = self._refine(earlier.level, earlier.corners_uv, later.level, rough)
        if fine is None and (matches.cell_px > 0.0 or count < MAJORITY * len(source)):
            return Rejection("few_inliers")  # too rough to be a measurement, or agreement by chance
        source, target = fine or (source[kept], target[kept])
        return self._fitted(source, target, rough, count, earlier.level, later.level)

    def _fitted(
        self,
        source: FloatArray,
        target: FloatArray,
        rough: Similarity,
        count: int,
        earlier: LevelImage,
        later: LevelImage,
    ) -> Link | Rejection:
        relief = RELIEF / earlier.altitude_m
        transform, covariance = fit_similarity(source, target, np.array(rough[:2]), relief)
        return self._implausible(transform, earlier, later) or Link(transform, count, covariance)

    def _refine(
        self, earlier: LevelImage, corners_uv: FloatArray, later: LevelImage, rough: Similarity
    ) -> tuple[FloatArray, FloatArray] | None:
        """Tracked corners (N, 2) of the later and the earlier image that lie on common ground; None when
        there are too few."""
        target, source = track(earlier, corners_uv, later, rough)
        if len(source) < self._config.min_inliers:
            return None
        threshold_m = self._config.refined_threshold_px * earlier.gsd_m
        _, kept = robust_similarity(source, target, threshold_m)
        return (source[kept], target[kept]) if kept.sum() >= self._config.min_inliers else None

    def _implausible(self, found: Similarity, earlier: LevelImage, later: LevelImage) -> Rejection | None:
        """A transform that telemetry contradicts. The scale is what the two altitudes do not explain."""
        if abs(found.scale - 1.0) > self._config.max_scale_deviation:
            return Rejection("scale")
        deviation = math.remainder(found.yaw_rad - turn_told(earlier, later), math.tau)
        if abs(deviation) > math.radians(self._config.max_yaw_deviation_deg):
            return Rejection("yaw")
        return None


def link_covariance(link: Link, config: MapperConfig) -> FloatArray:
    """(4, 4) over x, y, yaw, log scale: what the fit knows of its pixels, and what it does not know (relief,
    lens, attitude), which shrinks with the inliers."""
    unknown = np.square(
        [
            config.sigma_position_m, config.sigma_position_m,
            math.radians(config.sigma_rotation_deg), config.sigma_log_scale,
        ]
    )  # fmt: skip
    return np.asarray(link.covariance + np.diag(unknown) * config.min_inliers / link.inliers)


def robust_similarity(
    source_m: FloatArray, target_m: FloatArray, threshold_m: float
) -> tuple[Similarity, NDArray[np.bool_]]:
    """RANSAC similarity from ``source_m`` to ``target_m``, both (N, 2), and its (N,) inliers: none when
    there is no similarity.

    Plain RANSAC: OpenCV has MAGSAC for affine maps but not for similarities, and the two degrees more
    follow the crowns of trees instead of the ground.
    """
    affine, inliers = cv2.estimateAffinePartial2D(
        source_m, target_m, method=cv2.RANSAC, ransacReprojThreshold=threshold_m,
        maxIters=5000, confidence=0.999, refineIters=20,
    )  # fmt: skip
    if affine is None:
        return Similarity(0.0, 0.0, 0.0, 1.0), np.zeros(len(source_m), dtype=bool)
    yaw, scale = math.atan2(affine[1, 0], affine[0, 0]), math.hypot(affine[0, 0], affine[1, 0])
    return Similarity(float(affine[0, 2]), float(affine[1, 2]), yaw, scale), inliers.ravel() > 0


def turn_told(earlier: LevelImage, later: LevelImage) -> float:
    """Yaw of the later camera in the earlier one by the gimbal, radians, counter-clockwise."""
    return earlier.heading_rad - later.heading_rad


def turn_image(image: ByteArray, turn: int) -> tuple[ByteArray, tuple[int, int]]:
    """The image turned counter-clockwise by quarter turns, cut and filled to the shape that it had, so that
    networks see both images of a pair at one scale; and where (u, v) the turned image's first pixel lies."""
    turned, (height, width) = np.rot90(image, turn), image.shape
    left, top = (width - turned.shape[1]) // 2, (height - turned.shape[0]) // 2
    canvas = np.full((height, width), round(float(image.mean())), dtype=np.uint8)
    inner = turned[max(0, -top) : height - top, max(0, -left) : width - left]
    row, column = max(0, top), max(0, left)
    canvas[row : row + inner.shape[0], column : column + inner.shape[1]] = inner
    return canvas, (left, top)


def turn_back(uv: FloatArray, turn: int, shape: tuple[int, ...]) -> FloatArray:
    """Pixels (N, 2) of ``np.rot90(image, turn)`` -> pixels of the image of this shape."""
    (u, v), right, bottom = uv.T, shape[1] - 1, shape[0] - 1
    back = {0: (u, v), 1: (right - v, u), 2: (right - u, bottom - v), 3: (v, bottom - u)}
    return np.column_stack(back[turn % 4])
