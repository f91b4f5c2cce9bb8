"""The operators that turn depth into scale, and everything PyTorch must know of them.

A depth z has the scale ``reference_depth / z``, computed as ``(1 / z) * reference_depth``, within
limits; its derivative is ``-reference_depth / z**2``. Compiled and plain form give the same bits.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from . import direct
from ._loader import missing_library_reason
from .checks import valid_depth

FORWARD_SCHEMA = (
    "depth_to_scale(Tensor depth, float reference_depth, float invalid, float low, float high,"
    " float steepest) -> Tensor"
)
BACKWARD_SCHEMA = (
    "depth_to_scale_backward(Tensor grad, Tensor depth, float reference_depth, float low,"
    " float high, float steepest) -> Tensor"
)
_FORWARD = "surfconv::depth_to_scale"
_BACKWARD = "surfconv::depth_to_scale_backward"


class ScaleRule(NamedTuple):
    """What becomes of scales that depth does not give, or not within bounds."""

    invalid: float
    low: float
    high: float
    # Larger derivatives do not flow: they would not be finite in the dtype the depth came in.
    steepest: float


def scale_of(depth: Tensor, reference_depth: float, rule: ScaleRule) -> Tensor:
    """Scale of float32 or float64 depth, differentiable in every way."""
    if torch.compiler.is_compiling():
        return plain_scale(depth, reference_depth, rule)
    scale: Tensor = direct.apply(
        DepthToScaleFunction,
        torch.ops.surfconv.depth_to_scale.default,
        depth,
        reference_depth,
        *rule,
    )
    return scale


def plain_scale(depth: Tensor, reference_depth: float, rule: ScaleRule) -> Tensor:
    """:func:`scale_of` by PyTorch's own operators, which a compiler fuses with their neighbours."""
    if not (depth.requires_grad and torch.is_grad_enabled()):
        return _forward(depth, reference_depth, *rule)
    constant = _forward(depth.detach(), reference_depth, *rule)
    flows = _flows(depth.detach(), reference_depth, *rule[1:])
    return torch.where(flows, reference_depth / torch.where(flows, depth, 1.0), constant)


def _forward(
    depth: Tensor,
    reference_depth: float,
    invalid: float,
    low: float,
    high: float,
    steepest: float,
) -> Tensor:
    scale = (reference_depth / depth).clamp(low, high)
    return torch.where(valid_depth(depth), scale, invalid)


def _flows(
    depth: Tensor, reference_depth: float, low: float, high: float, steepest: float
) -> Tensor:
    """Where a derivative flows: depth valid, scale not clamped, derivative not too steep."""
    valid = valid_depth(depth)
    safe = torch.where(valid, depth, 1.0)
    wanted = reference_depth / safe
    finite = (wanted / safe <= steepest) & safe.reciprocal().square().isfinite()
    return valid & (wanted >= low) & (wanted <= high) & finite


def _slopes(
    depth: Tensor, reference_depth: float, low: float, high: float, steepest: float
) -> tuple[Tensor, Tensor]:
    """First and second derivative of the scale; they can be differentiated further."""
    flows = _flows(depth.detach(), reference_depth, low, high, steepest)
    inverse = torch.where(flows, depth, 1.0).reciprocal()
    first = -reference_depth * inverse.square()
    return torch.where(flows, first, 0.0), torch.where(flows, -2.0 * first * inverse, 0.0)


def _backward(
    grad: Tensor, depth: Tensor, reference_depth: float, low: float, high: float, steepest: float
) -> Tensor:
    flows = _flows(depth, reference_depth, low, high, steepest)
    inverse = torch.where(flows, depth, 1.0).reciprocal()
    return torch.where(flows, -(grad * reference_depth) * inverse.square(), 0.0)


def forward_kernel(depth: Tensor, *numbers: float) -> Tensor:
    return _forward(depth, *numbers).contiguous()


def backward_kernel(grad: Tensor, depth: Tensor, *numbers: float) -> Tensor:
    return _backward(grad, depth, *numbers).contiguous()


