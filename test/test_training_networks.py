"""Networks train, resume and export. Needs training/requirements.txt; skips without PyTorch."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest

torch = pytest.importorskip(
    "torch", reason="PyTorch is not installed: pip install -r training/requirements.txt"
)
pytest.importorskip("efficientnet_lite_pytorch", reason="pip install -r training/requirements.txt")
pytest.importorskip("transformers", reason="pip install -r training/requirements.txt")


def batch(seed: int, count: int = 2, side: int = 64) -> tuple[Any, Any, Any]:
    """White squares on dark noise, building and core."""
    rng = np.random.default_rng(seed)
    rgb = rng.uniform(0.0, 90.0, (count, 3, side, side)).astype(np.float32)
    target = np.zeros((count, 2, side, side), dtype=np.float32)
    for k in range(count):
        y, x = rng.integers(4, side // 2, 2)
        rgb[k, :, y : y + 24, x : x + 24] += 150.0
        target[k, 0, y : y + 24, x : x + 24] = 1.0
        target[k, 1, y + 3 : y + 21, x + 3 : x + 21] = 1.0
    return torch.from_numpy(rgb), torch.from_numpy(target), torch.ones((count, 1, side, side))


def trained(name: str, steps: int, bfloat16: bool = False) -> tuple[Any, list[float]]:
    from networks import network
    from train import Training

    torch.manual_seed(0)
    training = Training(network(name), 30, torch.device("cpu"), bfloat16=bfloat16)
    training.net.train()
    return training, [float(training.advance(*batch(step))[0].sum()) for step in range(steps)]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "bfloat16"), [("lite0", False), ("lite0", True), ("segformer-b0", False)])
def test_a_network_learns_squares_and_exports_what_it_learnt(
    name: str, bfloat16: bool, tmp_path: Path
) -> None:
    from export import parity, write_onnx

    training, losses = trained(name, 20, bfloat16)
    assert max(losses[-4:]) < min(losses[:4])
    path = tmp_path / "model.onnx"
    write_onnx(training.average, path, {"places": ["squares"]})
    report = parity(training.average, path, batch(99)[0].numpy())
    assert report["equal_mask_share"] >= 0.999
    assert report["max_difference"] < 1e-2
    carried = {p.key: json.loads(p.value) for p in onnx.load(str(path)).metadata_props}
    assert carried["buildloc"]["channels"] == ["building", "core"]
    assert carried["buildloc_training"] == {"places": ["squares"]}


@pytest.mark.slow
def test_a_run_resumes_where_it_was_and_refuses_other_settings(tmp_path: Path) -> None:
    from networks import network
    from train import Training

    whole, _ = trained("lite0", 4)
    part, _ = trained("lite0", 2)
    checkpoint = tmp_path / "checkpoint.pt"
    part.save(checkpoint, {"seed": 1})
    resumed = Training(network("lite0"), 30, torch.device("cpu"))
    resumed.restore(checkpoint, {"seed": 1})
    resumed.net.train()
    for step in (2, 3):
        resumed.advance(*batch(step))
    theirs = resumed.average.state_dict()
    for name, value in whole.average.state_dict().items():
        assert torch.allclose(value.float(), theirs[name].float(), atol=1e-5), name
    with pytest.raises(SystemExit, match="choose another --out"):
        resumed.restore(checkpoint, {"seed": 2})


@pytest.mark.slow
def test_a_run_goes_on_from_an_exported_network(tmp_path: Path) -> None:
    from export import parity, write_onnx
    from networks import folded, network, take_weights
    from train import started_from

    training, _ = trained("lite0", 3)
    path = tmp_path / "model.onnx"
    write_onnx(training.average, path, {"places": ["squares"], "steps": 3})
    assert started_from(path, ["squares", "circles"]) == {"places": ["squares"], "steps": 3}
    with pytest.raises(SystemExit, match="squares too"):
        started_from(path, ["circles"])
    net = network("lite0")
    take_weights(folded(net), path)
    assert parity(net, path, batch(99)[0].numpy())["max_difference"] < 1e-3
    write_onnx(torch.nn.Conv2d(3, 2, 3), tmp_path / "other.onnx", {"places": []})
    with pytest.raises(SystemExit, match=r"other.onnx: is not an export of this network"):
        take_weights(net, tmp_path / "other.onnx")


@pytest.mark.slow
def test_a_run_is_averaged_with_one_that_it_went_on_from(tmp_path: Path) -> None:
    from export import averaged, load, write_onnx
    from networks import folded, network, take_weights
    from train import Training

    earlier, other = tmp_path / "earlier.onnx", tmp_path / "other.onnx"
    notes = {"places": ["squares"], "steps": 3}
    for path, steps, told in ((earlier, 3, notes), (other, 1, notes | {"steps": 1})):
        write_onnx(trained("lite0", steps)[0].average, path, told)
    net, before = network("lite0"), network("lite0")
    for one in (net, before):
        take_weights(folded(one), earlier)
    later = Training(net, 30, torch.device("cpu"))
    later.net.train()
    later.advance(*batch(0))
    settings = {"network": "lite0", "places": ["squares", "circles"], "start": notes}
    later.save(tmp_path / "checkpoint.pt", settings)
    mean, training = averaged(*load(tmp_path), [earlier])
    assert training["averaged_with_runs_before"] == [1] and training["start"] == notes
    first, second = later.average.state_dict(), before.state_dict()
    for name, value in mean.state_dict().items():
        assert torch.allclose(value, (first[name] + second[name]) / 2.0, atol=1e-7), name
    assert any(not torch.equal(first[name], second[name]) for name in first)
    with pytest.raises(SystemExit, match=r"other.onnx: is none that this run went on from"):
        averaged(*load(tmp_path), [other])


@pytest.mark.slow
def test_int8_says_nearly_the_same(tmp_path: Path) -> None:
    from export import agreement, quantise, write_onnx

    training, _ = trained("lite0", 20)
    full, int8 = tmp_path / "model.onnx", tmp_path / "int8.onnx"
    write_onnx(training.average, full, {})
    rgb = batch(50, count=8)[0].numpy()
    quantise(full, int8, rgb, {})
    outputs = [onnxruntime.InferenceSession(str(p)).run(None, {"rgb": rgb})[0] for p in (full, int8)]
    assert agreement(*outputs)["equal_mask_share"] > 0.97
    assert int8.stat().st_size < 0.4 * full.stat().st_size


@pytest.mark.slow
def test_the_papers_network_is_exported_and_runs(tmp_path: Path) -> None:
    from export import write_onnx
    from networks import network

    path = tmp_path / "b5.onnx"
    write_onnx(network("segformer-b5"), path, {})
    (logits,) = onnxruntime.InferenceSession(str(path)).run(None, {"rgb": batch(0, 1, 128)[0].numpy()})
    assert logits.shape == (1, 2, 32, 32)
    assert np.isfinite(logits).all()


@pytest.mark.slow
@pytest.mark.parametrize("bfloat16", [False, True])
def test_netvlads_branches_learn_and_export_what_they_learnt(bfloat16: bool, tmp_path: Path) -> None:
    from netvlad import RADIUS_M, DualBranch, Ground, Training, draw_pairs, export

    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    side = round(RADIUS_M)  # at 2 m per pixel
    town = np.kron(rng.random((side // 8 + 1,) * 2) < 0.2, np.ones((8, 8)))[:side, :side].astype(np.float32)
    ground = Ground((0.0, 0.0), (town,), (town,))
    pairs = draw_pairs(ground, 12, rng)
    assert pairs.views.shape == (12, 2, 64, 64) and pairs.tiles.shape == (12, 1, 64, 64)
    assert not pairs.views[:, 0][pairs.views[:, 1] == 0.0].any()  # nothing is seen outside the frame
    training = Training(DualBranch(), 120, torch.device("cpu"), bfloat16)
    losses = [math.prod(training.advance(draw_pairs(ground, 16, rng))) for _ in range(18)]  # of all triplets
    assert np.mean(losses[-4:]) < 0.8 * np.mean(losses[:4])
    assert max(export(training.net, tmp_path, pairs).values()) < 1e-4
    sessions = [
        onnxruntime.InferenceSession(str(tmp_path / f"{name}.onnx")) for name in ("drone", "reference")
    ]
    given = (pairs.views, pairs.tiles)
    views, tiles = (s.run(None, {"tiles": g})[0] for s, g in zip(sessions, given, strict=True))
    assert views.shape == tiles.shape == (12, 4096)
    np.testing.assert_allclose(np.linalg.norm(views, axis=1), 1.0, atol=1e-5)
    training.save(tmp_path / "checkpoint.pt", {"seed": 1})
    resumed = Training(DualBranch(), 120, torch.device("cpu"), bfloat16)
    resumed.restore(tmp_path / "checkpoint.pt", {"seed": 1})
    np.testing.assert_allclose(resumed.advance(pairs), training.advance(pairs), atol=1e-5)


def test_netvlad_starts_from_a_file_of_resnet_weights(tmp_path: Path) -> None:
    from netvlad import ResNet18

    state = ResNet18(3).state_dict() | {"fc.weight": torch.zeros(1000, 512), "fc.bias": torch.zeros(1000)}
    torch.save(state, tmp_path / "resnet18.pth")
    net = ResNet18(2)
    net.load_pretrained(tmp_path / "resnet18.pth")
    colours = state["conv1.weight"].mean(dim=1)
    assert all(torch.equal(net.conv1.weight[:, plane], colours) for plane in (0, 1))
    assert torch.equal(net.layer4[1].conv2.weight, state["layer4.1.conv2.weight"])


def test_an_unknown_network_is_refused() -> None:
    from networks import network

    with pytest.raises(SystemExit, match="choose lite0 or segformer"):
        network("resnet")
