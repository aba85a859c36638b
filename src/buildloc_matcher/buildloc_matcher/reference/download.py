"""Files from an HTTP server: resumed, checked, and not fetched again while they are unchanged."""

from __future__ import annotations

import dataclasses
import datetime
import hashlib
import importlib.metadata
import json
import os
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import requests
from buildloc_msgs_py.errors import BuildlocError
from urllib3.exceptions import HTTPError, InvalidHeader, NewConnectionError, ReadTimeoutError
from urllib3.util import Retry

MANIFEST = "fetch.json"
PART = ".part"
CHUNK = 1 << 14  # what of a chunk has arrived is lost when the connection breaks
BUSY = frozenset({408, 429, 500, 502, 503, 504})
AGAIN = "run the same command again, it goes on from what has arrived"

Progress = Callable[[str], None]
Check = Callable[[Path], str | None]


class FetchError(BuildlocError):
    """Footprint data cannot be fetched."""


class _InterruptedError(Exception):
    """One attempt failed, another may succeed; ``wait_s`` is what the server asks to wait."""

    def __init__(self, reason: str, wait_s: float = 0.0) -> None:
        super().__init__(reason)
        self.wait_s = wait_s


@dataclass(frozen=True)
class HttpConfig:
    """Patience and politeness: seconds between two packets, attempts per file, first pause between them."""

    timeout_s: float = 30.0
    attempts: int = 5
    backoff_s: float = 1.0
    longest_wait_s: float = 120.0


@dataclass(frozen=True)
class Record:
    """What the manifest says of a file; ``size`` and ``sha256`` are None while it is incomplete."""

    url: str
    licence: str
    date: str
    size: int | None = None
    sha256: str | None = None
    etag: str | None = None
    last_modified: str | None = None


def today() -> str:
    """The UTC date of a record."""
    return datetime.datetime.now(datetime.UTC).date().isoformat()


