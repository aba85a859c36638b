"""A node's parameters come from its config dataclass: values, ranges, and one line for a wrong one. Its
workers tell it what came of their work."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

import rclpy
from buildloc_msgs_py.config import ConfigError, param
from buildloc_msgs_py.ros_node import Worker, declare_config
from drone import DEADLINE_S, domain_id
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

pytestmark = pytest.mark.dds


@dataclass(frozen=True)
class Config:
    count: int = param(3, "how many", 1, 9)
    period_s: float = param(0.5, "how often, s", 0.1, 60.0)
    mean: tuple[float, ...] = param((0.0, 1.0), "per channel")
    name: str = param("", "any text")


Make = Callable[..., Node]


@pytest.fixture
def make() -> Iterator[Make]:
    """A node with parameters as a launch file would give them."""
    context = Context()
    rclpy.init(context=context, domain_id=domain_id())

    def node(**values: Any) -> Node:
        overrides = [Parameter(name, value=value) for name, value in values.items()]
        return Node("configured", context=context, parameter_overrides=overrides)

    yield node
    rclpy.try_shutdown(context=context)


def test_parameters_are_read_and_described_with_their_ranges(make: Make) -> None:
    node = make(count=7, period_s=2, mean=[0.5, 0.25])
    assert declare_config(node, Config) == Config(7, 2.0, (0.5, 0.25), "")
    described = node.describe_parameter("count")
    assert described.description == "how many" and described.read_only
    assert (described.integer_range[0].from_value, described.integer_range[0].to_value) == (1, 9)
    described = node.describe_parameter("period_s")
    assert (described.floating_point_range[0].from_value, described.floating_point_range[0].to_value) == (
        0.1,
        60.0,
    )
    assert not node.set_parameters([Parameter("count", value=8)])[0].successful


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"count": 10}, r"parameter count = 10 is out of range \[1, 9\]"),
        ({"period_s": 0.05}, r"parameter period_s = 0.05 is out of range \[0.1, 60\]"),
        ({"period_s": float("nan")}, r"parameter period_s = nan is out of range \[0.1, 60\]"),
        ({"count": "many"}, "parameter count = 'many' is not a int"),
    ],
)
def test_a_wrong_value_is_named_with_its_range(make: Make, values: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        declare_config(make(**values), Config)


def spin_until(node: Node, condition: Callable[[], object]) -> None:
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline
        executor.spin_once(timeout_sec=0.02)


def test_a_worker_tells_what_came_of_its_work_in_order_and_on_the_executor(make: Make) -> None:
    node, told = make(), list[tuple[object, str]]()
    worker = Worker(node, "work")

    def fail() -> int:
        raise ValueError("no")

    def tell(done: Future[int]) -> None:
        told.append((done.exception() or done.result(), threading.current_thread().name))

    for work in (lambda: 1, fail, lambda: 3):
        worker.submit(work, tell)
    spin_until(node, lambda: len(told) == 3)
    (first, second, third), threads = zip(*told, strict=True)
    assert (first, third) == (1, 3) and isinstance(second, ValueError)
    assert set(threads) == {threading.current_thread().name}
    worker.shutdown()


def test_what_a_worker_is_to_forget_is_never_told(make: Make) -> None:
    node, told, begun, go_on = make(), list[object](), threading.Event(), threading.Event()
    worker = Worker(node, "work")

    def wait() -> bool:
        begun.set()
        return go_on.wait(DEADLINE_S)

    worker.submit(wait, told.append)
    worker.submit(lambda: None, told.append)
    assert begun.wait(DEADLINE_S)
    threading.Timer(0.0, go_on.set).start()
    worker.forget()
    worker.submit(lambda: None, lambda done: told.append("after"))
    spin_until(node, lambda: told)
    assert told == ["after"]
    worker.shutdown()
