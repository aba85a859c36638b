"""The baseline NetVLAD with an encoder made by hand: tiles, keyframes, hypotheses, kept predictions."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
from buildloc_eval.paper.flights import PaperFlight
from buildloc_eval.paper.flown import Maps, Shot, Snapshot, Track
from buildloc_eval.paper.netvlad import (
    FARTHEST,
    NETVLAD,
    PIXEL_M,
    SIDE_PX,
    STEP_M,
    Encoders,
    Grid,
    NetVladError,
    accumulate,
    distances,
    keyframe_tile,
    load_encoders,
    raster,
    tile_rows,
)
from buildloc_eval.paper.plan import Models, Plan, Stores, maps_name
from buildloc_eval.paper.published import FLIGHTS
from buildloc_eval.paper.retrieval import predict_netvlad, view
from buildloc_eval.paper.scoring import score
from buildloc_eval.paper.store import StaleError
from buildloc_eval.segmentation_errors import SegmentationErrors
from buildloc_msgs_py import topics
from buildloc_msgs_py.types import CameraModel, Keyframe, LocalMap, Mask
from numpy.testing import assert_allclose

CENTRE = np.array([320_000.0, 4_690_000.0])
CAMERA = CameraModel(480, 360, 300.0, 300.0, 239.5, 179.5)
KEYFRAMES = 17
ALTITUDE_M, TURN_RAD, YAW_RAD = 100.0, 0.7, 0.4  # of the map against north; of image-right from east
ERRORS = SegmentationErrors(
    1, 0.1, 0.05, 0.05, 100.0, 0.2, 30.0, 0.5, 0.0, 0.2, (0.05, 0.05, 0.05, 0.05), 0.6, 1, 0.1, 0.2, 0.5
)
FLIGHT = PaperFlight(FLIGHTS[0], (float(CENTRE[0]), float(CENTRE[1])))
PLAN = Plan(("flight1",), 1, (1,), {})


def town(seed: int = 1) -> np.ndarray:
    """Houses of many sizes, more of them here and fewer there."""
    rng = np.random.default_rng(seed)
    places = CENTRE + rng.uniform(-1200.0, 1200.0, (5000, 2))
    block = np.floor((places - CENTRE + 1200.0) / 120.0).astype(int)
    places = places[rng.random(5000) < rng.random((20, 20))[*block.T] ** 2]
    low = places - rng.uniform(5.0, 20.0, places.shape)
    return np.asarray(shapely.box(*low.T, *places.T))


def by_hand(tiles: np.ndarray) -> np.ndarray:
    """A descriptor without learning: the middle of the building plane, coarse, of length 1."""
    small = np.array([cv2.resize(tile[0], (16, 16), interpolation=cv2.INTER_AREA) for tile in tiles])
    flat = np.array([cv2.GaussianBlur(one, (0, 0), 3.0)[4:12, 4:12] for one in small]).reshape(len(tiles), -1)
    return np.asarray(flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9), dtype=np.float32)


def shots(true_m: np.ndarray) -> tuple[Shot, ...]:
    down = (0.0, 0.0, 0.0, 1.0)
    turned = (0.0, 0.0, math.sin(-YAW_RAD / 2.0), math.cos(YAW_RAD / 2.0))
    return tuple(
        Shot(n + 1, ALTITUDE_M, down, (*xy, ALTITUDE_M, YAW_RAD), turned)
        for n, xy in enumerate(true_m.tolist())
    )


def mask(outlines: np.ndarray, shot: Shot) -> Mask:
    """What the camera sees, without the evaluation's own rendering: every pixel's ground is looked up."""
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    right, up = (u - CAMERA.cx) / CAMERA.fx * ALTITUDE_M, -(v - CAMERA.cy) / CAMERA.fy * ALTITUDE_M
    ground = (right + 1j * up) * np.exp(1j * YAW_RAD) + complex(*shot.true_pose[:2])
    near = outlines[shapely.STRtree(outlines).query(shapely.Point(*shot.true_pose[:2]).buffer(150.0))]
    built = shapely.contains_xy(shapely.union_all(near), ground.real, ground.imag)
    return Mask(shot.stamp_ns, topics.FRAME_CAMERA, built.astype(np.uint8) * np.uint8(255))


@pytest.fixture(scope="module")
def outlines() -> np.ndarray:
    return town()


@pytest.fixture(scope="module")
def flown(outlines: np.ndarray) -> tuple[Track, Maps, list[Mask]]:
    """A faultless flight to the north east between the tiles; its map is turned by TURN_RAD."""
    true = CENTRE + [17.0, -21.0] + np.linspace(-480.0, 480.0, KEYFRAMES)[:, None] * (0.8, 0.6)
    c, s = math.cos(TURN_RAD), math.sin(TURN_RAD)
    poses = (true - CENTRE) @ np.array([[c, s], [-s, c]])
    frames = tuple(Keyframe(n + 1, *xy, TURN_RAD + YAW_RAD) for n, xy in enumerate(poses.tolist()))
    nothing = LocalMap.whole(
        KEYFRAMES,
        np.empty(0, np.int64),
        np.empty((0, 2)),
        np.empty(0),
        np.empty((0, 4)),
        np.empty(0, np.int64),
    )
    last = Snapshot(nothing, frames, tuple(range(KEYFRAMES)))
    maps = Maps(
        (*(None,) * (KEYFRAMES - 1), last),
        (),
        (1.0, 2.0, 3.0),
        np.empty((KEYFRAMES, 3)),
        true,
        np.full(KEYFRAMES, YAW_RAD),
    )
    taken = shots(true)
    return Track(CAMERA, taken, (None,) * KEYFRAMES), maps, [mask(outlines, shot) for shot in taken]


def test_a_raster_has_the_area_and_the_place_of_a_building() -> None:
    drawn = raster(np.array([shapely.box(20.0, 40.0, 40.0, 50.0)]), 0.0, 0.0, (64, 64))
    assert drawn.shape == (64, 64) and drawn[64 - 23, 15] == 1.0  # at 30 m east and 45 m north
    assert_allclose(drawn.sum() * PIXEL_M**2, 200.0, rtol=0.2)


def test_a_keyframe_is_turned_north_up(outlines: np.ndarray, flown: tuple[Track, Maps, list[Mask]]) -> None:
    track, maps, masks = flown
    tile = keyframe_tile(masks[8].pixels, CAMERA, ALTITUDE_M, track.shots[8].attitude_xyzw, YAW_RAD)
    half = SIDE_PX * PIXEL_M / 2.0
    drawn = raster(outlines, *(maps.true_m[8] - half).tolist(), (SIDE_PX, SIDE_PX))
    shown = tile[1] > 0.99
    assert 0.5 < shown.mean() < 1.0  # 160 x 120 m, turned: corners of the tile are not seen
    flipped = [drawn[::-1], drawn[:, ::-1], drawn[::-1, ::-1], drawn.T]
    off = [np.abs(tile[0] - one)[shown].mean() for one in (drawn, *flipped)]
    assert off[0] < 0.03 and off[0] < 0.4 * min(off[1:])
    assert not tile[0][tile[1] == 0.0].any()


def test_tiles_of_a_grid_lie_about_their_places(outlines: np.ndarray) -> None:
    grid = Grid.about(CENTRE + np.array([9.0, -17.0]), 120.0)
    assert (grid.west_m % STEP_M, grid.south_m % STEP_M) == (0.0, 0.0)  # wherever the circle lies
    assert grid.inside.sum(axis=1).tolist() == [3, 5, 5, 4, 1]
    half = SIDE_PX * PIXEL_M / 2.0
    for row, columns, tiles in tile_rows(outlines, grid):
        for column, tile in zip(columns.tolist(), tiles, strict=True):
            corner = np.array([grid.west_m + column * STEP_M, grid.south_m + row * STEP_M]) - half
            assert_allclose(tile[0], raster(outlines, *corner.tolist(), (SIDE_PX, SIDE_PX)), atol=0.26)


def built_or_not(tiles: np.ndarray) -> np.ndarray:
    """A descriptor that tells whether a tile shows anything."""
    built = tiles.any(axis=(1, 2, 3))
    return np.column_stack([built, ~built]).astype(np.float32)


HOUSE = np.array([shapely.box(*(CENTRE - 10.0), *(CENTRE + 10.0))])
BUILT = np.array([[1.0, 0.0], [0.0, 1.0]], dtype=np.float32)


def test_distances_are_those_of_the_descriptors_and_far_outside_the_circle() -> None:
    grid, rows = Grid.about(CENTRE, 120.0), list[int]()
    (apart,), (seconds,) = distances(HOUSE, [grid], built_or_not, [BUILT], lambda: rows.append(1))
    assert len(rows) == len(grid.inside) and seconds > 0.0
    assert (apart[:, ~grid.inside] == FARTHEST).all()
    assert apart[0, 2, 2] == 0.0 and apart[1, 2, 2] == 2.0
    assert apart[0, 0, 2] == 2.0 and apart[1, 0, 2] == 0.0  # 100 m off: the house is out of the tile


def test_circles_that_overlap_describe_their_tiles_once() -> None:
    grids = [Grid.about(CENTRE + np.array(by), 120.0) for by in ([0.0, 0.0], [70.0, -130.0], [9000.0, 60.0])]
    asked = list[int]()

    def counted(tiles: np.ndarray) -> np.ndarray:
        asked.append(len(tiles))
        return built_or_not(tiles)

    one = np.array([[0.6, 0.8]], dtype=np.float32)
    together, _ = distances(HOUSE, grids, counted, [BUILT, one, BUILT], lambda: None)
    for found, grid, query in zip(together, grids, (BUILT, one, BUILT), strict=True):
        (alone,), _ = distances(HOUSE, [grid], built_or_not, [query], lambda: None)
        assert_allclose(found, alone)
    built = (together[0][0] == 0.0).sum()  # those of the first circle are those of the second as well
    assert 9 <= built <= sum(asked) - 1 < built + (together[1][0] < 1.0).sum()


def test_hypotheses_are_carried_by_odometry() -> None:
    grid = Grid.about(CENTRE, 300.0)
    apart = np.full((3, *grid.inside.shape), 2.0, dtype=np.float16)
    path = np.array([[7.0, 3.0], [57.0, 3.0], [57.0, -47.0]])  # a tile to the east, then one to the south
    for plane, (row, column) in zip(apart, [(6, 5), (6, 6), (5, 6)], strict=True):
        plane[row, column] = 0.0
    found = accumulate(apart, path, grid)
    best = int(np.argmin(found.residuals))
    assert_allclose(found.residuals[best], 0.0, atol=1e-6)
    assert_allclose(found.places_m[best], (grid.west_m + 6 * STEP_M, grid.south_m + 5 * STEP_M))
    assert (np.delete(found.residuals, best) > 1.3).all()
    assert found.residuals.max() > 2.0  # carried out of the circle


def test_a_flight_is_found_kept_and_not_made_again(
    tmp_path: Path, outlines: np.ndarray, flown: tuple[Track, Maps, list[Mask]]
) -> None:
    track, maps, masks = flown
    stores, said, asked = Stores(tmp_path, 1, Models(ERRORS), networks="a"), list[str](), list[int]()
    stores.tracks.save(FLIGHT.name, track)
    stores.maps.save(maps_name(FLIGHT, 1), maps)

    def seen_by(_: PaperFlight, seed: int) -> Iterator[Mask]:
        asked.append(seed)
        return iter(masks)

    def run() -> None:
        encoders = Encoders(by_hand, by_hand, "a")
        predict_netvlad(stores, [FLIGHT], PLAN, 1, outlines, encoders, seen_by, said.append)

    run()
    (kept,) = stores.of(NETVLAD).folder.glob("*.pickle")
    found = stores.of(NETVLAD).load(kept.stem)
    assert not stores.predictions.has(kept.stem)
    assert score(found, maps, KEYFRAMES, 1.0).rank == score(found, maps, KEYFRAMES, 1.0).bin_rank == 1
    assert 2 <= len(found.places_m) <= 10 and np.hypot(*(found.places_m[1] - found.places_m[0])) > 100.0
    assert found.refused and set(found.seconds) == {"describe", "search"}
    assert "100 %" in said[-1]
    run()
    assert asked == [1]
    with pytest.raises(StaleError, match="another networks"):
        Stores(tmp_path, 1, Models(ERRORS), networks="b")
    Stores(tmp_path, 1, Models(ERRORS))  # without NetVLAD, what it made is in nobody's way


def test_a_flight_whose_last_keyframe_links_to_nothing_has_no_view(
    flown: tuple[Track, Maps, list[Mask]],
) -> None:
    track, maps, masks = flown
    assert view(track, replace(maps, snapshots=(None,)), masks) is None


def test_a_folder_without_networks_is_refused_with_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(NetVladError, match=r"training/netvlad.py --out"):
        load_encoders(tmp_path)
    for name in ("drone", "reference"):
        (tmp_path / f"{name}.onnx").write_bytes(b"no network")
    with pytest.raises(NetVladError, match="export it again"):
        load_encoders(tmp_path)
