"""Problems to solve, the oracle's answer to them, and the one place for tolerances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

import oracle

# Largest error allowed, as a share of the sum of absolute terms of each result.
SUM_TOLERANCE = {torch.float32: 2e-6, torch.float64: 2e-14}
# Largest relative RMS error of a result that is rounded once, at the end.
RMS_TOLERANCE = {torch.bfloat16: 2.0**-8, torch.float16: 2.0**-11}
# Samples closer than this to a pixel count as lying on it, where slopes are compared.
KINK = {torch.float32: 1e-4, torch.float64: 1e-9}

DTYPES = (torch.float32, torch.float64, torch.bfloat16, torch.float16)
SCALES = (
    "ones",
    "smooth",
    "random",
    "integers",
    "zero",
    "negative",
    "nan",
    "inf",
    "huge",
    "tiny",
    "mixed",
)
GUIDES = ("none", "levels", "depth", "holes", "nan")
LAYOUTS = ("contiguous", "channels_last", "sliced", "expanded", "transposed")
GRADIENTS = ("input", "weight", "bias", "scale")
Operator = Callable[..., Tensor]


def compute_dtype(dtype: torch.dtype) -> torch.dtype:
    return torch.float64 if dtype == torch.float64 else torch.float32


def to_numpy(tensor: Tensor) -> np.ndarray:
    return tensor.detach().double().cpu().numpy()


def assert_matches(actual: Tensor, expected: oracle.Checked, what: str = "output") -> None:
    """`actual` against the oracle: an error per element, or a relative RMS for half types."""
    value = expected.value
    assert tuple(actual.shape) == value.shape, f"{what}: {tuple(actual.shape)} != {value.shape}"
    error = np.abs(to_numpy(actual) - value)
    if actual.dtype in RMS_TOLERANCE:
        rms = float(np.sqrt(np.mean(error**2)) if error.size else 0.0)
        size = float(np.sqrt(np.mean(value**2)) if error.size else 0.0)
        # Sums that cancel leave nothing but float32's rounding of their terms.
        floor = float(np.sqrt(np.mean(expected.magnitude**2)) if error.size else 0.0)
        allowed = RMS_TOLERANCE[actual.dtype] * size + SUM_TOLERANCE[torch.float32] * floor
        assert rms <= allowed, f"{what}: RMS {rms:.3g} > {allowed:.3g}"
        return
    allowed = SUM_TOLERANCE[actual.dtype] * expected.magnitude
    worst = error - allowed
    assert not np.isnan(error).any(), f"{what}: NaN"
    assert (worst <= 0).all(), (
        f"{what}: error {error.flat[worst.argmax()]:.3g} at "
        f"{np.unravel_index(worst.argmax(), worst.shape)}, "
        f"allowed {allowed.flat[worst.argmax()]:.3g}"
    )


def assert_same_bits(actual: Tensor, expected: Tensor, what: str = "") -> None:
    assert actual.dtype == expected.dtype and actual.shape == expected.shape, what
    same = torch.equal(actual.nan_to_num(nan=1.25e-3), expected.nan_to_num(nan=1.25e-3))
    assert same, f"{what}: bits differ, worst {(actual.double() - expected.double()).abs().max()}"


def make_scale(pattern: str, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    if pattern == "ones":
        return np.ones(shape)
    if pattern == "smooth":
        rows = np.linspace(0.4, 2.1, shape[-2])[:, None]
        return np.broadcast_to(rows + np.linspace(0, 0.7, shape[-1]), shape).copy()
    if pattern == "random":
        return rng.uniform(0.2, 3.0, shape)
    if pattern == "integers":
        return rng.integers(0, 4, shape).astype(float)
    if pattern == "negative":
        return -rng.uniform(0.2, 3.0, shape)
    if pattern == "mixed":
        odd = [0.0, 1.0, 2.0, -1.0, 0.5, np.nan, np.inf, -np.inf, 1e30, -1e30, 1e-30, -1e-30]
        return np.where(rng.random(shape) < 0.5, rng.choice(odd, shape), rng.uniform(0.2, 3, shape))
    values = {"zero": [0.0], "nan": [np.nan], "inf": [np.inf, -np.inf], "huge": [1e30, -1e30]}
    values["tiny"] = [1e-30, -1e-30]
    return rng.choice(values[pattern], shape)


def make_guide(pattern: str, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    guide = rng.integers(0, 3, shape).astype(float)
    if pattern == "depth":
        guide = rng.uniform(1.0, 4.0, shape)
    if pattern == "holes":
        guide[rng.random(shape) < 0.3] = np.nan
        guide[rng.random(shape) < 0.1] = np.inf
    if pattern == "nan":
        guide[:] = np.nan
    return guide


def lay_out(tensor: Tensor, layout: str) -> Tensor:
    """The same values under other strides ('expanded' repeats the first channel)."""
    if layout == "channels_last":
        return tensor.contiguous(memory_format=torch.channels_last)
    if layout == "sliced":
        big = torch.full((*tensor.shape[:-1], 2 * tensor.shape[-1] + 1), torch.nan).to(tensor)
        big[..., 1::2] = tensor
        return big[..., 1::2]
    if layout == "expanded":
        return tensor[:, :1].expand_as(tensor)
    if layout == "transposed":
        return tensor.transpose(-1, -2).contiguous().transpose(-1, -2)
    return tensor.contiguous()


@dataclass
class Problem:
    """The operator's arguments, and how the oracle answers them."""

    input: Tensor
    weight: Tensor
    bias: Tensor | None
    scale: Tensor
    guide: Tensor | None = None
    guide_tolerance: float = 0.0
    stride: Any = 1
    padding: Any = 0
    dilation: Any = 1
    groups: int = 1
    kink: float | None = None

    @property
    def geometry(self) -> oracle.Geometry:
        kernel = tuple(self.weight.shape[2:])
        return geometry(kernel, self.stride, self.padding, self.dilation, self.groups)

    @property
    def options(self) -> dict[str, Any]:
        names = ("scale", "guide", "guide_tolerance", "stride", "padding", "dilation", "groups")
        return {name: getattr(self, name) for name in names}

    def run(self, operator: Operator) -> Tensor:
        return operator(self.input, self.weight, self.bias, **self.options)

    def _oracle_arguments(self) -> dict[str, Any]:
        scale, x = to_numpy(self.scale), to_numpy(self.input)
        guide = None if self.guide is None else to_numpy(self.guide)
        if x.ndim == 3:
            x, scale = x[None], scale[None]
            guide = None if guide is None else guide[None]
        if scale.ndim == 3:
            scale = scale[:, None]
        return {
            "x": x,
            "weight": to_numpy(self.weight),
            "scale": scale,
            "geometry": self.geometry,
            "guide": guide,
            "tolerance": self.guide_tolerance,
            "single": self.input.dtype != torch.float64,
        }

    def expected(self) -> oracle.Checked:
        bias = None if self.bias is None else to_numpy(self.bias)
        out = oracle.forward(bias=bias, **self._oracle_arguments())
        if self.input.ndim == 3:
            return oracle.Checked(out.value[0], out.magnitude[0])
        return out

    def expected_gradients(self, grad: Tensor) -> oracle.Gradients:
        grad_array = to_numpy(grad)
        if grad_array.ndim == 3:
            grad_array = grad_array[None]
        kink = KINK[compute_dtype(self.input.dtype)] if self.kink is None else self.kink
        return oracle.backward(grad_array, kink=kink, **self._oracle_arguments())

    def gradients(self, operator: Operator, grad: Tensor) -> dict[str, Tensor]:
        """What autograd gives through `operator`, by name, each at its tensor's own strides."""
        tensors = {name: getattr(self, name) for name in GRADIENTS}
        leaves = {n: t.detach().requires_grad_() for n, t in tensors.items() if t is not None}
        out = replace(self, **leaves).run(operator)
        # A 1 x 1 kernel does not depend on scale; the oracle tells whether zero is right.
        values = torch.autograd.grad(out, list(leaves.values()), grad, materialize_grads=True)
        return dict(zip(leaves, values, strict=True))

    def check_forward(self, operator: Operator) -> Tensor:
        out = self.run(operator)
        assert out.dtype == self.input.dtype
        assert_matches(out, self.expected())
        return out

    def check_gradients(self, operator: Operator, grad: Tensor | None = None) -> None:
        if grad is None:
            grad = torch.randn(self.output_shape()).to(self.input.dtype)
        actual, expected = self.gradients(operator, grad), self.expected_gradients(grad)
        for name, value in actual.items():
            target = getattr(self, name)
            assert value.dtype == target.dtype and value.shape == target.shape, name
            if name == "scale":
                assert_scale_gradient(value, expected)
                continue
            wanted: oracle.Checked = getattr(expected, name)
            shaped = oracle.Checked(
                wanted.value.reshape(value.shape), wanted.magnitude.reshape(value.shape)
            )
            assert_matches(value, shaped, f"grad_{name}")

    def to(self, dtype: torch.dtype) -> Problem:
        """The same numbers, tensors of another type."""
        names = ("input", "weight", "bias", "scale", "guide")
        tensors = {name: getattr(self, name) for name in names}
        return replace(self, **{n: None if t is None else t.to(dtype) for n, t in tensors.items()})

    def output_shape(self) -> tuple[int, ...]:
        size = self.geometry.output_size(*self.input.shape[-2:])
        return (*self.input.shape[:-3], self.weight.shape[0], *size)


