"""The paper's net: FCN-8s skips on a small ResNet-18, at capacity 1 exactly 65,008 parameters.

Plain PyTorch: nothing in it knows of depth. `segmenter.py` makes it a SurfConv net.

Source:
    Chu et al., *SurfConv*, CVPR 2018, section 4 (the net and its training).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

WIDTHS = (4, 8, 16, 32)
HEAD_WIDTH = 64
CLASSES = 12
CHANNELS = 6
PARAMETERS_AT_CAPACITY_1 = 65_008


class Block(nn.Module):
    """ResNet's basic block: two 3x3 convolutions and a shortcut."""

    def __init__(self, channels_in: int, channels_out: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels_in, channels_out, 3, stride, padding=1, bias=False)
        self.norm1 = nn.BatchNorm2d(channels_out)
        self.conv2 = nn.Conv2d(channels_out, channels_out, 3, padding=1, bias=False)
        self.norm2 = nn.BatchNorm2d(channels_out)
        self.shortcut: nn.Module = nn.Identity()
        if stride != 1 or channels_in != channels_out:
            self.shortcut = nn.Sequential(
                nn.Conv2d(channels_in, channels_out, 1, stride, bias=False),
                nn.BatchNorm2d(channels_out),
            )

    def forward(self, input: Tensor) -> Tensor:
        """Features (N, channels_out, ceil(H / stride), ceil(W / stride))."""
        features = self.norm1(self.conv1(input)).relu()
        features = self.norm2(self.conv2(features))
        return (features + self.shortcut(input)).relu()


class PaperNet(nn.Module):
    """Scores (N, classes, H, W) of frames (N, channels, H, W), at any size.

    Args:
        capacity: multiplies the widths 4, 8, 16, 32 of the four stages.
        channels: of the input; 6 for RGB and HHA.
        classes: number of classes, the ignored one included.
    """

    def __init__(self, capacity: int = 1, channels: int = CHANNELS, classes: int = CLASSES) -> None:
        super().__init__()
        widths = [capacity * width for width in WIDTHS]
        self.stem = nn.Conv2d(channels, widths[0], 7, stride=2, padding=3, bias=False)
        self.norm = nn.BatchNorm2d(widths[0])
        self.pool = nn.MaxPool2d(3, stride=2, padding=1)
        self.stages = nn.ModuleList()
        width_in = widths[0]
        for number, width in enumerate(widths):
            first = Block(width_in, width, stride=1 if number == 0 else 2)
            self.stages.append(nn.Sequential(first, Block(width, width, stride=1)))
            width_in = width
        self.head = nn.Conv2d(width_in, HEAD_WIDTH, 3, padding=1)
        self.scores = nn.Conv2d(HEAD_WIDTH, classes, 1)
        self.skips = nn.ModuleList(nn.Conv2d(width, classes, 1) for width in widths[:-1])
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, input: Tensor) -> Tensor:
        """Scores of every pixel; stages 1 to 3 come in on the way up, stage 4 is the head's."""
        features = self.pool(self.norm(self.stem(input)).relu())
        skipped = []
        for stage in self.stages:
            features = stage(features)
            skipped.append(features)
        scores: Tensor = self.scores(self.head(features).relu())
        for skip, at in zip(reversed(self.skips), reversed(skipped[:-1]), strict=True):
            scores = _resize(scores, at) + skip(at)
        return _resize(scores, input)


def _resize(scores: Tensor, like: Tensor) -> Tensor:
    return interpolate(scores, size=like.shape[-2:], mode="bilinear", align_corners=False)


def parameter_count(module: nn.Module) -> int:
    """Number of values that training changes."""
    return sum(parameter.numel() for parameter in module.parameters())


def on_device(device: str) -> torch.device:
    """The device asked for; 'auto' is CUDA where there is one."""
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(device)
