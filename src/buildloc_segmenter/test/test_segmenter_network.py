"""The contract with ONNX networks, on graphs of a few nodes, and the network that is shipped."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from buildloc_msgs_py.config import ConfigError
from buildloc_segmenter.config import SegmenterConfig
from buildloc_segmenter.network import Network, NetworkError
from onnx import TensorProto, helper, numpy_helper

PLAIN = SegmenterConfig(network_gsd_m=0.0, input_multiple=8, min_component_m2=0.0)
DATA = Path(os.environ.get("BUILDLOC_DATA", Path(__file__).parents[4] / "shared" / "data"))


def save_graph(
    path: Path,
    weights: np.ndarray,
    bias: list[float],
    stride: int = 1,
    tail: str | None = None,
    nhwc: bool = False,
    size: int | None = None,
) -> str:
    """A network that weighs the three channels per class, at a stride, with Sigmoid or Softmax behind."""
    kernel = np.zeros((len(bias), 3, stride, stride), dtype=np.float32)
    kernel[:] = weights.reshape(len(bias), 3, 1, 1) / stride**2
    initializers = [
        numpy_helper.from_array(kernel, "kernel"),
        numpy_helper.from_array(np.float32(bias), "bias"),
    ]
    nodes, last = [], "image"
    if nhwc:
        nodes.append(helper.make_node("Transpose", ["image"], ["planes"], perm=[0, 3, 1, 2]))
        last = "planes"
    nodes.append(helper.make_node("Conv", [last, "kernel", "bias"], ["scores"], strides=[stride, stride]))
    last = "scores"
    if tail is not None:
        nodes.append(helper.make_node(tail, [last], ["tail"], **({"axis": 1} if tail == "Softmax" else {})))
        last = "tail"
    if nhwc:
        nodes.append(helper.make_node("Transpose", [last], ["back"], perm=[0, 2, 3, 1]))
        last = "back"
    sides = ["h", "w"] if size is None else [size, size]
    shape = ["n", *sides, 3] if nhwc else ["n", 3, *sides]
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info(last, TensorProto.FLOAT, None)],
        initializers,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, str(path))
    return str(path)


def scene() -> tuple[np.ndarray, np.ndarray]:
    """A red building on green ground, BGR, sides that are no multiples of anything, and its mask."""
    image = np.full((50, 70, 3), (40, 160, 40), dtype=np.uint8)
    image[16:32, 24:48] = (40, 40, 200)
    mask = np.zeros((50, 70), dtype=bool)
    mask[16:32, 24:48] = True
    return image, mask


RED_MINUS_GREEN = np.array([0.1, -0.1, 0.0])


def iou(found: np.ndarray, true: np.ndarray) -> float:
    return float(((found > 0) & true).sum() / ((found > 0) | true).sum())


@pytest.mark.parametrize("stride", [1, 2, 4])
def test_one_class_of_logits_at_any_stride(tmp_path: Path, stride: int) -> None:
    model = save_graph(tmp_path / "net.onnx", RED_MINUS_GREEN, [0.0], stride)
    image, true = scene()
    mask = Network(replace(PLAIN, model=model)).segment(image, 0.2)
    assert mask.shape == (50, 70) and mask.dtype == np.uint8 and set(np.unique(mask)) == {0, 255}
    assert iou(mask, true) > (0.99 if stride == 1 else 0.85)


@pytest.mark.parametrize("channels", [("building", "background"), ("background", "building"), ()])
def test_two_classes_of_logits(tmp_path: Path, channels: tuple[str, ...]) -> None:
    weights = np.array([RED_MINUS_GREEN, -RED_MINUS_GREEN])
    ordered = weights if channels[:1] == ("building",) else weights[::-1]
    model = save_graph(tmp_path / "net.onnx", ordered, [0.0, 0.0], 4)
    image, true = scene()
    config = replace(PLAIN, model=model, channels=channels)
    assert iou(Network(config).segment(image, 0.2), true) > 0.85


def test_two_classes_of_probability(tmp_path: Path) -> None:
    weights = np.array([-RED_MINUS_GREEN, RED_MINUS_GREEN])
    model = save_graph(tmp_path / "net.onnx", weights, [0.0, 0.0], 1, tail="Softmax")
    image, true = scene()
    assert iou(Network(replace(PLAIN, model=model, output="probability")).segment(image, 0.2), true) > 0.99


def test_one_class_of_probability_and_the_threshold(tmp_path: Path) -> None:
    model = save_graph(tmp_path / "net.onnx", np.zeros(3), [0.0], 1, tail="Sigmoid")
    config = replace(PLAIN, model=model, output="probability", min_score=0.0)
    image, _ = scene()
    assert Network(replace(config, threshold=0.45)).segment(image, 0.2).min() == 255
    assert Network(replace(config, threshold=0.55)).segment(image, 0.2).max() == 0


def test_a_label_map_is_a_probability(tmp_path: Path) -> None:
    model = onnx.load(save_graph(tmp_path / "net.onnx", RED_MINUS_GREEN, [0.0]))
    del model.graph.output[:]
    model.graph.initializer.append(numpy_helper.from_array(np.array([1]), "class_axis"))
    model.graph.node.extend(
        [
            helper.make_node("Relu", ["scores"], ["positive"]),
            helper.make_node("Sign", ["positive"], ["sign"]),
            helper.make_node("Cast", ["sign"], ["whole"], to=TensorProto.INT64),
            helper.make_node("Squeeze", ["whole", "class_axis"], ["labels"]),
        ]
    )
    model.graph.output.append(helper.make_tensor_value_info("labels", TensorProto.INT64, None))
    onnx.save(model, str(tmp_path / "labels.onnx"))
    config = replace(PLAIN, model=str(tmp_path / "labels.onnx"), output="probability")
    image, true = scene()
    assert iou(Network(config).segment(image, 0.2), true) > 0.99


def test_channels_last_input_and_output(tmp_path: Path) -> None:
    model = save_graph(tmp_path / "net.onnx", RED_MINUS_GREEN, [0.0], 2, nhwc=True)
    image, true = scene()
    assert iou(Network(replace(PLAIN, model=model, layout="NHWC")).segment(image, 0.2), true) > 0.9
    with pytest.raises(NetworkError, match="correct the parameters layout"):
        Network(replace(PLAIN, model=model, layout="NCHW"))


def test_channel_order_and_normalisation_reach_the_network(tmp_path: Path) -> None:
    image, true = scene()
    swapped = save_graph(tmp_path / "bgr.onnx", np.array([0.0, -0.1, 0.1]), [-1.0])
    assert iou(Network(replace(PLAIN, model=swapped, channel_order="bgr")).segment(image, 0.2), true) > 0.99
    assert Network(replace(PLAIN, model=swapped, channel_order="rgb")).segment(image, 0.2).max() == 0
    # (200 - 100) / 50 = 2 on the building's red and (40 - 100) / 50 = -1.2 elsewhere.
    red = save_graph(tmp_path / "red.onnx", np.array([1.0, 0.0, 0.0]), [0.0])
    config = replace(PLAIN, model=red, mean=(100.0, 0.0, 0.0), std=(50.0, 1.0, 1.0))
    probability = Network(config).probability(image, 0.2)
    assert probability[20, 30] == pytest.approx(1 / (1 + np.exp(-2.0)), abs=1e-4)
    assert probability[2, 2] == pytest.approx(1 / (1 + np.exp(1.2)), abs=1e-4)


def test_images_are_resampled_to_the_gsd_of_the_training(tmp_path: Path) -> None:
    # A strided network sees 4 px as one: at half the training's GSD that is 8 px of the image.
    model = save_graph(tmp_path / "net.onnx", RED_MINUS_GREEN, [0.0], 4)
    image, true = scene()
    config = replace(PLAIN, model=model, network_gsd_m=0.2)
    for gsd_m in (0.05, 0.1, 0.2, 0.4):
        mask = Network(config).segment(image, gsd_m)
        assert mask.shape == true.shape
        assert iou(mask, true) > (0.85 if gsd_m >= 0.2 else 0.4)


def test_an_absurd_altitude_is_doubted_and_costs_no_more_than_a_few_frames(tmp_path: Path) -> None:
    model = save_graph(tmp_path / "net.onnx", RED_MINUS_GREEN, [0.0])
    network = Network(replace(PLAIN, model=model, network_gsd_m=0.2))
    assert network.doubt(0.1) is None and network.doubt(0.5) is None
    doubt = network.doubt(100.0)
    assert doubt is not None and "100 m per pixel, outside of the 0.1 to 0.5 m" in doubt
    image, _ = scene()
    assert network.segment(image, 100.0).shape == (50, 70)
    assert network.scores(image, 100.0).building.shape == (200, 280)
    assert network.segment(image, 0.001).shape == (50, 70)


def test_probability_is_not_taken_for_logits_nor_the_reverse(tmp_path: Path) -> None:
    sigmoid = save_graph(tmp_path / "sigmoid.onnx", RED_MINUS_GREEN, [0.0], tail="Sigmoid")
    with pytest.raises(NetworkError, match="set the parameter output to probability"):
        Network(replace(PLAIN, model=sigmoid))
    with pytest.raises(NetworkError, match="set the parameter output to logits"):
        Network(
            replace(
                PLAIN,
                model=save_graph(tmp_path / "logits.onnx", RED_MINUS_GREEN, [0.0]),
                output="probability",
            )
        )


def test_what_fails_in_the_network_is_one_line(tmp_path: Path) -> None:
    # The shipped network, without its contract, still needs multiples of 32.
    stripped = onnx.load(str(Network(SegmenterConfig()).path))
    del stripped.metadata_props[:]
    onnx.save(stripped, str(tmp_path / "stripped.onnx"))
    config = SegmenterConfig(
        model=str(tmp_path / "stripped.onnx"), channels=("building", "core"), input_multiple=16
    )
    with pytest.raises(NetworkError, match="does not run on 272x272 pixels") as caught:
        Network(config)
    assert "\n" not in str(caught.value)
    model = save_graph(tmp_path / "nan.onnx", np.full(3, np.nan), [0.0])
    with pytest.raises(NetworkError, match="not finite"):
        Network(replace(PLAIN, model=model))


@pytest.mark.parametrize("side", [32, 64])
def test_a_network_of_fixed_size_goes_over_the_image_in_tiles(tmp_path: Path, side: int) -> None:
    free = save_graph(tmp_path / "free.onnx", RED_MINUS_GREEN, [0.0])
    fixed = save_graph(tmp_path / "fixed.onnx", RED_MINUS_GREEN, [0.0], size=side)
    image, true = scene()  # 50 rows, 70 columns: smaller and larger than a tile
    mask = Network(replace(PLAIN, model=fixed)).segment(image, 0.2)
    assert iou(mask, true) > 0.99
    assert (mask == Network(replace(PLAIN, model=free)).segment(image, 0.2)).all()


def test_a_large_image_goes_in_tiles_and_none_is_left_out(tmp_path: Path) -> None:
    model = save_graph(tmp_path / "net.onnx", RED_MINUS_GREEN, [0.0])
    image = np.full((700, 1900, 3), (40, 160, 40), dtype=np.uint8)
    true = np.zeros((700, 1900), dtype=bool)
    for corner in ((0, 0), (680, 1880), (340, 940), (340, 1010), (0, 1880)):
        at = np.s_[corner[0] : corner[0] + 20, corner[1] : corner[1] + 20]
        image[at], true[at] = (40, 40, 200), True
    assert ((Network(replace(PLAIN, model=model)).segment(image, 0.2) > 0) == true).all()


def test_a_missing_a_damaged_and_a_foreign_file(tmp_path: Path) -> None:
    with pytest.raises(NetworkError, match="no such ONNX file"):
        Network(replace(PLAIN, model=str(tmp_path / "absent.onnx")))
    (tmp_path / "garbage.onnx").write_bytes(b"not a network")
    with pytest.raises(NetworkError, match=r"garbage\.onnx: is not a loadable ONNX network") as caught:
        Network(replace(PLAIN, model=str(tmp_path / "garbage.onnx")))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"providers": ("NoSuchProvider",)}, "NoSuchProvider is no provider of ONNX Runtime; it knows"),
        ({"channels": ("building", "roof")}, "channels = .* is not each of background, building, core"),
        ({"channels": ("building", "building")}, "channels = .* is not each of"),
        ({"channels": ("background",)}, "channels = .* has no building"),
        ({"network_gsd_range_m": (0.5, 0.1)}, "network_gsd_range_m = .* is not two lengths"),
        ({"layout": "CHWN"}, "parameter layout = CHWN is not one of NCHW, NHWC"),
        ({"std": (1.0, 0.0, 1.0)}, "std = .* is not positive"),
        ({"mean": (1.0,)}, "mean = .* is not three numbers"),
        ({"mean": ("a", "b", "c")}, "mean = .* is not three numbers"),
        ({"std": (1.0, float("nan"), 1.0)}, "std = .* is not three numbers"),
        ({"providers": ()}, "providers is empty"),
        ({"threshold": 1.5}, "threshold = 1.5 is out of range"),
    ],
)
def test_a_wrong_parameter_is_named(change: dict[str, object], message: str) -> None:
    with pytest.raises((NetworkError, ConfigError), match=message):
        Network(replace(SegmenterConfig(), **change))  # type: ignore[arg-type]


def test_the_shipped_network_runs_and_calls_a_meadow_no_building() -> None:
    rng = np.random.default_rng(0)
    meadow = np.clip(rng.normal((60, 110, 80), 12, (200, 300, 3)), 0, 255).astype(np.uint8)
    mask = Network(SegmenterConfig()).segment(cv2.GaussianBlur(meadow, (0, 0), 2), 0.15)
    assert mask.shape == (200, 300) and (mask > 0).mean() < 0.1


@pytest.mark.data
def test_the_shipped_network_on_real_ground_it_never_saw() -> None:
    folder = DATA / "imagery" / "barnarp"
    if not folder.is_dir():
        pytest.skip(f"no real imagery: {folder} is absent (set BUILDLOC_DATA)")
    # 250 x 160 m in the middle of the orthophoto; the model card has 0.59 for all of it.
    window = np.s_[2000:3000, 5000:6600]
    image = cv2.imread(str(folder / "ortho.jpg"), cv2.IMREAD_COLOR)[window]
    true = cv2.imread(str(folder / "labels.png"), cv2.IMREAD_GRAYSCALE)[window] > 127
    assert iou(Network(SegmenterConfig()).segment(image, 0.16), true) > 0.45


@pytest.mark.data
def test_a_network_that_ends_in_a_sigmoid_on_real_ground() -> None:
    model = DATA / "models" / "baseline_west.onnx"
    if not model.is_file():
        pytest.skip(f"no such network: {model} is absent (set BUILDLOC_DATA)")
    folder = DATA / "imagery" / "barnarp"
    window = np.s_[2000:3000, 5000:6600]  # in the east half, which it never saw
    image = cv2.imread(str(folder / "ortho.jpg"), cv2.IMREAD_COLOR)[window]
    true = cv2.imread(str(folder / "labels.png"), cv2.IMREAD_GRAYSCALE)[window] > 127
    mask = Network(SegmenterConfig(model=str(model), output="probability")).segment(image, 0.16)
    assert iou(mask, true) > 0.7
