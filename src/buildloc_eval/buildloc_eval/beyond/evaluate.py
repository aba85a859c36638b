"""`buildloc eval beyond`: every case is drawn, located and scored once; then the report."""

from __future__ import annotations

import functools
import json
import math
import pickle
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from buildloc_matcher.config import matcher_config
from buildloc_matcher.matcher import Matcher
from buildloc_matcher.reference.buildings import Buildings
from buildloc_matcher.reference.database import ReferenceDatabase, assemble
from buildloc_msgs_py.types import FloatArray
from scipy.spatial import cKDTree

from buildloc_eval.beyond.cases import (
    ABLATED_LEVELS,
    FACTORS,
    PRESETS,
    Case,
    Factor,
    Reference,
    ablated,
)
from buildloc_eval.beyond.report import Ablations, Curves, write
from buildloc_eval.observation import Digitiser, ObservedMap, observe_map, sensing
from buildloc_eval.paper.flights import EPSG
from buildloc_eval.paper.sources import measure, read_boston
from buildloc_eval.paper.stages import side_by_side
from buildloc_eval.paper.store import Store
from buildloc_eval.realworld import LEXINGTON_DEG
from buildloc_eval.sections import source_digest
from buildloc_eval.segmentation_errors import read_errors
from buildloc_eval.trials import Trial, run_trial
from buildloc_eval.world import to_utm

Say = Callable[[str], None]

CODE = (
    "buildloc_matcher", "buildloc_msgs_py", "buildloc_eval.observation", "buildloc_eval.trials",
    "buildloc_eval.segmentation_errors", "buildloc_eval.paper.methods", "buildloc_eval.paper.scoring",
    "buildloc_eval.paper.sources", "buildloc_eval.beyond.cases", "buildloc_eval.beyond.evaluate",
)  # fmt: skip
BUILDINGS = "buildings"
IMAGE_M = 500.0
SAME_SHAPE = 0.8  # of every metric of every building, where shapes are taken out


@dataclass(frozen=True)
class Plan:
    """How much is run: maps of every case; of each factor and of the ablations every ``step``-th case."""

    maps: int
    step: int
    factors: tuple[Factor, ...] = FACTORS


FULL = Plan(100, 1)
QUICK = Plan(6, 3, (FACTORS[0], *FACTORS[2:]))  # without all of greater Boston


def curves(plan: Plan) -> tuple[Curves, Ablations]:
    """What a plan runs: of every factor and preset, and of every preset and level without its parts."""
    factors = [(factor, {p: factor.of(p)[:: plan.step] for p in PRESETS}) for factor in plan.factors]
    ablations = {(p, level): ablated(p, level)[:: plan.step] for p in PRESETS for level in ABLATED_LEVELS}
    return factors, ablations


def cases(plan: Plan) -> list[Case]:
    """Every case once, those of one reference one after the other."""
    factors, ablations = curves(plan)
    series = [one for _, by_preset in factors for one in by_preset.values()] + list(ablations.values())
    found = dict.fromkeys(case for one in series for _, case in one)
    return sorted(found, key=lambda case: repr(case.reference))


def within(buildings: Buildings, radius_km: float | None) -> Buildings:
    """Those so near to Lexington, or all."""
    if radius_km is None:
        return buildings
    _, east, north = to_utm(*LEXINGTON_DEG)
    return buildings.select(np.hypot(*(buildings.centroids_m - (east, north)).T) <= 1000.0 * radius_km)


