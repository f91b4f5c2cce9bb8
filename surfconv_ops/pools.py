"""SurfMaxPool2d and SurfAvgPool2d: nn's pools that also take depth."""

from __future__ import annotations

import math
from typing import Any

from torch import Tensor, nn

from .checks import FloatPairArgument, PairArgument, check_pair, type_name
from .depth_layer import DepthLayer, check_depth_options
from .levels import DepthLevels
from .pool_functional import surf_avg_pool2d, surf_max_pool2d
from .pool_validation import check_divisor, check_pool_window


class SurfMaxPool2d(DepthLayer, nn.MaxPool2d):
    """:class:`torch.nn.MaxPool2d` whose window covers the same metres of surface at every depth.

    At a pixel of depth z the taps lie ``reference_depth / z`` times as far apart as in
    nn.MaxPool2d, clamped into the image. Where the depth is invalid (zero, negative, NaN,
    infinite) the layer is nn.MaxPool2d, unless ``invalid_scale`` says otherwise.

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

    @classmethod
    def from_pool(
        cls, pool: nn.MaxPool2d, *, reference_depth: FloatPairArgument, **options: Any
    ) -> SurfMaxPool2d:
        """A SurfMaxPool2d that takes the place of ``pool``.

        Args:
            pool: A plain nn.MaxPool2d or a SurfMaxPool2d.
            reference_depth: Depth in metres at which the layer is ``pool``, or a (y, x) pair.
            **options: :class:`SurfMaxPool2d`'s other depth arguments, from ``levels`` on.

        Returns:
            The layer, in the training mode of ``pool``.

        Raises:
            TypeError: ``pool`` is no nn.MaxPool2d, or a subclass whose forward may do more.
            ValueError: A number is out of its range.
            NotImplementedError: ``pool`` returns indices.

        Example:
            >>> SurfMaxPool2d.from_pool(nn.MaxPool2d(2), reference_depth=2.0).stride
            2
        """
        _check_replaceable(pool, nn.MaxPool2d, SurfMaxPool2d)
        layer = cls(
            pool.kernel_size,
            pool.stride,
            pool.padding,
            pool.dilation,
            pool.return_indices,
            pool.ceil_mode,
            reference_depth=reference_depth,
            **options,
        )
        return layer.train(pool.training)

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


class SurfAvgPool2d(DepthLayer, nn.AvgPool2d):
    """:class:`torch.nn.AvgPool2d` whose window covers the same metres of surface at every depth.

    At a pixel of depth z the taps lie ``reference_depth / z`` times as far apart as in
    nn.AvgPool2d; outside the image is zero. Where the depth is invalid (zero, negative, NaN,
    infinite) the layer is nn.AvgPool2d, unless ``invalid_scale`` says otherwise.

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

    @classmethod
    def from_pool(
        cls, pool: nn.AvgPool2d, *, reference_depth: FloatPairArgument, **options: Any
    ) -> SurfAvgPool2d:
        """A SurfAvgPool2d that takes the place of ``pool``.

        Args:
            pool: A plain nn.AvgPool2d or a SurfAvgPool2d.
            reference_depth: Depth in metres at which the layer is ``pool``, or a (y, x) pair.
            **options: :class:`SurfAvgPool2d`'s other depth arguments, from ``levels`` on.

        Returns:
            The layer, in the training mode of ``pool``.

        Raises:
            TypeError: ``pool`` is no nn.AvgPool2d, or a subclass whose forward may do more.
            ValueError: A number is out of its range.

        Example:
            >>> SurfAvgPool2d.from_pool(nn.AvgPool2d(2), reference_depth=2.0).stride
            2
        """
        _check_replaceable(pool, nn.AvgPool2d, SurfAvgPool2d)
        layer = cls(
            pool.kernel_size,
            pool.stride,
            pool.padding,
            pool.ceil_mode,
            pool.count_include_pad,
            pool.divisor_override,
            reference_depth=reference_depth,
            **options,
        )
        return layer.train(pool.training)

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


def _check_replaceable(pool: Any, kind: type[nn.Module], surf: type[nn.Module]) -> None:
    if not isinstance(pool, kind):
        raise TypeError(f"pool: expected nn.{kind.__name__}, got {type_name(pool)}")
    if type(pool) is not kind and not isinstance(pool, surf):
        raise TypeError(
            f"pool: expected nn.{kind.__name__} itself, got the subclass {type_name(pool)}, whose"
            " forward may do more than pool"
        )
