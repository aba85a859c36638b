"""The memory of a matcher process: a module of its own, for the process to load nothing else."""

from __future__ import annotations

from pathlib import Path

from buildloc_matcher.config import matcher_config
from buildloc_matcher.matcher import Matcher
from buildloc_matcher.reference.database import open_database
from buildloc_msgs_py.types import LocalMap

from buildloc_eval.process_memory import peak_mb


def peak_memory_mb(database: Path, local_map: LocalMap) -> float:
    """Peak resident memory, MB, of a process that opens the database and locates a map twice.

    Libraries and the part of the mapped tables that was read are in it.
    """
    return peak_mb(_locate, database, local_map)


def _locate(database: Path, local_map: LocalMap) -> None:
    config = matcher_config()
    matcher = Matcher(open_database(database, config), config)
    for _ in range(2):
        matcher.locate(local_map)
