"""Memory of processes. It loads nothing else, so that the memory is that of what runs in them."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any


def memory_mb(what: str) -> float:
    """Memory of this process, MB: ``VmRSS`` resident now, ``VmHWM`` at its peak."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return float(next(line for line in lines if line.startswith(what)).split()[1]) / 1024.0


def peak_mb(work: Callable[..., None], *args: Any) -> float:
    """Peak resident memory, MB, libraries too, of a process that does ``work``, a function of a module.

    What ``work`` raises is raised here; BrokenProcessPool when its process ended without a word.
    """
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_work, work, args).result()


def _work(work: Callable[..., None], args: tuple[Any, ...]) -> float:
    work(*args)
    return memory_mb("VmHWM")
