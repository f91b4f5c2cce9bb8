"""torch.compile, torch.export, torch.func, checkpointing, forward-mode differentiation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch._dynamo.testing
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from helpers import assert_same_bits, make_problem
from surfconv_ops import DepthLevels, SurfConv2d, reference, surf_conv2d

MODES: dict[str, dict[str, Any]] = {
    "continuous": {},
    "window": {"depth_window": 0.5, "min_scale": 0.2, "max_scale": 4.0},
    "levels": {"levels": DepthLevels([2.0], [1.0, 3.0]), "same_level_only": True},
}


class Net(nn.Module):
    def __init__(self, mode: str) -> None:
        super().__init__()
        options = {"reference_depth": 2.0} | MODES[mode]
        self.first = SurfConv2d(3, 6, 3, padding=1, **options)
        self.second = SurfConv2d(6, 4, 3, padding=1, groups=2, **options)

    def forward(self, x: Tensor, depth: Tensor) -> Tensor:
        return self.second(torch.relu(self.first(x, depth)), depth)


def data(batch: int = 2, height: int = 9, width: int = 10) -> tuple[Tensor, Tensor]:
    depth = torch.rand(batch, height, width) * 3 + 0.5
    depth[:, ::3, ::4] = 0.0
    return torch.randn(batch, 3, height, width), depth


def gradients(net: nn.Module, call: Callable[..., Tensor], *inputs: Tensor) -> list[Tensor]:
    return list(torch.autograd.grad(call(*inputs).square().sum(), list(net.parameters())))


@pytest.mark.parametrize("mode", MODES)
def test_compile_without_graph_breaks(mode: str) -> None:
    torch._dynamo.reset()
    net = Net(mode)
    compiled = torch.compile(net, fullgraph=True, dynamic=True, backend="aot_eager")
    for size in ((2, 9, 10), (3, 5, 20)):
        x, depth = data(*size)
        torch.testing.assert_close(compiled(x, depth), net(x, depth))
        for ours, eager in zip(
            gradients(net, compiled, x, depth), gradients(net, net, x, depth), strict=True
        ):
            torch.testing.assert_close(ours, eager, rtol=1e-4, atol=1e-4)


def test_dynamic_shapes_compile_once() -> None:
    torch._dynamo.reset()
    counter = torch._dynamo.testing.CompileCounterWithBackend("aot_eager")
    net = Net("continuous")
    compiled = torch.compile(net, fullgraph=True, dynamic=True, backend=counter)
    compiled(*data(2, 9, 10))
    first = counter.frame_count
    for size in ((3, 12, 7), (4, 5, 20), (5, 11, 11)):
        compiled(*data(*size))
    assert counter.frame_count == first > 0


def test_compile_to_machine_code() -> None:
    torch._dynamo.reset()
    net = Net("continuous")
    compiled = torch.compile(net, fullgraph=True)
    x, depth = data()
    torch.testing.assert_close(compiled(x, depth), net(x, depth))
    for ours, eager in zip(
        gradients(net, compiled, x, depth), gradients(net, net, x, depth), strict=True
    ):
        torch.testing.assert_close(ours, eager, rtol=1e-4, atol=1e-4)


def test_compile_of_the_function_and_its_scale_gradient() -> None:
    torch._dynamo.reset()
    problem = make_problem(guide="levels", axes=2)
    compiled = torch.compile(surf_conv2d, fullgraph=True, backend="aot_eager")
    grad = torch.randn(problem.output_shape())
    expected = problem.gradients(surf_conv2d, grad)
    for name, value in problem.gradients(compiled, grad).items():
        torch.testing.assert_close(value, expected[name])


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("strict", [False, True])
def test_export(mode: str, strict: bool) -> None:
    net = Net(mode).eval()
    batch = torch.export.Dim("batch", min=1, max=64)
    rows, columns = (torch.export.Dim(name, min=4, max=512) for name in ("rows", "columns"))
    shapes = ({0: batch, 2: rows, 3: columns}, {0: batch, 1: rows, 2: columns})
    program = torch.export.export(net, data(), dynamic_shapes=shapes, strict=strict)
    parts = [m for m in program.graph_module.modules() if isinstance(m, torch.fx.GraphModule)]
    calls = [node.target for part in parts for node in part.graph.nodes]
    assert calls.count(torch.ops.surfconv.surf_conv2d.default) == 2
    for size in ((2, 9, 10), (3, 17, 6)):
        x, depth = data(*size)
        torch.testing.assert_close(program.module()(x, depth), net(x, depth))


def test_export_of_a_training_graph_decomposes() -> None:
    program = torch.export.export(Net("continuous"), data()).run_decompositions()
    x, depth = data()
    assert program.module()(x, depth).shape == (2, 4, 9, 10)


def test_functional_gradient() -> None:
    net = Net("continuous")
    x, depth = data()
    parameters = dict(net.named_parameters())

    def loss(values: dict[str, Tensor]) -> Tensor:
        return torch.func.functional_call(net, values, (x, depth)).square().sum()

    expected = gradients(net, net, x, depth)
    for ours, eager in zip(torch.func.grad(loss)(parameters).values(), expected, strict=True):
        torch.testing.assert_close(ours, eager)


def test_gradients_per_sample() -> None:
    net = Net("window")
    x, depth = data(4)
    parameters = {name: p.detach() for name, p in net.named_parameters()}

    def loss(values: dict[str, Tensor], one: Tensor, z: Tensor) -> Tensor:
        return torch.func.functional_call(net, values, (one[None], z[None])).square().sum()

    each = torch.func.vmap(torch.func.grad(loss), (None, 0, 0))(parameters, x, depth)
    for n in range(4):
        alone = gradients(net, net, x[n : n + 1], depth[n : n + 1])
        for ours, eager in zip(each.values(), alone, strict=True):
            torch.testing.assert_close(ours[n], eager, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "mapped",
    [
        ("input",),
        ("weight",),
        ("scale",),
        ("input", "scale", "guide"),
        ("weight", "bias"),
        ("input", "weight", "bias", "scale", "guide"),
    ],
)
@pytest.mark.parametrize("place", [0, 1])
def test_vmap_over_any_argument(mapped: tuple[str, ...], place: int) -> None:
    names = ("input", "weight", "bias", "scale", "guide")
    problems = [make_problem(guide="levels", axes=2, groups=1, seed=seed) for seed in range(3)]
    tensors = {n: [getattr(p, n) for p in problems] for n in names}

    def call(*arguments: Tensor) -> Tensor:
        x, weight, bias, scale, guide = arguments
        return surf_conv2d(x, weight, bias, scale=scale, guide=guide, padding=1)

    dims = tuple((place if n != "bias" else 0) if n in mapped else None for n in names)
    stacked = [torch.stack(tensors[n], d) if d is not None else tensors[n][0]
               for n, d in zip(names, dims, strict=True)]  # fmt: skip
    out = torch.func.vmap(call, dims)(*stacked)
    for i in range(3):
        one = [tensors[n][i if n in mapped else 0] for n in names]
        torch.testing.assert_close(out[i], call(*one), rtol=1e-5, atol=1e-5)
    grads = torch.func.vmap(
        torch.func.grad(lambda *a: call(*a).square().sum(), (0, 1, 2, 3)), dims
    )(*stacked)
    for i in range(3):
        one = [tensors[n][i if n in mapped else 0] for n in names]
        wanted = torch.func.grad(lambda *a: call(*a).square().sum(), (0, 1, 2, 3))(*one)
        for ours, eager in zip(grads, wanted, strict=True):
            torch.testing.assert_close(ours[i], eager, rtol=1e-4, atol=1e-4)


def test_jacobian_and_hessian() -> None:
    problem = make_problem(1, 1, 1, (3, 3), dtype=torch.float64)

    def loss(weight: Tensor, operator: Any = surf_conv2d) -> Tensor:
        return operator(problem.input, weight, scale=problem.scale, padding=1).exp().sum()

    jacobian = torch.func.jacrev(
        lambda w: surf_conv2d(problem.input, w, scale=problem.scale, padding=1)
    )
    slow = torch.func.jacrev(
        lambda w: reference.surf_conv2d(problem.input, w, scale=problem.scale, padding=1)
    )
    torch.testing.assert_close(jacobian(problem.weight), slow(problem.weight))
    hessian = torch.func.jacrev(torch.func.jacrev(loss))(problem.weight)
    wanted = torch.func.jacrev(torch.func.jacrev(lambda w: loss(w, reference.surf_conv2d)))(
        problem.weight
    )
    torch.testing.assert_close(hessian, wanted)


@pytest.mark.parametrize("reentrant", [False, True])
def test_checkpointing(reentrant: bool) -> None:
    net = Net("levels")
    x, depth = data()
    x.requires_grad_()

    def checkpointed(image: Tensor, z: Tensor) -> Tensor:
        out: Tensor = checkpoint(net, image, z, use_reentrant=reentrant)
        return out

    # Re-entrant checkpointing only knows backward().
    results = []
    for call in (net, checkpointed):
        net.zero_grad()
        call(x, depth).square().sum().backward()
        results.append([p.grad.clone() for p in net.parameters() if p.grad is not None])
    assert len(results[0]) == 4
    for ours, eager in zip(*results, strict=True):
        assert_same_bits(ours, eager)


def forward_mode(call: Callable[[Tensor], Tensor], primal: Tensor) -> Tensor:
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(primal, torch.ones_like(primal))
        return torch.autograd.forward_ad.unpack_dual(call(dual)).tangent


@pytest.mark.parametrize("needed", ["input", "weight", "bias", "scale"])
@pytest.mark.parametrize("how", ["public", "operator"])
def test_forward_mode_raises(needed: str, how: str) -> None:
    """A tangent silently dropped would be a derivative of zero."""
    problem = make_problem()
    names = ("input", "weight", "bias", "scale")

    def call(value: Tensor) -> Tensor:
        x, weight, bias, scale = (value if n == needed else getattr(problem, n) for n in names)
        if how == "public":
            return surf_conv2d(x, weight, bias, scale=scale, padding=1)
        return torch.ops.surfconv.surf_conv2d(
            x, weight, bias, scale, None, 0.0, [1, 1], [1, 1], [1, 1], 1
        )

    with pytest.raises((RuntimeError, NotImplementedError)):
        forward_mode(call, getattr(problem, needed))


def test_jvp_raises() -> None:
    problem = make_problem()
    with pytest.raises((RuntimeError, NotImplementedError)):
        torch.func.jvp(lambda w: surf_conv2d(problem.input, w, scale=problem.scale, padding=1),
                       (problem.weight,), (problem.weight,))  # fmt: skip


def test_inference_mode() -> None:
    net = Net("continuous")
    x, depth = data()
    with torch.inference_mode():
        out = net(x, depth)
    assert_same_bits(out.clone(), net(x, depth))
