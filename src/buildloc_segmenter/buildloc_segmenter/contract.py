"""What a segmentation network takes and gives: as its own file says, or as the parameters say."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass

from buildloc_msgs_py.config import ConfigError, from_mapping

from buildloc_segmenter.config import SegmenterConfig, check_segmenter

METADATA_KEY = "buildloc"  # of the ONNX file's metadata: the contract as JSON
# The two fields whose parameter has another name, because there they stand among other lengths.
PARAMETERS = {"gsd_m": "network_gsd_m", "gsd_range_m": "network_gsd_range_m"}


@dataclass(frozen=True)
class Contract:
    """Input and output of a network; docs/segmentation_networks.md tells each field.

    ``gsd_m``: metres per pixel of its input, 0: images as they come. ``gsd_range_m``: lowest and highest of
    the images that it was trained for. ``channels``: what each channel of the output holds.
    """

    gsd_m: float
    gsd_range_m: tuple[float, ...]
    layout: str
    channel_order: str
    mean: tuple[float, ...]
    std: tuple[float, ...]
    input_multiple: int
    output: str
    channels: tuple[str, ...]

    def to_json(self) -> str:
        """The text that travels in the file, under :data:`METADATA_KEY`."""
        return json.dumps(dataclasses.asdict(self))


def contract_of(config: SegmenterConfig) -> Contract:
    """The contract that the parameters state; raises ConfigError."""
    check_segmenter(config)
    names = [field.name for field in dataclasses.fields(Contract)]
    return Contract(**{name: getattr(config, PARAMETERS.get(name, name)) for name in names})


def contract_from_json(text: str) -> Contract:
    """The contract of a file, by the rules of the parameters; raises ConfigError with one line."""
    try:
        values = json.loads(text)
    except ValueError as error:
        raise ConfigError(f"contract is no JSON ({error})") from error
    names = {field.name for field in dataclasses.fields(Contract)}
    if not isinstance(values, dict) or values.keys() != names:
        given = ", ".join(sorted(values)) if isinstance(values, dict) else type(values).__name__
        raise ConfigError(f"contract holds {given}; expected {', '.join(sorted(names))}")
    config = from_mapping(SegmenterConfig, {PARAMETERS.get(str(k), str(k)): v for k, v in values.items()})
    if not config.channels:
        raise ConfigError("contract names no channels")
    return contract_of(config)
