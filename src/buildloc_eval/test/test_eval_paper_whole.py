"""`buildloc eval paper` from footprints and orthophotos to its report: a short flight over invented data."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import cv2
import geopandas as gpd
import numpy as np
import pytest
import shapely
from browser import open_page
from buildloc_eval.orthos import BANEPA_TILE_PX
from buildloc_eval.paper import evaluate
from buildloc_eval.paper.flights import CENTRES_M, EPSG
from buildloc_eval.paper.methods import METHODS
from buildloc_eval.paper.netvlad import NETVLAD, Encoders
from buildloc_eval.paper.plan import Models, Plan
from buildloc_eval.realworld import DATA_VARIABLE, DataError, data_folder
from buildloc_eval.segmentation_errors import SegmentationErrors
from buildloc_eval.town import suburb

# One process flies, and whoever looks at its report waits for it.
pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("eval_paper_whole")]

MILD = SegmentationErrors(
    1, 0.1, 0.05, 0.02, 100.0, 0.1, 30.0, 0.5, 0.0, 0.1, (0.05, 0.05, 0.05, 0.05), 0.6, 1, 0.1, 0.2, 0.5
)
PLAN = Plan(("flight1",), 2, (1,), {"default preset": {1: 2}})
TILES, FIRST = 8, (386_300, 220_700)  # a side of the orthophoto, and the tile of its corner
DESKTOP_PX = 1280


def invent(data: Path) -> None:
    """A suburb below the first flight, and ground of noise in the place of Banepa's, which it sees."""
    (data / "footprints").mkdir()
    houses = shapely.transform(np.array(suburb(1, 1500.0)), lambda xy: xy + CENTRES_M[0])
    degrees = gpd.GeoSeries(houses, crs=EPSG).to_crs(4326)
    gpd.GeoDataFrame(geometry=degrees).to_parquet(data / "footprints" / "boston_osm.parquet")
    folder, side = data / "imagery" / "banepa_ortho", BANEPA_TILE_PX
    (folder / "tiles").mkdir(parents=True)
    rng = np.random.default_rng(1)
    noise = sum(
        cv2.resize(rng.normal(0.0, 9.0 * scale**0.5, (TILES * side // scale,) * 2), (TILES * side,) * 2)
        for scale in (2, 8, 32)
    )
    ground = np.dstack([np.clip(noise + 120.0, 0, 255).astype(np.uint8)] * 3)
    for x in range(TILES):
        for y in range(TILES):
            tile = ground[y * side : (y + 1) * side, x * side : (x + 1) * side]
            cv2.imwrite(str(folder / "tiles" / f"OAM-{FIRST[0] + x}-{FIRST[1] + y}-19.jpg"), tile)
    longitude, latitude = FIRST[0] / 2**19 * 360.0 - 180.0, 27.63
    label = shapely.box(longitude, latitude, longitude + 1e-4, latitude + 1e-4)
    gpd.GeoSeries([label], crs=4326).to_file(folder / "labels.geojson")


def coarse(tiles: np.ndarray) -> np.ndarray:
    """In the place of NetVLAD's networks: a tile of 8 by 8, of length 1."""
    small = np.array([cv2.resize(tile[0], (8, 8), interpolation=cv2.INTER_AREA).ravel() for tile in tiles])
    return np.asarray(small / np.maximum(np.linalg.norm(small, axis=1, keepdims=True), 1e-9))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, list[str]]:
    """The folder of a run, its summary and what it said."""
    data, out = tmp_path_factory.mktemp("data"), tmp_path_factory.mktemp("out")
    invent(data)
    said: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(DATA_VARIABLE, str(data))
        patch.setattr(evaluate, "QUICK", PLAN)
        patch.setattr(evaluate, "measured_models", lambda: Models(MILD))
        patch.setattr(evaluate, "load_encoders", lambda _: Encoders(coarse, coarse, "by hand"))
        text = evaluate.evaluate(out, 1, True, said.append, parts=("boston",), netvlad=out)
    return out, text, said


def test_a_short_flight_is_flown_mapped_located_and_reported(run: tuple[Path, str, list[str]]) -> None:
    out, text, said = run
    report = json.loads((out / "report.json").read_text())
    (chapter,) = report["what is real"]
    told: dict[str, Any] = report[chapter]
    recall = {(row["method"], row["metric"]): row["1 km"] for row in told["recall"] if "1 km" in row}
    assert {method for method, _ in recall} == {NETVLAD, *METHODS}
    # Two flights over a suburb of some thousand houses, with small errors: less than both would be a defect.
    assert recall["default preset", "R@1"].startswith("1.000")
    (flown,) = told["flights and references"]
    assert flown["keyframes"] == flown["paper's keyframes"] == 20 and flown["buildings mapped"] > 15
    (trace,) = told["convergence"]
    assert trace["flights"] == trace["stable success, flights"] == 2
    assert 1 <= trace["first success"] <= trace["stable success"] <= 20
    assert trace["by flight, first"].startswith("flight1: ")
    assert told["failures of the default preset, one by one"] == []
    assert told["plan"]["seeds"] == 2 and report["command"] and report["versions"]["numpy"]
    stages = [line.split(":")[0] for line in said if "left" in line]
    assert list(dict.fromkeys(stages)) == [
        "registering keyframes", "mapping flight1", "locating", "BRM", NETVLAD
    ]  # fmt: skip
    assert told["not done"] == [] and "NetVLAD" in text


def test_the_report_is_whole_in_a_browser(run: tuple[Path, str, list[str]], tmp_path: Path) -> None:
    out, _, _ = run
    page = open_page(out / "report.html", DESKTOP_PX, out / "report.png", tmp_path)
    assert page.title == "The paper's experiments on open data"
    assert page.console == []
    # Trajectories, convergence, radius, candidates.
    assert len(page.images) == 4
    assert all(image["decoded"] > 100 and image["width"] > 100 < image["height"] for image in page.images)
    assert len(page.tables) >= 10
    assert all(table["width"] > 50 and table["height"] > 15 for table in page.tables)
    assert page.wide <= DESKTOP_PX
    assert cv2.imread(str(out / "report.png")).shape[1] == DESKTOP_PX


@pytest.mark.data
def test_the_quick_run_on_real_data_writes_its_report(tmp_path: Path) -> None:
    try:
        data_folder()
    except DataError as error:
        pytest.skip(str(error))
    text = evaluate.evaluate(tmp_path, 1, True, lambda _: None)
    report = json.loads((tmp_path / "report.json").read_text())
    assert set(report["what is real"]) < set(report)
    assert {row["what"] for row in report["bars"]} >= {"default preset, recall@1 at 12 km"}
    assert "Seven flights over Boston" in text
    pictures = re.findall('src="data:image/png;base64,([^"]+)"', (tmp_path / "report.html").read_text())
    # No chapter draws over another's.
    assert len(set(pictures)) == len(pictures) == len(list(tmp_path.rglob("*.png"))) >= 5
