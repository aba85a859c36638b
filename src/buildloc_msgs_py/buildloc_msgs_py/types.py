"""Frozen dataclasses for what travels between the stages. Metres, seconds, radians; stamps in ns."""

from __future__ import annotations

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
class LocalMap:
    """Buildings seen so far in ``buildloc_map`` (metric, y up, arbitrary origin and heading).

    ``centroids_m`` (N, 2); ``areas_m2`` (N,); ``shapes`` (N, 4) in the order of
    :data:`buildloc_msgs_py.footprint.SHAPE_METRICS`; ``observations`` (N,) times observed.
    """

    stamp_ns: int
    ids: NDArray[np.int64]
    centroids_m: FloatArray
    areas_m2: FloatArray
    shapes: FloatArray
    observations: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True)
class FrameObservation:
    """Building centroids of one frame, (N, 2) metres in the level camera frame (x image right, y up,
    origin below the camera)."""

    stamp_ns: int
    centroids_m: FloatArray
    altitude_m: float


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

    ``covariance_enu_m2`` is (3, 3) east, north, up. ``yaw_rad`` is the ENU heading of image-right.
    """

    stamp_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    easting_m: float
    northing_m: float
    yaw_rad: float
    covariance_enu_m2: FloatArray


@dataclass(frozen=True)
class NoFix:
    """No position, and why."""

    stamp_ns: int
    reason: str
