"""Seven flights over greater Boston that mirror the paper's, each where a seeded rule puts it.

Metres are of the UTM zone of the footprints.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import FloatArray
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from buildloc_eval.flight import FlightConfig, Trajectory, fly, margin_m
from buildloc_eval.paper.published import FLIGHTS, LARGE_RADII_KM, PublishedFlight

EPSG = 32619
KEYFRAME_PERIOD_S = 5.0  # of the keyframe policy: the paper's keyframes then give the ground speed
LEG_M, SPACING_M = 450.0, 100.0  # swaths of 140 m overlap by a third
HALF_SWATH_M = 55.0  # of the path, within which a building is seen whole more than once
SLACK_M = 25.0
SITES = 1500  # places that the rule looks at
APART_M = 2000.0  # between flights
MIN_AREA_M2 = 20.0
HOUSE_M2, HALL_M2 = 250.0, 1000.0  # footprints: single-family below, commercial above, between: residential


class SiteError(BuildlocError):
    """No place is left for a flight."""


class Course(Protocol):
    """How far is flown, how high, and with how many keyframes."""

    @property
    def length_km(self) -> float:
        """Of the path."""

    @property
    def altitude_m(self) -> float:
        """Above ground."""

    @property
    def keyframes(self) -> int:
        """Their number, or about."""


class Flight(Protocol):
    """A flight of any part of the experiments."""

    @property
    def name(self) -> str:
        """Of its files."""

    @property
    def like(self) -> Course:
        """What is flown."""


class PlacedFlight(Flight, Protocol):
    """A flight whose place is the same for every seed."""

    @property
    def number(self) -> int:
        """Tells the flights of a part apart."""

    @property
    def centre_m(self) -> tuple[float, float]:
        """East and north."""


@dataclass(frozen=True)
class PaperFlight:
    """A row of the paper's flight table, flown over ``centre_m`` (east, north)."""

    like: PublishedFlight
    centre_m: tuple[float, float]

    @property
    def number(self) -> int:
        """That of the paper."""
        return self.like.number

    @property
    def name(self) -> str:
        """Of its files."""
        return f"flight{self.number}"


# What choose() finds in the footprints of boston_osm.parquet with seed 1.
CENTRES_M = (
    (311190.1, 4685820.6),
    (316173.0, 4685837.9),
    (313452.5, 4704748.8),
    (323456.5, 4687847.5),
    (319438.3, 4691645.5),
    (325603.4, 4685251.0),
    (332100.9, 4694866.5),
)


def flight_config(like: Course) -> FlightConfig:
    """Camera of a DJI Mini 4K at reduced resolution; the speed that makes the number of keyframes."""
    length = 1000.0 * like.length_km
    return FlightConfig(
        length_m=length, leg_m=(length - (_legs(like) - 1) * SPACING_M) / _legs(like),
        spacing_m=SPACING_M, altitude_m=like.altitude_m,
        speed_mps=length / ((like.keyframes - 1) * KEYFRAME_PERIOD_S),
        rate_hz=1.0 / KEYFRAME_PERIOD_S, width=960, height=540,
    )  # fmt: skip


def _legs(like: Course) -> int:
    return max(1, round(1000.0 * like.length_km / (LEG_M + SPACING_M)))


def trajectory(flight: PlacedFlight, seed: int) -> Trajectory:
    """Legs back and forth about the centre; what the wind does is by the seed."""
    config = flight_config(flight.like)
    margin = margin_m(config) + SLACK_M
    half_width = config.leg_m / 2.0 + margin
    half_height = (_legs(flight.like) - 1) * config.spacing_m / 2.0 + margin
    x, y = flight.centre_m
    reach = (max(half_width, half_height), half_height)  # legs run along the longer side: east and west
    return fly((x - reach[0], y - reach[1], x + reach[0], y + reach[1]), config, seed)


def keyframe_stamps(flight: Flight, flown: Trajectory) -> NDArray[np.int64]:
    """(N,) as many as the flight is to have, evenly over it."""
    first, last = int(flown.stamps_ns[0]), int(flown.stamps_ns[-1])
    return np.linspace(first, last, flight.like.keyframes).astype(np.int64)


def environment(areas_m2: FloatArray) -> FloatArray:
    """(3,) shares of the built ground under halls (C), houses (S) and what is between (R)."""
    halls, houses = areas_m2 > HALL_M2, areas_m2 < HOUSE_M2
    parts = [areas_m2[halls].sum(), areas_m2[houses].sum(), areas_m2[~halls & ~houses].sum()]
    return np.asarray(np.array(parts) / max(sum(parts), 1e-9))


def wanted_environment(letters: str) -> FloatArray:
    """(3,) equal shares of the kinds that a row of the paper's table names."""
    named = np.array([kind in letters.split("+") for kind in "CSR"], dtype=np.float64)
    return np.asarray(named / named.sum())


def unlikeness(
    like: PublishedFlight, site_m: FloatArray, reference: FloatArray, tree: cKDTree, areas_m2: FloatArray
) -> float:
    """How far a site is from what the paper flew over: logarithms of the reference's sizes (3,) and of the
    buildings seen, shares of the environment."""
    path = trajectory(PaperFlight(like, (float(site_m[0]), float(site_m[1]))), seed=1).xy_m[::50]
    seen = np.unique(np.concatenate(tree.query_ball_point(path, HALF_SWATH_M)).astype(np.int64))
    if not len(seen):
        return math.inf
    sizes = np.abs(np.log(reference / np.array(like.reference))).mean()
    detected = abs(math.log(len(seen) / like.detected))
    kinds = np.abs(environment(areas_m2[seen]) - wanted_environment(like.environment)).sum()
    return float(sizes + 0.5 * detected + 0.5 * kinds)


def choose(
    centroids_m: FloatArray,
    areas_m2: FloatArray,
    seed: int,
    likes: Sequence[PublishedFlight] = FLIGHTS,
    sites: int = SITES,
) -> tuple[PaperFlight, ...]:
    """For every flight of the paper, one after the other, the site most like its own of those that the seed
    draws among the buildings (N, 2) and that are 2 km from the sites taken.

    Raises SiteError when no site is left.
    """
    large = areas_m2 >= MIN_AREA_M2
    points, areas = centroids_m[large], areas_m2[large]
    tree = cKDTree(points)
    rng = np.random.default_rng(seed)
    inside = np.all(
        (points >= points.min(axis=0) + APART_M) & (points <= points.max(axis=0) - APART_M), axis=1
    )
    drawn = points[rng.permutation(np.flatnonzero(inside))[:sites]]
    sizes = np.column_stack(
        [tree.query_ball_point(drawn, 1e3 * km, return_length=True) for km in LARGE_RADII_KM]
    )
    free = np.ones(len(drawn), dtype=bool)
    chosen = []
    for like in likes:
        costs = [
            unlikeness(like, site, size, tree, areas) if is_free else math.inf
            for site, size, is_free in zip(drawn, sizes, free, strict=True)
        ]
        if not len(costs) or not math.isfinite(min(costs)):
            raise SiteError(f"no site is left for flight {like.number}; give a larger city")
        site = drawn[int(np.argmin(costs))]
        free &= np.hypot(*(drawn - site).T) > APART_M
        chosen.append(PaperFlight(like, (round(float(site[0]), 1), round(float(site[1]), 1))))
    return tuple(chosen)


def paper_flights() -> tuple[PaperFlight, ...]:
    """The seven flights, where :func:`choose` has put them once."""
    return tuple(PaperFlight(like, centre) for like, centre in zip(FLIGHTS, CENTRES_M, strict=True))
