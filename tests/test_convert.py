"""convert_conv2d: what changes, what is kept, what is left alone, and what the report says."""

from __future__ import annotations

import copy
import gc
import inspect
import pickle
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from guided_nets import NETS, Residual, frames
from helpers import assert_same_bits
from surfconv_ops import DepthGuided, DepthLevels, SurfConv2d, conversion_report, convert_conv2d
from test_errors import says

LEVELS = DepthLevels([1.5, 3.0], [1.0, 2.0, 4.0])


def convert(module: nn.Module, **options: Any) -> nn.Module:
    return convert_conv2d(module, **({"reference_depth": 2.0} | options))


@pytest.mark.parametrize("name", NETS)
@pytest.mark.parametrize("training", [True, False])
def test_depth_at_reference_changes_nothing(name: str, training: bool) -> None:
    net = NETS[name]().train(training)
    x, depth = frames()
    expected = copy.deepcopy(net)(x)
    guided = DepthGuided(convert(net))
    out = guided(x, depth=torch.full_like(depth, 2.0))
    torch.testing.assert_close(out, expected, rtol=1e-5, atol=1e-6)
    assert (guided(x, depth=depth) - expected).abs().max() > 1e-2
    # So do holes, at the default invalid_scale.
    out = guided(x, depth=torch.zeros_like(depth))
    torch.testing.assert_close(out, expected, rtol=1e-5, atol=1e-6)


def test_what_is_converted() -> None:
    net = NETS["encoder-decoder"]()
    before = dict(net.named_modules())
    parameters = dict(net.named_parameters())
    keys = list(net.state_dict())
    assert convert(net) is net
    after = dict(net.named_modules())
    assert list(after) == list(before) and list(net.state_dict()) == keys
    changed = {name for name in after if type(after[name]) is not type(before[name])}
    assert changed == {"stem", "down.conv1", "down.conv2", "shared", "head.0"}
    assert {type(after[name]) for name in changed} == {SurfConv2d}
    assert all(after[name] is before[name] for name in set(after) - changed)
    assert list(dict(net.named_parameters())) == list(parameters)
    assert all(p is parameters[name] for name, p in net.named_parameters())


def test_old_checkpoint_loads_and_optimizer_goes_on() -> None:
    net = NETS["residual"]()
    optimizer = torch.optim.SGD(net.parameters(), 0.1)
    state = copy.deepcopy(net.state_dict())
    convert(net)
    x, depth = frames()
    before = net[0].conv1.weight.detach().clone()
    DepthGuided(net)(x, depth=depth).square().mean().backward()
    optimizer.step()
    assert (net[0].conv1.weight != before).any()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        net.load_state_dict(state)
    assert_same_bits(net[0].conv1.weight, before)


OPTIONS: dict[str, dict[str, Any]] = {
    "continuous": {"depth_window": 0.5, "min_scale": 0.25, "max_scale": 3.0, "invalid_scale": 0.5},
    "levels": {"levels": LEVELS, "same_level_only": True},
    "pair": {"reference_depth": (2.0, 1.5)},
}


@pytest.mark.parametrize("case", OPTIONS)
def test_options_reach_the_layers(case: str) -> None:
    net = convert(nn.Sequential(nn.Conv2d(1, 2, 3)), **OPTIONS[case])
    for name, value in OPTIONS[case].items():
        assert getattr(net[0], name) == value


