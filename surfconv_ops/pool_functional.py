"""The pools as functions."""

from __future__ import annotations

from torch import Tensor

from . import avg_pool_ops, max_pool_ops
from .checks import PairArgument
from .pool_validation import check_avg_pool, check_max_pool


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
    """Max pooling whose tap spacing is multiplied, at every output pixel, by its own scale.

    The taps lie where :func:`surfconv_ops.surf_conv2d` has them: at
    ``centre + scale * dilation * (t - (kernel_size - 1) / 2)``, read by bilinear interpolation, and
    clamped into the image. With scale 1 this is :func:`torch.nn.functional.max_pool2d`: where an
    axis' scale is exactly 1, taps outside the image are left out as they are there.

    The gradient goes to the winning tap's pixels by their interpolation weights, and through the
    tap's position to the scale; the first of equal taps wins, and NaN wins over all. Where the
    scale is not finite only taps of zero offset are left. An output without any tap is 0.

    Derivatives of any order work, forward-mode differentiation raises.

    Args:
        input: Images: float32, float64, bfloat16 or float16.
        kernel_size: An integer or (y, x).
        stride: An integer or (y, x), in pixels; None for ``kernel_size``.
        padding: An integer or (y, x), at most half the kernel.
        dilation: An integer or (y, x), in pixels.
        ceil_mode: Whether a window may reach beyond the padding, as in nn.
        scale: Factor on the tap spacing per output pixel, without unit; any value. float32 or
            the input's dtype.
        guide: What a tap may see, as in :func:`surfconv_ops.surf_conv2d`: what it does not see
            counts as zero, which beats negative features. Carries no gradient.
        guide_tolerance: In the guide's unit; zero or more.

    Returns:
        The maxima, in the input's dtype and memory format.

    Shape:
        - input: ``(N, C, H, W)`` or ``(C, H, W)``; N may be 0
        - scale: ``(N, Ho, Wo)``, ``(N, 1, Ho, Wo)``, or ``(N, 2, Ho, Wo)`` for (y, x); without N
          where input has none
        - guide: ``(N, H, W)``; without N where input has none
        - output: ``(N, C, Ho, Wo)`` or ``(C, Ho, Wo)``

    Raises:
        ValueError: An argument's value, shape or device is wrong.
        TypeError: An argument's type or dtype is wrong.

    Source:
        Chu et al., *SurfConv*, CVPR 2018, Eq. 7, applied to a pool's window.

    Example:
        >>> import torch
        >>> from surfconv_ops import surf_max_pool2d
        >>> x = torch.tensor([[[[1.0, 5.0, 2.0, 9.0, 0.0]]]])
        >>> surf_max_pool2d(x, (1, 3), 1, (0, 1), scale=torch.full((1, 1, 5), 2.0))
        tensor([[[[2., 9., 2., 9., 2.]]]])
    """
    arguments, batched = check_max_pool(
        input, kernel_size, stride, padding, dilation, ceil_mode, scale, guide, guide_tolerance
    )
    output, _ = max_pool_ops.surf_max_pool2d(*arguments)
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
    """Average pooling whose tap spacing is multiplied, at every output pixel, by its own scale.

    The taps lie where :func:`surfconv_ops.surf_conv2d` has them, read by bilinear interpolation;
    pixels outside the image and hidden ones count as zero, one by one. With scale 1 this is
    :func:`torch.nn.functional.avg_pool2d`. The divisor is the one that nn has for the window; with
    ``count_include_pad=False`` it is the sum of the interpolation weights that the taps have on
    pixels of the image, hidden ones included, and a divisor of 0 gives 0.

    Derivatives of any order work, forward-mode differentiation raises.

    Args:
        input: Images: float32, float64, bfloat16 or float16.
        kernel_size: An integer or (y, x).
        stride: An integer or (y, x), in pixels; None for ``kernel_size``.
        padding: An integer or (y, x), at most half the kernel.
        ceil_mode: Whether a window may reach beyond the padding, as in nn.
        count_include_pad: Whether what lies outside the image counts in the divisor.
        divisor_override: A divisor for all windows, not 0; None for the above.
        scale: Factor on the tap spacing per output pixel, without unit; any value. float32 or
            the input's dtype.
        guide: What a tap may see, as in :func:`surfconv_ops.surf_conv2d`. Carries no gradient.
        guide_tolerance: In the guide's unit; zero or more.

    Returns:
        The averages, in the input's dtype and memory format.

    Shape:
        As for :func:`surfconv_ops.surf_max_pool2d`.

    Raises:
        ValueError: An argument's value, shape or device is wrong.
        TypeError: An argument's type or dtype is wrong.

    Source:
        Chu et al., *SurfConv*, CVPR 2018, Eq. 7, applied to a pool's window.

    Example:
        >>> import torch
        >>> from surfconv_ops import surf_avg_pool2d
        >>> x = torch.tensor([[[[1.0, 5.0, 3.0, 9.0, 0.0]]]])
        >>> surf_avg_pool2d(x, (1, 3), 1, (0, 1), scale=torch.full((1, 1, 5), 0.0))
        tensor([[[[1., 5., 3., 9., 0.]]]])
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
    output = avg_pool_ops.surf_avg_pool2d(*arguments)
    return output if batched else output.squeeze(0)
