"""Every parameter of the segmenter: the keyframe policy and the contract with an ONNX network."""

from __future__ import annotations

import math
from dataclasses import dataclass

from buildloc_msgs_py.config import ConfigError, check, param

LAYOUTS = ("NCHW", "NHWC")
CHANNEL_ORDERS = ("rgb", "bgr")
OUTPUTS = ("logits", "probability")
CHANNELS = ("background", "building", "core")


@dataclass(frozen=True)
class SegmenterConfig:
    """Parameters of keyframe selection, of the network's input and output, and of mask clean-up.

    The network's input and output are described for files that do not carry their own contract.
    """

    keyframe_rotation_deg: float = param(15.0, "in-plane rotation that makes a keyframe, deg", 0.1, 180.0)
    keyframe_period_s: float = param(5.0, "time that makes a keyframe, s", 0.0, 3600.0)
    model: str = param(
        "", "path of an ONNX network; empty: the one that is shipped, int8: the same quantised"
    )
    providers: tuple[str, ...] = param(
        ("CPUExecutionProvider",),
        "ONNX Runtime execution providers, by preference; the CPU is the last resort",
    )
    threads: int = param(0, "threads of one inference; 0: ONNX Runtime decides", 0, 256)
    network_gsd_m: float = param(0.2, "ground sampling distance of the training, m; 0: any", 0.0, 10.0)
    network_gsd_range_m: tuple[float, ...] = param((0.1, 0.5), "images it was trained for, from, to, m")
    layout: str = param("NCHW", "order of the input's axes: NCHW or NHWC")
    channel_order: str = param("rgb", "order of the input's channels: rgb or bgr")
    mean: tuple[float, ...] = param((0.0, 0.0, 0.0), "subtracted from the 0-255 channels, in channel order")
    std: tuple[float, ...] = param((1.0, 1.0, 1.0), "divides the channels after that, in channel order")
    input_multiple: int = param(32, "the input's sides are multiples of this, px", 1, 1024)
    output: str = param("logits", "what the output holds: logits or probability")
    channels: tuple[str, ...] = param(
        (), "what each channel of the output holds: background, building, core; empty: [background,] building"
    )
    threshold: float = param(0.5, "building probability that makes a pixel building", 0.01, 0.99)
    min_component_m2: float = param(8.0, "smaller buildings and holes are removed, m2", 0.0, 1000.0)
    min_score: float = param(0.56, "buildings of a lower mean core probability are removed", 0.0, 1.0)


def check_segmenter(config: SegmenterConfig) -> None:
    """Raise ConfigError for the first value that is out of range or not among its choices."""
    check(config)
    for name, value, choices in (
        ("layout", config.layout, LAYOUTS),
        ("channel_order", config.channel_order, CHANNEL_ORDERS),
        ("output", config.output, OUTPUTS),
    ):
        if value not in choices:
            raise ConfigError(f"parameter {name} = {value} is not one of {', '.join(choices)}")
    for name, values in (("mean", config.mean), ("std", config.std)):
        if len(values) != 3 or not all(isinstance(v, (int, float)) and math.isfinite(v) for v in values):
            raise ConfigError(f"parameter {name} = {list(values)} is not three numbers, one per channel")
    if not all(value > 0.0 for value in config.std):
        raise ConfigError(f"parameter std = {list(config.std)} is not positive")
    span = config.network_gsd_range_m
    if len(span) != 2 or not all(isinstance(v, (int, float)) for v in span) or not 0.0 < span[0] <= span[1]:
        raise ConfigError(f"parameter network_gsd_range_m = {list(span)} is not two lengths, from and to")
    unknown = [name for name in config.channels if name not in CHANNELS]
    if unknown or len(set(config.channels)) != len(config.channels):
        raise ConfigError(
            f"parameter channels = {list(config.channels)} is not each of {', '.join(CHANNELS)} at most once"
        )
    if config.channels and "building" not in config.channels:
        raise ConfigError(f"parameter channels = {list(config.channels)} has no building")
    if not config.providers:
        raise ConfigError("parameter providers is empty; name one, such as CPUExecutionProvider")
