"""Similarities of the plane, and their least squares over ground that may slope."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from buildloc_msgs_py.types import FloatArray


class Similarity(NamedTuple):
    """p_to = translation + scale R(yaw) p_from; metres, radians."""

    x_m: float
    y_m: float
    yaw_rad: float
    scale: float

    def apply(self, points_m: FloatArray) -> FloatArray:
        """(N, 2) -> (N, 2)."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        rotation = np.array([[c, -s], [s, c]])
        return np.asarray(self.scale * points_m @ rotation.T + (self.x_m, self.y_m), dtype=np.float64)

    def compose(self, other: Similarity) -> Similarity:
        """Apply ``other`` first, then this one."""
        x, y = self.apply(np.array([[other.x_m, other.y_m]]))[0]
        yaw = math.remainder(self.yaw_rad + other.yaw_rad, math.tau)
        return Similarity(float(x), float(y), yaw, self.scale * other.scale)

    def inverse(self) -> Similarity:
        """What takes the target back to the source."""
        undone = Similarity(0.0, 0.0, -self.yaw_rad, 1.0 / self.scale)
        x, y = undone.apply(np.array([[-self.x_m, -self.y_m]]))[0]
        return undone._replace(x_m=float(x), y_m=float(y))

    def matrix(self) -> FloatArray:
        """(3, 3) homogeneous matrix."""
        c, s = self.scale * math.cos(self.yaw_rad), self.scale * math.sin(self.yaw_rad)
        return np.array([[c, -s, self.x_m], [s, c, self.y_m], [0.0, 0.0, 1.0]])


def fit_similarity(
    source_m: FloatArray, target_m: FloatArray, moved_m: FloatArray, relief_rad: float
) -> tuple[Similarity, FloatArray]:
    """Least squares of ``target_m`` on ``source_m``, both (N, 2), N >= 3, and its (4, 4) covariance.

    Ground that slopes, or trees along one side, move with the camera's motion ``moved_m`` (2,), which a
    similarity alone takes for yaw and scale. That motion's parallax, linear over the image, is therefore
    estimated beside it: ``p_to = translation + scale R p_from + moved (n . p_from)``, n unknown with the
    standard deviation ``relief_rad``, in 1/m (slope over height). Order of the covariance: x, y, yaw,
    log scale; metres, radians. It treats the points as independent.
    """
    (x, y), one, none = source_m.T, np.ones(len(source_m)), np.zeros(len(source_m))
    rows_x = np.column_stack([x, -y, one, none, moved_m[0] * x, moved_m[0] * y])
    rows_y = np.column_stack([y, x, none, one, moved_m[1] * x, moved_m[1] * y])
    design, measured = np.vstack([rows_x, rows_y]), np.concatenate([target_m[:, 0], target_m[:, 1]])
    flat = np.linalg.lstsq(design[:, :4], measured, rcond=None)[0]
    noise = max(float(np.mean((measured - design[:, :4] @ flat) ** 2)), 1e-12)
    normal = design.T @ design / noise
    normal[4:, 4:] += np.eye(2) / relief_rad**2
    a, b, tx, ty, *_ = solution = np.linalg.solve(normal, design.T @ measured / noise)
    residual = measured - design @ solution
    freedom = max(len(measured) - 6, 1)
    covariance = np.linalg.inv(normal)[:4, :4] * (float(residual @ residual) / freedom / noise)
    square = a * a + b * b
    jacobian = np.array(
        [[0, 0, 1, 0], [0, 0, 0, 1], [-b / square, a / square, 0, 0], [a / square, b / square, 0, 0]]
    )
    found = Similarity(float(tx), float(ty), math.atan2(b, a), math.sqrt(square))
    return found, np.asarray(jacobian @ covariance @ jacobian.T, dtype=np.float64)
