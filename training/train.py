"""Train a building network. Resumes by itself from OUT/checkpoint.pt; writes OUT/log.csv and OUT/curves.png.

python training/train.py --places banepa zanzibar philippines --steps 2500 --out out/training/held_barnarp
"""

from __future__ import annotations

import argparse
import copy
import csv
import json
import math
import os
import time
from pathlib import Path
from typing import Any

import cv2
import onnx
import torch
from buildloc_eval.places import PLACES, Scene, place
from buildloc_eval.trained_on import TrainingNotesError, trained_on
from crops import CropConfig, CropSampler
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from networks import BuildingNet, SegFormer, folded, network, take_weights
from runs import Run
from torch import Tensor, nn
from torch.nn import functional

REPOSITORY = Path(__file__).resolve().parents[1]
STARTED_RATE = 0.3  # peak learning rate of weights that are trained already, over that of fresh ones
COLUMNS = ("step", "loss", "building", "core", "learning_rate", "seconds")
EVERY = 25
BFLOAT16_HELP = "compute in bfloat16 where it is faster; weights and loss stay in float32"


def segmentation_loss(logits: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Cross-entropy plus dice of each channel (2,), over the pixels that have a weight in it."""
    logits = functional.interpolate(logits, size=target.shape[2:], mode="bilinear", align_corners=False)
    entropy = functional.binary_cross_entropy_with_logits(logits, target, reduction="none")
    axes = (0, 2, 3)
    total = weight.sum(axes).clamp(min=1.0)
    probability, truth = torch.sigmoid(logits) * weight, target * weight
    overlap = 2.0 * (probability * truth).sum(axes) + 1.0
    dice = 1.0 - overlap / (probability.sum(axes) + truth.sum(axes) + 1.0)
    return (entropy * weight).sum(axes) / total + dice


@torch.no_grad()
def average_into(average: nn.Module, net: nn.Module, keep: float) -> None:
    """Exponential moving average of the weights: flatter minima carry further."""
    mine, theirs = average.state_dict(), net.state_dict()
    for name, value in mine.items():
        if value.dtype.is_floating_point:
            value.lerp_(theirs[name], 1.0 - keep)
        else:
            value.copy_(theirs[name])


def learning_rate(step: int, steps: int) -> float:
    """Factor of the peak: a short warm-up, then a cosine down to nothing."""
    return min(1.0, (step + 1) / 40.0) * 0.5 * (1.0 + math.cos(math.pi * step / steps))


class Training(Run):
    """A network in training, and the average of its weights."""

    def __init__(
        self,
        net: BuildingNet | SegFormer,
        steps: int,
        device: torch.device,
        rate: float = 1.0,
        bfloat16: bool = False,
    ) -> None:
        self.net = net.to(device, memory_format=torch.channels_last)
        self.average = copy.deepcopy(self.net)
        gentle = {id(p) for p in net.pretrained_parameters()}
        fresh = [p for p in net.parameters() if id(p) not in gentle]
        self.optimiser = torch.optim.AdamW(
            [{"params": net.pretrained_parameters(), "lr": 3e-4}, {"params": fresh, "lr": 1e-3}],
            weight_decay=2e-2,
        )
        parts = {"net": self.net, "average": self.average, "optimiser": self.optimiser}
        super().__init__(parts, steps, device)
        self.bfloat16 = bfloat16
        self.peaks = [rate * float(group["lr"]) for group in self.optimiser.param_groups]

    def advance(self, rgb: Tensor, target: Tensor, weight: Tensor) -> tuple[Tensor, float]:
        """One step: the loss of each channel before it, and the learning rate's factor."""
        factor = learning_rate(self.step, self.steps)
        for group, peak in zip(self.optimiser.param_groups, self.peaks, strict=True):
            group["lr"] = peak * factor
        with torch.autocast(self.device.type, torch.bfloat16, self.bfloat16):
            logits = self.net(rgb.contiguous(memory_format=torch.channels_last))
        loss = segmentation_loss(logits.float(), target, weight)
        self.optimiser.zero_grad(set_to_none=True)
        loss.sum().backward()
        nn.utils.clip_grad_norm_(self.net.parameters(), 5.0)
        self.optimiser.step()
        self.step += 1
        average_into(self.average, self.net, min(0.995, self.step / (self.step + 10.0)))
        return loss.detach(), factor


def draw_curves(log: Path, picture: Path) -> None:
    """Loss of each channel and learning rate over the steps."""
    with log.open() as lines:
        rows = list(csv.DictReader(lines))
    steps = [int(row["step"]) for row in rows]
    figure = Figure(figsize=(8, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for name in ("building", "core"):
        axes.plot(steps, [float(row[name]) for row in rows], label=name)
    axes.set_xlabel("step")
    axes.set_ylabel("cross-entropy + dice")
    axes.legend()
    rate = axes.twinx()
    rate.plot(steps, [float(row["learning_rate"]) for row in rows], color="0.7", linestyle=":")
    rate.set_ylabel("learning rate / peak")
    figure.savefig(picture, dpi=100)


def train(
    training: Training, sampler: CropSampler, batch: int, out: Path, settings: dict[str, object]
) -> None:
    """Run to the last step, logging and saving as it goes."""
    log, checkpoint = out / "log.csv", out / "checkpoint.pt"
    if training.step == 0 or not log.exists():
        log.write_text(",".join(COLUMNS) + "\n")
    training.net.train()
    recent: list[Tensor] = []
    started = time.monotonic() - training.seconds
    while training.step < training.steps:
        rgb, target, weight = (
            torch.from_numpy(a).to(training.device)
            for a in sampler.batch(training.step, batch, training.step / training.steps)
        )
        loss, factor = training.advance(rgb, target, weight)
        recent.append(loss)
        training.seconds = time.monotonic() - started
        if training.step % EVERY == 0 or training.step == training.steps:
            building, core = torch.stack(recent).mean(dim=0).tolist()
            recent.clear()
            row = (training.step, building + core, building, core, factor, training.seconds)
            with log.open("a") as lines:
                lines.write(
                    ",".join(f"{value:.5g}" if isinstance(value, float) else str(value) for value in row)
                    + "\n"
                )
            left = training.seconds / training.step * (training.steps - training.step)
            print(
                f"step {training.step}/{training.steps} loss {building:.3f} + {core:.3f}, "
                f"{left / 60:.0f} min left",
                flush=True,
            )
        if training.step % (8 * EVERY) == 0 or training.step == training.steps:
            training.save(checkpoint, settings)
    draw_curves(log, out / "curves.png")


def scenes_of(places: list[str], imagery: Path) -> list[Scene]:
    """The scenes that train. Raises SystemExit for a place's part beside its whole."""
    unknown = [name for name in places if name not in PLACES]
    if unknown:
        raise SystemExit(f"{', '.join(unknown)}: no such place; choose from {', '.join(PLACES)}")
    scenes = {name: place(imagery, name) for name in dict.fromkeys(places)}
    return [scene for name in places for scene in scenes[name]]


def notes_of(model: Path) -> dict[str, Any]:
    """How an exported network was trained. Raises SystemExit where its file does not say."""
    try:
        training = trained_on({entry.key: entry.value for entry in onnx.load(str(model)).metadata_props})
    except TrainingNotesError as error:
        raise SystemExit(f"{model}: {error}") from error
    if training is None:
        raise SystemExit(f"{model}: does not say what trained it; give a file of training/export.py")
    return training


def started_from(model: Path, places: list[str]) -> dict[str, Any]:
    """The same. Raises SystemExit where it saw more ground than ``places``."""
    training = notes_of(model)
    if missing := sorted(set(training["places"]) - set(places)):
        raise SystemExit(f"{model}: has seen {', '.join(missing)} too; add that to --places")
    return training


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--places", nargs="+", required=True, help="ground that trains; all else is held out")
    parser.add_argument("--network", default="lite0", help="lite0, or segformer-b0 to segformer-b5")
    parser.add_argument("--pretrained", help="folder of pretrained SegFormer weights")
    parser.add_argument(
        "--start", type=Path, help="exported float32 network (lite0) whose weights to go on from"
    )
    parser.add_argument("--steps", type=int, default=1800)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--bfloat16", action="store_true", help=BFLOAT16_HELP)
    parser.add_argument(
        "--closing", type=float, default=CropConfig.closing,
        help="share of the run, at its end, with crops near to what a camera brings; 1 for known ground",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    if args.threads:
        torch.set_num_threads(args.threads)
    torch.manual_seed(args.seed)
    cv2.setNumThreads(1)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    imagery = Path(os.environ.get("BUILDLOC_DATA", REPOSITORY / "../shared/data")) / "imagery"
    settings: dict[str, object] = {
        "places": args.places, "network": args.network, "steps": args.steps, "batch": args.batch,
        "seed": args.seed, "bfloat16": args.bfloat16, "closing": args.closing,
    }  # fmt: skip
    net = network(args.network, args.pretrained)
    if args.start:
        settings["start"] = started_from(args.start, args.places)
        take_weights(folded(net), args.start)
    training = Training(net, args.steps, device, STARTED_RATE if args.start else 1.0, args.bfloat16)
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "settings.json").write_text(json.dumps(settings, indent=2) + "\n")
    if (args.out / "checkpoint.pt").exists():
        training.restore(args.out / "checkpoint.pt", settings)
        print(f"going on from step {training.step}")
    sampler = CropSampler(scenes_of(args.places, imagery), CropConfig(closing=args.closing), args.seed)
    train(training, sampler, args.batch, args.out, settings)
    print(f"{args.out}: {training.step} steps in {training.seconds / 60:.1f} min")


if __name__ == "__main__":
    main()
