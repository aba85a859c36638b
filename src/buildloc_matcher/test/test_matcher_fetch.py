"""Footprints from a local server with Microsoft's layout and every fault, and from a local Overture."""

from __future__ import annotations

import functools
import gzip
import io
import json
import re
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import geopandas as gpd
import mercantile
import numpy as np
import overturemaps.core
import pyarrow as pa
import pyarrow.fs
import pyarrow.parquet as pq
import pytest
from buildloc_matcher.reference import fetch
from buildloc_matcher.reference.download import FetchError, HttpConfig, read_manifest, sha256
from buildloc_matcher.reference.fetch import (
    Box,
    Fetched,
    Link,
    OvertureMaps,
    fetch_microsoft,
    fetch_overture,
    file_names,
    microsoft_licence,
    part_of,
    quadkeys,
    size_doubt,
)
from buildloc_matcher.reference.region import Circle, RegionError
from pyproj import Geod
from shapely.geometry import box

ONCE = HttpConfig(timeout_s=5.0, attempts=1, backoff_s=0.0)
TWICE = HttpConfig(timeout_s=5.0, attempts=2, backoff_s=0.0)
BOSTON = Circle(42.36, -71.06, 1.0)
BASEL = Circle(47.56, 7.59, 1.0)  # listed under three countries
RELEASE = "/2026-08-13/global-buildings.geojsonl"


def key_of(area: Circle) -> str:
    return str(mercantile.quadkey(mercantile.tile(area.longitude_deg, area.latitude_deg, 9)))


@functools.cache
def tile_bytes(area: Circle, seed: int = 0, count: int = 4000) -> bytes:
    """Gzipped GeoJSON lines, several chunks long: random digits do not compress."""
    rng = np.random.default_rng(seed)
    lines = []
    for x, y in rng.uniform(-0.01, 0.01, (count, 2)):
        outline = box(
            area.longitude_deg + x, area.latitude_deg + y,
            area.longitude_deg + x + 1e-4, area.latitude_deg + y + 1e-4,
        ).__geo_interface__  # fmt: skip
        lines.append(json.dumps({"type": "Feature", "properties": {"height": -1.0}, "geometry": outline}))
    return gzip.compress("\n".join(lines).encode(), mtime=0)


@dataclass
class Request:
    path: str
    headers: dict[str, str]


@dataclass
class Server:
    """Files by path, what was asked for, and faults: each takes over one request for its path."""

    url: str = ""
    files: dict[str, bytes] = field(default_factory=dict)
    requests: list[Request] = field(default_factory=list)
    faults: dict[str, list[Callable[[BaseHTTPRequestHandler, bytes], None]]] = field(default_factory=dict)
    ranges: bool = True

    def list_tiles(self, rows: list[tuple[str, str, bytes]]) -> None:
        """Serve (location, quadkey, content) and an index that names them, numeric quadkeys as published."""
        index = "Location,QuadKey,Url,Size,UploadDate\n"
        for location, quadkey, content in rows:
            path = f"{RELEASE}/RegionName={location}/quadkey={quadkey}/part-00001.csv.gz"
            self.files[path] = content
            index += f"{location},{int(quadkey)},{self.url}{path},{len(content) / 1e3:.1f}KB,2026-08-13\n"
        self.files["/dataset-links.csv"] = index.encode()

    def tile(self, location: str = "UnitedStates") -> str:
        return next(path for path in self.files if f"={location}/" in path)

    def asked(self, part: str) -> list[Request]:
        return [request for request in self.requests if part in request.path]


def etag(content: bytes) -> str:
    return f'"{hash(content) & 0xFFFFFFFF:08x}"'


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    served: Server

    def log_message(self, *_: object) -> None:
        pass

    def answer(self, status: int, body: bytes, headers: dict[str, str], promised: int | None = None) -> None:
        """Send ``body``, announce ``promised`` bytes."""
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(body) if promised is None else promised))
        self.end_headers()
        self.wfile.write(body)
        self.wfile.flush()

    def do_GET(self) -> None:
        server = self.served
        server.requests.append(Request(self.path, dict(self.headers.items())))
        content = server.files.get(self.path)
        if server.faults.get(self.path):
            server.faults[self.path].pop(0)(self, content or b"")
            return
        if content is None:
            self.answer(404, b"<html>no such blob</html>", {})
            return
        tag = {"ETag": etag(content)}
        if self.headers.get("If-None-Match") == tag["ETag"]:
            self.send_response(304)
            self.end_headers()
            return
        asked = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))
        if server.ranges and asked and self.headers.get("If-Range") in (None, tag["ETag"]):
            start = int(asked[1])
            tag["Content-Range"] = f"bytes {start}-{len(content) - 1}/{len(content)}"
            self.answer(206, content[start:], tag)
            return
        self.answer(200, content, tag)