def test_shared_layer_stays_one() -> None:
    class Shared(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.a = nn.Conv2d(3, 3, 3, padding=1)
            self.b = nn.ModuleDict({"again": self.a, "other": nn.Conv2d(3, 3, 3)})
            self.c = nn.Sequential(self.b, self.a)

    asked = []
    net = convert(Shared(), include=lambda name, layer: not asked.append(name))
    assert type(net.a) is SurfConv2d
    assert net.a is net.b["again"] and net.a is net.c[1] and net.b["other"] is not net.a
    assert asked == ["a", "b.other"]
    assert [row.name for row in conversion_report(net).rows] == ["a", "b.other"]


def test_root_that_is_a_layer() -> None:
    conv = nn.Conv2d(3, 2, 3)
    layer = convert(conv)
    assert type(layer) is SurfConv2d and layer.weight is conv.weight and type(conv) is nn.Conv2d
    x, depth = frames()
    assert_same_bits(DepthGuided(layer)(x, depth=depth), layer(x, depth))
    (row,) = conversion_report(layer).rows
    assert row == ("", "Conv2d(3, 2, 3 x 3)", "SurfConv2d(reference_depth=2.0)", "")


def test_flags_are_kept() -> None:
    net = nn.Sequential(nn.Conv2d(1, 1, 3), nn.Conv2d(1, 1, 3, dtype=torch.float64)).eval()
    net[0].weight.requires_grad_(False)
    net[1].train()
    net[0].weight.grad = torch.ones(1, 1, 3, 3)
    net[0].tag = "mine"  # type: ignore[assignment]
    net[0].register_buffer("mask", torch.ones(1))
    net[0].register_module("child", nn.Identity())
    net[0].register_parameter("extra", nn.Parameter(torch.ones(2)))
    convert(net)
    assert not net[0].training and net[1].training
    assert not net[0].weight.requires_grad and net[0].bias.requires_grad
    assert net[0].weight.grad.sum() == 9 and net[0].tag == "mine"
    assert list(net[0].state_dict()) == ["weight", "bias", "extra", "mask"]
    assert net[1].weight.dtype == torch.float64 and isinstance(net[0].child, nn.Identity)


def test_hooks_are_kept() -> None:
    net = nn.Sequential(nn.Conv2d(3, 3, 3, padding=1), nn.Conv2d(3, 3, 3))
    layer, calls = net[0], []

    def note(name: str) -> Callable[..., None]:
        return lambda *args, **kwargs: calls.append(name)

    handles = {
        "forward": layer.register_forward_hook(note("forward")),
        "forward kw": layer.register_forward_hook(note("forward kw"), with_kwargs=True),
        "always": layer.register_forward_hook(note("always"), always_call=True),
        "pre": layer.register_forward_pre_hook(note("pre")),
        "pre kw": layer.register_forward_pre_hook(note("pre kw"), with_kwargs=True),
        "backward": layer.register_full_backward_hook(note("backward")),
        "backward pre": layer.register_full_backward_pre_hook(note("backward pre")),
        "save": layer.register_state_dict_post_hook(note("save")),
        "save pre": layer.register_state_dict_pre_hook(note("save pre")),
        "load": layer.register_load_state_dict_post_hook(note("load")),
        "load pre": layer.register_load_state_dict_pre_hook(
            lambda module, *rest: calls.append(f"load pre of {type(module).__name__}")
        ),
    }
    convert(net)
    del layer
    gc.collect()

    def use() -> list[str]:
        calls.clear()
        x, depth = frames()
        DepthGuided(net)(x.requires_grad_(), depth=depth).sum().backward()
        net.load_state_dict(net.state_dict())
        return sorted(calls)

    expected = sorted([*(set(handles) - {"load pre"}), "load pre of SurfConv2d"])
    assert use() == expected
    for handle in handles.values():
        handle.remove()
    assert use() == []


def test_kernels_that_reach_along_one_axis_are_converted() -> None:
    net = convert(nn.Sequential(nn.Conv2d(1, 1, (1, 3)), nn.Conv2d(1, 1, (2, 1))))
    assert [type(m) for m in net] == [SurfConv2d, SurfConv2d]


def test_include_narrows() -> None:
    net = NETS["encoder-decoder"]()
    asked: dict[str, nn.Module] = {}

    def include(name: str, layer: nn.Module) -> bool:
        asked[name] = layer
        return name.startswith("down")

    modules = dict(net.named_modules())
    convert(net, include=include)
    assert asked == {
        n: modules[n] for n in ("stem", "down.conv1", "down.conv2", "shared", "head.0")
    }
    report = conversion_report(net)
    assert [row.name for row in report.converted] == ["down.conv1", "down.conv2"]
    reasons = {row.name: row.why for row in report.unchanged}
    assert reasons["stem"] == reasons["head.0"] == "include returned False for it"
    assert "1 x 1" in reasons["down.shortcut"]
    convert(net)
    assert type(net.stem) is SurfConv2d and not hasattr(net.stem, "_surfconv_left_out")


def test_second_conversion_changes_nothing() -> None:
    net = convert(NETS["residual"]())
    before = dict(net.named_modules())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        convert(net)
    with pytest.warns(UserWarning, match="4 layers take depth already, 4 of them with other"):
        convert(net, reference_depth=3.0)
    assert all(module is before[name] for name, module in net.named_modules())
    assert net[0].conv1.reference_depth == 2.0
    net.append(nn.Conv2d(4, 4, 3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        convert(net, reference_depth=3.0)
    assert net[0].conv1 is before["0.conv1"] and net[2].reference_depth == 3.0


@pytest.mark.parametrize(
    ("net", "include", "words"),
    [
        (nn.Sequential(nn.Linear(1, 1), nn.Conv2d(1, 1, 1)), None, "no nn.Conv2d that can be"),
        (nn.Sequential(nn.Conv2d(1, 1, 3)), lambda n, m: False, "include returned False for all 1"),
    ],
)
def test_nothing_to_convert_is_a_warning(net: nn.Module, include: Any, words: str) -> None:
    with pytest.warns(UserWarning, match=words) as caught:
        assert convert(net, include=include) is net
    assert caught[0].filename == inspect.getsourcefile(convert)


def broken_include(name: str, layer: nn.Module) -> bool:
    if name == "1.conv2":
        raise KeyError(name)
    return True


MISTAKES: dict[str, tuple[dict[str, Any], type[Exception], list[str]]] = {
    "unknown": ({"depth_windows": 1.0}, TypeError,
                ["surf_options", "depth_windows", "depth_window", "invalid_scale"]),
    "conv's own": ({"stride": 2}, TypeError, ["surf_options", "'stride'"]),
    "reference": ({"reference_depth": -1.0}, ValueError, ["reference_depth", "-1"]),
    "levels": ({"levels": 4}, TypeError, ["levels", "int"]),
    "window": ({"levels": LEVELS, "depth_window": 1.0}, ValueError, ["depth_window", "levels"]),
    "include": ({"include": "down"}, TypeError, ["include", "str"]),
}  # fmt: skip


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes_change_nothing(case: str) -> None:
    change, error, words = MISTAKES[case]
    net = NETS["residual"]()
    before = dict(net.named_modules())
    says(error, words, lambda: convert(net, **change))
    # Options are checked where there is nothing to convert too.
    says(error, words, lambda: convert(nn.Identity(), **change))
    assert all(module is before[name] for name, module in net.named_modules())


def test_errors_of_include_change_nothing() -> None:
    net = NETS["residual"]()
    before = {name: dict(vars(module)) for name, module in net.named_modules()}
    with pytest.raises(KeyError, match="conv2"):
        convert(net, include=broken_include)
    assert {name: dict(vars(module)) for name, module in net.named_modules()} == before


def test_module_argument() -> None:
    says(TypeError, ["module", "list", "nn.Module"], lambda: convert([nn.Conv2d(1, 1, 3)]))  # type: ignore[arg-type]
    says(TypeError, ["module", "nn.Module"], lambda: conversion_report("net"))  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="reference_depth"):
        convert_conv2d(nn.Conv2d(1, 1, 3))  # type: ignore[call-arg]


def test_copies_of_a_converted_net() -> None:
    net = convert(nn.Sequential(Residual(3, 4, 2))).eval()
    x, depth = frames()
    expected = DepthGuided(net)(x, depth=depth)
    for copied in (copy.deepcopy(net), pickle.loads(pickle.dumps(net))):
        assert_same_bits(DepthGuided(copied)(x, depth=depth), expected)
        copied[0].conv1.weight.data.zero_()
    assert_same_bits(DepthGuided(net)(x, depth=depth), expected)


def test_list_beside_the_registered_layer_is_noticed_when_it_runs() -> None:
    class Listed(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.conv = nn.Conv2d(3, 3, 3)
            self.plain = [self.conv]

        def forward(self, x: Tensor) -> Tensor:
            out: Tensor = self.plain[0](x)
            return out

    x, depth = frames()
    with pytest.warns(UserWarning, match="1 of 1 layers that take depth did not run .*: conv"):
        DepthGuided(convert(Listed()))(x, depth=depth)
