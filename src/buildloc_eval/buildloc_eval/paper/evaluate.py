"""`buildloc eval paper`: ground, flights, maps, predictions, then scores and the report.

Every stage is kept under the output folder, so that a run that is cut off goes on where it was.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from buildloc_matcher.reference.buildings import Buildings
from buildloc_msgs_py.types import Mask

from buildloc_eval.paper import brm, methods, real, tokyo
from buildloc_eval.paper.chapters import real_imagery, two_digitisers
from buildloc_eval.paper.differences import redrawn, reference_outlines
from buildloc_eval.paper.flights import (
    EPSG,
    PaperFlight,
    paper_flights,
)
from buildloc_eval.paper.flown import Maps, Track, fly_textured, limit_threads, map_flight, masks
from buildloc_eval.paper.methods import BRM
from buildloc_eval.paper.netvlad import NETVLAD, Encoders, load_encoders
from buildloc_eval.paper.plan import (
    FULL,
    QUICK,
    Models,
    Plan,
    Stores,
    maps_name,
    measured_models,
    outlines_of,
    ragged,
    whole_names,
)
from buildloc_eval.paper.report import Chapter, boston, write
from buildloc_eval.paper.retrieval import predict_netvlad
from buildloc_eval.paper.sources import measure, read_boston
from buildloc_eval.paper.stages import Area, Job, Say, Search, predict, run_all, side_by_side
from buildloc_eval.paper.store import Store

PARTS = ("boston", "tokyo", "real")
FLOWN_OVER_M = 900.0  # around a flight's centre: what any of its frames may see


def make_ground(store: Store, flights: Sequence[PaperFlight], models: Models, seed: int, say: Say) -> None:
    """Keep the reference (outlines and measured buildings) and the real outlines around every flight."""
    names = [flight.name for flight in flights]
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
        store.save("reference", (ragged(reference), measure(reference)))


def draw_masks(
    flight: PaperFlight, track: Track, real: tuple[Any, ...], models: Models, seed: int
) -> Iterator[Mask]:
    """Draw what is flown over and what the segmenter makes of it: the same masks for the same seed."""
    true = redrawn(outlines_of(real), models.digitiser, np.random.default_rng([seed, 7, flight.number]))
    return masks(track, true, models.errors(flight), 1000 * seed + flight.number)


def make_maps(flight: PaperFlight, track: Track, real: tuple[Any, ...], models: Models, seed: int) -> Maps:
    """Map what the segmenter makes of a flight."""
    limit_threads()
    return map_flight(track, draw_masks(flight, track, real, models, seed), models.mapper)


def fly_all(
    stores: Stores, flights: Sequence[PaperFlight], plan: Plan, models: Models, seed: int, say: Say
) -> None:
    """Tracks of all flights, then their maps for all seeds."""
    side_by_side(
        [
            (flight.name, flight.like.keyframes, partial(fly_textured, flight, models.mapper, seed))
            for flight in flights
        ],
        stores.tracks, "registering keyframes", say,
    )  # fmt: skip
    for flight in flights:
        track, real = (store.load(flight.name) for store in (stores.tracks, stores.ground))
        jobs = [
            (maps_name(flight, s), 1.0, partial(make_maps, flight, track, real, models, s))
            for s in range(seed, seed + plan.seeds)
        ]
        side_by_side(jobs, stores.maps, f"mapping {flight.name}", say)


def city(buildings: Buildings, flight: PaperFlight) -> Area:
    """The reference about a flight."""
    return Area(buildings, np.array(flight.centre_m), EPSG)


def predict_all(stores: Stores, flights: Sequence[PaperFlight], plan: Plan, seed: int, say: Say) -> None:
    """Every prediction that is not there yet."""
    _, buildings = stores.ground.load("reference")
    seeds = range(seed, seed + plan.seeds)
    searches = [Search(flight, seeds, partial(city, buildings, flight)) for flight in flights]
    predict(stores, searches, plan, seed, say)
    predict_brm(stores, flights, plan, seed, say)


def predict_brm(stores: Stores, flights: Sequence[PaperFlight], plan: Plan, seed: int, say: Say) -> None:
    """BRM's predictions that are not there yet."""

    def lacks(flight: PaperFlight, s: int) -> bool:
        names = whole_names(BRM, flight, s, plan.radii_km).values()
        return not all(stores.predictions.has(name) for name in names)

    asked = {flight: [s for s in range(seed, seed + plan.seeds) if lacks(flight, s)] for flight in flights}
    jobs: list[Job] = [
        (flight.name, float(len(seeds)), partial(locate_brm, stores, flight, seeds, plan.radii_km))
        for flight, seeds in asked.items()
        if seeds
    ]
    for _ in run_all(jobs, BRM, say):
        pass  # every prediction is kept as soon as it is made


