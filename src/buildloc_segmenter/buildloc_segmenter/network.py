"""A segmentation network in ONNX behind one class. The only module with onnxruntime."""

from __future__ import annotations

import importlib.resources
import itertools
import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
from buildloc_msgs_py.config import ConfigError
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import ByteArray

from buildloc_segmenter.config import SegmenterConfig
from buildloc_segmenter.contract import METADATA_KEY, contract_from_json, contract_of
from buildloc_segmenter.instances import (
    FloatImage,
    Instances,
    draw_mask,
    find_instances,
    owned,
    probability,
)
from buildloc_segmenter.outlines import Building, buildings
from buildloc_segmenter.tiles import Block, blocks, starts

# Networks that come with the package, by the value of the parameter model.
SHIPPED = {"": "models/buildings_lite0.onnx", "int8": "models/buildings_lite0_int8.onnx"}
CPU = "CPUExecutionProvider"
TILE_PX = 1024  # larger inputs go through in tiles: memory stays bounded
OVERLAP_PX = 96
PROBE_PX = 256
MAX_STRIDE = 32.0
BLOCK_PX = 2048  # larger images are divided into blocks, at the network's ground sampling distance
BLOCK_OVERLAP_M = 120.0  # a building of this size lies whole in the block that holds its centroid
MAX_ZOOM = 4.0  # finer than this share of its own pixels an image holds nothing new


class NetworkError(BuildlocError):
    """A network cannot be loaded or does not keep the contract."""


@dataclass(frozen=True)
class Scores:
    """Logits (h, w) float32 at ``gsd_m`` metres per pixel: of building, and of cores where the network has
    them (the inside of each building, so that those of touching roofs are separate)."""

    building: FloatImage
    core: FloatImage | None
    gsd_m: float


@dataclass(frozen=True)
class Segmentation:
    """Mask (H, W) uint8, 0 or 255, and the buildings of an image."""

    mask: ByteArray
    buildings: tuple[Building, ...]


