"""Flights over real imagery, through a network that never trained on that ground.

A place's orthophoto and outlines are set into greater Boston, whose buildings are the distractors. A seed
draws where, the flight with its wind, telemetry and light, and the noise of the camera.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import shapely
from buildloc_matcher.reference.buildings import Buildings, concatenate
from buildloc_msgs_py import topics
from buildloc_msgs_py.types import ByteArray, FloatArray, Mask
from buildloc_segmenter.config import SegmenterConfig
from buildloc_segmenter.network import Network
from buildloc_segmenter.segmenter import Segmenter

from buildloc_eval.camera import camera_model
from buildloc_eval.cut import keyframe_stamps
from buildloc_eval.flight import Box, FlightConfig, fly, margin_m
from buildloc_eval.orthos import LabelledGround, banepa, barnarp
from buildloc_eval.paper.flights import EPSG
from buildloc_eval.paper.flown import Maps, Track, frames, limit_threads, link, map_flight, masks, shots
from buildloc_eval.paper.plan import Models, Plan, Stores, maps_name
from buildloc_eval.paper.published import LARGE_RADII_KM
from buildloc_eval.paper.sources import measure, read_boston, usable
from buildloc_eval.paper.stages import Area, Job, Say, Search, predict, side_by_side
from buildloc_eval.paper.store import Store
from buildloc_eval.realworld import HOLE_MARGIN_M, data_folder
from buildloc_eval.segmentation import Case, EvaluationError, refuse_known_ground
from buildloc_eval.segmentation_errors import Outlines, SegmentationErrors
from buildloc_eval.trained_on import trained_on
from buildloc_eval.world import PictureWorld

CODE = (
    "buildloc_segmenter", "buildloc_eval.cut", "buildloc_eval.realworld", "buildloc_eval.paper.real"
)  # fmt: skip
PNG = ".png"
RADIUS_M = 1000.0 * max(LARGE_RADII_KM)  # of every reference


@dataclass(frozen=True)
class Surveyed:
    """What is flown over a place: legs back and forth."""

    length_km: float
    leg_m: float
    spacing_m: float
    altitude_m: float = 105.0
    speed_mps: float = 5.0

    @property
    def keyframes(self) -> int:
        """About: one every five seconds."""
        return round(1000.0 * self.length_km / (5.0 * self.speed_mps))

    @property
    def config(self) -> FlightConfig:
        """With the camera of the other flights."""
        return FlightConfig(
            length_m=1000.0 * self.length_km, leg_m=self.leg_m, spacing_m=self.spacing_m,
            altitude_m=self.altitude_m, speed_mps=self.speed_mps, width=960, height=540,
        )  # fmt: skip


@dataclass(frozen=True)
class RealFlight:
    """Flights over a labelled place of :mod:`buildloc_eval.places`; every seed's is another."""

    name: str
    place: str
    read: Callable[[Path], LabelledGround]
    like: Surveyed


FLIGHTS = (
    RealFlight("barnarp", "barnarp", barnarp, Surveyed(1.4, 450.0, 100.0)),
    # Labels cover 440 x 570 m: three legs are all that fits without a frame beyond them.
    RealFlight("banepa", "banepa", banepa, Surveyed(1.0, 330.0, 80.0)),
)
# No errors: true outlines as a segmenter would draw them.
FAULTLESS = SegmentationErrors(
    true=0, missed=0.0, merged=0.0, split=0.0, false_per_km2=0.0, false_share=0.0, false_median_m2=0.0,
    centroid_sigma_m=0.0, log_area_bias=0.0, log_area_sigma=0.0, shape_sigma=(0.0, 0.0, 0.0, 0.0),
    outline_m=0.0, twice=0, flicker=0.0, centroid_frame_sigma_m=0.0, false_again=0.0,
)  # fmt: skip
SHORT = RealFlight("barnarp_short", "barnarp", barnarp, Surveyed(0.6, 450.0, 100.0))

STAR_METHODS = ("paper preset", "default preset")
FULL = Plan(
    tuple(flight.name for flight in FLIGHTS), 10, LARGE_RADII_KM, {"default preset": {6: 1}}, STAR_METHODS
)  # fmt: skip
QUICK = Plan((SHORT.name,), 1, (6,), {}, STAR_METHODS)


def drawn(flight: RealFlight) -> RealFlight:
    """The same flights with the true outlines for masks: what these find and the network's do not, the
    network has lost."""
    return replace(flight, name=f"{flight.name}_drawn")


def drawn_plan(plan: Plan) -> Plan:
    """What is run of them: the default preset, whole flights."""
    return replace(plan, prefixes={}, methods=STAR_METHODS[1:])


@dataclass(frozen=True)
class Trained:
    """A network for a place: its file as given (empty: the one that is shipped), the checksum of that file,
    and what trained it, as it says itself."""

    model: str
    sha256: str
    training: dict[str, Any] | None

    @property
    def config(self) -> SegmenterConfig:
        """One thread: the flights are what runs side by side."""
        return SegmenterConfig(model=self.model, threads=1)


