"""What convert_conv2d can change, what it has changed, and why it leaves the rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from torch import nn
from torch.nn.modules import conv, pooling

from .checks import type_name
from .depth_layer import DepthLayer
from .validation import FLOAT_DTYPES

#: Attributes by which a layer remembers what convert_conv2d did, through copies and files.
CONVERTED_FROM = "_surfconv_converted_from"
LEFT_OUT = "_surfconv_left_out"

_POOLS = (
    pooling._MaxPoolNd,
    pooling._AvgPoolNd,
    pooling._AdaptiveAvgPoolNd,
    pooling._AdaptiveMaxPoolNd,
    pooling._LPPoolNd,
    nn.FractionalMaxPool2d,
)
_UNCHANGED = "unchanged"


class ConversionRow(NamedTuple):
    """One layer of a net that looks at neighbouring pixels."""

    #: Its name in the net; '' for the net itself.
    name: str
    #: What it was before.
    was: str
    #: What it is: the new layer and its depth options, or 'unchanged'.
    now: str
    #: Why it is unchanged; '' where it was converted.
    why: str


@dataclass(frozen=True)
class ConversionReport:
    """Layers of a net in the order of its modules; ``str()`` is a table.

    Args:
        rows: One a layer; a layer held in several places counts once, by its first name.
    """

    rows: tuple[ConversionRow, ...]

    @property
    def converted(self) -> tuple[ConversionRow, ...]:
        """Rows of layers that take depth."""
        return tuple(row for row in self.rows if row.now != _UNCHANGED)

    @property
    def unchanged(self) -> tuple[ConversionRow, ...]:
        """Rows of layers that do not."""
        return tuple(row for row in self.rows if row.now == _UNCHANGED)

    def __str__(self) -> str:
        table = [ConversionRow("layer", "was", "now", "why"), *self.rows]
        table = [line._replace(name=line.name or ".") for line in table]
        widths = [max(len(line[i]) for line in table) for i in range(4)]
        lines = ["  ".join(c.ljust(w) for c, w in zip(t, widths, strict=True)) for t in table]
        total = f"{len(self.converted)} layers take depth, {len(self.unchanged)} are unchanged"
        return "\n".join([*(line.rstrip() for line in lines), total])


def conversion_report(module: nn.Module) -> ConversionReport:
    """Layer by layer: what a convolution or pool was, what it is now, and why not another.

    It reads the net as it is, so it works at any time: before a conversion, later, on copies and
    on nets loaded from files.

    Args:
        module: Any net.

    Returns:
        The report: ``print`` it, or go through its ``rows``.

    Raises:
        TypeError: ``module`` is not an nn.Module.

    Example:
        >>> from torch import nn
        >>> from surfconv_ops import conversion_report, convert_conv2d
        >>> net = nn.Sequential(nn.Conv2d(3, 8, 3), nn.Conv2d(8, 2, 1))
        >>> for row in conversion_report(convert_conv2d(net, reference_depth=2.0)).rows:
        ...     print(row.name, row.now, row.why or "-")
        0 SurfConv2d(reference_depth=2.0) -
        1 unchanged its 1 x 1 window reaches no neighbour
    """
    if not isinstance(module, nn.Module):
        raise TypeError(f"module: expected an nn.Module, got {type_name(module)}")
    return ConversionReport(
        tuple(
            _row(name, layer)
            for name, layer in module.named_modules()
            if isinstance(layer, (DepthLayer, conv._ConvNd, *_POOLS))
        )
    )


def obstacle(layer: nn.Module, *, pools: bool) -> str | None:
    """Why a layer cannot be converted; None where it can."""
    kind = type(layer)
    if isinstance(layer, DepthLayer):
        return "it takes depth already"
    if kind is not nn.Conv2d and kind is not nn.MaxPool2d and kind is not nn.AvgPool2d:
        for known in (nn.Conv2d, nn.MaxPool2d, nn.AvgPool2d):
            if isinstance(layer, known):
                return f"a subclass of nn.{known.__name__}, whose forward may do more"
        return "only nn.Conv2d, nn.MaxPool2d and nn.AvgPool2d have a counterpart"
    if "forward" in vars(layer):
        return "its forward was replaced on the object"
    if isinstance(layer, nn.Conv2d):
        return _obstacle_of_conv2d(layer)
    assert isinstance(layer, (nn.MaxPool2d, nn.AvgPool2d))
    if layer.kernel_size in (1, (1, 1)):
        return "its 1 x 1 window reaches no neighbour"
    if isinstance(layer, nn.MaxPool2d) and layer.return_indices:
        return "return_indices=True: between pixels there is no index"
    return None if pools else "convert_conv2d changes pools with pools=True only"


def _obstacle_of_conv2d(layer: nn.Conv2d) -> str | None:
    if layer.kernel_size == (1, 1):
        return "its 1 x 1 window reaches no neighbour"
    if layer.padding_mode != "zeros":
        return f"padding_mode={layer.padding_mode!r}"
    bias = layer.bias
    if not isinstance(layer.weight, nn.Parameter) or not isinstance(bias, nn.Parameter | None):
        return "its weight or bias is computed, as by weight_norm or pruning"
    if layer.weight.dtype not in FLOAT_DTYPES:
        return f"its weight is {layer.weight.dtype}"
    return None


def _row(name: str, layer: nn.Module) -> ConversionRow:
    if isinstance(layer, DepthLayer):
        was = vars(layer).get(CONVERTED_FROM, type_name(layer))
        now = f"{type_name(layer)}({layer.describe_options()})"
        return ConversionRow(name, _description(was, layer), now, "")
    why = obstacle(layer, pools=True)
    if why is None and LEFT_OUT in vars(layer):
        why = "include returned False for it"
    elif why is None:
        why = obstacle(layer, pools=False) or "convert_conv2d was not called on it"
    return ConversionRow(name, _description(type_name(layer), layer), _UNCHANGED, why)


def _description(kind: str, layer: nn.Module) -> str:
    size = getattr(layer, "kernel_size", None)
    window = " x ".join(map(str, size)) if isinstance(size, tuple) else f"{size} x {size}"
    if isinstance(layer, conv._ConvNd):
        return f"{kind}({layer.in_channels}, {layer.out_channels}, {window})"
    return kind if size is None else f"{kind}({window})"
