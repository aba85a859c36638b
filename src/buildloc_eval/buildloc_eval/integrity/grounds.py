"""The footprints of the trials: what is flown over and the references, built once, opened by memory map."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
import shapely
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.reference.buildings import Buildings, concatenate
from buildloc_matcher.reference.database import DatabaseWriter, ReferenceDatabase, open_database
from buildloc_matcher.reference.ingest import read_buildings
from buildloc_matcher.reference.region import WGS84, Circle, transformer
from buildloc_matcher.reference.tile import make_tile
from buildloc_msgs_py.footprint import footprints
from buildloc_msgs_py.types import FloatArray
from pyproj import CRS

from buildloc_eval.integrity.plan import (
    AS_IS,
    FAR_SHIFT_M,
    GRID,
    MISSING,
    SCATTERED,
    TOWNS,
    TOWNS_ALIKE,
    VARIANTS,
    Place,
    Plan,
    missing_variant,
)
from buildloc_eval.observed_flight import Flown, everywhere
from buildloc_eval.realworld import data_folder

APART_KM = 1.0  # flights outside of a reference are that far from it
TOWN_M, TOWN_START_M, TOWN_PITCH_M = 1600.0, 150.0, 2400.0  # no two of any heading touch
CROSSING_M = 16.0  # of a street that crosses
Say = Callable[[str], None]
T = TypeVar("T")


@dataclass(frozen=True)
class Source:
    """Measured footprints in metres of a UTM zone."""

    epsg: int
    buildings: Buildings


def read_source(name: str) -> Source:
    """One of the files of the real data. Raises DataError without them."""
    found = read_buildings([data_folder() / "footprints" / f"{name}.parquet"], MatcherConfig().min_area_m2)
    return Source(found.epsg, found.buildings)


def centre_m(place: Place, epsg: int) -> FloatArray:
    """(2,) metres of the UTM zone."""
    latitude, longitude = place.centre_deg
    return np.array(transformer(CRS(WGS84), CRS(epsg)).transform(longitude, latitude))


@dataclass(frozen=True)
class GridDesign:
    """A suburb of equal lots: houses every ``lot_m`` in rows, two to a street, which are ``street_m`` apart.

    The far row begins ``stagger`` of a lot later; after every ``block`` lots a street crosses, with larger
    houses at the corners or not. ``plans`` (P, 3) are width, depth and side of the garage, m; houses stand
    ``aside_m`` off the middle of the lot, on the other side where ``mirrored``. Shares of lots with another
    plan than the first, mirrored, and vacant; the houses' scatter, m.
    """

    lot_m: float
    street_m: float
    stagger: float
    block: int
    corners: bool
    plans: tuple[tuple[float, float, float], ...]
    aside_m: float
    other_plans: float
    mirrored: float
    vacant: float
    scatter_m: float


CORNER_HOUSE = 1.25  # how much wider and deeper than the first plan


def grid_design(rng: np.random.Generator) -> GridDesign:
    """Any suburb: from one plan on every lot to lots that have little in common but their size."""
    lot = rng.uniform(15.0, 30.0)
    width, depth = rng.uniform(0.55, 0.75) * lot, rng.uniform(8.0, 13.0)
    plans = tuple(
        (width * rng.uniform(0.85, 1.15), depth * rng.uniform(0.85, 1.15), float(rng.choice((0.0, 3.0, 5.0))))
        for _ in range(int(rng.integers(2, 5)))
    )
    return GridDesign(
        lot, rng.uniform(48.0, 72.0), float(rng.choice((0.0, 0.5, rng.random()))), int(rng.integers(6, 21)),
        bool(rng.integers(2)), plans, rng.uniform(0.0, 2.0), rng.uniform(0.0, 0.5),
        float(rng.choice((0.0, 0.5))), rng.uniform(0.0, 0.06), rng.uniform(0.1, 0.8),
    )  # fmt: skip


def _house_plans(design: GridDesign) -> tuple[FloatArray, FloatArray]:
    """Areas (P + 1,) and shapes (P + 1, 4) of the plans, the corner house last."""
    wide, deep, garage = design.plans[0]
    outlines = [
        shapely.union(shapely.box(0.0, 0.0, wide, deep), shapely.box(0.0, deep - 0.5, side, deep + side))
        for wide, deep, side in (*design.plans, (CORNER_HOUSE * wide, CORNER_HOUSE * deep, garage))
    ]
    found = footprints(np.array(outlines, dtype=object))
    return found.areas_m2, found.shapes


def grid_town(design: GridDesign, at_m: FloatArray, rng: np.random.Generator) -> Buildings:
    """A suburb of the design, at any heading; two of them differ in vacant lots, plans and scatter alone."""
    half = TOWN_M / 2.0
    lots, rows = int(TOWN_M / design.lot_m), int(TOWN_M / design.street_m)
    lot, row, side = (one.ravel() for one in np.meshgrid(range(lots), range(rows), (-1, 1), indexing="ij"))
    crossed = lot // design.block
    u = (lot + design.stagger * (side > 0)) * design.lot_m + crossed * CROSSING_M - half
    points = np.column_stack([u, row * design.street_m + side * 0.24 * design.street_m - half])
    corner = design.corners & ((lot % design.block == 0) | (lot % design.block == design.block - 1))
    built = (rng.random(len(points)) >= design.vacant) & (u < half)
    points, corner = points[built], corner[built]
    points[:, 0] += design.aside_m * np.where(rng.random(len(points)) < design.mirrored, -1.0, 1.0)
    points += rng.normal(0.0, design.scatter_m, points.shape)
    angle = rng.uniform(-math.pi, math.pi)
    c, s = math.cos(angle), math.sin(angle)
    areas, shapes = _house_plans(design)
    other = rng.integers(1, len(design.plans), len(points))
    plan = np.where(rng.random(len(points)) < design.other_plans, other, 0)
    plan[corner] = len(design.plans)
    placed = at_m + points @ np.array([[c, s], [-s, c]])
    return Buildings(placed, areas[plan].astype(np.float32), shapes[plan].astype(np.float32))


@dataclass(frozen=True)
class Grounds:
    """The footprints of a plan under a folder, those used so far in memory."""

    folder: Path
    plan: Plan
    seed: int
    config: MatcherConfig
    _kept: dict[tuple[object, ...], object] = field(default_factory=dict)

    def build(self, read: Callable[[str], Source], say: Say) -> None:
        """Make what is not there yet: the territories of all sources, and every reference."""
        self.folder.mkdir(parents=True, exist_ok=True)
        for name, territory in self.plan.territories.items():
            if not self._path(name).is_file():
                say(f"reading {name}")
                source = read(name)
                own = source.buildings.select(territory.holds(source.buildings.centroids_m, source.epsg))
                staged = self._path(f"unfinished_{name}")
                np.savez(
                    staged, epsg=source.epsg, centroids_m=own.centroids_m, areas_m2=own.areas_m2,
                    shapes=own.shapes,
                )  # fmt: skip
                staged.replace(self._path(name))
        for place in self.plan.places:
            for radius in place.radii_km:
                for variant in VARIANTS if radius == place.radii_km[-1] else (AS_IS,):
                    if not self._database(place, radius, variant).exists():
                        say(f"building the reference of {place.name}, {radius:g} km, {variant}")
                        self._build(place, radius, variant)

    def _path(self, source: str) -> Path:
        return self.folder / f"{source}.npz"

    def _database(self, place: Place, radius_km: float, variant: str) -> Path:
        return self.folder / f"{place.slug}_{radius_km:g}km_{variant.replace(' ', '_')}.bldb"

    def _build(self, place: Place, radius_km: float, variant: str) -> None:
        buildings = self._varied(self._within(place, place.reference, radius_km), place, radius_km, variant)
        box = (-np.inf, -np.inf, np.inf, np.inf)
        epsg = self.source(place.reference).epsg
        with DatabaseWriter(self._database(place, radius_km, variant), epsg, self.config) as writer:
            writer.add("all", make_tile(buildings, box, self.config))
            writer.commit((), {})

    def _rng(self, place: Place, *which: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, *place.slug.encode(), *which])

    def _varied(self, own: Buildings, place: Place, radius_km: float, variant: str) -> Buildings:
        """The buildings of a reference as a control wants them."""
        rng = self._rng(place, VARIANTS.index(variant))
        for share in MISSING:
            if variant == missing_variant(share):
                return own.select(rng.random(len(own)) >= share)
        if variant == SCATTERED:
            length, angle = rng.uniform(*FAR_SHIFT_M, len(own)), rng.uniform(-math.pi, math.pi, len(own))
            away = length[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
            return Buildings(own.centroids_m + away, own.areas_m2, own.shapes)
        if variant == GRID:
            return concatenate([own, *(self.town(place, town) for town in range(TOWNS))])
        return own

    def town_site_m(self, place: Place, town: int) -> FloatArray:
        """(2,) where a suburb lies: in a block to the east of the city, those in no reference as well."""
        column, row = divmod(town % TOWNS, TOWNS_ALIKE)
        first = 1000.0 * place.radii_km[-1] + TOWN_PITCH_M
        east, north = first + column * TOWN_PITCH_M, (row - 0.5 * (TOWNS_ALIKE - 1)) * TOWN_PITCH_M
        return np.array([east, north]) + centre_m(place, self.source(place.reference).epsg)

    def town(self, place: Place, town: int) -> Buildings:
        """A suburb; the first TOWNS are those of the reference, TOWNS_ALIKE of one design each."""
        design = grid_design(self._rng(place, len(VARIANTS), town % TOWNS // TOWNS_ALIKE))
        return grid_town(design, self.town_site_m(place, town), self._rng(place, len(VARIANTS) + 1, town))

    def source(self, name: str) -> Source:
        """The territory of a source."""

        def load() -> Source:
            with np.load(self._path(name)) as kept:
                found = Buildings(kept["centroids_m"], kept["areas_m2"], kept["shapes"])
                return Source(int(kept["epsg"]), found)

        return self._once(("source", name), load)

    def _within(self, place: Place, source: str, radius_km: float) -> Buildings:
        found = self.source(source)
        inside = Circle(*place.centre_deg, radius_km).holds(found.buildings.centroids_m, found.epsg)
        return found.buildings.select(inside)

    def reference(self, place: Place, radius_km: float, variant: str) -> ReferenceDatabase:
        """A reference that was built."""
        return self._once(
            ("reference", place.name, radius_km, variant),
            lambda: open_database(self._database(place, radius_km, variant), self.config),
        )

    def home(self, place: Place, radius_km: float) -> Flown:
        """What lies in a place's reference."""
        return self._once(
            ("home", place.name, radius_km), lambda: everywhere(self._within(place, place.world, radius_km))
        )

    def outside(self, place: Place) -> Flown:
        """The plan's ground beyond a place's reference."""

        def make() -> Flown:
            found = self.source(place.world)
            near = Circle(*place.centre_deg, place.outside_km + APART_KM)
            return everywhere(found.buildings.select(~near.holds(found.buildings.centroids_m, found.epsg)))

        return self._once(("outside", place.name), make)

    def suburb(self, place: Place, town: int) -> Flown:
        """A suburb alone; flights start near its middle."""

        def make() -> Flown:
            buildings = self.town(place, town)
            away = np.hypot(*(buildings.centroids_m - self.town_site_m(place, town)).T)
            return Flown(buildings, buildings.centroids_m[away < TOWN_START_M])

        return self._once(("suburb", place.name, town), make)

    def _once(self, key: tuple[object, ...], make: Callable[[], T]) -> T:
        if key not in self._kept:
            self._kept[key] = make()
        return self._kept[key]  # type: ignore[return-value]
