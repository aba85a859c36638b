"""How high the score of a best candidate gets where the map lies nowhere near, and how far errors of fixes go
beyond what a normal distribution of their covariance has: measured, not assumed.

``calibration.json`` is written by ``buildloc eval integrity --plan calibration --write-calibration``.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
from buildloc_msgs_py.types import FloatArray

FILE = "calibration.json"
PROTECTED = 0.999


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


@dataclass(frozen=True)
class Errors:
    """Errors of fixes over their standard deviations (by the whole horizontal covariance) follow Student's t
    in the plane, times ``scale``, with ``dof`` degrees of freedom: the fewer, the heavier the tail."""

    scale: float
    dof: float

    def radius(self, probability: float) -> float:
        """Standard deviations that the error stays within with this probability, below 1."""
        return self.scale * math.sqrt(self.dof * math.expm1(-2.0 / self.dof * math.log1p(-probability)))


@dataclass(frozen=True)
class Calibration:
    """What was measured."""

    tail: Tail
    errors: Errors


@cache
def measured() -> Calibration:
    """The calibration that is installed."""
    kept = json.loads((files("buildloc_matcher") / FILE).read_text())
    return Calibration(Tail(**kept["tail"]), Errors(**kept["errors"]))


def false_fix_probability(nats: float) -> float:
    """How often a map that lies nowhere near scores as high."""
    return measured().tail.exceedance(nats)


def threshold(rate: float) -> float:
    """Smallest score of a fix at a rate of false fixes, nats."""
    return measured().tail.quantile(rate)


def protection_level_m(covariance_m2: FloatArray) -> FloatArray:
    """Radius about a fix, m, that holds the truth with the probability PROTECTED, of horizontal covariances
    (..., 2, 2), m2, by their longer axis; if the fix is not of another place altogether, and
    ``sigma_registration_m`` is right."""
    longest = np.linalg.eigvalsh(covariance_m2)[..., -1]
    return np.asarray(measured().errors.radius(PROTECTED) * np.sqrt(longest), dtype=np.float64)
