"""A frame as a grey image of level, metric ground: tilt, distortion and height are taken out first."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from buildloc_msgs_py.ground import border, heading_rad, level_to_ray, pixels_to_level, resample, resized
from buildloc_msgs_py.types import ByteArray, FloatArray, Frame
from numpy.typing import NDArray

REACH = 1.5  # sides of the level image over those of the camera's, at most: a tilted image is longer
CELL_PX = 8
MARGIN_PX = 12  # descriptors look this far around a point; the seam of the image must not be in it


@dataclass(frozen=True)
class LevelImage:
    """Grey ground, (H, W) uint8, in the level camera frame; pixel (0, 0) lies at ``left_m``, ``top_m``.

    ``covered`` (H/8, W/8) says which cells the camera saw. ``heading_rad`` is the gimbal's.
    """

    grey: ByteArray
    covered: NDArray[np.bool_]
    gsd_m: float
    left_m: float
    top_m: float
    altitude_m: float
    heading_rad: float

    def to_metres(self, uv: FloatArray) -> FloatArray:
        """(N, 2) pixels -> (N, 2) metres in the level camera frame."""
        return np.asarray(uv * [self.gsd_m, -self.gsd_m] + [self.left_m, self.top_m], dtype=np.float64)

    def metres_matrix(self) -> FloatArray:
        """(3, 3) of :meth:`to_metres`, homogeneous."""
        return np.array([[self.gsd_m, 0, self.left_m], [0, -self.gsd_m, self.top_m], [0, 0, 1.0]])

    def sees(self, uv: FloatArray) -> NDArray[np.bool_]:
        """(N,) whether the camera saw these pixels (N, 2), with some margin."""
        column, row = np.round(uv).astype(int).T // CELL_PX
        rows, columns = self.covered.shape
        inside = (row >= 0) & (column >= 0) & (row < rows) & (column < columns)
        seen = np.zeros(len(uv), dtype=bool)
        seen[inside] = self.covered[row[inside], column[inside]]
        return seen


def level_image(frame: Frame, width_px: int) -> LevelImage:
    """The frame's ground at the camera's own ground sampling distance, or ``width_px`` columns of it."""
    grey, camera = cv2.cvtColor(frame.image_bgr, cv2.COLOR_BGR2GRAY), frame.camera
    if width_px < camera.width:
        camera = resized(camera, width_px / camera.width)
        grey = cv2.resize(grey, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    gsd = frame.altitude_m / camera.fx
    edge = pixels_to_level(border(camera), camera, frame.altitude_m, frame.attitude_xyzw)
    centre = np.array([[(camera.width - 1) / 2.0, (camera.height - 1) / 2.0]])
    middle = pixels_to_level(centre, camera, frame.altitude_m, frame.attitude_xyzw)[0]
    reach = REACH / 2.0 * max(camera.width, camera.height) * gsd
    low, high = np.maximum(edge.min(axis=0), middle - reach), np.minimum(edge.max(axis=0), middle + reach)
    columns, rows = (max(1, math.floor(side / gsd)) for side in high - low)
    left, top = float(low[0] + 0.5 * gsd), float(high[1] - 0.5 * gsd)
    pixel_to_level = np.array([[gsd, 0.0, left], [0.0, -gsd, top], [0.0, 0.0, 1.0]])
    to_ray = level_to_ray(frame.altitude_m, frame.attitude_xyzw) @ pixel_to_level
    ground = resample(np.asarray(grey, dtype=np.uint8), camera, to_ray, (columns, rows))
    whole = np.full(grey.shape, 255, dtype=np.uint8)
    seen = resample(whole, camera, to_ray, (columns, rows), cv2.INTER_NEAREST)
    reach_px = 2 * MARGIN_PX + 1
    inner = cv2.erode(
        seen, np.ones((reach_px, reach_px), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0
    )
    covered = inner[CELL_PX // 2 :: CELL_PX, CELL_PX // 2 :: CELL_PX] > 0
    heading = heading_rad(frame.attitude_xyzw)
    return LevelImage(ground, covered, gsd, left, top, frame.altitude_m, heading)
