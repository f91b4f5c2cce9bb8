"""The same small net with nn.Conv2d and with SurfConv2d, and a fair stopwatch for both."""

from __future__ import annotations

import copy
import ctypes
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor, nn

from surfconv_ops import DepthGuided, DepthLevels, convert_conv2d

# (in, out, stride, dilation) of 3x3 layers, padded so that tap 0 is the centre of every pixel kept.
LAYERS = ((3, 16, 2, 1), (16, 32, 2, 1), (32, 64, 2, 1), (64, 64, 1, 2))
KERNEL = 3
CLASSES = 8


@dataclass(frozen=True)
class DrawnLayer:
    """The last 3x3 layer, the one whose footprint the picture shows, in pixels of the frame."""

    stride: int = LAYERS[0][2] * LAYERS[1][2] * LAYERS[2][2]
    dilation: int = LAYERS[3][3]

    @property
    def tap_spacing(self) -> int:
        """Distance of neighbouring taps at scale 1, in frame pixels."""
        return self.stride * self.dilation

    @property
    def footprint(self) -> int:
        """Width of the k x k cells at scale 1, in frame pixels."""
        return KERNEL * self.tap_spacing


class FrameNet(nn.Sequential):
    """Four 3x3 layers and a 1x1 classifier: scores (N, 8, H/8, W/8) of an image (N, 3, H, W)."""

    def __init__(self) -> None:
        super().__init__()
        for channels_in, channels_out, stride, dilation in LAYERS:
            self.append(
                nn.Conv2d(
                    channels_in, channels_out, KERNEL, stride, padding=dilation, dilation=dilation
                )
            )
            self.append(nn.ReLU())
        self.append(nn.Conv2d(LAYERS[-1][1], CLASSES, 1))


def with_depth(
    net: FrameNet, reference_depth: float, levels: DepthLevels | None = None
) -> DepthGuided:
    """A copy of the net whose 3x3 layers are SurfConv2d."""
    copied = copy.deepcopy(net)
    return DepthGuided(convert_conv2d(copied, reference_depth=reference_depth, levels=levels))


@dataclass
class Measured:
    """Times in seconds of each round, and what one step showed."""

    forward: list[float] = field(default_factory=list)
    backward: list[float] = field(default_factory=list)
    output_shape: tuple[int, ...] = ()
    extra_mib: float | None = None
    finite: bool = True

    def medians(self) -> tuple[float, float]:
        return statistics.median(self.forward), statistics.median(self.backward)


def _resident_mib(key: str) -> float | None:
    """A memory figure of this process from Linux's /proc; None elsewhere."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    for line in lines:
        if line.startswith(key):
            return int(line.split()[1]) / 1024
    return None


def _reset_peak() -> bool:
    """Start a new peak of resident memory; freed heap goes back first, else its reuse hides."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")
    except (OSError, AttributeError):
        return False
    return True


def _step(net: nn.Module, image: Tensor, depth: Tensor, result: Measured) -> None:
    net.zero_grad(set_to_none=True)
    leaf = image.clone().requires_grad_()
    start = time.perf_counter()
    output = net(leaf, depth=depth) if isinstance(net, DepthGuided) else net(leaf)
    middle = time.perf_counter()
    output.square().mean().backward()
    end = time.perf_counter()
    result.forward.append(middle - start)
    result.backward.append(end - middle)
    result.output_shape = tuple(output.shape)
    gradients = [leaf.grad, *(parameter.grad for parameter in net.parameters())]
    tensors = [output, *(gradient for gradient in gradients if gradient is not None)]
    result.finite &= all(bool(torch.isfinite(tensor).all()) for tensor in tensors)


def measure(
    nets: Mapping[str, nn.Module],
    image: Tensor,
    depth: Tensor,
    rounds: int,
    progress: Callable[[int], None] = lambda _: None,
) -> dict[str, Measured]:
    """Run every net forward and backward in turn, `rounds` times, so that drift hits all alike.

    Two steps of each net warm up and are not timed; the second gives the peak of the process's
    resident memory above what it was before (None where the system cannot reset that counter).
    """
    results = {name: Measured() for name in nets}
    for name, net in nets.items():
        _step(net, image, depth, Measured())
        before = _resident_mib("VmRSS:") if _reset_peak() else None
        _step(net, image, depth, results[name])
        peak = _resident_mib("VmHWM:")
        if before is not None and peak is not None:
            results[name].extra_mib = peak - before
        results[name].forward.clear()
        results[name].backward.clear()
    for number in range(rounds):
        for name, net in nets.items():
            _step(net, image, depth, results[name])
        progress(number + 1)
    return results
