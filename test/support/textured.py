"""A textured plane with known buildings, photographed from known poses."""

from __future__ import annotations

import math

import cv2
import numpy as np
from buildloc_msgs_py.ground import camera_matrix, level_matrix
from buildloc_msgs_py.types import ByteArray, CameraModel, Frame, Mask

GSD = 0.2
SIDE = 1200  # world of 240 m, origin at its centre, y up
CAMERA = CameraModel(480, 360, 400.0, 400.0, 239.5, 179.5)
LEVEL = (0.0, 0.0, 0.0, 1.0)
BUILDINGS = [
    (-40.0, -10.0, 14.0, 9.0),
    (-5.0, 12.0, 10.0, 10.0),
    (30.0, -8.0, 18.0, 8.0),
    (55.0, 20.0, 9.0, 12.0),
]


def world() -> tuple[ByteArray, ByteArray]:
    """Image (SIDE, SIDE, 3) and building mask of the plane."""
    rng = np.random.default_rng(3)
    noise = sum(
        cv2.resize(rng.normal(size=(SIDE // k, SIDE // k)), (SIDE, SIDE), interpolation=cv2.INTER_CUBIC) * w
        for k, w in ((4, 18.0), (12, 22.0), (40, 18.0))
    )
    grey = np.clip(110 + noise, 0, 255).astype(np.uint8)
    mask = np.zeros((SIDE, SIDE), dtype=np.uint8)
    for x, y, w, h in BUILDINGS:
        c0, r0 = (round(v / GSD) for v in (x - w / 2 + SIDE * GSD / 2, SIDE * GSD / 2 - y - h / 2))
        mask[r0 : r0 + int(h / GSD), c0 : c0 + int(w / GSD)] = 255
    grey[mask > 0] = np.clip(grey[mask > 0].astype(int) + 60, 0, 255)
    return np.repeat(grey[:, :, None], 3, axis=2), mask


WORLD, WORLD_MASK = world()


def tilt(roll_rad: float, pitch_rad: float) -> tuple[float, float, float, float]:
    qx, qy = math.sin(roll_rad / 2), math.sin(pitch_rad / 2)
    return qx, qy, 0.0, math.sqrt(1 - qx * qx - qy * qy)


def shoot(
    stamp: int,
    x: float,
    y: float,
    yaw: float,
    altitude: float = 60.0,
    attitude=LEVEL,
    camera: CameraModel = CAMERA,
) -> tuple[Frame, Mask]:
    """Frame and mask of a camera at (x, y) whose image-right points to ``yaw``."""
    c, s = math.cos(yaw), math.sin(yaw)
    to_world = np.array([[c, -s, x], [s, c, y], [0, 0, 1.0]])
    to_pixel = np.array([[1 / GSD, 0, SIDE / 2 - 0.5], [0, -1 / GSD, SIDE / 2 - 0.5], [0, 0, 1.0]])
    ray = camera_matrix(camera) @ level_matrix(attitude).T @ np.diag([1.0, -1.0, altitude])
    homography = to_pixel @ to_world @ np.linalg.inv(ray)
    size, flags = (camera.width, camera.height), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    image = cv2.warpPerspective(WORLD, homography, size, flags=flags)
    pixels = (cv2.warpPerspective(WORLD_MASK, homography, size, flags=flags) > 127).astype(np.uint8) * 255
    return Frame(stamp, "camera", image, camera, altitude, attitude), Mask(stamp, "camera", pixels)
