"""`buildloc locate` and `buildloc refdb info` as users meet them: the answer, and bad input in one line."""

from __future__ import annotations

import hashlib
import json
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pytest
from buildloc.cli import main
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.geometry import rotation
from buildloc_matcher.reference.build import build
from buildloc_matcher.reference.database import MANIFEST, open_database
from buildloc_msgs_py.types import FloatArray
from pyproj import Transformer
from scipy.spatial import cKDTree
from shapely import MultiPolygon, Polygon, affinity, box
from shapely.geometry.base import BaseGeometry

UTM = 32619
ORIGIN_M = np.array([320_000.0, 4_700_000.0])
YAW = 2.2
SIDE_M, SEEN_M = 1200.0, 230.0
LICENCE = "ODbL 1.0"
TO_UTM = Transformer.from_crs(4326, UTM, always_xy=True)


def houses() -> list[Polygon]:
    """Rectangles anywhere in a square, none over another."""
    rng = np.random.default_rng(5)
    spots = np.add(rng.uniform(0.0, SIDE_M, (4000, 2)), ORIGIN_M)
    close = cKDTree(spots).query_pairs(27.0, output_type="ndarray")
    found = []
    for x, y in np.delete(spots, np.unique(close[:, 1]), axis=0):
        wide, high = rng.uniform(6.0, 12.0), rng.uniform(8.0, 24.0)
        outline = box(x - wide / 2, y - high / 2, x + wide / 2, y + high / 2)
        found.append(affinity.rotate(outline, rng.uniform(0.0, 180.0)))
    return found


HOUSES = houses()
CENTRE_M = ORIGIN_M + SIDE_M / 2.0


def to_local(outline: BaseGeometry) -> BaseGeometry:
    """Into the frame of the map: turned by -YAW around the middle of the town, which becomes (100, -50)."""
    moved = affinity.translate(outline, *(-CENTRE_M))
    return affinity.translate(affinity.rotate(moved, -YAW, origin=(0, 0), use_radians=True), 100.0, -50.0)


def to_world(point_m: FloatArray) -> FloatArray:
    return np.asarray((point_m - (100.0, -50.0)) @ rotation(YAW).T + CENTRE_M)


SEEN = [h for h in HOUSES if math.dist((h.centroid.x, h.centroid.y), CENTRE_M) < SEEN_M]
MAP = [to_local(house) for house in SEEN]
MEAN_M = np.mean([(outline.centroid.x, outline.centroid.y) for outline in MAP], axis=0)


def write_map(path: Path, outlines: list[Any]) -> Path:
    """GeoJSON without CRS, or GeoParquet by suffix; a dict is a geometry as it is."""
    if path.suffix == ".parquet":
        gpd.GeoDataFrame(geometry=outlines, crs=None).to_parquet(path)
        return path
    shapes = [outline if isinstance(outline, dict) else outline.__geo_interface__ for outline in outlines]
    features = [{"type": "Feature", "properties": {}, "geometry": shape} for shape in shapes]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The town's footprints, its database and a map of its middle."""
    made = tmp_path_factory.mktemp("locate")
    gpd.GeoDataFrame(geometry=HOUSES, crs=UTM).to_crs(4326).to_file(made / "town.geojson", driver="GeoJSON")
    build([made / "town.geojson"], made / "town.bldb", MatcherConfig(), licence=LICENCE)
    write_map(made / "map.geojson", MAP)
    return made


Locate = Callable[..., dict[str, Any]]


@pytest.fixture
def locate(folder: Path, capsys: pytest.CaptureFixture[str]) -> Locate:
    """The parsed answer of `buildloc locate --json`: what a strict reader of JSON accepts."""

    def run(path: Path | None = None, *options: str) -> dict[str, Any]:
        path = path or folder / "map.geojson"
        assert main(["locate", str(folder / "town.bldb"), str(path), "--json", *options]) == 0
        said = capsys.readouterr()
        assert said.err == ""

        def no_number(text: str) -> None:
            raise AssertionError(f"{text} is no JSON")

        return dict(json.loads(said.out, parse_constant=no_number))

    return run


