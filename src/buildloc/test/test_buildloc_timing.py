"""How often fixes came and how late, and which of them are printed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from buildloc.cli import Digest
from buildloc.timing import timing
from buildloc_msgs_py.types import NoFix

SECOND = 10**9


def test_rate_gap_and_latency_are_those_of_the_fixes_alone(tmp_path: Path) -> None:
    """Images at 2 Hz; fixes of those at 1.0, 1.5, 2.0 and 4.0 s, each 0.2 s late but the last, 1 s."""
    published = {i * SECOND // 2: 77 * SECOND + i * SECOND // 2 for i in range(11)}
    late = {SECOND: 0.2, 3 * SECOND // 2: 0.2, 2 * SECOND: 0.2, 4 * SECOND: 1.0}
    lines = [
        {"fix": True, "stamp_ns": stamp, "received_ns": published[stamp] + round(by * SECOND)}
        for stamp, by in late.items()
    ]
    lines.append({"fix": False, "stamp_ns": 0, "received_ns": 99 * SECOND})
    path = tmp_path / "fixes.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    told = timing(path, published)
    assert told is not None
    assert told.fixes_per_second == pytest.approx(4 / 4.0)  # from 1 s to the last image at 5 s
    assert told.longest_gap_s == pytest.approx(2.0) and told.latency_median_s == pytest.approx(0.2)
    assert told.latency_p95_s == pytest.approx(0.88)  # 0.85 of the way from 0.2 to 1.0, by interpolation
    path.write_text(json.dumps(lines[-1]) + "\n")
    assert timing(path, published) is None


def test_one_line_per_second_and_for_every_other_reason() -> None:
    digest = Digest()
    told = [
        digest.worth(NoFix(tenth * SECOND // 10, reason))
        for tenth, reason in enumerate(["a", "a", "b", "b", "a", *["a"] * 10])
    ]
    assert [i for i, worth in enumerate(told) if worth] == [0, 2, 4, 14]
