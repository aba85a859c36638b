"""Flights over Tokyo between two digitisers: over the outlines of one, looked for among those of the other.

Metres are of the UTM zone of Tokyo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import shapely
from buildloc_matcher.reference.buildings import Buildings
from buildloc_msgs_py.types import FloatArray

from buildloc_eval.paper.flights import Course
from buildloc_eval.paper.flown import Maps, Track, fly_textured, limit_threads, map_flight, masks
from buildloc_eval.paper.plan import Models, Plan, Stores, maps_name, outlines_of, ragged
from buildloc_eval.paper.sources import measure, read_outlines
from buildloc_eval.paper.stages import Area, Say, Search, predict, side_by_side
from buildloc_eval.paper.store import Store
from buildloc_eval.realworld import data_folder

EPSG = 32654
SOURCES = {
    "plateau": "footprints/tokyo_plateau.parquet",
    "osm": "footprints/tokyo_osm.parquet",
}
PAIRS = (("plateau", "osm"), ("osm", "plateau"))  # flown over, reference
RADIUS_KM = 5
BORDER_M = 2500.0  # a flight is no nearer to the end of the data
APART_M = 1000.0  # between flights
FLOWN_OVER_M = 900.0
CODE = ("buildloc_eval.paper.tokyo",)


@dataclass(frozen=True)
class Dense:
    """A flight that sees some hundred buildings of a dense city."""

    length_km: float = 1.2
    altitude_m: float = 105.0
    keyframes: int = 49  # one every five seconds at 5 m/s


@dataclass(frozen=True)
class TokyoFlight:
    """Over the outlines of ``world`` about a centre, looked for among those of ``reference``."""

    number: int
    centre_m: tuple[float, float]
    world: str
    reference: str
    like: Course = Dense()

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.track}_over_{self.world}"

    @property
    def track(self) -> str:
        """Of its registered keyframes, which see the ground's texture alone."""
        return f"tokyo{self.number}"


# What choose() finds in the footprints of tokyo_osm.parquet with seed 1.
CENTRES_M = (
    (382929.6, 3943539.3),
    (383397.1, 3940607.2),
    (383681.6, 3942052.1),
    (381657.1, 3942983.2),
    (382233.8, 3941367.7),
)


def choose(centroids_m: FloatArray, seed: int, flights: int = 5) -> tuple[tuple[float, float], ...]:
    """Centres of flights: buildings (N, 2) that a seed draws, apart from the border and from each other."""
    low, high = centroids_m.min(axis=0) + BORDER_M, centroids_m.max(axis=0) - BORDER_M
    inside = centroids_m[np.all((centroids_m >= low) & (centroids_m <= high), axis=1)]
    chosen = np.empty((0, 2))
    for place in inside[np.random.default_rng(seed).permutation(len(inside))]:
        if len(chosen) < flights and (np.hypot(*(chosen - place).T) > APART_M).all():
            chosen = np.vstack([chosen, place])
    return tuple((round(float(x), 1), round(float(y), 1)) for x, y in chosen)


def tokyo_flights() -> tuple[TokyoFlight, ...]:
    """Every centre both ways round."""
    return tuple(
        TokyoFlight(number, centre, world, reference)
        for number, centre in enumerate(CENTRES_M, start=1)
        for world, reference in PAIRS
    )


FULL = Plan(
    tuple(flight.name for flight in tokyo_flights()), 10, (RADIUS_KM,), {"default preset": {RADIUS_KM: 1}},
    ("paper preset", "default preset"),
)  # fmt: skip
QUICK = Plan(FULL.flights[:1], 1, (RADIUS_KM,), {}, FULL.methods)


def make_ground(store: Store, flights: Sequence[TokyoFlight], say: Say) -> None:
    """Keep each reference (outlines and measured buildings) and the outlines below every flight."""
    for source, path in SOURCES.items():
        below = {f.name: f for f in flights if f.world == source and not store.has(f.name)}
        wanted = any(f.reference == source for f in flights) and not store.has(source)
        if not (below or wanted):
            continue
        say(f"reading the footprints of Tokyo: {source}")
        outlines = read_outlines(data_folder() / path, EPSG)
        centres = shapely.get_coordinates(shapely.centroid(outlines))
        for name, flight in below.items():
            store.save(name, ragged(outlines[np.hypot(*(centres - flight.centre_m).T) <= FLOWN_OVER_M]))
        if wanted:
            store.save(source, (ragged(outlines), measure(outlines)))


def make_maps(flight: TokyoFlight, track: Track, real: tuple[Any, ...], models: Models, seed: int) -> Maps:
    """What the segmenter makes of the outlines as they are, mapped."""
    limit_threads()
    seen = masks(track, outlines_of(real), models.segmentation, 1000 * seed + flight.number)
    return map_flight(track, seen, models.mapper)


def area(buildings: Buildings, flight: TokyoFlight) -> Area:
    """The reference about a flight."""
    return Area(buildings, np.array(flight.centre_m), EPSG)


def run(
    stores: Stores, flights: Sequence[TokyoFlight], plan: Plan, models: Models, seed: int, say: Say
) -> None:
    """Every stage of what is not there yet."""
    make_ground(stores.ground, flights, say)
    tracks = {flight.track: flight for flight in flights}
    side_by_side(
        [(n, f.like.keyframes, partial(fly_textured, f, models.mapper, seed)) for n, f in tracks.items()],
        stores.tracks, "Tokyo: registering keyframes", say,
    )  # fmt: skip
    seeds = range(seed, seed + plan.seeds)
    for flight in flights:
        track, below = stores.tracks.load(flight.track), stores.ground.load(flight.name)
        jobs = [
            (maps_name(flight, s), 1.0, partial(make_maps, flight, track, below, models, s)) for s in seeds
        ]
        side_by_side(jobs, stores.maps, f"mapping {flight.name}", say)
    measured = {
        source: stores.ground.load(source)[1] for source in dict.fromkeys(f.reference for f in flights)
    }
    predict(
        stores, [Search(f, seeds, partial(area, measured[f.reference], f)) for f in flights], plan, seed, say
    )
