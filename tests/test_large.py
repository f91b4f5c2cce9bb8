"""More than 2^31 elements: positions beyond what 32 bits can count."""

from __future__ import annotations

import contextlib
import os
import resource
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor

from surfconv_ops import surf_conv2d

GIGABYTE = 2**30
NEEDED = 11 * GIGABYTE  # an input and its gradient; what the operator itself takes is little


def available_memory() -> int:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        free = int(dict(line.split(":") for line in lines)["MemAvailable"].split()[0]) * 1024
    except OSError:
        free = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_AVPHYS_PAGES")
    group = Path("/sys/fs/cgroup")
    # "max" where the group has no limit, no files where there are no groups.
    with contextlib.suppress(OSError, ValueError):
        limit = int((group / "memory.max").read_text())
        free = min(free, limit - int((group / "memory.current").read_text()))
    return free


@pytest.fixture(autouse=True)
def _room(compiled: None) -> Iterator[None]:
    """Memory for the tensors, and no copy of them; asking for more is a MemoryError."""
    if available_memory() < NEEDED:
        pytest.skip(f"needs {NEEDED // GIGABYTE} GiB of free memory")
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    limit = pages * resource.getpagesize() + NEEDED
    resource.setrlimit(resource.RLIMIT_AS, (limit, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


# One plane, many planes, channels_last: each overflows another product of sizes and strides.
CASES = {
    "one plane": ((1, 1, 46_400, 46_400), "contiguous"),
    "planes": ((1, 4, 23_200, 23_200), "contiguous"),
    "channels_last": ((1, 3, 26_800, 26_800), "channels_last"),
    "batch": ((40, 1, 7_400, 7_400), "contiguous"),
}
CORNER = 48


def frame(shape: tuple[int, ...], layout: str) -> tuple[Tensor, Tensor]:
    """Zeros, but for noise in the last pixels of the last image: 32 bits would not find them."""
    batch, channels, height, width = shape
    if layout == "channels_last":
        x = torch.zeros(batch, height, width, channels, dtype=torch.float16).permute(0, 3, 1, 2)
    else:
        x = torch.zeros(shape, dtype=torch.float16)
    assert x.numel() > 2**31
    noise = torch.randn(channels, CORNER, CORNER).half()
    x[-1, :, -CORNER:, -CORNER:] = noise
    return x, noise


@pytest.mark.parametrize("case", CASES)
def test_forward(case: str) -> None:
    shape, layout = CASES[case]
    batch, channels, height, width = shape
    x, noise = frame(shape, layout)
    weight = torch.randn(2, channels, 3, 3).half()
    stride = (height - 3) // 2
    # The last output's window ends `last` pixels before the last row and column.
    count = (height - 3) // stride + 1
    last = height - 3 - stride * (count - 1)
    scale = torch.full((batch, count, count), 1.5)
    out = surf_conv2d(x, weight, scale=scale, stride=stride)
    assert last < CORNER - 8
    near = surf_conv2d(noise[None].double(), weight.double(),
                       scale=torch.full((1, CORNER - 2, CORNER - 2), 1.5).double())  # fmt: skip
    at = CORNER - 3 - last
    exact = near[0, :, at, at]
    assert (exact != 0).any()
    torch.testing.assert_close(out[-1, :, -1, -1].double(), exact, rtol=2e-3, atol=2e-3)
    out[-1, :, -1, -1] = 0
    assert not out.any()


@pytest.mark.parametrize("case", ["one plane", "planes"])
def test_gradients(case: str) -> None:
    x, noise = frame(*CASES[case])
    _, channels, height, _ = x.shape
    weight = torch.randn(1, channels, 3, 3).half()
    stride = (height - 3) // 2
    count = (height - 3) // stride + 1
    last = height - 3 - stride * (count - 1)
    assert last < CORNER - 8
    scale = torch.full((1, 1, count, count), 1.5)
    grad = torch.zeros(1, 1, count, count).half()
    grad[..., -1, -1] = 1.0
    arguments = (weight, scale, None, 0.0, [stride] * 2, [0, 0], [1, 1], 1)
    backward = torch.ops.surfconv.surf_conv2d_backward
    needs = (True, True, False, True)
    grad_input, grad_weight, _, grad_scale = backward(grad, x, *arguments, *needs)
    small = torch.zeros(1, 1, CORNER - 2, CORNER - 2).double()
    at = CORNER - 3 - last
    small[..., at, at] = 1.0
    near = backward(
        small, noise[None].double(), weight.double(), torch.full_like(small, 1.5), None, 0.0,
        [1, 1], [0, 0], [1, 1], 1, True, True, True, True,
    )  # fmt: skip
    corner = grad_input[..., -CORNER:, -CORNER:]
    torch.testing.assert_close(corner.double(), near[0], rtol=2e-3, atol=2e-3)
    assert corner.any()
    corner.zero_()
    assert not any(part.any() for part in grad_input.split(4_000, 2))
    torch.testing.assert_close(grad_weight.double(), near[1], rtol=2e-3, atol=2e-3)
    last_slope = grad_scale[0, 0, -1, -1].double()
    torch.testing.assert_close(last_slope, near[3][0, 0, at, at], rtol=1e-4, atol=1e-4)
