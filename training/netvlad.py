"""Train the two branches of the NetVLAD baseline on rendered pairs of ground that no flight crosses.

Resumes by itself from OUT/checkpoint.pt; writes OUT/log.csv, and OUT/drone.onnx, OUT/reference.onnx and
OUT/export.json at the end.

python training/netvlad.py --steps 4000 --out out/training/netvlad
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import shapely
import torch
from buildloc_eval.observation import Digitiser
from buildloc_eval.paper.differences import AutomaticMapping, redrawn, reference_outlines
from buildloc_eval.paper.netvlad import BRANCHES, FINE, PIXEL_M, SIDE_PX, STEP_M, Tiles, raster
from buildloc_eval.paper.sources import read_boston
from buildloc_eval.segmentation_errors import Outlines, SegmentationErrors, perceive, read_errors
from export import OPSET
from runs import Run
from torch import Tensor, nn
from torch.nn import functional
from train import BFLOAT16_HELP, EVERY, learning_rate

# Framingham and Ashland (east, north; EPSG 32619), 10 and 15 km from the nearest flight.
TRAIN_M, HELD_OUT_M = (301_000.0, 4_685_000.0), (298_000.0, 4_679_000.0)
RADIUS_M = 2500.0
ERRORS_OF = "barnarp"  # as the flights have them
DRAWS = 6  # of both hands and of the segmenter, over the same ground
ALTITUDE_M, HALF_VIEW = (
    (95.0, 120.0),
    (0.70, 0.394),
)  # half a frame's sides over its altitude: 70 degrees, 16:9
CLUSTERS, FEATURES = 64, 64  # a descriptor of 4096
MARGIN = 0.1
APART_M = 150.0  # tiles nearer than this are no negatives
PROBES = 500
STEPS_KEPT = 8 * EVERY


class Block(nn.Module):
    """A basic block of ResNet; names are torchvision's, so that its weights fit."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(outputs)
        self.downsample = (
            nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))
            if stride > 1
            else nn.Identity()
        )

    def forward(self, x: Tensor) -> Tensor:
        """(n, inputs, h, w) -> (n, outputs, h / stride, w / stride)."""
        inner = self.bn2(self.conv2(functional.relu(self.bn1(self.conv1(x)))))
        return functional.relu(inner + self.downsample(x))


class ResNet18(nn.Module):
    """He et al. 2016 without its classifier; (n, inputs, h, w) -> (n, 512, h / 32, w / 32)."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.layer1 = nn.Sequential(Block(64, 64, 1), Block(64, 64, 1))
        self.layer2 = nn.Sequential(Block(64, 128, 2), Block(128, 128, 1))
        self.layer3 = nn.Sequential(Block(128, 256, 2), Block(256, 256, 1))
        self.layer4 = nn.Sequential(Block(256, 512, 2), Block(512, 512, 1))

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        x = functional.max_pool2d(functional.relu(self.bn1(self.conv1(x))), 3, 2, 1)
        return self.layer4(self.layer3(self.layer2(self.layer1(x))))  # type: ignore[no-any-return]

    def load_pretrained(self, path: Path) -> None:
        """Weights of torchvision's resnet18; every input plane gets the mean over the colours."""
        state = torch.load(path, map_location="cpu", weights_only=True)
        own = {name: value for name, value in state.items() if not name.startswith("fc.")}
        own["conv1.weight"] = (
            own["conv1.weight"].mean(dim=1, keepdim=True).repeat(1, self.conv1.in_channels, 1, 1)
        )
        self.load_state_dict(own)


