"""Photographs a world: plane homography with tilt and heading, exposure, blur and noise."""

from __future__ import annotations

import math

import cv2
import numpy as np
from buildloc_msgs_py.ground import camera_matrix, level_to_ray, pixels_to_level
from buildloc_msgs_py.types import ByteArray, CameraModel, FloatArray

from buildloc_eval.flight import FlightConfig, focal_px
from buildloc_eval.world import Surface, WorldError

Quaternion = tuple[float, float, float, float]


def camera_model(config: FlightConfig) -> CameraModel:
    """Pinhole without distortion, principal point in the middle."""
    focal = focal_px(config)
    centre = ((config.width - 1) / 2.0, (config.height - 1) / 2.0)
    return CameraModel(config.width, config.height, focal, focal, *centre)


def attitude(roll_rad: float, pitch_rad: float, heading_rad: float) -> Quaternion:
    """Camera axes to level axes: tilt about a horizontal axis first, then heading about the vertical.

    ``heading_rad`` is positive clockwise seen from above, since the level z axis points down.
    """
    angle = math.hypot(roll_rad, pitch_rad)
    half = math.sin(angle / 2.0) / angle if angle > 0.0 else 0.5
    x, y, w = pitch_rad * half, roll_rad * half, math.cos(angle / 2.0)
    z_h, w_h = math.sin(heading_rad / 2.0), math.cos(heading_rad / 2.0)
    return w_h * x - z_h * y, w_h * y + z_h * x, z_h * w, w_h * w


def level_to_world(x_m: float, y_m: float, yaw_rad: float) -> FloatArray:
    """(3, 3) homogeneous transform of the level camera frame to UTM metres."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s, x_m], [s, c, y_m], [0.0, 0.0, 1.0]])


def world_to_rays(pose: tuple[float, float, float, float], attitude_xyzw: Quaternion) -> FloatArray:
    """(3, 3) from (x, y, 1), metres of the world, to a ray in camera axes; ``pose`` as in :func:`look`."""
    x, y, altitude, yaw = pose
    return np.asarray(
        level_to_ray(altitude, attitude_xyzw) @ np.linalg.inv(level_to_world(x, y, yaw)), dtype=np.float64
    )


def look(
    world: Surface, camera: CameraModel, pose: tuple[float, float, float, float], attitude_xyzw: Quaternion
) -> ByteArray:
    """The world as it is, (H, W) or (H, W, 3), from ``pose``: x, y, altitude in m, ENU yaw of image-right.

    Raises WorldError when the image would reach beyond the bounds of the world.
    """
    x, y, altitude, yaw = pose
    placed = level_to_world(x, y, yaw)
    wide, high = camera.width, camera.height
    corners_uv = np.array([[0, 0], [wide, 0], [wide, high], [0, high]]) - 0.5
    corners = pixels_to_level(corners_uv, camera, altitude, attitude_xyzw) @ placed[:2, :2].T + placed[:2, 2]
    (west, south), (east, north) = corners.min(axis=0), corners.max(axis=0)
    bounds = world.bounds_m
    if west < bounds[0] or south < bounds[1] or east > bounds[2] or north > bounds[3]:
        raise WorldError("the camera sees beyond the edge of the world; fly lower or choose a smaller region")
    window = world.window((float(west) - 1.0, float(south) - 1.0, float(east) + 1.0, float(north) + 1.0))
    gsd = window.gsd_m
    # Metres relative to the window keep the homography well conditioned.
    to_window = np.array(
        [
            [1 / gsd, 0, (x - window.left_m) / gsd - 0.5],
            [0, -1 / gsd, (window.top_m - y) / gsd - 0.5],
            [0, 0, 1.0],
        ]
    )
    rays = camera_matrix(camera) @ level_to_ray(altitude, attitude_xyzw)
    homography = to_window @ level_to_world(0.0, 0.0, yaw) @ np.linalg.inv(rays)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    seen = cv2.warpPerspective(window.image_bgr, homography, (camera.width, camera.height), flags=flags)
    return np.asarray(seen, dtype=np.uint8)


def photograph(
    world: Surface,
    camera: CameraModel,
    pose: tuple[float, float, float, float],
    attitude_xyzw: Quaternion,
    config: FlightConfig,
    rng: np.random.Generator,
) -> ByteArray:
    """What :func:`look` sees, (H, W, 3) BGR, with the blur, exposure and noise of a camera."""
    image = look(world, camera, pose, attitude_xyzw)
    sigma = rng.uniform(0.0, config.blur_px)
    if sigma > 0.1:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.uint8)
    gain = max(0.2, 1.0 + config.exposure * rng.normal())
    grainy = image.astype(np.float32) * np.float32(gain)
    grainy += rng.standard_normal(image.shape, dtype=np.float32) * np.float32(config.noise)
    return np.asarray(np.clip(grainy, 0, 255), dtype=np.uint8)