class Http(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exc_info()[1], ConnectionError):  # a client that gave up is what is tested
            super().handle_error(request, client_address)


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    state = Server()
    handler = type("Bound", (Handler,), {"served": state})
    http = Http(("127.0.0.1", 0), handler)
    state.url = f"http://127.0.0.1:{http.server_address[1]}"
    state.list_tiles([("UnitedStates", key_of(BOSTON), tile_bytes(BOSTON))])
    thread = threading.Thread(target=http.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield state
    http.shutdown()
    http.server_close()
    thread.join()


def quiet(_: str) -> None:
    pass


def microsoft(
    server: Server, folder: Path, area: Circle = BOSTON, config: HttpConfig = ONCE
) -> list[Fetched]:
    return fetch_microsoft(area, folder, f"{server.url}/dataset-links.csv", config, quiet)


def refused(server: Server, folder: Path, config: HttpConfig = ONCE) -> str:
    with pytest.raises(FetchError) as error:
        microsoft(server, folder, config=config)
    assert "\n" not in str(error.value)
    return str(error.value)


def finished(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.glob("microsoft_*.gz"))


def part(folder: Path) -> Path:
    return next(folder.glob("microsoft_*.part"))


def truncated(share: float) -> Callable[[BaseHTTPRequestHandler, bytes], None]:
    def fault(handler: BaseHTTPRequestHandler, content: bytes) -> None:
        assert isinstance(handler, Handler)
        half = content[: int(len(content) * share)]
        handler.answer(200, half, {"ETag": etag(content)}, promised=len(content))
        handler.close_connection = True

    return fault


def status(code: int, **headers: str) -> Callable[[BaseHTTPRequestHandler, bytes], None]:
    def fault(handler: BaseHTTPRequestHandler, _: bytes) -> None:
        assert isinstance(handler, Handler)
        handler.answer(code, b"busy", {name.replace("_", "-"): value for name, value in headers.items()})

    return fault


def test_just_the_tiles_of_the_area_with_their_record(server: Server, tmp_path: Path) -> None:
    elsewhere = ("Switzerland", key_of(BASEL), tile_bytes(BASEL))
    server.list_tiles([("UnitedStates", key_of(BOSTON), tile_bytes(BOSTON)), elsewhere])
    (file,) = microsoft(server, tmp_path / "new" / "folder")
    assert file.fresh and file.doubt is None
    assert file.path.name == f"microsoft_{key_of(BOSTON)}_UnitedStates.csv.gz"
    assert file.path.read_bytes() == tile_bytes(BOSTON)
    record = read_manifest(file.path.parent)[file.path.name]
    assert record.url.endswith(server.tile()) and record.size == file.size == len(tile_bytes(BOSTON))
    assert record.sha256 == sha256(file.path) and record.etag == etag(tile_bytes(BOSTON))
    assert record.licence == file.licence == "CDLA-Permissive-2.0, Microsoft Global ML Building Footprints"
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", record.date)
    assert [r.path for r in server.requests] == ["/dataset-links.csv", server.tile()]
    assert all(r.headers["User-Agent"].startswith("buildloc/") for r in server.requests)
    names = {path.name for path in file.path.parent.iterdir()}
    assert names == {"fetch.json", "dataset-links.csv", file.path.name}


def test_a_tile_on_a_border_comes_from_all_its_countries(server: Server, tmp_path: Path) -> None:
    tiles = [(name, key_of(BASEL), tile_bytes(BASEL, seed)) for seed, name in enumerate(("CH", "DE", "FR"))]
    server.list_tiles(tiles)
    files = microsoft(server, tmp_path, BASEL)
    assert [file.path.read_bytes() for file in files] == [content for _, _, content in tiles]


def test_finished_files_are_asked_for_but_not_sent_again(server: Server, tmp_path: Path) -> None:
    (first,) = microsoft(server, tmp_path)
    written = first.path.stat().st_mtime_ns
    (again,) = microsoft(server, tmp_path)
    assert not again.fresh and again.path.stat().st_mtime_ns == written
    assert [r.headers.get("If-None-Match") for r in server.asked("quadkey=")] == [
        None,
        etag(tile_bytes(BOSTON)),
    ]


def test_a_file_damaged_here_is_fetched_again(server: Server, tmp_path: Path) -> None:
    (file,) = microsoft(server, tmp_path)
    file.path.write_bytes(b"x" * file.size)
    assert microsoft(server, tmp_path)[0].fresh and file.path.read_bytes() == tile_bytes(BOSTON)


def test_a_file_changed_there_is_fetched_again(server: Server, tmp_path: Path) -> None:
    microsoft(server, tmp_path)
    newer = tile_bytes(BOSTON, seed=1)
    server.files[server.tile()] = newer
    (file,) = microsoft(server, tmp_path)
    assert file.fresh and file.path.read_bytes() == newer
    assert read_manifest(tmp_path)[file.path.name].etag == etag(newer)


def test_the_old_file_stays_until_the_new_one_is_complete(server: Server, tmp_path: Path) -> None:
    (file,) = microsoft(server, tmp_path)
    newer = tile_bytes(BOSTON, seed=1)
    server.files[server.tile()] = newer
    server.faults[server.tile()] = [truncated(0.5)]
    refused(server, tmp_path)
    assert file.path.read_bytes() == tile_bytes(BOSTON)
    microsoft(server, tmp_path)
    assert "Range" in server.asked("quadkey=")[-1].headers and file.path.read_bytes() == newer


def test_truncated_then_resumed_by_the_next_run(server: Server, tmp_path: Path) -> None:
    whole = tile_bytes(BOSTON)
    server.faults[server.tile()] = [truncated(0.5)]
    message = refused(server, tmp_path)
    assert "connection lost" in message and "run the same command again" in message
    assert not finished(tmp_path)
    arrived = part(tmp_path).read_bytes()
    assert 0 < len(arrived) < len(whole) and whole.startswith(arrived)
    (file,) = microsoft(server, tmp_path)
    headers = server.asked("quadkey=")[-1].headers
    assert headers["Range"] == f"bytes={len(arrived)}-" and headers["If-Range"] == etag(whole)
    assert file.path.read_bytes() == whole and not list(tmp_path.glob("*.part"))
    assert set(read_manifest(tmp_path)) == {"dataset-links.csv", file.path.name}


def test_truncated_then_resumed_in_the_same_run(server: Server, tmp_path: Path) -> None:
    server.faults[server.tile()] = [truncated(0.5)]
    (file,) = microsoft(server, tmp_path, config=TWICE)
    assert file.path.read_bytes() == tile_bytes(BOSTON)
    assert [("Range" in r.headers) for r in server.asked("quadkey=")] == [False, True]


def test_a_file_that_changed_under_a_resume_starts_anew(server: Server, tmp_path: Path) -> None:
    server.faults[server.tile()] = [truncated(0.5)]
    refused(server, tmp_path)
    newer = tile_bytes(BOSTON, seed=1)
    server.files[server.tile()] = newer
    assert microsoft(server, tmp_path)[0].path.read_bytes() == newer


def test_what_is_left_of_an_old_release_is_not_resumed(server: Server, tmp_path: Path) -> None:
    old = server.tile()
    server.faults[old] = [truncated(0.5)]
    refused(server, tmp_path)
    new = old.replace("2026-08-13", "2026-11-01")
    server.files[new] = server.files.pop(old)
    index = server.files["/dataset-links.csv"]
    server.files["/dataset-links.csv"] = index.replace(b"/2026-08-13/", b"/2026-11-01/")
    (file,) = microsoft(server, tmp_path)
    assert "Range" not in server.asked(new)[0].headers and file.path.read_bytes() == tile_bytes(BOSTON)


def test_a_server_without_ranges_sends_it_all_again(server: Server, tmp_path: Path) -> None:
    server.ranges = False
    server.faults[server.tile()] = [truncated(0.5)]
    (file,) = microsoft(server, tmp_path, config=TWICE)
    assert "Range" in server.asked("quadkey=")[-1].headers
    assert file.path.read_bytes() == tile_bytes(BOSTON)


def test_a_resume_the_server_refuses_starts_anew(server: Server, tmp_path: Path) -> None:
    server.faults[server.tile()] = [truncated(0.5), status(416)]
    (file,) = microsoft(server, tmp_path, config=HttpConfig(5.0, 3, 0.0))
    assert "Range" not in server.asked("quadkey=")[-1].headers
    assert file.path.read_bytes() == tile_bytes(BOSTON)


def test_a_resume_at_the_wrong_place_starts_anew(server: Server, tmp_path: Path) -> None:
    server.faults[server.tile()] = [truncated(0.5), status(206, Content_Range="bytes 7-10/11")]
    (file,) = microsoft(server, tmp_path, config=HttpConfig(5.0, 3, 0.0))
    assert file.path.read_bytes() == tile_bytes(BOSTON)


def test_slow_servers_are_given_up(server: Server, tmp_path: Path) -> None:
    over = threading.Event()

    def stall(handler: BaseHTTPRequestHandler, content: bytes) -> None:
        truncated(0.5)(handler, content)
        over.wait(10.0)

    def silent(handler: BaseHTTPRequestHandler, _: bytes) -> None:
        over.wait(10.0)
        handler.close_connection = True

    server.faults[server.tile()] = [stall, silent]
    patience = HttpConfig(timeout_s=0.2, attempts=1)
    try:
        assert "nothing arrived for 0.2 s" in refused(server, tmp_path, patience)
        assert part(tmp_path).stat().st_size > 0 and not finished(tmp_path)
        assert "no answer within 0.2 s" in refused(server, tmp_path, patience)
    finally:
        over.set()


@pytest.mark.parametrize("code", [404, 410])
def test_a_tile_that_is_gone(server: Server, tmp_path: Path, code: int) -> None:
    server.faults[server.tile()] = [status(code)]
    message = refused(server, tmp_path, TWICE)
    assert f"HTTP {code}" in message and server.tile() in message and "--index-url" in message
    assert len(server.asked("quadkey=")) == 1, "asking again cannot help"
    assert not finished(tmp_path)


def test_an_index_that_is_gone(server: Server, tmp_path: Path) -> None:
    del server.files["/dataset-links.csv"]
    assert "HTTP 404" in refused(server, tmp_path)


def test_access_denied(server: Server, tmp_path: Path) -> None:
    server.faults[server.tile()] = [status(403)]
    assert "refused (HTTP 403" in refused(server, tmp_path)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"<html><body>please log in</body></html>", "no intact gzip file"),
        (gzip.compress(b"<html></html>"), "no GeoJSON features"),
        (gzip.compress(b'{"type": "FeatureCollection"}'), "no GeoJSON features"),
        (gzip.compress(b""), "no GeoJSON features"),
        (tile_bytes(BOSTON, count=50)[:-9], "no intact gzip file"),
        (tile_bytes(BOSTON, count=50)[:-8] + b"\0" * 8, "no intact gzip file"),
        (b"", "no GeoJSON features"),
    ],
    ids=["html", "gzipped html", "collection", "no lines", "short", "checksum", "nothing"],
)
def test_wrong_content_gets_no_name(server: Server, tmp_path: Path, content: bytes, reason: str) -> None:
    server.files[server.tile()] = content
    assert reason in refused(server, tmp_path)
    assert not finished(tmp_path) and not list(tmp_path.glob("*.part"))
    server.files[server.tile()] = tile_bytes(BOSTON)
    assert microsoft(server, tmp_path)[0].fresh


