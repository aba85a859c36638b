"""A segmentation network in ONNX behind one function. The only module with onnxruntime."""

from __future__ import annotations

import importlib.resources
import math
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import ByteArray
from numpy.typing import NDArray

from buildloc_segmenter.config import SegmenterConfig, check_segmenter

FloatImage = NDArray[np.float32]
SHIPPED = "models/buildings_lite0.onnx"
MAX_INPUT_PX = 8192
TILE_PX = 1024  # larger inputs go through in tiles: memory stays bounded
OVERLAP_PX = 96
PROBE_PX = 256


class NetworkError(BuildlocError):
    """A network cannot be loaded or does not keep the contract."""


class Network:
    """Building probability of an image; docs/segmentation_networks.md is the contract.

    Construction loads the file and runs it once on noise. Raises NetworkError, or ConfigError.
    """

    def __init__(self, config: SegmenterConfig) -> None:
        check_segmenter(config)
        self._config = config
        self._path = Path(
            config.model or str(importlib.resources.files("buildloc_segmenter").joinpath(SHIPPED))
        )
        self._session = _load(self._path, config)
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if len(inputs) != 1 or len(inputs[0].shape) != 4 or inputs[0].type != "tensor(float)":
            raise NetworkError(f"{self._path}: needs exactly one float input of four axes; export it again")
        shape = inputs[0].shape
        channels, other = shape[1::2] if config.layout == "NCHW" else shape[3::-2]
        if channels != 3 and (isinstance(channels, int) or other == 3):
            raise NetworkError(
                f"{self._path}: input {shape} has not three channels in {config.layout}; "
                "correct the parameter layout"
            )
        axes = shape[2:4] if config.layout == "NCHW" else shape[1:3]
        self._input, self._output = inputs[0].name, outputs[0].name
        self._fixed = (int(axes[0]), int(axes[1])) if all(isinstance(a, int) for a in axes) else None
        self._probe()

    def segment(self, image_bgr: ByteArray, gsd_m: float) -> ByteArray:
        """(H, W, 3) uint8 BGR at ``gsd_m`` metres per pixel -> (H, W) uint8 mask, 0 or 255."""
        probability = self.probability(image_bgr, gsd_m)
        mask = (probability >= self._config.threshold).astype(np.uint8) * np.uint8(255)
        return remove_specks(mask, self._config.min_component_m2 / gsd_m**2)

    def probability(self, image_bgr: ByteArray, gsd_m: float) -> FloatImage:
        """(H, W, 3) uint8 BGR -> (H, W) float32 building probability."""
        height, width = image_bgr.shape[:2]
        trained = self._config.network_gsd_m
        zoom = gsd_m / trained if trained > 0.0 else 1.0
        rows, columns = max(1, round(height * zoom)), max(1, round(width * zoom))
        if max(rows, columns) > MAX_INPUT_PX:
            raise NetworkError(
                f"the image would be {columns}x{rows} pixels for the network; "
                "check altitude, intrinsics and network_gsd_m"
            )
        method = cv2.INTER_AREA if rows < height else cv2.INTER_LINEAR
        resized = cv2.resize(image_bgr, (columns, rows), interpolation=method)
        logits = self._logits(np.asarray(resized, dtype=np.uint8))
        upsampled = cv2.resize(logits, (width, height), interpolation=cv2.INTER_LINEAR)
        return np.asarray(1.0 / (1.0 + np.exp(-np.clip(upsampled, -60.0, 60.0))), dtype=np.float32)

    def _probe(self) -> None:
        """Run once on noise: shows a wrong output before the flight, not in it."""
        # An odd multiple: a network that needs a larger multiple does not run on it.
        side = (math.ceil(PROBE_PX / self._config.input_multiple) | 1) * self._config.input_multiple
        size = self._fixed or (side, side)
        noise = np.random.default_rng(0).integers(0, 256, (*size, 3), dtype=np.uint8)
        scores = self._run(noise)
        probable = bool(scores.min() >= 0.0 and scores.max() <= 1.0)
        if probable != (self._config.output == "probability"):
            right = "probability" if probable else "logits"
            raise NetworkError(
                f"{self._path}: output from {scores.min():.3g} to {scores.max():.3g} is not "
                f"{self._config.output}; set the parameter output to {right}"
            )

    def _whole(self, side: int) -> int:
        """The side, rounded up to what the network takes."""
        return math.ceil(side / self._config.input_multiple) * self._config.input_multiple

    def _logits(self, image_bgr: ByteArray) -> FloatImage:
        """Logits of the building class at the image's own size; tiles are averaged where they overlap."""
        rows, columns = image_bgr.shape[:2]
        largest = self._whole(TILE_PX)
        tile = self._fixed or (min(self._whole(rows), largest), min(self._whole(columns), largest))
        height, width = max(rows, tile[0]), max(columns, tile[1])
        border = (0, height - rows, 0, width - columns)
        padded = np.asarray(cv2.copyMakeBorder(image_bgr, *border, cv2.BORDER_REPLICATE), dtype=np.uint8)
        total, count = np.zeros((2, height, width), dtype=np.float32)
        for top in _starts(height, tile[0]):
            for left in _starts(width, tile[1]):
                window = np.s_[top : top + tile[0], left : left + tile[1]]
                total[window] += self._tile_logits(padded[window])
                count[window] += 1.0
        return np.asarray((total / count)[:rows, :columns], dtype=np.float32)

    def _tile_logits(self, tile_bgr: ByteArray) -> FloatImage:
        """Logits of the building class at the tile's size, whatever the output's stride."""
        values = self._run(tile_bgr)
        if self._config.output == "probability":
            values = np.clip(values, 1e-6, 1.0 - 1e-6)
            values = np.log(values / (1.0 - values))
            scores = values[self._config.building_class] if len(values) == 2 else values[0]
        elif len(values) == 2:
            scores = values[self._config.building_class] - values[1 - self._config.building_class]
        else:
            scores = values[0]
        resized = cv2.resize(scores, tile_bgr.shape[1::-1], interpolation=cv2.INTER_LINEAR)
        return np.asarray(resized, dtype=np.float32)

    def _run(self, tile_bgr: ByteArray) -> FloatImage:
        """(C, h, w) output of the network for one tile, C one or two classes."""
        config = self._config
        ordered = tile_bgr[:, :, ::-1] if config.channel_order == "rgb" else tile_bgr
        mean, std = np.array(config.mean, dtype=np.float32), np.array(config.std, dtype=np.float32)
        tensor = (ordered.astype(np.float32) - mean) / std
        if config.layout == "NCHW":
            tensor = tensor.transpose(2, 0, 1)
        try:
            (output,) = self._session.run([self._output], {self._input: np.ascontiguousarray(tensor[None])})
            values = np.asarray(output, dtype=np.float32)
        except Exception as error:  # onnxruntime has no base class for its errors
            height, width = tile_bgr.shape[:2]
            raise NetworkError(
                f"{self._path}: does not run on {width}x{height} pixels ({_line(error)}); "
                "correct the parameters layout and input_multiple"
            ) from error
        planes = self._planes(values)
        if not np.isfinite(planes).all():
            raise NetworkError(f"{self._path}: output is not finite; correct the parameters mean and std")
        return planes

    def _planes(self, output: FloatImage) -> FloatImage:
        """(C, h, w) of an output with or without batch and class axes."""
        values = output[0] if output.ndim == 4 else output
        if values.ndim == 3 and self._config.layout == "NHWC" and values.shape[2] <= 2:
            values = values.transpose(2, 0, 1)
        if values.ndim == 2:
            values = values[None]
        if values.ndim != 3 or values.shape[0] not in (1, 2):
            raise NetworkError(
                f"{self._path}: output {output.shape} has neither one nor two classes; "
                "use a network of building and background"
            )
        return values


