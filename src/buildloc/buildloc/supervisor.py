"""Starts the node graph without ros2 launch: one process per node, SIGINT forwarded, exit codes kept."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from buildloc.settings import MAPPER, MATCHER, REFERENCE_DB, SEGMENTER, Settings, dump, resource

MODULES = {
    REFERENCE_DB: "buildloc_matcher.reference_db_node",
    SEGMENTER: "buildloc_segmenter.segmenter_node",
    MAPPER: "buildloc_mapper.mapper_node",
    MATCHER: "buildloc_matcher.matcher_node",
}
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
# A node imports for seconds before ROS takes its signals: SIGINT must end it without a traceback then, too.
START = (
    "import runpy, signal, sys; signal.signal(signal.SIGINT, lambda *_: sys.exit(0)); "
    "runpy.run_module(sys.argv.pop(1), run_name='__main__', alter_sys=True)"
)
GRACE_S = 10.0
POLL_S = 0.1


def dds_environment() -> dict[str, str]:
    """The environment with the installed DDS profile, unless the user has set one."""
    return {PROFILES: str(resource("config/fastdds.xml")), **os.environ}


class Supervisor:
    """The processes of one graph; use as a context manager, leaving it stops them."""

    def __init__(self, settings: Settings, folder: Path, modules: dict[str, str] | None = None) -> None:
        """``folder`` takes the parameter file; ``modules`` maps node names to Python modules."""
        self._modules = modules or MODULES
        self._parameters = folder / "parameters.yaml"
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        dump(settings, self._parameters)

    def start(self) -> None:
        """Start every node in a process group of its own, so that a terminal's SIGINT comes through us."""
        for name, module in self._modules.items():
            arguments = [module, "--ros-args", "--params-file", str(self._parameters)]
            self._processes[name] = subprocess.Popen(
                [sys.executable, "-c", START, *arguments],
                env=dds_environment(),
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )

    def dead(self) -> dict[str, int]:
        """Exit status of every node that has ended."""
        codes = {name: process.poll() for name, process in self._processes.items()}
        return {name: code for name, code in codes.items() if code is not None}

    def stop(self) -> dict[str, int]:
        """SIGINT to all, SIGKILL to those that do not end in time; the exit status of each."""
        for process in self._processes.values():
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + GRACE_S
        for process in self._processes.values():
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        return self.dead()

    def __enter__(self) -> Supervisor:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def failures(codes: dict[str, int]) -> list[str]:
    """One line for each node that did not end with status 0."""
    return [f"{name} ended with status {code}" for name, code in codes.items() if code != 0]


def supervise(supervisor: Supervisor, stop_signals: Sequence[int] = (signal.SIGINT, signal.SIGTERM)) -> int:
    """Run the graph until a signal or until a node ends; 0 when all ended cleanly on request, else 1 or 2."""
    asked: list[int] = []
    for number in stop_signals:
        signal.signal(number, lambda received, _: asked.append(received))
    with supervisor:
        while not asked and not supervisor.dead():
            time.sleep(POLL_S)
        died = supervisor.dead()
        codes = supervisor.stop()
    if not asked:
        for name, code in died.items():
            print(f"error: {name} ended with status {code}; the graph was stopped", file=sys.stderr)
        return 2 if 2 in died.values() else 1
    for line in failures(codes):
        print(f"error: {line}", file=sys.stderr)
    return 1 if failures(codes) else 0
