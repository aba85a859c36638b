"""Build a reference database from footprint files: ingest, tiles over Dask, one artefact."""

from __future__ import annotations

import importlib.util
import itertools
import logging
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from buildloc_msgs_py.errors import BuildlocError
from dask.system import CPU_COUNT
from distributed import Client, KilledWorker, LocalCluster, as_completed

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.reference.buildings import Buildings
from buildloc_matcher.reference.database import DatabaseWriter
from buildloc_matcher.reference.ingest import COUNTS, Progress, ingest, open_sources, zone_of
from buildloc_matcher.reference.merge import overlapping_ids, windows
from buildloc_matcher.reference.region import Bounds, Region
from buildloc_matcher.reference.spool import Key, Spool, squares
from buildloc_matcher.reference.tile import MARGIN_M, Tile, make_tile

CONNECT_S = 10.0


class BuildError(BuildlocError):
    """A database cannot be built as asked."""


@dataclass(frozen=True)
class BuildReport:
    """What a build read, dropped and kept (see ingest.COUNTS), and how long each stage took.

    ``built_up_km2`` counts the squares of one kilometre that hold a building.
    """

    epsg: int
    counts: dict[str, int]
    tiles: int
    built_up_km2: int
    seconds: dict[str, float]

    def table(self) -> str:
        """For people: one line per figure."""
        lines = [(name.replace("_", " "), f"{count:,}") for name, count in self.counts.items()]
        lines += [("tiles", f"{self.tiles:,}"), ("built-up km2", f"{self.built_up_km2:,}")]
        lines += [("buildings per km2", f"{self.counts['used'] / max(self.built_up_km2, 1):,.0f}")]
        lines += [(f"{name}, s", f"{seconds:.1f}") for name, seconds in self.seconds.items()]
        return "\n".join(f"{name:>20}  {value:>12}" for name, value in lines)


@dataclass(frozen=True)
class _Job:
    """A tile to be described: ``buildings`` are those of the box grown by MARGIN_M."""

    name: str
    box_m: Bounds
    buildings: Buildings


def build(
    sources: Sequence[Path],
    out: Path,
    config: MatcherConfig,
    region: Region | None = None,
    *,
    tile_km: float = 20.0,
    licence: str | None = None,
    scheduler: str | None = None,
    progress: Progress = lambda _: None,
) -> BuildReport:
    """Build the database ``out``; the same tiles bit for bit whatever the tiles' order and the workers.

    Tiles are described by local processes, one per core, or by the Dask cluster whose scheduler is named; a
    single tile in this process. ``licence`` overrides what the files state. Script users: starting processes
    needs ``if __name__ == "__main__":`` as ever.

    Raises BuildlocError with one line when something cannot be used.
    """
    if not 0.0 < tile_km < np.inf:
        raise BuildError(f"tiles of {tile_km:g} km are impossible; give a positive --tile-km")
    clock = _Clock()
    opened = open_sources(sources)
    epsg = zone_of(opened, region)
    with ExitStack() as stack:
        client = None if scheduler is None else stack.enter_context(_cluster(scheduler))
        writer = stack.enter_context(DatabaseWriter(out, epsg, config))
        # Beside the database, because /tmp is memory on many machines.
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent))
        spool = Spool(Path(folder), tile_km * 1000.0, len(sources) > 1)
        read = ingest(opened, spool, epsg, region, config.min_area_m2, licence, progress)
        clock.lap("read and measure")
        replaced = overlapping_ids(spool)
        clock.lap("merge sources")
        if client is None:
            client = stack.enter_context(_processes(len(spool.tiles())))
        if client is not None:
            progress(_dashboard(client))
        counts = Counter(read.counts)
        squares_km: set[Key] = set()
        keys = _tiles_near(spool)
        found = windows(spool, replaced, (spool.box_m(key) for key in keys), MARGIN_M, counts)
        done = 0
        for name, tile in _described(_jobs(spool, keys, found, squares_km), client, config):
            writer.add(name, tile)
            done += 1
            progress(f"{done} tiles described, {len(spool.tiles())} have buildings")
        table = {name: counts[name] for name in COUNTS}
        writer.commit(read.records, table)
        clock.lap("describe and write")
    return BuildReport(epsg, table, done, len(squares_km), clock.seconds)