def assert_scale_gradient(actual: Tensor, expected: oracle.Gradients) -> None:
    """grad_scale may be any one-sided derivative where a sample lies on a pixel."""
    value = to_numpy(actual).reshape(expected.scale_low.shape)
    clipped = np.clip(value, expected.scale_low, expected.scale_high)
    nearest = oracle.Checked(clipped, expected.scale.magnitude)
    assert_matches(actual.reshape(value.shape), nearest, "grad_scale")


def pair(value: Any) -> tuple[int, int]:
    return (value, value) if isinstance(value, int) else tuple(value)


def geometry(
    kernel: Any, stride: Any = 1, padding: Any = 0, dilation: Any = 1, groups: int = 1
) -> oracle.Geometry:
    kernel, dilation = pair(kernel), pair(dilation)
    if padding == "valid":
        padding = 0
    if padding == "same":
        total = [dilation[axis] * (kernel[axis] - 1) for axis in (0, 1)]
        first = [span // 2 for span in total]
        last = [span - span // 2 for span in total]
        return oracle.Geometry(kernel, pair(stride), (*first, *last), dilation, groups)
    return oracle.Geometry(kernel, pair(stride), pair(padding) * 2, dilation, groups)


def make_problem(
    batch: int = 2,
    channels: int = 3,
    out_channels: int = 4,
    size: tuple[int, int] = (7, 8),
    kernel: Any = 3,
    *,
    stride: Any = 1,
    padding: Any = 1,
    dilation: Any = 1,
    groups: int = 1,
    dtype: torch.dtype = torch.float32,
    scale: str = "random",
    scale_dtype: torch.dtype | None = None,
    axes: int = 1,
    guide: str = "none",
    guide_tolerance: float = 0.0,
    bias: bool = True,
    layout: str = "contiguous",
    seed: int = 0,
) -> Problem:
    """A problem of random numbers; `axes` = 2 gives a (y, x) scale."""
    rng = np.random.default_rng(seed)
    shape = geometry(kernel, stride, padding, dilation, groups)
    out_size = shape.output_size(*size)
    kind = compute_dtype(dtype) if scale_dtype is None else scale_dtype

    def normal(*dims: int) -> Tensor:
        return torch.from_numpy(rng.standard_normal(dims)).to(dtype)

    scales = torch.from_numpy(make_scale(scale, (batch, axes, *out_size), rng)).to(kind)
    guides = None
    if guide != "none":
        guides = torch.from_numpy(make_guide(guide, (batch, *size), rng)).to(kind)
    return Problem(
        input=lay_out(normal(batch, channels, *size), layout),
        weight=normal(out_channels, channels // groups, *shape.kernel),
        bias=normal(out_channels) if bias else None,
        scale=scales,
        guide=guides,
        guide_tolerance=guide_tolerance,
        stride=stride,
        padding=padding,
        dilation=dilation,
        groups=groups,
    )
