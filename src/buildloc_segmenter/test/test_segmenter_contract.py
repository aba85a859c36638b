"""A network is used by the contract it carries; what is no segmentation network says what it is."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from buildloc_msgs_py.config import ConfigError
from buildloc_segmenter.config import SegmenterConfig
from buildloc_segmenter.contract import METADATA_KEY, Contract, contract_from_json, contract_of
from buildloc_segmenter.network import CPU, Network, NetworkError
from onnx import TensorProto, helper, numpy_helper

CONTRACT = Contract(
    gsd_m=0.2,
    gsd_range_m=(0.1, 0.5),
    layout="NCHW",
    channel_order="rgb",
    mean=(0.0, 0.0, 0.0),
    std=(255.0, 255.0, 255.0),
    input_multiple=8,
    output="logits",
    channels=("building", "core"),
)
RED_MINUS_GREEN = np.array([25.0, -25.0, 0.0])  # of values from 0 to 1
# Parameters that would spoil everything if the file's contract did not come first.
OTHERWISE = SegmenterConfig(
    channel_order="bgr", mean=(9.0, 9.0, 9.0), output="probability", network_gsd_m=3.0
)


def save(path: Path, weights: np.ndarray, contract: str | None, bias: float = 0.0) -> str:
    """A network that weighs red, green and blue per channel, (C, 3), and carries a contract."""
    kernel = numpy_helper.from_array(weights.reshape(-1, 3, 1, 1).astype(np.float32), "kernel")
    offset = numpy_helper.from_array(np.full(len(weights), bias, dtype=np.float32), "bias")
    graph = helper.make_graph(
        [helper.make_node("Conv", ["image", "kernel", "bias"], ["scores"])],
        "tiny",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, ["n", 3, "h", "w"])],
        [helper.make_tensor_value_info("scores", TensorProto.FLOAT, None)],
        [kernel, offset],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    if contract is not None:
        helper.set_model_props(model, {METADATA_KEY: contract})
    onnx.save(model, str(path))
    return str(path)


def two_roofs() -> tuple[np.ndarray, np.ndarray]:
    """Two touching roofs, BGR: red on green, blue only on what lies well inside either; and their mask."""
    image = np.full((60, 100, 3), (0, 160, 40), dtype=np.uint8)
    for left in (16, 48):
        image[14:46, left : left + 32] = (0, 40, 200)
        image[17:43, left + 3 : left + 29, 0] = 255
    mask = np.zeros((60, 100), dtype=bool)
    mask[14:46, 16:80] = True
    return image, mask


def test_a_contract_survives_the_file_and_comes_before_the_parameters(tmp_path: Path) -> None:
    assert contract_from_json(CONTRACT.to_json()) == CONTRACT
    blue = np.array([-10.0, -10.0, 25.0])
    model = save(tmp_path / "net.onnx", np.array([RED_MINUS_GREEN, blue]), CONTRACT.to_json())
    network = Network(replace(OTHERWISE, model=model))
    assert network.contract == CONTRACT
    image, true = two_roofs()
    instances = network.instances(image, 0.2)
    assert len(instances) == 2 and ((instances.labels > 0) == true).all()
    assert (np.unique(instances.labels[17:43, 20:45]), np.unique(instances.labels[17:43, 52:77])) == (1, 2)
    mask = network.segment(image, 0.2)
    assert mask[30, 30] == mask[30, 66] == 255 and (mask[:, 47:49] == 0).all()


def test_a_file_without_a_contract_is_used_by_the_parameters(tmp_path: Path) -> None:
    model = save(tmp_path / "net.onnx", np.array([RED_MINUS_GREEN]) / 255.0, None)
    network = Network(SegmenterConfig(model=model, input_multiple=8))
    assert network.contract == contract_of(SegmenterConfig(model=model, input_multiple=8))
    image, true = two_roofs()
    assert ((network.segment(image, 0.2) > 0) == true).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"channels": ["building", "roof"]}, "channels = .* is not each of background, building, core"),
        ({"channels": []}, "names no channels"),
        ({"std": [1, 0, 1]}, "std = .* is not positive"),
        ({"mean": [0.0]}, "mean = .* is not three numbers"),
        ({"gsd_m": "0.2"}, "network_gsd_m = '0.2' is not a float"),
        ({"gsd_range_m": [0.5, 0.1]}, "network_gsd_range_m = .* is not two lengths"),
        ({"layout": "CHWN"}, "layout = CHWN is not one of NCHW, NHWC"),
        ({"input_multiple": 0}, "input_multiple = 0 is out of range"),
        ({"stride": 4}, "contract holds .*stride.*; expected channel_order, channels"),
    ],
)
def test_a_contract_that_cannot_be_is_one_line(
    tmp_path: Path, change: dict[str, object], message: str
) -> None:
    text = json.dumps({**json.loads(CONTRACT.to_json()), **change})
    with pytest.raises(ConfigError, match=message):
        contract_from_json(text)
    model = save(tmp_path / "net.onnx", np.zeros((2, 3)), text)
    with pytest.raises(NetworkError, match=r"net\.onnx: .*export it again") as caught:
        Network(SegmenterConfig(model=model))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["not JSON", "[1, 2]", '{"gsd_m": 0.2}'])
def test_metadata_that_is_no_contract(text: str) -> None:
    with pytest.raises(ConfigError, match="contract"):
        contract_from_json(text)


def test_a_contract_that_the_file_does_not_keep(tmp_path: Path) -> None:
    model = save(tmp_path / "net.onnx", np.zeros((1, 3)), CONTRACT.to_json())
    with pytest.raises(
        NetworkError, match=r"channels building, core .* an output of 1 channel; export it again"
    ):
        Network(SegmenterConfig(model=model))


def identity(
    path: Path, inputs: list[tuple[int, list[object]]], op: str = "Relu", **attributes: object
) -> str:
    """A file of one operation on its first input."""
    values = [helper.make_tensor_value_info(f"in{i}", kind, shape) for i, (kind, shape) in enumerate(inputs)]
    output = helper.make_tensor_value_info("out", inputs[0][0], None)
    graph = helper.make_graph(
        [helper.make_node(op, ["in0"], ["out"], **attributes)], "other", values, [output]
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), str(path))
    return str(path)


FLOAT = TensorProto.FLOAT


@pytest.mark.parametrize(
    ("inputs", "op", "attributes", "found"),
    [
        ([(FLOAT, ["n", 4])], "Relu", {}, r"input in0 tensor\(float\) \['n', 4\]"),
        ([(FLOAT, [1, 3, 64, 64]), (FLOAT, [1])], "Relu", {}, r"in0 .*, in1 tensor\(float\) \[1\]"),
        ([(TensorProto.FLOAT16, [1, 3, 64, 64])], "Relu", {}, r"in0 tensor\(float16\)"),
        ([(FLOAT, [1, 3, 64, 64])], "Relu", {}, "an output of 3 channels"),  # image to image
        ([(FLOAT, [1, 3, 64, 64])], "Flatten", {}, r"an output \[1, 12288\] for 64x64 pixels"),  # features
        ([(FLOAT, [1, 3, 64, 64])], "ReduceMean", {"axes": [1, 2, 3]}, r"an output \[1, 1, 1, 1\] for 64x64"),
    ],
)
def test_a_file_that_is_no_segmentation_network_says_what_it_is(
    tmp_path: Path, inputs: list[tuple[int, list[object]]], op: str, attributes: dict[str, object], found: str
) -> None:
    model = identity(tmp_path / "other.onnx", inputs, op, **attributes)
    expected = r"expected input tensor\(float\) \[n, 3, h, w\] and output of the channels .*; found .*"
    with pytest.raises(
        NetworkError, match=rf"other\.onnx: is not a segmentation .*{expected}{found}"
    ) as caught:
        Network(SegmenterConfig(model=model))
    assert "\n" not in str(caught.value)


def test_a_provider_that_is_absent_gives_way_to_the_cpu_and_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["AzureExecutionProvider", CPU])
    model = save(
        tmp_path / "net.onnx",
        np.array([RED_MINUS_GREEN]),
        replace(CONTRACT, channels=("building",)).to_json(),
    )
    with caplog.at_level(logging.WARNING):
        network = Network(
            SegmenterConfig(model=model, providers=("TensorrtExecutionProvider", "CUDAExecutionProvider"))
        )
    assert network.provider == CPU
    (record,) = caplog.records
    assert record.getMessage() == (
        "TensorrtExecutionProvider does not run here (this ONNX Runtime has AzureExecutionProvider, "
        "CPUExecutionProvider); the network runs on CPUExecutionProvider"
    )


def test_the_next_provider_is_tried_when_one_does_not_start(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = []
    real = onnxruntime.InferenceSession

    class Session:
        """Has CUDA installed, and no card for it."""

        def __new__(cls, path: str, options: object, providers: list[str], **rest: object) -> object:
            tried.append(providers)
            if providers != [CPU]:
                raise RuntimeError("no CUDA-capable device is detected")
            return real(path, options, providers, **rest)

    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CUDAExecutionProvider", CPU])
    monkeypatch.setattr(onnxruntime, "InferenceSession", Session)
    model = save(
        tmp_path / "net.onnx",
        np.array([RED_MINUS_GREEN]),
        replace(CONTRACT, channels=("building",)).to_json(),
    )
    with caplog.at_level(logging.WARNING):
        network = Network(SegmenterConfig(model=model, providers=("CUDAExecutionProvider",)))
    assert tried == [["CUDAExecutionProvider", CPU], [CPU]] and network.provider == CPU
    assert "CUDAExecutionProvider does not run here" in caplog.text


def test_the_cpu_is_nothing_to_warn_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    model = save(
        tmp_path / "net.onnx",
        np.array([RED_MINUS_GREEN]),
        replace(CONTRACT, channels=("building",)).to_json(),
    )
    with caplog.at_level(logging.WARNING):
        assert Network(SegmenterConfig(model=model)).provider == CPU
    assert not caplog.records
