"""The memory of a matcher process: a module of its own, for the process to load nothing else."""

from __future__ import annotations

import multiprocessing
from multiprocessing.queues import Queue
from pathlib import Path

from buildloc_matcher.config import matcher_config
from buildloc_matcher.matcher import Matcher
from buildloc_matcher.reference.database import open_database
from buildloc_msgs_py.types import LocalMap

DEADLINE_S = 300.0


def peak_memory_mb(database: Path, local_map: LocalMap) -> float:
    """Peak resident memory, MB, of a process that opens the database and locates a map twice.

    Libraries and the part of the mapped tables that was read are in it.
    """
    context = multiprocessing.get_context("spawn")
    answer: Queue[float] = context.Queue()
    process = context.Process(target=_locate, args=(database, local_map, answer))
    process.start()
    peak = answer.get(timeout=DEADLINE_S)
    process.join()
    return peak


def _locate(database: Path, local_map: LocalMap, answer: Queue[float]) -> None:
    config = matcher_config()
    matcher = Matcher(open_database(database, config), config)
    for _ in range(2):
        matcher.locate(local_map)
    status = Path("/proc/self/status").read_text().splitlines()
    peak = next(line for line in status if line.startswith("VmHWM"))
    answer.put(float(peak.split()[1]) / 1024.0)
