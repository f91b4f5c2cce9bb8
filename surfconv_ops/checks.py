"""Checks of single arguments: numbers, pairs, depth.

Every message names the argument, what came, and what was expected. Values raise ValueError, types
raise TypeError.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any, Literal, TypeVar

from numpy.typing import NDArray
from torch import Tensor, nn

from .geometry import FloatPair, Pair

PairArgument = int | Sequence[int]
PaddingArgument = int | Sequence[int] | Literal["same", "valid"]
FloatPairArgument = float | Sequence[float]
Depths = TypeVar("Depths", Tensor, NDArray[Any])

# int on its own as well: to ask the abstract class takes eight times as long, in every call.
_INTEGERS = (int, Integral)


def check_integer(value: Any, name: str, minimum: int) -> int:
    """An integer of at least ``minimum``, NumPy's included."""
    if isinstance(value, bool) or not isinstance(value, _INTEGERS):
        raise TypeError(f"{name}: expected an integer, got {value!r} of type {type_name(value)}")
    if value < minimum:
        raise ValueError(f"{name}: expected at least {minimum}, got {value}")
    return int(value)


def check_optional_integer(value: Any, name: str) -> int | None:
    """Any integer, NumPy's included, or None."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, _INTEGERS):
        raise TypeError(
            f"{name}: expected an integer or None, got {value!r} of type {type_name(value)}"
        )
    return int(value)


def check_pair(value: Any, name: str, minimum: int) -> Pair:
    """An integer or a (y, x) pair of integers, each of at least ``minimum``."""
    # A module's own attributes, checked in every call.
    if type(value) is tuple and len(value) == 2 and type(value[0]) is type(value[1]) is int:
        y, x = value
        if y >= minimum and x >= minimum:
            return y, x
    if isinstance(value, _INTEGERS):
        single = check_integer(value, name, minimum)
        return single, single
    if not isinstance(value, (tuple, list)):
        raise TypeError(
            f"{name}: expected an integer or a (y, x) pair of integers,"
            f" got {value!r} of type {type_name(value)}"
        )
    if len(value) != 2:
        raise ValueError(
            f"{name}: expected an integer or a (y, x) pair of integers,"
            f" got {len(value)} values: {value!r}"
        )
    return check_integer(value[0], name, minimum), check_integer(value[1], name, minimum)


def check_number(value: Any, name: str) -> float:
    """A real number, NaN excluded."""
    if isinstance(value, bool) or not isinstance(value, (float, int, Real)):
        raise TypeError(f"{name}: expected a number, got {value!r} of type {type_name(value)}")
    number = float(value)
    # torch.compile knows comparisons of symbolic floats, but not math.isnan.
    if number != number:
        raise ValueError(f"{name}: expected a number, got NaN")
    return number


def check_finite(value: Any, name: str) -> float:
    """A finite real number."""
    number = check_number(value, name)
    if not -math.inf < number < math.inf:
        raise ValueError(f"{name}: expected a finite number, got {number}")
    return number


def check_not_negative(value: Any, name: str) -> float:
    """A real number that is zero or greater; infinity is allowed."""
    number = check_number(value, name)
    if number < 0:
        raise ValueError(f"{name}: expected zero or more, got {number}")
    return number


def check_positive(value: Any, name: str, meaning: str) -> float:
    """A positive, finite real number; ``meaning`` tells its unit and role in the message."""
    number = check_number(value, name)
    if not 0 < number < math.inf:
        raise ValueError(f"{name}: expected a positive, finite number ({meaning}), got {number}")
    return number


def check_positive_pair(value: Any, name: str, meaning: str) -> float | FloatPair:
    """A positive, finite number, or a (y, x) pair of them."""
    if not isinstance(value, (tuple, list)):
        return check_positive(value, name, meaning)
    if len(value) != 2:
        raise ValueError(
            f"{name}: expected a number or a (y, x) pair of numbers ({meaning}),"
            f" got {len(value)} values: {value!r}"
        )
    return check_positive(value[0], name, meaning), check_positive(value[1], name, meaning)


def check_depth_tensor(depth: Any, name: str = "depth") -> Tensor:
    """A tensor of floating-point depth in metres."""
    if not isinstance(depth, Tensor):
        raise TypeError(f"{name}: expected a tensor, got {type_name(depth)}")
    if not depth.is_floating_point():
        raise TypeError(
            f"{name}: expected floating-point metres, got {depth.dtype}; sensors often store"
            f" integer millimetres: convert with {name}.float() / 1000 (or by your sensor's unit)"
        )
    return depth


def check_class_ids(ids: Any, name: str) -> Tensor:
    """A tensor of integers."""
    if not isinstance(ids, Tensor):
        raise TypeError(f"{name}: expected a tensor of class ids, got {type_name(ids)}")
    if ids.is_floating_point() or ids.is_complex():
        raise TypeError(
            f"{name}: expected integer class ids, got {ids.dtype} of shape {tuple(ids.shape)}; of"
            " scores (N, C, H, W), pass scores.argmax(1)"
        )
    return ids


def check_depth_ranges(depth_ranges: Any) -> tuple[float, ...] | None:
    """Ascending boundaries of depth ranges in metres, or None."""
    if depth_ranges is None:
        return None
    if isinstance(depth_ranges, str) or not isinstance(depth_ranges, Sequence):
        raise TypeError(f"depth_ranges: expected a sequence of metres, got {depth_ranges!r}")
    edges = tuple(check_not_negative(v, f"depth_ranges[{i}]") for i, v in enumerate(depth_ranges))
    if len(edges) < 2:
        raise ValueError(f"depth_ranges: expected at least two boundaries, got {list(edges)}")
    for low, high in itertools.pairwise(edges):
        if high <= low:
            raise ValueError(
                f"depth_ranges: expected strictly ascending metres, got {high} after {low}"
            )
    return edges


def type_name(value: Any) -> str:
    """Name of a value's type, for messages."""
    return type(value).__name__


def check_shareable_conv2d(conv: Any, surf_conv2d: type[nn.Conv2d]) -> None:
    """An nn.Conv2d, or the layer made from one, whose Parameters another layer can share."""
    if not isinstance(conv, nn.Conv2d):
        raise TypeError(f"conv: expected nn.Conv2d, got {type_name(conv)}")
    if isinstance(conv, nn.LazyConv2d):
        raise ValueError(
            "conv: expected nn.Conv2d with its weights made, got LazyConv2d before its first"
            " forward; run it once first"
        )
    if type(conv) is not nn.Conv2d and not isinstance(conv, surf_conv2d):
        raise TypeError(
            f"conv: expected nn.Conv2d itself, got the subclass {type_name(conv)}, whose"
            " forward may do more than convolve"
        )
    if not isinstance(conv.weight, nn.Parameter):
        raise ValueError(
            "conv: expected a weight that is a Parameter, got one that is computed (as by"
            " weight_norm), which cannot be shared"
        )


def valid_depth(depth: Depths) -> Depths:
    """Where a depth is positive and finite."""
    return (depth > 0) & (depth < math.inf)
