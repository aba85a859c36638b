"""`buildloc eval paper`: ground, flights, maps, predictions, then scores and the report.

Every stage is kept under the output folder, so that a run that is cut off goes on where it was.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from buildloc_matcher.matching import THREADS
from buildloc_matcher.reference.buildings import Buildings
from buildloc_msgs_py.footprint import footprints

from buildloc_eval.paper import brm, methods
from buildloc_eval.paper.differences import redrawn, reference_outlines
from buildloc_eval.paper.flights import PaperFlight, flight_config, keyframe_stamps, paper_flights, trajectory
from buildloc_eval.paper.flown import Maps, Track, limit_threads, map_flight, masks, register, shots
from buildloc_eval.paper.methods import BRM, STARS, Prediction
from buildloc_eval.paper.plan import (
    FULL,
    QUICK,
    Models,
    Plan,
    Stores,
    maps_name,
    measured_models,
    outlines_of,
    prediction_name,
    ragged,
)
from buildloc_eval.paper.report import write
from buildloc_eval.paper.sources import read_boston
from buildloc_eval.paper.store import Store
from buildloc_eval.paper.texture import ground_texture
from buildloc_eval.realworld import data_folder
from buildloc_eval.segmentation_errors import Outlines

Say = Callable[[str], None]

FLOWN_OVER_M = 900.0  # around a flight's centre: what any of its frames may see


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


def make_ground(store: Store, flights: Sequence[PaperFlight], models: Models, seed: int, say: Say) -> None:
    """Keep the reference (outlines and measured buildings) and the real outlines around every flight."""
    names = [f"flight{flight.number}" for flight in flights]
    if store.has("reference") and all(store.has(name) for name in names):
        return
    say("reading the footprints of greater Boston")
    real = read_boston()
    centres = shapely.get_coordinates(shapely.centroid(real))
    for name, flight in zip(names, flights, strict=True):
        near = np.hypot(*(centres - flight.centre_m).T) <= FLOWN_OVER_M
        store.save(name, ragged(real[near]))
    if not store.has("reference"):
        say("making the reference of them")
        rng = np.random.default_rng([seed, 5])
        reference = reference_outlines(real, models.digitiser, models.automatic, rng)
        measured = footprints(reference)
        buildings = Buildings(
            measured.centroids_m, measured.areas_m2.astype(np.float32), measured.shapes.astype(np.float32)
        )
        store.save("reference", (ragged(reference), buildings))


def make_track(flight: PaperFlight, models: Models, seed: int) -> Track:
    """Fly over textured ground and register every keyframe."""
    limit_threads()
    config = flight_config(flight.like)
    flown = trajectory(flight, seed)
    taken = shots(flown, keyframe_stamps(flight, flown).tolist(), config, seed)
    ground = ground_texture(data_folder(), flight, np.random.default_rng([seed, 6]))
    return register(taken, ground, config, models.mapper, seed)


def make_maps(flight: PaperFlight, track: Track, real: tuple[Any, ...], models: Models, seed: int) -> Maps:
    """Draw what is flown over and what the segmenter makes of it, and map it."""
    limit_threads()
    true = redrawn(outlines_of(real), models.digitiser, np.random.default_rng([seed, 7, flight.number]))
    seen = masks(track, true, models.errors(flight), 1000 * seed + flight.number)
    return map_flight(track, seen, models.mapper)


def side_by_side(
    jobs: Sequence[tuple[str, float, Callable[[], Any]]], store: Store, stage: str, say: Say
) -> None:
    """Make what is not there yet, of jobs (name, cost, how), on all cores; the costliest first."""
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


def fly_all(
    stores: Stores, flights: Sequence[PaperFlight], plan: Plan, models: Models, seed: int, say: Say
) -> None:
    """Tracks of all flights, then their maps for all seeds."""
    side_by_side(
        [
            (f"flight{f.number}", f.like.keyframes, partial(make_track, f, models, seed)) for f in flights
        ],
        stores.tracks, "registering keyframes", say,
    )  # fmt: skip
    for flight in flights:
        track, real = (store.load(f"flight{flight.number}") for store in (stores.tracks, stores.ground))
        jobs = [
            (maps_name(flight, s), 1.0, partial(make_maps, flight, track, real, models, s))
            for s in range(seed, seed + plan.seeds)
        ]
        side_by_side(jobs, stores.maps, f"mapping flight {flight.number}", say)


@dataclass(frozen=True)
class Query:
    """A prediction to be made."""

    method: str
    radius_km: int
    flight: PaperFlight
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


def queries(flight: PaperFlight, plan: Plan, seed: int) -> Iterator[Query]:
    """Everything that a plan asks of one flight, by radius and then method."""
    for radius in plan.radii_km:
        for name in STARS:
            for s in range(seed, seed + plan.seeds):
                yield Query(name, radius, flight, s, prefixes=False)
            if radius in plan.prefixes.get(name, ()):
                for s in range(seed, seed + plan.prefix_seeds):
                    yield Query(name, radius, flight, s, prefixes=True)


def predict_all(stores: Stores, flights: Sequence[PaperFlight], plan: Plan, seed: int, say: Say) -> None:
    """Every prediction that is not there yet."""
    asked = [query for flight in flights for query in queries(flight, plan, seed)]
    missing = [query for query in asked if not stores.predictions.has(query.name)]
    kept, buildings = stores.ground.load("reference")
    progress = Progress(say, "locating", sum(query.cost for query in missing))
    for flight in flights:
        centre = np.array(flight.centre_m)
        for radius in plan.radii_km:
            here = [q for q in missing if q.flight == flight and q.radius_km == radius]
            if not here:
                continue
            database = methods.reference_within(buildings, centre, radius)
            for name in dict.fromkeys(q.method for q in here):
                matcher = methods.make_matcher(name, database)
                for query in (q for q in here if q.method == name):
                    maps = stores.maps.load(maps_name(flight, query.seed))
                    count = len(maps.snapshots)
                    found: Prediction | list[Prediction]
                    if query.prefixes:
                        found = [methods.locate(matcher, maps, n, final=False) for n in range(1, count + 1)]
                    else:
                        found = methods.locate(matcher, maps, count, final=True)
                    stores.predictions.save(query.name, found)
                    progress.step(query.name, query.cost)
    predict_brm(stores, flights, plan, seed, outlines_of(kept), say)


def predict_brm(
    stores: Stores, flights: Sequence[PaperFlight], plan: Plan, seed: int, reference: Outlines, say: Say
) -> None:
    """BRM once per flight and seed, in the largest radius; the others are parts of it."""
    store, centres = stores.predictions, shapely.get_coordinates(shapely.centroid(reference))
    progress = Progress(say, "BRM", len(flights) * plan.seeds)
    for flight in flights:
        centre, largest = np.array(flight.centre_m), max(plan.radii_km)
        ratios: brm.RatioMap | None = None
        for s in range(seed, seed + plan.seeds):
            asked = {
                radius: prediction_name(BRM, radius, flight, s, prefixes=False) for radius in plan.radii_km
            }
            if not all(store.has(name) for name in asked.values()):
                maps = stores.maps.load(maps_name(flight, s))
                if ratios is None:
                    near = np.hypot(*(centres - centre).T) <= 1000.0 * largest
                    ratios = brm.ratio_map(reference[near], centre, 1000.0 * largest, maps.radii_m)
                found, seconds = methods.brm_survivors(ratios, maps)
                for radius, name in asked.items():
                    store.save(name, methods.brm_prediction(found, seconds, centre, radius))
            progress.step(maps_name(flight, s))


def evaluate(out: Path, seed: int, quick: bool, say: Say) -> str:
    """Run what is not there yet, score everything, write report.json and report.html; the summary.

    Raises StaleError when the folder holds results of another configuration or code.
    """
    plan, models, started = QUICK if quick else FULL, measured_models(), time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    flights = [flight for flight in paper_flights() if flight.number in plan.flights]
    stores = Stores(out, seed, models)
    make_ground(stores.ground, flights, models, seed, say)
    fly_all(stores, flights, plan, models, seed, say)
    predict_all(stores, flights, plan, seed, say)
    say("scoring")
    return write(out, stores, flights, plan, models, seed, quick, time.perf_counter() - started)
