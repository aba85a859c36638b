"""Buildings of the fused map: components across tiles, as outlines in metres that keep their ids."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import islice

import cv2
import numpy as np
import shapely
from buildloc_msgs_py.footprint import footprints
from buildloc_msgs_py.ground import traced
from buildloc_msgs_py.types import ByteArray, FloatArray, LocalMap
from numpy.typing import NDArray
from shapely.geometry import Polygon

from buildloc_mapper.config import MapperConfig
from buildloc_mapper.fusion import Fusion
from buildloc_mapper.identity import Outlines, continued
from buildloc_mapper.similarity import Similarity
from buildloc_mapper.tiles import TILE_PX, Box, Counts, Tile, read

LocalOutlines = tuple[Polygon, ...]
CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
VIEWS_COMPARED = 20  # keyframes per tile whose centroids are compared: a flight may hover
PRIOR_VIEWS = 2.0  # what sigma_centroid_m weighs against their scatter
LARGEST_PX = 4096  # longest side of a building: what is larger is ground taken for one, and fills the memory
SAME_AREA = 0.7  # smaller to larger area of what one keyframe and the map take for the same building

# Steps to the four neighbours of a tile, the tile's own pixels along that side, and the neighbour's.
SIDES = (
    ((1, 0), np.s_[:, -1], np.s_[:, 0]),
    ((-1, 0), np.s_[:, 0], np.s_[:, -1]),
    ((0, 1), np.s_[-1, :], np.s_[0, :]),
    ((0, -1), np.s_[0, :], np.s_[-1, :]),
)
Part = tuple[Tile, int]  # a component of a tile and its label there

BUILDING = np.dtype(
    [
        ("id", np.int64), ("centroid", np.float64, 2), ("area", np.float64), ("shape", np.float64, 4),
        ("observations", np.int64), ("covariance", np.float64, (2, 2)), ("cut", np.bool_),
        ("outline", object), ("parts", object),
        # The keyframe it moves with, and where that one was when the outline was drawn.
        ("keyframe", np.int64), ("pose", np.float64, 4),
    ]
)  # fmt: skip
COLUMNS = ("id", "centroid", "area", "shape", "observations", "covariance", "cut")  # as in LocalMap
Table = NDArray[np.void]


@dataclass(frozen=True)
class Extraction:
    """The map, and its outlines in the same order."""

    local_map: LocalMap
    outlines: LocalOutlines


@dataclass(frozen=True)
class _Labels:
    """Connected components of one tile: a label per pixel, 0 for none, and OpenCV's statistics of each."""

    labels: NDArray[np.uint16]
    stats: NDArray[np.int32]


@dataclass(frozen=True)
class _Component:
    """Confirmed pixels that are connected, in a box that has a free pixel on every side."""

    parts: tuple[Part, ...]
    box: Box


def confirmed(counts: Counts, config: MapperConfig) -> ByteArray:
    """0 or 1: building in enough keyframes and in more than ``min_share`` of those that saw the pixel.

    ``counts`` is (2, rows, columns), seen and building.
    """
    seen, building = counts
    enough = (building >= config.min_observations) & (building > config.min_share * seen)
    return np.asarray(enough, dtype=np.uint8)


