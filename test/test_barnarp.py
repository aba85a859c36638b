"""Real imagery: 2 km over the east half of Barnarp, in a reference of 30,000 buildings, through the nodes."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

from buildloc.supervisor import dds_environment
from buildloc_eval.barnarp import BASELINE, cases, fly_live
from buildloc_eval.realworld import place_barnarp
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.reference.build import build
from buildloc_matcher.reference.database import open_database
from drone import domain_id

pytestmark = [
    pytest.mark.data, pytest.mark.dds, pytest.mark.slow, pytest.mark.xdist_group("flights")
]  # fmt: skip
DATA = Path(os.environ.get("BUILDLOC_DATA", Path(__file__).parents[2] / "shared" / "data"))
NEEDED = ("imagery/barnarp/ortho.jpg", "footprints/boston_osm.parquet", BASELINE)


def test_the_flight_over_the_east_half_is_localized(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the baseline network, trained on the west half: it never saw the ground below.

    Scores of masks and map are left to `buildloc eval barnarp`; the flight itself cannot be shorter.
    """
    absent = [name for name in NEEDED if not (DATA / name).is_file()]
    if absent:
        pytest.skip(f"no real imagery: {DATA / absent[0]} is absent (set BUILDLOC_DATA)")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain_id()))
    for name, value in dds_environment().items():
        monkeypatch.setenv(name, value)
    ground = place_barnarp(DATA, tmp_path)
    build([ground.footprints], tmp_path / "reference.bldb", MatcherConfig())
    database = open_database(tmp_path / "reference.bldb", MatcherConfig())
    assert len(database) >= 30_000
    # An image per second: what goes wrong here is not how often fixes come, and the flight takes a quarter.
    flown = cases(DATA)[0]
    case = replace(flown, flight=replace(flown.flight, rate_hz=1.0))
    assert case.flight.length_m >= 2000.0 and case.flight.width == 1280
    live = fly_live(case, ground, database, tmp_path / "reference.bldb", tmp_path / "flight", 1, 4.0)
    assert live.scored.last_error_m is not None, live.summary
    assert live.scored.last_error_m < 100.0, live.summary
    # Wrong but confident is the worst: no fix of the whole flight may be off by more than the last.
    assert max(live.scored.errors_m) < 100.0, live.table