class NetVlad(nn.Module):
    """Residuals of local features to the clusters they are assigned to: (n, 512, h, w) to (n, 4096)."""

    def __init__(self) -> None:
        super().__init__()
        self.project = nn.Conv2d(512, FEATURES, 1, bias=False)
        self.assign = nn.Conv2d(FEATURES, CLUSTERS, 1)
        self.centres = nn.Parameter(functional.normalize(torch.randn(CLUSTERS, FEATURES), dim=1))
        with torch.no_grad():  # the assignment starts as that to the nearest centre
            self.assign.weight.copy_(10.0 * self.centres[:, :, None, None])
            self.assign.bias.zero_()  # type: ignore[union-attr]

    def forward(self, x: Tensor) -> Tensor:
        """See the class; of length 1. In float32, whatever the backbone computes in."""
        with torch.autocast(x.device.type, enabled=False):
            x = functional.normalize(self.project(x.float()), dim=1)
            share = self.assign(x).flatten(2).softmax(dim=1)  # (n, clusters, places)
            sums = share @ x.flatten(2).transpose(1, 2) - share.sum(dim=2, keepdim=True) * self.centres
            return functional.normalize(functional.normalize(sums, dim=2).flatten(1), dim=1)


class Branch(nn.Sequential):
    """Backbone and pooling for tiles with so many planes."""

    def __init__(self, planes: int, pretrained: Path | None = None) -> None:
        backbone = ResNet18(planes)
        if pretrained:
            backbone.load_pretrained(pretrained)
        super().__init__(backbone, NetVlad())


class DualBranch(nn.Module):
    """Drone and reference, which start alike but for their first layer."""

    def __init__(self, pretrained: Path | None = None) -> None:
        super().__init__()
        self.drone, self.reference = Branch(2, pretrained), Branch(1, pretrained)
        first = "0.conv1.weight"
        alike = {name: value for name, value in self.drone.state_dict().items() if name != first}
        self.reference.load_state_dict(alike, strict=False)

    def forward(self, views: Tensor, tiles: Tensor) -> tuple[Tensor, Tensor]:
        """(n, 2, s, s) and (n, 1, s, s) -> descriptors (n, 4096) of both."""
        return self.drone(views), self.reference(tiles)


@dataclass(frozen=True)
class Ground:
    """Built ground as a segmenter sees it and as a reference has it, DRAWS times, about ``centre_m``."""

    centre_m: tuple[float, float]
    seen: tuple[Tiles, ...]
    reference: tuple[Tiles, ...]


@dataclass(frozen=True)
class Pairs:
    """Views (N, 2, s, s), tiles (N, 1, s, s) of the same places, and where those are (N, 2), metres."""

    views: Tiles
    tiles: Tiles
    places_m: np.ndarray


def draw_ground(
    city: Outlines, centre_m: tuple[float, float], errors: SegmentationErrors, draws: int, seed: int
) -> Ground:
    """What the flights' models of both digitisers and of the segmenter make of a circle of the city."""
    near = city[np.hypot(*(shapely.get_coordinates(shapely.centroid(city)) - centre_m).T) <= RADIUS_M]
    side = round(2.0 * RADIUS_M / PIXEL_M)
    corner = (centre_m[0] - RADIUS_M, centre_m[1] - RADIUS_M)
    circle, seen, reference = shapely.Point(*centre_m).buffer(RADIUS_M), list[Tiles](), list[Tiles]()
    for draw in range(draws):
        rng = np.random.default_rng([seed, draw])
        perceived = perceive(redrawn(near, Digitiser(), rng), errors, circle, rng)
        shown = perceived.outlines[rng.random(len(perceived.outlines)) < perceived.shown]
        seen.append(raster(shown, *corner, (side, side)))
        drawn = reference_outlines(near, Digitiser(), AutomaticMapping(), rng)
        reference.append(raster(drawn, *corner, (side, side)))
    return Ground(centre_m, tuple(seen), tuple(reference))


def draw_pairs(ground: Ground, count: int, rng: np.random.Generator) -> Pairs:
    """Pairs at random places with buildings in view, tiles off by what their grid allows."""
    views, tiles, places = [], [], []
    reach = RADIUS_M / math.sqrt(2.0) - SIDE_PX * PIXEL_M
    while len(views) < count:
        draw, place = int(rng.integers(len(ground.seen))), rng.uniform(-reach, reach, 2)
        heading, altitude = rng.uniform(-math.pi, math.pi), rng.uniform(*ALTITUDE_M)
        off = rng.uniform(-0.5, 0.5, 2) * STEP_M
        shown = _frame(heading, altitude)
        view = _cut(ground.seen[draw], place) * shown
        if not view.any():
            continue
        views.append(np.stack([view, shown]))
        tiles.append(_cut(ground.reference[draw], place + off)[None])
        places.append(place)
    return Pairs(np.array(views), np.array(tiles), np.array(places))


