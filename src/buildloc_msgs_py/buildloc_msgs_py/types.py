"""Frozen dataclasses for what travels between the stages. Metres, seconds, radians; stamps in ns."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
ByteArray = NDArray[np.uint8]

# Lens models of CameraInfo, each with the numbers of coefficients that it may have.
DISTORTION_MODELS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}


@dataclass(frozen=True)
class CameraModel:
    """Intrinsics in pixels. ``distortion`` is empty when the images are rectified; its coefficients are
    those of ``distortion_model``, a key of :data:`DISTORTION_MODELS`, in the order of CameraInfo's d."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    distortion_model: str = "plumb_bob"


@dataclass(frozen=True)
class Frame:
    """One camera image with the telemetry that belongs to it.

    ``image_bgr`` is (H, W, 3) uint8. ``altitude_m`` is the height above ground. ``attitude_xyzw``
    rotates camera axes (x right, y down, z forward) into a level frame (x, y horizontal, z down)
    whose heading is arbitrary; the identity is a camera that looks straight down.
    """

    stamp_ns: int
    frame_id: str
    image_bgr: ByteArray
    camera: CameraModel
    altitude_m: float
    attitude_xyzw: tuple[float, float, float, float]


@dataclass(frozen=True)
class Mask:
    """Building mask of a keyframe, (H, W) uint8, 0 or 255, with the image's stamp and frame_id."""

    stamp_ns: int
    frame_id: str
    pixels: ByteArray


@dataclass(frozen=True)
class Keyframe:
    """Optimised pose of a keyframe in ``buildloc_map``: position of the image centre, yaw, scale.

    ``yaw_rad`` turns image-right into the map's x axis, counter-clockwise positive. ``scale`` is the
    cumulative scale of the pose graph: 1 where altitude alone explains the ground sampling distance.
    """

    stamp_ns: int
    x_m: float
    y_m: float
    yaw_rad: float
    scale: float = 1.0


@dataclass(frozen=True)
class Tracked:
    """Where a frame is in a keyframe: below the camera, in the level camera frame of the keyframe.

    Metres are those of the keyframe's altimeter; its scale in the map is not in them, ``height_m`` above
    ground included. ``covariance`` (4, 4) is that of the registration alone, over x, y, yaw and the
    logarithm of the height.
    """

    stamp_ns: int
    keyframe_ns: int
    x_m: float
    y_m: float
    yaw_rad: float
    height_m: float
    covariance: FloatArray


@dataclass(frozen=True)
class LocalMap:
    """Buildings seen so far in ``buildloc_map`` (metric, y up, arbitrary origin and heading).

    ``ids`` (N,) stay with their buildings over a flight; ``centroids_m`` (N, 2); ``areas_m2`` (N,);
    ``shapes`` (N, 4) in the order of :data:`buildloc_msgs_py.footprint.SHAPE_METRICS`; ``observations`` (N,)
    times observed. ``covariances_m2`` (N, 2, 2) are those of the centroids, NaN where they are not known.
    ``cut`` (N,) is true for buildings that reach the border of the seen area: there may be more of them.
    """

    stamp_ns: int
    ids: NDArray[np.int64]
    centroids_m: FloatArray
    areas_m2: FloatArray
    shapes: FloatArray
    observations: NDArray[np.int64]
    covariances_m2: FloatArray
    cut: NDArray[np.bool_]

    @classmethod
    def whole(
        cls,
        stamp_ns: int,
        ids: NDArray[np.int64],
        centroids_m: FloatArray,
        areas_m2: FloatArray,
        shapes: FloatArray,
        observations: NDArray[np.int64],
    ) -> LocalMap:
        """Buildings of which none is cut, with unknown covariances."""
        unknown, cut = np.full((len(ids), 2, 2), np.nan), np.zeros(len(ids), dtype=bool)
        return cls(stamp_ns, ids, centroids_m, areas_m2, shapes, observations, unknown, cut)

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> LocalMap:
        """The buildings at these rows."""
        return LocalMap(
            self.stamp_ns, self.ids[rows], self.centroids_m[rows], self.areas_m2[rows], self.shapes[rows],
            self.observations[rows], self.covariances_m2[rows], self.cut[rows],
        )  # fmt: skip


@dataclass(frozen=True)
class FrameObservation:
    """Building centroids of one frame, (N, 2) metres in the level camera frame (x image right, y up,
    origin below the camera); ``outlines_m`` (N, P, 2), if known, are P points evenly along each outline,
    counter-clockwise."""

    stamp_ns: int
    centroids_m: FloatArray
    altitude_m: float
    outlines_m: FloatArray | None = None


@dataclass(frozen=True)
class Candidate:
    """A ranked hypothesis: where the query-map centre lies in the world (ENU metres of the database
    CRS), the rotation and scale of the similarity map -> world, and its evidence."""

    x_m: float
    y_m: float
    yaw_rad: float
    scale: float
    votes: float
    mnn_jaccard: float
    acceptance: float


@dataclass(frozen=True)
class Fix:
    """An accepted position of the camera at ``stamp_ns`` (the image's capture time).

    ``covariance_enu_m2`` is (3, 3) east, north, up. ``yaw_rad`` is the ENU heading of image-right, and
    ``yaw_variance_rad2`` its variance, NaN where it is not known.
    """

    stamp_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    easting_m: float
    northing_m: float
    yaw_rad: float
    covariance_enu_m2: FloatArray
    yaw_variance_rad2: float = math.nan


@dataclass(frozen=True)
class NoFix:
    """No position, and why."""

    stamp_ns: int
    reason: str
