"""From pixels to metres on the ground: tilt, ground sampling distance, outlines.

The level camera frame has its origin below the camera, x to image right, y to image up, in metres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon

from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import ByteArray, CameraModel, FloatArray, Frame, FrameObservation
from buildloc_msgs_py.wire import WireError

Quaternion = tuple[float, float, float, float]
OUTLINE_POINTS = 24
UNDISTORT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-10)  # ends well below a pixel


def rotation_matrix(attitude_xyzw: Quaternion) -> FloatArray:
    """(3, 3) rotation of a unit quaternion (x, y, z, w)."""
    x, y, z, w = attitude_xyzw
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def heading_rad(attitude_xyzw: Quaternion) -> float:
    """In-plane rotation of the camera about the vertical, radians, clockwise seen from above."""
    x_axis = rotation_matrix(attitude_xyzw)[:, 0]
    return math.atan2(x_axis[1], x_axis[0])


def level_matrix(attitude_xyzw: Quaternion) -> FloatArray:
    """(3, 3) rotation that takes camera axes to level axes by tilt alone: the heading is removed.

    Raises BuildlocError when the camera does not look down (tilt above 60 degrees).
    """
    down = rotation_matrix(attitude_xyzw)[2, :]  # the vertical, seen from the camera
    if down[2] < 0.5:
        raise BuildlocError(
            "the camera looks more than 60 degrees away from the ground; point the gimbal down"
        )
    axis = np.cross(down, [0.0, 0.0, 1.0])
    skew = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.asarray(np.eye(3) + skew + skew @ skew / (1.0 + down[2]), dtype=np.float64)


def camera_matrix(camera: CameraModel) -> FloatArray:
    """(3, 3) intrinsic matrix."""
    return np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])


def resized(camera: CameraModel, zoom: float) -> CameraModel:
    """The camera of an image that was shrunk or enlarged by ``zoom``, to whole pixels."""
    width, height = round(camera.width * zoom), round(camera.height * zoom)
    zoom_u, zoom_v = width / camera.width, height / camera.height
    # Pixel centres are whole numbers, so shrinking maps u to (u + 0.5) zoom - 0.5.
    return replace(
        camera, width=width, height=height, fx=camera.fx * zoom_u, fy=camera.fy * zoom_v,
        cx=(camera.cx + 0.5) * zoom_u - 0.5, cy=(camera.cy + 0.5) * zoom_v - 0.5,
    )  # fmt: skip


def _rays(uv: FloatArray, camera: CameraModel) -> FloatArray:
    """(N, 2) pixels of the image as taken -> (N, 3) rays (x, y, 1) in camera axes, distortion removed."""
    if not any(camera.distortion) or len(uv) == 0:
        xy = (uv - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    else:
        undistort = (
            cv2.fisheye.undistortPoints if camera.distortion_model == "equidistant" else cv2.undistortPoints
        )
        points, coefficients = uv.reshape(-1, 1, 2).astype(np.float64), np.array(camera.distortion)
        undistorted = undistort(
            points, camera_matrix(camera), coefficients, R=np.eye(3), P=np.eye(3), criteria=UNDISTORT
        )
        xy = np.asarray(undistorted, dtype=np.float64).reshape(-1, 2)
    return np.column_stack([xy, np.ones(len(uv))])


def pixels_to_level(
    uv: FloatArray, camera: CameraModel, altitude_m: float, attitude_xyzw: Quaternion
) -> FloatArray:
    """(N, 2) pixels of the image as taken -> (N, 2) metres in the level camera frame."""
    level = _rays(uv, camera) @ level_matrix(attitude_xyzw).T
    ground = level[:, :2] / level[:, 2:] * altitude_m
    return np.asarray(ground * [1.0, -1.0], dtype=np.float64)


def resample(
    image: ByteArray,
    camera: CameraModel,
    pixel_to_ray: FloatArray,
    size: tuple[int, int],
    interpolation: int = cv2.INTER_LINEAR,
) -> ByteArray:
    """What the camera saw along the rays of another image, ``size`` (width, height); zero outside.

    ``pixel_to_ray`` (3, 3) takes an output pixel (u, v, 1) to a ray in camera axes, of any length.
    """
    k = camera_matrix(camera)
    if not any(camera.distortion):
        flags = interpolation | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpPerspective(image, k @ pixel_to_ray, size, flags=flags), dtype=np.uint8)
    maps = (
        cv2.fisheye.initUndistortRectifyMap
        if camera.distortion_model == "equidistant"
        else cv2.initUndistortRectifyMap
    )
    # OpenCV asks for the matrix that takes rays to output pixels, and inverts it.
    to_pixel, coefficients = np.linalg.inv(pixel_to_ray), np.array(camera.distortion)
    u, v = maps(k, coefficients, np.eye(3), to_pixel, size, cv2.CV_32FC1)
    return np.asarray(cv2.remap(image, u, v, interpolation), dtype=np.uint8)


def level_to_ray(altitude_m: float, attitude_xyzw: Quaternion) -> FloatArray:
    """(3, 3) from (x, y, 1), metres in the level camera frame, to a ray in camera axes."""
    return np.asarray(level_matrix(attitude_xyzw).T @ np.diag([1.0, -1.0, altitude_m]), dtype=np.float64)


def rectify(
    image: ByteArray, camera: CameraModel, attitude_xyzw: Quaternion, interpolation: int = cv2.INTER_LINEAR
) -> ByteArray:
    """The image as a pinhole camera of the same intrinsics would have taken it looking straight down."""
    pixel_to_ray = level_matrix(attitude_xyzw).T @ np.linalg.inv(camera_matrix(camera))
    return resample(image, camera, pixel_to_ray, (camera.width, camera.height), interpolation)


def border(camera: CameraModel) -> FloatArray:
    """(N, 2) pixels along the image's outer edge, closely enough that a distorted edge keeps its bend."""
    steps = np.linspace(0.0, 1.0, 17 if any(camera.distortion) else 2)[:-1]
    w, h = float(camera.width), float(camera.height)
    none, all_ = np.zeros_like(steps), np.ones_like(steps)
    sides = [(steps, none), (all_, steps), (1.0 - steps, all_), (none, 1.0 - steps)]
    return np.vstack([np.column_stack([u * w, v * h]) for u, v in sides]) - 0.5


