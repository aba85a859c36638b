"""An ONNX matching network behind one call. The only module of this package with onnxruntime."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime
from buildloc_msgs_py.errors import BuildlocError
from numpy.typing import NDArray

Tensor = NDArray[np.float32]


class NetworkError(BuildlocError):
    """A matching network cannot be loaded or does not keep its contract."""


class Network:
    """A network with float inputs and outputs of known numbers. Raises NetworkError when it is another."""

    def __init__(self, method: str, path: str, inputs: int, outputs: int) -> None:
        if not path:
            raise NetworkError(f"registration {method} needs weights; name its ONNX file: registration_model")
        if not Path(path).is_file():
            raise NetworkError(f"{path}: no such ONNX file; correct the parameter registration_model")
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 4  # what goes wrong is raised
        try:
            self._session = onnxruntime.InferenceSession(path, options, ["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime has no base class for its errors
            raise NetworkError(f"{path}: is not a loadable ONNX network; export it again") from error
        self._path = path
        self._inputs = [tensor.name for tensor in self._session.get_inputs()]
        found = (len(self._inputs), len(self._session.get_outputs()))
        if found[0] != inputs or found[1] < outputs:
            raise NetworkError(
                f"{path}: has {found[0]} inputs and {found[1]} outputs, {method} {inputs} and {outputs}; "
                "give the network that belongs to the parameter registration"
            )
        shape = self._session.get_inputs()[0].shape
        self.sides = tuple(side if isinstance(side, int) else None for side in shape[-2:])

    def __call__(self, *tensors: Tensor) -> list[Tensor]:
        """The outputs for these inputs, in the order of the file."""
        try:
            values = self._session.run(None, dict(zip(self._inputs, tensors, strict=True)))
        except Exception as error:  # onnxruntime has no base class for its errors
            shapes = ", ".join(str(tensor.shape) for tensor in tensors)
            raise NetworkError(
                f"{self._path}: does not run on inputs {shapes}; see docs/mapping.md for what is expected"
            ) from error
        return [np.asarray(value, dtype=np.float32) for value in values]
