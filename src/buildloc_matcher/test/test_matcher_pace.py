"""Rate and latency of fixes, by hand."""

from __future__ import annotations

import pytest
from buildloc_matcher.pace import FIXES_KEPT, Pace


def test_rate_and_latency_are_those_of_the_latest_fixes() -> None:
    pace = Pace()
    assert pace.figures() == {"fixes_per_second": 0.0, "latency_p95_seconds": 0.0}
    pace.add(0.0, 9.0)
    assert pace.figures() == {"fixes_per_second": 0.0, "latency_p95_seconds": 9.0}
    for i in range(FIXES_KEPT):
        pace.add(100.0 + i / 8.0, 0.1 if i % 10 else 0.3)
    figures = pace.figures()  # the first is forgotten; 5 of 50 are late
    assert figures["fixes_per_second"] == pytest.approx(8.0)
    assert figures["latency_p95_seconds"] == 0.3
    pace.reset()
    assert pace.figures()["fixes_per_second"] == 0.0