def validate_frame(frame: Frame) -> None:
    """Raise WireError for an altitude that is no height or an image of another size than camera_info's."""
    if not (math.isfinite(frame.altitude_m) and frame.altitude_m > 0.0):
        raise WireError(f"altitude {frame.altitude_m} m is not a positive number; check the altitude source")
    height, width = frame.image_bgr.shape[:2]
    if (width, height) != (frame.camera.width, frame.camera.height):
        raise WireError(
            f"image is {width}x{height} but camera_info says {frame.camera.width}x{frame.camera.height}; "
            "publish the calibration of this resolution"
        )


def traced(
    contours: Sequence[NDArray[np.int32]], gsd_m: float, origin_uv: tuple[float, float]
) -> NDArray[np.object_]:
    """(N,) outlines in metres, y up, of N contours of pixels as OpenCV finds them, the origin at a pixel
    (u, v); None for a contour that encloses no valid polygon."""
    enough = np.array([len(contour) >= 3 for contour in contours], dtype=bool)
    found = np.full(len(contours), None, dtype=object)
    if not enough.any():
        return found
    rings = [contour.reshape(-1, 2) for contour, one in zip(contours, enough, strict=True) if one]
    xy = (np.concatenate(rings).astype(np.float64) - origin_uv) * [gsd_m, -gsd_m]
    index = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings])
    polygons = shapely.polygons(shapely.linearrings(xy, indices=index))
    # Contours run through pixel centres; half a pixel outwards gives the pixels' own outline.
    polygons = shapely.buffer(polygons, 0.5 * gsd_m, join_style="mitre")
    usable = (shapely.get_type_id(polygons) == shapely.GeometryType.POLYGON) & shapely.is_valid(polygons)
    found[enough] = np.where(usable, polygons, None)
    return found


def outlines(mask_pixels: ByteArray, gsd_m: float, min_area_m2: float) -> list[Polygon]:
    """Connected components of a mask as polygons in metres, y up, origin at the image centre."""
    height, width = mask_pixels.shape
    contours, _ = cv2.findContours(mask_pixels, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    found = traced(
        [np.asarray(c, dtype=np.int32) for c in contours], gsd_m, ((width - 1) / 2, (height - 1) / 2)
    )
    return [polygon for polygon in found if polygon is not None and polygon.area >= min_area_m2]


def observe(
    mask_pixels: ByteArray,
    stamp_ns: int,
    camera: CameraModel,
    altitude_m: float,
    attitude_xyzw: Quaternion,
    min_area_m2: float,
) -> FrameObservation:
    """Centroids and outlines of the buildings of one frame that do not touch the image's border."""
    height, width = mask_pixels.shape
    gsd = altitude_m / camera.fx
    _, labels, stats, centroids = cv2.connectedComponentsWithStats(mask_pixels, connectivity=8)
    x, y, w, h, area = stats[1:].T
    inside = (x > 0) & (y > 0) & (x + w < width) & (y + h < height) & (area * gsd * gsd >= min_area_m2)
    rings = _rings(mask_pixels, np.asarray(labels, dtype=np.int32))[1:][inside]
    uv = np.concatenate([centroids[1:][inside], rings.reshape(-1, 2)])
    level = pixels_to_level(uv, camera, altitude_m, attitude_xyzw)
    around = level[len(rings) :].reshape(rings.shape)
    return FrameObservation(stamp_ns, level[: len(rings)], altitude_m, around)


def _rings(mask_pixels: ByteArray, labels: NDArray[np.int32]) -> FloatArray:
    """(labels, OUTLINE_POINTS, 2) pixels along the outer border of every component, counter-clockwise when v
    points up. They lie half a pixel inside, all around."""
    contours, tree = cv2.findContours(mask_pixels, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    rings = np.zeros((int(labels.max()) + 1, OUTLINE_POINTS, 2))
    for contour, (_, _, _, parent) in zip(contours, tree[0] if contours else (), strict=True):
        if parent < 0:  # not the border of a courtyard
            u, v = contour[0, 0]
            rings[labels[v, u]] = contour[np.arange(OUTLINE_POINTS) * len(contour) // OUTLINE_POINTS, 0]
    return rings
