"""The operators behind depth_to_scale: bits, derivatives, transforms, and maps that are shared."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad

import oracle_depth
from helpers import assert_same_bits
from surfconv_ops import depth_ops, depth_to_scale
from surfconv_ops.depth_ops import ScaleRule

pytestmark = pytest.mark.filterwarnings("ignore:depth_to_scale")

SOURCE = Path(__file__).parent.parent / "csrc" / "library.cpp"
SCHEMAS = {
    "depth_to_scale": depth_ops.FORWARD_SCHEMA,
    "depth_to_scale_backward": depth_ops.BACKWARD_SCHEMA,
}
INF = math.inf
ODD = [0.0, -0.0, -1.0, math.nan, INF, -INF, 1e-45, 1e-38, 1e-20, 1e-19, 1e-3, 1.0, 2.0, 5.0]
ODD += [1e4, 1e30, 3.4e38]
LIMITS = [(0.0, INF), (0.4, 2.0), (1.0, 1.0), (0.0, 0.0)]


def make_depth(dtype: torch.dtype, size: int) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    depth = torch.rand(size, dtype=torch.float64, generator=generator) * 9
    depth[: len(ODD)] = torch.tensor(ODD, dtype=torch.float64)[:size]
    return depth.to(dtype)


def rule_of(dtype: torch.dtype, limits: tuple[float, float], steepest: torch.dtype) -> ScaleRule:
    high = min(limits[1], torch.finfo(dtype).max)
    return ScaleRule(0.25, limits[0], high, torch.finfo(steepest).max)


@pytest.mark.core
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("limits", LIMITS, ids=str)
@pytest.mark.parametrize("reference", [2.0, 25.9, 1e-3, 1e-12, 1e300])
@pytest.mark.parametrize("size", [0, 1, 9, 257, 40000])
def test_bits_of_the_plain_form(
    dtype: torch.dtype, limits: tuple[float, float], reference: float, size: int
) -> None:
    """Compiled kernel, plain kernel, and what autograd makes of PyTorch's own operators."""
    depth, grad = make_depth(dtype, size), torch.randn(size, dtype=dtype)
    rule = rule_of(dtype, limits, dtype)
    scale = torch.ops.surfconv.depth_to_scale(depth, reference, *rule)
    assert_same_bits(scale, depth_ops._forward(depth, reference, *rule), "scale")
    slope = torch.ops.surfconv.depth_to_scale_backward(grad, depth, reference, *rule[1:])
    assert_same_bits(slope, depth_ops._backward(grad, depth, reference, *rule[1:]), "slope")
    leaf = depth.clone().requires_grad_()
    plain = depth_ops.plain_scale(leaf, reference, rule)
    assert_same_bits(scale, plain.detach(), "plain scale")
    if plain.requires_grad:
        assert_same_bits(slope, torch.autograd.grad(plain, leaf, grad)[0], "plain slope")


@pytest.mark.parametrize("limits", LIMITS, ids=str)
@pytest.mark.parametrize("reference", [2.0, 1e-3])
def test_against_the_oracle(limits: tuple[float, float], reference: float) -> None:
    depth = make_depth(torch.float64, 60)
    rule = rule_of(torch.float64, limits, torch.float64)
    bounds = {"invalid_scale": 0.25, "min_scale": limits[0], "max_scale": limits[1]}
    pairs = [oracle_depth.depth_to_scale(float(z), reference, None, **bounds) for z in depth]
    values, slopes = (torch.tensor(part, dtype=torch.float64) for part in zip(*pairs, strict=True))
    scale = torch.ops.surfconv.depth_to_scale(depth, reference, *rule)
    torch.testing.assert_close(scale, values, rtol=1e-15, atol=0)
    ones = torch.ones_like(depth)
    slope = torch.ops.surfconv.depth_to_scale_backward(ones, depth, reference, *rule[1:])
    torch.testing.assert_close(slope, slopes, rtol=1e-15, atol=0)


@pytest.mark.parametrize("reference", [0.7, 1e-3, 1e-10, 1e10])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16], ids=str)
def test_no_depth_has_an_infinite_derivative(reference: float, dtype: torch.dtype) -> None:
    depth = torch.logspace(-45, 38, 4000, dtype=torch.float64).to(dtype)[None].requires_grad_()
    scale = depth_to_scale(depth, reference)
    assert scale.isfinite().all()
    (grad,) = torch.autograd.grad(scale.sum(), depth)
    assert grad.dtype == dtype and grad.isfinite().all() and (grad < 0).any()


