"""Map files: what is written comes back, and what others wrote is taken as it is."""

from __future__ import annotations

import json
import re
from dataclasses import fields
from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest
import yaml
from buildloc.mapfile import read_map, write_map
from buildloc_msgs_py import topics
from buildloc_msgs_py.footprint import footprints
from buildloc_msgs_py.types import LocalMap
from buildloc_msgs_py.wire import MAP_ROW
from shapely.geometry import MultiPolygon, Polygon, box

OUTLINES = [
    box(0, 0, 10, 8),
    box(20, 0, 32, 9),
    Polygon([(40, 0), (60, 0), (60, 20), (50, 20), (50, 10), (40, 10)]),
]
LAYOUTS = Path(__file__).parents[1] / "buildloc" / "layouts"


def known_map() -> LocalMap:
    found = footprints(np.array(OUTLINES, dtype=object))
    spread = np.random.default_rng(1).normal(size=(3, 2, 2))
    return LocalMap(
        0, np.array([3, 7, 11]), found.centroids_m, found.areas_m2, found.shapes, np.array([2, 9, 4]),
        spread @ spread.swapaxes(1, 2), np.array([False, True, False]),
    )  # fmt: skip


def same(one: LocalMap, other: LocalMap) -> None:
    for field in fields(LocalMap):
        expected = getattr(other, field.name)
        np.testing.assert_allclose(getattr(one, field.name), expected, rtol=1e-12, err_msg=field.name)


@pytest.mark.parametrize("suffix", ["parquet", "geojson"])
def test_what_is_written_comes_back(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"map.{suffix}"
    write_map(OUTLINES, known_map(), path)
    same(read_map(path), known_map())


@pytest.mark.parametrize("suffix", ["parquet", "geojson"])
def test_the_columns_are_there_for_other_programs(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"map.{suffix}"
    write_map(OUTLINES, known_map(), path)
    frame = gpd.read_parquet(path) if suffix == "parquet" else gpd.read_file(path)
    assert frame["id"].tolist() == [3, 7, 11] and frame["cut"].tolist() == [False, True, False]
    assert frame["observations"].tolist() == [2, 9, 4]
    assert frame["covariance_yy"].tolist() == pytest.approx(known_map().covariances_m2[:, 1, 1].tolist())


@pytest.mark.parametrize("suffix", ["parquet", "geojson"])
def test_buildings_of_another_program_are_whole_and_seen_once(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"map.{suffix}"
    frame = gpd.GeoDataFrame({"id": ["a", "b", "c"]}, geometry=OUTLINES, crs=None)
    frame.to_parquet(path) if suffix == "parquet" else path.write_text(frame.to_json())
    known = known_map()
    expected = (known.centroids_m, known.areas_m2, known.shapes)
    same(read_map(path), LocalMap.whole(0, np.arange(3), *expected, np.ones(3, dtype=int)))


def test_a_map_whose_polygons_were_edited_is_taken_as_another_programs(tmp_path: Path) -> None:
    path = tmp_path / "map.parquet"
    write_map(OUTLINES, known_map(), path)
    frame = gpd.read_parquet(path)
    frame.loc[0, "geometry"] = MultiPolygon([box(0, 0, 5, 8), box(6, 0, 10, 8)])
    frame.to_parquet(path)
    found = read_map(path)
    assert len(found) == 4 and not found.cut.any() and np.isnan(found.covariances_m2).all()


def test_layouts_show_topics_and_fields_that_exist() -> None:
    foxglove = json.loads((LAYOUTS / "foxglove.json").read_text())
    rviz = yaml.safe_load((LAYOUTS / "buildloc.rviz").read_text())
    shown = set(re.findall(r'"(/buildloc/\w+)"', json.dumps([foxglove, rviz])))
    assert {topics.MAP, topics.KEYFRAMES, topics.MASK} <= shown
    assert shown <= {value for value in vars(topics).values() if isinstance(value, str)}
    (cloud,) = [d for d in rviz["Visualization Manager"]["Displays"] if d["Class"].endswith("PointCloud2")]
    coloured = foxglove["configById"]["3D!map"]["topics"][topics.MAP]["colorField"]
    assert {cloud["Channel Name"], coloured} <= set(MAP_ROW.names or ())