def _save_forward(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    depth, reference_depth, _, *limits = inputs
    ctx.save_for_backward(depth)
    ctx.save_for_forward(depth)
    ctx.numbers = (reference_depth, *limits)


def _save_backward(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    grad, depth, *numbers = inputs
    ctx.save_for_backward(grad, depth)
    ctx.save_for_forward(grad, depth)
    ctx.numbers = numbers


def _differentiate_forward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    (depth,) = ctx.saved_tensors
    return _backward_of(grad, depth, *ctx.numbers), None, None, None, None, None


def _differentiate_backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
    grad, depth = ctx.saved_tensors
    first, second = _slopes(depth, *ctx.numbers)
    needs_grad, needs_depth, *_ = ctx.needs_input_grad
    return (
        cotangent * first if needs_grad else None,
        cotangent * grad * second if needs_depth else None,
        *(None for _ in ctx.numbers),
    )


def _backward_of(grad: Tensor, depth: Tensor, *numbers: float) -> Tensor:
    result: Tensor = direct.apply(
        DepthToScaleBackwardFunction,
        torch.ops.surfconv.depth_to_scale_backward.default,
        grad,
        depth,
        *numbers,
    )
    return result


class DepthToScaleFunction(torch.autograd.Function):
    """The forward operator; its derivative is :class:`DepthToScaleBackwardFunction`."""

    @staticmethod
    def forward(
        depth: Tensor,
        reference_depth: float,
        invalid: float,
        low: float,
        high: float,
        steepest: float,
    ) -> Tensor:
        operator = torch.ops.surfconv.depth_to_scale.default
        scale: Tensor = direct.run_kernel(
            operator, depth, reference_depth, invalid, low, high, steepest
        )
        return scale

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        _save_forward(ctx, inputs, output)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        return _differentiate_forward(ctx, grad)

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, *_: Any) -> Tensor:
        (depth,) = ctx.saved_tensors
        return _backward_of(tangent, depth, *ctx.numbers)

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, ...], depth: Tensor, *numbers: float
    ) -> tuple[Tensor, int | None]:
        return DepthToScaleFunction.apply(depth, *numbers), in_dims[0]


class DepthToScaleBackwardFunction(torch.autograd.Function):
    """The derivative's operator; its own derivatives are plain products with the slopes."""

    @staticmethod
    def forward(
        grad: Tensor,
        depth: Tensor,
        reference_depth: float,
        low: float,
        high: float,
        steepest: float,
    ) -> Tensor:
        operator = torch.ops.surfconv.depth_to_scale_backward.default
        result: Tensor = direct.run_kernel(
            operator, grad, depth, reference_depth, low, high, steepest
        )
        return result

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        _save_backward(ctx, inputs, output)

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        return _differentiate_backward(ctx, cotangent)

    @staticmethod
    def jvp(ctx: Any, grad_tangent: Tensor, depth_tangent: Tensor, *_: Any) -> Tensor:
        grad, depth = ctx.saved_tensors
        first, second = _slopes(depth, *ctx.numbers)
        tangent: Tensor = grad_tangent * first + depth_tangent * grad * second
        return tangent

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, ...], grad: Tensor, depth: Tensor, *numbers: float
    ) -> tuple[Tensor, int]:
        tensors = _in_front(info.batch_size, in_dims, grad, depth)
        return DepthToScaleBackwardFunction.apply(*tensors, *numbers), 0


def _in_front(size: int, dims: tuple[int | None, ...], *tensors: Tensor) -> list[Tensor]:
    """The tensors with the mapped dimension first; one that has none is repeated."""
    return [
        tensor.expand(size, *tensor.shape) if dim is None else tensor.movedim(dim, 0)
        for tensor, dim in zip(tensors, dims, strict=False)
    ]


def _fake(depth: Tensor, *numbers: Any) -> Tensor:
    return depth.new_empty(depth.shape)


def register(library: torch.library.Library) -> None:
    """Everything about both operators that is not in the compiled library."""
    if missing_library_reason is not None:
        library.define(FORWARD_SCHEMA)
        library.define(BACKWARD_SCHEMA)
    library.impl("depth_to_scale", forward_kernel, "CompositeExplicitAutograd")
    library.impl("depth_to_scale_backward", backward_kernel, "CompositeExplicitAutograd")
    forward = torch.ops.surfconv.depth_to_scale.default
    backward = torch.ops.surfconv.depth_to_scale_backward.default

    def vmap_forward(
        info: Any, in_dims: tuple[int | None, ...], depth: Tensor, *numbers: float
    ) -> tuple[Tensor, int | None]:
        return forward(depth, *numbers), in_dims[0]

    def vmap_backward(
        info: Any, in_dims: tuple[int | None, ...], grad: Tensor, depth: Tensor, *numbers: float
    ) -> tuple[Tensor, int]:
        tensors = _in_front(info.batch_size, in_dims, grad, depth)
        return backward(*tensors, *numbers), 0

    def differentiate_forward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (depth,) = ctx.saved_tensors
        return backward(grad, depth, *ctx.numbers), None, None, None, None, None

    torch.library.register_fake(_FORWARD, _fake, lib=library)
    torch.library.register_fake(_BACKWARD, _fake, lib=library)
    torch.library.register_vmap(_FORWARD, vmap_forward, lib=library)
    torch.library.register_vmap(_BACKWARD, vmap_backward, lib=library)
    torch.library.register_autograd(
        _FORWARD, differentiate_forward, setup_context=_save_forward, lib=library
    )
    torch.library.register_autograd(
        _BACKWARD, _differentiate_backward, setup_context=_save_backward, lib=library
    )