def place(row: dict[str, Any]) -> FloatArray:
    return np.array(TO_UTM.transform(row["lon"], row["lat"]))


def test_the_answer_has_what_was_promised(locate: Locate) -> None:
    answer = locate()
    assert answer.keys() == {"fix", "reason", "candidates", "funnel", "seconds"} and answer["reason"] is None
    fix = answer["fix"]
    assert fix.keys() == {"lat", "lon", "yaw_deg", "scale", "covariance", "score"}
    # A map without errors; the degrees of the footprints have 7 decimals: 1 cm.
    np.testing.assert_allclose(place(fix), to_world(MEAN_M), atol=0.1)
    assert fix["yaw_deg"] == pytest.approx(math.degrees(YAW), abs=0.05)
    assert fix["scale"] == pytest.approx(1.0, abs=1e-3)
    (xx, xy), (yx, yy) = fix["covariance"]
    assert xx == yy > 1.5**2 and xy == yx == 0.0  # no better than the reference's registration
    for rank, row in enumerate(answer["candidates"], start=1):
        assert row.keys() == {"rank", "lat", "lon", "yaw_deg", "scale", "votes", "mnn_jaccard", "score"}
        assert row["rank"] == rank
    best = answer["candidates"][0]
    assert best["score"] == fix["score"] > 15.0 and best["mnn_jaccard"] > 0.9
    np.testing.assert_allclose(place(best), to_world(MEAN_M), atol=0.1)
    funnel = answer["funnel"]
    wanted = {"stars", "pairs_tested", "pairs_passed", "hypotheses", "bins", "clusters", "rescored"}
    assert wanted <= funnel.keys() and funnel["buildings"] == len(MAP)
    assert funnel["pairs_tested"] >= funnel["pairs_passed"] > 0
    assert answer["seconds"].keys() == {"describe", "match", "hypothesize", "vote", "select"}


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_at_moves_the_answer_by_the_turned_offset(locate: Locate, preset: str) -> None:
    options = ("--preset", preset)
    mean = locate(None, *options)["fix"]
    for point in ((0.0, 0.0), (100.0, -50.0), (-60.0, 180.0)):
        fix = locate(None, *options, f"--at={point[0]},{point[1]}")["fix"]
        offset = rotation(math.radians(mean["yaw_deg"])) @ (np.array(point) - MEAN_M)
        # The scale of either preset is within a thousandth or, averaged over hypotheses, near it.
        np.testing.assert_allclose(place(fix), place(mean) + mean["scale"] * offset, atol=0.2)
        assert np.hypot(*(place(fix) - to_world(np.array(point)))) < 3.0
        assert fix["covariance"][0][0] > 1.5**2


def test_top_limits_what_is_listed(locate: Locate) -> None:
    everything = locate(None, "--preset", "paper", "--top", "1000")["candidates"]
    assert len(everything) == 20 and len(locate(None, "--preset", "paper")["candidates"]) == 10
    three = locate(None, "--preset", "paper", "--top", "3")
    assert three["candidates"] == everything[:3]
    none = locate(None, "--top", "0")
    assert none["candidates"] == [] and none["fix"] is not None


def test_presets_by_name_in_every_way(folder: Path, locate: Locate, tmp_path: Path) -> None:
    paper, default = locate(None, "--preset", "paper"), locate(None, "--preset", "default")
    assert default["candidates"] == locate()["candidates"] != paper["candidates"]
    settings = tmp_path / "settings.yaml"
    settings.write_text("matcher_node: {ros__parameters: {preset: paper}}")
    assert locate(None, "--config", str(settings))["candidates"] == paper["candidates"]
    assert locate(None, "--set", "matcher_node.preset=paper")["candidates"] == paper["candidates"]
    # The command line goes over the file.
    over = locate(None, "--config", str(settings), "--preset", "default")
    assert over["candidates"] == default["candidates"]
    fewer = locate(None, "--preset", "paper", "--set", "matcher_node.top_k=4", "--top", "100")
    assert len(fewer["candidates"]) <= 4


