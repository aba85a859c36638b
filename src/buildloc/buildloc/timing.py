"""How often fixes came, and how late: what was received against when the images were published."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Timing:
    """Fixes per second of flight from the first on; the longest stretch without one from there to the last
    image, s of flight; seconds by the clock on the wall from an image's publication to the arrival of its
    fix, median and 95th percentile."""

    fixes_per_second: float
    longest_gap_s: float
    latency_median_s: float
    latency_p95_s: float

    def line(self) -> str:
        """For people."""
        return (
            f"{self.fixes_per_second:.1f} fixes per second, longest gap {self.longest_gap_s:.1f} s; "
            f"from image to fix {self.latency_median_s:.2f} s, 95 % within {self.latency_p95_s:.2f} s"
        )


def timing(received: Path, published_ns: Mapping[int, int]) -> Timing | None:
    """Of the JSON lines that the fix listener wrote, and when the image of each stamp was published; None
    without a fix."""
    records = [json.loads(line) for line in received.read_text().splitlines()]
    arrivals = {int(r["stamp_ns"]): int(r["received_ns"]) for r in records if r["fix"]}
    late_s = [1e-9 * (at - published_ns[stamp]) for stamp, at in arrivals.items() if stamp in published_ns]
    if not late_s:
        return None
    flight_s = 1e-9 * np.array([*sorted(arrivals), max(published_ns)], dtype=np.float64)
    median, p95 = np.percentile(late_s, [50.0, 95.0])
    span_s = max(float(flight_s[-1] - flight_s[0]), 1.0)
    return Timing(len(arrivals) / span_s, float(np.diff(flight_s).max()), float(median), float(p95))
