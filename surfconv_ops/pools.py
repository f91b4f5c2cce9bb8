"""SurfMaxPool2d and SurfAvgPool2d: nn's pools that also take depth."""

from __future__ import annotations

import math
from typing import Any, ClassVar, TypeVar

from torch import Tensor, nn

from .checks import FloatPairArgument, PairArgument, check_pair, type_name
from .depth_layer import DepthLayer, check_depth_options
from .levels import DepthLevels
from .pool_functional import surf_avg_pool2d, surf_max_pool2d
from .pool_validation import check_divisor, check_pool_window

_Pool = TypeVar("_Pool", bound="SurfPool2d")


class SurfPool2d(DepthLayer):
    """What both pools share: how one takes the place of nn's."""

    #: nn's pool, and its arguments in their order.
    _plain: ClassVar[type[nn.Module]]
    _arguments: ClassVar[tuple[str, ...]]

    @classmethod
    def from_pool(
        cls: type[_Pool], pool: nn.Module, *, reference_depth: FloatPairArgument, **options: Any
    ) -> _Pool:
        """A pool with depth that takes the place of ``pool``.

        Args:
            pool: nn's pool of the same kind, or one that was made from it.
            reference_depth: Depth in metres at which the layer is ``pool``, or a (y, x) pair.
            **options: The other depth arguments, from ``levels`` on.

        Returns:
            The layer, in the training mode of ``pool``.

        Raises:
            TypeError: ``pool`` is of another kind, or a subclass whose forward may do more.
            ValueError: A number is out of its range.
            NotImplementedError: ``pool`` returns indices.

        Example:
            >>> from torch import nn
            >>> from surfconv_ops import SurfMaxPool2d
            >>> SurfMaxPool2d.from_pool(nn.MaxPool2d(2), reference_depth=2.0).stride
            2
        """
        name = cls._plain.__name__
        if not isinstance(pool, cls._plain):
            raise TypeError(f"pool: expected nn.{name}, got {type_name(pool)}")
        if type(pool) is not cls._plain and not isinstance(pool, SurfPool2d):
            raise TypeError(
                f"pool: expected nn.{name} itself, got the subclass {type_name(pool)}, whose"
                " forward may do more than pool"
            )
        shape = {argument: getattr(pool, argument) for argument in cls._arguments}
        make: Any = cls
        layer: _Pool = make(**shape, reference_depth=reference_depth, **options)
        return layer.train(pool.training)


