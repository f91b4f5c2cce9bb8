"""Images so large that they are handled in passes over some of their rows."""

from __future__ import annotations

import resource

import pytest
import torch
from torch import Tensor

from surfconv_ops import reference, surf_conv2d

HEIGHT, WIDTH = 1100, 1000  # with three channels padded to four, more than a pass holds


def smooth(size: tuple[int, int], generator: torch.Generator) -> Tensor:
    rows = torch.linspace(0.4, 3.3, size[0])[:, None]
    return rows + 0.05 * torch.rand(1, 1, *size, generator=generator)


def far_in_the_middle(size: tuple[int, int], generator: torch.Generator) -> Tensor:
    """A few rows reach back over rows that earlier passes would have finished."""
    scale = smooth(size, generator)
    scale[:, :, size[0] // 2 : size[0] // 2 + 3] = 150.3
    return scale


def everywhere(size: tuple[int, int], generator: torch.Generator) -> Tensor:
    # Eighths, so that float32 holds positions a thousand pixels away exactly, and none on a pixel.
    scale = (8000 * torch.randn(1, 1, *size, generator=generator)).round() / 4 + 0.125
    scale[0, 0, ::7] = float("nan")
    return scale


@pytest.mark.parametrize("stride", [1, 3, 97])
@pytest.mark.parametrize("pattern", [smooth, far_in_the_middle, everywhere])
@pytest.mark.parametrize("in_place", [False, True], ids=["copied", "in_place"])
def test_passes_match_the_reference(pattern: object, stride: int, in_place: bool) -> None:
    generator = torch.Generator().manual_seed(3)
    size = ((HEIGHT - 2) // stride + 1, (WIDTH - 2) // stride + 1)
    channels = 4 if in_place else 3
    x = torch.randn(1, channels, HEIGHT, WIDTH, generator=generator)
    if in_place:
        x = x.contiguous(memory_format=torch.channels_last)
    weight = torch.randn(2, channels, 2, 2, generator=generator)
    scale = pattern(size, generator)  # type: ignore[operator]
    grad = torch.randn(1, 2, *size, generator=generator)
    leaves = [t.requires_grad_() for t in (x, weight, scale)]
    output = surf_conv2d(x, weight, scale=scale, stride=stride)
    grads = torch.autograd.grad(output, leaves, grad)
    exact = [t.detach().double().requires_grad_() for t in leaves]
    expected = reference.surf_conv2d(exact[0], exact[1], scale=exact[2], stride=stride)
    expected_grads = torch.autograd.grad(expected, exact, grad.double())
    torch.testing.assert_close(output.double(), expected, rtol=1e-5, atol=1e-4)
    # A weight's gradient sums a million terms of both signs: its size is that of the terms.
    terms = reference.surf_conv2d(exact[0].abs(), exact[1], scale=exact[2].detach(), stride=stride)
    (magnitude,) = torch.autograd.grad(terms, exact[1], grad.double().abs())
    sizes = {"grad_input": expected_grads[0], "grad_weight": magnitude}
    sizes["grad_scale"] = expected_grads[2]
    for (name, size_of), got, want in zip(sizes.items(), grads, expected_grads, strict=True):
        error = (got.double() - want).norm() / size_of.norm()
        assert error < 2e-6, (name, error)


def test_rows_longer_than_a_pass_that_no_tap_reaches() -> None:
    x = torch.randn(1, 4, 1, 1_100_000, requires_grad=True)
    weight = torch.randn(1, 4, 3, 1, requires_grad=True)
    scale = torch.full((1, 4, 1_100_000), 0.5)
    output = surf_conv2d(x, weight, scale=scale, stride=(30, 1), padding=(50, 0))
    assert torch.equal(output, torch.zeros_like(output))
    for gradient in torch.autograd.grad(output, (x, weight), torch.ones_like(output)):
        assert torch.equal(gradient, torch.zeros_like(gradient))


def test_half_gradients_of_passes_are_rounded_once() -> None:
    generator = torch.Generator().manual_seed(4)
    size = (HEIGHT, WIDTH)
    x = torch.randn(1, 3, *size, generator=generator).bfloat16().requires_grad_()
    weight = torch.randn(2, 3, 3, 3, generator=generator).bfloat16()
    scale = smooth(size, generator)
    grad = torch.randn(1, 2, *size, generator=generator).bfloat16()
    (got,) = torch.autograd.grad(surf_conv2d(x, weight, scale=scale, padding=1), x, grad)
    wide = x.detach().float().requires_grad_()
    output = surf_conv2d(wide, weight.float(), scale=scale, padding=1)
    (want,) = torch.autograd.grad(output, wide, grad.float())
    assert torch.equal(got, want.bfloat16())


def test_working_memory_does_not_grow_with_the_image() -> None:
    def peak_growth(height: int) -> int:
        x = torch.zeros(1, 1, height, 8000, dtype=torch.float16)
        weight = torch.ones(1, 1, 3, 3, dtype=torch.float16)
        scale = torch.full((1, 1, 5, 5), 1.5)
        stride = ((height - 3) // 4, 1999)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        surf_conv2d(x, weight, scale=scale, stride=stride)
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before

    peak_growth(1000)
    # A packed copy of the tall image would take 800 MB.
    assert peak_growth(6000) * 1024 < 6000 * 8000 * 2 + 60e6
