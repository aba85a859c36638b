"""Runs the trials of a plan on all cores; what is finished is kept, and a run that was cut off goes on."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict
from pathlib import Path

import pandas as pd
from buildloc_matcher.config import matcher_config
from buildloc_matcher.matching import THREADS

from buildloc_eval.integrity.grounds import Grounds, Say, Source, read_source
from buildloc_eval.integrity.plan import CHUNK, Plan
from buildloc_eval.integrity.trials import run
from buildloc_eval.paper.store import Store
from buildloc_eval.sections import source_digest

CODE = (
    "buildloc_msgs_py", "buildloc_matcher", "buildloc_eval.observation", "buildloc_eval.observed_flight",
    *(f"buildloc_eval.integrity.{name}" for name in ("plan", "grounds", "trials")),
)  # fmt: skip


def chunk_name(first: int) -> str:
    """Of the chunk of trials that begins with a number."""
    return f"trials_{first:06d}"


def run_chunk(grounds: Grounds, numbers: range) -> pd.DataFrame:
    """The records of some trials; in a process of its own."""
    own = Grounds(grounds.folder, grounds.plan, grounds.seed, grounds.config)
    return pd.DataFrame([run(number, own) for number in numbers])


def run_all(
    out: Path,
    plan: Plan,
    trials: int,
    seed: int,
    say: Say,
    read: Callable[[str], Source] = read_source,
) -> pd.DataFrame:
    """All trials of a plan, those of an earlier run from what it kept.

    Raises StaleError when the folder holds trials of another seed, configuration or code.
    """
    config = matcher_config()
    made_by = {"plan": plan.name, "seed": seed, "matcher": asdict(config), "code": source_digest(CODE)}
    store = Store(out / plan.name, made_by)
    grounds = Grounds(out / plan.name / "grounds", plan, seed, config)
    grounds.build(read, say)
    chunks = [range(first, min(first + CHUNK, trials)) for first in range(0, trials, CHUNK)]
    missing = [chunk for chunk in chunks if _kept(store, chunk) < len(chunk)]
    done, total, started = 0, sum(map(len, missing)), time.monotonic()
    for chunk, records in _side_by_side(grounds, missing):
        store.save(chunk_name(chunk.start), records)
        done += len(chunk)
        left = (time.monotonic() - started) / done * (total - done)
        say(f"{trials - total + done} of {trials} trials, {left / 60.0:.1f} min left")
    kept = [store.load(chunk_name(c.start)).iloc[: len(c)] for c in chunks]
    return pd.concat(kept, ignore_index=True)


def _kept(store: Store, chunk: range) -> int:
    """How many trials of a chunk are there: an earlier run may have asked for fewer."""
    name = chunk_name(chunk.start)
    return len(store.load(name)) if store.has(name) else 0


def _side_by_side(grounds: Grounds, chunks: list[range]) -> Iterator[tuple[range, pd.DataFrame]]:
    """Chunks as they are finished, a few at a time on the way."""
    waiting = iter(chunks)
    with ProcessPoolExecutor(max(1, min(THREADS, len(chunks))), multiprocessing.get_context("spawn")) as pool:
        running: dict[Future[pd.DataFrame], range] = {}
        while True:
            for chunk in waiting:
                running[pool.submit(run_chunk, grounds, chunk)] = chunk
                if len(running) >= 2 * THREADS:
                    break
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), future.result()
