"""Barnarp set into Lexington: enough buildings, a hole where it lies, nothing scaled."""

from __future__ import annotations

import os
from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest
import shapely
from buildloc_eval.realworld import DataError, data_folder, place_barnarp
from buildloc_eval.world import OrthoWorld

DATA = Path(os.environ.get("BUILDLOC_DATA", Path(__file__).parents[4] / "shared" / "data"))


def test_absent_data_is_said_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BUILDLOC_DATA", str(tmp_path))
    with pytest.raises(DataError, match="set BUILDLOC_DATA to the folder"):
        data_folder()


@pytest.mark.data
def test_barnarp_is_moved_rigidly_into_a_hole(tmp_path: Path) -> None:
    if not (DATA / "footprints").is_dir():
        pytest.skip(f"no real footprints: {DATA} is absent (set BUILDLOC_DATA)")
    ground = place_barnarp(DATA, tmp_path)
    world = OrthoWorld(ground.ortho, ground.georef)
    assert ground.buildings >= 30_000
    placed = gpd.read_parquet(ground.footprints).geometry.to_crs(world.epsg)
    inside = placed[shapely.intersects(placed.to_numpy(), shapely.box(*world.bounds_m))]
    original = gpd.read_file(DATA / "imagery" / "barnarp" / "footprints.geojson").geometry
    assert len(inside) == len(original)
    equal_area = original.to_crs("+proj=laea +lat_0=57.7 +lon_0=14.14 +units=m")
    # UTM's own scale is within a thousandth; anything scaled would show.
    assert np.allclose(np.sort(inside.area), np.sort(equal_area.area), rtol=3e-3)
    # The labels of the orthophoto lie on the placed outlines: what the georeference claims.
    labels = OrthoWorld(DATA / "imagery" / "barnarp" / "labels.png", ground.georef)
    window = labels.window(labels.bounds_m)
    middle = np.array([(g.representative_point().x, g.representative_point().y) for g in inside])
    columns = ((middle[:, 0] - window.left_m) / window.gsd_m).astype(int)
    rows = ((window.top_m - middle[:, 1]) / window.gsd_m).astype(int)
    within = (rows >= 0) & (columns >= 0) & (rows < 5120) & (columns < 8704)
    assert (window.image_bgr[rows[within], columns[within], 0] > 127).mean() > 0.97
