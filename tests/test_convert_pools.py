"""convert_conv2d(pools=True)."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn

from guided_nets import frames
from helpers import assert_same_bits
from surfconv_ops import (
    DepthGuided,
    SurfAvgPool2d,
    SurfConv2d,
    SurfMaxPool2d,
    conversion_report,
    convert_conv2d,
)


def net() -> nn.Module:
    return nn.Sequential(
        nn.Conv2d(3, 4, 3, padding=1),
        nn.MaxPool2d(3, stride=2, padding=1, ceil_mode=True),
        nn.Conv2d(4, 4, 3, padding=1),
        nn.AvgPool2d(2, stride=1, count_include_pad=False),
        nn.MaxPool2d(1, stride=2),
    )


@pytest.mark.parametrize("pools", [True, False])
def test_pools_are_swapped_on_request(pools: bool) -> None:
    plain = net()
    x, depth = frames()
    expected = copy.deepcopy(plain)(x)
    guided = DepthGuided(convert_conv2d(plain, reference_depth=2.0, pools=pools))
    kinds = [SurfConv2d, SurfMaxPool2d, SurfConv2d, SurfAvgPool2d, nn.MaxPool2d]
    if not pools:
        kinds[1], kinds[3] = nn.MaxPool2d, nn.AvgPool2d
    assert [type(layer) for layer in plain] == kinds
    out = guided(x, depth=torch.full_like(depth, 2.0))
    torch.testing.assert_close(out, expected, rtol=1e-5, atol=1e-6)
    assert (guided(x, depth=depth) - expected).abs().max() > 1e-2


def test_arguments_and_options_reach_the_pools() -> None:
    plain = nn.Sequential(
        nn.MaxPool2d((3, 2), stride=(2, 1), padding=1, dilation=2, ceil_mode=True),
        nn.AvgPool2d(3, stride=2, padding=1, count_include_pad=False, divisor_override=5),
    )
    before = [dict(vars(layer)) for layer in plain]
    convert_conv2d(plain, reference_depth=2.0, pools=True, depth_window=0.5, max_scale=4.0)
    for layer, old in zip(plain, before, strict=True):
        assert layer.depth_window == 0.5 and layer.max_scale == 4.0
        names = {"kernel_size", "stride", "padding", "ceil_mode", "training"}
        assert {n: getattr(layer, n) for n in names} == {n: old[n] for n in names}
    assert plain[0].dilation == 2
    assert not plain[1].count_include_pad and plain[1].divisor_override == 5


def test_hooks_stay() -> None:
    calls = []
    plain = nn.Sequential(nn.MaxPool2d(2))
    handle = plain[0].register_forward_hook(lambda *args: calls.append(type(args[0])))
    guided = DepthGuided(convert_conv2d(plain, reference_depth=2.0, pools=True))
    x, depth = frames()
    guided(x, depth=depth)
    handle.remove()
    guided(x, depth=depth)
    assert calls == [SurfMaxPool2d]


class Own(nn.MaxPool2d):
    pass


@pytest.mark.parametrize(
    ("pool", "reason"),
    [
        (nn.MaxPool2d(2, return_indices=True), "return_indices"),
        (nn.MaxPool2d((1, 1), stride=2), "1 x 1"),
        (nn.AvgPool2d(1), "1 x 1"),
        (Own(2), "subclass of nn.MaxPool2d"),
        (nn.AdaptiveMaxPool2d(2), "counterpart"),
        (nn.LPPool2d(2, 2), "counterpart"),
    ],
)
def test_pools_left_alone(pool: nn.Module, reason: str) -> None:
    plain = nn.Sequential(pool, nn.AvgPool2d(2))
    convert_conv2d(plain, reference_depth=2.0, pools=True)
    assert plain[0] is pool and type(plain[1]) is SurfAvgPool2d
    row = conversion_report(plain).rows[0]
    assert row.now == "unchanged" and reason in row.why


def test_include_and_report() -> None:
    plain = net()
    convert_conv2d(plain, reference_depth=2.0, pools=True, include=lambda name, m: name != "1")
    rows = {row.name: row for row in conversion_report(copy.deepcopy(plain)).rows}
    assert rows["1"].why == "include returned False for it"
    assert rows["3"].was == "AvgPool2d(2 x 2)"
    assert rows["3"].now == "SurfAvgPool2d(reference_depth=2.0)"


def test_pools_alone_suffice() -> None:
    layer = convert_conv2d(nn.MaxPool2d(3, stride=2), reference_depth=2.0, pools=True)
    x, depth = frames()
    assert_same_bits(DepthGuided(layer)(x, depth=depth), layer(x, depth))
