"""Memory of processes. It loads nothing else, so that the memory is that of what runs in them."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from multiprocessing.queues import Queue
from pathlib import Path
from typing import Any

DEADLINE_S = 600.0


def memory_mb(what: str) -> float:
    """Memory of this process, MB: ``VmRSS`` resident now, ``VmHWM`` at its peak."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return float(next(line for line in lines if line.startswith(what)).split()[1]) / 1024.0


def peak_mb(work: Callable[..., None], *args: Any) -> float:
    """Peak resident memory, MB, libraries too, of a process that does ``work``, a function of a module."""
    context = multiprocessing.get_context("spawn")
    answer: Queue[float] = context.Queue()
    process = context.Process(target=_work, args=(work, args, answer))
    process.start()
    peak = answer.get(timeout=DEADLINE_S)
    process.join()
    return peak


def _work(work: Callable[..., None], args: tuple[Any, ...], answer: Queue[float]) -> None:
    work(*args)
    answer.put(memory_mb("VmHWM"))