class SurfMaxPool2d(SurfPool2d, nn.MaxPool2d):
    """:class:`torch.nn.MaxPool2d` whose window covers the same metres of surface at every depth.

    At a pixel of depth z the taps lie ``reference_depth / z`` times as far apart as in
    nn.MaxPool2d, clamped into the image. Where the depth is invalid (zero, negative, NaN,
    infinite) the layer is nn.MaxPool2d, unless ``invalid_scale`` says otherwise. What
    ``depth_window`` or ``same_level_only`` hide counts as zero, which beats negative features.

    Args:
        kernel_size: As in nn.MaxPool2d.
        stride: As in nn.MaxPool2d.
        padding: As in nn.MaxPool2d.
        dilation: As in nn.MaxPool2d.
        return_indices: False only: a sample between pixels has no index.
        ceil_mode: As in nn.MaxPool2d.
        reference_depth: Depth in metres at which the layer is nn.MaxPool2d, or a (y, x) pair.
        levels: Depth levels for the paper's levels mode; None for continuous mode.
        depth_window: Continuous mode only: a tap sees only points within this many metres of the
            centre's depth. None: no limit.
        same_level_only: Levels mode only: a tap sees only points of the centre's level.
        invalid_scale: Scale where the depth is invalid.
        min_scale: Lower limit of the scale elsewhere.
        max_scale: Upper limit of the scale elsewhere.

    Shape:
        - input: ``(N, C, H, W)`` or ``(C, H, W)``
        - depth: ``(N, H, W)`` or ``(N, 1, H, W)``; without N, ``(H, W)`` or ``(1, H, W)``
        - output: as in nn.MaxPool2d

    Raises:
        ValueError: A number is out of its range, or ``depth_window`` and ``same_level_only`` are
            used with the other mode.
        TypeError: An argument is of the wrong type.
        NotImplementedError: ``return_indices`` is True.

    Source:
        Chu et al., *SurfConv: Bridging 3D and 2D Convolution for RGBD Images*, CVPR 2018, Eq. 7
        (window), applied to a pool.

    Example:
        >>> import torch
        >>> from surfconv_ops import SurfMaxPool2d
        >>> pool = SurfMaxPool2d(3, 2, 1, reference_depth=2.0)
        >>> pool(torch.randn(1, 8, 12, 16), torch.full((1, 12, 16), 3.0)).shape
        torch.Size([1, 8, 6, 8])
    """

    _plain = nn.MaxPool2d
    _arguments = ("kernel_size", "stride", "padding", "dilation", "return_indices", "ceil_mode")

    def __init__(
        self,
        kernel_size: PairArgument,
        stride: PairArgument | None = None,
        padding: PairArgument = 0,
        dilation: PairArgument = 1,
        return_indices: bool = False,
        ceil_mode: bool = False,
        *,
        reference_depth: FloatPairArgument,
        levels: DepthLevels | None = None,
        depth_window: float | None = None,
        same_level_only: bool = False,
        invalid_scale: float = 1.0,
        min_scale: float = 0.0,
        max_scale: float = math.inf,
    ) -> None:
        if return_indices:
            raise NotImplementedError(
                "return_indices: SurfMaxPool2d supports False only, got True: a sample between"
                " pixels has no index"
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
        _check_window_arguments(kernel_size, stride, padding, dilation)
        super().__init__(
            kernel_size,  # type: ignore[arg-type]
            stride,  # type: ignore[arg-type]
            padding,  # type: ignore[arg-type]
            dilation,  # type: ignore[arg-type]
            return_indices,
            ceil_mode,
        )
        self._set_depth_options(options)

    def forward(self, input: Tensor, depth: Tensor | None = None) -> Tensor:
        """The maximum under every window.

        Args:
            input: Images, ``(N, C, H, W)`` or ``(C, H, W)``.
            depth: Depth in metres at the input's resolution, floating point, as in
                :class:`surfconv_ops.SurfConv2d`. Invalid depth is allowed anywhere.

        Returns:
            ``(N, C, Ho, Wo)`` or ``(C, Ho, Wo)``, in the input's dtype.

        Raises:
            ValueError: ``depth`` is missing, or an argument's shape or device is wrong.
            TypeError: An argument's type or dtype is wrong.
        """
        depth = self._resolve_depth(input, depth)
        size = (input.shape[-2], input.shape[-1])
        shape = (self.kernel_size, self.stride, self.padding, self.dilation, self.ceil_mode)
        window = check_pool_window(size, *shape)
        guide, tolerance = self._guide(depth)
        return surf_max_pool2d(
            input,
            *shape,
            scale=self._scale(depth, window),
            guide=guide,
            guide_tolerance=tolerance,
        )


class SurfAvgPool2d(SurfPool2d, nn.AvgPool2d):
    """:class:`torch.nn.AvgPool2d` whose window covers the same metres of surface at every depth.

    At a pixel of depth z the taps lie ``reference_depth / z`` times as far apart as in
    nn.AvgPool2d; outside the image is zero. Where the depth is invalid (zero, negative, NaN,
    infinite) the layer is nn.AvgPool2d, unless ``invalid_scale`` says otherwise. What
    ``depth_window`` or ``same_level_only`` hide counts as zero too.

    Args:
        kernel_size: As in nn.AvgPool2d.
        stride: As in nn.AvgPool2d.
        padding: As in nn.AvgPool2d.
        ceil_mode: As in nn.AvgPool2d.
        count_include_pad: As in nn.AvgPool2d; if False, the divisor is the sum of the
            interpolation weights inside the image.
        divisor_override: As in nn.AvgPool2d.
        reference_depth: Depth in metres at which the layer is nn.AvgPool2d, or a (y, x) pair.
        levels: Depth levels for the paper's levels mode; None for continuous mode.
        depth_window: Continuous mode only: a tap sees only points within this many metres of the
            centre's depth. None: no limit.
        same_level_only: Levels mode only: a tap sees only points of the centre's level.
        invalid_scale: Scale where the depth is invalid.
        min_scale: Lower limit of the scale elsewhere.
        max_scale: Upper limit of the scale elsewhere.

    Shape:
        - input: ``(N, C, H, W)`` or ``(C, H, W)``
        - depth: ``(N, H, W)`` or ``(N, 1, H, W)``; without N, ``(H, W)`` or ``(1, H, W)``
        - output: as in nn.AvgPool2d

    Raises:
        ValueError: A number is out of its range, or ``depth_window`` and ``same_level_only`` are
            used with the other mode.
        TypeError: An argument is of the wrong type.

    Source:
        Chu et al., *SurfConv: Bridging 3D and 2D Convolution for RGBD Images*, CVPR 2018, Eq. 7
        (window), applied to a pool.

    Example:
        >>> import torch
        >>> from surfconv_ops import SurfAvgPool2d
        >>> pool = SurfAvgPool2d(2, reference_depth=2.0)
        >>> pool(torch.randn(1, 8, 12, 16), torch.full((1, 12, 16), 3.0)).shape
        torch.Size([1, 8, 6, 8])
    """

    _plain = nn.AvgPool2d
    _arguments = (
        *("kernel_size", "stride", "padding", "ceil_mode", "count_include_pad"),
        "divisor_override",
    )

    def __init__(
        self,
        kernel_size: PairArgument,
        stride: PairArgument | None = None,
        padding: PairArgument = 0,
        ceil_mode: bool = False,
        count_include_pad: bool = True,
        divisor_override: int | None = None,
        *,
        reference_depth: FloatPairArgument,
        levels: DepthLevels | None = None,
        depth_window: float | None = None,
        same_level_only: bool = False,
        invalid_scale: float = 1.0,
        min_scale: float = 0.0,
        max_scale: float = math.inf,
    ) -> None:
        options = check_depth_options(
            reference_depth,
            levels,
            depth_window,
            same_level_only,
            invalid_scale,
            min_scale,
            max_scale,
        )
        _check_window_arguments(kernel_size, stride, padding)
        super().__init__(
            kernel_size,  # type: ignore[arg-type]
            stride,  # type: ignore[arg-type]
            padding,  # type: ignore[arg-type]
            ceil_mode,
            count_include_pad,
            check_divisor(divisor_override),
        )
        self._set_depth_options(options)

    def forward(self, input: Tensor, depth: Tensor | None = None) -> Tensor:
        """The average under every window.

        Args:
            input: Images, ``(N, C, H, W)`` or ``(C, H, W)``.
            depth: Depth in metres at the input's resolution, floating point, as in
                :class:`surfconv_ops.SurfConv2d`. Invalid depth is allowed anywhere.

        Returns:
            ``(N, C, Ho, Wo)`` or ``(C, Ho, Wo)``, in the input's dtype.

        Raises:
            ValueError: ``depth`` is missing, or an argument's shape or device is wrong.
            TypeError: An argument's type or dtype is wrong.
        """
        depth = self._resolve_depth(input, depth)
        size = (input.shape[-2], input.shape[-1])
        shape = (self.kernel_size, self.stride, self.padding)
        window = check_pool_window(size, *shape, 1, self.ceil_mode)
        guide, tolerance = self._guide(depth)
        return surf_avg_pool2d(
            input,
            *shape,
            self.ceil_mode,
            self.count_include_pad,
            self.divisor_override,
            scale=self._scale(depth, window),
            guide=guide,
            guide_tolerance=tolerance,
        )


def _check_window_arguments(kernel_size: Any, stride: Any, padding: Any, dilation: Any = 1) -> None:
    check_pair(kernel_size, "kernel_size", 1)
    if stride is not None:
        check_pair(stride, "stride", 1)
    check_pair(padding, "padding", 0)
    check_pair(dilation, "dilation", 1)
