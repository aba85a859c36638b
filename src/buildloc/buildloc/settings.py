"""One YAML of ROS parameters for nodes, launch files and the command line alike."""

from __future__ import annotations

import importlib.resources
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from buildloc_mapper.config import MapperConfig
from buildloc_matcher.config import MatcherConfig, matcher_config
from buildloc_msgs_py.config import ConfigError, from_mapping
from buildloc_segmenter.config import SegmenterConfig

ConfigT = TypeVar("ConfigT")
Settings = dict[str, dict[str, Any]]
SEGMENTER, MAPPER, MATCHER, REFERENCE_DB = (
    "segmenter_node",
    "mapper_node",
    "matcher_node",
    "reference_db_node",
)
NODES = (REFERENCE_DB, SEGMENTER, MAPPER, MATCHER)
NOT_CONFIG = ("use_sim_time", "database")


def resource(name: str) -> Path:
    """A file that is installed with this package."""
    return Path(str(importlib.resources.files("buildloc").joinpath(name)))


def load(path: Path | None = None, overrides: Sequence[str] = ()) -> Settings:
    """Parameters per node from a YAML (the installed one by default) and ``NODE.PARAMETER=VALUE`` overrides.

    Raises ConfigError with one line when the file or an override cannot be understood.
    """
    path = path or resource("config/buildloc.yaml")
    try:
        document = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"{path}: not a readable parameter file ({str(error).splitlines()[0]})") from error
    settings: Settings = {node: {} for node in NODES}
    for node, block in (document or {}).items():
        parameters = block.get("ros__parameters") if isinstance(block, Mapping) else None
        if node not in settings or not isinstance(parameters, Mapping):
            raise ConfigError(
                f"{path}: expected `NODE: {{ros__parameters: ...}}` for {', '.join(NODES)}, not {node}"
            )
        settings[node].update(parameters)
    for text in overrides:
        name, equals, value = text.partition("=")
        node, dot, parameter = name.partition(".")
        if not (equals and dot) or node not in settings:
            raise ConfigError(
                f"--set {text}: expected NODE.PARAMETER=VALUE with NODE one of {', '.join(NODES)}"
            )
        settings[node][parameter] = yaml.safe_load(value)
    return settings


def config_of(settings: Settings, node: str, cls: type[ConfigT]) -> ConfigT:
    """The config dataclass of a node; raises ConfigError naming the parameter that is wrong."""
    return from_mapping(cls, {k: v for k, v in settings[node].items() if k not in NOT_CONFIG})


def matcher_config_of(settings: Settings, node: str = MATCHER) -> MatcherConfig:
    """The config of a node of the matcher, over the preset it names; raises ConfigError."""
    return matcher_config({k: v for k, v in settings[node].items() if k not in NOT_CONFIG})


def check_settings(settings: Settings) -> None:
    """Raises ConfigError for a parameter that its node does not have, or not with such a value: a node itself
    ignores a name that it does not know."""
    config_of(settings, SEGMENTER, SegmenterConfig)
    config_of(settings, MAPPER, MapperConfig)
    for node in (MATCHER, REFERENCE_DB):
        matcher_config_of(settings, node)


def dump(settings: Settings, path: Path) -> None:
    """Write the parameters as ROS reads them."""
    document = {node: {"ros__parameters": values} for node, values in settings.items() if values}
    path.write_text(yaml.safe_dump(document))