def read_manifest(folder: Path) -> dict[str, Record]:
    """Records by file name; none for a folder without a manifest."""
    path = folder / MANIFEST
    if not path.is_file():
        return {}
    try:
        files = json.loads(path.read_text(encoding="utf-8"))["files"]
        return {str(name): Record(**values) for name, values in files.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise FetchError(
            f"{path}: damaged or not from `buildloc refdb fetch`; delete it or choose another --out"
        ) from error


def write_manifest(folder: Path, records: Mapping[str, Record]) -> None:
    """Replace the manifest in one step."""
    values = {name: dataclasses.asdict(record) for name, record in sorted(records.items())}
    fresh = folder / f".{MANIFEST}"
    fresh.write_text(json.dumps({"files": values}, indent=1) + "\n", encoding="utf-8")
    os.replace(fresh, folder / MANIFEST)


def sha256(path: Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def intact(path: Path, record: Record | None, url: str) -> bool:
    """Whether the file is still what was fetched from ``url``."""
    return (
        record is not None
        and record.url == url
        and path.is_file()
        and path.stat().st_size == record.size
        and sha256(path) == record.sha256
    )


def finish(part: Path, path: Path, record: Record) -> None:
    """Give a complete and checked file its name and write its record."""
    whole = dataclasses.replace(record, size=part.stat().st_size, sha256=sha256(part))
    os.replace(part, path)
    records = read_manifest(path.parent)
    records.pop(part.name, None)
    write_manifest(path.parent, records | {path.name: whole})


def open_session() -> requests.Session:
    """A session that says who asks and wants the bytes as they are stored."""
    session = requests.Session()
    version = importlib.metadata.version("buildloc_matcher")
    session.headers.update({"User-Agent": f"buildloc/{version}", "Accept-Encoding": "identity"})
    return session


def download(
    session: requests.Session,
    url: str,
    path: Path,
    licence: str,
    check: Check,
    config: HttpConfig,
    progress: Progress,
) -> bool:
    """Bring ``url`` to ``path``; False when the file there is still what the server has.

    The transfer goes to ``path`` + ``.part`` and goes on where it stopped, now or in a later run, unless the
    file has changed meanwhile. ``check`` says what is wrong with the complete content, or None.
    Raises FetchError when the attempts are used up or another attempt cannot help.
    """
    attempt = 1
    while True:
        try:
            return _attempt(session, url, path, licence, check, config, progress)
        except _InterruptedError as error:
            if attempt == config.attempts or error.wait_s > config.longest_wait_s:
                raise FetchError(f"{url}: {error}; {AGAIN}") from error
            wait_s = max(error.wait_s, config.backoff_s * 2.0 ** (attempt - 1))
            progress(f"{path.name}: {error}, next attempt in {wait_s:.0f} s")
        except OSError as error:
            raise FetchError(
                f"{path}: cannot be written ({error.strerror or error}); "
                "make room there or choose another --out"
            ) from error
        time.sleep(wait_s)
        attempt += 1


def _attempt(
    session: requests.Session,
    url: str,
    path: Path,
    licence: str,
    check: Check,
    config: HttpConfig,
    progress: Progress,
) -> bool:
    part = path.with_name(path.name + PART)
    records = read_manifest(path.parent)
    here = part.stat().st_size if part.is_file() else 0
    headers = _resume(records.get(part.name), url, here)
    if intact(path, records.get(path.name), url):
        headers |= _unless_same(records[path.name])
    with _get(session, url, headers, config.timeout_s) as response:
        if response.status_code == 304:
            return False
        _refuse(response, url)
        if response.status_code == 416:  # what is here is no beginning of what is there
            part.unlink(missing_ok=True)
            raise _InterruptedError("the server has another file now")
        start, total = _extent(response)
        if start not in (0, here):
            part.unlink(missing_ok=True)
            raise _InterruptedError("the server resumes at another place")
        record = Record(
            url, licence, today(),
            etag=response.headers.get("ETag"), last_modified=response.headers.get("Last-Modified"),
        )  # fmt: skip
        write_manifest(path.parent, records | {part.name: record})
        _receive(response, part, start, total, config.timeout_s, progress)
    fault = check(part)
    if fault is not None:
        part.unlink()
        raise FetchError(f"{url}: {fault}")
    finish(part, path, record)
    return True


def _resume(record: Record | None, url: str, here: int) -> dict[str, str]:
    """Headers that ask for the rest, if the file is still the one that was begun."""
    if record is None or record.url != url or here == 0:
        return {}
    strong = record.etag if record.etag and not record.etag.startswith("W/") else None
    validator = strong or record.last_modified
    return {"Range": f"bytes={here}-", "If-Range": validator} if validator else {}


def _unless_same(record: Record) -> dict[str, str]:
    if record.etag:
        return {"If-None-Match": record.etag}
    return {"If-Modified-Since": record.last_modified} if record.last_modified else {}


def _get(session: requests.Session, url: str, headers: dict[str, str], timeout_s: float) -> requests.Response:
    try:
        return session.get(url, headers=headers, stream=True, timeout=timeout_s)
    except requests.exceptions.SSLError as error:
        raise FetchError(f"{url}: no secure connection; check the clock and the certificates") from error
    except requests.exceptions.ProxyError as error:
        raise FetchError(f"{url}: the proxy refuses; check HTTPS_PROXY and NO_PROXY") from error
    except requests.Timeout as error:
        raise _InterruptedError(f"no answer within {timeout_s:g} s") from error
    except requests.ConnectionError as error:
        reason = getattr(error.args[0], "reason", None) if error.args else None
        if isinstance(reason, NewConnectionError):  # no route, no name server, nobody listening
            raise FetchError(
                f"{url}: cannot be reached, this machine seems to be offline; connect it, "
                "or fetch on another machine and copy the folder"
            ) from error
        raise _InterruptedError("connection lost") from error
    except requests.RequestException as error:
        raise FetchError(f"{url}: cannot be fetched ({error}); correct the address") from error


def _refuse(response: requests.Response, url: str) -> None:
    """Raise for what is neither content nor an answer to a resume."""
    status = response.status_code
    if status in BUSY:
        raise _InterruptedError(f"the server is busy (HTTP {status})", _retry_after(response))
    if status in (404, 410):
        raise FetchError(
            f"{url}: not on the server (HTTP {status}); the data set has moved or is being replaced: "
            "try later, or give its present index with --index-url"
        )
    if status not in (200, 206, 416):
        raise FetchError(f"{url}: refused (HTTP {status} {response.reason}); try later or another --source")


def _retry_after(response: requests.Response) -> float:
    value = response.headers.get("Retry-After")
    try:
        return 0.0 if value is None else Retry().parse_retry_after(value)
    except InvalidHeader:
        return 0.0


def _extent(response: requests.Response) -> tuple[int, int | None]:
    """(first byte, size of the whole file if the server says)."""
    if response.status_code == 206:
        found = re.fullmatch(r"bytes (\d+)-\d+/(\d+|\*)", response.headers.get("Content-Range", ""))
        if found is None:
            return -1, None
        return int(found[1]), None if found[2] == "*" else int(found[2])
    length = response.headers.get("Content-Length", "")
    return 0, int(length) if length.isdigit() else None


def _receive(
    response: requests.Response,
    part: Path,
    start: int,
    total: int | None,
    timeout_s: float,
    progress: Progress,
) -> None:
    whole = "" if total is None else f" of {total / 1e6:.1f}"
    received = start
    with part.open("ab" if start else "wb") as file:
        try:
            # The stored bytes: a server that labels a .gz file as encoded would have it unpacked otherwise.
            for chunk in response.raw.stream(CHUNK, decode_content=False):
                file.write(chunk)
                received += len(chunk)
                progress(f"{part.name.removesuffix(PART)}: {received / 1e6:.1f}{whole} MB")
        except ReadTimeoutError as error:
            raise _InterruptedError(f"nothing arrived for {timeout_s:g} s") from error
        except HTTPError as error:
            raise _InterruptedError(f"connection lost after {received / 1e6:.1f}{whole} MB") from error
    if total is not None and received != total:
        raise _InterruptedError(f"truncated: {received} of {total} bytes")
