"""The supervisor: SIGINT ends the graph cleanly, and so does a node that ends by itself."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

import rclpy
from buildloc.settings import MAPPER, NODES, load
from buildloc.supervisor import MODULES, Supervisor, dds_environment, supervise
from drone import DEADLINE_S, Drone, domain_id
from rclpy.context import Context

pytestmark = pytest.mark.dds


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@contextmanager
def launch(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """`buildloc launch` as a user starts it, ended with its nodes in any case."""
    process = subprocess.Popen(
        [sys.executable, "-m", "buildloc.cli", "launch", *arguments],
        env={**dds_environment(), "ROS_DOMAIN_ID": str(domain_id())}, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.communicate(timeout=DEADLINE_S)


def wait_until_all_speak() -> None:
    """Every node is up once it was heard on /diagnostics."""
    context = Context()
    rclpy.init(context=context, domain_id=domain_id())
    drone = Drone(context)
    try:
        drone.until(lambda: set(NODES) <= drone.states.keys())
    finally:
        drone.destroy_node()
        rclpy.try_shutdown(context=context)


def node_process(supervisor: subprocess.Popen[str], node: str) -> int:
    """The process id of a node that a supervisor started."""
    for child in Path(f"/proc/{supervisor.pid}/task/{supervisor.pid}/children").read_text().split():
        if MODULES[node] in Path(f"/proc/{child}/cmdline").read_text():
            return int(child)
    raise AssertionError(f"{node} is not running")


def test_sigint_ends_the_graph_cleanly() -> None:
    with launch() as process:
        wait_until_all_speak()
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=DEADLINE_S)
        assert process.returncode == 0, said
        assert "error" not in said and "Traceback" not in said


def test_a_node_that_dies_ends_the_graph() -> None:
    with launch() as process:
        wait_until_all_speak()
        os.kill(node_process(process, MAPPER), signal.SIGKILL)
        _, said = process.communicate(timeout=DEADLINE_S)
        assert process.returncode == 1
        errors = [line for line in said.splitlines() if line.startswith("error: ")]
        assert errors == ["error: mapper_node ended with status -9; the graph was stopped"]
        assert "Traceback" not in said


def test_a_node_that_refuses_a_parameter_ends_the_graph_and_names_it_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain_id()))
    settings = load(overrides=["mapper_node.features=7"])
    assert supervise(Supervisor(settings, tmp_path), stop_signals=()) == 2
    assert capfd.readouterr().err.splitlines() == [
        "error: parameter features = 7 is out of range [50, 20000]",
        "error: mapper_node ended with status 2; the graph was stopped",
    ]


def module(folder: Path, name: str, *lines: str) -> str:
    """A stand-in for a node."""
    (folder / f"{name}.py").write_text(
        "\n".join(("import signal, sys, time", "from pathlib import Path", *lines))
    )
    return name


@pytest.fixture
def modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder from which the supervisor's Python takes modules."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return tmp_path


def test_sigint_before_a_node_handles_it_is_clean_too(
    modules: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """A node imports for seconds before ROS takes its signals; Python alone would end with a traceback."""
    up = modules / "up"
    name = module(modules, "importing", f"Path({str(up)!r}).touch()", "signal.pause()")
    with Supervisor(load(), modules, {"slow": name}) as supervisor:
        until(up.exists)
        assert supervisor.dead() == {}
        assert supervisor.stop() == {"slow": 0}
    assert capfd.readouterr().err == ""


def test_a_node_that_ends_takes_the_others_with_it(modules: Path, capfd: pytest.CaptureFixture[str]) -> None:
    up = modules / "up"
    waits = module(modules, "waits", f"Path({str(up)!r}).touch()", "signal.pause()")
    for status, expected in ((0, 1), (1, 1), (2, 2)):
        up.unlink(missing_ok=True)
        lines = (f"while not Path({str(up)!r}).exists():", "    time.sleep(0.01)", f"sys.exit({status})")
        ends = module(modules, f"ends{status}", *lines)
        supervisor = Supervisor(load(), modules, {"waits": waits, "ends": ends})
        assert supervise(supervisor, stop_signals=()) == expected
        assert capfd.readouterr().err == f"error: ends ended with status {status}; the graph was stopped\n"
        assert supervisor.dead().keys() == {"waits", "ends"}


def test_a_node_that_does_not_end_is_killed(modules: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("buildloc.supervisor.GRACE_S", 0.2)
    up = modules / "up"
    lines = ("signal.signal(signal.SIGINT, signal.SIG_IGN)", f"Path({str(up)!r}).touch()", "while True:")
    with Supervisor(
        load(), modules, {"deaf": module(modules, "deaf", *lines, "    signal.pause()")}
    ) as graph:
        until(up.exists)
        assert graph.stop() == {"deaf": -signal.SIGKILL}
