"""How metric the map is over a whole flight: registration, trajectory, buildings, rate and memory.

Real flights with measured positions, flights cut out of real orthophotos with exact truth, and beside every
figure the same with plain consecutive chaining: no rectification, no pose graph.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import shapely
from buildloc.map_picture import MapPicture
from buildloc_mapper.config import MapperConfig
from buildloc_mapper.extraction import Extractor
from buildloc_mapper.fusion import Fusion, View
from buildloc_mapper.mapper import MapUpdate
from buildloc_mapper.similarity import Similarity
from buildloc_msgs_py.types import FloatArray, LocalMap
from numpy.typing import NDArray

from buildloc_eval import endurance
from buildloc_eval.bars import Bar, bar_table, judge, table
from buildloc_eval.cut import CutFlight, cut
from buildloc_eval.flight import FlightConfig, follow, tour
from buildloc_eval.flown import Aligned, Flight, Path2d, align, draw, mapped, path_of, unrectified
from buildloc_eval.html import write_report
from buildloc_eval.machine import machine
from buildloc_eval.orthos import LabelledGround, banepa, barnarp
from buildloc_eval.pairs import chain, links, pair_scores
from buildloc_eval.realworld import data_folder
from buildloc_eval.sections import PICTURES, Scores, Sections, fingerprint
from buildloc_eval.survey import mirafiori, sheffield

Progress = Callable[[str], None]
Make = Callable[[], Scores]
NETWORKS = ("xfeat", "coarse_loftr")
MAPPED_BY = ("sift", "xfeat")  # coarse_loftr gives the same pairs, and would take as long as the two
COARSE_MAP_GSD_M = 2.0  # for flights whose masks are empty
TOUR = FlightConfig(length_m=2000.0, speed_mps=5.0, altitude_swing_m=10.5, tilt_deg=3.0)
BIAS = 1.03
QUICK_IMAGES, QUICK_LENGTH_M = 60, 1000.0
KEYFRAMES, QUICK_KEYFRAMES = 1000, 150
CODE = ("buildloc_eval", "buildloc_mapper", "buildloc_msgs_py")
IMAGERY = {
    "mirafiori_rtk": "real images; RTK positions and gimbal angles of their own metadata",
    "sheffield_flight": "real images; EXIF positions; the tilt is estimated from the images",
    "barnarp, banepa_ortho, altitude_bias, endurance": (
        "real orthophotos, photographed along simulated paths through a simulated camera; masks are the true "
        "outlines seen by that camera, so that mapping is measured alone; banepa_ortho is labelled in its "
        "middle only; endurance flies over barnarp and its mirror image"
    ),
}


BARS = (
    Bar("mirafiori_rtk_sift", "pairs.pairs_registered", 31, at_least=True),
    Bar("mirafiori_rtk_sift", "pairs.translation_median_m", 0.12),
    Bar("mirafiori_rtk_sift", "pairs.translation_p90_m", 0.2),
    Bar("mirafiori_rtk_sift", "pairs.yaw_median_deg", 0.1),
    Bar("mirafiori_rtk_sift", "mapper.rmse_m", 0.3),
    Bar("sheffield_flight_sift", "mapper.share_of_images", 1.0, at_least=True),
    Bar("sheffield_flight_sift", "mapper.rmse_m", 3.0),
    *(
        bar
        for flight in ("barnarp", "banepa_ortho")
        for bar in (
            Bar(flight, "without_loop_closures.rmse_percent", 1.0),
            Bar(flight, "mapper.rmse_m", 2.0),
            Bar(flight, "mapper.buildings.median_m", 1.0),
        )
    ),
    Bar("altitude_bias", "scale_error_percent", 0.5),
    Bar("altitude_bias", "scale_in_sigmas", 2.0),
    Bar("endurance", "median_ms", 250.0),
    Bar("endurance", "last_over_first", 1.25),
    Bar("endurance", "peak_memory_mb", 1000.0),
)


def configs(data: Path) -> dict[str, MapperConfig]:
    """The mapper's config for every method whose weights are here."""
    found = {"sift": MapperConfig()}
    for name in NETWORKS:
        weights = data / "models" / f"{name}.onnx"
        if weights.is_file():
            found[name] = replace(MapperConfig(), registration=name, registration_model=str(weights))
    return found


def building_scores(local_map: LocalMap, to_world: Similarity, true_m: FloatArray) -> Scores:
    """Distances of the buildings that were seen whole, placed by the alignment of the trajectory, to the
    nearest true centroids (N, 2)."""
    placed = to_world.apply(local_map.select(~local_map.cut).centroids_m)
    if not len(placed):
        return {"buildings": 0}
    distances = np.linalg.norm(placed[:, None] - true_m[None], axis=2).min(axis=1)
    return {
        "buildings": len(placed),
        "median_m": float(np.median(distances)),
        "p90_m": float(np.quantile(distances, 0.9)),
    }


