"""The tiled build: the same tiles whoever describes them, in whatever order; nothing left of a failed one."""

from __future__ import annotations

import dataclasses
import gzip
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.reference import build as module
from buildloc_matcher.reference.build import BuildReport, build
from buildloc_matcher.reference.buildings import SourceRecord
from buildloc_matcher.reference.ingest import COUNTS, read_buildings
from buildloc_matcher.reference.tile import Tile
from buildloc_msgs_py.errors import BuildlocError
from distributed import LocalCluster
from shapely import box

CONFIG = MatcherConfig()
UTM = 32619


@pytest.fixture
def town(tmp_path: Path) -> Path:
    """4,000 houses over 3 x 3 km, with a gap of 1.2 km in the middle."""
    rng = np.random.default_rng(7)
    corners = rng.uniform([330_000.0, 4_700_000.0], [333_000.0, 4_703_000.0], (4000, 2))
    corners = corners[np.abs(corners - (331_500.0, 4_701_500.0)).max(axis=1) > 600.0]
    sides = rng.uniform(6.0, 20.0, corners.shape)
    path = tmp_path / "town.parquet"
    gpd.GeoDataFrame(geometry=box(*corners.T, *(corners + sides).T), crs=UTM).to_parquet(path)
    return path


class Memory:
    """Stands in for the writer of databases: keeps what it is given."""

    def __init__(self, path: Path, epsg: int, config: MatcherConfig) -> None:
        self.tiles: dict[str, Tile] = {}
        self.sources: list[SourceRecord] = []
        self.counts: dict[str, int] = {}

    def __enter__(self) -> Memory:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def add(self, name: str, tile: Tile) -> None:
        assert name not in self.tiles
        self.tiles[name] = tile

    def commit(self, sources: Sequence[SourceRecord], counts: Mapping[str, int]) -> None:
        self.sources, self.counts = list(sources), dict(counts)


def built(
    monkeypatch: pytest.MonkeyPatch, sources: list[Path], out: Path, **options: object
) -> tuple[Memory, BuildReport]:
    """What a build gives its writer."""
    writers: list[Memory] = []

    def writer(*args: object) -> Memory:
        writers.append(Memory(*args))  # type: ignore[arg-type]
        return writers[-1]

    monkeypatch.setattr(module, "DatabaseWriter", writer)
    report = build(sources, out, CONFIG, **options)  # type: ignore[arg-type]
    return writers[0], report


def same(one: object, other: object) -> bool:
    """Whether two values are equal, arrays in dataclasses bit for bit."""
    if dataclasses.is_dataclass(one):
        names = [field.name for field in dataclasses.fields(one)]
        return all(same(getattr(one, name), getattr(other, name)) for name in names)
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other)  # type: ignore[attr-defined]
    return bool(one == other)


@pytest.fixture(scope="module")
def cluster() -> Iterator[LocalCluster]:
    with LocalCluster(
        n_workers=2, threads_per_worker=1, memory_limit=0, dashboard_address="127.0.0.1:0"
    ) as found:
        yield found


def test_the_same_tiles_from_processes_a_cluster_and_here(
    town: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cluster: LocalCluster
) -> None:
    frame = gpd.read_parquet(town)
    shuffled = tmp_path / "shuffled.parquet"
    frame.sample(frac=1.0, random_state=1).to_parquet(shuffled)
    with monkeypatch.context() as patch:
        patch.setattr(module, "_processes", lambda _: nullcontext())
        here, report = built(patch, [town], tmp_path / "a", tile_km=1.0)
    processes, _ = built(monkeypatch, [shuffled], tmp_path / "b", tile_km=1.0)
    there, _ = built(monkeypatch, [town], tmp_path / "c", tile_km=1.0, scheduler=cluster.scheduler_address)
    assert len(here.tiles) == report.tiles > 4
    for other in (processes, there):
        assert other.tiles.keys() == here.tiles.keys()
        assert all(same(tile, here.tiles[name]) for name, tile in other.tiles.items())
        assert other.counts == here.counts
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []  # no spool is left


def test_every_building_belongs_to_one_tile(
    town: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, report = built(monkeypatch, [town], tmp_path / "a")
    assert report.tiles == len(found.tiles) == 1
    with monkeypatch.context() as patch:
        patch.setattr(module, "_processes", lambda _: nullcontext())
        many, _ = built(patch, [town], tmp_path / "b", tile_km=0.5)
    owned = [tile.buildings.centroids_m[: tile.owned] for tile in many.tiles.values()]
    whole = read_buildings([town], CONFIG.min_area_m2).buildings.centroids_m
    assert sorted(np.concatenate(owned).tolist()) == sorted(whole.tolist())


def test_the_report_says_what_became_of_everything(
    town: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages: list[str] = []
    found, report = built(
        monkeypatch, [town, town], tmp_path / "a", licence="ODbL 1.0", progress=messages.append
    )
    assert report.counts == found.counts and list(report.counts) == list(COUNTS)
    assert report.counts["overlapping"] > 0 and report.counts["read"] == 2 * len(gpd.read_parquet(town))
    assert [record.licence for record in found.sources] == ["ODbL 1.0"] * 2
    assert report.epsg == UTM and report.built_up_km2 in range(8, 17)
    assert set(report.seconds) == {"read and measure", "merge sources", "describe and write"}
    table = report.table()
    assert all(name.replace("_", " ") in table for name in COUNTS) and "buildings per km2" in table
    assert (
        any("read" in message for message in messages)
        and messages[-1] == "1 tiles described, 1 have buildings"
    )


def refused(text: str, *args: object, **options: object) -> None:
    with pytest.raises(BuildlocError, match=text) as error:
        build(*args, **options)  # type: ignore[arg-type]
    assert "\n" not in str(error.value)


def test_what_cannot_be_built_leaves_nothing(town: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.bldb"
    for tile_km in (0.0, -1.0, np.nan):
        refused("--tile-km", [town], out, CONFIG, tile_km=tile_km)
    refused("does not exist", [town], tmp_path / "nowhere" / "a.bldb", CONFIG)
    half = tmp_path / "half.csv.gz"
    half.write_bytes(gzip.compress(b'{"type": "Feature", "properties": {}, "geometry": null}')[:-9])
    refused("half.csv.gz: not a readable", [town, half], out, CONFIG)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["half.csv.gz", "town.parquet"]


def test_a_scheduler_must_answer_and_have_workers(
    town: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "CONNECT_S", 0.3)
    with LocalCluster(n_workers=0, dashboard_address="127.0.0.1:0") as idle:
        for address in ("tcp://127.0.0.1:9", "nonsense://", "", idle.scheduler_address):
            refused("no Dask scheduler", [town], tmp_path / "a.bldb", CONFIG, scheduler=address)
