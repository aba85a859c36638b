"""A replay that is ended from outside stops what it has started."""

from __future__ import annotations

import os
import signal

import pytest
from buildloc.replay import ended_by_sigterm


def test_sigterm_unwinds_what_was_started() -> None:
    before, stopped = signal.getsignal(signal.SIGTERM), list[str]()
    with pytest.raises(SystemExit) as ended, ended_by_sigterm():
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            signal.pause()
        finally:
            stopped.append("nodes")
    assert stopped == ["nodes"] and ended.value.code == 128 + signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is before
