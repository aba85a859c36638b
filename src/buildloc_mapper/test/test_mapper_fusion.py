"""Masks drawn by hand, put on the map: what is counted, what becomes a building, and which one it is."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buildloc_mapper import extraction
from buildloc_mapper.config import MapperConfig
from buildloc_mapper.extraction import Extraction, Extractor, confirmed
from buildloc_mapper.fusion import Fusion, View
from buildloc_mapper.identity import continued
from buildloc_mapper.similarity import Similarity
from buildloc_mapper.tiles import TILE_PX, Box, read
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.ground import pixels_to_level
from buildloc_msgs_py.types import ByteArray, CameraModel, Frame, Mask
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import Polygon, box
from textured import LEVEL, shoot

CONFIG = replace(MapperConfig(), max_redraws=1000)
CAMERA = CameraModel(400, 300, 400.0, 400.0, 199.5, 149.5)
ALTITUDE = 80.0  # a pixel is 0.2 m, the image 80 m x 60 m
PIXELS = np.mgrid[: CAMERA.height, : CAMERA.width].reshape(2, -1)[::-1].T.astype(np.float64)
GROUND = pixels_to_level(PIXELS, CAMERA, ALTITUDE, LEVEL)
House = tuple[float, float, float, float]  # west, south, east, north, m


def at(x: float, y: float, yaw: float = 0.0, scale: float = 1.0) -> Similarity:
    return Similarity(x, y, yaw, scale)


def see(houses: list[House], pose: Similarity, config: MapperConfig = CONFIG) -> View:
    """What a keyframe at ``pose`` sees of houses in the map: the pixels whose centre lies in one."""
    x, y = pose.apply(GROUND).T
    inside = np.zeros(len(GROUND), dtype=bool)
    for west, south, east, north in houses:
        inside |= (x >= west) & (x < east) & (y >= south) & (y < north)
    return seen(inside.reshape(CAMERA.height, CAMERA.width).astype(np.uint8) * 255, config)


def seen(mask: ByteArray, config: MapperConfig = CONFIG) -> View:
    image = np.zeros((*mask.shape, 3), dtype=np.uint8)
    return View.of(Frame(0, "camera", image, CAMERA, ALTITUDE, LEVEL), Mask(0, "camera", mask), config)


class Flight:
    """A map that grows by keyframes; the houses may change between them, as masks do."""

    def __init__(self, config: MapperConfig = CONFIG) -> None:
        self.config = config
        self.fusion, self.extractor = Fusion(config), Extractor(config)
        self.views: dict[int, View] = {}
        self.poses: dict[int, Similarity] = {}

    def fly(self, houses: list[House], *poses: Similarity) -> Extraction:
        for pose in poses:
            keyframe = max(self.views, default=-1) + 1
            self.views[keyframe], self.poses[keyframe] = see(houses, pose, self.config), pose
        return self.update()

    def update(self) -> Extraction:
        dirty = self.fusion.update(self.views, self.poses)
        return self.extractor.update(self.fusion, dirty, 7)


def same_counts(one: Fusion, other: Fusion) -> None:
    assert one.counts.keys() == other.counts.keys()
    for tile, counts in one.counts.items():
        np.testing.assert_array_equal(counts, other.counts[tile])


def same_map(one: Extraction, other: Extraction) -> None:
    """The same buildings, whatever their ids."""
    rows = [np.lexsort(e.local_map.centroids_m.T) for e in (one, other)]
    for name in ("centroids_m", "areas_m2", "shapes", "observations", "covariances_m2", "cut"):
        values = [getattr(e.local_map, name)[r] for e, r in zip((one, other), rows, strict=True)]
        np.testing.assert_allclose(*values, atol=1e-9, err_msg=name)


TOWN: list[House] = [
    (x, y, x + w, y + h)
    for x, y, w, h in [(-30, -20, 12, 9), (-8, -5, 20, 10), (20, 8, 9, 9), (50, -8, 30, 12), (60, 20, 8, 14)]
]
LINE = [at(-20, 0, 0.1), at(0, 3, -0.2), at(20, 0, 0.3), at(40, 5), at(60, 0, math.pi), at(75, 5, 0.5)]


def test_box_is_cut_along_the_tiles_and_read_across_them() -> None:
    window = Box(-3, 250, 5, 260)
    pieces = {piece.tile for piece in window.pieces()}
    assert pieces == {(-1, 0), (0, 0), (-1, 1), (0, 1)}
    tiles = {
        (-1, 0): np.full((2, TILE_PX, TILE_PX), 1, np.uint16),
        (0, 1): np.full((2, 256, 256), 2, np.uint16),
    }
    found = read(tiles, window)[0]
    assert (found[:6, :3] == 1).all() and (found[6:, 3:] == 2).all()
    assert (found[:6, 3:] == 0).all() and (found[6:, :3] == 0).all()


def test_counts_are_the_keyframes_that_saw_the_ground_and_the_building() -> None:
    flight = Flight()
    flight.fly([(0.0, 0.0, 10.0, 10.0)], at(0, 0), at(0, 0, 1.0))
    flight.fly([], at(20, 0))
    count, building = read(flight.fusion.counts, Box(20, -20, 21, -19))[:, 0, 0]  # x 5 m, y 5 m
    assert (count, building) == (3, 2)
    assert read(flight.fusion.counts, Box(-120, 20, -119, 21))[:, 0, 0].tolist() == [2, 0]
    assert read(flight.fusion.counts, Box(500, 0, 501, 1)).max() == 0


def test_memory_follows_the_area() -> None:
    flight = Flight()
    flight.fly(TOWN, *LINE[:3])
    tiles = len(flight.fusion.counts)
    for _ in range(4):
        flight.fly(TOWN, *LINE[:3])
    assert len(flight.fusion.counts) == tiles
    flight.fly(TOWN, at(5000, 5000))
    assert len(flight.fusion.counts) <= tiles + 9  # the way there was not flown
    flight.poses = {15: flight.poses[15]}
    flight.update()
    assert len(flight.fusion.counts) < 10


@settings(max_examples=4, deadline=None)
@given(st.integers(0, 10**6))
def test_incremental_is_what_fusing_from_scratch_gives(seed: int) -> None:
    rng = np.random.default_rng(seed)
    flight = Flight(replace(CONFIG, map_gsd_m=0.5))
    for pose in LINE:
        flight.fly(TOWN, pose)
        for keyframe, now in list(flight.poses.items()):
            if rng.uniform() < 0.5:
                dx, dy, dyaw = rng.normal(size=3) * (0.6, 0.6, 0.01)
                flight.poses[keyframe] = Similarity(now.x_m + dx, now.y_m + dy, now.yaw_rad + dyaw, 1.01)
        if len(flight.poses) > 2 and rng.uniform() < 0.3:
            del flight.poses[int(rng.choice(list(flight.poses)))]
        grown = flight.update()
    drawn = {keyframe: drawn.pose for keyframe, drawn in flight.fusion.drawn.items()}
    scratch = Flight(flight.config)
    scratch.views, scratch.poses = flight.views, drawn
    same_map(grown, scratch.update())
    same_counts(flight.fusion, scratch.fusion)


def test_only_what_moved_is_drawn_anew_and_at_most_so_much_per_update() -> None:
    flight = Flight(replace(CONFIG, max_redraws=2, map_gsd_m=0.5))
    for pose in LINE:
        flight.fly(TOWN, pose)
    assert flight.fusion.waiting == 0
    near = {k: p._replace(x_m=p.x_m + 0.1) for k, p in flight.poses.items()}  # less than half a map pixel
    assert flight.fusion.update(flight.views, near) == set()
    flight.poses = {k: p._replace(x_m=p.x_m + 0.5 * (k + 1)) for k, p in flight.poses.items()}
    flight.update()
    drawn = [flight.fusion.drawn[k].pose == pose for k, pose in flight.poses.items()]
    assert drawn == [False] * 4 + [True] * 2 and flight.fusion.waiting == 4  # those that moved most
    far = {0: at(-20.0, 30.0, 0.1), 1: at(5000.0, 0.0), 2: at(0.0, 700.0)}  # a map joined to another one
    flight.poses |= far
    flight.update()
    assert {k: flight.fusion.drawn[k].pose for k in far} == far and flight.fusion.waiting == 1
    assert flight.fusion.update(flight.views, flight.poses, everything=True)
    assert flight.fusion.waiting == 0


def test_another_map_takes_the_place_of_the_last_and_joins_it() -> None:
    flight = Flight(replace(CONFIG, max_redraws=1))
    first = flight.fly(TOWN, *LINE, *LINE)
    old = dict(flight.poses)
    flight.poses = {}
    flight.fly(TOWN, at(300, 0), at(301, 0))  # lost: a map of its own
    assert flight.fusion.drawn.keys() == flight.poses.keys() == {12, 13}
    flight.poses = {**old, 12: LINE[0], 13: LINE[1]}  # joined, in the frame of the first
    joined = flight.update()
    assert flight.fusion.waiting == 0 and len(joined.local_map) == len(first.local_map)
    assert joined.local_map.ids.min() > first.local_map.ids.max()  # none is given again


def test_an_impossible_height_is_refused_before_it_is_mapped() -> None:
    frame, mask = shoot(0, 0.0, 0.0, 0.0)
    with pytest.raises(BuildlocError, match="check the altitude"):
        View.of(replace(frame, altitude_m=1e5), mask, CONFIG)


def test_a_mask_is_kept_as_it_was() -> None:
    mask = (np.random.default_rng(1).uniform(size=(300, 400)) < 0.5).astype(np.uint8) * 255
    np.testing.assert_array_equal(seen(mask).mask(), mask)


@pytest.mark.parametrize("seed", range(4))
def test_a_gap_on_which_the_views_agree_stays_open(seed: int) -> None:
    # Two roofs 0.4 m apart that lie askew in the map, seen from everywhere, registered to 0.1 m.
    rng = np.random.default_rng(seed)
    askew = at(0.0, 0.0, rng.uniform(0, math.tau))
    pair = [(-12.0, -6.0, -0.2, 6.0), (0.2, -6.0, 12.0, 6.0)]
    flight = Flight()
    for keyframe in range(4):
        pose = at(*rng.uniform(-8, 8, 2), rng.uniform(0, math.tau))
        off = rng.normal(0.0, 0.1, 2)
        flight.views[keyframe] = see(pair, pose)
        off_pose = pose._replace(x_m=pose.x_m + off[0], y_m=pose.y_m + off[1])
        flight.poses[keyframe] = askew.compose(off_pose)
    found = flight.update().local_map
    assert len(found) == 2
    apart = found.centroids_m[1] - found.centroids_m[0]
    assert math.hypot(*apart) == pytest.approx(12.2, abs=0.2)


def test_a_building_across_four_tiles_is_one() -> None:
    found = Flight().fly([(-12.0, -9.0, 8.0, 7.0)], at(0, 0), at(3, 2, 0.4)).local_map
    assert len(found) == 1 and not found.cut[0]
    assert found.centroids_m[0] == pytest.approx((-2.0, -1.0), abs=0.15)
    assert found.areas_m2[0] == pytest.approx(320.0, rel=0.04)
    assert found.observations[0] == 2 and found.stamp_ns == 7


def test_a_building_at_the_border_of_the_seen_area_is_cut_until_it_is_seen_whole() -> None:
    house = [(30.0, -5.0, 60.0, 5.0)]
    flight = Flight()
    first = flight.fly(house, at(0, 0), at(0, 1)).local_map  # sees up to x = 40 m
    assert first.cut.tolist() == [True] and first.areas_m2[0] == pytest.approx(100.0, rel=0.05)
    once = flight.fly(house, at(40, 0)).local_map  # one keyframe alone saw the rest
    assert once.cut.tolist() == [True]
    twice = flight.fly(house, at(45, 0)).local_map
    assert twice.cut.tolist() == [False] and twice.areas_m2[0] == pytest.approx(300.0, rel=0.05)
    assert first.ids[0] == once.ids[0] == twice.ids[0]


def test_the_cut_is_told_at_the_border_of_a_tile_too() -> None:
    # West of x = 0, a tile's border, the ground is seen once and then twice; the house ends there.
    house = [(0.0, -5.0, 10.0, 5.0)]
    flight = Flight()
    assert flight.fly(house, at(40, 0), at(40, 0), at(-10, 0)).local_map.cut.tolist() == [True]
    assert flight.fly(house, at(-12, 0)).local_map.cut.tolist() == [False]


def test_untouched_buildings_stay_to_the_last_bit() -> None:
    flight = Flight()
    far = [*TOWN, (500.0, 0.0, 512.0, 9.0)]
    before = flight.fly(far, *LINE, *LINE)
    after = flight.fly(far, at(500, 0), at(505, 0))
    rows = np.isin(after.local_map.ids, before.local_map.ids)
    assert rows.sum() == len(before.local_map) == len(after.local_map) - 1
    kept = after.local_map.select(rows)
    np.testing.assert_array_equal(kept.centroids_m, before.local_map.centroids_m)
    np.testing.assert_array_equal(kept.shapes, before.local_map.shapes)
    assert all(a is b for a, b in zip(before.outlines, after.outlines, strict=False))


def test_ids_stay_while_the_map_grows_and_the_graph_moves() -> None:
    flight = Flight()
    first = flight.fly(TOWN, *LINE, *LINE).local_map
    # 8 m to the side and turned: nearest neighbours alone would mix up the houses.
    move = at(8.0, -6.0, 0.1)
    flight.poses = {k: move.compose(p) for k, p in flight.poses.items()}
    second = flight.update().local_map
    assert first.ids.tolist() == second.ids.tolist() and len(first) == len(TOWN)
    np.testing.assert_allclose(second.centroids_m, move.apply(first.centroids_m), atol=0.15)


def test_of_a_split_the_larger_part_and_of_a_merger_the_larger_building_keeps_its_id() -> None:
    whole, parts = [(-20.0, -5.0, 20.0, 5.0)], [(-20.0, -5.0, 2.0, 5.0), (5.0, -5.0, 20.0, 5.0)]
    flight = Flight()
    (first,) = flight.fly(whole, at(0, 0), at(1, 0)).local_map.ids
    split = flight.fly(parts, at(0, 0), at(1, 0), at(0, 1)).local_map
    large, small = split.ids[np.argsort(-split.areas_m2)]
    assert (large, small) == (first, first + 1)
    merged = flight.fly(whole, *[at(0, 0)] * 4).local_map
    assert merged.ids.tolist() == [large]
    again = flight.fly(parts, *[at(0, 0)] * 8).local_map
    assert set(again.ids.tolist()) == {first, first + 2}  # an id that was lost is not given again


def test_continued_is_mutual_and_survives_nothing_at_all() -> None:
    none = np.empty(0, dtype=object)
    squares = np.array([box(0, 0, 10, 10), box(20, 0, 30, 10)], dtype=object)
    assert continued(none, squares).tolist() == [] and continued(squares, none).tolist() == [-1, -1]
    # The second touches what was the first and is nearest to nothing else: it is new.
    shifted = np.array([box(1, 0, 11, 10), box(9.5, 0, 14, 10), Polygon(squares[1].exterior)], dtype=object)
    assert continued(shifted, squares).tolist() == [0, -1, 1]


def test_covariance_is_the_prior_at_first_and_then_what_the_keyframes_say() -> None:
    house = (-5.0, -5.0, 5.0, 5.0)
    few = Flight().fly([house], at(0, 0)).local_map
    assert len(few) == 0
    rng, sigma = np.random.default_rng(5), np.array([1.0, 0.1])
    flight = Flight()
    for keyframe in range(2):
        flight.views[keyframe], flight.poses[keyframe] = see([house], at(0, 0)), at(0, 0)
    first = flight.update().local_map.covariances_m2[0]
    prior = CONFIG.sigma_centroid_m**2
    assert first == pytest.approx(prior * 2 / 3 * np.eye(2), abs=1e-3)  # two agree: one difference of none
    for keyframe in range(2, 20):
        dx, dy = rng.normal(0.0, sigma)
        moved = (house[0] + dx, house[1] + dy, house[2] + dx, house[3] + dy)
        flight.views[keyframe], flight.poses[keyframe] = see([moved], at(0, 0)), at(0, 0)
    found = flight.update().local_map.covariances_m2[0]
    assert math.sqrt(found[0, 0]) == pytest.approx(sigma[0], rel=0.35)
    assert math.sqrt(found[1, 1]) < 0.25 and found[0, 1] == found[1, 0]


def test_covariance_leaves_out_keyframes_that_saw_a_part() -> None:
    house = (-5.0, -5.0, 5.0, 5.0)
    flight = Flight()
    flight.fly([house], at(0, 0), at(0, 1), at(0, -1))
    before = flight.update().local_map
    after = flight.fly([house], at(40, 0), at(-41, 0)).local_map  # these see a sliver of it, at their border
    np.testing.assert_allclose(after.covariances_m2, before.covariances_m2, atol=1e-9)


def test_what_one_view_alone_claims_is_no_building() -> None:
    flight = Flight()
    house, ghost = (0.0, 0.0, 10.0, 10.0), (-30.0, -20.0, -20.0, -10.0)
    assert len(flight.fly([house, ghost], at(0, 0)).local_map) == 0
    assert len(flight.fly([house], at(0, 0), at(0, 0)).local_map) == 1
    counts = read(flight.fusion.counts, Box(-120, 40, -80, 80))
    assert not confirmed(counts, CONFIG).any()
    assert confirmed(counts, replace(CONFIG, min_observations=1, min_share=0.3)).any()


def test_ground_that_a_network_takes_for_one_building_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extraction, "LARGEST_PX", 100)  # 25 m
    flight = Flight()
    before = flight.fly([(-10.0, -5.0, 10.0, 5.0)], at(0, 0), at(1, 0)).local_map
    assert len(before) == 1
    after = flight.fly([(-30.0, -20.0, 30.0, 20.0)], *[at(0, 0)] * 4).local_map
    assert len(after) == 0
    again = flight.fly([(-10.0, -5.0, 10.0, 5.0)], *[at(0, 0)] * 8).local_map
    assert again.ids.tolist() == [before.ids[0] + 1]
