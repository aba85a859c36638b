"""What the flights of all parts go through: jobs side by side, and maps located within a search area."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
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
    for name, made in run_all([job for job in jobs if not store.has(job[0])], stage, say):
        store.save(name, made)


def run_all(jobs: Sequence[Job], stage: str, say: Say) -> Iterator[tuple[str, Any]]:
    """Results by name, as they are finished, of jobs on all cores; the costliest first."""
    if not jobs:
        return
    progress = Progress(say, stage, sum(cost for _, cost, _ in jobs))
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(THREADS, len(jobs)), context) as pool:
        running = {
            pool.submit(make): (name, cost) for name, cost, make in sorted(jobs, key=lambda job: -job[1])
        }
        for done in as_completed(running):
            name, cost = running[done]
            yield name, done.result()
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
            for s in range(seed, seed + plan.prefixes.get(name, {}).get(radius, 0)):
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
    jobs: list[Job] = []
    for search in searches:
        asked = [
            query
            for query in queries(search.flight, plan, seed)
            if query.seed in search.seeds and not stores.predictions.has(query.name)
        ]
        for radius in dict.fromkeys(query.radius_km for query in asked):
            here = tuple(query for query in asked if query.radius_km == radius)
            name = f"{search.flight.name}, {radius} km"
            jobs.append((name, sum(q.cost for q in here), partial(locate_all, stores, search.area, here)))
    for _ in run_all(jobs, "locating", say):
        pass  # every prediction is kept as soon as it is made


def locate_all(stores: Stores, where: Callable[[], Area], asked: Sequence[Query]) -> None:
    """Predictions within one radius of an area: its database is made once, a matcher once for a method."""
    area = where()
    database = methods.reference_within(area.buildings, area.centre_m, asked[0].radius_km, area.epsg)
    for name in dict.fromkeys(query.method for query in asked):
        matcher = methods.make_matcher(name, database)
        for query in (q for q in asked if q.method == name):
            maps = stores.maps.load(maps_name(query.flight, query.seed))
            count = len(maps.snapshots)
            found: Prediction | list[Prediction]
            if query.prefixes:
                found = [methods.locate(matcher, maps, n, final=False) for n in range(1, count + 1)]
            else:
                found = methods.locate(matcher, maps, count, final=True)
            stores.predictions.save(query.name, found)
