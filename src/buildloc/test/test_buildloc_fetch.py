"""`buildloc refdb fetch`: what it prints at the end, and its one line when it cannot."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from buildloc.cli import main, parser
from buildloc_matcher.reference import fetch
from buildloc_matcher.reference.fetch import Fetched
from buildloc_matcher.reference.region import Circle

AREA = ["--center=-33.86,151.2", "--radius-km", "12.5"]


def test_it_ends_with_the_files_and_the_next_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "foot prints"
    files = [
        Fetched(folder / "a.csv.gz", 2_000_000, "CDLA-Permissive-2.0", fresh=True),
        Fetched(folder / "b.csv.gz", 9, "CDLA-Permissive-2.0", fresh=False, doubt="has 9 bytes"),
    ]
    asked: list[object] = []

    def fetched(*arguments: object) -> list[Fetched]:
        asked.extend(arguments[:3])
        return files

    monkeypatch.setattr(fetch, "fetch_microsoft", fetched)
    assert main(["refdb", "fetch", "--source", "microsoft", *AREA, "--out", str(folder)]) == 0
    assert asked == [Circle(-33.86, 151.2, 12.5), folder, fetch.MICROSOFT_INDEX]
    printed = capsys.readouterr()
    assert printed.err == f"warning: {files[1].path}: has 9 bytes\n"
    *listed, licence, following = printed.out.splitlines()
    assert listed == [f"{files[0].path}  2.0 MB  fetched", f"{files[1].path}  0.0 MB  unchanged"]
    assert licence == "licence: CDLA-Permissive-2.0"
    command = shlex.split(following.removeprefix("next: "))
    build = parser().parse_args(command[1:])
    assert build.sources == [file.path for file in files] and build.out == folder / "reference.bldb"
    assert (build.center, build.radius_km) == ((-33.86, 151.2), 12.5)


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--source", "microsoft", "--index-url", "ftp://host/x"], "correct the address"),
        (["--source", "microsoft", "--radius-km", "0"], "radius in km"),
        (["--source", "overture", "--index-url", "http://host/x"], "leave it out"),
    ],
)
def test_what_cannot_be_is_one_line_and_status_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], reason: str
) -> None:
    assert main(["refdb", "fetch", *AREA, "--out", str(tmp_path), *arguments]) == 2
    error = capsys.readouterr().err
    assert reason in error and error.startswith("error: ") and error.count("\n") == 1
