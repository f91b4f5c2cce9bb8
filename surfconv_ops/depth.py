"""From depth to scale, and from the input's grid to the output's."""

from __future__ import annotations

import math
import warnings
from typing import Any

import torch
from torch import Tensor

from . import geometry
from .checks import (
    FloatPairArgument,
    PaddingArgument,
    PairArgument,
    check_depth_tensor,
    check_finite,
    check_not_negative,
    check_positive_pair,
    valid_depth,
)
from .depth_ops import ScaleRule, scale_of
from .geometry import FloatPair
from .levels import DepthLevels
from .validation import Window, check_window

#: Share of clamped valid pixels beyond which clamping is probably a mistake in units.
CLAMPED_SHARE_TO_WARN = 0.1

#: A GPU has to be waited for to count pixels: a mistake in units shows in the first calls.
_CUDA_CALLS_TO_CHECK = 16

_warned_of_clamping = False
_cuda_calls_checked = 0


def depth_to_scale(
    depth: Tensor,
    reference_depth: FloatPairArgument,
    *,
    levels: DepthLevels | None = None,
    invalid_scale: float = 1.0,
    min_scale: float = 0.0,
    max_scale: float = math.inf,
) -> Tensor:
    """Scale of the tap spacing at every depth: ``reference_depth / depth``.

    A surface at ``reference_depth`` gets scale 1, the ordinary convolution; one at twice that
    depth gets 0.5. With ``levels`` the depth is first replaced by its level's representative
    depth. Depths that are zero, negative, NaN or infinite are invalid, which is normal, and get
    ``invalid_scale``.

    The gradient flows to ``depth``. It is 0 where the depth is invalid, where the scale is
    clamped, with ``levels``, and where a depth is so small that the derivative is not a finite
    number. When more than 10 % of the valid pixels of a call are clamped, a warning says so,
    once per process (never while compiling, and on CUDA in the first calls alone).

    Args:
        depth: Metres, floating point.
        reference_depth: Depth in metres at which the scale is 1; a (y, x) pair puts a dimension
            of 2 before the last two.
        levels: Depth levels, for the paper's levels mode; None for continuous mode.
        invalid_scale: Scale of pixels without a valid depth; finite.
        min_scale: Scales below it become it.
        max_scale: Scales above it become it. Without a limit, scales stop at the dtype's largest
            finite number.

    Returns:
        Scale without unit: float64 for float64 depth, float32 for all others.

    Shape:
        - depth: ``(..., H, W)``
        - output: the same, or ``(..., 2, H, W)`` for a (y, x) pair

    Raises:
        ValueError: ``reference_depth`` is not positive and finite, or another number is out of
            its range.
        TypeError: ``depth`` is not a floating-point tensor, or another type is wrong.

    Source:
        Chu et al., *SurfConv*, CVPR 2018, Eq. 7 (continuous) and section 3.3 (levels).

    Example:
        >>> import torch
        >>> from surfconv_ops import depth_to_scale
        >>> depth_to_scale(torch.tensor([[1.0, 2.0, 4.0, 0.0]]), reference_depth=2.0)
        tensor([[2.0000, 1.0000, 0.5000, 1.0000]])
    """
    check_depth_tensor(depth)
    reference = check_reference_depth(reference_depth)
    invalid_scale, min_scale, max_scale = check_scale_limits(invalid_scale, min_scale, max_scale)
    check_levels(levels)
    if isinstance(reference, tuple) and depth.ndim < 2:
        raise ValueError(
            "depth: expected (..., H, W) with a (y, x) pair as reference_depth,"
            f" got {tuple(depth.shape)}"
        )
    dtype = torch.float64 if depth.dtype == torch.float64 else torch.float32
    references = reference if isinstance(reference, tuple) else (reference,)
    rule = ScaleRule(
        invalid_scale,
        min_scale,
        min(max_scale, torch.finfo(dtype).max),
        torch.finfo(depth.dtype).max,
    )
    if levels is not None:
        scales = [_of_levels(r, levels, depth, rule) for r in references]
    else:
        scales = [scale_of(depth.to(dtype), r, rule) for r in references]
    if min_scale > 0 or max_scale < math.inf:
        _warn_of_clamping(references, depth, levels, rule, scales)
    return torch.stack(scales, -3) if isinstance(reference, tuple) else scales[0]


def _of_levels(reference: float, levels: DepthLevels, depth: Tensor, rule: ScaleRule) -> Tensor:
    """One scale per level, computed once for each and looked up by every pixel."""
    scales = [min(max(reference / c, rule.low), rule.high) for c in levels.centers]
    return levels.look_up(depth, scales, rule.invalid)