@pytest.mark.parametrize("content", [b"<html>log in</html>", b"", b"Location,QuadKey\n", b"\xff\xfe\0"])
def test_a_wrong_index(server: Server, tmp_path: Path, content: bytes) -> None:
    server.files["/dataset-links.csv"] = content
    message = refused(server, tmp_path)
    assert "not an index of Microsoft footprints" in message and "--index-url" in message
    assert not (tmp_path / "dataset-links.csv").exists()


def test_a_file_labelled_as_encoded_is_stored_as_it_is(server: Server, tmp_path: Path) -> None:
    def labelled(handler: BaseHTTPRequestHandler, content: bytes) -> None:
        assert isinstance(handler, Handler)
        handler.answer(200, content, {"Content-Encoding": "gzip"})

    server.faults[server.tile()] = [labelled]
    assert microsoft(server, tmp_path)[0].path.read_bytes() == tile_bytes(BOSTON)


def test_busy_servers_are_waited_for_as_long_as_they_ask(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept: list[float] = []
    monkeypatch.setattr(time, "sleep", slept.append)
    server.faults[server.tile()] = [status(429, Retry_After="7"), status(503), status(503)]
    config = HttpConfig(timeout_s=5.0, attempts=4, backoff_s=0.5)
    assert microsoft(server, tmp_path, config=config)[0].fresh
    assert slept == [7.0, 1.0, 2.0]


def test_busy_servers_are_left_alone(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "sleep", lambda _: pytest.fail("waits too long"))
    server.faults[server.tile()] = [status(429, Retry_After="86400")]
    assert "HTTP 429" in refused(server, tmp_path, HttpConfig(attempts=3))
    assert len(server.asked("quadkey=")) == 1


def test_offline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with socket.socket() as reserved:  # bound and not listening: nobody answers
        reserved.bind(("127.0.0.1", 0))
        state = Server(url=f"http://127.0.0.1:{reserved.getsockname()[1]}")
        message = refused(state, tmp_path, HttpConfig(attempts=3, backoff_s=60.0))
    assert "offline" in message and "copy the folder" in message


@pytest.mark.parametrize("url", ["no-address", "ftp://127.0.0.1/x", "http://"])
def test_an_impossible_address(tmp_path: Path, url: str) -> None:
    with pytest.raises(FetchError, match="correct the address"):
        fetch_microsoft(BOSTON, tmp_path, url, ONCE, quiet)


def test_no_data_for_the_area(server: Server, tmp_path: Path) -> None:
    with pytest.raises(FetchError, match=r"lists no buildings within 1 km of -40\.0+, -20\.0+"):
        microsoft(server, tmp_path, Circle(-40.0, -20.0, 1.0))
    assert not server.asked("quadkey=")


def test_a_folder_that_cannot_be(server: Server, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert "another --out" in refused(server, tmp_path / "file")


def test_a_damaged_manifest(server: Server, tmp_path: Path) -> None:
    for text in ("{", "[]", '{"files": {"a": {"colour": 1}}}', '{"files": 3}'):
        (tmp_path / "fetch.json").write_text(text)
        assert "delete it" in refused(server, tmp_path)


def test_progress_says_how_far(server: Server, tmp_path: Path) -> None:
    said: list[str] = []
    fetch_microsoft(BOSTON, tmp_path, f"{server.url}/dataset-links.csv", ONCE, said.append)
    size = len(tile_bytes(BOSTON)) / 1e6
    assert said[-1].startswith("file 1 of 1, ") and said[-1].endswith(f": {size:.1f} of {size:.1f} MB")


@pytest.mark.parametrize("radius_km", [0.0, -1.0, float("nan"), float("inf")])
def test_an_impossible_radius(radius_km: float) -> None:
    with pytest.raises(RegionError, match="not positive"):
        Circle(0.0, 0.0, radius_km)


@pytest.mark.parametrize("seed", range(5))
def test_tiles_hold_every_point_of_the_circle(seed: int) -> None:
    rng = np.random.default_rng(seed)
    area = Circle(float(rng.uniform(-75, 75)), float(rng.uniform(-180, 180)), float(rng.uniform(1, 200)))
    azimuth = rng.uniform(0, 360, 500)
    distance = area.radius_km * 1e3 * np.sqrt(rng.uniform(0, 1, 500))
    x, y, _ = Geod(ellps="WGS84").fwd(
        np.full(500, area.longitude_deg), np.full(500, area.latitude_deg), azimuth, distance
    )
    keys = quadkeys(area)
    inside = {str(mercantile.quadkey(mercantile.tile(*point, 9))) for point in zip(x, y, strict=True)}
    assert inside <= set(keys)
    boxes = [part_of(area, key) for key in keys]
    homes = [sum(w <= a < e and s <= b < n for w, s, e, n in boxes) for a, b in zip(x, y, strict=True)]
    assert homes == [1] * 500
    across = np.array([(e - w, n - s) for w, s, e, n in boxes])
    widest = 2.02 * area.radius_km / 111.0 + 0.02
    assert (across[:, 1] <= widest).all()
    west, east = min(b[0] for b in boxes), max(b[2] for b in boxes)
    if east - west < 180.0:  # not across the 180th meridian
        assert east - west <= widest / np.cos(np.radians(abs(area.latitude_deg) + widest))


def test_tiles_that_the_circle_misses_are_left_out() -> None:
    corner = mercantile.bounds(mercantile.quadkey_to_tile(key_of(BOSTON)))
    near = Circle(corner.north - 0.05, corner.west + 0.05, 5.9)  # the corner lies 6.9 km away
    assert len(quadkeys(near)) == 3
    assert len(quadkeys(Circle(near.latitude_deg, near.longitude_deg, 7.0))) == 4


def test_the_180th_meridian() -> None:
    keys = quadkeys(Circle(-16.8, 179.99, 10.0))  # Taveuni
    columns = {mercantile.quadkey_to_tile(key).x for key in keys}
    assert columns == {0, 511}


def test_names_are_harmless_and_different() -> None:
    rows = [Link(location, "0" * 9, f"u{i}", "") for i, location in enumerate(("../a b", "ab", "a-b", "Å"))]
    assert file_names(rows) == [
        "microsoft_000000000_ab.csv.gz",
        "microsoft_000000000_ab-2.csv.gz",
        "microsoft_000000000_ab-3.csv.gz",
        "microsoft_000000000_.csv.gz",
    ]


@pytest.mark.parametrize(
    ("url", "licence"),
    [
        ("https://host/$web/2026-08-13/x", "CDLA-Permissive-2.0"),
        ("https://host/global-buildings/2026-02-03/x", "ODbL-1.0"),
        ("https://host/mirror/x", "ODbL-1.0"),
    ],
)
def test_the_licence_goes_with_the_release(url: str, licence: str) -> None:
    assert microsoft_licence(url).startswith(f"{licence}, ")


@pytest.mark.parametrize(
    ("size", "listed", "doubted"),
    [
        (23_100_000, "23.1MB", False),
        (24_222_000, "23.1MB", False),
        (300, "23.1MB", True),
        (90_000, "1.2KB", True),
        (5, "", False),
        (5, "large", False),
    ],
)
def test_sizes_are_compared_with_the_index(size: int, listed: str, doubted: bool) -> None:
    assert (size_doubt(size, listed) is not None) == doubted


@pytest.fixture
def overture(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A bucket on the disk behind the real client: catalogue, index and Parquet as Overture lays them out."""
    bucket = tmp_path_factory.mktemp("bucket")
    release = bucket / "overturemaps-us-west-2/release/2026-10-21.0/theme=buildings/type=building"
    release.mkdir(parents=True)
    corner = mercantile.bounds(mercantile.quadkey_to_tile(key_of(BOSTON)))
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-0.02, 0.02, 21), np.linspace(-0.02, 0.02, 21)))
    # One house in the middle lies across the corner of four tiles.
    houses = [
        box(corner.west + a - 4e-5, corner.north + b - 4e-5, corner.west + a + 4e-5, corner.north + b + 4e-5)
        for a, b in zip(x, y, strict=True)
    ]
    frame = gpd.GeoDataFrame({"id": [str(i) for i in range(len(houses))]}, geometry=houses, crs=4326)
    path = release / "part-00000.parquet"
    frame.to_parquet(path, write_covering_bbox=True)
    extent = dict(zip(("xmin", "ymin", "xmax", "ymax"), map(float, frame.total_bounds), strict=True))
    href = f"s3://{path.relative_to(bucket)}"
    rows = [
        {
            "collection": "building", "type": "Feature", "bbox": extent,
            "assets": {"aws": {"alternate": {"s3": {"href": href}}}},
        }
    ]  # fmt: skip
    pq.write_table(pa.Table.from_pylist(rows), bucket / "collections.parquet")
    answers = {
        "https://stac.overturemaps.org/catalog.json": b'{"latest": "2026-10-21.0", "links": []}',
        "https://stac.overturemaps.org/2026-10-21.0/collections.parquet": (
            bucket / "collections.parquet"
        ).read_bytes(),
    }
    monkeypatch.setattr(overturemaps.core, "_cached_stac_catalog", None)
    monkeypatch.setattr(overturemaps.core, "urlopen", lambda url: io.BytesIO(answers[url]))
    disk = pyarrow.fs.SubTreeFileSystem(str(bucket), pyarrow.fs.LocalFileSystem())
    monkeypatch.setattr(overturemaps.core.fs, "S3FileSystem", lambda **_: disk)
    return path


def corner_area() -> Circle:
    corner = mercantile.bounds(mercantile.quadkey_to_tile(key_of(BOSTON)))
    return Circle(corner.north, corner.west, 1.0)


def test_overture_splits_at_the_tiles_without_doubles(
    overture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = fetch_overture(corner_area(), tmp_path, OvertureMaps(), quiet)
    assert len(files) == 4 and all(file.fresh for file in files)
    frames = [gpd.read_parquet(file.path) for file in files]
    ids = [name for frame in frames for name in frame["id"]]
    assert len(ids) == len(set(ids))
    everything = gpd.read_parquet(overture)
    area = corner_area()
    metric = everything.to_crs(32619).centroid
    middle = gpd.GeoSeries.from_xy([area.longitude_deg], [area.latitude_deg], crs=4326).to_crs(32619)
    near = set(everything["id"][metric.distance(middle.iloc[0]) <= 1000.0])
    assert near and near <= set(ids) and len(ids) < len(everything)
    assert all(frame.crs == 4326 for frame in frames)
    records = read_manifest(tmp_path)
    for file in files:
        record = records[file.path.name]
        assert "release/2026-10-21.0/theme=buildings" in record.url and record.sha256 == sha256(file.path)
        assert record.licence.startswith("ODbL-1.0")
    assert capsys.readouterr().out == ""


def test_overture_is_not_fetched_twice_but_a_new_release_is(overture: Path, tmp_path: Path) -> None:
    client = Recorded()
    fetch_overture(BOSTON, tmp_path, client, quiet)
    (again,) = fetch_overture(BOSTON, tmp_path, client, quiet)
    assert not again.fresh and client.asked == ["old"]
    client.release = "new"
    (newer,) = fetch_overture(BOSTON, tmp_path, client, quiet)
    assert newer.fresh and newer.path == again.path and client.asked == ["old", "new"]


def test_overture_without_data(overture: Path, tmp_path: Path) -> None:
    with pytest.raises(FetchError, match=r"no buildings within 1 km of -40\.0.* in release 2026-10-21"):
        fetch_overture(Circle(-40.0, -20.0, 1.0), tmp_path, OvertureMaps(), quiet)
    assert not list(tmp_path.iterdir())


def test_overture_client_that_fails_to_open(overture: Path, tmp_path: Path) -> None:
    overture.write_bytes(b"no parquet")
    with pytest.raises(FetchError, match=r"Overture: .*run the same command again") as error:
        fetch_overture(corner_area(), tmp_path, OvertureMaps(), quiet)
    assert "\n" not in str(error.value) and not list(tmp_path.iterdir())


def test_overture_offline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def unreachable(_: str) -> None:
        raise OSError("Name or service not known")

    monkeypatch.setattr(overturemaps.core, "_cached_stac_catalog", None)
    monkeypatch.setattr(overturemaps.core, "urlopen", unreachable)
    with pytest.raises(FetchError, match="check that this machine is online"):
        fetch_overture(BOSTON, tmp_path, OvertureMaps(), quiet)
    assert socket.getdefaulttimeout() is None


@dataclass
class Recorded:
    """A client with one house for every box, that may break off after it."""

    release: str = "old"
    broken: bool = False
    asked: list[str] = field(default_factory=list)

    def latest_release(self) -> str:
        return self.release

    def buildings(self, area: Box, release: str) -> pa.RecordBatchReader:
        self.asked.append(release)
        west, south, _, _ = area
        house = gpd.GeoDataFrame(
            geometry=[box(west + 1e-4, south + 1e-4, west + 2e-4, south + 2e-4)], crs=4326
        )
        buffer = io.BytesIO()
        house.to_parquet(buffer, write_covering_bbox=True)
        table = pq.read_table(buffer)

        def batches() -> Iterator[pa.RecordBatch]:
            yield from table.to_batches()
            if self.broken:
                raise OSError("curlCode: 28, Timeout was reached")

        return pa.RecordBatchReader.from_batches(table.schema, batches())


def test_overture_that_breaks_off_leaves_nothing_half(tmp_path: Path) -> None:
    with pytest.raises(FetchError, match="Timeout was reached"):
        fetch_overture(BOSTON, tmp_path, Recorded(broken=True), quiet)
    assert not list(tmp_path.iterdir())


def test_the_index_in_use_is_of_the_release_its_licence_belongs_to() -> None:
    assert microsoft_licence(fetch.MICROSOFT_INDEX).startswith("CDLA")
