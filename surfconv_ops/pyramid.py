"""SurfConvPyramid: the paper's multi-scale scheme for a whole net."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from .checks import FloatPairArgument, check_positive, type_name
from .depth_layer import DepthLayer, check_depth_options
from .geometry import FloatPair, Pair
from .levels import DepthLevels
from .resampling import AxisTaps, axis_taps, read_grid


class SurfConvPyramid(DepthLayer):
    """A net run once per depth level, on the frame resized to that level's scale.

    For level k, with ``scale_k = reference_depth / levels.centers[k]``, the frame is resampled so
    that resized pixel r lies at original position ``r * scale_k``, bilinearly; it has
    ``floor((H - 1) / scale_k) + 1`` rows, and columns likewise. The whole net runs on it, its
    output is read back at ``p / scale_k`` for every original pixel p (positions beyond the last
    resized pixel read that one), and each pixel keeps the output of its own level. Pixels without
    a valid depth are one more level, at ``invalid_scale``.

    This is what :class:`SurfConv2d` with ``levels`` replaces by one pass: as one layer, where both
    grids meet and no tap crosses the border, the two are the same number. (With
    ``same_level_only`` that holds for pixels with a valid depth.) The cost is that of the net on
    ``1 / scale_k**2`` times the frame's pixels for every level that occurs in the batch, and of
    nothing for the others.

    In training, batch normalisation sees every level's frame as a batch of its own: each run
    normalises by that frame's statistics and updates the running ones.

    Args:
        net: Takes images ``(N, C, h, w)`` of any size and gives ``(N, O, h, w)``.
        levels: Depth levels.
        reference_depth: Metres at which a level's frame is the original one, or a (y, x) pair.
        same_level_only: Each level's frame holds only the points of that level, and zeros
            elsewhere, as the paper's text has it; masked before it is resampled. False, as in the
            authors' experiments: it holds all points.
        antialias: A frame that is made smaller is low-passed by a triangle filter ``scale_k``
            pixels to either side, instead of interpolated between two pixels.
        invalid_scale: Scale of the frame for pixels without a valid depth; positive.

    Shape:
        - input: ``(N, C, H, W)`` or ``(C, H, W)``
        - depth: ``(N, H, W)`` or ``(N, 1, H, W)``; without N, ``(H, W)`` or ``(1, H, W)``
        - output: ``(N, O, H, W)`` or ``(O, H, W)``

    Raises:
        ValueError: A number is out of its range.
        TypeError: An argument is of the wrong type.

    Source:
        Chu et al., *SurfConv*, CVPR 2018, section 3.3.

    Example:
        >>> import torch
        >>> from surfconv_ops import DepthLevels, SurfConvPyramid
        >>> net = torch.nn.Conv2d(3, 8, 3, padding=1)
        >>> levels = DepthLevels(edges=[3.0], centers=[2.0, 4.0])
        >>> pyramid = SurfConvPyramid(net, levels, reference_depth=2.0)
        >>> pyramid.scales
        (1.0, 0.5, 1.0)
        >>> pyramid(torch.randn(1, 3, 12, 16), torch.rand(1, 12, 16) * 6).shape
        torch.Size([1, 8, 12, 16])
    """

    levels: DepthLevels

    def __init__(
        self,
        net: Callable[[Tensor], Tensor],
        levels: DepthLevels,
        reference_depth: FloatPairArgument,
        *,
        same_level_only: bool = False,
        antialias: bool = False,
        invalid_scale: float = 1.0,
    ) -> None:
        if not callable(net):
            raise TypeError(f"net: expected a module, got {type_name(net)}")
        if not isinstance(levels, DepthLevels):
            raise TypeError(f"levels: expected DepthLevels, got {type_name(levels)}")
        invalid_scale = check_positive(
            invalid_scale, "invalid_scale", "scale of the frame for pixels without depth"
        )
        super().__init__()
        self._set_depth_options(
            check_depth_options(
                reference_depth, levels, None, same_level_only, invalid_scale, 0.0, math.inf
            )
        )
        self.net = net
        self.antialias = bool(antialias)

    @property
    def scales(self) -> tuple[float | FloatPair, ...]:
        """Scale of every level's frame, and last that of the pixels without depth."""
        scales: list[float | FloatPair] = []
        for center in self.levels.centers:
            reference = self.reference_depth
            if isinstance(reference, tuple):
                scales.append((reference[0] / center, reference[1] / center))
            else:
                scales.append(reference / center)
        return (*scales, self.invalid_scale)

    def forward(self, input: Tensor, depth: Tensor | None = None) -> Tensor:
        """The net's output, every pixel at its level's scale.

        Args:
            input: Images, ``(N, C, H, W)`` or ``(C, H, W)``.
            depth: Depth in metres at the input's resolution, floating point: ``(N, H, W)`` or
                ``(N, 1, H, W)``, ``(H, W)`` or ``(1, H, W)`` where input has no N. Used as
                float32 unless the input is float64. Invalid depth is allowed anywhere. It gets no
                gradient.

        Returns:
            ``(N, O, H, W)`` or ``(O, H, W)``, in the dtype and memory format that the net gives.

        Raises:
            ValueError: ``depth`` is missing, an argument's shape or device is wrong, or the net's
                output is not of its input's size.
            TypeError: An argument's type or dtype is wrong, or the net gives no tensor.
        """
        depth = self._resolve_depth(input, depth)
        if input.ndim == 3:
            return self._merged(input.unsqueeze(0), depth.unsqueeze(0)).squeeze(0)
        return self._merged(input, depth)

    def _merged(self, input: Tensor, depth: Tensor) -> Tensor:
        if depth.numel() == 0:
            return self._run_net(input)
        level = self.levels.assign(depth).unsqueeze(1)
        level = torch.where(level < 0, len(self.levels), level)
        pixels = torch.bincount(level.flatten(), minlength=len(self.levels) + 1).tolist()
        output: Tensor | None = None
        for k, scale in enumerate(self.scales):
            if pixels[k] == 0:
                continue
            own = level == k
            result = self._at_scale(
                torch.where(own, input, 0.0) if self.same_level_only else input,
                scale if isinstance(scale, tuple) else (scale, scale),
            )
            output = result if output is None else torch.where(own, result, output)
        assert output is not None
        return output

    def _at_scale(self, input: Tensor, scale: FloatPair) -> Tensor:
        """The net's output on the frame at one scale, at the original pixels."""
        taps = [self._axis_taps(input.shape[i - 2], scale[i]) for i in (0, 1)]
        (rows, rows_back), (columns, columns_back) = taps
        return read_grid(self._run_net(read_grid(input, rows, columns)), rows_back, columns_back)

    def _axis_taps(self, size: int, scale: float) -> tuple[AxisTaps | None, AxisTaps | None]:
        """What resizing an axis reads, and what reading it back does; None where it stays."""
        if scale == 1:
            return None, None
        resized = math.floor((size - 1) / scale) + 1
        reach = max(scale, 1.0) if self.antialias else 1.0
        return (
            axis_taps(_range(resized) * scale, size, reach),
            axis_taps(_range(size) / scale, resized),
        )

    def _run_net(self, frame: Tensor) -> Tensor:
        output = self.net(frame)
        if not isinstance(output, Tensor):
            raise TypeError(
                f"net: expected a tensor (N, O, h, w) as output, got {type_name(output)}; wrap the"
                " net in a module that returns the tensor of interest"
            )
        size: Pair = (frame.shape[-2], frame.shape[-1])
        if output.ndim != 4 or output.shape[0] != frame.shape[0] or output.shape[-2:] != size:
            raise ValueError(
                f"net: expected an output ({frame.shape[0]}, O, {size[0]}, {size[1]}) of the size"
                f" of its input, got {tuple(output.shape)}; resize it inside the net, e.g. by"
                " torch.nn.functional.interpolate"
            )
        return output

    def extra_repr(self) -> str:
        """The options that are in use."""
        # The base class expects the description of an nn layer in front.
        text = super().extra_repr().removeprefix(", ")
        return f"{text}, antialias=True" if self.antialias else text


def _range(count: int) -> Tensor:
    # On the CPU, because not every device has float64.
    return torch.arange(count, dtype=torch.float64)
