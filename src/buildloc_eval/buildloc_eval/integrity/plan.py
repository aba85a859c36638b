"""What is tried: grounds of two disjoint sets, and the trial of every number."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass

import numpy as np
from buildloc_matcher.reference.region import Box, Circle, Region
from buildloc_msgs_py.types import FloatArray
from numpy.typing import NDArray

FLIGHT = "flight"  # over ground that the reference holds as it is
CONTROLS = (
    "outside", "another city", "mirrored", "missing", "shifted", "grid suburbs", "snow", "scaled",
)  # fmt: skip
PAPER_EVERY = 31  # not a multiple of how often controls come: every kind has its share
CHUNK = 100  # trials with consecutive numbers are of one region

BUILDINGS = (20, 40, 60, 100, 200)
LEVELS, LEVEL_SHARES = (1, 2, 3), (0.45, 0.40, 0.15)
LARGEST_SHARE = 0.7  # of the radii of a region
SHIFTS_M = (0.0, 1.0)
MISSING = (0.30, 0.45, 0.60)
FAR_SHIFT_M = (5.0, 20.0)
SNOW = (0.30, 0.60)
WRONG_SCALE = 0.10
TOWN_NONE = -1
TOWNS_ALIKE = 4  # grid suburbs of one design
TOWNS = 8 * TOWNS_ALIKE  # set beside a city; as many again are flown over and in no reference

AS_IS, SCATTERED, GRID = "as is", "scattered", "grid"


def missing_variant(share: float) -> str:
    """Name of the reference that lacks a share of its buildings."""
    return f"missing{100.0 * share:.0f}"


VARIANTS = (AS_IS, *map(missing_variant, MISSING), SCATTERED, GRID)


@dataclass(frozen=True)
class Territory:
    """The ground of a set in one source of footprints: what a region holds, but none of ``apart``."""

    regions: tuple[Region, ...]
    apart: tuple[Region, ...] = ()

    def holds(self, centroids_m: FloatArray, epsg: int) -> NDArray[np.bool_]:
        """Which of the points (N, 2) of a UTM zone belong to it."""
        inside = np.any([region.holds(centroids_m, epsg) for region in self.regions], axis=0)
        for region in self.apart:
            inside &= ~region.holds(centroids_m, epsg)
        return np.asarray(inside)


@dataclass(frozen=True)
class Place:
    """A region to be searched: around ``centre_deg`` (latitude, longitude), at one of the radii. Flights are
    over the footprints of ``world``, the reference is of ``reference``; ``outside_km`` is the radius of the
    reference that flights outside of it are tried against. ``registration_m``: standard deviation per axis of
    what the one lies beside the other as a whole, as far as a map reaches."""

    name: str
    city: str
    world: str
    reference: str
    centre_deg: tuple[float, float]
    radii_km: tuple[float, ...]
    outside_km: float
    registration_m: float = 0.0

    @property
    def slug(self) -> str:
        """The name in files."""
        return "".join(c if c.isalnum() else "_" for c in self.name.lower())


@dataclass(frozen=True)
class Plan:
    """A set of places with the territory of every source, ground that no other set touches; every
    ``control_every``-th trial is a negative control."""

    name: str
    control_every: int
    places: tuple[Place, ...]
    territories: dict[str, Territory]


BOSTON, OSM, PLATEAU = "boston_osm", "tokyo_osm", "tokyo_plateau"
FRAMINGHAM, LEXINGTON, BURLINGTON, DOWNTOWN = (
    (42.30, -71.42), (42.447, -71.225), (42.49, -71.20), (42.356, -71.06),
)  # fmt: skip
TESTED = (LEXINGTON, BURLINGTON, DOWNTOWN)
BOSTON_KM, GAP_KM = (3.0, 6.0, 12.0), 0.5
ALL_BOSTON = Box(-72.0, 42.0, -70.5, 43.0)
# The box of Tokyo is halved along a meridian, with 370 m between the halves.
TOKYO_WEST, TOKYO_EAST = Box(139.66, 35.58, 139.703, 35.66), Box(139.707, 35.58, 139.75, 35.66)
TOKYO_KM = (3.0, 5.0)  # the larger holds all of a half
# Mean offsets of the same buildings in cells of 75 m, about what a map covers, over the west: RMS per axis.
TOKYO_REGISTRATION_M = 0.42


def _boston(name: str, centre_deg: tuple[float, float]) -> Place:
    return Place(name, "Boston", BOSTON, BOSTON, centre_deg, BOSTON_KM, BOSTON_KM[-1])


def _tokyo(side: str, half: Box) -> tuple[Place, ...]:
    centre = ((half.south_deg + half.north_deg) / 2.0, (half.west_deg + half.east_deg) / 2.0)
    sources = (("PLATEAU over OSM", PLATEAU, OSM), ("OSM over PLATEAU", OSM, PLATEAU))
    return tuple(
        Place(
            f"Tokyo {side}, {title}", "Tokyo", world, reference, centre, TOKYO_KM, TOKYO_KM[0],
            TOKYO_REGISTRATION_M,
        )
        for title, world, reference in sources
    )  # fmt: skip


CALIBRATION = Plan(
    "calibration",
    2,  # acceptance is calibrated on the wrong candidates of controls, protection levels on flights
    (_boston("Framingham", FRAMINGHAM), *_tokyo("west", TOKYO_WEST)),
    {
        BOSTON: Territory((ALL_BOSTON,), tuple(Circle(*centre, BOSTON_KM[-1] + GAP_KM) for centre in TESTED)),
        OSM: Territory((TOKYO_WEST,)),
        PLATEAU: Territory((TOKYO_WEST,)),
    },
)
TEST = Plan(
    "test",
    5,
    (
        _boston("Lexington", LEXINGTON),
        _boston("Burlington", BURLINGTON),
        _boston("downtown Boston", DOWNTOWN),
        *_tokyo("east", TOKYO_EAST),
    ),
    {
        BOSTON: Territory(tuple(Circle(*centre, BOSTON_KM[-1]) for centre in TESTED)),
        OSM: Territory((TOKYO_EAST,)),
        PLATEAU: Territory((TOKYO_EAST,)),
    },
)
PLANS = {plan.name: plan for plan in (TEST, CALIBRATION)}


@dataclass(frozen=True)
class Trial:
    """One trial: where, of what kind (``detail`` tells which of it), against which reference, the map's
    buildings and the level of its errors, the standard deviation per axis of a shift that all of the
    reference has, m; ``amount`` of what a control does (share, factor or metres);
    ``town``: the suburb flown over, or TOWN_NONE."""

    number: int
    place: Place
    kind: str
    detail: str
    radius_km: float
    variant: str
    buildings: int
    level: int
    shift_m: float
    amount: float
    town: int

    @property
    def control(self) -> bool:
        """Whether it is a negative control."""
        return self.kind != FLIGHT

    @property
    def absent(self) -> bool:
        """Whether the ground flown over is nowhere in the reference: any fix is a false one."""
        return self.kind in ("outside", "another city", "mirrored") or self.detail == "absent"

    @property
    def paper(self) -> bool:
        """Whether the paper's preset is tried on it too."""
        return self.number % PAPER_EVERY == 0