class _Clock:
    """Seconds per stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.monotonic()

    def lap(self, stage: str) -> None:
        now = time.monotonic()
        self.seconds[stage], self._last = now - self._last, now


def _tiles_near(spool: Spool) -> list[Key]:
    """Tiles that own a building, and those within the margin: a star may lie in one without buildings."""
    reach = int(np.ceil(MARGIN_M / spool.tile_m))
    around = range(-reach, reach + 1)
    return sorted({(i + di, j + dj) for i, j in spool.tiles() for di in around for dj in around})


def _jobs(
    spool: Spool, keys: Iterable[Key], found: Iterable[Buildings], squares_km: set[Key]
) -> Iterator[_Job]:
    """The tiles that buildings surround; ``squares_km`` grows by the square kilometres they are in."""
    for (i, j), buildings in zip(keys, found, strict=True):
        if len(buildings) == 0:
            continue
        west, south, east, north = box = spool.box_m((i, j))
        (x0, y0), (x1, y1) = buildings.centroids_m.min(axis=0), buildings.centroids_m.max(axis=0)
        if x0 < east and x1 >= west and y0 < north and y1 >= south:
            occupied = np.unique(squares(buildings.centroids_m, 1000.0), axis=0)
            squares_km |= {(int(x), int(y)) for x, y in occupied}
            yield _Job(f"{i}_{j}", box, buildings)


def _described(
    jobs: Iterator[_Job], client: Client | None, config: MatcherConfig
) -> Iterator[tuple[str, Tile]]:
    """Tiles by name as they are finished, by a cluster or here; a few jobs at a time are on the way."""
    if client is None:
        for job in jobs:
            yield job.name, make_tile(job.buildings, job.box_m, config)
        return
    names: dict[str, str] = {}
    running = as_completed()

    def submit(some: Iterable[_Job]) -> None:
        for job in some:
            data = client.scatter(job.buildings, hash=False)
            future = client.submit(make_tile, data, job.box_m, config, pure=False)
            names[future.key] = job.name
            running.add(future)

    submit(itertools.islice(jobs, 2 * sum(client.nthreads().values())))
    for future in running:
        name = names.pop(future.key)
        try:
            tile = future.result()
        except KilledWorker as error:
            raise BuildError(f"tile {name} killed its worker, for memory? Use a smaller --tile-km") from error
        yield name, tile
        submit(itertools.islice(jobs, 1))


@contextmanager
def _cluster(scheduler: str) -> Iterator[Client]:
    """A client of a running scheduler that has workers."""
    with ExitStack() as stack:
        try:
            client = stack.enter_context(Client(scheduler, timeout=CONNECT_S))
            client.wait_for_workers(1, timeout=CONNECT_S)
        except (OSError, ValueError) as error:  # TimeoutError is an OSError
            raise BuildError(
                f"{scheduler}: no Dask scheduler with workers answers there; start `dask scheduler` and "
                "`dask worker`, or leave --scheduler out"
            ) from error
        yield client


@contextmanager
def _processes(tiles: int) -> Iterator[Client | None]:
    """A client of local processes, one per core; none for a single tile, which is not worth starting any."""
    if tiles == 1:
        yield None
        return
    cluster = LocalCluster(
        n_workers=min(CPU_COUNT, tiles), threads_per_worker=1, processes=True, memory_limit=0,
        dashboard_address="127.0.0.1:0", silence_logs=logging.ERROR,
    )  # fmt: skip
    with cluster, Client(cluster) as client:
        yield client


def _dashboard(client: Client) -> str:
    hint = "" if importlib.util.find_spec("bokeh") else " (install bokeh to see more than figures)"
    return f"Dask dashboard: {client.dashboard_link}{hint}\n"
