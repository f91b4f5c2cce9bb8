"""convert_conv2d: SurfConv2d in the place of nn.Conv2d in nets that people already have."""

from __future__ import annotations

import warnings
import weakref
from collections.abc import Callable
from typing import Any

from torch import nn

from .checks import FloatPairArgument, type_name
from .levels import DepthLevels
from .modules import SurfConv2d

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
    """SurfConv2d in the place of every nn.Conv2d whose kernel is larger than 1 x 1."""
    if not isinstance(module, nn.Module):
        raise TypeError(f"module: expected an nn.Module, got {type_name(module)}")
    if pools:
        raise NotImplementedError("pools: not supported yet")
    options = {"reference_depth": reference_depth, "levels": levels, **surf_options}
    SurfConv2d(1, 1, 3, device="meta", **options)
    swaps: dict[nn.Module, nn.Module] = {}
    for name, layer in module.named_modules():
        if why_not(layer) is None and (include is None or include(name, layer)):
            assert isinstance(layer, nn.Conv2d)
            swaps[layer] = SurfConv2d.from_conv2d(layer, **options)
    if not swaps:
        warnings.warn("convert_conv2d: no layer was converted", UserWarning, stacklevel=2)
    for old, new in swaps.items():
        _move_state(old, new)
    for parent in list(module.modules()):
        for name, child in parent._modules.items():
            if child in swaps:
                parent._modules[name] = swaps[child]
    return swaps.get(module, module)


def why_not(layer: nn.Module) -> str | None:
    """Why a layer cannot be converted; None where it can."""
    if type(layer) is not nn.Conv2d:
        return f"{type_name(layer)} is not nn.Conv2d itself"
    if layer.kernel_size == (1, 1):
        return "a 1 x 1 kernel has no neighbours to reach for"
    if layer.padding_mode != "zeros":
        return f"padding_mode={layer.padding_mode!r}"
    if not isinstance(layer.weight, nn.Parameter):
        return "its weight is computed"
    return None


def _move_state(old: nn.Module, new: nn.Module) -> None:
    """Hooks and whatever else a layer carries beyond its parameters."""
    own = {"_parameters"}
    for name, value in vars(old).items():
        if name not in own:
            new.__dict__[name] = value
    for hook in new._load_state_dict_pre_hooks.values():
        if getattr(hook, "with_module", False):
            hook.module = weakref.ref(new)
