"""`buildloc refdb build`: its table, and every wrong use in one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from buildloc.cli import main
from shapely.geometry import box


@pytest.fixture
def town(tmp_path: Path) -> Path:
    """A hundred houses at the equator, of 11 m, 110 m apart."""
    lines = [
        {"type": "Feature", "properties": {}, "geometry": box(x, y, x + 1e-4, y + 1e-4).__geo_interface__}
        for x, y in ((3.0 + 1e-3 * (i + 0.1 * j**2), 1e-3 * j) for i in range(10) for j in range(10))
    ]
    path = tmp_path / "town.ndjson"
    path.write_text("\n".join(json.dumps(line) for line in lines))
    return path


@pytest.mark.parametrize(
    ("options", "used"),
    [([], 100), (["--bbox", "3,-0.001,4,0.0045"], 50), (["--center", "0,3", "--radius-km", "0.05"], 1)],
)
def test_the_table_is_printed(
    town: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], used: int
) -> None:
    out = tmp_path / "town.bldb"
    assert main(["refdb", "build", str(town), "--out", str(out), *options]) == 0
    printed = capsys.readouterr()
    rows = dict(line.rsplit(maxsplit=1) for line in printed.out.splitlines() if line.startswith(" "))
    rows = {name.strip(): value for name, value in rows.items()}
    assert (rows["read"], rows["used"]) == ("100", str(used)) and "buildings per km2" in rows
    assert f"{out}: {used} buildings, EPSG:32631" in printed.out and printed.err == ""
    assert out.exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--center", "0,3"], "--center and --radius-km together"),
        (["--radius-km", "3"], "--center and --radius-km together"),
        (["--center", "0,3", "--radius-km", "1", "--bbox", "1,2,3,4"], "or --bbox"),
        (["--center", "0,3", "--radius-km", "-1"], "not positive"),
        (["--bbox", "4,2,3,1"], "WEST,SOUTH,EAST,NORTH"),
        (["--center", "50,3", "--radius-km", "1"], "no building within 1 km"),
        (["--tile-km", "0"], "--tile-km"),
    ],
)
def test_wrong_use_is_one_line(
    town: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    assert main(["refdb", "build", str(town), "--out", str(tmp_path / "town.bldb"), *options]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and message in error and error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["town.ndjson"]
