"""Maps read at the centres of output pixels: shared where they can be, never wrong."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from helpers import assert_same_bits
from surfconv_ops import SurfConv2d, at_output_centers
from surfconv_ops.depth import read_at_centers
from surfconv_ops.validation import check_window

CENTERS: list[tuple[dict[str, Any], bool]] = [
    ({"kernel_size": 3, "padding": 1}, True),
    ({"kernel_size": 5, "padding": "same", "dilation": 2}, True),
    ({"kernel_size": 4, "padding": "same"}, True),
    ({"kernel_size": 1}, True),
    ({"kernel_size": 3, "padding": 1, "stride": 2}, True),
    ({"kernel_size": (3, 5), "padding": (0, 1), "stride": (2, 3)}, True),
    ({"kernel_size": 3}, True),
    ({"kernel_size": 3, "padding": 2}, False),
    ({"kernel_size": 2, "padding": 1, "stride": 1}, False),
    ({"kernel_size": 1, "padding": 1, "stride": 4}, False),
    ({"kernel_size": (1, 3), "padding": (0, 2)}, False),
]


@pytest.mark.parametrize(("options", "shared"), CENTERS, ids=str)
@pytest.mark.parametrize("size", [(7, 8), (11, 5), (12, 12)])
def test_maps_are_shared_where_no_center_is_outside(
    options: dict[str, Any], shared: bool, size: tuple[int, int]
) -> None:
    map = torch.rand(2, *size)
    full = {"stride": 1, "padding": 0, "dilation": 1} | options
    window = check_window(
        size, full["kernel_size"], full["stride"], full["padding"], full["dilation"]
    )
    read, public = read_at_centers(map, window), at_output_centers(map, **options)
    assert_same_bits(read, public)
    assert (read.untyped_storage().data_ptr() == map.untyped_storage().data_ptr()) == shared
    assert public.untyped_storage().data_ptr() != map.untyped_storage().data_ptr()


@pytest.mark.parametrize("options", [c[0] for c in CENTERS[::3]], ids=str)
def test_gradient_of_depth_through_a_layer(options: dict[str, Any]) -> None:
    """The same whether centres are selected by index, as while compiling, or shared."""
    torch._dynamo.reset()
    options = dict(options)
    layer = SurfConv2d(2, 3, options.pop("kernel_size"), **options, reference_depth=2.0)
    x, depth = torch.randn(2, 2, 9, 10), torch.rand(2, 9, 10) * 3 + 0.5
    depth[:, ::3, ::2] = 0.0
    depth.requires_grad_()
    (eager,) = torch.autograd.grad(layer(x, depth).square().sum(), depth)
    compiled = torch.compile(layer, backend="aot_eager", fullgraph=True)
    (wanted,) = torch.autograd.grad(compiled(x, depth).square().sum(), depth)
    torch.testing.assert_close(eager, wanted, rtol=1e-5, atol=1e-5)
