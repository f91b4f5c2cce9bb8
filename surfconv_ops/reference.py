"""The operator in plain PyTorch: the readable specification, and the kernel of last resort.

:func:`surf_conv2d` is what a reader should trust. It runs on any device and is differentiable as
often as one likes, because autograd derives all of it. :func:`forward` and :func:`backward` are
the same operator and its gradients at the level of the registered operators: no argument
checking, pairs for pairs, and a backward that does not need autograd. Both are built from
differentiable operations, so the backward's own derivative is the double backward.

All of them walk over the taps one at a time and never unfold the image: without autograd's
recording, memory stays at a few images whatever the kernel size.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .autocast import autocast_disabled, cast_to_autocast_dtype
from .checks import PaddingArgument, PairArgument
from .geometry import Pair
from .layout import lay_out, memory_format_of, with_own_gradient
from .sampling import pixels, sample, seen, taps
from .validation import check_surf_conv2d


def surf_conv2d(
    input: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    *,
    scale: Tensor,
    guide: Tensor | None = None,
    guide_tolerance: float = 0.0,
    stride: PairArgument = 1,
    padding: PaddingArgument = 0,
    dilation: PairArgument = 1,
    groups: int = 1,
) -> Tensor:
    """:func:`surfconv_ops.surf_conv2d` in plain PyTorch, with the same arguments and meaning.

    Use it to check the compiled operator, to read what it does, or for derivatives of any order.
    It is many times slower, and under autograd it keeps every tap's samples in memory.

    Args:
        input: Images, ``(N, C, H, W)`` or ``(C, H, W)``.
        weight: Filters, ``(O, C/groups, kH, kW)``.
        bias: One value per output channel, ``(O,)``, or None.
        scale: Factor on the tap spacing per output pixel, without unit.
        guide: Map at the input's resolution that limits what a tap may see, or None.
        guide_tolerance: Largest difference of guide to the centre that is still seen, in the
            guide's unit.
        stride: As in :class:`torch.nn.Conv2d`.
        padding: As in :class:`torch.nn.Conv2d`, ``'same'`` and ``'valid'`` included.
        dilation: As in :class:`torch.nn.Conv2d`.
        groups: As in :class:`torch.nn.Conv2d`.

    Returns:
        The response, in the input's dtype. float16 and bfloat16 are computed in float32 and
        rounded once, at the end.

    Shape:
        As for :func:`surfconv_ops.surf_conv2d`.

    Raises:
        ValueError: An argument's value or shape is wrong.
        TypeError: An argument's type or dtype is wrong.

    Source:
        Chu et al., *SurfConv: Bridging 3D and 2D Convolution for RGBD Images*, CVPR 2018, Eq. 7.

    Example:
        >>> import torch
        >>> from surfconv_ops import reference
        >>> x, w = torch.randn(1, 3, 8, 8), torch.randn(4, 3, 3, 3)
        >>> out = reference.surf_conv2d(x, w, scale=torch.ones(1, 8, 8), padding=1)
        >>> torch.allclose(out, torch.nn.functional.conv2d(x, w, padding=1), atol=1e-5)
        True
    """
    input, weight, bias = cast_to_autocast_dtype(input, weight, bias)
    arguments, batched = check_surf_conv2d(
        input, weight, bias, scale, guide, guide_tolerance, stride, padding, dilation, groups
    )
    arguments = arguments._replace(
        input=with_own_gradient(arguments.input),
        weight=with_own_gradient(arguments.weight),
        scale=with_own_gradient(arguments.scale),
    )
    output = lay_out(forward(*arguments), memory_format_of(arguments.input))
    return output if batched else output.squeeze(0)


def _compute_dtype(input: Tensor) -> torch.dtype:
    return torch.float64 if input.dtype == torch.float64 else torch.float32


def forward(
    input: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    scale: Tensor,
    guide: Tensor | None,
    guide_tolerance: float,
    stride: Pair,
    padding: Pair,
    dilation: Pair,
    groups: int,
) -> Tensor:
    """``torch.ops.surfconv.surf_conv2d`` in differentiable operations.

    input is (N, C, H, W), scale (N, 1 | 2, Ho, Wo), guide (N, H, W). ``padding`` is what comes
    before the first row and column; the output has the scale's size.
    """
    dtype = _compute_dtype(input)
    batch, channels, height, width = input.shape
    out_channels, _, kernel_y, kernel_x = weight.shape
    count = scale.shape[2] * scale.shape[3]
    with autocast_disabled(input.device.type):
        image = input.to(dtype).reshape(batch, channels, height * width)
        filters = weight.to(dtype).reshape(
            groups, out_channels // groups, channels // groups, kernel_y, kernel_x
        )
        walk = taps(
            (height, width),
            (kernel_y, kernel_x),
            scale.to(dtype),
            None if guide is None else guide.detach().to(dtype),
            guide_tolerance,
            stride,
            padding,
            dilation,
        )
        output = image.new_zeros(batch, groups, out_channels // groups, count)
        for tap in walk:
            samples = sample(image, tap).reshape(batch, groups, channels // groups, count)
            output = output + filters[..., tap.row, tap.column] @ samples
        output = output.reshape(batch, out_channels, *scale.shape[2:])
        if bias is not None:
            output = output + bias.to(dtype)[:, None, None]
        return output.to(input.dtype)


def backward(
    grad_output: Tensor,
    input: Tensor,
    weight: Tensor,
    scale: Tensor,
    guide: Tensor | None,
    guide_tolerance: float,
    stride: Pair,
    padding: Pair,
    dilation: Pair,
    groups: int,
    need_input: bool,
    need_weight: bool,
    need_bias: bool,
    need_scale: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """``torch.ops.surfconv.surf_conv2d_backward``: gradients of input, weight, bias and scale.

    A gradient that is not needed comes back as an empty tensor of shape (0,).
    """
    dtype = _compute_dtype(input)
    batch, channels, height, width = input.shape
    out_channels, group_channels, kernel_y, kernel_x = weight.shape
    count = scale.shape[2] * scale.shape[3]
    blocked = (batch, groups, channels // groups, count)
    with autocast_disabled(input.device.type):
        image = input.to(dtype).reshape(batch, channels, height * width)
        filters = weight.to(dtype).reshape(
            groups, out_channels // groups, group_channels, kernel_y, kernel_x
        )
        outer = grad_output.to(dtype).reshape(batch, groups, out_channels // groups, count)
        grad_image = torch.zeros_like(image)
        grad_taps: list[Tensor] = []
        grad_y = grad_x = scale.new_zeros(batch, count, dtype=dtype)
        walk = taps(
            (height, width),
            (kernel_y, kernel_x),
            scale.to(dtype),
            None if guide is None else guide.detach().to(dtype),
            guide_tolerance,
            stride,
            padding,
            dilation,
        )
        for tap in walk if need_input or need_weight or need_scale else ():
            if need_weight:
                samples = sample(image, tap).reshape(blocked)
                grad_taps.append((outer @ samples.transpose(2, 3)).sum(0))
            if not (need_input or need_scale):
                continue
            pulled = filters[..., tap.row, tap.column].transpose(1, 2) @ outer
            pulled = pulled.reshape(batch, channels, count)
            for corner in tap.corners:
                if need_input:
                    index = corner.place[:, None].expand_as(pulled)
                    share = (corner.weight_y * corner.weight_x)[:, None] * seen(pulled, corner)
                    grad_image = grad_image.scatter_add(2, index, share)
                if need_scale:
                    along = (pixels(image, corner) * pulled).sum(1)
                    along = torch.where(corner.visible, along, 0.0)
                    if tap.offset_y:
                        slope = tap.offset_y * corner.slope_y * corner.weight_x
                        grad_y = grad_y + slope * along
                    if tap.offset_x:
                        slope = tap.offset_x * corner.slope_x * corner.weight_y
                        grad_x = grad_x + slope * along
        nothing = input.new_empty(0)
        grads = [nothing, nothing, nothing, nothing]
        if need_input:
            grads[0] = grad_image.reshape(input.shape).to(input.dtype)
        if need_weight:
            grads[1] = torch.stack(grad_taps, -1).reshape(weight.shape).to(weight.dtype)
        if need_bias:
            grads[2] = outer.sum((0, 3)).reshape(out_channels).to(weight.dtype)
        if need_scale:
            grad_scale = torch.stack((grad_y, grad_x), 1)
            if scale.shape[1] == 1:
                grad_scale = grad_scale.sum(1, keepdim=True)
            grads[3] = grad_scale.reshape(scale.shape).to(scale.dtype)
        return grads[0], grads[1], grads[2], grads[3]
