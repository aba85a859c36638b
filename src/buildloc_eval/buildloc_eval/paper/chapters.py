"""The report's chapters on flights between two digitisers and on real imagery."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from buildloc_msgs_py.types import FloatArray
from scipy.spatial import cKDTree

from buildloc_eval.paper import figures, real, tokyo
from buildloc_eval.paper.flights import Flight
from buildloc_eval.paper.flown import Maps, true_place
from buildloc_eval.paper.plan import Models, Plan, Stores, maps_name, outlines_of
from buildloc_eval.paper.real import RealFlight, Site, Trained
from buildloc_eval.paper.report import (
    OURS,
    TIMES,
    Chapter,
    Converged,
    Trial,
    converged,
    convergence_pictures,
    convergence_table,
    failure_table,
    failures_one_by_one,
    judged,
    methods_of,
    runtime_table,
    trials,
)
from buildloc_eval.paper.scoring import error_row, recall_row
from buildloc_eval.paper.tokyo import TokyoFlight
from buildloc_eval.segmentation_errors import Outlines
from buildloc_eval.trained_on import runs

TOKYO = [
    "real: the footprints, PLATEAU (government model, roof edges) and OpenStreetMap, each drawn by its own "
    "people: one is flown over as it is, the other is the reference as it is; the ground's texture "
    "(orthophotos of Barnarp and Banepa, mirrored); registration, mapping, matching and refinement",
    "simulated: the flights, the camera, its telemetry, and the masks (the outlines flown over with the "
    "errors that the network which ships was measured to make over Barnarp, a suburb it never saw; in a "
    "dense town such as this a network errs more: see Banepa among the real images)",
]
IMAGERY = [
    "real: the images (orthophotos of Barnarp and Banepa), the network, which never trained on the ground it "
    "sees, and the whole pipeline after it; the outlines that people drew on that ground, and the city of "
    "Boston (OpenStreetMap) that they are set into as the reference",
    "simulated: the flights and the camera that photographs the orthophotos, its telemetry; and that Barnarp "
    "and Banepa lie in Boston, where the seed says",
    "the outlines were drawn on the very images that are flown over: the errors in metres are without what "
    "another survey's georeference would add",
    "'drawn' are the same flights with the true outlines for masks: what they find and the others do not is "
    "lost by the network",
]
FOUND_M = 5.0  # from a reference's building to one of the map that is the same


def results_table(scored: Sequence[Trial], groups: Mapping[str, Sequence[str]]) -> list[dict[str, Any]]:
    """Recall with intervals, errors, fixes and false fixes of groups of flights, by method and radius."""
    rows = []
    for group, names in groups.items():
        for method in methods_of(scored):
            for radius in dict.fromkeys(t.radius_km for t in scored):
                mine = [
                    t.score
                    for t in scored
                    if t.flight in names and (t.method, t.radius_km) == (method, radius)
                ]
                row = {"flights": group, "method": method, "radius_km": radius}
                if mine:
                    rows.append(row | recall_row(mine) | error_row(mine))
    return rows


def recall_at_1(scored: Sequence[Trial], names: Sequence[str], radius_km: int) -> float | None:
    """Of the default preset; None when it was not run."""
    right = [
        t.score.rank == 1
        for t in scored
        if t.flight in names and (t.method, t.radius_km) == (OURS, radius_km)
    ]
    return float(np.mean(right)) if right else None


def share_in_reference(maps: Maps, centroids_m: FloatArray) -> float | None:
    """Of the buildings that the last map has whole, those that lie on one (N, 2) of the reference."""
    last = maps.snapshots[-1]
    if last is None:
        return None
    found = last.local_map.select(~last.local_map.cut).centroids_m
    if not len(found):
        return None
    apart, _ = cKDTree(centroids_m).query([true_place(maps, last, at) for at in found])
    return float((apart <= FOUND_M).mean())


def mapped_row(
    flight: Flight, flown: Sequence[Maps], references_m: Sequence[FloatArray], counts: Mapping[int, int]
) -> dict[str, Any]:
    """What was flown and mapped, medians over the seeds: their maps, the references' centroids (N, 2) near
    each, and the sizes of the references by radius."""
    lengths = [float(np.hypot(*np.diff(maps.true_m, axis=0).T).sum()) for maps in flown]
    lasts = [maps.snapshots[-1] for maps in flown]
    shares = [share_in_reference(maps, near) for maps, near in zip(flown, references_m, strict=True)]
    known = [share for share in shares if share is not None]
    return {
        "flight": flight.name,
        "seeds": len(flown),
        "length_km": round(float(np.median(lengths)) / 1000.0, 2),
        "keyframes": float(np.median([len(maps.true_m) for maps in flown])),
        "keyframes in the last map": float(np.median([0 if s is None else len(s.numbers) for s in lasts])),
        "buildings mapped": float(np.median([0 if s is None else len(s.local_map) for s in lasts])),
        "of them in the reference": float(np.median(known)) if known else None,
        **{f"reference {radius} km": count for radius, count in counts.items()},
    }


def sizes(
    references_m: Sequence[FloatArray], centres_m: Sequence[FloatArray], radii_km: Sequence[int]
) -> dict[int, int]:
    """Median number of centroids within each radius."""
    away = [np.hypot(*(all_m - at).T) for all_m, at in zip(references_m, centres_m, strict=True)]
    return {radius: int(np.median([(d <= 1e3 * radius).sum() for d in away])) for radius in radii_km}


def told(
    what: Sequence[str], not_done: Sequence[str], flown: Sequence[dict[str, Any]],
    scored: Sequence[Trial], traces: Sequence[Converged], groups: Mapping[str, Sequence[str]], plan: Plan,
) -> dict[str, Any]:  # fmt: skip
    """What both chapters say."""
    radii = list(plan.radii_km)
    return {
        "what is real": list(what),
        "not done": list(not_done),
        "flights and references": list(flown),
        "results": results_table(scored, groups),
        "failures": failure_table(scored),
        f"failures of the {OURS}, one by one": failures_one_by_one(scored, OURS),
        "convergence": convergence_table(traces),
        "time of a query": runtime_table(scored, radii),
        "times": TIMES,
        "plan": asdict(plan),
    }


def two_digitisers(
    out: Path, stores: Stores, flights: Sequence[TokyoFlight], plan: Plan, models: Models, seed: int
) -> Chapter:
    """Tokyo; draws into ``out``."""
    scored, traces = trials(stores, flights, plan, seed), converged(stores, flights, plan, seed)
    groups: dict[str, list[str]] = {}
    for flight in flights:
        groups.setdefault(f"over {flight.world}, reference {flight.reference}", []).append(flight.name)
    seeds = range(seed, seed + plan.seeds)
    rows, around, paths, least = [], dict[str, Outlines](), dict[str, FloatArray](), []
    for flight in flights:
        flown = [stores.maps.load(maps_name(flight, s)) for s in seeds]
        centroids = stores.ground.load(flight.reference)[1].centroids_m
        counts = sizes([centroids], [np.array(flight.centre_m)], plan.radii_km)
        rows.append(mapped_row(flight, flown, [centroids] * len(flown), counts))
        least.append(counts[tokyo.RADIUS_KM])
        around[flight.name] = outlines_of(stores.ground.load(flight.name))
        paths[flight.name] = flown[0].true_m
    bars = [
        judged(
            f"Tokyo {group}: default preset, recall@1 at {tokyo.RADIUS_KM} km", 0.95,
            recall_at_1(scored, names, tokyo.RADIUS_KM), True,
        )
        for group, names in groups.items()
    ]  # fmt: skip
    bars.append(judged("Tokyo, buildings of the smallest reference", 80_000, float(min(least)), True))
    said = told(TOKYO, [], rows, scored, traces, groups | {f.name: [f.name] for f in flights}, plan) | {
        "errors of the segmenter": asdict(models.segmentation)
    }
    drawn = figures.draw_trajectories(out / "trajectories.png", around, paths)
    pictures = [("Flights over what they see (simulated flights, real footprints)", drawn)]
    return Chapter("Two digitisers: Tokyo", said, bars, pictures + convergence_pictures(out, traces))


def real_imagery(
    out: Path, stores: Mapping[str, Stores], flights: Sequence[RealFlight], networks: Mapping[str, Trained],
    left_out: Mapping[str, str], plan: Plan, seed: int,
) -> Chapter:  # fmt: skip
    """Barnarp and Banepa, those that have a network; draws into ``out``."""
    scored, traces, rows = list[Trial](), list[Converged](), []
    around, paths = dict[str, Outlines](), dict[str, FloatArray]()
    seeds = range(seed, seed + plan.seeds)
    groups = dict[str, list[str]]()
    for flight in flights:
        kept, other = stores[flight.name], real.drawn(flight)
        sites: list[Site] = [kept.ground.load(maps_name(flight, s)) for s in seeds]
        centroids = [site.reference.centroids_m for site in sites]
        counts = sizes(centroids, [site.centre_m for site in sites], plan.radii_km)
        for one, its_plan in ((flight, plan), (other, real.drawn_plan(plan))):
            scored += trials(kept, [one], its_plan, seed)
            traces += converged(kept, [one], its_plan, seed)
            flown = [kept.maps.load(maps_name(one, s)) for s in seeds]
            rows.append(mapped_row(one, flown, centroids, counts))
        groups |= {flight.name: [flight.name], f"{flight.name}, true outlines for masks": [other.name]}
        around[flight.name] = real.own_outlines(flight, sites[0].moved_m)
        paths[flight.name] = flown[0].true_m
    bars = [
        judged(f"real imagery, {flight.place}: default preset, recall@1 at 12 km", 1.0, value, True)
        for flight in flights
        if (value := recall_at_1(scored, [flight.name], 12)) is not None
    ]
    missing = [f"{place} was left out: {reason}" for place, reason in left_out.items()]
    said = told(IMAGERY, missing, rows, scored, traces, groups, plan) | {
        "networks": {
            place: {"model": one.model or "shipped", "sha256": one.sha256, "training": runs(one.training)}
            for place, one in networks.items()
        }
    }
    pictures = []
    if flights:
        drawn = figures.draw_trajectories(out / "trajectories.png", around, paths)
        pictures = [("Flights of the first seed over the outlines of the reference", drawn)]
    return Chapter("Real imagery", said, bars, pictures + convergence_pictures(out, traces))