def test_a_half_depth_stops_where_its_own_dtype_ends() -> None:
    depth = torch.tensor([[4e-3, 8e-3, 1.0]], dtype=torch.float16, requires_grad=True)
    (half,) = torch.autograd.grad(depth_to_scale(depth, 2.0).sum(), depth)
    assert half[0, 0] == 0 and half[0, 1] < -3e4 and half[0, 2] == -2
    single = depth.detach().float().requires_grad_()
    (wide,) = torch.autograd.grad(depth_to_scale(single, 2.0).sum(), single)
    assert wide[0, 0] < -65504


@pytest.mark.core
def test_strides_and_threads() -> None:
    depth, grad = make_depth(torch.float32, 300 * 400).view(300, 400), torch.randn(300, 400)
    rule = rule_of(torch.float32, (0.1, 3.0), torch.float32)

    def both(z: Tensor, g: Tensor) -> tuple[Tensor, Tensor]:
        ops = torch.ops.surfconv
        backward = ops.depth_to_scale_backward(g, z, 2.0, *rule[1:])
        return ops.depth_to_scale(z, 2.0, *rule), backward

    expected = both(depth, grad)
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        for view in (
            lambda t: t.t(),
            lambda t: t[::3, 1::2],
            lambda t: t[:1].expand(5, 400),
            lambda t: t.view(3, 100, 20, 20).permute(2, 0, 3, 1),
        ):
            for ours, whole in zip(both(view(depth), view(grad)), expected, strict=True):
                assert ours.is_contiguous()
                assert_same_bits(ours, view(whole).contiguous())


@pytest.mark.parametrize("name", SCHEMAS)
def test_schemas(name: str) -> None:
    """Registered, in the C++ source and in Python: one text."""

    def normal(schema: str) -> str:
        return re.sub(r"\s+", "", schema)

    registered = str(getattr(torch.ops.surfconv, name).default._schema)
    assert normal(registered) == normal("surfconv::" + SCHEMAS[name])
    text = re.sub(r'"\s*"', "", SOURCE.read_text())
    found = [s for s in re.findall(r'"([^"]*)"', text) if s.startswith(name + "(")]
    assert [normal(s) for s in found] == [normal(SCHEMAS[name])]


@pytest.mark.parametrize(
    ("requires_grad", "dtype"), [(False, torch.float64), (True, torch.float32)], ids=str
)
def test_are_good_operators(requires_grad: bool, dtype: torch.dtype) -> None:
    depth = make_depth(dtype, 48).view(2, 4, 6).requires_grad_(requires_grad)
    rule = rule_of(dtype, (0.3, 4.0), dtype)
    torch.library.opcheck(torch.ops.surfconv.depth_to_scale.default, (depth, 2.0, *rule))
    grad = torch.randn(2, 4, 6, dtype=dtype, requires_grad=requires_grad)
    arguments = (grad, depth, 2.0, *rule[1:])
    torch.library.opcheck(torch.ops.surfconv.depth_to_scale_backward.default, arguments)


def refuse(call: Callable[[], Any], words: str) -> None:
    with pytest.raises(RuntimeError, match=words):
        call()


def test_refuses(compiled: None) -> None:
    ops, depth, limits = torch.ops.surfconv, torch.ones(3), (0.0, 9.0, 9.0)
    refuse(lambda: ops.depth_to_scale(depth.half(), 2.0, 1.0, *limits), "float32 or float64")
    refuse(lambda: ops.depth_to_scale(depth, 2.0, 1e300, *limits), "finite")
    refuse(lambda: ops.depth_to_scale(depth, 2.0, 1.0, math.nan, 9.0, 9.0), "finite")
    for grad in (torch.ones(2), torch.ones(3).double(), torch.ones(1, 3)):
        with pytest.raises(RuntimeError, match="shape"):
            ops.depth_to_scale_backward(grad, depth, 2.0, *limits)


def on_float64(depth: Tensor) -> Tensor:
    return depth_to_scale(depth, 2.0, min_scale=0.3, max_scale=4.0, invalid_scale=0.7)


SMOOTH = [-0.5, 0.9, 1.3, math.nan, 2.2, 4.7, 9.0, 0.2, -3.0]


