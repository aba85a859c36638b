"""What the flights of all parts go through: jobs side by side, and maps located within a search area."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Any

from buildloc_matcher.matching import THREADS
from buildloc_matcher.reference.buildings import Buildings
from buildloc_msgs_py.types import FloatArray

from buildloc_eval.paper import methods
from buildloc_eval.paper.flights import Flight
from buildloc_eval.paper.methods import STARS, Prediction
from buildloc_eval.paper.plan import Plan, Stores, maps_name, prediction_name
from buildloc_eval.paper.store import Store

Say = Callable[[str], None]
Job = tuple[str, float, Callable[[], Any]]  # name of the result, cost, how it is made


class Progress:
    """Tells how far a stage is and how long it will still take."""

    def __init__(self, say: Say, stage: str, total: float) -> None:
        self._say, self._stage, self._total, self._done = say, stage, total, 0.0
        self._started = self._told = time.monotonic()

    def step(self, name: str, amount: float = 1.0) -> None:
        """So much of it is done."""
        self._done += amount
        now = time.monotonic()
        if now - self._told < 5.0 and self._done < self._total:
            return
        self._told, spent = now, now - self._started
        left = spent / self._done * (self._total - self._done)
        self._say(
            f"{self._stage}: {100.0 * self._done / self._total:.0f} %, {left / 60.0:.1f} min left ({name})"
        )


def side_by_side(jobs: Sequence[Job], store: Store, stage: str, say: Say) -> None:
    """Make what is not there yet on all cores; the costliest first."""
    missing = sorted((job for job in jobs if not store.has(job[0])), key=lambda job: -job[1])
    if not missing:
        return
    progress = Progress(say, stage, sum(cost for _, cost, _ in missing))
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(THREADS, len(missing)), context) as pool:
        running = {pool.submit(make): (name, cost) for name, cost, make in missing}
        for done in as_completed(running):
            name, cost = running[done]
            store.save(name, done.result())
            progress.step(name, cost)


@dataclass(frozen=True)
class Query:
    """A prediction to be made."""

    method: str
    radius_km: int
    flight: Flight
    seed: int
    prefixes: bool

    @property
    def name(self) -> str:
        """Of its file."""
        return prediction_name(self.method, self.radius_km, self.flight, self.seed, self.prefixes)

    @property
    def cost(self) -> float:
        """Relative."""
        return float(self.flight.like.keyframes) if self.prefixes else 1.0


def queries(flight: Flight, plan: Plan, seed: int) -> Iterator[Query]:
    """Everything that a plan asks the star methods of one flight, by radius and then method."""
    for radius in plan.radii_km:
        for name in (n for n in STARS if n in plan.methods):
            for s in range(seed, seed + plan.seeds):
                yield Query(name, radius, flight, s, prefixes=False)
            if radius in plan.prefixes.get(name, ()):
                for s in range(seed, seed + plan.prefix_seeds):
                    yield Query(name, radius, flight, s, prefixes=True)


@dataclass(frozen=True)
class Area:
    """Where flights are looked for: measured buildings and the centre (2,) of the search, metres of a UTM
    zone."""

    buildings: Buildings
    centre_m: FloatArray
    epsg: int


@dataclass(frozen=True)
class Search:
    """Seeds of a flight that are looked for in the same area, which is made when it is needed."""

    flight: Flight
    seeds: Sequence[int]
    area: Callable[[], Area]


def predict(stores: Stores, searches: Sequence[Search], plan: Plan, seed: int, say: Say) -> None:
    """The star methods' predictions that are not there yet."""
    asked = [
        [
            q
            for q in queries(search.flight, plan, seed)
            if q.seed in search.seeds and not stores.predictions.has(q.name)
        ]
        for search in searches
    ]
    progress = Progress(say, "locating", sum(query.cost for some in asked for query in some))
    for search, some in zip(searches, asked, strict=True):
        if some:
            locate_all(stores, search.area(), some, progress)


def locate_all(stores: Stores, area: Area, asked: Sequence[Query], progress: Progress) -> None:
    """Predictions within one area: its database is made once for a radius, a matcher once for a method."""
    for radius in dict.fromkeys(query.radius_km for query in asked):
        here = [query for query in asked if query.radius_km == radius]
        database = methods.reference_within(area.buildings, area.centre_m, radius, area.epsg)
        for name in dict.fromkeys(query.method for query in here):
            matcher = methods.make_matcher(name, database)
            for query in (q for q in here if q.method == name):
                maps = stores.maps.load(maps_name(query.flight, query.seed))
                count = len(maps.snapshots)
                found: Prediction | list[Prediction]
                if query.prefixes:
                    found = [methods.locate(matcher, maps, n, final=False) for n in range(1, count + 1)]
                else:
                    found = methods.locate(matcher, maps, count, final=True)
                stores.predictions.save(query.name, found)
                progress.step(query.name, query.cost)
