"""Labelled places: every layout, and what is said when a folder is not as told."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
from buildloc_eval.places import (
    PlaceError,
    Scene,
    components,
    drawn,
    place,
    read_inria,
    read_ortho,
    read_pairs,
    read_web_ortho,
    read_web_tiles,
    web_tile_gsd_m,
)


def write(path: Path, picture: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture)


def mask_with_two_squares(side: int = 32) -> np.ndarray:
    mask = np.zeros((side, side), dtype=np.uint8)
    mask[4:12, 4:12] = mask[18:28, 18:28] = 255
    return mask


def test_a_folder_of_pairs_is_read_one_scene_a_pair(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write(tmp_path / "images" / f"{name}.png", np.full((32, 32, 3), (10, 20, 200), dtype=np.uint8))
        write(tmp_path / "masks" / f"{name}.png", mask_with_two_squares())
    write(tmp_path / "images" / "unlabelled.png", np.zeros((32, 32, 3), dtype=np.uint8))
    scenes = list(read_pairs(tmp_path / "images", tmp_path / "masks", 0.25))
    assert [scene.name for scene in scenes] == ["a", "b"]
    assert tuple(scenes[0].rgb[0, 0]) == (200, 20, 10)
    assert np.bincount(scenes[0].buildings.ravel()).tolist() == [32 * 32 - 164, 64, 100]
    assert scenes[0].gsd_m == 0.25 and scenes[0].labelled.all()


def test_the_inria_layout_names_the_town(tmp_path: Path) -> None:
    write(tmp_path / "images" / "austin12.tif", np.zeros((32, 32, 3), dtype=np.uint8))
    write(tmp_path / "gt" / "austin12.tif", mask_with_two_squares())
    ((town, scene),) = read_inria(tmp_path)
    assert (town, scene.name, scene.gsd_m) == ("austin", "austin12", 0.3)


def test_web_tiles_of_a_zoom_lie_side_by_side(tmp_path: Path) -> None:
    for x, grey in ((100, 50), (102, 90)):
        write(tmp_path / "images" / f"T-{x}-200-19.png", np.full((32, 32, 3), grey, dtype=np.uint8))
        write(tmp_path / "masks" / f"T-{x}-200-19.png", mask_with_two_squares())
    (scene,) = read_web_tiles(tmp_path / "images", tmp_path / "masks")
    assert scene.rgb.shape == (32, 96, 3)
    assert scene.labelled.sum() == 2 * 32 * 32 and not scene.labelled[:, 32:64].any()
    assert scene.buildings.max() == 4
    assert scene.gsd_m == pytest.approx(web_tile_gsd_m(200.5, 19, 32))


def test_ground_sampling_distance_of_a_web_tile_at_the_equator() -> None:
    assert web_tile_gsd_m(2**18, 19, 256) == pytest.approx(40075016.686 / 2**19 / 256)


def test_polygons_keep_touching_buildings_and_courtyards_apart() -> None:
    left, right = shapely.box(2, 2, 10, 10), shapely.box(10, 2, 18, 10)
    ring = shapely.Polygon(shapely.box(2, 12, 18, 28).exterior, [shapely.box(6, 16, 14, 24).exterior])
    labels = drawn([left, right, ring], (30, 20))
    assert labels[5, 9] == 1 and labels[5, 10] == 2
    assert labels[13, 10] == 3 and labels[20, 10] == 0
    areas = np.bincount(labels.ravel())[1:]
    assert areas.tolist() == [64, 64, 192]


def orthophoto(folder: Path) -> None:
    write(folder / "ortho.jpg", np.full((40, 60, 3), 80, dtype=np.uint8))
    (folder / "georef.json").write_text(
        json.dumps({"origin_lat_deg": 0.0, "origin_lon_deg": 0.0, "gsd_m": 0.5})
    )
    metre = 1.0 / 111_319.49
    square = shapely.box(5 * metre, -15 * metre * 1.00674, 15 * metre, -5 * metre * 1.00674)
    feature = {"type": "Feature", "properties": {}, "geometry": shapely.geometry.mapping(square)}
    (folder / "outlines.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))


def test_an_orthophoto_is_labelled_by_its_polygons(tmp_path: Path) -> None:
    orthophoto(tmp_path)
    scene = read_ortho(tmp_path / "ortho.jpg", tmp_path / "outlines.geojson", tmp_path / "georef.json")
    rows, columns = np.nonzero(scene.buildings == 1)
    assert rows.mean() == pytest.approx(19.5, abs=0.6) and columns.mean() == pytest.approx(19.5, abs=0.6)
    assert len(rows) == pytest.approx(400, rel=0.12)


def test_a_web_orthophoto_takes_its_labels_from_polygons(tmp_path: Path) -> None:
    x, y, zoom, side = 2**18, 2**18, 19, 64  # just south-east of (0, 0)
    write(tmp_path / "tiles" / f"T-{x}-{y}-{zoom}.png", np.zeros((side, side, 3), dtype=np.uint8))
    write(tmp_path / "masks" / f"T-{x}-{y}-{zoom}.png", np.zeros((side, side), dtype=np.uint8))
    degrees = 360.0 / 2**zoom / side  # of a pixel
    square = shapely.box(10 * degrees, -30 * degrees, 30 * degrees, -10 * degrees)
    feature = {"type": "Feature", "properties": {}, "geometry": shapely.geometry.mapping(square)}
    (tmp_path / "l.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    scene = read_web_ortho(tmp_path / "tiles", tmp_path / "masks", tmp_path / "l.geojson")
    rows, columns = np.nonzero(scene.buildings)
    assert (rows.min(), columns.min()) == pytest.approx((10, 10), abs=1)
    assert (rows.max(), columns.max()) == pytest.approx((29, 29), abs=1)


def test_resampling_keeps_ground_and_labels_together() -> None:
    labels = np.zeros((40, 40), dtype=np.int32)
    labels[10:30, 20:40] = 7
    rgb = np.repeat(((labels > 0) * 200).astype(np.uint8)[:, :, None], 3, axis=2)
    scene = Scene("s", 0.1, rgb, labels, np.ones(labels.shape, dtype=np.bool_)).resampled(0.2)
    assert scene.gsd_m == 0.2 and scene.buildings.shape == (20, 20)
    assert ((scene.rgb[:, :, 0] > 100) == (scene.buildings == 7)).mean() > 0.95


def test_crumbs_of_a_mask_are_no_buildings() -> None:
    mask = mask_with_two_squares()
    mask[0, 0] = 255
    assert components(mask).max() == 2


def test_wrong_folders_are_named_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(PlaceError, match="no image in images/ has a mask"):
        list(read_pairs(tmp_path / "images", tmp_path / "masks", 0.2))
    write(tmp_path / "images" / "a.png", np.zeros((32, 32, 3), dtype=np.uint8))
    write(tmp_path / "masks" / "a.png", np.zeros((16, 16), dtype=np.uint8))
    with pytest.raises(PlaceError, match=r"a\.png: its size is not that of a\.png"):
        list(read_pairs(tmp_path / "images", tmp_path / "masks", 0.2))
    with pytest.raises(PlaceError, match="a web tile is named"):
        list(read_web_tiles(tmp_path / "images", tmp_path / "masks"))
    (tmp_path / "images" / "a.png").write_bytes(b"not a picture")
    write(tmp_path / "masks" / "a.png", np.zeros((32, 32), dtype=np.uint8))
    with pytest.raises(PlaceError, match="is not a readable image"):
        list(read_pairs(tmp_path / "images", tmp_path / "masks", 0.2))
    with pytest.raises(PlaceError, match="is no place of the data"):
        place(tmp_path, "atlantis")
    with pytest.raises(PlaceError, match="needs georef"):
        read_ortho(tmp_path / "ortho.jpg", tmp_path / "outlines.geojson", tmp_path / "georef.json")
