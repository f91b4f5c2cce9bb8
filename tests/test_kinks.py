"""Where samples lie exactly on pixels, grad_scale is the derivative towards larger scales."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from surfconv_ops import reference, surf_conv2d

STEP = 1e-7


@pytest.mark.core
@pytest.mark.parametrize("function", [surf_conv2d, reference.surf_conv2d], ids=["op", "reference"])
@pytest.mark.parametrize("kernel", [(3, 3), (4, 3), (5, 2), (2, 2), (1, 3)])
@pytest.mark.parametrize("value", [1.0, 2.0, -1.0, 0.0])
@pytest.mark.parametrize("components", [1, 2])
def test_grad_scale_on_a_kink_is_the_derivative_from_above(
    function: object, kernel: tuple[int, int], value: float, components: int
) -> None:
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    x, weight = random(1, 2, 9, 10), random(3, 2, *kernel)
    size = (9 + 2 - kernel[0] + 1, 10 + 2 - kernel[1] + 1)
    scale = torch.full((1, components, *size), value, dtype=torch.float64, requires_grad=True)
    grad_output = random(1, 3, *size)

    def respond(scale: Tensor) -> Tensor:
        return function(x, weight, scale=scale, padding=1)  # type: ignore[operator]

    (grad,) = torch.autograd.grad(respond(scale), scale, grad_output)
    start = respond(scale.detach())
    for component in range(components):
        moved = scale.detach().clone()
        moved[:, component] += STEP
        quotient = ((respond(moved) - start) * grad_output).sum(1) / STEP
        # The response is quadratic between kinks: the quotient is off by its second derivative.
        torch.testing.assert_close(grad[:, component], quotient, rtol=1e-4, atol=2e-5)