def spoilt(buildings: Buildings, reference: Reference, rng: np.random.Generator) -> Buildings:
    """The buildings as the reference has them."""
    kept = buildings.select(rng.random(len(buildings)) >= reference.missing)
    corner = kept.centroids_m.min(axis=0)
    column, row = ((kept.centroids_m - corner) // IMAGE_M).astype(np.int64).T
    of_image = _directions((column.max() + 1) * (row.max() + 1), rng)[column * (row.max() + 1) + row]
    of_building = _directions(len(kept), rng)
    moved = kept.centroids_m + reference.image_shift_m * of_image + reference.shift_m * of_building
    shapes = kept.shapes if reference.shapes else np.full_like(kept.shapes, SAME_SHAPE)
    return Buildings(moved, kept.areas_m2, shapes)


def _directions(count: int, rng: np.random.Generator) -> FloatArray:
    angles = rng.uniform(-math.pi, math.pi, count)
    return np.column_stack([np.cos(angles), np.sin(angles)])


# One after the other a process meets all cases of a reference, which takes seconds to make.
@functools.lru_cache(maxsize=1)
def searched(file: Path, reference: Reference, seed: int) -> ReferenceDatabase:
    """The database of a reference, of kept buildings."""
    chosen = within(pickle.loads(file.read_bytes()), reference.radius_km)
    return assemble(EPSG, spoilt(chosen, reference, np.random.default_rng([seed, 1])), matcher_config())


@functools.lru_cache(maxsize=1)
def flown_over(file: Path, radius_km: float | None) -> tuple[Buildings, cKDTree]:
    """The ground of the flights, of kept buildings."""
    buildings = within(pickle.loads(file.read_bytes()), radius_km)
    return buildings, cKDTree(buildings.centroids_m)


def draw(case: Case, ground: tuple[Buildings, cKDTree], seed: int) -> ObservedMap:
    """The map of a seed: the same for all presets, ablations and references."""
    level = sensing(case.level)
    model = replace(level, heading_walk_deg=case.drift * level.heading_walk_deg)
    drawn = observe_map(*ground, case.buildings, model, np.random.default_rng([seed, 2]))
    zoom, shapes = 1.0 + case.altitude_bias, drawn.local_map.shapes
    local_map = replace(
        drawn.local_map,
        centroids_m=zoom * drawn.local_map.centroids_m,
        areas_m2=zoom**2 * drawn.local_map.areas_m2,
        shapes=shapes if case.reference.shapes else np.full_like(shapes, SAME_SHAPE),
    )
    return replace(drawn, local_map=local_map)


def run_case(file: Path, case: Case, maps: int, seed: int) -> tuple[Trial, ...]:
    """Maps of a case, located."""
    matcher = Matcher(searched(file, case.reference, seed), case.config)
    matcher.warm_up()
    ground = flown_over(file, case.flown_km)
    return tuple(run_trial(matcher, draw(case, ground, 1000 * seed + n)) for n in range(maps))


def stores(out: Path, seed: int, maps: int) -> tuple[Store, Store]:
    """Buildings, and trials by case. Raises StaleError."""
    made_by = {"code": source_digest(CODE)}
    models = {"digitiser": asdict(Digitiser()), "errors": asdict(read_errors())}
    configs = {preset: asdict(matcher_config({"preset": preset})) for preset in PRESETS}
    trials = made_by | {"seed": seed, "maps": maps} | models | configs
    return (
        Store(out / "ground", {"code": source_digest(["buildloc_eval.paper.sources"])}),
        Store(out / "trials", dict(json.loads(json.dumps(trials)))),
    )


def evaluate(out: Path, seed: int, quick: bool, say: Say) -> str:
    """Run what is not there yet, write report.json and report.html; the summary.

    Raises StaleError when the folder holds results of another configuration or code.
    """
    plan, started = QUICK if quick else FULL, time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    ground, trials = stores(out, seed, plan.maps)
    if not ground.has(BUILDINGS):
        say("reading the footprints of greater Boston")
        ground.save(BUILDINGS, measure(read_boston()))
    asked, file = cases(plan), ground.path(BUILDINGS)
    jobs = [(case.name, case.cost, partial(run_case, file, case, plan.maps, seed)) for case in asked]
    side_by_side(jobs, trials, "locating", say)
    located = {case: trials.load(case.name) for case in asked}
    buildings: Buildings = ground.load(BUILDINGS)
    sizes = {radius: len(within(buildings, radius)) for radius in {c.reference.radius_km for c in asked}}
    return write(out, *curves(plan), located, sizes, seed, quick, time.perf_counter() - started)
