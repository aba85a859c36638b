"""Planar similarity transforms. Angles in radians, points (N, 2) in metres."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from buildloc_msgs_py.types import FloatArray

CELLS = 6  # across the radius of an area


def rotation(yaw_rad: float) -> FloatArray:
    """(2, 2) counter-clockwise rotation."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s], [s, c]])


def wrap(angle_rad: FloatArray | float) -> FloatArray:
    """Wrap to [-pi, pi)."""
    return np.asarray((np.asarray(angle_rad) + math.pi) % (2.0 * math.pi) - math.pi, dtype=np.float64)


@dataclass(frozen=True)
class Similarity:
    """p_world = anchor_world + scale * R(yaw) @ (p - anchor): all anchors in metres."""

    anchor_m: tuple[float, float]
    world_m: tuple[float, float]
    yaw_rad: float
    scale: float = 1.0

    def apply(self, points_m: FloatArray) -> FloatArray:
        """(N, 2) -> (N, 2)."""
        turned = (np.asarray(points_m, dtype=np.float64) - self.anchor_m) @ rotation(self.yaw_rad).T
        return np.asarray(self.world_m + self.scale * turned, dtype=np.float64)


def fit_rigid(source_m: FloatArray, target_m: FloatArray, weights: FloatArray | None = None) -> Similarity:
    """Rotation and translation minimising sum w |target - (R source + t)|^2, by SVD (Arun et al. 1987)."""
    w = np.ones(len(source_m)) if weights is None else weights
    centre_s, centre_t = w @ source_m / w.sum(), w @ target_m / w.sum()
    u, _, vt = np.linalg.svd((source_m - centre_s).T @ ((target_m - centre_t) * w[:, None]))
    turn = vt.T @ np.diag([1.0, np.sign(np.linalg.det(vt.T @ u.T)) or 1.0]) @ u.T
    return Similarity(
        (float(centre_s[0]), float(centre_s[1])),
        (float(centre_t[0]), float(centre_t[1])),
        math.atan2(turn[1, 0], turn[0, 0]),
    )


def fit_similarity(
    source_m: FloatArray, target_m: FloatArray, scale_gate: float, weights: FloatArray | None = None
) -> Similarity:
    """The rigid fit with the least-squares scale, held within 1 +- scale_gate."""
    w = np.ones(len(source_m)) if weights is None else weights
    rigid = fit_rigid(source_m, target_m, w)
    centred = (source_m - rigid.anchor_m) @ rotation(rigid.yaw_rad).T
    spread = float(np.sum(w[:, None] * centred**2))
    along = float(np.sum(w[:, None] * (target_m - rigid.world_m) * centred))
    scale = along / spread if spread > 0.0 else 1.0
    return replace(rigid, scale=min(1.0 + scale_gate, max(1.0 - scale_gate, scale)))


def area_around_m2(points_m: FloatArray, radius_m: float) -> float:
    """Area of the ground within a radius of any point (N, 2), m2, by cells."""
    cell = radius_m / CELLS
    line = (np.arange(-CELLS, CELLS) + 0.5) * cell
    disc = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    disc = disc[np.linalg.norm(disc, axis=1) <= radius_m]
    cells = np.floor((points_m[:, None] + disc).reshape(-1, 2) / cell).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    return len(np.unique(cells @ (1, 1 + cells[:, 0].max(initial=0)))) * cell**2
