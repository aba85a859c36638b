"""The picture of a map: images lie where the graph has put them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from buildloc.map_picture import MapPicture
from buildloc_mapper.config import MapperConfig
from buildloc_mapper.mapper import Mapper
from buildloc_msgs_py.types import Keyframe
from textured import GSD, SIDE, WORLD, shoot, tilt

FLIGHT = [(-20.0, 3.0, 0.3, 60.0, tilt(0.04, -0.05)), (0.0, 0.0, 1.2, 55.0, tilt(-0.06, 0.02))]


def test_the_mosaic_shows_the_ground_where_it_is() -> None:
    picture = MapPicture()
    keyframes = []
    for stamp, (x, y, yaw, altitude, attitude) in enumerate(FLIGHT):
        picture.add(shoot(stamp, x, y, yaw, altitude, attitude)[0])
        keyframes.append(Keyframe(stamp, x, y, yaw))
    mosaic = picture.mosaic(keyframes)
    rows, columns = mosaic.image_rgba.shape[:2]
    west, east, south, north = mosaic.extent_m
    x = west + (np.arange(columns) + 0.5) * (east - west) / columns
    y = north - (np.arange(rows) + 0.5) * (north - south) / rows
    u, v = np.meshgrid(x / GSD + SIDE / 2 - 0.5, SIDE / 2 - 0.5 - y / GSD)
    blurred = cv2.GaussianBlur(WORLD, (0, 0), 1.0)
    true = cv2.remap(blurred, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
    seen = mosaic.image_rgba[:, :, 3] > 0
    assert 0.4 < seen.mean() < 0.95  # two frames that stand askew in their box
    shown = mosaic.image_rgba[:, :, 2::-1]
    assert np.abs(shown[seen].astype(float) - true[seen]).mean() < 6.0
    moved = np.roll(shown, 6, axis=1)  # 1.3 m beside
    assert np.abs(moved[seen].astype(float) - true[seen]).mean() > 12.0


def test_a_map_is_drawn_with_its_links(tmp_path: Path) -> None:
    picture, mapper = MapPicture(), Mapper(MapperConfig())
    for stamp, pose in enumerate(FLIGHT):
        frame, mask = shoot(stamp, *pose)
        picture.add(frame)
        update = mapper.add(frame, mask)
    assert update is not None and (0, 1, "consecutive") in update.links
    picture.write(update, tmp_path / "map.png", "drawn")
    drawn = cv2.imread(str(tmp_path / "map.png"))
    assert drawn is not None and drawn.std() > 20.0


def test_an_image_that_was_not_kept_is_an_error() -> None:
    with pytest.raises(KeyError):
        MapPicture().mosaic([Keyframe(7, 0.0, 0.0, 0.0)])
