"""Fuses keyframe masks on the ground by counting observations (paper, map stitching), tile by tile."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.ground import border, level_to_ray, pixels_to_level, resample
from buildloc_msgs_py.types import ByteArray, CameraModel, FloatArray, Frame, Mask

from buildloc_mapper.config import MapperConfig
from buildloc_mapper.similarity import Similarity
from buildloc_mapper.tiles import TILE_PX, Box, Counts, Tile

MAX_SIDE_PX = 16_000  # of a keyframe on the map; OpenCV warps no image of 32768


@dataclass(frozen=True)
class Sightings:
    """Buildings that one keyframe saw whole: centroids (N, 2) in its level camera frame, areas (N,)."""

    centroids_m: FloatArray
    areas_m2: FloatArray


@dataclass(frozen=True)
class Footprint:
    """A keyframe's ground, 0 or 1 per pixel of the box: what it saw, and where it saw a building."""

    box: Box
    seen: ByteArray
    building: ByteArray


@dataclass(frozen=True)
class View:
    """The mask of one keyframe, compressed without loss, with what puts it on the ground.

    ``edge_m`` (N, 2) is the outer edge of the image in the level camera frame.
    """

    png: ByteArray
    camera: CameraModel
    altitude_m: float
    attitude_xyzw: tuple[float, float, float, float]
    edge_m: FloatArray
    sightings: Sightings

    @classmethod
    def of(cls, frame: Frame, mask: Mask, config: MapperConfig) -> View:
        """Raises BuildlocError when the frame covers an impossibly large piece of ground."""
        camera, altitude, attitude = frame.camera, frame.altitude_m, frame.attitude_xyzw
        edge = pixels_to_level(border(camera), camera, altitude, attitude)
        side = float(np.ptp(edge, axis=0).max())
        if side > MAX_SIDE_PX * config.map_gsd_m:
            raise BuildlocError(
                f"a keyframe would cover {side:.0f} m of map; check the altitude telemetry or raise map_gsd_m"
            )
        _, png = cv2.imencode(".png", mask.pixels, [cv2.IMWRITE_PNG_BILEVEL, 1])
        nothing = Sightings(np.empty((0, 2)), np.empty(0))
        view = cls(np.asarray(png, dtype=np.uint8), camera, altitude, attitude, edge, nothing)
        level = view.footprint(mask.pixels, Similarity(0.0, 0.0, 0.0, 1.0), config.map_gsd_m)
        return replace(view, sightings=_sightings(level, config))

    def mask(self) -> ByteArray:
        """(H, W) uint8, 0 or 255."""
        return np.asarray(cv2.imdecode(self.png, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)

    def footprint(self, mask: ByteArray, pose: Similarity, gsd_m: float) -> Footprint:
        """The view's own mask on the map: the same to the bit whenever it is asked for at this pose."""
        edge = pose.apply(self.edge_m) * [1.0, -1.0] / gsd_m
        (left, top), (right, bottom) = np.floor(edge.min(axis=0)), np.ceil(edge.max(axis=0))
        box = Box(int(left), int(top), int(right), int(bottom))
        pixel_to_map = np.array(
            [[gsd_m, 0.0, (left + 0.5) * gsd_m], [0.0, -gsd_m, -(top + 0.5) * gsd_m], [0, 0, 1.0]]
        )
        to_level = np.linalg.inv(pose.matrix()) @ pixel_to_map
        to_ray = level_to_ray(self.altitude_m, self.attitude_xyzw) @ to_level
        seen = np.zeros(box.shape, dtype=np.uint8)
        corners = np.round((edge - (left + 0.5, top + 0.5)) * 16).astype(np.int32)
        cv2.fillPoly(seen, [corners], 1, cv2.LINE_8, 4)
        warped = resample(mask, self.camera, to_ray, box.shape[::-1])
        return Footprint(box, seen, (warped > 127).astype(np.uint8) & seen)


def _sightings(level: Footprint, config: MapperConfig) -> Sightings:
    gsd, square = config.map_gsd_m, np.ones((3, 3), np.uint8)
    _, labels, stats, centroids = cv2.connectedComponentsWithStats(level.building, connectivity=4)
    inside = cv2.erode(level.seen, square, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    areas = stats[:, cv2.CC_STAT_AREA] * gsd**2
    whole = areas >= config.min_area_m2
    whole[0] = False  # the background
    whole[labels[inside == 0]] = False  # what the image's border may cut
    pixels = centroids[whole] + (level.box.left + 0.5, level.box.top + 0.5)
    return Sightings(pixels * np.array([gsd, -gsd]), np.asarray(areas[whole], dtype=np.float64))


@dataclass(frozen=True)
class Drawn:
    """A keyframe that is part of the counts, at the pose it was drawn with."""

    view: View
    pose: Similarity
    reach_m: float  # of its farthest corner


class Fusion:
    """Counts per pixel of the keyframes that saw it, and of those that saw a building there.

    ``counts`` holds (2, TILE_PX, TILE_PX) per tile, seen and building, in this order; ``keyframes`` which of
    them a tile shows, latest drawn last; ``drawn`` the keyframes by id. ``waiting`` counts keyframes that
    the last update left undrawn or at an earlier pose.
    """

    def __init__(self, config: MapperConfig) -> None:
        self._config = config
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.counts: dict[Tile, Counts] = {}
        self.keyframes: dict[Tile, dict[int, None]] = {}
        self.drawn: dict[int, Drawn] = {}
        self.waiting = 0

    def update(
        self, views: Mapping[int, View], poses: Mapping[int, Similarity], everything: bool = False
    ) -> set[Tile]:
        """Make the counts those of ``poses``; the tiles that changed.

        Keyframes that are gone are taken out, new ones drawn. Those that moved by ``redraw_px`` since they
        were drawn are drawn anew, those that moved most first: ``max_redraws`` of them, but all that moved
        by more than ``max_stale_m``, and all when ``everything`` is asked for. So a loop closure that moves
        the whole flight a little costs no more than any keyframe, and the map follows over the next ones.
        """
        dirty: set[Tile] = set()
        if not self.drawn.keys() & poses.keys():  # another map: quicker than taking out every keyframe
            dirty.update(self.counts)
            self.reset()
        for gone in self.drawn.keys() - poses.keys():
            drawn = self.drawn.pop(gone)
            dirty.update(self._erase(gone, drawn, drawn.view.mask()))
        moved, shift_m = self._moved(poses)
        far = int((shift_m > self._config.max_stale_m).sum())
        redraws = len(moved) if everything else max(far, self._config.max_redraws)
        self.waiting = max(0, len(moved) - redraws)
        now = [*sorted(poses.keys() - self.drawn.keys()), *moved[:redraws]]
        for keyframe in now:
            mask = views[keyframe].mask()
            if keyframe in self.drawn:
                dirty.update(self._erase(keyframe, self.drawn[keyframe], mask))
            dirty.update(self._draw(keyframe, views[keyframe], mask, poses[keyframe]))
        return dirty

    def _moved(self, poses: Mapping[int, Similarity]) -> tuple[list[int], FloatArray]:
        """Keyframes drawn too far from where they are now, and by how much; those that moved most first."""
        ids = np.array(list(self.drawn), dtype=np.int64)
        before = np.array([drawn.pose for drawn in self.drawn.values()]).reshape(-1, 4)
        after = np.array([poses[keyframe] for keyframe in self.drawn]).reshape(-1, 4)
        reach = np.array([drawn.reach_m for drawn in self.drawn.values()])
        turned = after[:, 3] * np.exp(1j * after[:, 2]) - before[:, 3] * np.exp(1j * before[:, 2])
        shift = np.hypot(*(after - before)[:, :2].T) + np.abs(turned) * reach
        order = np.argsort(-shift, kind="stable")
        order = order[shift[order] > self._config.redraw_px * self._config.map_gsd_m]
        return ids[order].tolist(), shift[order]

    def _draw(self, keyframe: int, view: View, mask: ByteArray, pose: Similarity) -> list[Tile]:
        footprint = view.footprint(mask, pose, self._config.map_gsd_m)
        touched = []
        for tile, in_tile, in_box in footprint.box.pieces():
            if not footprint.seen[in_box].any():
                continue
            if tile not in self.counts:
                self.counts[tile] = np.zeros((2, TILE_PX, TILE_PX), dtype=np.uint16)
                self.keyframes[tile] = {}
            self.counts[tile][0][in_tile] += footprint.seen[in_box]
            self.counts[tile][1][in_tile] += footprint.building[in_box]
            self.keyframes[tile][keyframe] = None
            touched.append(tile)
        self.drawn[keyframe] = Drawn(view, pose, float(np.linalg.norm(view.edge_m, axis=1).max()))
        return touched

    def _erase(self, keyframe: int, drawn: Drawn, mask: ByteArray) -> list[Tile]:
        """Take out of the counts exactly what :meth:`_draw` put in: the same mask at the same pose."""
        footprint = drawn.view.footprint(mask, drawn.pose, self._config.map_gsd_m)
        touched = []
        for tile, in_tile, in_box in footprint.box.pieces():
            if keyframe not in self.keyframes.get(tile, {}):
                continue
            self.counts[tile][0][in_tile] -= footprint.seen[in_box]
            self.counts[tile][1][in_tile] -= footprint.building[in_box]
            del self.keyframes[tile][keyframe]
            if not self.keyframes[tile]:
                del self.keyframes[tile], self.counts[tile]
            touched.append(tile)
        return touched