def at_output_centers(
    map: Tensor,
    kernel_size: PairArgument,
    stride: PairArgument = 1,
    padding: PaddingArgument = 0,
    dilation: PairArgument = 1,
) -> Tensor:
    """A map at the input's resolution, read at the centre of every output pixel's window.

    The centre is ``stride * o - padding + dilation * (kernel - 1) / 2``; the nearest pixel is
    read, a half rounding down, clamped into the image. This is where a convolution reads the
    depth that stands for an output pixel.

    Args:
        map: Any dtype; gradients flow through it.
        kernel_size: As in :class:`torch.nn.Conv2d`.
        stride: As in :class:`torch.nn.Conv2d`.
        padding: As in :class:`torch.nn.Conv2d`, ``'same'`` and ``'valid'`` included.
        dilation: As in :class:`torch.nn.Conv2d`.

    Returns:
        The values read, in the map's dtype.

    Shape:
        - map: ``(N, H, W)`` or ``(N, K, H, W)``; ``(H, W)`` without a batch
        - output: the same with ``(Ho, Wo)``, the convolution's output size, at the end

    Raises:
        ValueError: An argument's value or shape is wrong, or the output would be empty.
        TypeError: An argument's type is wrong.

    Example:
        >>> import torch
        >>> from surfconv_ops import at_output_centers
        >>> depth = torch.arange(16.0).reshape(1, 4, 4)
        >>> at_output_centers(depth, kernel_size=3, stride=2, padding=1)
        tensor([[[ 0.,  2.],
                 [ 8., 10.]]])
    """
    if not isinstance(map, Tensor):
        raise TypeError(f"map: expected a tensor, got {type(map).__name__}")
    if map.ndim not in (2, 3, 4):
        raise ValueError(f"map: expected (N, H, W), (N, K, H, W) or (H, W), got {tuple(map.shape)}")
    size = (map.shape[-2], map.shape[-1])
    window = check_window(size, kernel_size, stride, padding, dilation, size_name="map")
    return _select_centers(map, window)


def read_at_centers(map: Tensor, window: Window) -> Tensor:
    """:func:`at_output_centers` with a checked window; the map itself where that is all of it.

    Copies nothing where every centre lies on a pixel: such a result shares the map's memory.
    """
    # Sizes that a compiler keeps symbolic would turn into conditions on them.
    if torch.compiler.is_compiling():
        return _select_centers(map, window)
    parts = []
    for i in (0, 1):
        first = geometry.first_centre_pixel(
            window.kernel[i], window.padding_before[i], window.dilation[i]
        )
        end = first + (window.output[i] - 1) * window.stride[i] + 1
        if first < 0 or end > map.shape[i - 2]:
            return _select_centers(map, window)
        parts.append(slice(first, end, window.stride[i]))
    rows, columns = parts
    if window.stride == (1, 1) and window.output == tuple(map.shape[-2:]):
        return map
    return map[..., rows, columns]


def _select_centers(map: Tensor, window: Window) -> Tensor:
    for i in (0, 1):
        pixels = geometry.centre_pixels(
            window.output[i],
            window.kernel[i],
            window.stride[i],
            window.padding_before[i],
            window.dilation[i],
            map.device,
        )
        map = map.index_select(i - 2, pixels.clamp(0, map.shape[i - 2] - 1))
    return map


def check_reference_depth(reference_depth: Any) -> float | FloatPair:
    """A positive, finite depth in metres, or a (y, x) pair of them."""
    return check_positive_pair(reference_depth, "reference_depth", "metres at which scale is 1")


def check_scale_limits(
    invalid_scale: Any, min_scale: Any, max_scale: Any
) -> tuple[float, float, float]:
    """The three numbers that bound what depth turns into."""
    invalid = check_finite(invalid_scale, "invalid_scale")
    low = check_not_negative(min_scale, "min_scale")
    low = check_finite(low, "min_scale")
    high = check_not_negative(max_scale, "max_scale")
    if high < low:
        raise ValueError(f"max_scale: expected at least min_scale = {low}, got {high}")
    return invalid, low, high


def check_levels(levels: Any) -> None:
    """DepthLevels or None."""
    if levels is not None and not isinstance(levels, DepthLevels):
        raise TypeError(f"levels: expected DepthLevels or None, got {type(levels).__name__}")


def _warn_of_clamping(
    references: tuple[float, ...],
    depth: Tensor,
    levels: DepthLevels | None,
    limits: ScaleRule,
    scales: list[Tensor],
) -> None:
    global _cuda_calls_checked, _warned_of_clamping
    if _warned_of_clamping or torch.compiler.is_compiling():
        return
    if depth.is_cuda:
        enough = _cuda_calls_checked >= _CUDA_CALLS_TO_CHECK
        if enough or torch.cuda.is_current_stream_capturing():
            return
        _cuda_calls_checked += 1
    try:
        # Only a scale at its limit can have been clamped: most calls need no closer look.
        ends = [limits.low] if limits.low > 0 else []
        ends += [limits.high] if limits.high < torch.finfo(scales[0].dtype).max else []
        suspects = sum(int(torch.count_nonzero(s == end)) for s in scales for end in ends)
        total = len(references) * int(torch.count_nonzero(valid_depth(depth))) if suspects else 0
        if suspects <= CLAMPED_SHARE_TO_WARN * total:
            return
        metres = depth.detach().to(torch.float64) if levels is None else levels.quantize(depth)
        wanted = [r / metres for r in references]
        outside = [(w < limits.low) | (w > limits.high) for w in wanted]
        count = sum(int((valid_depth(metres) & o).sum()) for o in outside)
    except torch.AcceleratorError:
        raise
    except RuntimeError:
        # Under vmap and in traces values cannot be read; an eager call will tell.
        return
    if total and count / total > CLAMPED_SHARE_TO_WARN:
        _warned_of_clamping = True
        warnings.warn(
            f"depth_to_scale: {count / total:.0%} of the valid pixels have a scale outside"
            f" [min_scale, max_scale] = [{limits.low}, {limits.high}] and were clamped; check that"
            " depth and reference_depth are both in metres. This is said once.",
            UserWarning,
            stacklevel=3,
        )
