"""The memory of a piece of work in a process of its own, and what becomes of its failure."""

from __future__ import annotations

import os
from concurrent.futures.process import BrokenProcessPool

import numpy as np
import pytest
from buildloc_eval.process_memory import peak_mb


def fill(megabytes: int) -> None:
    """Take memory, and give it back."""
    np.ones(megabytes << 17)


def refuse() -> None:
    """Fail as work does."""
    raise ValueError("no such frame")


def end() -> None:
    """Be gone without a word."""
    os._exit(3)


def test_the_peak_is_seen_and_a_failure_is_raised() -> None:
    assert 150.0 < peak_mb(fill, 200) - peak_mb(fill, 0) < 250.0
    with pytest.raises(ValueError, match="no such frame"):
        peak_mb(refuse)
    with pytest.raises(BrokenProcessPool):
        peak_mb(end)
