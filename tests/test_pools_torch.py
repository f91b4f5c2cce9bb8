"""The pools' operators under gradcheck, opcheck, torch.func, torch.compile, export, autocast."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from helpers import assert_same_bits
from operators import name_of
from pools import Problem, make
from surfconv_ops import DepthLevels, SurfAvgPool2d, SurfMaxPool2d

ops = torch.ops.surfconv
MODES = ("max", "avg")
each_mode = pytest.mark.parametrize("mode", MODES)
SMALL: list[dict[str, Any]] = [
    {"mode": "max"},
    {"mode": "max", "axes": 2, "guide": "depth", "guide_tolerance": 0.8, "kernel": (2, 3)},
    {"mode": "max", "dilation": 2, "kernel": 2, "ceil_mode": True},
    {"mode": "avg", "axes": 2},
    {"mode": "avg", "count_include_pad": False, "guide": "levels"},
    {"mode": "avg", "count_include_pad": False, "axes": 2, "kernel": (2, 3), "ceil_mode": True},
    {"mode": "avg", "divisor_override": 3, "kernel": 2, "padding": 0},
]


def small(case: dict[str, Any], **others: Any) -> Problem:
    usual = {"batch": 1, "channels": 2, "size": (4, 5), "dtype": torch.float64}
    return make(**(usual | case | others))


@pytest.mark.parametrize("case", SMALL, ids=name_of)
def test_gradcheck(case: dict[str, Any]) -> None:
    problem = small(case)

    def call(x: Tensor, scale: Tensor) -> Tensor:
        return replace(problem, input=x, scale=scale).run()

    leaves = (problem.input.requires_grad_(), problem.scale.requires_grad_())
    assert torch.autograd.gradcheck(call, leaves, eps=1e-7)
    assert torch.autograd.gradgradcheck(call, leaves, eps=1e-7, fast_mode=True)


def operator_arguments(problem: Problem) -> tuple[Any, ...]:
    pool = problem.pool
    own: tuple[Any, ...] = (list(pool.dilation),)
    if problem.mode == "avg":
        own = (pool.count_include_pad, pool.divisor_override)
    return (
        problem.input,
        problem.scale,
        problem.guide,
        problem.guide_tolerance,
        list(pool.kernel),
        list(pool.stride),
        list(pool.padding),
        *own,
    )


OPCHECKED = [
    SMALL[0],
    SMALL[1] | {"channels": 4, "layout": "channels_last", "dtype": torch.float32},
    SMALL[4],
    SMALL[3] | {"channels": 4, "layout": "channels_last", "dtype": torch.bfloat16},
]


@pytest.mark.parametrize("case", OPCHECKED, ids=name_of)
@pytest.mark.parametrize("requires_grad", [False, True])
def test_opcheck(case: dict[str, Any], requires_grad: bool) -> None:
    problem = small(case)
    x, scale, *rest = operator_arguments(problem)
    x.requires_grad_(requires_grad), scale.requires_grad_(requires_grad)
    forward = ops.surf_max_pool2d if problem.mode == "max" else ops.surf_avg_pool2d
    torch.library.opcheck(forward.default, (x, scale, *rest))


@pytest.mark.parametrize("case", OPCHECKED, ids=name_of)
@pytest.mark.parametrize("needs", [(True, True), (True, False), (False, True)])
def test_opcheck_backward(case: dict[str, Any], needs: tuple[bool, bool]) -> None:
    problem = small(case)
    x, scale, guide, *rest = operator_arguments(problem)
    out = problem.run()
    if problem.mode == "max":
        winner = ops.surf_max_pool2d(x, scale, guide, *rest)[1]
        arguments = (torch.randn_like(out), x, scale, guide, winner, *rest, *needs)
        torch.library.opcheck(ops.surf_max_pool2d_backward.default, arguments)
    else:
        arguments = (torch.randn_like(out), x, scale, guide, *rest, *needs)
        torch.library.opcheck(ops.surf_avg_pool2d_backward.default, arguments)


@each_mode
def test_opcheck_of_the_second_derivative(mode: str) -> None:
    problem = small({"mode": mode}, kernel=(1, 2), padding=0, size=(2, 4))
    x, scale, guide, *rest = operator_arguments(problem)
    grad = torch.randn_like(problem.run()).requires_grad_()
    x.requires_grad_(), scale.requires_grad_()
    if mode == "max":
        winner = ops.surf_max_pool2d(x.detach(), scale.detach(), guide, *rest)[1]
        arguments = (grad, x, scale, guide, winner, *rest, True, True)
        torch.library.opcheck(ops.surf_max_pool2d_backward.default, arguments)
    else:
        arguments = (grad, x, scale, guide, *rest, True, True)
        torch.library.opcheck(ops.surf_avg_pool2d_backward.default, arguments)


class Net(nn.Module):
    def __init__(self, **options: Any) -> None:
        super().__init__()
        self.first = SurfMaxPool2d(3, 2, 1, ceil_mode=True, reference_depth=2.0, **options)
        self.second = SurfAvgPool2d(3, 1, 1, count_include_pad=False, reference_depth=2.0,
                                    **options)  # fmt: skip

    def forward(self, x: Tensor, depth: Tensor) -> Tensor:
        out: Tensor = self.first(torch.sin(self.second(x, depth)), depth)
        return out


NETS: dict[str, dict[str, Any]] = {
    "continuous": {},
    "window": {"depth_window": 0.5, "min_scale": 0.2, "max_scale": 4.0},
    "levels": {"levels": DepthLevels([2.0], [1.0, 3.0]), "same_level_only": True},
}


def data(batch: int = 2, height: int = 9, width: int = 10) -> tuple[Tensor, Tensor]:
    depth = torch.rand(batch, height, width) * 3 + 0.5
    depth[:, ::3, ::4] = 0.0
    return torch.randn(batch, 3, height, width).requires_grad_(), depth


def input_gradient(call: Callable[..., Tensor], x: Tensor, depth: Tensor) -> Tensor:
    return torch.autograd.grad(call(x, depth).square().sum(), x)[0]


@pytest.mark.parametrize("options", NETS)
def test_compile_without_graph_breaks(options: str) -> None:
    torch._dynamo.reset()
    net = Net(**NETS[options])
    compiled = torch.compile(net, fullgraph=True, dynamic=True, backend="aot_eager")
    for size in ((2, 9, 10), (3, 6, 21)):
        x, depth = data(*size)
        torch.testing.assert_close(compiled(x, depth), net(x, depth))
        torch.testing.assert_close(input_gradient(compiled, x, depth),
                                   input_gradient(net, x, depth))  # fmt: skip


def test_compile_to_machine_code() -> None:
    torch._dynamo.reset()
    net = Net()
    compiled = torch.compile(net, fullgraph=True)
    x, depth = data()
    torch.testing.assert_close(compiled(x, depth), net(x, depth))
    torch.testing.assert_close(input_gradient(compiled, x, depth), input_gradient(net, x, depth))


@pytest.mark.parametrize("strict", [False, True])
def test_export(strict: bool) -> None:
    net = Net(**NETS["levels"]).eval()
    batch = torch.export.Dim("batch", min=1, max=64)
    rows, columns = (torch.export.Dim(name, min=4, max=512) for name in ("rows", "columns"))
    shapes = ({0: batch, 2: rows, 3: columns}, {0: batch, 1: rows, 2: columns})
    example = tuple(t.detach() for t in data())
    program = torch.export.export(net, example, dynamic_shapes=shapes, strict=strict)
    parts = [m for m in program.graph_module.modules() if isinstance(m, torch.fx.GraphModule)]
    calls = [node.target for part in parts for node in part.graph.nodes]
    assert calls.count(ops.surf_max_pool2d.default) == 1
    assert calls.count(ops.surf_avg_pool2d.default) == 1
    x, depth = data(3, 17, 6)
    torch.testing.assert_close(program.module()(x, depth), net(x, depth))


@each_mode
@pytest.mark.parametrize("mapped", [("input",), ("scale",), ("input", "scale", "guide")])
@pytest.mark.parametrize("place", [0, 1])
def test_vmap(mode: str, mapped: tuple[str, ...], place: int) -> None:
    names = ("input", "scale", "guide")
    problems = [make(mode, guide="levels", axes=2, seed=seed) for seed in range(3)]
    dims = tuple(place if n in mapped else None for n in names)

    def call(x: Tensor, scale: Tensor, guide: Tensor) -> Tensor:
        return replace(problems[0], input=x, scale=scale, guide=guide).run()

    def slope(*a: Tensor) -> tuple[Tensor, ...]:
        return torch.func.grad(lambda *b: call(*b).square().sum(), (0, 1))(*a)

    arguments = [
        torch.stack([getattr(p, n) for p in problems], place)
        if n in mapped
        else getattr(problems[0], n)
        for n in names
    ]
    out, grads = torch.func.vmap(call, dims)(*arguments), torch.func.vmap(slope, dims)(*arguments)
    for i in range(3):
        one = [getattr(problems[i if n in mapped else 0], n) for n in names]
        assert_same_bits(out[i], call(*one))
        for ours, alone in zip(grads, slope(*one), strict=True):
            assert_same_bits(ours[i], alone)


@each_mode
def test_hessian(mode: str) -> None:
    problem = small({"mode": mode}, channels=1, size=(3, 3))

    def loss(scale: Tensor) -> Tensor:
        return replace(problem, scale=scale).run().exp().sum()

    hessian = torch.func.jacrev(torch.func.jacrev(loss))(problem.scale).flatten(0, 3).flatten(1)
    step = 1e-6
    for i in range(problem.scale.numel()):
        ahead, behind = problem.scale.clone(), problem.scale.clone()
        ahead.view(-1)[i] += step
        behind.view(-1)[i] -= step
        rise = torch.func.grad(loss)(ahead) - torch.func.grad(loss)(behind)
        torch.testing.assert_close(hessian[:, i], rise.flatten() / (2 * step), rtol=1e-4, atol=1e-5)


@each_mode
@pytest.mark.parametrize("needed", ["input", "scale"])
@pytest.mark.parametrize("how", ["public", "operator"])
def test_forward_mode_raises(mode: str, needed: str, how: str) -> None:
    problem = make(mode)

    def call(value: Tensor) -> Tensor:
        changed = replace(problem, **{needed: value})
        if how == "public":
            return changed.run()
        forward = ops.surf_max_pool2d if mode == "max" else ops.surf_avg_pool2d
        result = forward(*operator_arguments(changed))
        return result[0] if mode == "max" else result

    primal = getattr(problem, needed)
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(primal, torch.ones_like(primal))
        with pytest.raises((RuntimeError, NotImplementedError)):
            call(dual)


@each_mode
def test_autocast_does_not_cast(mode: str) -> None:
    problem = make(mode)
    with torch.autocast("cpu", torch.bfloat16):
        assert_same_bits(problem.run(), make(mode).run())
        assert problem.run().dtype == torch.float32


@each_mode
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
def test_meta_tensors_have_the_real_strides(mode: str, layout: str) -> None:
    problem = make(mode, 2, 5, layout=layout)
    real = problem.run()
    meta = replace(problem, input=problem.input.to("meta"), scale=problem.scale.to("meta")).run()
    assert (meta.shape, meta.stride(), meta.dtype) == (real.shape, real.stride(), real.dtype)
