"""SurfConv2d: nn.Conv2d that also takes depth."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from . import geometry
from .checks import (
    FloatPairArgument,
    PaddingArgument,
    PairArgument,
    check_pair,
    check_positive_pair,
    check_shareable_conv2d,
)
from .depth_layer import DepthLayer, check_depth_options
from .functional import convolve
from .geometry import FloatPair
from .levels import DepthLevels
from .validation import check_window


class SurfConv2d(DepthLayer, nn.Conv2d):
    """:class:`torch.nn.Conv2d` whose window covers the same metres of surface at every depth.

    At a pixel of depth z the taps lie ``reference_depth / z`` times as far apart as in nn.Conv2d:
    far surfaces get a small window, near ones a large one. Where the depth is invalid (zero,
    negative, NaN, infinite) the layer is nn.Conv2d, unless ``invalid_scale`` says otherwise.

    Parameters and state_dict keys are nn.Conv2d's, so checkpoints load both ways.
    ``reference_depth`` and ``levels`` ride in the state_dict's metadata; loading a checkpoint
    that was trained under others warns.

    Keep one ``reference_depth`` for all layers of a net: like nn.Conv2d's, the window of a layer
    then grows with the stride of what comes before it. To state it in physical terms instead, use
    :meth:`from_radius`.

    Args:
        in_channels: As in nn.Conv2d.
        out_channels: As in nn.Conv2d.
        kernel_size: As in nn.Conv2d.
        stride: As in nn.Conv2d.
        padding: As in nn.Conv2d, ``'same'`` and ``'valid'`` included.
        dilation: As in nn.Conv2d.
        groups: As in nn.Conv2d.
        bias: As in nn.Conv2d.
        padding_mode: ``'zeros'`` only.
        device: As in nn.Conv2d.
        dtype: As in nn.Conv2d.
        reference_depth: Depth in metres at which the layer is nn.Conv2d, or a (y, x) pair.
        levels: Depth levels for the paper's levels mode; None for continuous mode.
        depth_window: Continuous mode only: a tap sees only points within this many metres of the
            centre's depth, so that it does not bleed across an occlusion edge. None: no limit.
        same_level_only: Levels mode only: a tap sees only points of the centre's level.
        invalid_scale: Scale where the depth is invalid.
        min_scale: Lower limit of the scale elsewhere.
        max_scale: Upper limit of the scale elsewhere.

    Shape:
        - input: ``(N, C, H, W)`` or ``(C, H, W)``
        - depth: ``(N, H, W)`` or ``(N, 1, H, W)``; without N, ``(H, W)`` or ``(1, H, W)``
        - output: as in nn.Conv2d

    Raises:
        ValueError: A number is out of its range, or ``depth_window`` and ``same_level_only`` are
            used with the other mode.
        TypeError: An argument is of the wrong type.
        NotImplementedError: ``padding_mode`` is not ``'zeros'``.

    Source:
        Chu et al., *SurfConv: Bridging 3D and 2D Convolution for RGBD Images*, CVPR 2018:
        Eq. 7 (window), Eq. 4 (``depth_window``), section 3.3 (levels).

    Example:
        >>> import torch
        >>> from surfconv_ops import SurfConv2d
        >>> layer = SurfConv2d(3, 8, 3, padding=1, reference_depth=2.0)
        >>> image, depth = torch.randn(1, 3, 12, 16), torch.full((1, 12, 16), 3.0)
        >>> layer(image, depth).shape
        torch.Size([1, 8, 12, 16])
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel_size: PairArgument,
        stride: PairArgument = 1,
        padding: PaddingArgument = 0,
        dilation: PairArgument = 1,
        groups: int = 1,
        bias: bool = True,
        padding_mode: str = "zeros",
        device: torch.device | str | int | None = None,
        dtype: torch.dtype | None = None,
        *,
        reference_depth: FloatPairArgument,
        levels: DepthLevels | None = None,
        depth_window: float | None = None,
        same_level_only: bool = False,
        invalid_scale: float = 1.0,
        min_scale: float = 0.0,
        max_scale: float = math.inf,
    ) -> None:
        if padding_mode != "zeros":
            raise NotImplementedError(
                f"padding_mode: SurfConv2d supports 'zeros' only, got {padding_mode!r}"
            )
        options = check_depth_options(
            reference_depth,
            levels,
            depth_window,
            same_level_only,
            invalid_scale,
            min_scale,
            max_scale,
        )
        check_pair(kernel_size, "kernel_size", 1)
        check_pair(stride, "stride", 1)
        check_pair(dilation, "dilation", 1)
        if not isinstance(padding, str):
            check_pair(padding, "padding", 0)
        super().__init__(
            in_channels,
            out_channels,
            kernel_size,  # type: ignore[arg-type]
            stride,  # type: ignore[arg-type]
            padding,  # type: ignore[arg-type]
            dilation,  # type: ignore[arg-type]
            groups,
            bias,
            "zeros",
            device,
            dtype,
        )
        self._set_depth_options(options)

    @classmethod
    def from_conv2d(
        cls, conv: nn.Conv2d, *, reference_depth: FloatPairArgument, **options: Any
    ) -> SurfConv2d:
        """A SurfConv2d that takes the place of ``conv`` and shares its Parameters.

        The weight and the bias are the same objects, so training one trains the other. Hooks stay
        with ``conv``.

        Args:
            conv: A plain nn.Conv2d or a SurfConv2d.
            reference_depth: Depth in metres at which the layer is ``conv``, or a (y, x) pair.
            **options: :class:`SurfConv2d`'s other depth arguments, from ``levels`` on.

        Returns:
            The layer, in the training mode of ``conv``.

        Raises:
            TypeError: ``conv`` is no nn.Conv2d, or a subclass whose forward may do more.
            ValueError: The weights of ``conv`` are not plain Parameters, or a number is out of
                its range.

        Example:
            >>> conv = nn.Conv2d(3, 8, 3, padding=1)
            >>> SurfConv2d.from_conv2d(conv, reference_depth=2.0).weight is conv.weight
            True
        """
        check_shareable_conv2d(conv, SurfConv2d)
        layer = cls(
            conv.in_channels,
            conv.out_channels,
            conv.kernel_size,
            conv.stride,
            conv.padding,  # type: ignore[arg-type]
            conv.dilation,
            conv.groups,
            conv.bias is not None,
            conv.padding_mode,
            "meta",
            conv.weight.dtype,
            reference_depth=reference_depth,
            **options,
        )
        layer.weight, layer.bias = conv.weight, conv.bias
        return layer.train(conv.training)

    @classmethod
    def from_radius(
        cls,
        in_channels: int,
        out_channels: int,
        kernel_size: PairArgument,
        stride: PairArgument = 1,
        padding: PaddingArgument = 0,
        dilation: PairArgument = 1,
        groups: int = 1,
        bias: bool = True,
        padding_mode: str = "zeros",
        device: torch.device | str | int | None = None,
        dtype: torch.dtype | None = None,
        *,
        radius: FloatPairArgument,
        focal_length: FloatPairArgument,
        **options: Any,
    ) -> SurfConv2d:
        """A SurfConv2d whose kernel tiles a cube of half-width ``radius`` around every point.

        ``reference_depth = 2 * radius * focal_length / (kernel_size * dilation)`` per axis, which
        puts the taps ``2 * radius / kernel_size`` metres apart on the surface.

        Args:
            in_channels: This and the arguments up to ``dtype`` as in :class:`SurfConv2d`.
            out_channels: See ``in_channels``.
            kernel_size: See ``in_channels``.
            stride: See ``in_channels``.
            padding: See ``in_channels``.
            dilation: See ``in_channels``.
            groups: See ``in_channels``.
            bias: See ``in_channels``.
            padding_mode: See ``in_channels``.
            device: See ``in_channels``.
            dtype: See ``in_channels``.
            radius: Half-width of the cube in metres, or a (y, x) pair.
            focal_length: Focal length in pixels *at this layer's input resolution* (half the
                camera's where the input is at half the frame's size), or a (y, x) pair.
            **options: :class:`SurfConv2d`'s depth arguments other than ``reference_depth``.

        Returns:
            The layer.

        Raises:
            ValueError: ``radius`` or ``focal_length`` is not positive and finite, and what
                :class:`SurfConv2d` raises.
            TypeError: As in :class:`SurfConv2d`.

        Source:
            Chu et al., *SurfConv*, CVPR 2018, Eq. 7.

        Example:
            >>> SurfConv2d.from_radius(3, 8, 3, radius=0.15, focal_length=500).reference_depth
            50.0
        """
        metres = _both(check_positive_pair(radius, "radius", "metres"))
        pixels = _both(check_positive_pair(focal_length, "focal_length", "pixels"))
        kernel = check_pair(kernel_size, "kernel_size", 1)
        spacing = check_pair(dilation, "dilation", 1)
        y, x = (
            geometry.reference_depth_of_radius(metres[i], pixels[i], kernel[i], spacing[i])
            for i in (0, 1)
        )
        return cls(
            in_channels,
            out_channels,
            kernel_size,
            stride,
            padding,
            dilation,
            groups,
            bias,
            padding_mode,
            device,
            dtype,
            reference_depth=y if y == x else (y, x),
            **options,
        )

    def forward(self, input: Tensor, depth: Tensor | None = None) -> Tensor:
        """The response of the layer.

        Args:
            input: Images, ``(N, C, H, W)`` or ``(C, H, W)``.
            depth: Depth in metres at the input's resolution, floating point: ``(N, H, W)`` or
                ``(N, 1, H, W)``, ``(H, W)`` or ``(1, H, W)`` where input has no N. Used as
                float32 unless the input is float64. Invalid depth is allowed anywhere.

        Returns:
            ``(N, O, Ho, Wo)`` or ``(O, Ho, Wo)``, in the dtype nn.Conv2d would give.

        Raises:
            ValueError: ``depth`` is missing, or an argument's shape or device is wrong.
            TypeError: An argument's type or dtype is wrong.
        """
        depth = self._resolve_depth(input, depth)
        window = check_window(
            (input.shape[-2], input.shape[-1]),
            self.kernel_size,
            self.stride,
            self.padding,  # type: ignore[arg-type]
            self.dilation,
        )
        # With a single tap there is no other point to see.
        guide, tolerance = (None, 0.0) if window.kernel == (1, 1) else self._guide(depth)
        return convolve(
            input,
            self.weight,
            self.bias,
            self._scale(depth, window),
            guide,
            tolerance,
            self.stride,
            self.padding,  # type: ignore[arg-type]
            self.dilation,
            self.groups,
            window,
        )


def _both(value: float | FloatPair) -> FloatPair:
    return value if isinstance(value, tuple) else (value, value)
