"""Footprints of an invented suburb: districts with streets of their own, houses of many shapes."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from buildloc_msgs_py.types import FloatArray
from pyproj import Transformer
from shapely import affinity
from shapely.geometry import Polygon

from buildloc_eval.world import to_utm

DISTRICT_M = 420.0
GAP_M = 2.5


@dataclass(frozen=True)
class _House:
    """A plan in metres: a rectangle, perhaps with a wing (its left edge, width and depth)."""

    width: float
    height: float
    wing: tuple[float, float, float] | None
    quarter_turns: int

    def outline(self) -> Polygon:
        """Rectangle, L or T about the origin."""
        w, h = self.width, self.height
        body = shapely.box(-w / 2, -h / 2, w / 2, h / 2)
        if self.wing is not None:
            left, wide, deep = self.wing
            body = body.union(shapely.box(left, h / 2 - 0.5, left + wide, h / 2 + deep))
        return affinity.rotate(body, 90.0 * self.quarter_turns, origin=(0, 0))


def _house(rng: np.random.Generator) -> _House:
    """One house of the suburb; one in 25 is a large hall."""
    if rng.random() < 0.04:
        return _House(rng.uniform(22, 48), rng.uniform(14, 26), None, 0)
    width, height = rng.uniform(9, 18), rng.uniform(7, 11)
    wing = None
    if rng.random() < 0.45:
        wide, deep = rng.uniform(4, 7), rng.uniform(3, 7)
        wing = rng.uniform(-width / 2, width / 2 - wide), wide, deep
    return _House(width, height, wing, int(rng.integers(4)))


def suburb(seed: int, extent_m: float) -> list[Polygon]:
    """Outlines in metres about the origin, within a square of ``extent_m``."""
    rng = np.random.default_rng(seed)
    count = max(4, round((extent_m / DISTRICT_M) ** 2))
    centres = rng.uniform(-extent_m / 2, extent_m / 2, (count, 2))
    taken: list[Polygon] = []
    for index, centre in enumerate(centres):
        angle = rng.uniform(0.0, math.pi / 2)
        lot, street = rng.uniform(19.0, 34.0), rng.uniform(42.0, 68.0)
        c, s = math.cos(angle), math.sin(angle)
        reach = int(2.0 * DISTRICT_M / lot)
        for i in range(-reach, reach + 1):
            for j in range(-reach, reach + 1):
                for side in (-1.0, 1.0):
                    bend = 12.0 * math.sin(i * lot / 90.0 + index)
                    u = i * lot + rng.normal(0, 2.2)
                    v = j * street + side * street * 0.24 + bend + rng.normal(0, 1.8)
                    place = centre + np.array([c * u - s * v, s * u + c * v])
                    skip = rng.random() < 0.14
                    turn = math.degrees(angle) + rng.normal(0, 5.0)
                    plan = _house(rng)
                    nearest = np.argmin(np.hypot(*(centres - place).T))
                    if skip or nearest != index or np.abs(place).max() > extent_m / 2:
                        continue
                    house = affinity.rotate(plan.outline(), turn, origin=(0, 0))
                    taken.append(affinity.translate(house, *place))
    return _apart(taken)


def _apart(outlines: list[Polygon]) -> list[Polygon]:
    """Without the later of every two that come closer than GAP_M."""
    tree = shapely.STRtree(outlines)
    one, other = tree.query(outlines, predicate="dwithin", distance=GAP_M)
    dropped: set[int] = set()
    for a, b in sorted(zip(one.tolist(), other.tolist(), strict=True)):
        if a < b and a not in dropped:
            dropped.add(b)
    return [outline for i, outline in enumerate(outlines) if i not in dropped]


def write_town(path: Path, seed: int, extent_m: float, centre_deg: tuple[float, float]) -> int:
    """Write the suburb as GeoJSON around (latitude, longitude); returns the number of buildings."""
    epsg, east, north = to_utm(*centre_deg)
    to_wgs84 = Transformer.from_crs(epsg, 4326, always_xy=True)
    features = []
    for outline in suburb(seed, extent_m):
        metres: FloatArray = shapely.get_coordinates(outline) + np.array([east, north])
        longitude, latitude = to_wgs84.transform(metres[:, 0], metres[:, 1])
        ring = [[round(float(x), 7), round(float(y), 7)] for x, y in zip(longitude, latitude, strict=True)]
        geometry = {"type": "Polygon", "coordinates": [ring]}
        features.append({"type": "Feature", "properties": {}, "geometry": geometry})
    document = {"type": "FeatureCollection", "features": features}
    path.write_text(json.dumps(document, separators=(",", ":")) + "\n")
    return len(features)
