"""Flights flown: every keyframe registered once by the real mapper, then mapped anew for each seed.

A seed draws what is flown over and what the segmenter makes of it. Registration does not see either: it sees
the ground's texture. So the poses of a flight are computed once and its maps for every seed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import shapely
from buildloc_mapper.atlas import Atlas
from buildloc_mapper.config import MapperConfig
from buildloc_mapper.extraction import Extractor
from buildloc_mapper.fusion import Fusion, View
from buildloc_mapper.similarity import Similarity
from buildloc_msgs_py import topics
from buildloc_msgs_py.ground import camera_matrix, observe
from buildloc_msgs_py.types import (
    CameraModel,
    FloatArray,
    Frame,
    FrameObservation,
    Keyframe,
    LocalMap,
    Mask,
)

from buildloc_eval.camera import attitude, camera_model, photograph, world_to_rays
from buildloc_eval.flight import FlightConfig, Trajectory
from buildloc_eval.paper.brm import coverage, regions
from buildloc_eval.paper.flights import PlacedFlight, flight_config, keyframe_stamps, trajectory
from buildloc_eval.paper.texture import ground_texture
from buildloc_eval.realworld import data_folder
from buildloc_eval.segmentation_errors import Outlines, SegmentationErrors, perceive
from buildloc_eval.world import Surface

CARRIERS = 12


@dataclass(frozen=True)
class Shot:
    """A keyframe without its image: what telemetry tells, and the truth: east, north, height, ENU yaw of
    image-right, and the attitude."""

    stamp_ns: int
    altitude_m: float
    attitude_xyzw: tuple[float, float, float, float]
    true_pose: tuple[float, float, float, float]
    true_attitude_xyzw: tuple[float, float, float, float]

    def frame(self, camera: CameraModel, image_bgr: np.ndarray) -> Frame:
        """With its image."""
        return Frame(
            self.stamp_ns, topics.FRAME_CAMERA, image_bgr, camera, self.altitude_m, self.attitude_xyzw
        )

    def to_pixels(self, camera: CameraModel, origin_m: FloatArray) -> FloatArray:
        """(3, 3) from (x, y, 1), metres east and north of an origin (2,), to true pixels."""
        x, y, height, yaw = self.true_pose
        pose = (x - float(origin_m[0]), y - float(origin_m[1]), height, yaw)
        rays = world_to_rays(pose, self.true_attitude_xyzw)
        return np.asarray(camera_matrix(camera) @ rays, dtype=np.float64)


@dataclass(frozen=True)
class Track:
    """A registered flight: its keyframes, and after each of them the poses (by number) of the submap that it
    belongs to; none where it links to nothing."""

    camera: CameraModel
    shots: tuple[Shot, ...]
    poses: tuple[dict[int, Similarity] | None, ...]


@dataclass(frozen=True)
class Snapshot:
    """What the mapper knows after a keyframe: its map, the numbers of the keyframes in it and their poses."""

    local_map: LocalMap
    keyframes: tuple[Keyframe, ...]
    numbers: tuple[int, ...]


@dataclass(frozen=True)
class Maps:
    """One flight of one seed: the map that the mapper has published after every keyframe (where one links to
    nothing, the one before it; none before the first), what each keyframe observed, its ratios (N, 3) of
    built ground in regions of ``radii_m``, and the true positions (N, 2) and yaws (N,) of all."""

    snapshots: tuple[Snapshot | None, ...]
    observations: tuple[FrameObservation, ...]
    radii_m: tuple[float, float, float]
    ratios: FloatArray
    true_m: FloatArray
    true_yaw_rad: FloatArray


def shots(flown: Trajectory, stamps_ns: Sequence[int], config: FlightConfig, seed: int) -> tuple[Shot, ...]:
    """Keyframes with noisy telemetry; the gimbal's heading is turned by a constant that the seed draws."""
    rng = np.random.default_rng([seed, 1])
    turned, found = rng.uniform(-math.pi, math.pi), []
    for stamp in stamps_ns:
        x, y, height, yaw, roll, pitch = flown.at(int(stamp))
        noise = math.radians(config.attitude_noise_deg) * rng.standard_normal(2)
        # The level frame's z points down: ENU yaw counts the other way round.
        found.append(
            Shot(
                int(stamp), height + config.altitude_noise_m * float(rng.standard_normal()),
                attitude(roll + noise[0], pitch + noise[1], turned - yaw),
                (x, y, height, yaw), attitude(roll, pitch, -yaw),
            )
        )  # fmt: skip
    return tuple(found)


def register(
    taken: tuple[Shot, ...], world: Surface, flight: FlightConfig, config: MapperConfig, seed: int
) -> Track:
    """Photograph the ground at every keyframe and let the mapper link them."""
    return link(taken, frames(taken, world, flight, seed), camera_model(flight), config)


def fly_textured(flight: PlacedFlight, config: MapperConfig, seed: int) -> Track:
    """Fly over textured ground and register every keyframe."""
    limit_threads()
    flying, flown = flight_config(flight.like), trajectory(flight, seed)
    taken = shots(flown, keyframe_stamps(flight, flown).tolist(), flying, seed)
    ground = ground_texture(data_folder(), flight, np.random.default_rng([seed, 6]))
    return register(taken, ground, flying, config, seed)


