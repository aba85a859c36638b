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
    VARIANTS,
    Place,
    Plan,
    missing_variant,
)
from buildloc_eval.observed_flight import Flown, everywhere
from buildloc_eval.realworld import data_folder

APART_KM = 1.0  # flights outside of a reference are that far from it
TOWN_M, TOWN_START_M, TOWN_GAP_M = 1600.0, 150.0, 30.0
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
    """A suburb of equal lots: houses every ``lot_m`` in rows, two to a street, which are ``street_m`` apart;
    the shares of lots with another plan than the common one and of vacant lots; the houses' scatter, m."""

    lot_m: float
    street_m: float
    other_plans: float
    vacant: float
    scatter_m: float


def grid_design(rng: np.random.Generator) -> GridDesign:
    """Any suburb."""
    return GridDesign(
        rng.uniform(17.0, 26.0), rng.uniform(52.0, 68.0), rng.uniform(0.0, 0.3), rng.uniform(0.01, 0.05), 0.3
    )


PLANS_M = ((14.0, 9.0, 0.0), (13.0, 10.0, 0.0), (14.0, 9.0, 4.0))  # width, depth, a garage's side


def _house_plans() -> tuple[FloatArray, FloatArray]:
    """Areas (3,) and shapes (3, 4) of the plans."""
    outlines = [
        shapely.union(shapely.box(0.0, 0.0, wide, deep), shapely.box(0.0, deep - 0.5, side, deep + side))
        for wide, deep, side in PLANS_M
    ]
    found = footprints(np.array(outlines, dtype=object))
    return found.areas_m2, found.shapes


def grid_town(design: GridDesign, at_m: FloatArray, rng: np.random.Generator) -> Buildings:
    """One building of the design, at any heading; two of them differ in vacant lots and plans alone."""
    half = TOWN_M / 2.0
    u, street = np.meshgrid(
        np.arange(-half, half, design.lot_m), np.arange(-half, half, design.street_m), indexing="ij"
    )
    back = 0.24 * design.street_m
    points = np.concatenate(
        [np.column_stack([u.ravel(), (street + side * back).ravel()]) for side in (-1, 1)]
    )
    points = points[rng.random(len(points)) >= design.vacant]
    points += rng.normal(0.0, design.scatter_m, points.shape)
    angle = rng.uniform(-math.pi, math.pi)
    c, s = math.cos(angle), math.sin(angle)
    areas, shapes = _house_plans()
    other = rng.integers(1, len(areas), len(points))
    plan = np.where(rng.random(len(points)) < design.other_plans, other, 0)
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
            for town in range(TOWNS):
                site = self.town_site_m(place, town)
                offset = np.abs(own.centroids_m - site).max(axis=1)
                own = concatenate(
                    [own.select(offset > TOWN_M / math.sqrt(2.0) + TOWN_GAP_M), self.town(place, town)]
                )
        return own

    def town_site_m(self, place: Place, town: int) -> FloatArray:
        """(2,) where a suburb lies: on a ring about the centre, those in no reference as well."""
        reach = 0.55 * 1000.0 * place.radii_km[-1]
        angle = 2.0 * math.pi * (town % TOWNS + 0.3) / TOWNS
        centre = centre_m(place, self.source(place.reference).epsg)
        return np.asarray(centre + reach * np.array([math.cos(angle), math.sin(angle)]))

    def town(self, place: Place, town: int) -> Buildings:
        """A suburb of the place's design; the first TOWNS are those of its reference."""
        design = grid_design(self._rng(place, len(VARIANTS)))
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
