"""The CUDA backend: the same operator as Triton kernels.

``torch.ops.surfconv`` runs it for CUDA tensors; nothing imports it before one turns up.
"""

from __future__ import annotations

from torch import Tensor

try:
    import triton as _triton  # noqa: F401
except ImportError as error:
    raise ImportError(
        f"surfconv_ops.triton needs the package triton, which cannot be imported: {error}"
    ) from error

from ..autocast import cast_to_autocast_dtype
from ..checks import PaddingArgument, PairArgument
from ..validation import check_surf_conv2d
from .autograd import SurfConv2dFunction
from .interpreter import check_device
from .pools import surf_avg_pool2d, surf_max_pool2d

__all__ = ["surf_avg_pool2d", "surf_conv2d", "surf_max_pool2d"]


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
    """:func:`surfconv_ops.surf_conv2d` by the CUDA backend's kernels, without a fallback.

    For tests of the backend, and to see why it cannot be used; nets call
    :func:`surfconv_ops.surf_conv2d`, which comes here for CUDA tensors.

    Args:
        input: Images on a CUDA device, or on the CPU where ``TRITON_INTERPRET=1`` was set before
            this module was imported: Triton's interpreter then runs the kernels, very slowly.
        weight: As in :func:`surfconv_ops.surf_conv2d`, and so are the others.
        bias: One value per output channel, or None.
        scale: Factor on the tap spacing per output pixel, without unit.
        guide: Map at the input's resolution that limits what a tap may see, or None.
        guide_tolerance: Largest difference of guide to the centre that is still seen.
        stride: An integer or (y, x), in pixels.
        padding: An integer, (y, x), ``'same'`` or ``'valid'``.
        dilation: An integer or (y, x), in pixels.
        groups: Number of channel groups.

    Returns:
        The response, in the input's dtype and memory format.

    Shape:
        As for :func:`surfconv_ops.surf_conv2d`.

    Raises:
        ValueError: An argument's value, shape or device is wrong, or its device has no kernels.
        TypeError: An argument's type or dtype is wrong.

    Source:
        Chu et al., *SurfConv: Bridging 3D and 2D Convolution for RGBD Images*, CVPR 2018, Eq. 7.

    Example:
        >>> import torch
        >>> from surfconv_ops.triton import surf_conv2d          # doctest: +SKIP
        >>> x, w = torch.randn(1, 3, 8, 8).cuda(), torch.randn(4, 3, 3, 3).cuda()  # doctest: +SKIP
        >>> scale = torch.ones(1, 8, 8).cuda()                   # doctest: +SKIP
        >>> surf_conv2d(x, w, scale=scale, padding=1).shape      # doctest: +SKIP
        torch.Size([1, 4, 8, 8])
    """
    input, weight, bias = cast_to_autocast_dtype(input, weight, bias)
    arguments, batched = check_surf_conv2d(
        input, weight, bias, scale, guide, guide_tolerance, stride, padding, dilation, groups
    )
    check_device(arguments.input)
    output: Tensor = SurfConv2dFunction.apply(*arguments)
    return output if batched else output.squeeze(0)
