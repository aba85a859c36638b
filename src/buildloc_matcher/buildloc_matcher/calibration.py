"""How high the score of a best candidate gets where the map lies nowhere near: measured, not assumed.

``calibration.json`` is written by ``buildloc eval integrity --plan calibration --write-calibration``.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

FILE = "calibration.json"


@dataclass(frozen=True)
class Tail:
    """Above ``start_nats`` a share ``share * exp(-(score - start_nats) / scale_nats)`` of the wrong best
    candidates scores higher: upper 95 % bounds, of the kind of ground where it is largest."""

    start_nats: float
    share: float
    scale_nats: float

    def exceedance(self, nats: float) -> float:
        """Share of wrong best candidates that score at least as much, at most 1."""
        return math.exp(min(0.0, math.log(self.share) - (nats - self.start_nats) / self.scale_nats))

    def quantile(self, rate: float) -> float:
        """The score that this share of wrong best candidates exceeds, nats; never below the start, where
        nothing was fitted."""
        return self.start_nats + self.scale_nats * max(0.0, math.log(self.share / rate))


@cache
def measured() -> Tail:
    """The tail as it was measured."""
    kept = json.loads((files("buildloc_matcher") / FILE).read_text())
    return Tail(**kept["tail"])


def false_fix_probability(nats: float) -> float:
    """How often a map that lies nowhere near scores as high."""
    return measured().exceedance(nats)


def threshold(rate: float) -> float:
    """Smallest score of a fix at a rate of false fixes, nats."""
    return measured().quantile(rate)