def streams(plan: Plan, seed: int, number: int) -> tuple[np.random.Generator, np.random.Generator]:
    """What draws a trial, and what draws its flight."""
    entropy = [seed, zlib.crc32(plan.name.encode()), number]
    return np.random.default_rng([*entropy, 0]), np.random.default_rng([*entropy, 1])


def trial(plan: Plan, seed: int, number: int) -> Trial:
    """The trial of a number: the same whatever other trials there are."""
    rng, _ = streams(plan, seed, number)
    place = plan.places[number // CHUNK % len(plan.places)]
    *smaller, largest = place.radii_km
    pick, which = rng.random(), rng.random()
    radius = largest if not smaller or pick < LARGEST_SHARE else smaller[int(which * len(smaller))]
    buildings = int(rng.choice(BUILDINGS))
    level = int(rng.choice(LEVELS, p=LEVEL_SHARES))
    shift = float(rng.choice(SHIFTS_M))
    kind, detail, variant, amount, town = FLIGHT, "", AS_IS, 0.0, TOWN_NONE
    if number % plan.control_every == plan.control_every - 1:
        kind = CONTROLS[number // plan.control_every % len(CONTROLS)]
        side = int(rng.integers(2))
        if kind == "outside":
            radius = place.outside_km
        elif kind == "missing":
            amount, radius = float(rng.choice(MISSING)), largest
            detail, variant = f"{100.0 * amount:.0f} % missing", missing_variant(amount)
        elif kind == "shifted":
            amount = rng.uniform(*FAR_SHIFT_M)
            detail = ("by one vector", "each its own way")[side]
            if side:
                radius, variant = largest, SCATTERED
        elif kind == "grid suburbs":
            detail, radius, variant = ("present", "absent")[side], largest, GRID
            town = int(rng.integers(TOWNS)) + TOWNS * side
        elif kind == "snow":
            amount = rng.uniform(*SNOW)
            detail = f"{100.0 * amount:.0f} % false"
        elif kind == "scaled":
            amount = 1.0 + WRONG_SCALE * (1 if side else -1)
            detail = f"by {amount:g}"
    return Trial(number, place, kind, detail, radius, variant, buildings, level, shift, amount, town)


def shift_of(one: Trial, rng: np.random.Generator) -> FloatArray:
    """(2,) m by which the ground lies beside the reference."""
    shift = rng.normal(0.0, one.shift_m, 2)
    if one.kind == "shifted" and one.variant == AS_IS:
        angle = rng.uniform(-math.pi, math.pi)
        shift += one.amount * np.array([math.cos(angle), math.sin(angle)])
    return np.asarray(shift)