def network_for(place: str, model: str) -> Trained:
    """Raises EvaluationError when that network was trained on the place, NetworkError when it is none."""
    network = Network(SegmenterConfig(model=model))
    training = trained_on(network.metadata)
    refuse_known_ground(Case(place, model), training)
    return Trained(model, hashlib.sha256(network.path.read_bytes()).hexdigest(), training)


def networks(
    flights: Sequence[RealFlight], models: Mapping[str, str]
) -> tuple[dict[str, Trained], dict[str, str]]:
    """The network of each place that has one, and why the others have none. ``models``: files by place; a
    place without one gets the shipped network, unless that knows its ground.

    Raises EvaluationError for a file that knows the ground it is given for, or a place without a flight.
    """
    places = [flight.place for flight in flights]
    unknown = sorted(set(models) - set(places))
    if unknown:
        raise EvaluationError(
            f"--model {unknown[0]}=...: no flight of this run goes there; they go to {', '.join(places)}"
        )
    found, left_out = dict[str, Trained](), dict[str, str]()
    for place in places:
        try:
            found[place] = network_for(place, models.get(place, ""))
        except EvaluationError:
            if place in models:
                raise
            left_out[place] = (
                f"the shipped network was trained on its ground; --model {place}=PATH gives one that was not"
            )
    return found, left_out


@dataclass(frozen=True)
class Site:
    """Where a seed sets a place into greater Boston: the move (2,) of its ground, the centre (2,) of the
    search, and the reference: the city around with the place's own buildings instead of those it covers."""

    moved_m: FloatArray
    centre_m: FloatArray
    reference: Buildings


def labelled_m(ground: LabelledGround) -> Box:
    """What is labelled of a ground's picture."""
    picture = shapely.box(*ground.picture.bounds_m)
    west, south, east, north = picture.intersection(
        shapely.box(*shapely.total_bounds(ground.outlines))
    ).bounds
    return west, south, east, north


def draw_site(centroids_m: FloatArray, radius_m: float, rng: np.random.Generator) -> FloatArray:
    """(2,) one of the buildings (N, 2) that have the whole search radius around them in the data."""
    low, high = centroids_m.min(axis=0) + radius_m, centroids_m.max(axis=0) - radius_m
    inside = centroids_m[np.all((centroids_m >= low) & (centroids_m <= high), axis=1)]
    return np.asarray(inside[rng.integers(len(inside))])


@dataclass(frozen=True)
class City:
    """Outlines (N,) and what a reference knows of each."""

    outlines: Outlines
    measured: Buildings


def read_city() -> City:
    """Greater Boston."""
    outlines = read_boston()
    return City(outlines, measure(outlines))


def set_in(city: City, ground: LabelledGround, at_m: FloatArray, radius_m: float) -> Site:
    """Bring the middle of a ground's labelled part to a place of a city, whose buildings there give way."""
    west, south, east, north = labelled_m(ground)
    moved = at_m - ((west + east) / 2.0, (south + north) / 2.0)
    hole = shapely.box(west, south, east, north).buffer(HOLE_MARGIN_M, join_style="mitre")
    hole = shapely.transform(hole, lambda xy: xy + moved)
    near = np.flatnonzero(np.hypot(*(city.measured.centroids_m - at_m).T) <= radius_m)
    kept = near[~shapely.intersects(city.outlines[near], hole)]
    own = shapely.transform(usable(ground.outlines), lambda xy: xy + moved)
    return Site(moved, at_m, concatenate([city.measured.select(kept), measure(own)]))


def make_sites(
    store: Store, flight: RealFlight, seeds: Sequence[int], read: Callable[[], City], say: Say
) -> None:
    """Keep the site of every seed, with the reference within the largest radius."""
    missing = [s for s in seeds if not store.has(maps_name(flight, s))]
    if not missing:
        return
    say(f"setting {flight.place} into greater Boston")
    city, ground = read(), flight.read(data_folder())
    number = [f.place for f in FLIGHTS].index(flight.place)
    for s in missing:
        at = draw_site(city.measured.centroids_m, RADIUS_M, np.random.default_rng([s, 8, number]))
        store.save(maps_name(flight, s), set_in(city, ground, at, RADIUS_M))


def region(labelled: Box, config: FlightConfig, rng: np.random.Generator) -> Box:
    """A part of the labelled ground that the legs fill, anywhere in it."""
    legs = math.ceil(config.length_m / (config.leg_m + config.spacing_m))
    margin = margin_m(config) + 1.0
    along, across = config.leg_m + 2.0 * margin, (legs - 1) * config.spacing_m + 2.0 * margin
    low, high = np.array(labelled[:2]), np.array(labelled[2:])
    size = high - low
    wanted = np.array([along, across] if size[0] >= size[1] else [across, along])
    corner = low + rng.uniform(0.0, 1.0, 2) * np.maximum(size - wanted, 0.0)
    (west, south), (east, north) = corner, np.minimum(corner + wanted, high)
    return float(west), float(south), float(east), float(north)


