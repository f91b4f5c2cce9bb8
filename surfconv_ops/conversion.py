"""convert_conv2d: SurfConv2d in the place of nn.Conv2d, in nets that people already have."""

from __future__ import annotations

import warnings
import weakref
from collections.abc import Callable
from typing import Any

from torch import nn

from .checks import FloatPairArgument, type_name
from .convertible import CONVERTED_FROM, LEFT_OUT, obstacle
from .depth_layer import DepthLayer, DepthOptions
from .levels import DepthLevels
from .modules import SurfConv2d
from .pools import SurfAvgPool2d, SurfMaxPool2d

Include = Callable[[str, nn.Module], bool]


def convert_conv2d(
    module: nn.Module,
    *,
    reference_depth: FloatPairArgument,
    levels: DepthLevels | None = None,
    include: Include | None = None,
    pools: bool = False,
    **surf_options: Any,
) -> nn.Module:
    """Put a SurfConv2d in the place of every nn.Conv2d whose kernel is larger than 1 x 1.

    The net is changed in place. Each new layer has the Parameters of the old one (the same
    objects, so optimizers and checkpoints go on), its hooks, its training mode and whatever else
    was attached to it. A layer that the net holds in several places stays one layer. The net is
    then called through :class:`surfconv_ops.DepthGuided`, which hands every layer its depth.

    Left alone are subclasses of nn.Conv2d (their forward may do more), layers whose weights are
    computed (weight_norm, spectral_norm, pruning), padding modes other than zeros, and layers
    whose forward was replaced. :func:`surfconv_ops.conversion_report` says which and why, also
    later. Convolutions that a net computes by :func:`torch.nn.functional.conv2d` cannot be seen,
    and where a net keeps a layer in a plain list as well, the list keeps the old one.

    Keep ONE reference_depth for the whole net: like nn.Conv2d's, the window of a layer then grows
    with the stride of what comes before it. With the depth at ``reference_depth`` everywhere, the
    net computes what it did before.

    Args:
        module: The net, or a single nn.Conv2d.
        reference_depth: Depth in metres at which a layer is what it was, or a (y, x) pair.
        levels: Depth levels for the paper's levels mode; None for continuous mode.
        include: Called as ``include(name, layer)`` for every layer that can be converted; those
            for which it returns False stay as they are. A layer held in several places is asked
            for once, by its first name.
        pools: Also put SurfMaxPool2d and SurfAvgPool2d in the place of nn.MaxPool2d and
            nn.AvgPool2d.
        **surf_options: Further options of the layers: ``depth_window``, ``same_level_only``,
            ``invalid_scale``, ``min_scale``, ``max_scale``.

    Returns:
        ``module``; or the new layer, where ``module`` itself was the layer to convert.

    Raises:
        TypeError: An argument is of the wrong type, or an option is unknown.
        ValueError: An option is out of its range. Whatever is raised, the net is as it was.

    Warns:
        UserWarning: Nothing was converted, and not because it had been before.

    Example:
        >>> from torch import nn
        >>> from surfconv_ops import convert_conv2d
        >>> net = nn.Sequential(nn.Conv2d(3, 8, 3), nn.ReLU(), nn.Conv2d(8, 2, 1))
        >>> [type(layer).__name__ for layer in convert_conv2d(net, reference_depth=2.0)]
        ['SurfConv2d', 'ReLU', 'Conv2d']
    """
    if not isinstance(module, nn.Module):
        raise TypeError(f"module: expected an nn.Module, got {type_name(module)}")
    if include is not None and not callable(include):
        raise TypeError(f"include: expected a function or None, got {type_name(include)}")
    options = {"reference_depth": reference_depth, "levels": levels, **surf_options}
    _check_options(options)
    candidates = {
        name: layer
        for name, layer in module.named_modules()
        if obstacle(layer, pools=pools) is None
    }
    wanted = {n: include is None or bool(include(n, layer)) for n, layer in candidates.items()}
    swaps = {
        id(layer): (layer, _surf_layer(layer, options))
        for name, layer in candidates.items()
        if wanted[name]
    }
    # From here on nothing can fail.
    for old, new in swaps.values():
        _move_state(old, new)
    for name, layer in candidates.items():
        if not wanted[name]:
            layer.__dict__[LEFT_OUT] = True
    for parent in list(module.modules()):
        for name, child in parent._modules.items():
            if id(child) in swaps:
                parent._modules[name] = swaps[id(child)][1]
    if not swaps:
        _warn_of_nothing(module, options, len(candidates))
    return swaps[id(module)][1] if id(module) in swaps else module


def _check_options(options: dict[str, Any]) -> None:
    unknown = sorted(set(options) - set(DepthOptions._fields))
    if unknown:
        known = [name for name in DepthOptions._fields if name not in ("reference_depth", "levels")]
        raise TypeError(
            f"surf_options: expected {', '.join(known)}, got {', '.join(map(repr, unknown))}"
        )
    SurfConv2d(1, 1, 3, device="meta", **options)


def _surf_layer(layer: nn.Module, options: dict[str, Any]) -> nn.Module:
    if isinstance(layer, nn.Conv2d):
        return SurfConv2d.from_conv2d(layer, **options)
    if isinstance(layer, nn.MaxPool2d):
        return SurfMaxPool2d.from_pool(layer, **options)
    assert isinstance(layer, nn.AvgPool2d)
    return SurfAvgPool2d.from_pool(layer, **options)


def _move_state(old: nn.Module, new: nn.Module) -> None:
    """Hooks, buffers, and whatever else a layer carries beyond what its class gives it."""
    for name, value in vars(old).items():
        # The hooks' own dicts, because the handles that remove hooks look for them there.
        if name not in ("_parameters", LEFT_OUT):
            new.__dict__[name] = value
    for name, parameter in old._parameters.items():
        new._parameters.setdefault(name, parameter)
    for hook in new._load_state_dict_pre_hooks.values():
        if getattr(hook, "with_module", False):
            # Such a hook is called with its module, of which it would find only the old one.
            setattr(hook, "module", weakref.ref(new))  # noqa: B010
    new.__dict__[CONVERTED_FROM] = type_name(old)


def _warn_of_nothing(module: nn.Module, options: dict[str, Any], candidates: int) -> None:
    before = [layer for layer in module.modules() if isinstance(layer, DepthLayer)]
    model = SurfConv2d(1, 1, 3, device="meta", **options)
    same = [layer.describe_options() == model.describe_options() for layer in before]
    if before and all(same) and not candidates:
        return
    if candidates:
        why = f"include returned False for all {candidates} layers that could be"
    elif before:
        why = (
            f"{len(before)} layers take depth already, {same.count(False)} of them with other"
            " options, which they keep"
        )
    else:
        why = "there is no nn.Conv2d that can be"
    warnings.warn(
        f"convert_conv2d: no layer was converted: {why}; conversion_report(module) says why, layer"
        " by layer",
        UserWarning,
        stacklevel=3,
    )
