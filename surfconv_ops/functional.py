"""The operator as a function."""

from __future__ import annotations

from torch import Tensor

from . import ops
from .autocast import cast_to_autocast_dtype
from .checks import PaddingArgument, PairArgument
from .validation import Window, check_surf_conv2d


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
    """Convolution whose tap spacing is multiplied, at every output pixel, by its own scale.

    Per axis, output pixel o reads tap t at a real position, by bilinear interpolation::

        centre(o)    = stride * o - padding + dilation * (kernel - 1) / 2
        sample(o, t) = centre(o) + scale(o) * dilation * (t - (kernel - 1) / 2)

    With scale 1 everywhere this is :func:`torch.nn.functional.conv2d`. With
    ``scale = reference_depth / depth`` (:func:`surfconv_ops.depth_to_scale`) the window covers
    the same metres of surface at every depth.

    Pixels outside the image count as zero. A scale that is not finite leaves only taps of zero
    offset, and its gradient is 0. Gradients flow to input, weight, bias and scale; where a sample
    lies exactly on a pixel the scale's gradient is a one-sided derivative. Derivatives of any
    order work, forward-mode differentiation raises.

    Under autocast, input, weight and bias are cast to the active dtype (never from float64), the
    scale and the guide are not.

    Args:
        input: Images: float32, float64, bfloat16 or float16.
        weight: Filters in the input's dtype.
        bias: One value per output channel in the input's dtype, or None.
        scale: Factor on the tap spacing per output pixel, without unit; any value. float32 or
            the input's dtype.
        guide: What a tap may see: an interpolation corner counts as zero unless its guide lies
            within ``guide_tolerance`` of the guide at the input pixel nearest to the centre, so a
            NaN is never seen. Where the centre's guide is not finite everything is seen. Carries
            no gradient. float32 or the input's dtype.
        guide_tolerance: In the guide's unit; zero or more.
        stride: An integer or (y, x), in pixels.
        padding: An integer, (y, x), ``'same'`` (stride 1 only) or ``'valid'``.
        dilation: An integer or (y, x), in pixels.
        groups: Number of channel groups.

    Returns:
        The response, in the input's dtype and memory format. bfloat16 and float16 are accumulated
        in float32 and rounded once.

    Shape:
        - input: ``(N, C, H, W)`` or ``(C, H, W)``; N may be 0
        - weight: ``(O, C/groups, kH, kW)``
        - bias: ``(O,)``
        - scale: ``(N, Ho, Wo)``, ``(N, 1, Ho, Wo)``, or ``(N, 2, Ho, Wo)`` for (y, x); without N
          where input has none
        - guide: ``(N, H, W)``, or ``(H, W)`` where input has no N
        - output: ``(N, O, Ho, Wo)`` or ``(O, Ho, Wo)``, sized as in :class:`torch.nn.Conv2d`

    Raises:
        ValueError: An argument's value, shape or device is wrong.
        TypeError: An argument's type or dtype is wrong.

    Source:
        Chu, Ma, Kundu, Urtasun, Fidler, *SurfConv: Bridging 3D and 2D Convolution for RGBD
        Images*, CVPR 2018, Eq. 7; the guide is Eq. 4's depth bound, or the paper's levels.

    Example:
        >>> import torch
        >>> from surfconv_ops import depth_to_scale, surf_conv2d
        >>> x, weight = torch.randn(2, 3, 16, 16), torch.randn(8, 3, 3, 3)
        >>> depth = torch.full((2, 16, 16), 4.0)
        >>> scale = depth_to_scale(depth, reference_depth=2.0)
        >>> surf_conv2d(x, weight, scale=scale, padding=1).shape
        torch.Size([2, 8, 16, 16])
    """
    return convolve(
        input, weight, bias, scale, guide, guide_tolerance, stride, padding, dilation, groups
    )


def convolve(
    input: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    scale: Tensor,
    guide: Tensor | None,
    guide_tolerance: float,
    stride: PairArgument,
    padding: PaddingArgument,
    dilation: PairArgument,
    groups: int,
    window: Window | None = None,
) -> Tensor:
    """:func:`surf_conv2d`; a layer passes the window that it has checked for its scale."""
    input, weight, bias = cast_to_autocast_dtype(input, weight, bias)
    arguments, batched = check_surf_conv2d(
        input,
        weight,
        bias,
        scale,
        guide,
        guide_tolerance,
        stride,
        padding,
        dilation,
        groups,
        window,
    )
    output = ops.surf_conv2d(*arguments)
    return output if batched else output.squeeze(0)