def _load(path: Path, config: SegmenterConfig) -> onnxruntime.InferenceSession:
    if not path.is_file():
        raise NetworkError(f"{path}: no such ONNX file; correct the parameter model")
    available = onnxruntime.get_available_providers()
    unknown = [name for name in config.providers if name not in available]
    if unknown:
        raise NetworkError(
            f"parameter providers: {', '.join(unknown)} not in this ONNX Runtime; "
            f"it has {', '.join(available)}"
        )
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = config.threads
    options.log_severity_level = 4  # what goes wrong is raised
    try:
        session = onnxruntime.InferenceSession(str(path), options, list(config.providers))
    except Exception as error:  # onnxruntime has no base class for its errors
        raise NetworkError(
            f"{path}: is not a loadable ONNX network ({_line(error)}); export it again"
        ) from error
    idle = [name for name in config.providers if name not in session.get_providers()]
    if idle:
        raise NetworkError(
            f"parameter providers: {', '.join(idle)} did not start; install what it needs, or leave it out"
        )
    return session


def _line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def _starts(size: int, tile: int) -> list[int]:
    """Where tiles begin so that they cover ``size`` pixels and overlap."""
    overlap = min(OVERLAP_PX, tile // 4)
    count = math.ceil(max(size - overlap, 1) / (tile - overlap)) if size > tile else 1
    return [round(start) for start in np.linspace(0, size - tile, count)]


def remove_specks(mask: ByteArray, min_px: float) -> ByteArray:
    """Remove specks of building and fill holes in it that are smaller than ``min_px`` pixels.

    A hole is enclosed: background that reaches the image's border stays.
    """
    cleaned = mask.copy()
    height, width = mask.shape
    for value in (255, 0):
        plane = (cleaned == value).astype(np.uint8)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(plane, connectivity=8 if value else 4)
        x, y, w, h, area = stats.T
        small = area < min_px
        if value == 0:
            small &= (x > 0) & (y > 0) & (x + w < width) & (y + h < height)
        small[0] = False
        cleaned[small[labels]] = 255 - value
    return cleaned