def test_derivatives_of_every_order() -> None:
    depth = torch.tensor([SMOOTH], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(on_float64, (depth,), check_forward_ad=True)
    assert torch.autograd.gradgradcheck(on_float64, (depth,))
    value, factor = on_float64(depth), 1.0
    flows = (depth.detach() > 0.5) & (depth.detach() < 6)
    for order in range(1, 5):
        (value,) = torch.autograd.grad(value.sum(), depth, create_graph=True)
        factor *= -order
        expected = torch.where(flows, factor * 2.0 / depth.detach() ** (order + 1), 0.0)
        torch.testing.assert_close(value, expected, rtol=1e-12, atol=0)


def test_transforms_of_torch_func() -> None:
    depth = torch.tensor(SMOOTH, dtype=torch.float64).view(3, 1, 3)
    leaf = depth.clone().requires_grad_()
    (expected,) = torch.autograd.grad(on_float64(leaf).square().sum(), leaf)

    def loss(z: Tensor) -> Tensor:
        return on_float64(z).square().sum()

    torch.testing.assert_close(torch.func.grad(loss)(depth), expected)
    torch.testing.assert_close(torch.func.vmap(torch.func.grad(loss))(depth), expected)
    torch.testing.assert_close(
        torch.func.vmap(on_float64, 1, 1)(depth.transpose(0, 1)), on_float64(depth).transpose(0, 1)
    )
    flat = depth.reshape(1, 9)
    reverse, forward = (j(on_float64)(flat) for j in (torch.func.jacrev, torch.func.jacfwd))
    torch.testing.assert_close(reverse, forward)
    hessians = [
        outer(inner(loss))(flat)
        for outer in (torch.func.jacrev, torch.func.jacfwd)
        for inner in (torch.func.jacrev, torch.func.jacfwd)
    ]
    assert hessians[0].any()
    for hessian in hessians[1:]:
        torch.testing.assert_close(hessian, hessians[0])


def test_a_pair_under_vmap() -> None:
    depth = make_depth(torch.float32, 60).view(3, 4, 5)
    mapped = torch.func.vmap(lambda z: depth_to_scale(z, (2.0, 3.0)))(depth)
    assert_same_bits(mapped, depth_to_scale(depth, (2.0, 3.0)))


@pytest.mark.parametrize("requires_grad", [False, True])
def test_forward_mode(requires_grad: bool) -> None:
    depth = torch.tensor([SMOOTH], dtype=torch.float64).requires_grad_(requires_grad)
    tangent = torch.randn(1, 9, dtype=torch.float64)
    leaf = depth.detach().clone().requires_grad_()
    (slope,) = torch.autograd.grad(on_float64(leaf).sum(), leaf)
    with forward_ad.dual_level():
        dual = on_float64(forward_ad.make_dual(depth, tangent))
        torch.testing.assert_close(forward_ad.unpack_dual(dual).tangent, slope * tangent)


def test_forward_mode_of_the_operators_raises() -> None:
    depth, numbers = torch.ones(1, 3), (2.0, 1.0, 0.0, 9.0, 9.0)
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(depth, depth)
        with pytest.raises(NotImplementedError, match="depth_to_scale"):
            torch.ops.surfconv.depth_to_scale(dual, *numbers)
        with pytest.raises(NotImplementedError, match="depth_to_scale"):
            torch.ops.surfconv.depth_to_scale_backward(depth, dual, 2.0, *numbers[2:])


@pytest.mark.parametrize("requires_grad", [False, True])
def test_compiles_into_one_graph(requires_grad: bool) -> None:
    torch._dynamo.reset()
    compiled = torch.compile(on_float64, fullgraph=True, dynamic=True, backend="aot_eager")
    for width in (7, 12):
        depth = make_depth(torch.float32, 4 * width).view(4, width).requires_grad_(requires_grad)
        assert_same_bits(compiled(depth).detach(), on_float64(depth).detach())
        if requires_grad:
            ours, eager = (torch.autograd.grad(f(depth).sum(), depth)[0]
                           for f in (compiled, on_float64))  # fmt: skip
            assert_same_bits(ours, eager)


def test_the_operator_itself_compiles_and_exports() -> None:
    torch._dynamo.reset()
    numbers = (2.0, *rule_of(torch.float32, (0.3, 4.0), torch.float32))

    class Call(torch.nn.Module):
        def forward(self, depth: Tensor) -> Tensor:
            scale: Tensor = torch.ops.surfconv.depth_to_scale(depth, *numbers)
            return scale

    depth = make_depth(torch.float32, 60).view(5, 12).requires_grad_()
    expected = Call()(depth)
    (slope,) = torch.autograd.grad(expected.sum(), depth)
    compiled = torch.compile(Call(), fullgraph=True, dynamic=True, backend="aot_eager")(depth)
    assert_same_bits(compiled.detach(), expected.detach())
    assert_same_bits(torch.autograd.grad(compiled.sum(), depth)[0], slope)
    shapes = ({0: torch.export.Dim("rows", min=2, max=64)},)
    program = torch.export.export(Call(), (depth.detach(),), dynamic_shapes=shapes)
    more = make_depth(torch.float32, 84).view(7, 12)
    assert_same_bits(program.module()(more), Call()(more))
