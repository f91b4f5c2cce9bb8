"""What D4 and fit_depth_levels take, and what they refuse."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import oracle_d4
from depth_samples import INVALID, normal_depths
from surfconv_ops import D4, DepthLevels, fit_depth_levels


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16, torch.bfloat16])
def test_dtypes_and_layouts(dtype: torch.dtype) -> None:
    depth = torch.from_numpy(normal_depths(60)).to(dtype).reshape(3, 1, 4, 5)
    wanted = oracle_d4.fit(depth.double().flatten().tolist(), 4, 1)
    shapes = {
        "batch": depth,
        "flat": depth.flatten(),
        "transposed": depth.transpose(0, 3),
        "strided": depth.repeat_interleave(2, -1)[..., ::2],
        "with grad": depth.clone().requires_grad_(),
    }
    for name, shaped in shapes.items():
        levels = fit_depth_levels(shaped, 4)
        assert list(levels.edges) == wanted.edges, name
        assert levels.centers == pytest.approx(wanted.centers, rel=1e-12), name
    assert fit_depth_levels(depth[0, 0, 0, 0], 1).centers == (float(depth[0, 0, 0, 0]),)


@pytest.mark.parametrize("kind", ["float16", "float32", "float64", "longdouble", ">f4"])
def test_arrays(kind: str) -> None:
    depth = normal_depths(60).astype(kind).reshape(5, 12)
    depth.flags.writeable = False
    wanted = oracle_d4.fit(depth.ravel().tolist(), 3, 2)
    assert list(fit_depth_levels(depth, 3, 2.0).edges) == wanted.edges
    assert list(fit_depth_levels(depth[:, ::-1].T, 3, 2.0).edges) == wanted.edges


def test_masked_pixels_are_holes() -> None:
    depth = np.ma.masked_greater(np.array([1.0, 2.0, 65.535]), 60.0)
    assert fit_depth_levels(depth, 1, 0.0).centers == (1.5,)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda() -> None:
    depth = torch.from_numpy(normal_depths(500))
    for dtype in (torch.float32, torch.bfloat16):
        assert fit_depth_levels(depth.to(dtype).cuda(), 4) == fit_depth_levels(depth.to(dtype), 4)


@pytest.mark.parametrize("depth", [torch.empty(0), torch.tensor(INVALID), torch.empty(0, 4, 5)])
def test_no_valid_depth(depth: torch.Tensor) -> None:
    reason = f"none of {depth.numel()} pixels" if depth.numel() else "there are none"
    for fit in (
        lambda: fit_depth_levels(depth, 4),
        lambda: fit_depth_levels([depth], 4),
        lambda: fit_depth_levels(iter([depth, depth[:0]]), 4),
        lambda: D4(4).update(depth).fit(),
    ):
        with pytest.raises(ValueError, match=f"at least one valid depth, but {reason}"):
            fit()


@pytest.mark.parametrize("nothing", [[], (), iter(())])
def test_no_maps_at_all(nothing: object) -> None:
    with pytest.raises(ValueError, match="at least one valid depth, but there are none"):
        fit_depth_levels(nothing, 4)  # type: ignore[arg-type]


def test_maps_without_depth_do_no_harm() -> None:
    fitted = D4(2, 0.0).update(torch.tensor(INVALID)).update(torch.tensor([1.0, 3.0]))
    fitted.update(torch.empty(0)).merge(D4(2, 0.0))
    assert fitted.fit() == DepthLevels((1.0,), (1.0, 3.0), 0.0)
    assert (fitted.pixels, fitted.valid_pixels) == (8, 2)


@pytest.mark.parametrize(
    ("depth", "message"),
    [
        (torch.ones(3, dtype=torch.int16), r"torch\.int16; .*\.float\(\) / 1000"),
        (torch.ones(3, dtype=torch.bool), r"torch\.bool"),
        (np.ones(3, np.uint16), r"uint16; .*\.astype\('float32'\) / 1000"),
        (np.ones(3, complex), "complex128"),
        (np.array(["a"]), "<U1"),
        (3.0, "got float"),
        (None, "got NoneType"),
    ],
)
def test_wrong_types(depth: object, message: str) -> None:
    with pytest.raises(TypeError, match=f"depth: expected .*{message}"):
        D4(4).update(depth)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=f"depths: expected .*{message}"):
        fit_depth_levels(depth, 4)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=rf"depths\[1\]: expected .*{message}"):
        fit_depth_levels([torch.ones(2), depth], 4)  # type: ignore[list-item]


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ((0,), ValueError, "num_levels: expected at least 1, got 0"),
        ((2.0,), TypeError, "num_levels: expected an integer"),
        ((True,), TypeError, "num_levels: expected an integer"),
        ((4, math.nan), ValueError, "gamma: expected a number, got NaN"),
        ((4, math.inf), ValueError, "gamma: expected a finite number"),
        ((4, "1"), TypeError, "gamma: expected a number"),
    ],
)
def test_wrong_numbers(arguments: tuple[object, ...], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        D4(*arguments)  # type: ignore[arg-type]
    with pytest.raises(error, match=message):
        fit_depth_levels(torch.ones(3), *arguments)  # type: ignore[arg-type]


def test_edges_and_float32() -> None:
    depth = torch.from_numpy(normal_depths())
    levels = fit_depth_levels(depth, 6)
    assert torch.equal(levels.assign(depth), levels.assign(depth.double()))