def test_a_parquet_map_answers_as_a_geojson_map(locate: Locate, tmp_path: Path) -> None:
    found, expected = locate(write_map(tmp_path / "map.parquet", MAP)), locate()
    for name in ("lat", "lon", "yaw_deg"):
        assert found["fix"][name] == pytest.approx(expected["fix"][name], abs=1e-7)


def test_people_read_a_table(folder: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["locate", str(folder / "town.bldb"), str(folder / "map.geojson")]) == 0
    said = capsys.readouterr().out
    assert said.splitlines()[0].split() == [
        "rank",
        "latitude",
        "longitude",
        "yaw_deg",
        "scale",
        "votes",
        "jaccard",
        "score",
    ]
    assert "fix: 42.4" in said and "sigma 1.5 m" in said
    few = write_map(tmp_path / "few.geojson", MAP[:5])
    assert main(["locate", str(folder / "town.bldb"), str(few)]) == 0
    assert "no fix: undecided: map has 5 buildings, fewer than 12" in capsys.readouterr().out


def test_processes_share_a_database(folder: Path, locate: Locate) -> None:
    command = [
        sys.executable,
        "-m",
        "buildloc.cli",
        "locate",
        folder / "town.bldb",
        folder / "map.geojson",
        "--json",
    ]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    answers = [json.loads(process.communicate()[0]) for process in running]
    expected = locate()
    for answer in answers:
        assert answer["fix"] == expected["fix"] and answer["candidates"] == expected["candidates"]


# Maps that give no fix, and say why


def square(x: float, y: float, side: float = 10.0) -> Polygon:
    return box(x, y, x + side, y + side)


def elsewhere() -> list[Polygon]:
    rng = np.random.default_rng(9)
    return [
        square(x, y, side)
        for x, y, side in np.column_stack([rng.uniform(0, 400, (60, 2)), rng.uniform(6, 18, 60)])
    ]


NO_FIX: dict[str, tuple[list[Polygon], str]] = {
    "one building": (MAP[:1], "map has 1 buildings, fewer than 12"),
    "two buildings": (MAP[:2], "map has 2 buildings, fewer than 12"),
    "sheds": ([square(20.0 * i, 7.0 * i * i, 4.0) for i in range(30)], "map has 0 buildings, fewer than 12"),
    "on a line": ([square(30.0 * i, 0.0) for i in range(30)], "rejected: "),
    "in one place": ([square(0.0, 0.0)] * 30, "no candidate"),
    "in one place, of all sizes": ([square(-i, -i, 2.0 * i) for i in range(3, 40)], "no candidate"),
    "another town": (elsewhere(), ""),
    "mirrored": ([affinity.scale(outline, -1.0, 1.0, origin=(0, 0)) for outline in MAP], ""),
    "twice as large": ([affinity.scale(outline, 2.0, 2.0, origin=(0, 0)) for outline in MAP], ""),
}


@pytest.mark.parametrize("kind", NO_FIX)
@pytest.mark.parametrize("preset", ["default", "paper"])
def test_a_map_that_cannot_be_placed_has_a_reason(
    locate: Locate, tmp_path: Path, kind: str, preset: str
) -> None:
    outlines, text = NO_FIX[kind]
    answer = locate(write_map(tmp_path / "map.geojson", outlines), "--preset", preset)
    assert answer["fix"] is None and answer["reason"] and text in answer["reason"]
    assert "\n" not in answer["reason"] and answer["funnel"]["buildings"] <= len(outlines)


# Maps with faults that do no harm


