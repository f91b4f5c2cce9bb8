"""The paper's net: FCN-8s on ResNet-18, at capacity 1 exactly 65,008 parameters.

Basic blocks of widths 4, 8, 16, 32 after a 7x7 stride-2 convolution and a max pool; a head of
3x3 to 64 channels and 1x1 to the classes; and from stages 1 to 3 skips of 1x1 to the classes, added
on the way back up (stage 4 comes through the head).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from surfconv_ops import SurfConv2d

WIDTHS = (4, 8, 16, 32)
HEAD_WIDTH = 64
CLASSES = 12
CHANNELS = 6
PARAMETERS = 65_008

#: Makes a convolution from nn.Conv2d's arguments.
ConvFactory = Callable[..., nn.Conv2d]


def surf_factory(**options: Any) -> ConvFactory:
    """SurfConv2d with these depth arguments for kernels larger than 1 x 1, nn.Conv2d for others."""

    def make(channels_in: int, channels_out: int, kernel: int, **rest: Any) -> nn.Conv2d:
        if kernel == 1:
            return nn.Conv2d(channels_in, channels_out, kernel, **rest)
        return SurfConv2d(channels_in, channels_out, kernel, **rest, **options)

    return make


class DepthBySize:
    """One depth map at every resolution that a net asks for, each made once.

    Pixel i of h takes the depth at row floor(i * H / h), columns likewise: what layers of odd,
    'same'-padded kernels keep of a frame.
    """

    def __init__(self, depth: Tensor) -> None:
        self._full = depth
        self._made: dict[tuple[int, int], Tensor] = {}

    def at(self, height: int, width: int) -> Tensor:
        """Depth (N, height, width)."""
        if (height, width) not in self._made:
            rows, columns = self._full.shape[-2:]
            y = torch.arange(height) * rows // height
            x = torch.arange(width) * columns // width
            same = (height, width) == (rows, columns)
            self._made[height, width] = (
                self._full if same else self._full.index_select(-2, y).index_select(-1, x)
            )
        return self._made[height, width]


def _convolve(conv: nn.Module, input: Tensor, depth: DepthBySize | None) -> Tensor:
    if isinstance(conv, SurfConv2d):
        assert depth is not None, "a net of SurfConv2d needs depth"
        return conv(input, depth.at(input.shape[-2], input.shape[-1]))
    output: Tensor = conv(input)
    return output


class Block(nn.Module):
    """ResNet's basic block: two 3x3 convolutions and a shortcut."""

    def __init__(self, conv: ConvFactory, channels_in: int, channels_out: int, stride: int) -> None:
        super().__init__()
        self.conv1 = conv(channels_in, channels_out, 3, stride=stride, padding=1, bias=False)
        self.norm1 = nn.BatchNorm2d(channels_out)
        self.conv2 = conv(channels_out, channels_out, 3, padding=1, bias=False)
        self.norm2 = nn.BatchNorm2d(channels_out)
        self.shortcut: nn.Module = nn.Identity()
        if stride != 1 or channels_in != channels_out:
            self.shortcut = nn.Sequential(
                conv(channels_in, channels_out, 1, stride=stride, bias=False),
                nn.BatchNorm2d(channels_out),
            )

    def forward(self, input: Tensor, depth: DepthBySize | None) -> Tensor:
        """Features (N, channels_out, ceil(H / stride), ceil(W / stride))."""
        features = self.norm1(_convolve(self.conv1, input, depth)).relu()
        features = self.norm2(_convolve(self.conv2, features, depth))
        return (features + self.shortcut(input)).relu()


class PaperNet(nn.Module):
    """Scores (N, classes, H, W) of frames (N, 6, H, W).

    Args:
        conv: makes every convolution from nn.Conv2d's arguments: nn.Conv2d itself, or
            `surf_factory(...)`.
        widths: channels of the four stages.
        classes: number of classes.
    """

    def __init__(
        self,
        conv: ConvFactory = nn.Conv2d,
        widths: tuple[int, ...] = WIDTHS,
        classes: int = CLASSES,
    ) -> None:
        super().__init__()
        self.stem = conv(CHANNELS, widths[0], 7, stride=2, padding=3, bias=False)
        self.norm = nn.BatchNorm2d(widths[0])
        self.pool = nn.MaxPool2d(3, stride=2, padding=1)
        self.stages = nn.ModuleList()
        channels = widths[0]
        for number, width in enumerate(widths):
            stride = 1 if number == 0 else 2
            stage = nn.ModuleList(
                (Block(conv, channels, width, stride), Block(conv, width, width, 1))
            )
            self.stages.append(stage)
            channels = width
        self.head = conv(channels, HEAD_WIDTH, 3, padding=1)
        self.scores = conv(HEAD_WIDTH, classes, 1)
        self.skips = nn.ModuleList(conv(width, classes, 1) for width in widths[:-1])

    def forward(self, input: Tensor, depth: Tensor | None = None) -> Tensor:
        """The scores; depth (N, H, W) in metres where the factory made SurfConv2d."""
        depths = None if depth is None else DepthBySize(depth)
        features = self.pool(self.norm(_convolve(self.stem, input, depths)).relu())
        stages = []
        for stage in self.stages:
            assert isinstance(stage, nn.ModuleList)
            for block in stage:
                features = block(features, depths)
            stages.append(features)
        scores: Tensor = self.scores(_convolve(self.head, features, depths).relu())
        for skip, skipped in zip(reversed(self.skips), reversed(stages[:-1]), strict=True):
            scores = _resize(scores, skipped) + skip(skipped)
        return _resize(scores, input)


def _resize(scores: Tensor, like: Tensor) -> Tensor:
    return interpolate(scores, size=like.shape[-2:], mode="bilinear", align_corners=False)
