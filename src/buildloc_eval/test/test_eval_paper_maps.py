"""Maps of the paper's flights: registered once, mapped by the mapper's own hands, true places known."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import shapely
from buildloc_eval.camera import camera_model, photograph
from buildloc_eval.flight import FlightConfig, Trajectory, fly
from buildloc_eval.paper.flights import EPSG
from buildloc_eval.paper.flown import Maps, Snapshot, Track, map_flight, masks, register, shots, true_place
from buildloc_eval.segmentation_errors import SegmentationErrors
from buildloc_eval.world import PictureWorld
from buildloc_mapper.config import MapperConfig
from buildloc_mapper.mapper import Mapper
from buildloc_msgs_py.types import Keyframe, LocalMap

SEED = 3
CONFIG = FlightConfig(
    length_m=170.0, leg_m=60.0, spacing_m=40.0, altitude_m=60.0, altitude_swing_m=2.0, width=320, height=240
)
MAPPER = MapperConfig(level_width_px=320, features=500)
FAULTLESS = SegmentationErrors(
    1, 0.0, 0.0, 0.0, 0.0, 0.0, 30.0, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0, 0.0), 0.0, 1, 0.0, 0.0, 0.5
)
CENTRE = (320_000.0, 4_690_000.0)


def trajectory() -> Trajectory:
    x, y = CENTRE
    return fly((x - 130.0, y - 130.0, x + 130.0, y + 130.0), CONFIG, SEED)


def ground() -> PictureWorld:
    """Noise of several scales, 0.4 m per pixel."""
    rng = np.random.default_rng(SEED)
    image = sum(
        cv2.resize(rng.normal(0, 18.0 * scale**0.5, (600 // scale, 600 // scale, 1)), (900, 900))
        for scale in (1, 3, 9)
    )
    grey = np.clip(image + 120.0, 0, 255).astype(np.uint8)
    return PictureWorld(np.dstack([grey] * 3), EPSG, CENTRE[0] - 180.0, CENTRE[1] + 180.0, 0.4)


def town() -> np.ndarray:
    """Houses of 10 x 7 m every 22 m."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-8, 9) * 22.0, np.arange(-8, 9) * 22.0))
    return np.asarray(shapely.box(*np.add([x - 5, y - 3.5, x + 5, y + 3.5], np.array(CENTRE * 2)[:, None])))


@pytest.fixture(scope="module")
def track() -> Track:
    flown = trajectory()
    stamps = np.linspace(flown.stamps_ns[0], flown.stamps_ns[-1], 8).astype(np.int64)
    return register(shots(flown, stamps.tolist(), CONFIG, SEED), ground(), CONFIG, MAPPER, SEED)


@pytest.fixture(scope="module")
def maps(track: Track) -> Maps:
    return map_flight(track, masks(track, town(), FAULTLESS, 1), MAPPER)


def test_maps_are_those_of_the_mapper_to_the_last_bit(track: Track, maps: Maps) -> None:
    mapper, rng, camera = Mapper(MAPPER), np.random.default_rng([SEED, 2]), camera_model(CONFIG)
    seen = masks(track, town(), FAULTLESS, 1)
    for shot, mask, snapshot in zip(track.shots, seen, maps.snapshots, strict=True):
        image = photograph(ground(), camera, shot.true_pose, shot.true_attitude_xyzw, CONFIG, rng)
        update = mapper.add(shot.frame(camera, image), mask)
        assert (update is None) == (snapshot is None)
        if update is None or snapshot is None:
            continue
        assert snapshot.keyframes == update.keyframes
        assert snapshot.local_map.stamp_ns == update.local_map.stamp_ns
        np.testing.assert_array_equal(snapshot.local_map.centroids_m, update.local_map.centroids_m)
        np.testing.assert_array_equal(snapshot.local_map.ids, update.local_map.ids)


def test_a_keyframe_that_links_to_nothing_leaves_the_map_before_it(track: Track, maps: Maps) -> None:
    lost = replace(track, poses=(*track.poses[:4], None, *({k: p for k, p in poses.items() if k != 4}
                                                         for poses in track.poses[5:] if poses)))  # fmt: skip
    found = map_flight(lost, masks(track, town(), FAULTLESS, 1), MAPPER)
    assert found.snapshots[4] is found.snapshots[3]
    last = found.snapshots[-1]
    assert last is not None and last.numbers == (0, 1, 2, 3, 5, 6, 7)
    none = map_flight(replace(track, poses=(None,) * 8), masks(track, town(), FAULTLESS, 1), MAPPER)
    assert none.snapshots == (None,) * 8


def test_faultless_masks_give_the_true_buildings_where_they_truly_are(maps: Maps) -> None:
    last = maps.snapshots[-1]
    assert last is not None and len(last.keyframes) == len(maps.true_m)
    whole = last.local_map.select(~last.local_map.cut)
    assert len(whole) >= 10
    places = np.array([true_place(maps, last, at) for at in whole.centroids_m])
    truth = shapely.get_coordinates(shapely.centroid(town()))
    nearest = np.sqrt(((places[:, None] - truth[None]) ** 2).sum(axis=2)).min(axis=1)
    # Half a map pixel, and what the altimeter's 0.3 m of 60 m make of the 60 m to the far end of an image.
    assert np.median(nearest) < 1.0
    assert np.median(whole.areas_m2) == pytest.approx(70.0, rel=0.1)


def test_the_true_place_of_a_point_is_carried_by_the_keyframes() -> None:
    keyframes = tuple(Keyframe(i, 10.0 * i, 0.0, 0.2) for i in range(3))
    # The map is turned by a quarter turn, and moved.
    true = np.array([[100.0, 50.0 + 10.0 * i] for i in range(3)])
    nothing = LocalMap.whole(
        0, np.empty(0, np.int64), np.empty((0, 2)), np.empty(0), np.empty((0, 4)), np.empty(0, np.int64)
    )
    snapshot = Snapshot(nothing, keyframes, (0, 1, 2))
    yaws = np.full(3, 0.2 + math.pi / 2)
    maps = Maps((snapshot,), (), (1.0, 2.0, 3.0), np.empty((0, 3)), true, yaws)
    np.testing.assert_allclose(true_place(maps, snapshot, np.array([10.0, 5.0])), [95.0, 60.0], atol=1e-9)
