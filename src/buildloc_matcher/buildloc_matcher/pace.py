"""How often fixes went out lately, and how late."""

from __future__ import annotations

from collections import deque

FIXES_KEPT = 50


class Pace:
    """Of the latest fixes."""

    def __init__(self) -> None:
        self._fixes: deque[tuple[float, float]] = deque(maxlen=FIXES_KEPT)

    def reset(self) -> None:
        """Forget the flight."""
        self._fixes.clear()

    def add(self, at_s: float, late_s: float) -> None:
        """A fix that went out at a time, so long after its image was taken."""
        self._fixes.append((at_s, late_s))

    def figures(self) -> dict[str, float]:
        """For /diagnostics: fixes per second, and the 95th percentile of their latencies; 0 without any."""
        late_s = sorted(late for _, late in self._fixes)
        span_s = self._fixes[-1][0] - self._fixes[0][0] if late_s else 0.0
        return {
            "fixes_per_second": (len(late_s) - 1) / span_s if span_s > 0.0 else 0.0,
            "latency_p95_seconds": late_s[int(0.95 * len(late_s))] if late_s else 0.0,
        }
