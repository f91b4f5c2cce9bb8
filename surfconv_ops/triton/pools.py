"""The pools by the backend's own kernels, apart from the registered operators."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .. import avg_pool_ops, max_pool_ops, pool_ops, pool_reference
from ..checks import PairArgument
from ..pool_validation import check_avg_pool, check_max_pool
from . import pool_kernels
from .interpreter import check_device


class MaxPoolFunction(torch.autograd.Function):
    """The maximum and its winners; its backward is :class:`MaxPoolBackwardFunction`."""

    @staticmethod
    def forward(*arguments: Any) -> tuple[Tensor, Tensor]:
        return pool_kernels.max_pool2d(*arguments)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        max_pool_ops.save_forward(ctx, inputs, output)

    @staticmethod
    def backward(ctx: Any, grad_output: Tensor, _: Any) -> pool_ops.Grads:
        return pool_ops.differentiate(MaxPoolBackwardFunction.apply, ctx, grad_output)


class MaxPoolBackwardFunction(torch.autograd.Function):
    """The maximum's backward; its derivative is that of the reference's formula."""

    @staticmethod
    def forward(*arguments: Any) -> tuple[Tensor, Tensor]:
        return pool_kernels.max_pool2d_backward(*arguments)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        pool_ops.save_backward(ctx, inputs, output)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> pool_ops.Grads:
        return pool_ops.differentiate_backward(pool_reference.max_backward, ctx, *cotangents)


class AvgPoolFunction(torch.autograd.Function):
    """The average; its backward is :class:`AvgPoolBackwardFunction`."""

    @staticmethod
    def forward(*arguments: Any) -> Tensor:
        return pool_kernels.avg_pool2d(*arguments)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        avg_pool_ops.save_forward(ctx, inputs, output)

    @staticmethod
    def backward(ctx: Any, grad_output: Tensor) -> pool_ops.Grads:
        return pool_ops.differentiate(AvgPoolBackwardFunction.apply, ctx, grad_output)


class AvgPoolBackwardFunction(torch.autograd.Function):
    """The average's backward; its derivative is that of the reference's formula."""

    @staticmethod
    def forward(*arguments: Any) -> tuple[Tensor, Tensor]:
        return pool_kernels.avg_pool2d_backward(*arguments)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        pool_ops.save_backward(ctx, inputs, output)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> pool_ops.Grads:
        return pool_ops.differentiate_backward(pool_reference.avg_backward, ctx, *cotangents)


def surf_max_pool2d(
    input: Tensor,
    kernel_size: PairArgument,
    stride: PairArgument | None = None,
    padding: PairArgument = 0,
    dilation: PairArgument = 1,
    ceil_mode: bool = False,
    *,
    scale: Tensor,
    guide: Tensor | None = None,
    guide_tolerance: float = 0.0,
) -> Tensor:
    """:func:`surfconv_ops.surf_max_pool2d` by the CUDA backend's kernels, without a fallback.

    Args:
        input: Images on a CUDA device, or on the CPU in Triton's interpreter, as in
            :func:`surfconv_ops.triton.surf_conv2d`.
        kernel_size: As in :func:`surfconv_ops.surf_max_pool2d`, and so are the others.
        stride: An integer or (y, x), in pixels; None for ``kernel_size``.
        padding: An integer or (y, x), in pixels, at most half the kernel.
        dilation: An integer or (y, x), in pixels.
        ceil_mode: Whether a window may reach beyond the padding.
        scale: Factor on the tap spacing per output pixel, without unit.
        guide: Map at the input's resolution that limits what a tap may see, or None.
        guide_tolerance: Largest difference of guide to the centre that is still seen.

    Returns:
        The maxima, in the input's dtype and memory format.

    Shape:
        As for :func:`surfconv_ops.surf_max_pool2d`.

    Raises:
        ValueError: An argument's value, shape or device is wrong, or its device has no kernels.
        TypeError: An argument's type or dtype is wrong.

    Source:
        Chu et al., *SurfConv*, CVPR 2018, Eq. 7, applied to a pool's window.

    Example:
        >>> import torch
        >>> from surfconv_ops.triton import surf_max_pool2d      # doctest: +SKIP
        >>> x, scale = torch.randn(1, 3, 8, 8).cuda(), torch.ones(1, 4, 4).cuda()  # doctest: +SKIP
        >>> surf_max_pool2d(x, 2, scale=scale).shape             # doctest: +SKIP
        torch.Size([1, 3, 4, 4])
    """
    arguments, batched = check_max_pool(
        input, kernel_size, stride, padding, dilation, ceil_mode, scale, guide, guide_tolerance
    )
    check_device(arguments[0])
    output: Tensor = MaxPoolFunction.apply(*arguments)[0]
    return output if batched else output.squeeze(0)


def surf_avg_pool2d(
    input: Tensor,
    kernel_size: PairArgument,
    stride: PairArgument | None = None,
    padding: PairArgument = 0,
    ceil_mode: bool = False,
    count_include_pad: bool = True,
    divisor_override: int | None = None,
    *,
    scale: Tensor,
    guide: Tensor | None = None,
    guide_tolerance: float = 0.0,
) -> Tensor:
    """:func:`surfconv_ops.surf_avg_pool2d` by the CUDA backend's kernels, without a fallback.

    Args:
        input: Images on a CUDA device, or on the CPU in Triton's interpreter, as in
            :func:`surfconv_ops.triton.surf_conv2d`.
        kernel_size: As in :func:`surfconv_ops.surf_avg_pool2d`, and so are the others.
        stride: An integer or (y, x), in pixels; None for ``kernel_size``.
        padding: An integer or (y, x), in pixels, at most half the kernel.
        ceil_mode: Whether a window may reach beyond the padding.
        count_include_pad: Whether what lies outside the image counts in the divisor.
        divisor_override: A divisor for all windows, not 0; None for the window's own.
        scale: Factor on the tap spacing per output pixel, without unit.
        guide: Map at the input's resolution that limits what a tap may see, or None.
        guide_tolerance: Largest difference of guide to the centre that is still seen.

    Returns:
        The averages, in the input's dtype and memory format.

    Shape:
        As for :func:`surfconv_ops.surf_max_pool2d`.

    Raises:
        ValueError: An argument's value, shape or device is wrong, or its device has no kernels.
        TypeError: An argument's type or dtype is wrong.

    Source:
        Chu et al., *SurfConv*, CVPR 2018, Eq. 7, applied to a pool's window.

    Example:
        >>> import torch
        >>> from surfconv_ops.triton import surf_avg_pool2d      # doctest: +SKIP
        >>> x, scale = torch.randn(1, 3, 8, 8).cuda(), torch.ones(1, 4, 4).cuda()  # doctest: +SKIP
        >>> surf_avg_pool2d(x, 2, scale=scale).shape             # doctest: +SKIP
        torch.Size([1, 3, 4, 4])
    """
    arguments, batched = check_avg_pool(
        input,
        kernel_size,
        stride,
        padding,
        ceil_mode,
        count_include_pad,
        divisor_override,
        scale,
        guide,
        guide_tolerance,
    )
    check_device(arguments[0])
    output: Tensor = AvgPoolFunction.apply(*arguments)
    return output if batched else output.squeeze(0)
