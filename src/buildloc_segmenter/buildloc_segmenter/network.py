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


class NetworkError(BuildlocError):
    """A network cannot be loaded or does not keep the contract."""


class Network:
    """Building probability of an image; docs/segmentation_networks.md is the contract."""

    def __init__(self, config: SegmenterConfig) -> None:
        check_segmenter(config)
        self._config = config
        path = Path(config.model or str(importlib.resources.files("buildloc_segmenter").joinpath(SHIPPED)))
        if not path.is_file():
            raise NetworkError(f"{path}: no such ONNX file; correct the parameter model")
        available = onnxruntime.get_available_providers()
        unknown = [name for name in config.providers if name not in available]
        if unknown:
            raise NetworkError(
                f"parameter providers: {', '.join(unknown)} not in this ONNX Runtime; it has {', '.join(available)}"
            )
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = config.threads
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, list(config.providers))
        except Exception as error:  # onnxruntime has no base class for its load errors
            line = str(error).strip().splitlines()[0]
            raise NetworkError(f"{path}: is not a loadable ONNX network ({line}); export it again") from error
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if len(inputs) != 1 or len(inputs[0].shape) != 4 or inputs[0].type != "tensor(float)":
            raise NetworkError(f"{path}: needs exactly one float input of four axes; export it again")
        channels, other = inputs[0].shape[1::2] if config.layout == "NCHW" else inputs[0].shape[3::-2]
        if channels != 3 and (isinstance(channels, int) or other == 3):
            raise NetworkError(
                f"{path}: input {inputs[0].shape} has not three channels in {config.layout}; "
                "correct the parameter layout"
            )
        self._path, self._input, self._output = path, inputs[0].name, outputs[0].name
        axes = inputs[0].shape[2:4] if config.layout == "NCHW" else inputs[0].shape[1:3]
        self._fixed = (int(axes[0]), int(axes[1])) if all(isinstance(a, int) for a in axes) else None

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
        if self._fixed is not None:
            rows, columns = min(rows, self._fixed[0]), min(columns, self._fixed[1])
        if max(rows, columns) > MAX_INPUT_PX:
            raise NetworkError(
                f"the image would be {columns}x{rows} pixels for the network; "
                "check altitude, intrinsics and network_gsd_m"
            )
        method = cv2.INTER_AREA if rows < height else cv2.INTER_LINEAR
        resized = cv2.resize(image_bgr, (columns, rows), interpolation=method)
        logits = self._infer(np.asarray(resized, dtype=np.uint8))
        upsampled = cv2.resize(logits, (width, height), interpolation=cv2.INTER_LINEAR)
        return np.asarray(1.0 / (1.0 + np.exp(-np.clip(upsampled, -60.0, 60.0))), dtype=np.float32)

    def _infer(self, image_bgr: ByteArray) -> FloatImage:
        """Logits of the building class at the resized image's size, whatever the output's stride."""
        config = self._config
        rows, columns = image_bgr.shape[:2]
        multiple = config.input_multiple
        full = self._fixed or (math.ceil(rows / multiple) * multiple, math.ceil(columns / multiple) * multiple)
        border = (0, full[0] - rows, 0, full[1] - columns)
        padded = cv2.copyMakeBorder(image_bgr, *border, cv2.BORDER_REPLICATE)
        ordered = padded[:, :, ::-1] if config.channel_order == "rgb" else padded
        mean, std = np.float32(config.mean), np.float32(config.std)
        tensor = (ordered.astype(np.float32) - mean) / std
        if config.layout == "NCHW":
            tensor = tensor.transpose(2, 0, 1)
        feed = {self._input: np.ascontiguousarray(tensor[None])}
        scores = self._building_scores(np.asarray(self._session.run([self._output], feed)[0]))
        if config.output == "probability":
            clipped = np.clip(scores, 1e-6, 1.0 - 1e-6)
            scores = np.log(clipped / (1.0 - clipped))
        scores = cv2.resize(scores, (full[1], full[0]), interpolation=cv2.INTER_LINEAR)
        return np.asarray(scores[:rows, :columns], dtype=np.float32)

    def _building_scores(self, output: NDArray[np.generic]) -> FloatImage:
        """(h, w) of an output with or without batch and class axes; two classes become one logit."""
        values = output.astype(np.float32)
        if values.ndim == 4:
            values = values[0]
        if values.ndim == 3 and self._config.layout == "NHWC" and values.shape[2] <= 2:
            values = values.transpose(2, 0, 1)
        if values.ndim == 2:
            return values
        if values.ndim != 3 or values.shape[0] not in (1, 2):
            raise NetworkError(f"{self._path}: output {output.shape} has neither one nor two classes")
        if values.shape[0] == 1:
            return values[0]
        building = self._config.building_class
        if self._config.output == "probability":
            return values[building]
        return np.asarray(values[building] - values[1 - building], dtype=np.float32)


def remove_specks(mask: ByteArray, min_px: float) -> ByteArray:
    """Flip components of building and of background that are smaller than ``min_px`` pixels."""
    cleaned = mask.copy()
    for value in (255, 0):
        plane = (cleaned == value).astype(np.uint8)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(plane, connectivity=8 if value else 4)
        small = np.zeros(count, dtype=bool)
        small[1:] = stats[1:, cv2.CC_STAT_AREA] < min_px
        cleaned[small[labels]] = 255 - value
    return cleaned
