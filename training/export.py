"""Export a trained network to ONNX, check it against PyTorch, and quantise it.

python training/export.py out/training/held_barnarp

Writes model.onnx, model_int8.onnx and export.json beside the checkpoint. Both files carry their contract
(metadata `buildloc`) and how they were trained (`buildloc_training`).
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import onnx
import onnxruntime
import torch
from buildloc_eval.places import place
from buildloc_eval.trained_on import TRAINING_KEY, runs
from crops import TRAIN_GSD_M, CropConfig, CropSampler
from networks import CHANNELS, BuildingNet, SegFormer, folded, network, take_weights
from numpy.typing import NDArray
from onnxruntime.quantization import (
    CalibrationDataReader,
    CalibrationMethod,
    QuantFormat,
    QuantType,
    quantize_static,
)
from onnxruntime.quantization.shape_inference import quant_pre_process
from torch import nn
from train import REPOSITORY, notes_of

Batch = NDArray[np.float32]
CONTRACT = {
    "gsd_m": TRAIN_GSD_M, "gsd_range_m": [0.1, 0.5], "layout": "NCHW", "channel_order": "rgb",
    "mean": [0.0, 0.0, 0.0], "std": [1.0, 1.0, 1.0], "input_multiple": 32, "output": "logits",
    "channels": list(CHANNELS),
}  # fmt: skip
PARITY_CROPS, CALIBRATION_CROPS = 16, 64
OPSET = 17
AVERAGE_HELP = "exported float32 networks that it went on from: take the mean weights with theirs"


def write_onnx(net: nn.Module, path: Path, training: dict[str, object]) -> None:
    """One self-contained file with free batch size, height and width."""
    net = net.eval().to("cpu", memory_format=torch.contiguous_format)
    free = {0: "n", 2: "h", 3: "w"}
    torch.onnx.export(
        net, (torch.zeros(1, 3, 256, 256),), str(path), input_names=["rgb"], output_names=["logits"],
        dynamic_axes={"rgb": free, "logits": {0: "n", 2: "rows", 3: "columns"}}, opset_version=OPSET,
        dynamo=False,
    )  # fmt: skip
    describe(path, training)


def describe(path: Path, training: dict[str, object]) -> None:
    """Put the contract and the training into the file."""
    model = onnx.load(str(path))
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, {"buildloc": json.dumps(CONTRACT), TRAINING_KEY: json.dumps(training)})
    onnx.save(model, str(path))


def _session(path: Path) -> onnxruntime.InferenceSession:
    return onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])


def parity(net: nn.Module, path: Path, rgb: Batch) -> dict[str, float]:
    """Largest difference of logits, and share of equal mask pixels, PyTorch against ONNX Runtime."""
    with torch.no_grad():
        ours = net(torch.from_numpy(rgb)).numpy()
    return agreement(ours, _session(path).run(None, {"rgb": rgb})[0])


def agreement(ours: Batch, theirs: Batch) -> dict[str, float]:
    """The same of two outputs (n, 2, h, w)."""
    same = (ours[:, 0] > 0.0) == (theirs[:, 0] > 0.0)
    return {"max_difference": float(np.abs(ours - theirs).max()), "equal_mask_share": float(same.mean())}


class _Crops(CalibrationDataReader):  # type: ignore[misc]  # onnxruntime has no types
    """Feeds training crops to the calibration, one by one."""

    def __init__(self, rgb: Batch) -> None:
        self._feeds: Iterator[dict[str, Batch]] = iter([{"rgb": crop[None]} for crop in rgb])

    def get_next(self) -> dict[str, Batch] | None:
        """The next crop, or None after the last."""
        return next(self._feeds, None)


def quantise(path: Path, out: Path, rgb: Batch, training: dict[str, object]) -> None:
    """Static int8: weights by channel, activations calibrated on crops (n, 3, h, w)."""
    with TemporaryDirectory() as folder:
        prepared = Path(folder) / "prepared.onnx"
        quant_pre_process(str(path), str(prepared), skip_symbolic_shape=True)
        quantize_static(
            str(prepared), str(out), _Crops(rgb), quant_format=QuantFormat.QDQ, per_channel=True,
            activation_type=QuantType.QUInt8, weight_type=QuantType.QInt8,
            calibrate_method=CalibrationMethod.MinMax,
        )  # fmt: skip
    describe(out, {**training, "quantised": f"static int8, {len(rgb)} training crops"})


def load(folder: Path) -> tuple[BuildingNet | SegFormer, dict[str, object]]:
    """The averaged network of a checkpoint, and how it was trained."""
    path = folder / "checkpoint.pt"
    if not path.is_file():
        raise SystemExit(f"{path}: no such checkpoint; run training/train.py --out {folder} first")
    state = torch.load(path, map_location="cpu", weights_only=True)
    net = network(state["settings"]["network"])
    if "start" in state["settings"]:
        folded(net)
    net.load_state_dict(state["average"])
    return net.eval(), {
        **state["settings"],
        "step": state["step"],
        "minutes": round(state["seconds"] / 60.0, 1),
    }


def averaged(
    net: BuildingNet | SegFormer, training: dict[str, object], models: Sequence[Path]
) -> tuple[BuildingNet | SegFormer, dict[str, object]]:
    """The mean, weight by weight, with exported networks that this one went on from, and how it was trained.

    Raises SystemExit for any other network: the mean of unrelated weights says nothing.
    """
    mine, mean = runs(training), folded(network(str(training["network"])))
    states, back = [net.state_dict()], list[int]()
    for path in models:
        theirs = runs(notes_of(path))
        if theirs not in [mine[:count] for count in range(1, len(mine))]:
            raise SystemExit(f"{path}: is none that this run went on from; name an export of one that it did")
        other = network(str(training["network"]))
        take_weights(folded(other), path)
        states.append(other.state_dict())
        back.append(len(mine) - len(theirs))
    mean.load_state_dict({name: sum(state[name] for state in states) / len(states) for name in states[0]})
    return mean.eval(), {**training, "averaged_with_runs_before": back}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="the --out of training/train.py")
    parser.add_argument("--average", nargs="+", default=[], metavar="MODEL", type=Path, help=AVERAGE_HELP)
    args = parser.parse_args()
    folder: Path = args.folder
    net, training = load(folder)
    if args.average:
        net, training = averaged(net, training, args.average)
    imagery = Path(os.environ.get("BUILDLOC_DATA", REPOSITORY / "../shared/data")) / "imagery"
    scenes = [scene for name in training["places"] for scene in place(imagery, name)]  # type: ignore[attr-defined]
    sampler = CropSampler(scenes, CropConfig(rendered_share=0.0, decoy_share=0.0), seed=0)
    rgb = sampler.batch(0, CALIBRATION_CROPS)[0]
    full, int8 = folder / "model.onnx", folder / "model_int8.onnx"
    write_onnx(net, full, training)
    quantise(full, int8, rgb, training)
    probe = sampler.batch(1, PARITY_CROPS)[0]
    report = {
        "training": training,
        "torch_against_onnx": parity(net, full, probe),
        "onnx_against_int8": agreement(*(_session(p).run(None, {"rgb": probe})[0] for p in (full, int8))),
        "megabytes": {p.name: round(p.stat().st_size / 1e6, 2) for p in (full, int8)},
    }
    (folder / "export.json").write_text(json.dumps(report, indent=2) + "\n")
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