def plain_map(flight: Flight, path: Path2d, config: MapperConfig) -> LocalMap:
    """The masks fused at the poses of plain chaining, as if the camera had looked straight down."""
    fusion = Fusion(config)
    views = {i: View.of(unrectified(flight.frame(i)), flight.mask(i), config) for i in path.index}
    dirty = fusion.update(views, dict(zip(path.index, path.poses, strict=True)), everything=True)
    return Extractor(config).update(fusion, dirty, 0).local_map


@dataclass(frozen=True)
class Flown:
    """What a flight gave: scores and alignment by way of mapping, the mapper's path and its map."""

    scores: Scores
    aligned: dict[str, Aligned]
    path: Path2d
    update: MapUpdate | None


def _fly(
    flight: Flight, config: MapperConfig, others: dict[str, Path2d], folder: Path, with_scale: bool = False
) -> Flown:
    """A flight through the mapper, beside paths of other ways to map it; two pictures."""
    picture = MapPicture()
    path, update = mapped(flight, config, picture)
    paths = {"mapper": path, **others}
    aligned = {name: found for name, path in paths.items() if (found := align(flight, path, with_scale))}
    scores: Scores = {name: found.scores for name, found in aligned.items()}
    if update is None:
        return Flown(scores, aligned, path, update)
    name, alignment = f"{flight.name}_{config.registration}", "similarity" if with_scale else "rigid"
    draw(folder / f"{name}_path.png", flight, aligned, f"{flight.name}: {alignment} alignment to the truth")
    picture.write(update, folder / f"{name}_map.png", f"{flight.name}: the map as the graph has it")
    scores[PICTURES] = [
        (f"{flight.name}, {config.registration}: paths", f"{name}_path.png"),
        (f"{flight.name}, {config.registration}: mosaic, path, buildings, loop closures", f"{name}_map.png"),
    ]
    return Flown(scores, aligned, path, update)


def rtk_scores(data: Path, config: MapperConfig, folder: Path) -> Scores:
    """Pairs of mirafiori_rtk, and its trajectory for the methods that are flown."""
    survey = mirafiori(data)
    assert survey.yaw_rad is not None
    found, counts = links(survey, config, lambda frame: frame)
    pairs, constants = pair_scores(survey, survey.yaw_rad, found)
    plain, _ = links(survey, config, unrectified)
    plain_pairs, _ = pair_scores(survey, survey.yaw_rad, plain)
    scores: Scores = {"pairs": {**pairs, **counts}, "plain_pairs": plain_pairs}
    if config.registration not in MAPPED_BY:
        return scores
    flat = replace(config, map_gsd_m=COARSE_MAP_GSD_M)
    flown = _fly(survey, flat, {"plain_chaining": chain(plain)}, folder)
    put_right = align(survey, constants.correct(flown.path), with_scale=False)
    if put_right is not None:
        flown.scores["fitted_to_truth"] = put_right.scores
    return {**scores, **flown.scores}


def tilted_scores(data: Path, config: MapperConfig, folder: Path, images: int | None) -> Scores:
    """The trajectory of sheffield_flight, or of its first images."""
    survey = sheffield(data, images)
    plain, _ = links(survey, config, unrectified)
    flat = replace(config, map_gsd_m=COARSE_MAP_GSD_M)
    return _fly(survey, flat, {"plain_chaining": chain(plain)}, folder, with_scale=True).scores


def round_trip(
    ground: LabelledGround, flown: FlightConfig, seed: int, altitude_factor: float = 1.0
) -> CutFlight:
    """A round trip over an orthophoto."""
    path = tour(ground.flown_m(), flown, seed)
    trajectory = follow(path, math.inf, flown, seed)
    return cut(ground.name, ground.picture, ground.labels, trajectory, flown, seed, altitude_factor)


def cut_scores(
    flight: CutFlight, buildings: NDArray[np.object_], config: MapperConfig, folder: Path
) -> Scores:
    """Trajectory of a flight over an orthophoto, and its map against the true outlines (N,)."""
    found, _ = links(flight, config, unrectified)
    plain, (without, _) = chain(found), mapped(flight, replace(config, loop_tests=0))
    others = {"without_loop_closures": without, "plain_chaining": plain}
    flown = _fly(flight, config, others, folder)
    true = shapely.get_coordinates(shapely.centroid(buildings))
    maps = {"plain_chaining": plain_map(flight, plain, config)}
    if flown.update is not None:
        maps["mapper"] = flown.update.local_map
    for way, aligned in flown.aligned.items():
        if way in maps:
            flown.scores[way]["buildings"] = building_scores(maps[way], aligned.to_world, true)
    return flown.scores


def bias_scores(flight: CutFlight, config: MapperConfig) -> Scores:
    """A flight with an altimeter that says too much: the map is as much too large, and the standard deviation
    that it tells of its scale allows for it."""
    path, update = mapped(flight, config)
    aligned = align(flight, path, with_scale=True)
    if update is None or aligned is None:
        return {}
    larger, sigma = 1.0 / aligned.scores["scale"], update.funnel["scale_sigma"]
    return {
        "altitude_told_over_true": flight.altitude_factor, "map_over_world": larger,
        "scale_error_percent": 100.0 * abs(larger / flight.altitude_factor - 1.0),
        "scale_sigma_told": sigma, "scale_in_sigmas": abs(math.log(larger)) / sigma,
        "similarity_alignment": aligned.scores,
    }  # fmt: skip