def test_every_building_twice_is_located(locate: Locate, tmp_path: Path) -> None:
    answer = locate(write_map(tmp_path / "map.geojson", MAP + MAP))
    np.testing.assert_allclose(place(answer["candidates"][0]), to_world(MEAN_M), atol=1.0)


def bow_tie(outline: BaseGeometry) -> dict[str, Any]:
    """The outline with two corners exchanged: it crosses itself."""
    a, b, c, d = list(outline.exterior.coords)[:4]
    return {"type": "Polygon", "coordinates": [[a, c, b, d, a]]}


def test_a_few_impossible_outlines_do_not_spoil_the_rest(locate: Locate, tmp_path: Path) -> None:
    x, y = MEAN_M
    nan = {"type": "Polygon", "coordinates": [[[x, y], [math.nan, y], [x + 9, y + 9], [x, y + 9], [x, y]]]}
    spike = {"type": "Polygon", "coordinates": [[[x, y], [x + 30, y], [x, y], [x, y]]]}
    others = [{"type": "Point", "coordinates": [x, y]}, {"type": "Polygon", "coordinates": []}]
    crossed = [bow_tie(outline) for outline in MAP[:5]]
    path = write_map(tmp_path / "map.geojson", [*crossed, nan, spike, *others, *MAP[5:]])
    answer = locate(path, f"--at={x},{y}")
    assert answer["fix"] is not None
    np.testing.assert_allclose(place(answer["fix"]), to_world(MEAN_M), atol=1.0)


def test_a_map_that_crosses_itself_everywhere_is_answered(locate: Locate, tmp_path: Path) -> None:
    answer = locate(write_map(tmp_path / "map.geojson", [bow_tie(outline) for outline in MAP]))
    assert answer["reason"] is None or "\n" not in answer["reason"]
    assert answer["funnel"]["buildings"] > len(MAP)  # each has become two triangles


def test_a_multipolygon_is_its_parts(locate: Locate, tmp_path: Path) -> None:
    one = locate(write_map(tmp_path / "map.geojson", [MultiPolygon(MAP)]))
    np.testing.assert_allclose(place(one["fix"]), to_world(MEAN_M), atol=0.1)


# What ends in one line


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    capsys.readouterr()
    assert main([str(argument) for argument in arguments]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.startswith("error: ") and said.err.count("\n") == 1
    return said.err


@pytest.mark.parametrize("suffix", ["geojson", "parquet"])
def test_a_map_in_degrees_is_said(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], suffix: str
) -> None:
    frame = gpd.GeoDataFrame(geometry=SEEN, crs=UTM).to_crs(4326)
    path = write_map(tmp_path / f"map.{suffix}", list(frame.geometry))
    assert "as if in degrees; project it to metres" in refused(capsys, "locate", folder / "town.bldb", path)


