"""Observed outlines against those of the reference: the shift of each that puts its points onto walls.

Walls are the edges of all reference buildings near by, so a blob over several buildings lies on their outer
walls, where its centroid would pull it to none of theirs. A point only counts on a wall that faces its way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from buildloc_msgs_py.types import FloatArray
from numba import njit
from numpy.typing import NDArray

REACH_M = (4.0, 3.0, 2.0)  # from a point to its wall, step by step
WALL_SIGMA_M = 1.0  # error of a point of a segmented outline
CAUCHY2 = 2.385**2
FACING = 0.5  # cosine between the normals of outline and wall
MIN_COVERED = 0.5  # share of an outline that has to lie on walls
OWN_POINTS = 3  # on the walls of a building that counts as seen
FULL = 0.3  # share of an outline's points that tells one direction as well as it can be told


@dataclass(frozen=True)
class Walls:
    """Buildings of the reference: middles (B, 2) of their boxes and radii (B,) around these, and the first
    ``counts`` (B,) of V walls each: corners (B, V, 2) where they begin, edges (B, V, 2) to where they end,
    the edges' lengths, and normals (B, V, 2) that point outwards."""

    middles_m: FloatArray
    radii_m: FloatArray
    counts: NDArray[np.int64]
    corners_m: FloatArray
    edges_m: FloatArray
    lengths_m: FloatArray
    normals: FloatArray


@dataclass(frozen=True)
class Alignment:
    """Of N outlines: ``buildings`` (N,) whose walls most points lie on, -1 where too few lie on any; the
    shift (N, 2) m onto them, how well it is told (N, 2, 2), from 0 to the identity; the share of each outline
    (N,) that lies on walls; and which buildings of the reference (B,) were seen."""

    buildings: NDArray[np.int64]
    shifts_m: FloatArray
    certainty: FloatArray
    covered: FloatArray
    seen: NDArray[np.bool_]


def walls(vertices_m: FloatArray) -> Walls:
    """The walls of outlines (B, V, 2), counter-clockwise; vertices that repeat make none."""
    edges = np.roll(vertices_m, -1, axis=1) - vertices_m
    lengths = np.hypot(edges[:, :, 0], edges[:, :, 1])
    first = np.argsort(lengths == 0.0, axis=1, kind="stable")
    corners, edges = (np.take_along_axis(of, first[:, :, None], axis=1) for of in (vertices_m, edges))
    lengths = np.take_along_axis(lengths, first, axis=1)
    outwards = np.stack([edges[:, :, 1], -edges[:, :, 0]], axis=2) / np.maximum(lengths, 1e-9)[:, :, None]
    low, high = vertices_m.min(axis=1), vertices_m.max(axis=1)
    radii, counts = np.hypot(*(high - low).T) / 2.0, (lengths > 0.0).sum(axis=1)
    return Walls((low + high) / 2.0, radii, counts, corners, edges, lengths, outwards)


def align(outlines_m: FloatArray, reference: Walls) -> Alignment:
    """Shift outlines (N, P, 2), points evenly along each, counter-clockwise, onto the walls, one by one."""
    along = np.roll(outlines_m, -1, axis=1) - np.roll(outlines_m, 1, axis=1)
    normals = np.stack([along[:, :, 1], -along[:, :, 0]], axis=2)
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-9)
    count = len(outlines_m)
    buildings = np.full(count, -1, dtype=np.int64)
    shifts, moments = np.zeros((count, 2)), np.zeros((count, 2, 2))
    seen = np.zeros(len(reference.radii_m), dtype=bool)
    _align(
        outlines_m, normals, reference.middles_m, reference.radii_m, reference.counts, reference.corners_m,
        reference.edges_m, reference.lengths_m, reference.normals, buildings, shifts, moments, seen,
    )  # fmt: skip
    shares, axes = np.linalg.eigh(moments)
    certainty = np.einsum("nij,nj,nkj->nik", axes, np.minimum(1.0, shares / FULL), axes)
    return Alignment(buildings, shifts, certainty, np.trace(moments, axis1=1, axis2=2), seen)


@njit(nogil=True, cache=True)
def _align(  # type: ignore[no-untyped-def]
    outlines, normals, middles, radii, counts, corners, edges, lengths, outwards, buildings, shifts, moments,
    seen,
):  # fmt: skip
    """``moments`` become the sums of w n n' over the points, w their weights over the number of points."""
    points = outlines.shape[1]
    votes = np.zeros(len(radii), np.int64)
    near = np.empty(len(radii), np.int64)
    for i in range(len(outlines)):
        x, y = outlines[i, :, 0].mean(), outlines[i, :, 1].mean()
        radius = np.sqrt(np.max((outlines[i, :, 0] - x) ** 2 + (outlines[i, :, 1] - y) ** 2))
        count = 0
        for b in range(len(radii)):
            within = radius + radii[b] + REACH_M[0]
            if counts[b] > 0 and (middles[b, 0] - x) ** 2 + (middles[b, 1] - y) ** 2 < within * within:
                near[count] = b
                count += 1
        dx, dy, covered, xx, xy, yy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for reach in REACH_M:
            covered, xx, xy, yy, px, py = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            votes[near[:count]] = 0
            for k in range(points):
                u, v = outlines[i, k, 0] + dx, outlines[i, k, 1] + dy
                nx, ny = normals[i, k, 0], normals[i, k, 1]
                best, owner, wall_x, wall_y, away = reach * reach, -1, 0.0, 0.0, 0.0
                for c in range(count):
                    b = near[c]
                    within = radii[b] + reach
                    if (middles[b, 0] - u) ** 2 + (middles[b, 1] - v) ** 2 > within * within:
                        continue
                    for e in range(counts[b]):
                        if outwards[b, e, 0] * nx + outwards[b, e, 1] * ny < FACING:
                            continue
                        ex, ey, length = edges[b, e, 0], edges[b, e, 1], lengths[b, e]
                        gx, gy = corners[b, e, 0] - u, corners[b, e, 1] - v
                        t = min(1.0, max(0.0, -(gx * ex + gy * ey) / (length * length)))
                        gx, gy = gx + t * ex, gy + t * ey
                        if gx * gx + gy * gy < best:
                            best, owner = gx * gx + gy * gy, b
                            wall_x, wall_y = outwards[b, e, 0], outwards[b, e, 1]
                            away = gx * wall_x + gy * wall_y
                if owner < 0:
                    continue
                votes[owner] += 1
                weight = 1.0 / (1.0 + best / (CAUCHY2 * WALL_SIGMA_M * WALL_SIGMA_M)) / points
                covered += weight
                xx, yy = xx + weight * wall_x * wall_x, yy + weight * wall_y * wall_y
                xy += weight * wall_x * wall_y
                px, py = px + weight * wall_x * away, py + weight * wall_y * away
            # Along a wall without an end nothing is told, and the shift stays 0.
            a, d = xx + 1e-3, yy + 1e-3
            determinant = a * d - xy * xy
            dx, dy = dx + (d * px - xy * py) / determinant, dy + (a * py - xy * px) / determinant
        if covered < MIN_COVERED:
            continue
        most = 0
        for c in range(count):
            seen[near[c]] |= votes[near[c]] >= OWN_POINTS
            if votes[near[c]] > most:
                most, buildings[i] = votes[near[c]], near[c]
        shifts[i] = dx, dy
        moments[i, 0, 0], moments[i, 0, 1], moments[i, 1, 0], moments[i, 1, 1] = xx, xy, xy, yy
