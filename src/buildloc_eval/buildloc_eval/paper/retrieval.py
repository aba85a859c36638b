"""Flights located by NetVLAD: their keyframes as tiles, and the predictions of every radius.

This method alone is given the heading: the true one, as a compass without error would tell it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from buildloc_msgs_py.types import FloatArray, Mask
from numpy.typing import NDArray

from buildloc_eval.paper.brm import Survivors, used_keyframes
from buildloc_eval.paper.flights import PaperFlight
from buildloc_eval.paper.flown import Maps, Track
from buildloc_eval.paper.methods import LISTED, Prediction, nothing
from buildloc_eval.paper.netvlad import (
    NETVLAD,
    Descriptors,
    Encoders,
    Grid,
    Tiles,
    accumulate,
    distances,
    keyframe_tile,
)
from buildloc_eval.paper.plan import Plan, Stores, maps_name, whole_names
from buildloc_eval.paper.scoring import BIN_M
from buildloc_eval.paper.stages import Progress, Say
from buildloc_eval.segmentation_errors import Outlines

SeenBy = Callable[[PaperFlight, int], Iterable[Mask]]  # the masks of a flight and a seed


@dataclass(frozen=True)
class View:
    """Keyframes of a flight: places (N, 2), metres east and north of anywhere, and tiles (N, 2, H, W)."""

    path_m: FloatArray
    tiles: Tiles


def view(track: Track, maps: Maps, seen: Iterable[Mask]) -> View | None:
    """The keyframes used of a whole flight, as the mapper's odometry places them; None where the last one
    links to nothing."""
    snapshot = maps.snapshots[-1]
    if snapshot is None:
        return None
    path = np.array([[k.x_m, k.y_m] for k in snapshot.keyframes])
    numbers, yaws = np.array(snapshot.numbers), np.array([k.yaw_rad for k in snapshot.keyframes])
    north_up = float(np.angle(np.exp(1j * (maps.true_yaw_rad[numbers] - yaws)).mean()))
    c, s = math.cos(north_up), math.sin(north_up)
    used = used_keyframes(path)
    wanted, tiles = set(numbers[used].tolist()), dict[int, Tiles]()
    for number, (shot, mask) in enumerate(zip(track.shots, seen, strict=True)):
        if number in wanted:
            telemetry = (track.camera, shot.altitude_m, shot.attitude_xyzw)
            tiles[number] = keyframe_tile(mask.pixels, *telemetry, float(maps.true_yaw_rad[number]))
    return View(
        path[used] @ np.array([[c, s], [-s, c]]), np.array([tiles[n] for n in numbers[used].tolist()])
    )


def prediction(
    found: Survivors, seconds: dict[str, float], centre_m: FloatArray, radius_km: float
) -> Prediction:
    """The hypotheses that end within a radius, ranked; as with BRM, they do not depend on each other."""
    places = found.ranked(centre_m, 1000.0 * radius_km)
    inside = np.hypot(*(found.places_m - centre_m).T) <= 1000.0 * radius_km
    order = np.argsort(found.residuals[inside], kind="stable")
    bins = np.round(found.places_m[inside][order] / BIN_M).astype(np.int32)
    _, first = np.unique(bins, axis=0, return_index=True)
    return Prediction(
        places, np.full_like(places, np.nan), None, bins[np.sort(first)[:LISTED]], None,
        "NetVLAD has no measure of acceptance", seconds, {"hypotheses": float(inside.sum())},
    )  # fmt: skip


def locate(
    views: Mapping[int, View],
    apart: NDArray[np.float16],
    grid: Grid,
    describing_s: float,
    comparing_s: float,
) -> Iterator[tuple[int, Survivors, dict[str, float]]]:
    """Every seed of a flight with its hypotheses and its seconds, from the distances (Q, rows, columns) to
    the tiles of all keyframes, seed after seed, and what it took to describe and to compare them."""
    first = 0
    for s, some in views.items():
        started, count = time.perf_counter(), len(some.tiles)
        hypotheses = accumulate(apart[first : first + count], some.path_m, grid)
        share, carrying_s = count / len(apart), time.perf_counter() - started
        yield (
            s, hypotheses, {"describe": share * describing_s, "search": share * comparing_s + carrying_s}
        )  # fmt: skip
        first += count


def predict_netvlad(
    stores: Stores, flights: Sequence[PaperFlight], plan: Plan, seed: int, reference: Outlines,
    encoders: Encoders, seen_by: SeenBy, say: Say,
) -> None:  # fmt: skip
    """What is not there yet: all seeds of all flights at once, since their circles share most tiles."""
    views = {flight: _views(stores, flight, plan, seed, seen_by) for flight in flights}
    views = {flight: seen for flight, seen in views.items() if seen}
    if not views:
        return
    queries, describing_s = list[Descriptors](), list[float]()
    for seen in views.values():
        started = time.perf_counter()
        queries.append(encoders.drone(np.concatenate([some.tiles for some in seen.values()])))
        describing_s.append(time.perf_counter() - started)
    radius_m = 1000.0 * max(plan.radii_km)
    grids = [Grid.about(np.array(flight.centre_m), radius_m) for flight in views]
    step = partial(Progress(say, NETVLAD, len(Grid.over(grids).inside)).step, "rows of tiles")
    apart, comparing_s = distances(reference, grids, encoders.reference, queries, step)
    for number, (flight, seen) in enumerate(views.items()):
        told = (apart[number], grids[number], describing_s[number], comparing_s[number])
        for s, hypotheses, seconds in locate(seen, *told):
            for radius, name in whole_names(NETVLAD, flight, s, plan.radii_km).items():
                kept = prediction(hypotheses, seconds, np.array(flight.centre_m), radius)
                stores.of(NETVLAD).save(name, kept)


def _views(stores: Stores, flight: PaperFlight, plan: Plan, seed: int, seen_by: SeenBy) -> dict[int, View]:
    """What the seeds of a flight see that have no prediction yet; a seed whose last keyframe links to nothing
    gets its predictions here."""
    store, views = stores.of(NETVLAD), dict[int, View]()
    for s in range(seed, seed + plan.seeds):
        names = whole_names(NETVLAD, flight, s, plan.radii_km).values()
        if all(store.has(name) for name in names):
            continue
        track, maps = stores.tracks.load(flight.name), stores.maps.load(maps_name(flight, s))
        seen = view(track, maps, seen_by(flight, s))
        if seen is not None:
            views[s] = seen
            continue
        for name in names:
            store.save(name, nothing("keyframe links to none of the latest keyframes"))
    return views