def test_maps_without_a_building(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nan = {"type": "Polygon", "coordinates": [[[0, 0], [math.nan, 0], [9, 9], [0, 0]]]}
    flat = {"type": "Polygon", "coordinates": [[[0, 0], [9, 0], [0, 0], [0, 0]]]}
    for name, outlines in (("empty", []), ("nan", [nan] * 20), ("flat", [flat] * 20)):
        path = write_map(tmp_path / f"{name}.geojson", outlines)
        assert "no building polygon" in refused(capsys, "locate", folder / "town.bldb", path)
    for name, content in (("no.geojson", "no JSON"), ("no.parquet", "no parquet"), ("nothing.geojson", "")):
        (tmp_path / name).write_text(content)
        assert name in refused(capsys, "locate", folder / "town.bldb", tmp_path / name)
    assert "absent.geojson" in refused(capsys, "locate", folder / "town.bldb", tmp_path / "absent.geojson")


def test_unknown_presets_and_parameters(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ("locate", folder / "town.bldb", folder / "map.geojson")
    text = "preset fast is unknown; there are default, paper"
    assert text in refused(capsys, *arguments, "--set", "matcher_node.preset=fast")
    settings = tmp_path / "settings.yaml"
    settings.write_text("matcher_node: {ros__parameters: {preset: fast}}")
    assert text in refused(capsys, *arguments, "--config", settings)
    assert "votes = loud is not one of" in refused(capsys, *arguments, "--set", "matcher_node.votes=loud")
    assert text in refused(capsys, *arguments, "--preset", "fast")
    for options in (("--at", "1,2,3"), ("--at", "nan,1"), ("--at", "x"), ("--top", "few"), ("--top", "-1")):
        with pytest.raises(SystemExit) as ended:  # of the parser, with its usage
            main([*map(str, arguments), *options])
        assert ended.value.code == 2 and options[0] in capsys.readouterr().err


@pytest.mark.parametrize(
    ("override", "text"),
    [
        ("matcher_node.min_jacard=0.5", "parameter min_jacard is unknown to MatcherConfig"),
        ("mapper_node.map_gsd=0.5", "parameter map_gsd is unknown to MapperConfig"),
        ("segmenter_node.thread=1", "parameter thread is unknown to SegmenterConfig"),
        ("reference_db_node.databse=x", "parameter databse is unknown to MatcherConfig"),
    ],
)
def test_nodes_are_not_started_with_a_parameter_that_they_do_not_have(
    override: str, text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert text in refused(capsys, "launch", "--set", override)
    assert text in refused(capsys, "replay", tmp_path / "bag", "--set", override)


def test_another_minimum_area_needs_another_database(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ("locate", folder / "town.bldb", folder / "map.geojson")
    said = refused(capsys, *arguments, "--set", "matcher_node.min_area_m2=40")
    assert "another descriptor configuration" in said and "refdb build" in said


# refdb info


def test_info_prints_what_the_database_is(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["refdb", "info", str(folder / "town.bldb")]) == 0
    lines = capsys.readouterr().out.splitlines()
    told = dict(line.strip().split(maxsplit=1) for line in lines)
    database = open_database(folder / "town.bldb", MatcherConfig())
    assert told["format"] == "buildloc-reference 3" and told["CRS"] == f"EPSG:{UTM}"
    assert told["stars"] == f"{database.stars:,}" and told["buildings"] == f"{len(database):,}"
    west, south, east, north = database.bounds_m
    assert told["bounds"].startswith(f"{west:.0f} {south:.0f} {east:.0f} {north:.0f} m")
    digest = hashlib.sha256((folder / "town.geojson").read_bytes()).hexdigest()
    source = f"{folder / 'town.geojson'}, {len(HOUSES)} geometries, licence: {LICENCE}"
    assert (told["source"], told["sha256"]) == (source, digest)
    assert (told["read"], told["used"]) == (str(len(HOUSES)), f"{len(database):,}")
    text = "\n".join(lines)
    for figure in (
        "checksums agree",
        "bytes per building",
        "descriptor hash",
        "minimum area",
        "south-west 42.4",
    ):
        assert figure in " ".join(text.split()), figure


def test_a_damaged_database_is_refused_by_every_command(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "town.bldb"
    path.mkdir()
    for file in (folder / "town.bldb").iterdir():
        (path / file.name).write_bytes(file.read_bytes())
    table = next(path.glob("*.triangles.arrow"))
    data = bytearray(table.read_bytes())
    data[len(data) // 2] ^= 16
    table.write_bytes(data)
    for command in (("locate", path, folder / "map.geojson"), ("refdb", "info", path)):
        said = refused(capsys, *command)
        assert "truncated or damaged" in said and table.name in said and "refdb build" in said
    manifest = json.loads((path / MANIFEST).read_text())
    (path / MANIFEST).write_text(json.dumps(manifest | {"version": 1}))
    for command in (("locate", path, folder / "map.geojson"), ("refdb", "info", path)):
        assert "has version 1, not 3; build it again" in refused(capsys, *command)
