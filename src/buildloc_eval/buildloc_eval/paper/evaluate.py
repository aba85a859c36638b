"""`buildloc eval paper`: ground, flights, maps, predictions, then scores and the report.

Every stage is kept under the output folder, so that a run that is cut off goes on where it was.
"""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from buildloc_mapper.config import MapperConfig
from buildloc_matcher.config import matcher_config
from buildloc_matcher.matching import THREADS
from buildloc_matcher.reference.buildings import Buildings
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.footprint import footprints

from buildloc_eval.observation import Digitiser
from buildloc_eval.paper import brm, methods
from buildloc_eval.paper.differences import AutomaticMapping, Outlines, redrawn, reference_outlines
from buildloc_eval.paper.flights import PaperFlight, flight_config, keyframe_stamps, paper_flights, trajectory
from buildloc_eval.paper.flown import Maps, Track, limit_threads, map_flight, masks, register, shots
from buildloc_eval.paper.methods import BRM, STARS, Prediction
from buildloc_eval.paper.perception import SNOW, PerceptionErrors, perceive
from buildloc_eval.paper.published import LARGE_RADII_KM, RADII_KM
from buildloc_eval.paper.sources import read_boston
from buildloc_eval.paper.store import Store, code_hash
from buildloc_eval.paper.texture import ground_texture
from buildloc_eval.realworld import data_folder

Say = Callable[[str], None]

FLOWN_OVER_M = 900.0  # around a flight's centre: what any of its frames may see
PAPER = "buildloc_eval.paper"
GROUND_CODE = (f"{PAPER}.sources", f"{PAPER}.differences", f"{PAPER}.flights", "buildloc_eval.observation")
TRACK_CODE = (
    "buildloc_mapper", "buildloc_msgs_py", "buildloc_eval.flight", "buildloc_eval.camera",
    "buildloc_eval.places", f"{PAPER}.flights", f"{PAPER}.published", f"{PAPER}.texture", f"{PAPER}.flown",
)  # fmt: skip
MAP_CODE = (*TRACK_CODE, *GROUND_CODE, f"{PAPER}.perception", f"{PAPER}.brm")
PREDICTION_CODE = (
    *MAP_CODE, "buildloc_matcher", "buildloc_eval.generators", "buildloc_eval.scale", f"{PAPER}.methods"
)  # fmt: skip


class PaperError(BuildlocError):
    """The experiments cannot be run as asked."""


@dataclass(frozen=True)
class Plan:
    """What is run: numbers of the paper's flights, seeds of each, radii; of which methods every prefix is
    located, at which radii and for how many seeds."""

    flights: tuple[int, ...]
    seeds: int
    radii_km: tuple[int, ...]
    prefixes: dict[str, tuple[int, ...]]
    prefix_seeds: int


FULL = Plan(
    (1, 2, 3, 4, 5, 6, 7), 10, RADII_KM, {"default preset": LARGE_RADII_KM, "paper preset": (6,)}, 1
)  # fmt: skip
QUICK = Plan((1, 2), 2, (1, 6, 12), {"default preset": (6,)}, 1)


@dataclass(frozen=True)
class Models:
    """Every error that is simulated, and the mapper's parameters."""

    digitiser: Digitiser = field(default_factory=Digitiser)
    automatic: AutomaticMapping = field(default_factory=AutomaticMapping)
    perception: PerceptionErrors = field(default_factory=PerceptionErrors)
    snow: PerceptionErrors = SNOW
    mapper: MapperConfig = field(default_factory=MapperConfig)


class Stores:
    """One folder per stage. Each is refused when an earlier stage's configuration or code has changed."""

    def __init__(self, out: Path, seed: int, models: Models) -> None:
        said = {name: value for name, value in asdict(models).items() if name != "mapper"}
        ground = {"seed": seed, "digitiser": said.pop("digitiser"), "automatic": said.pop("automatic")}
        track = {"seed": seed, "mapper": asdict(models.mapper)}
        matchers = {name: asdict(matcher_config({"preset": name})) for name in ("default", "paper")}
        self.ground = Store(out / "ground", _plain(ground | {"code": code_hash(GROUND_CODE)}))
        self.tracks = Store(out / "tracks", _plain(track | {"code": code_hash(TRACK_CODE)}))
        maps = ground | track | said
        self.maps = Store(out / "maps", _plain(maps | {"code": code_hash(MAP_CODE)}))
        predictions = maps | {"matchers": matchers, "code": code_hash(PREDICTION_CODE)}
        self.predictions = Store(out / "predictions", _plain(predictions))


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """As JSON gives it back: lists for tuples."""
    return dict(json.loads(json.dumps(values)))


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


def ragged(outlines: Outlines) -> tuple[Any, ...]:
    """Outlines as arrays, which are kept and read much faster than objects."""
    return tuple(shapely.to_ragged_array(outlines))


def outlines_of(kept: tuple[Any, ...]) -> Outlines:
    """Outlines kept by :func:`ragged`."""
    return np.asarray(shapely.from_ragged_array(*kept))


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
    ground = ground_texture(data_folder() / "imagery", flight.number, np.random.default_rng([seed, 6]))
    return register(taken, ground, config, models.mapper, seed)


def make_maps(flight: PaperFlight, track: Track, real: tuple[Any, ...], models: Models, seed: int) -> Maps:
    """Draw what is flown over and what the segmenter makes of it, and map it."""
    limit_threads()
    true = redrawn(outlines_of(real), models.digitiser, np.random.default_rng([seed, 7, flight.number]))
    errors = models.snow if flight.like.snow else models.perception

    def perceived(outlines: Outlines, ground: shapely.Polygon, rng: np.random.Generator) -> Any:
        return perceive(outlines, errors, ground, rng)

    seen = masks(track, true, perceived, 1000 * seed + flight.number)
    return map_flight(track, seen, models.mapper)


def side_by_side(
    jobs: Sequence[tuple[str, float, Callable[[], Any]]], store: Store, stage: str, say: Say
) -> None:
    """Make what is not there yet, of jobs (name, cost, how), on all cores; the costliest first."""
    missing = sorted((job for job in jobs if not store.has(job[0])), key=lambda job: -job[1])
    progress = Progress(say, stage, sum(cost for _, cost, _ in missing))
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max(1, min(THREADS, len(missing))), context) as pool:
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


def maps_name(flight: PaperFlight, seed: int) -> str:
    """Of the maps of a flight and a seed."""
    return f"flight{flight.number}_seed{seed}"


def prediction_name(method: str, radius_km: float, flight: PaperFlight, seed: int, prefixes: bool) -> str:
    """Of a prediction, or of those of all prefixes."""
    kind = "prefixes" if prefixes else "whole"
    return f"{kind}_{method.replace(' ', '_')}_{radius_km:g}km_{maps_name(flight, seed)}"


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
    from buildloc_eval.paper.report import write

    plan, models, started = QUICK if quick else FULL, Models(), time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    flights = [flight for flight in paper_flights() if flight.number in plan.flights]
    stores = Stores(out, seed, models)
    make_ground(stores.ground, flights, models, seed, say)
    fly_all(stores, flights, plan, models, seed, say)
    predict_all(stores, flights, plan, seed, say)
    say("scoring")
    return write(out, stores, flights, plan, models, seed, quick, time.perf_counter() - started)