class Network:
    """Scores of an image; docs/segmentation_networks.md is the contract.

    Construction loads the file and runs it once on noise. Raises NetworkError, or ConfigError. ``provider``
    is the ONNX Runtime provider that runs it; one that was asked for and does not run is logged.
    ``path`` is its file, ``metadata`` what that says of itself.
    """

    def __init__(self, config: SegmenterConfig) -> None:
        self.contract = contract_of(config)
        self._config = config
        self.path = _path(config.model)
        self._session = _load(self.path, config)
        self.provider: str = self._session.get_providers()[0]
        self.metadata: dict[str, str] = dict(self._session.get_modelmeta().custom_metadata_map)
        own = self.metadata.get(METADATA_KEY)
        self._carries_contract = own is not None
        if own is not None:
            try:
                self.contract = contract_from_json(own)
            except ConfigError as error:
                raise NetworkError(f"{self.path}: {error}; export it again") from error
        inputs = self._session.get_inputs()
        shape = inputs[0].shape
        if len(inputs) != 1 or len(shape) != 4 or inputs[0].type != "tensor(float)":
            raise self._wrong("layout")
        channels, other = shape[1::2] if self.contract.layout == "NCHW" else shape[3::-2]
        if channels != 3 and (isinstance(channels, int) or other == 3):
            raise self._wrong("layout")
        axes = shape[2:4] if self.contract.layout == "NCHW" else shape[1:3]
        self._input, self._output = inputs[0].name, self._session.get_outputs()[0].name
        self._fixed = (int(axes[0]), int(axes[1])) if all(isinstance(a, int) for a in axes) else None
        self._probe()

    def doubt(self, gsd_m: float) -> str | None:
        """Why masks of images at this ground sampling distance may be poor; None: they should not be."""
        low, high = self.contract.gsd_range_m
        if low <= gsd_m <= high:
            return None
        return (
            f"images have {gsd_m:.3g} m per pixel, outside of the {low:g} to {high:g} m that the network was "
            "trained for: expect poor masks"
        )

    def warm_up(self) -> None:
        """Run once at the largest size of one inference: its memory and first-time work are taken now."""
        side = self._whole(TILE_PX)
        self._run(np.zeros((*(self._fixed or (side, side)), 3), dtype=np.uint8))

    def segment(self, image_bgr: ByteArray, gsd_m: float) -> ByteArray:
        """(H, W, 3) uint8 BGR at ``gsd_m`` metres per pixel -> (H, W) uint8 mask, 0 or 255.

        Buildings that touch have a line of background between them.
        """
        mask = np.zeros(image_bgr.shape[:2], dtype=np.uint8)
        for block, found in self.blocks(image_bgr, gsd_m):
            part = mask[block.rows, block.columns]
            part |= draw_mask(found, part.shape[::-1])
        return mask

    def segment_buildings(self, image_bgr: ByteArray, gsd_m: float) -> Segmentation:
        """The mask as :meth:`segment` has it, and each building with its outline."""
        mask, found = np.zeros(image_bgr.shape[:2], dtype=np.uint8), list[Building]()
        for block, instances in self.blocks(image_bgr, gsd_m):
            part = mask[block.rows, block.columns]
            part |= draw_mask(instances, part.shape[::-1])
            corner = (block.columns.start, block.rows.start)
            found += [building.moved(*corner) for building in buildings(instances, gsd_m)]
        return Segmentation(mask, tuple(found))

    def blocks(self, image_bgr: ByteArray, gsd_m: float) -> Iterator[tuple[Block, Instances]]:
        """The buildings of an image of any size, each in the block that holds its centroid."""
        height, width = image_bgr.shape[:2]
        zoom = self.zoom(gsd_m)
        side = round(BLOCK_PX / zoom)
        for block in blocks(height, width, side, min(round(BLOCK_OVERLAP_M / gsd_m), side // 2)):
            found = self.instances(image_bgr[block.rows, block.columns], gsd_m)
            yield block, found if block.is_all else owned(found, block.own_in_window(zoom))

    def instances(self, image_bgr: ByteArray, gsd_m: float) -> Instances:
        """The buildings of an image (H, W, 3), as one block, at the network's ground sampling distance."""
        config, scores = self._config, self.scores(image_bgr, gsd_m)
        building = scores.building - np.float32(math.log(config.threshold / (1.0 - config.threshold)))
        return find_instances(
            building, scores.core, scores.gsd_m, config.min_component_m2, config.min_score, gsd_m
        )

    def scores(self, image_bgr: ByteArray, gsd_m: float) -> Scores:
        """(H, W, 3) uint8 BGR at ``gsd_m`` metres per pixel -> logits at the network's."""
        height, width = image_bgr.shape[:2]
        zoom = self.zoom(gsd_m)
        rows, columns = max(1, round(height * zoom)), max(1, round(width * zoom))
        method = cv2.INTER_AREA if rows < height else cv2.INTER_LINEAR
        resized = cv2.resize(image_bgr, (columns, rows), interpolation=method)
        building, *core = self._logits(np.asarray(resized, dtype=np.uint8))
        return Scores(building, core[0] if core else None, gsd_m / zoom)

    def zoom(self, gsd_m: float) -> float:
        """Network pixels per image pixel."""
        trained = self.contract.gsd_m
        return min(gsd_m / trained, MAX_ZOOM) if trained > 0.0 else 1.0

    def probability(self, image_bgr: ByteArray, gsd_m: float) -> FloatImage:
        """(H, W, 3) uint8 BGR -> (H, W) float32 building probability."""
        logits = self.scores(image_bgr, gsd_m).building
        upsampled = cv2.resize(logits, image_bgr.shape[1::-1], interpolation=cv2.INTER_LINEAR)
        return probability(np.asarray(upsampled, dtype=np.float32))

    def _wrong(self, parameters: str, found: str = "") -> NetworkError:
        """What this contract expects of a file, what the file has, and what to put right."""
        contract, session = self.contract, self._session
        size = "3, h, w" if contract.layout == "NCHW" else "h, w, 3"
        holds = ", ".join(contract.channels) or "building, or background and building"
        has = "; ".join(
            f"{kind} " + ", ".join(f"{v.name} {v.type} {v.shape}" for v in values)
            for kind, values in (("input", session.get_inputs()), ("output", session.get_outputs()))
        )
        remedy = "export it again" if self._carries_contract else f"correct the parameters {parameters}"
        return NetworkError(
            f"{self.path}: is not a segmentation network of this contract: expected input tensor(float) "
            f"[n, {size}] and output of the channels {holds} in the image's shape; found {found or has}; "
            f"{remedy}, or give another file"
        )

    def _probe(self) -> None:
        """Run once on noise: shows a wrong output before the flight, not in it."""
        # An odd multiple: a network that needs a larger multiple does not run on it.
        multiple = self.contract.input_multiple
        side = (math.ceil(PROBE_PX / multiple) | 1) * multiple
        size = self._fixed or (side, side)
        noise = np.random.default_rng(0).integers(0, 256, (*size, 3), dtype=np.uint8)
        scores = self._run(noise)
        probable = bool(scores.min() >= 0.0 and scores.max() <= 1.0)
        if probable != (self.contract.output == "probability"):
            right = "probability" if probable else "logits"
            remedy = "export it again" if self._carries_contract else f"set the parameter output to {right}"
            raise NetworkError(
                f"{self.path}: output from {scores.min():.3g} to {scores.max():.3g} is not "
                f"{self.contract.output}; {remedy}"
            )

    def _whole(self, side: int) -> int:
        """The side, rounded up to what the network takes."""
        return math.ceil(side / self.contract.input_multiple) * self.contract.input_multiple

    def _tile_side(self, size: int) -> int:
        """The side of as few equal tiles as cover ``size`` pixels: no larger than their overlap asks for."""
        count = max(1, math.ceil((size - OVERLAP_PX) / (self._whole(TILE_PX) - OVERLAP_PX)))
        return self._whole(math.ceil((size + (count - 1) * OVERLAP_PX) / count))

    def _logits(self, image_bgr: ByteArray) -> FloatImage:
        """(1 or 2, rows, columns) logits of building and core; tiles are averaged where they overlap."""
        rows, columns = image_bgr.shape[:2]
        tile = self._fixed or (self._tile_side(rows), self._tile_side(columns))
        height, width = max(rows, tile[0]), max(columns, tile[1])
        border = (0, height - rows, 0, width - columns)
        padded = np.asarray(cv2.copyMakeBorder(image_bgr, *border, cv2.BORDER_REPLICATE), dtype=np.uint8)
        tops, lefts = (
            starts(size, part, min(OVERLAP_PX, part // 4))
            for size, part in zip((height, width), tile, strict=True)
        )
        corners = list(itertools.product(tops, lefts))
        if len(corners) == 1:
            return self._tile_logits(padded)[:, :rows, :columns]
        total = np.zeros((1 + ("core" in self.contract.channels), height, width), dtype=np.float32)
        count = np.zeros((height, width), dtype=np.float32)
        for top, left in corners:
            window = np.s_[top : top + tile[0], left : left + tile[1]]
            total[:, *window] += self._tile_logits(padded[window])
            count[window] += 1.0
        total /= count
        return total[:, :rows, :columns]

    def _tile_logits(self, tile_bgr: ByteArray) -> FloatImage:
        """(1 or 2, h, w) logits of building and core at the tile's size, whatever the output's stride."""
        values = self._run(tile_bgr)
        names = self._channels(len(values))
        if self.contract.output == "probability":
            values = np.clip(values, 1e-6, 1.0 - 1e-6)
            values = np.log(values / (1.0 - values))
        planes = dict(zip(names, values, strict=True))
        if "background" in planes and self.contract.output == "logits":
            planes["building"] = planes["building"] - planes["background"]
        size = tile_bgr.shape[1::-1]
        wanted = [planes[name] for name in ("building", "core") if name in planes]
        if wanted[0].shape[::-1] != size:
            wanted = [cv2.resize(plane, size, interpolation=cv2.INTER_LINEAR) for plane in wanted]
        return np.asarray(wanted[0][None] if len(wanted) == 1 else np.stack(wanted), dtype=np.float32)

    def _channels(self, count: int) -> tuple[str, ...]:
        """What the channels of an output hold; NetworkError when they are not as many as there should be."""
        named = self.contract.channels or (("background", "building") if count == 2 else ("building",))
        if count != len(named):
            raise self._wrong("channels and layout", f"an output of {count} channel" + "s" * (count != 1))
        return named

    def _run(self, tile_bgr: ByteArray) -> FloatImage:
        """(C, h, w) output of the network for one tile."""
        contract = self.contract
        height, width = tile_bgr.shape[:2]
        planes = cv2.split(tile_bgr)
        tensor = np.empty((1, 3, height, width), dtype=np.float32)
        ordered = planes[::-1] if contract.channel_order == "rgb" else planes
        for out, plane, mean, std in zip(tensor[0], ordered, contract.mean, contract.std, strict=True):
            np.subtract(plane, np.float32(mean), out=out, dtype=np.float32)
            out /= np.float32(std)
        if contract.layout == "NHWC":
            tensor = np.ascontiguousarray(tensor.transpose(0, 2, 3, 1))
        try:
            (output,) = self._session.run([self._output], {self._input: tensor})
            values = np.asarray(output, dtype=np.float32)
        except Exception as error:  # onnxruntime has no base class for its errors
            raise NetworkError(
                f"{self.path}: does not run on {width}x{height} pixels ({_line(error)}); "
                + ("export it again" if self._carries_contract else
                   "correct the parameters layout and input_multiple")
            ) from error  # fmt: skip
        scores = self._planes(values, (height, width))
        if not np.isfinite(scores).all():
            raise NetworkError(f"{self.path}: output is not finite; correct the parameters mean and std")
        return scores

    def _planes(self, output: FloatImage, size: tuple[int, int]) -> FloatImage:
        """(C, h, w) of an output with or without batch and class axes."""
        values = output[0] if output.ndim == 4 else output
        if values.ndim == 3 and self.contract.layout == "NHWC" and values.shape[2] <= 3:
            values = values.transpose(2, 0, 1)
        if values.ndim == 2:
            values = values[None]
        if values.ndim != 3:
            raise self._wrong("layout", f"an output {list(output.shape)}")
        self._channels(len(values))
        strides = [side / max(part, 1) for side, part in zip(size, values.shape[1:], strict=True)]
        if max(strides) > min(MAX_STRIDE, 1.1 * min(strides)):
            raise self._wrong("layout", f"an output {list(output.shape)} for {size[1]}x{size[0]} pixels")
        return values


def _path(model: str) -> Path:
    """The file of the parameter model."""
    if model not in SHIPPED:
        return Path(model)
    return Path(str(importlib.resources.files("buildloc_segmenter").joinpath(SHIPPED[model])))


def _load(path: Path, config: SegmenterConfig) -> onnxruntime.InferenceSession:
    """A session on the first provider that starts; a warning in the log when that was not the first asked."""
    if not path.is_file():
        raise NetworkError(f"{path}: no such ONNX file; correct the parameter model")
    known = onnxruntime.get_all_providers()
    unknown = [name for name in config.providers if name not in known]
    if unknown:
        raise NetworkError(
            f"parameter providers: {', '.join(unknown)} is no provider of ONNX Runtime; it knows "
            f"{', '.join(known)}"
        )
    available = onnxruntime.get_available_providers()
    before_cpu = itertools.takewhile(lambda name: name != CPU, config.providers)
    wanted = [name for name in before_cpu if name in available]
    session = _start(path, config, wanted)
    running = session.get_providers()[0]
    if running != config.providers[0]:
        logging.getLogger(__name__).warning(
            "%s does not run here (this ONNX Runtime has %s); the network runs on %s",
            config.providers[0], ", ".join(available), running,
        )  # fmt: skip
    return session


def _start(path: Path, config: SegmenterConfig, providers: list[str]) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = config.threads
    # Threads that spin between two inferences take the cores from everything else that runs on them.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 4  # what goes wrong is raised or told by _load
    try:
        # Its own fallback prints a banner; the next provider is ours to try.
        return onnxruntime.InferenceSession(str(path), options, [*providers, CPU], enable_fallback=0)
    except Exception as error:  # onnxruntime has no base class for its errors
        if providers:
            return _start(path, config, providers[1:])
        raise NetworkError(
            f"{path}: is not a loadable ONNX network ({_line(error)}); export it again"
        ) from error


def _line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
