"""A mapper in a process of its own: a module that loads nothing else, so that its memory is the mapper's."""

from __future__ import annotations

import time
from dataclasses import dataclass
from multiprocessing.queues import Queue

from buildloc_mapper.config import MapperConfig
from buildloc_mapper.mapper import Mapper, MapUpdate
from buildloc_msgs_py.types import Frame, Mask

from buildloc_eval.process_memory import memory_mb


@dataclass(frozen=True)
class Load:
    """What keyframes cost: wall and processor seconds of each, and the resident memory after it, MB; the
    process's peak, MB, libraries and all; and the last map."""

    wall_s: tuple[float, ...]
    processor_s: tuple[float, ...]
    resident_mb: tuple[float, ...]
    peak_mb: float
    update: MapUpdate | None


def map_all(config: MapperConfig, shots: Queue[tuple[Frame, Mask] | None], answer: Queue[Load]) -> None:
    """Map keyframes as they come, until None comes; then answer."""
    mapper = Mapper(config)
    wall, processor, resident = list[float](), list[float](), list[float]()
    while (shot := shots.get()) is not None:
        started, worked = time.perf_counter(), time.process_time()
        mapper.add(*shot)
        wall.append(time.perf_counter() - started)
        processor.append(time.process_time() - worked)
        resident.append(memory_mb("VmRSS"))
    peak = memory_mb("VmHWM")
    answer.put(Load(tuple(wall), tuple(processor), tuple(resident), peak, mapper.finish()))
