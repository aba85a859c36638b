"""The matcher's presets as a ROS parameter: by name, with others over it, an unknown one in one line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

import rclpy
from buildloc.settings import MATCHER, dump, load
from buildloc_matcher.config import MatcherConfig, matcher_config
from buildloc_matcher.matcher_node import MatcherNode
from buildloc_msgs_py.config import ConfigError
from drone import domain_id
from rclpy.context import Context
from rclpy.parameter import Parameter

pytestmark = pytest.mark.dds


@pytest.fixture
def context() -> Iterator[Context]:
    made = Context()
    rclpy.init(context=made, domain_id=domain_id())
    yield made
    rclpy.try_shutdown(context=made)


def config_of(context: Context, **parameters: object) -> MatcherConfig:
    """What a node makes of its parameters."""
    overrides = [Parameter(name, value=value) for name, value in parameters.items()]
    node = MatcherNode(context=context, parameter_overrides=overrides)
    config = node.session.config
    shown = {name: node.get_parameter(name).value for name in ("top_k", "votes", "selection")}
    assert shown == {name: getattr(config, name) for name in shown}  # `ros2 param get` tells what is used
    node.destroy_node()
    return config


def test_a_preset_by_name(context: Context) -> None:
    assert config_of(context) == config_of(context, preset="default") == matcher_config()
    assert config_of(context, preset="paper") == matcher_config({"preset": "paper"})


def test_a_parameter_goes_over_the_preset(context: Context) -> None:
    expected = matcher_config({"preset": "paper", "top_k": 7})
    assert config_of(context, preset="paper", top_k=7) == expected


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"preset": "fast"}, "preset fast is unknown; there are default, paper"),
        ({"preset": "paper", "votes": "loud"}, "parameter votes = loud is not one of score, evidence"),
    ],
)
def test_what_is_unknown_is_one_line(context: Context, parameters: dict[str, object], text: str) -> None:
    with pytest.raises(ConfigError) as error:
        config_of(context, **parameters)
    assert text in str(error.value) and "\n" not in str(error.value)


def test_the_preset_of_a_parameter_file(tmp_path: Path) -> None:
    """As launch files and the supervisor hand it to the node: a YAML of ROS parameters."""
    path = tmp_path / "settings.yaml"
    dump(load(None, [f"{MATCHER}.preset=paper"]), path)
    made = Context()
    rclpy.init(args=["--ros-args", "--params-file", str(path)], context=made, domain_id=domain_id())
    try:
        assert config_of(made) == matcher_config({"preset": "paper"})
    finally:
        rclpy.try_shutdown(context=made)