def frames(taken: Sequence[Shot], world: Surface, flight: FlightConfig, seed: int) -> Iterator[Frame]:
    """The ground as the camera sees it at every keyframe."""
    rng, camera = np.random.default_rng([seed, 2]), camera_model(flight)
    for shot in taken:
        image = photograph(world, camera, shot.true_pose, shot.true_attitude_xyzw, flight, rng)
        yield shot.frame(camera, image)


def link(taken: tuple[Shot, ...], seen: Iterable[Frame], camera: CameraModel, config: MapperConfig) -> Track:
    """Let the mapper link the frames of the keyframes."""
    atlas, poses = Atlas(config), list[dict[int, Similarity] | None]()
    for frame in seen:
        keyframe = atlas.add(frame)
        linked = atlas.submap(keyframe).poses
        poses.append(None if keyframe > 0 and len(linked) == 1 else dict(linked))
    return Track(camera, taken, tuple(poses))


def masks(track: Track, outlines: Outlines, errors: SegmentationErrors, seed: int) -> Iterator[Mask]:
    """The mask of every keyframe over outlines (N,) in metres east and north, with a segmenter's errors."""
    places = np.array([shot.true_pose[:2] for shot in track.shots])
    origin = places.mean(axis=0)
    near = shapely.transform(outlines, lambda xy: xy - origin)
    reach = 1.5 * max(shot.altitude_m for shot in track.shots)
    ground = shapely.MultiPoint(places - origin).convex_hull.buffer(reach)
    seen = perceive(near, errors, ground, np.random.default_rng([seed, 3]))
    camera, size = track.camera, (track.camera.width, track.camera.height)
    for number, shot in enumerate(track.shots):
        rng = np.random.default_rng([seed, 4, number])
        pixels = seen.frame(shot.to_pixels(camera, origin), size, shot.altitude_m / camera.fx, rng)
        yield Mask(shot.stamp_ns, topics.FRAME_CAMERA, pixels)


def map_flight(track: Track, seen: Iterator[Mask], config: MapperConfig) -> Maps:
    """What the mapper makes of the masks of a registered flight, as :class:`Mapper` does keyframe by
    keyframe. One that links to nothing publishes nothing: whoever has the map before goes on with it."""
    fusion, extractor = Fusion(config), Extractor(config)
    views: dict[int, View] = {}
    snapshots: list[Snapshot | None] = []
    observations, ratios = [], []
    radii_m = regions(track.camera, float(np.median([shot.altitude_m for shot in track.shots])))
    nothing = np.zeros((track.camera.height, track.camera.width, 3), dtype=np.uint8)
    for number, (shot, poses, mask) in enumerate(zip(track.shots, track.poses, seen, strict=True)):
        frame = shot.frame(track.camera, nothing)
        views[number] = View.of(frame, mask, config)
        telemetry = (track.camera, shot.altitude_m, shot.attitude_xyzw)
        observations.append(observe(mask.pixels, shot.stamp_ns, *telemetry, config.min_area_m2))
        ratios.append(coverage(mask.pixels, *telemetry, radii_m))
        if poses is None:
            snapshots.append(snapshots[-1] if snapshots else None)
            continue
        dirty = fusion.update(views, poses)
        found = extractor.update(fusion, dirty, shot.stamp_ns)
        keyframes = tuple(
            Keyframe(track.shots[n].stamp_ns, p.x_m, p.y_m, p.yaw_rad, p.scale) for n, p in poses.items()
        )
        snapshots.append(Snapshot(found.local_map, keyframes, tuple(poses)))
    true = np.array([shot.true_pose for shot in track.shots])
    return Maps(tuple(snapshots), tuple(observations), radii_m, np.array(ratios), true[:, :2], true[:, 3])


def true_place(maps: Maps, snapshot: Snapshot, at_m: FloatArray) -> FloatArray:
    """(2,) where a point (2,) of a map truly lies, carried there by the keyframes nearest to it."""
    poses = np.array([[k.x_m, k.y_m] for k in snapshot.keyframes])
    numbers = np.array(snapshot.numbers)
    near = np.argsort(np.sum((poses - at_m) ** 2, axis=1), kind="stable")[:CARRIERS]
    source, target = poses[near] @ (1.0, 1.0j), maps.true_m[numbers[near]] @ (1.0, 1.0j)
    # Yaws tell the turn even where the keyframes lie in one place.
    yaws = np.array([k.yaw_rad for k in snapshot.keyframes])[near]
    turn = np.exp(1j * (maps.true_yaw_rad[numbers[near]] - yaws)).mean()
    away = complex(float(at_m[0]), float(at_m[1])) - source.mean()
    place = target.mean() + turn / abs(turn) * away
    return np.array([place.real, place.imag])


def limit_threads() -> None:
    """One thread of OpenCV per process: the flights are what runs side by side."""
    cv2.setNumThreads(1)