def moved_picture(ground: LabelledGround, by_m: FloatArray) -> PictureWorld:
    """The ground's picture somewhere else."""
    whole = ground.picture.window(ground.picture.bounds_m)
    left, top = (float(v) for v in by_m + np.array([whole.left_m, whole.top_m]))
    return PictureWorld(whole.image_bgr, EPSG, left, top, whole.gsd_m)


@dataclass(frozen=True)
class Seen:
    """A flight's registered keyframes and the masks of the network, as PNG."""

    track: Track
    masks: tuple[bytes, ...]


def see(flight: RealFlight, moved_m: FloatArray, network: Trained, models: Models, seed: int) -> Seen:
    """Fly, register and segment."""
    limit_threads()
    ground, config = flight.read(data_folder()), flight.like.config
    box = region(labelled_m(ground), config, np.random.default_rng([seed, 9]))
    west, south, east, north = (np.array(box) + np.tile(moved_m, 2)).tolist()
    flown = fly((west, south, east, north), config, seed)
    taken = shots(flown, keyframe_stamps(flown, config.rate_hz), config, seed)
    images = tuple(frames(taken, moved_picture(ground, moved_m), config, seed))
    track = link(taken, images, camera_model(config), models.mapper)
    segmenter = Segmenter(network.config)
    return Seen(track, tuple(_packed(segmenter.segment(image).pixels) for image in images))


def _packed(mask: ByteArray) -> bytes:
    return bytes(cv2.imencode(PNG, mask)[1])


def make_maps(seen: Seen, models: Models) -> Maps:
    """What the mapper makes of them."""
    limit_threads()
    unpacked = (
        Mask(shot.stamp_ns, topics.FRAME_CAMERA, _unpacked(mask))
        for shot, mask in zip(seen.track.shots, seen.masks, strict=True)
    )
    return map_flight(seen.track, unpacked, models.mapper)


def _unpacked(mask: bytes) -> ByteArray:
    return np.asarray(cv2.imdecode(np.frombuffer(mask, np.uint8), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def make_drawn_maps(flight: RealFlight, track: Track, moved_m: FloatArray, models: Models, seed: int) -> Maps:
    """What the mapper makes of the true outlines in the network's stead."""
    limit_threads()
    return map_flight(track, masks(track, own_outlines(flight, moved_m), FAULTLESS, seed), models.mapper)


def own_outlines(flight: RealFlight, moved_m: FloatArray) -> Outlines:
    """The place's own outlines where they are set into the city."""
    outlines = usable(flight.read(data_folder()).outlines)
    return np.asarray(shapely.transform(outlines, lambda xy: xy + moved_m))


def area(store: Store, name: str) -> Area:
    """The reference of a seed."""
    site: Site = store.load(name)
    return Area(site.reference, site.centre_m, EPSG)


def stores_for(out: Path, flight: RealFlight, network: Trained, models: Models, seed: int) -> Stores:
    """Each place's are its own: another network makes anew what it has seen, and nothing else."""
    made_by = {"network": network.sha256, "segmenter": asdict(replace(network.config, model=""))}
    return Stores(out / f"real_{flight.name}", seed, models, made_by, CODE)


def run(
    stores: Stores, flight: RealFlight, network: Trained, read: Callable[[], City], plan: Plan,
    models: Models, seed: int, say: Say,
) -> None:  # fmt: skip
    """Every stage of what is not there yet; ``read`` gives the city."""
    seeds = range(seed, seed + plan.seeds)
    make_sites(stores.ground, flight, seeds, read, say)
    names = {s: maps_name(flight, s) for s in seeds}
    jobs: list[Job] = []
    for s in (s for s in seeds if not stores.tracks.has(names[s])):
        moved = stores.ground.load(names[s]).moved_m
        jobs.append((names[s], 1.0, partial(see, flight, moved, network, models, s)))
    side_by_side(jobs, stores.tracks, f"{flight.name}: registering and segmenting", say)
    jobs, other = [], drawn(flight)
    for s, name in names.items():
        if not (stores.maps.has(name) and stores.maps.has(maps_name(other, s))):
            seen, moved = stores.tracks.load(name), stores.ground.load(name).moved_m
            jobs.append((name, 1.0, partial(make_maps, seen, models)))
            remade = partial(make_drawn_maps, flight, seen.track, moved, models, s)
            jobs.append((maps_name(other, s), 1.0, remade))
    side_by_side(jobs, stores.maps, f"mapping {flight.name}", say)
    for one, its_plan in ((flight, plan), (other, drawn_plan(plan))):
        searches = [Search(one, (s,), partial(area, stores.ground, names[s])) for s in seeds]
        predict(stores, searches, its_plan, seed, say)