def _frame(heading_rad: float, altitude_m: float) -> Tiles:
    """(s, s) what a frame of this heading shows, north up."""
    box = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * HALF_VIEW * altitude_m / PIXEL_M * FINE
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    corners = box @ np.array([[c, -s], [s, c]]) + SIDE_PX * FINE / 2.0 - 0.5
    plane = np.zeros((SIDE_PX * FINE,) * 2, dtype=np.float32)
    cv2.fillPoly(plane, [np.round(corners * 16.0).astype(np.int32)], 1.0, cv2.LINE_8, 4)
    return np.asarray(cv2.resize(plane, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA))


def _cut(plane: Tiles, place_m: np.ndarray) -> Tiles:
    """(s, s) of a raster about a place, metres east and north of its middle."""
    column, row = np.round(plane.shape[0] / 2.0 + place_m * (1.0, -1.0) / PIXEL_M - SIDE_PX / 2.0).astype(int)
    return plane[row : row + SIDE_PX, column : column + SIDE_PX]


def triplet_loss(views: Tensor, tiles: Tensor, places_m: Tensor) -> tuple[Tensor, Tensor]:
    """Mean over the triplets of a batch that violate the margin (a view, its tile, another place's tile), and
    their share of all triplets: the mean alone tells little of progress, as the easy ones drop out of it."""
    apart = 2.0 - 2.0 * views @ tiles.T
    others = torch.cdist(places_m, places_m) > APART_M
    excess = functional.relu(apart.diagonal()[:, None] - apart + MARGIN) * others
    violating = (excess > 0).sum()
    return excess.sum() / violating.clamp(min=1), violating / others.sum().clamp(min=1)


class Training(Run):
    """Both branches in training."""

    def __init__(self, net: DualBranch, steps: int, device: torch.device, bfloat16: bool = False) -> None:
        self.net, self.bfloat16 = net.to(device, memory_format=torch.channels_last), bfloat16
        self.optimiser = torch.optim.AdamW(net.parameters(), lr=0.0, weight_decay=1e-2)
        super().__init__({"net": self.net, "optimiser": self.optimiser}, steps, device)

    def advance(self, pairs: Pairs) -> tuple[float, float]:
        """One step; the loss and the share of violating triplets before it."""
        self.net.train()
        for group in self.optimiser.param_groups:
            group["lr"] = 1e-3 * learning_rate(self.step, self.steps)
        given = [
            torch.from_numpy(a).float().to(self.device) for a in (pairs.views, pairs.tiles, pairs.places_m)
        ]
        with torch.autocast(self.device.type, torch.bfloat16, self.bfloat16):
            described = self.net(*given[:2])
        loss, violating = triplet_loss(*described, given[2])
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.net.parameters(), 5.0)
        self.optimiser.step()
        self.step += 1
        return float(loss.detach()), float(violating)


@torch.no_grad()
def recall(net: DualBranch, pairs: Pairs, device: torch.device) -> dict[str, float]:
    """Share of views whose tile, or one nearer than APART_M, is among the first K of all tiles."""
    net.eval()
    views, tiles = (
        torch.cat([branch(torch.from_numpy(part).float().to(device)) for part in np.array_split(given, 8)])
        for branch, given in ((net.drone, pairs.views), (net.reference, pairs.tiles))
    )
    order = (views @ tiles.T).argsort(dim=1, descending=True).cpu().numpy()
    apart = np.hypot(*(pairs.places_m[:, None] - pairs.places_m[order]).transpose(2, 0, 1))
    return {f"recall@{k}": float((apart[:, :k] < APART_M).any(axis=1).mean()) for k in (1, 10)}