def endurance_scores(flight: CutFlight, config: MapperConfig, folder: Path, progress: Progress) -> Scores:
    """Cost of a keyframe over a long flight, memory, and the trajectory."""
    load = endurance.endure(flight, config, progress)
    endurance.draw(load, folder / "endurance.png")
    scores: Scores = endurance.scores(flight, load)
    scores[PICTURES] = [("endurance: cost of a keyframe", "endurance.png")]
    if load.update is not None:
        path = path_of(load.update, {stamp: i for i, stamp in enumerate(flight.stamps_ns)})
        if (aligned := align(flight, path, with_scale=False)) is not None:
            scores["mapper"] = aligned.scores
    return scores


def plan(data: Path, folder: Path, seed: int, quick: bool, progress: Progress) -> dict[str, Make]:
    """The parts of the evaluation in order. A quick one has SIFT, one orthophoto and shorter flights."""
    methods, (town, dense) = configs(data), (cache(partial(read, data)) for read in (barnarp, banepa))
    sift = methods["sift"]
    parts: dict[str, Make] = {
        f"mirafiori_rtk_{name}": partial(rtk_scores, data, config, folder)
        for name, config in methods.items()
        if not quick or name == "sift"
    }
    for name in MAPPED_BY[: 1 if quick else None]:
        if name in methods:
            images = QUICK_IMAGES if quick else None
            parts[f"sheffield_flight_{name}"] = partial(tilted_scores, data, methods[name], folder, images)
    flown = replace(TOUR, length_m=QUICK_LENGTH_M) if quick else TOUR
    count = QUICK_KEYFRAMES if quick else KEYFRAMES

    def over(ground: LabelledGround) -> Scores:
        return cut_scores(round_trip(ground, flown, seed), ground.buildings, sift, folder)

    parts["barnarp"] = lambda: over(town())
    if not quick:
        parts["banepa_ortho"] = lambda: over(dense())
    parts["altitude_bias"] = lambda: bias_scores(round_trip(town(), flown, seed, BIAS), sift)
    parts["endurance"] = lambda: endurance_scores(
        endurance.long_flight(town(), count, seed), sift, folder, progress
    )
    return parts


def evaluate(out: Path, seed: int, quick: bool, progress: Progress) -> str:
    """Run every part that an earlier run has not finished, write report.json and report.html; the tables.

    The real flights are what they are; ``seed`` draws paths, noise and light of the others.
    """
    data, started = data_folder(), time.perf_counter()
    folder = out / "sections"
    sections = Sections(folder, fingerprint(CODE, seed, quick, machine()["versions"]), progress)
    parts = plan(data, folder, seed, quick, progress)
    scores = {name: sections.scores(name, make) for name, make in parts.items()}
    pictures = [
        (caption, folder / file) for part in scores.values() for caption, file in part.pop(PICTURES, ())
    ]
    judged = judge(BARS, scores)
    report = {
        "evaluation": "mapping",
        "imagery": IMAGERY,
        "quick": quick,
        "bars": judged,
        "seed": seed,
        "seconds": time.perf_counter() - started,
        **machine(),
        "sections": scores,
        "config": dataclasses.asdict(MapperConfig()),
    }
    (out / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    write_report(out / "report.html", "Mapping: registration, trajectory, buildings, rate", report, pictures)
    return f"{pair_table(scores)}\n\n{path_table(scores)}\n\n{bar_table(judged)}\n{out / 'report.html'}"


def pair_table(sections: dict[str, Scores]) -> str:
    """One line per method and way of looking, of the flights whose pairs have a truth."""
    names = ("pairs_registered", "translation_median_m", "translation_p90_m", "yaw_median_deg", "yaw_p90_deg")
    rows = [
        (section, shown, *(scores[key].get(name) for name in names))
        for section, scores in sections.items()
        for key, shown in (("pairs", "rectified"), ("plain_pairs", "plain"))
        if key in scores
    ]
    return table(("pairs of", "", "registered", "trans med m", "p90 m", "yaw med deg", "p90 deg"), rows)


def path_table(sections: dict[str, Scores]) -> str:
    """One line per flight and way of mapping."""
    rows = [
        (section, way.replace("_", " "), f"{path['images']} of {path['of']}", path["rmse_m"],
         path["rmse_percent"], path.get("loop_closures"), path.get("buildings", {}).get("median_m"))
        for section, scores in sections.items()
        for way in ("mapper", "without_loop_closures", "plain_chaining", "similarity_alignment")
        if (path := scores.get(way))
    ]  # fmt: skip
    head = ("trajectory of", "", "images", "rmse m", "% of length", "loops", "buildings med m")
    return table(head, rows)
