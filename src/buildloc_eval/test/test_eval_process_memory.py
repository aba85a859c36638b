"""The memory of a piece of work in a process of its own, and what becomes of its failure."""

from __future__ import annotations

import os
from concurrent.futures.process import BrokenProcessPool

import numpy as np
import pytest
from buildloc_eval.process_memory import peak_mb


def test_the_peak_is_seen_and_a_failure_is_raised() -> None:
    assert 150.0 < peak_mb(np.ones, 200 << 17) - peak_mb(np.ones, 1) < 250.0
    with pytest.raises(ValueError, match="invalid literal"):
        peak_mb(int, "no number")
    with pytest.raises(BrokenProcessPool):
        peak_mb(os._exit, 3)