def train(training: Training, ground: Ground, batch: int, out: Path, settings: dict[str, object]) -> None:
    """Run to the last step, logging and saving as it goes."""
    log = out / "log.csv"
    if training.step == 0 or not log.exists():
        log.write_text("step,loss,violating,seconds\n")
    recent, started = list[tuple[float, float]](), time.monotonic() - training.seconds
    while training.step < training.steps:
        rng = np.random.default_rng([int(str(settings["seed"])), 1, training.step])
        recent.append(training.advance(draw_pairs(ground, batch, rng)))
        training.seconds = time.monotonic() - started
        if training.step % EVERY == 0 or training.step == training.steps:
            loss, violating = np.mean(recent, axis=0).tolist()
            recent.clear()
            with log.open("a") as lines:
                lines.write(f"{training.step},{loss:.5g},{violating:.5g},{training.seconds:.5g}\n")
            left = training.seconds / training.step * (training.steps - training.step)
            print(
                f"step {training.step}/{training.steps} loss {loss:.4f}, "
                f"{100.0 * violating:.0f} % of triplets, {left / 60:.0f} min left",
                flush=True,
            )
        if training.step % STEPS_KEPT == 0 or training.step == training.steps:
            training.save(out / "checkpoint.pt", settings)


def export(net: DualBranch, folder: Path, pairs: Pairs) -> dict[str, float]:
    """Write both branches; the largest difference of a descriptor's value, PyTorch against ONNX Runtime."""
    net = copy.deepcopy(net).eval().to("cpu")
    found = {}
    for name, given in zip(BRANCHES, (pairs.views, pairs.tiles), strict=True):
        branch, path, probe = getattr(net, name), folder / f"{name}.onnx", given.astype(np.float32)
        torch.onnx.export(
            branch, (torch.from_numpy(probe[:2]),), str(path), input_names=["tiles"], dynamo=False,
            output_names=["descriptors"], dynamic_axes={"tiles": {0: "n"}, "descriptors": {0: "n"}},
            opset_version=OPSET,
        )  # fmt: skip
        with torch.no_grad():
            ours = branch(torch.from_numpy(probe)).numpy()
        session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        found[name] = float(np.abs(ours - session.run(None, {"tiles": probe})[0]).max())
    return found


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pretrained", type=Path, help="file of torchvision's resnet18 weights (ImageNet)")
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--bfloat16", action="store_true", help=BFLOAT16_HELP)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    if args.threads:
        torch.set_num_threads(args.threads)
    torch.manual_seed(args.seed)
    cv2.setNumThreads(1)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    settings: dict[str, object] = {
        "pretrained": str(args.pretrained or ""), "steps": args.steps, "batch": args.batch, "seed": args.seed,
        "bfloat16": args.bfloat16,
    }  # fmt: skip
    args.out.mkdir(parents=True, exist_ok=True)
    city, errors = read_boston(), read_errors(ERRORS_OF)
    held_out = draw_pairs(
        draw_ground(city, HELD_OUT_M, errors, 1, args.seed + 1), PROBES, np.random.default_rng(args.seed)
    )
    training = Training(DualBranch(args.pretrained), args.steps, device, args.bfloat16)
    before = recall(training.net, held_out, device)
    print(f"held-out pairs before training: {before}", flush=True)
    if (args.out / "checkpoint.pt").exists():
        training.restore(args.out / "checkpoint.pt", settings)
        print(f"going on from step {training.step}")
    train(training, draw_ground(city, TRAIN_M, errors, DRAWS, args.seed), args.batch, args.out, settings)
    report = {
        "training": {**settings, "step": training.step, "minutes": round(training.seconds / 60.0, 1)},
        "held-out pairs": {
            "count": PROBES, "before": before, "after": recall(training.net, held_out, device)
        },
        "torch_against_onnx": export(training.net, args.out, held_out),
    }  # fmt: skip
    (args.out / "export.json").write_text(json.dumps(report, indent=2) + "\n")
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