class Extractor:
    """The buildings of a growing map. Only tiles whose counts changed are looked at again, with the
    buildings that reach into them; all others stay as they are, to the last bit."""

    def __init__(self, config: MapperConfig) -> None:
        self._config = config
        self.reset()

    def reset(self) -> None:
        """Forget the flight; ids start again."""
        self._tiles: dict[Tile, _Labels] = {}
        self._owners: dict[Part, int] = {}
        self._table: Table = np.empty(0, dtype=BUILDING)
        self._next_id = 0

    def update(self, fusion: Fusion, dirty: Collection[Tile], stamp_ns: int) -> Extraction:
        """The buildings of ``fusion``, of which the tiles ``dirty`` changed since the last call.

        A building keeps the id of the one it continues (:func:`buildloc_mapper.identity.continued`), whose
        outline first moves with the keyframe that was nearest to it. An id is never given twice.
        """
        stale: set[int] = set()
        for tile in dirty:
            before = self._tiles.pop(tile, None)
            if before is not None:
                stale.update(self._owners.pop((tile, label), -1) for label in range(1, len(before.stats)))
            if tile in fusion.counts:
                self._tiles[tile] = self._label(fusion.counts[tile])
        found = self._components(dirty)
        stale.update(self._owners.get(part, -1) for component in found for part in component.parts)
        gone = np.isin(self._table["id"], list(stale))
        built = self._measure(fusion, found)
        self._name(built, self._table[gone], fusion)
        for row in self._table[gone]:
            for part in row["parts"]:
                self._owners.pop(part, None)
        for row in built:
            self._owners.update(dict.fromkeys(row["parts"], int(row["id"])))
        table = np.concatenate([self._table[~gone], built])
        self._table = table[np.argsort(table["id"])]
        return self._extraction(stamp_ns)

    def _extraction(self, stamp_ns: int) -> Extraction:
        table = self._table
        local_map = LocalMap(
            stamp_ns,
            *(np.ascontiguousarray(table[name]) for name in COLUMNS),
        )
        return Extraction(local_map, tuple(table["outline"]))

    def _label(self, counts: Counts) -> _Labels:
        """Four-connected, so that one free pixel on the diagonal keeps neighbours apart."""
        _, labels, stats, _ = cv2.connectedComponentsWithStats(
            confirmed(counts, self._config), connectivity=4
        )
        return _Labels(labels.astype(np.uint16), np.asarray(stats, dtype=np.int32))

    def _components(self, dirty: Collection[Tile]) -> list[_Component]:
        """Whole components that have a pixel in the dirty tiles or beside them."""
        waiting: list[Part] = []
        for tile in dirty:
            if tile in self._tiles:
                waiting += [(tile, label) for label in range(1, len(self._tiles[tile].stats))]
            for (di, dj), _, there in SIDES:
                other = (tile[0] + di, tile[1] + dj)
                if other in self._tiles and other not in dirty:
                    waiting += [(other, int(v)) for v in np.unique(self._tiles[other].labels[there]) if v]
        neighbours: dict[Tile, dict[int, set[Part]]] = {}
        reached: set[Part] = set()
        components = []
        for start in waiting:
            if start in reached:
                continue
            reached.add(start)
            parts = [start]
            for tile, label in parts:  # grows while it is walked
                if tile not in neighbours:
                    neighbours[tile] = self._neighbours(tile)
                new = neighbours[tile][label] - reached
                reached |= new
                parts += sorted(new)
            components.append(self._component(parts))
        return components

    def _neighbours(self, tile: Tile) -> dict[int, set[Part]]:
        """What the components of a tile touch in the tiles beside it, by label."""
        found: defaultdict[int, set[Part]] = defaultdict(set)
        for (di, dj), here, there in SIDES:
            other = (tile[0] + di, tile[1] + dj)
            if other not in self._tiles:
                continue
            own, others = self._tiles[tile].labels[here], self._tiles[other].labels[there]
            both = (own > 0) & (others > 0)
            for label, touched in set(zip(own[both].tolist(), others[both].tolist(), strict=True)):
                found[label].add((other, touched))
        return found

    def _component(self, parts: Sequence[Part]) -> _Component:
        corners = []
        for (i, j), label in parts:
            x, y, width, height = self._tiles[i, j].stats[label, :4].tolist()
            x, y = x + i * TILE_PX, y + j * TILE_PX
            corners.append((x, y, x + width, y + height))
        left, top, right, bottom = zip(*corners, strict=True)
        return _Component(tuple(parts), Box(min(left), min(top), max(right), max(bottom)).grown(1))

    def _mask(self, component: _Component) -> ByteArray:
        """0 or 1 per pixel of the component's box."""
        mask = np.zeros(component.box.shape, dtype=np.uint8)
        labels: defaultdict[Tile, list[int]] = defaultdict(list)
        for tile, label in component.parts:
            labels[tile].append(label)
        for tile, in_tile, in_box in component.box.pieces():
            for label in labels[tile]:
                mask[in_box] |= self._tiles[tile].labels[in_tile] == label
        return mask

    def _may_be_building(self, component: _Component) -> bool:
        rows, columns = component.box.grown(-1).shape
        area = rows * columns * self._config.map_gsd_m**2
        return max(rows, columns) <= LARGEST_PX and area >= self._config.min_area_m2

    def _measure(self, fusion: Fusion, components: Sequence[_Component]) -> Table:
        """Everything but the ids, of the components whose size is a building's."""
        config = self._config
        components = [component for component in components if self._may_be_building(component)]
        masks = [self._mask(component) for component in components]
        contours = []
        for component, mask in zip(components, masks, strict=True):
            how = (cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
            rings, _ = cv2.findContours(mask, *how, offset=component.box[:2])
            contours.append(np.asarray(rings[0], dtype=np.int32))
        outlines = traced(contours, config.map_gsd_m, (-0.5, -0.5))
        areas = shapely.area(outlines)  # NaN for None
        rows = np.flatnonzero((areas > 0.0) & (areas >= config.min_area_m2))
        table = np.zeros(len(rows), dtype=BUILDING)
        outlines = _simplified(outlines[rows], config.simplify_m)
        measured = footprints(outlines)
        table["outline"], table["centroid"] = outlines, measured.centroids_m
        table["area"], table["shape"] = measured.areas_m2, measured.shapes
        for row, index in zip(table, rows.tolist(), strict=True):
            component, inside = components[index], masks[index] > 0
            seen, building = read(fusion.counts, component.box)
            unseen = cv2.dilate((seen < config.min_observations).astype(np.uint8), CROSS)
            row["observations"], row["cut"] = int(building[inside].max()), bool(unseen[inside].any())
            row["parts"] = component.parts
        table["covariance"] = self._covariances(fusion, table)
        if len(table):
            ids, poses = list(fusion.drawn), np.array([drawn.pose for drawn in fusion.drawn.values()])
            nearest = np.argmin(_squared_distances(table["centroid"], poses[:, :2]), axis=1)
            table["keyframe"], table["pose"] = np.array(ids)[nearest], poses[nearest]
        return table

    def _covariances(self, fusion: Fusion, table: Table) -> FloatArray:
        """(N, 2, 2) scatter, m2, of a building's centroid among the keyframes that saw it whole.

        It is not divided by their number: what a network draws too large on one side it does in every
        view. Few views are outweighed by ``sigma_centroid_m``. Drift of the map is not in it.
        """
        tiles = {tile for parts in table["parts"] for tile, _ in parts}
        latest = {k for tile in tiles for k in islice(reversed(fusion.keyframes[tile]), VIEWS_COMPARED)}
        seen = [fusion.drawn[keyframe] for keyframe in sorted(latest)]
        points = np.concatenate(
            [np.empty((0, 2)), *(d.pose.apply(d.view.sightings.centroids_m) for d in seen)]
        )
        areas = np.concatenate([np.empty(0), *(d.pose.scale**2 * d.view.sightings.areas_m2 for d in seen)])
        which, building = shapely.STRtree(table["outline"]).query(shapely.points(points), predicate="within")
        ratio = areas[which] / table["area"][building]
        same = (ratio >= SAME_AREA) & (ratio <= 1.0 / SAME_AREA)
        points, building = points[which[same]], building[same]
        views = np.bincount(building, minlength=len(table))
        mean = np.zeros((len(table), 2))
        np.add.at(mean, building, points)
        away = points - (mean / np.maximum(views, 1)[:, None])[building]
        scatter = np.tile(PRIOR_VIEWS * self._config.sigma_centroid_m**2 * np.eye(2), (len(table), 1, 1))
        np.add.at(scatter, building, away[:, :, None] * away[:, None, :])
        return np.asarray(scatter / (PRIOR_VIEWS + np.maximum(views - 1, 0))[:, None, None])

    def _name(self, built: Table, before: Table, fusion: Fusion) -> None:
        """Give every building its id: that of the earlier one it continues, or the next."""
        earlier = before["outline"].copy()
        for row, building in enumerate(before):
            drawn = fusion.drawn.get(int(building["keyframe"]))
            if drawn is not None and tuple(building["pose"]) != drawn.pose:
                earlier[row] = _moved(earlier[row], Similarity(*building["pose"].tolist()), drawn.pose)
        known = continued(built["outline"], earlier)
        built["id"][known >= 0] = before["id"][known[known >= 0]]
        new = int((known < 0).sum())
        built["id"][known < 0] = np.arange(self._next_id, self._next_id + new)
        self._next_id += new


def _simplified(outlines: Outlines, tolerance_m: float) -> Outlines:
    """Quickly, and with care (ten times slower) only the few that would cross themselves."""
    quick = shapely.simplify(outlines, tolerance_m, preserve_topology=False)
    broken = ~shapely.is_valid(quick) | (shapely.get_type_id(quick) != shapely.GeometryType.POLYGON)
    broken |= ~(shapely.area(quick) > 0.0)
    quick[broken] = shapely.simplify(outlines[broken], tolerance_m)
    return np.asarray(quick, dtype=object)


def _squared_distances(some_m: FloatArray, others_m: FloatArray) -> FloatArray:
    return np.asarray(((some_m[:, None] - others_m[None]) ** 2).sum(axis=2), dtype=np.float64)


def _moved(outline: Polygon, before: Similarity, after: Similarity) -> Polygon:
    """The outline as it is when the keyframe it belongs to is elsewhere."""
    move = after.matrix() @ np.linalg.inv(before.matrix())
    return shapely.transform(outline, lambda xy: xy @ move[:2, :2].T + move[:2, 2])