def locate_brm(stores: Stores, flight: PaperFlight, seeds: Sequence[int], radii_km: Sequence[int]) -> None:
    """A flight once per seed, in the largest radius; the others are parts of it."""
    limit_threads()
    reference = outlines_of(stores.ground.load("reference")[0])
    centre, largest_m = np.array(flight.centre_m), 1000.0 * max(radii_km)
    away = np.hypot(*(shapely.get_coordinates(shapely.centroid(reference)) - centre).T)
    regions_m = stores.maps.load(maps_name(flight, seeds[0])).radii_m  # the same for all seeds
    ratios = brm.ratio_map(reference[away <= largest_m], centre, largest_m, regions_m)
    for s in seeds:
        found, seconds = methods.brm_survivors(ratios, stores.maps.load(maps_name(flight, s)))
        for radius, name in whole_names(BRM, flight, s, radii_km).items():
            stores.predictions.save(name, methods.brm_prediction(found, seconds, centre, radius))


def boston_part(
    out: Path, seed: int, quick: bool, models: Models, encoders: Encoders | None, say: Say
) -> Chapter:
    """The paper's seven flights."""
    plan = QUICK if quick else FULL
    flights = [flight for flight in paper_flights() if flight.name in plan.flights]
    stores = Stores(out, seed, models, networks=encoders.digest if encoders else None)
    make_ground(stores.ground, flights, models, seed, say)
    fly_all(stores, flights, plan, models, seed, say)
    predict_all(stores, flights, plan, seed, say)
    if encoders:

        def seen_by(flight: PaperFlight, s: int) -> Iterator[Mask]:
            track, real = (store.load(flight.name) for store in (stores.tracks, stores.ground))
            return draw_masks(flight, track, real, models, s)

        kept, _ = stores.ground.load("reference")
        predict_netvlad(stores, flights, plan, seed, outlines_of(kept), encoders, seen_by, say)
        plan = replace(plan, methods=(NETVLAD, *plan.methods))
    return boston(out, stores, flights, plan, models, seed)


def tokyo_part(out: Path, seed: int, quick: bool, models: Models, say: Say) -> Chapter:
    """Two digitisers."""
    plan = tokyo.QUICK if quick else tokyo.FULL
    flights = [flight for flight in tokyo.tokyo_flights() if flight.name in plan.flights]
    stores = Stores(out / "tokyo", seed, models, code=tokyo.CODE)
    tokyo.run(stores, flights, plan, models, seed, say)
    return two_digitisers(out / "tokyo", stores, flights, plan, models, seed)


def real_part(
    out: Path, seed: int, quick: bool, models: Models, networks: Mapping[str, str], say: Say
) -> Chapter:
    """Real imagery."""
    plan = real.QUICK if quick else real.FULL
    planned = [flight for flight in (*real.FLIGHTS, real.SHORT) if flight.name in plan.flights]
    found, left_out = real.networks(planned, networks)
    flights = [flight for flight in planned if flight.place in found]
    city, stores = cache(real.read_city), dict[str, Stores]()
    for flight in flights:
        network = found[flight.place]
        stores[flight.name] = real.stores_for(out, flight, network, models, seed)
        real.run(stores[flight.name], flight, network, city, plan, models, seed, say)
    pictures = out / "real"
    pictures.mkdir(exist_ok=True)
    return real_imagery(pictures, stores, flights, found, left_out, plan, seed)


def evaluate(
    out: Path,
    seed: int,
    quick: bool,
    say: Say,
    parts: Sequence[str] = PARTS,
    networks: Mapping[str, str] | None = None,
    netvlad: Path | None = None,
) -> str:
    """Run what is not there yet of some parts, score it, write report.json and report.html; the summary.

    ``networks``: ONNX files by the place of real imagery that they are for. ``netvlad``: folder of that
    method's networks; it is left out without. Raises StaleError when the folder holds results of another
    configuration or code, EvaluationError for a network that knows its ground, NetVladError.
    """
    models, started = measured_models(), time.perf_counter()
    encoders = load_encoders(netvlad) if netvlad else None
    out.mkdir(parents=True, exist_ok=True)
    made: dict[str, Callable[[], Chapter]] = {
        "boston": partial(boston_part, out, seed, quick, models, encoders, say),
        "tokyo": partial(tokyo_part, out, seed, quick, models, say),
        "real": partial(real_part, out, seed, quick, models, networks or {}, say),
    }
    chapters = [make() for name, make in made.items() if name in parts]
    return write(out, chapters, seed, quick, time.perf_counter() - started)
