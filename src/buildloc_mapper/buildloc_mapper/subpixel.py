"""Refines a rough registration below the pixel: corners tracked between the images it overlays."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from buildloc_msgs_py.types import ByteArray, FloatArray
from numpy.typing import NDArray

from buildloc_mapper.level import LevelImage
from buildloc_mapper.similarity import Similarity

CORNERS = 1200
CORNER_QUALITY = 0.005  # of the strongest corner
CORNER_DISTANCE_PX = 20  # spread over the ground: trees have the strongest corners
WINDOW_PX = 21
LEVELS = 2  # pyramid: finds what the rough registration is off by, some 15 px
CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01)
THERE_AND_BACK_PX = 0.3


def corners(level: LevelImage) -> FloatArray:
    """(N, 2) pixels that can be tracked in any direction."""
    found = cv2.goodFeaturesToTrack(level.grey, CORNERS, CORNER_QUALITY, CORNER_DISTANCE_PX)
    uv = np.empty((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64)
    return uv[level.sees(uv)]


def track(
    earlier: LevelImage, corners_uv: FloatArray, later: LevelImage, rough: Similarity
) -> tuple[FloatArray, FloatArray]:
    """Corners of the earlier image found again in the later one: (N, 2) and (N, 2), metres of each.

    The later image is laid over the earlier one by ``rough`` first, so that turn, scale and exposure are
    alike and Lucas-Kanade has a shift alone to find.
    """
    to_earlier = np.linalg.inv(earlier.metres_matrix()) @ rough.matrix() @ later.metres_matrix()
    to_later = np.asarray(np.linalg.inv(to_earlier), dtype=np.float64)
    size = (earlier.grey.shape[1], earlier.grey.shape[0])
    overlaid = cv2.warpAffine(later.grey, to_earlier[:2], size, borderMode=cv2.BORDER_REPLICATE)
    start = corners_uv[later.sees(_move(corners_uv, to_later))]
    if not len(start):
        return np.empty((0, 2)), np.empty((0, 2))
    alike = _exposed_like(np.asarray(overlaid, dtype=np.uint8), earlier.grey, start)
    points = start.astype(np.float32).reshape(-1, 1, 2)
    there, found = _lucas_kanade(earlier.grey, alike, points)
    back, found_back = _lucas_kanade(alike, earlier.grey, there)
    kept = found & found_back & (np.linalg.norm((back - points)[:, 0], axis=1) < THERE_AND_BACK_PX)
    return earlier.to_metres(start[kept]), later.to_metres(_move(there[kept, 0], to_later))


def _lucas_kanade(
    one: ByteArray, other: ByteArray, points: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Where points (N, 1, 2) of one image are in the other, and which of them were found."""
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        one, other, points, points.copy(), winSize=(WINDOW_PX, WINDOW_PX), maxLevel=LEVELS, criteria=CRITERIA
    )
    return np.asarray(moved, dtype=np.float32), np.asarray(found).ravel() > 0


def _move(uv: NDArray[Any], matrix: FloatArray) -> FloatArray:
    return np.asarray(uv @ matrix[:2, :2].T + matrix[:2, 2], dtype=np.float64)


def _exposed_like(image: ByteArray, model: ByteArray, uv: FloatArray) -> ByteArray:
    """The image with mean and contrast of the model, measured where (N, 2) pixels spread."""
    (left, top), (right, bottom) = uv.min(axis=0).astype(int), uv.max(axis=0).astype(int) + 1
    window = np.s_[top:bottom, left:right]
    (mean, spread), (wanted, wanted_spread) = (
        (float(part.mean()), float(part.std())) for part in (image[window], model[window])
    )
    gain = min(max(wanted_spread / max(spread, 1.0), 0.25), 4.0)
    return np.asarray(cv2.convertScaleAbs(image, alpha=gain, beta=wanted - gain * mean), dtype=np.uint8)
