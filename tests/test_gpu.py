"""The operator on CUDA tensors through the public names; `make test-gpu` runs these."""

from __future__ import annotations

import copy
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from helpers import DTYPES, GRADIENTS, SCALES, Problem, assert_same_bits, make_problem
from operators import GEOMETRIES, name_of
from surfconv_ops import (
    DepthGuided,
    DepthLevels,
    SurfAvgPool2d,
    SurfConv2d,
    SurfMaxPool2d,
    convert_conv2d,
    surf_conv2d,
)

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
    # The fallback's: on a GPU with Triton nothing may come to it.
    pytest.mark.filterwarnings("error:surfconv_ops"),
]
SIZES = {"channels": 64, "out_channels": 48, "size": (30, 40), "scale": "smooth"}


def on_gpu(input: Tensor, weight: Tensor, bias: Tensor | None, **options: Any) -> Tensor:
    moved = {k: v.cuda() if isinstance(v, Tensor) else v for k, v in options.items()}
    out = surf_conv2d(input.cuda(), weight.cuda(), None if bias is None else bias.cuda(), **moved)
    return out.to(input.device)


def to_gpu(problem: Problem, device: str = "cuda") -> Problem:
    tensors = {name: getattr(problem, name) for name in (*GRADIENTS, "guide")}
    return replace(problem, **{n: None if t is None else t.to(device) for n, t in tensors.items()})


@contextmanager
def settings(tf32: bool = False, deterministic: bool = False) -> Iterator[None]:
    before = torch.get_float32_matmul_precision(), torch.are_deterministic_algorithms_enabled()
    torch.set_float32_matmul_precision("high" if tf32 else "highest")
    torch.use_deterministic_algorithms(deterministic)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before[0])
        torch.use_deterministic_algorithms(before[1])


@pytest.mark.parametrize("case", GEOMETRIES, ids=name_of)
def test_geometry(case: dict[str, Any]) -> None:
    problem = make_problem(**case)
    problem.check_forward(on_gpu)
    problem.check_gradients(on_gpu)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("groups", [1, 2, 16])
@pytest.mark.parametrize("deterministic", [False, True])
def test_dtype(dtype: torch.dtype, groups: int, deterministic: bool) -> None:
    problem = make_problem(**SIZES, dtype=dtype, groups=groups, guide="levels")
    with settings(deterministic=deterministic):
        problem.check_forward(on_gpu)
        problem.check_gradients(on_gpu)


def test_tensor_float32_follows_torch() -> None:
    problem = to_gpu(make_problem(**SIZES))
    with settings(tf32=False):
        exact = problem.run(surf_conv2d)
    with settings(tf32=True):
        fast = problem.run(surf_conv2d)
    error = (fast - exact).norm() / exact.norm()
    assert 1e-6 < error < 2e-3


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("guide", ["none", "holes", "nan"])
def test_safe_whatever_the_scale(scale: str, guide: str) -> None:
    """Under `compute-sanitizer` as well: nothing is touched outside its tensor."""
    problem = to_gpu(make_problem(**(SIZES | {"scale": scale}), axes=2, guide=guide))
    out = problem.run(surf_conv2d)
    assert out.isfinite().all()
    for name, grad in problem.gradients(surf_conv2d, torch.randn_like(out)).items():
        assert grad.isfinite().all(), name


def test_deterministic_bits() -> None:
    problem = to_gpu(make_problem(**SIZES, batch=4))
    grad = torch.randn(problem.output_shape(), device="cuda")
    with settings(deterministic=True):
        first = problem.gradients(surf_conv2d, grad)
        for _ in range(5):
            for name, value in problem.gradients(surf_conv2d, grad).items():
                assert_same_bits(value, first[name], name)


class Net(nn.Module):
    """Two layers in both modes and a stride, as a net that somebody has."""

    def __init__(self) -> None:
        super().__init__()
        levels = DepthLevels([2.0, 4.0], [1.0, 3.0, 5.0])
        self.first = SurfConv2d(3, 16, 3, padding=1, reference_depth=3.0)
        self.second = SurfConv2d(16, 16, 3, padding=1, groups=4, reference_depth=3.0, levels=levels,
                                 same_level_only=True)  # fmt: skip

    def forward(self, x: Tensor, depth: Tensor) -> Tensor:
        out: Tensor = self.second(self.first(x, depth).relu(), depth)
        return out


def frame(batch: int = 2) -> tuple[Tensor, Tensor]:
    depth = torch.rand(batch, 24, 32) * 6 + 0.3
    depth[:, ::5, ::3] = float("nan")
    return torch.randn(batch, 3, 24, 32).cuda(), depth.cuda()


def step(net: Callable[..., Tensor], owner: nn.Module, *inputs: Tensor) -> list[Tensor]:
    out = net(*inputs)
    return [out.detach(), *torch.autograd.grad(out.float().square().sum(),
                                               list(owner.parameters()))]  # fmt: skip


def assert_close(ours: list[Tensor], expected: list[Tensor], tolerance: float = 1e-4) -> None:
    for mine, wanted in zip(ours, expected, strict=True):
        assert (mine - wanted).norm() <= tolerance * wanted.norm()


def test_agrees_with_the_cpu() -> None:
    net, (x, depth) = Net(), frame()
    expected = step(net, net, x.cpu(), depth.cpu())
    other = copy.deepcopy(net).cuda()
    assert_close([t.cpu() for t in step(other, other, x, depth)], expected)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16], ids=str)
def test_autocast(dtype: torch.dtype) -> None:
    net, inputs = Net().cuda(), frame()
    expected = step(net, net, *inputs)
    with torch.autocast("cuda", dtype):
        assert net(*inputs).dtype == dtype
        assert_close(step(net, net, *inputs), expected, 3e-2)


def test_compiles_into_one_graph() -> None:
    torch._dynamo.reset()
    net, inputs = Net().cuda(), frame()
    assert_close(step(torch.compile(net, fullgraph=True), net, *inputs), step(net, net, *inputs))


@pytest.mark.parametrize("pool", [SurfMaxPool2d, SurfAvgPool2d])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
def test_pools_agree_with_the_cpu(pool: type[nn.Module], dtype: torch.dtype) -> None:
    layer = pool(3, 2, 1, reference_depth=3.0)
    x, depth = frame()
    results = []
    for device in ("cuda", "cpu"):
        input = x.to(device, dtype).requires_grad_()
        z = depth.to(device).requires_grad_()
        out = layer(input, z)
        grads = torch.autograd.grad(out.float().square().sum(), (input, z))
        results.append([t.detach().float().cpu() for t in (out, *grads)])
    assert_close(*results, tolerance=1e-4 if dtype == torch.float32 else 1e-2)


def test_converted_net() -> None:
    net = nn.Sequential(nn.Conv2d(3, 8, 3, 2, 1), nn.ReLU(), nn.Conv2d(8, 8, 3, padding=1)).cuda()
    guided, (x, depth) = DepthGuided(convert_conv2d(net, reference_depth=2.0)), frame()
    out = guided(x, depth=depth)
    assert_close([out.cpu()], [copy.deepcopy(guided).cpu()(x.cpu(), depth=depth.cpu())])


def test_capture_as_a_graph() -> None:
    net, (x, depth) = Net().cuda(), frame()
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(3):
            step(net, net, x, depth)
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = step(net, net, x, depth)
    for values in (frame(), frame()):
        x.copy_(values[0])
        depth.copy_(values[1])
        graph.replay()
        assert_close(captured, step(net, net, *values))


def test_runs_on_the_current_stream() -> None:
    net, (x, depth) = Net().cuda(), frame()
    expected = step(net, net, x, depth)
    torch.cuda.synchronize()
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        # The stream is busy for a while, then makes the input: a launch elsewhere would see zeros.
        late = torch.zeros_like(x)
        torch.cuda._sleep(200_000_000)
        late.copy_(x)
        ours = step(net, net, late, depth)
    torch.cuda.current_stream().wait_stream(stream)
    assert_close(ours, expected)


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="one CUDA device alone")
def test_runs_on_the_tensors_own_device() -> None:
    problem = make_problem(**SIZES)
    first, second = (to_gpu(problem, f"cuda:{place}").run(surf_conv2d) for place in (0, 1))
    assert second.device.index == 1 and torch.cuda.current_device() == 0
    torch.testing.assert_close(second.cpu(), first.cpu())


def test_in_distributed_data_parallel() -> None:
    from torch import distributed

    net, inputs = Net().cuda(), frame()
    expected = step(net, net, *inputs)
    store = distributed.HashStore()
    distributed.init_process_group("nccl", store=store, rank=0, world_size=1)
    try:
        parallel = nn.parallel.DistributedDataParallel(net, device_ids=[0])
        parallel(*inputs).square().sum().backward()
    finally:
        distributed.destroy_process_group()
    assert_close([p.grad for p in net.parameters() if p.grad is not None], expected[1:])


def test_memory_holds_no_columns() -> None:
    """Taps are sampled where they are used: nine times the input is never there."""
    x = torch.randn(2, 64, 256, 256, device="cuda").to(memory_format=torch.channels_last)
    weight = torch.randn(64, 64, 3, 3, device="cuda")
    scale = torch.rand(2, 256, 256, device="cuda") + 0.5
    surf_conv2d(x, weight, scale=scale, padding=1)
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    out = surf_conv2d(x, weight, scale=scale, padding=1)
    extra = torch.cuda.max_memory_allocated() - before
    assert extra <= out.numel() * 4 + 2**21


@pytest.mark.skipif(
    torch.cuda.is_available() and torch.cuda.mem_get_info()[0] < 24 * 2**30,
    reason="needs 24 GiB of free GPU memory",
)
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
def test_more_than_2_to_the_31_elements(layout: str) -> None:
    """The far end of a tensor that 32 bits cannot index equals a crop of it."""
    rows, width, channels = 2**15 + 8, 2**13, 8
    x = torch.empty(1, channels, rows, width, dtype=torch.float16, device="cuda")
    if layout == "channels_last":
        x = x.to(memory_format=torch.channels_last)
    assert x.numel() > 2**31
    x.normal_()
    weight = torch.randn(channels, 1, 3, 3, dtype=torch.float16, device="cuda")
    scale = torch.rand(1, rows, width, device="cuda") + 0.5
    out = surf_conv2d(x, weight, scale=scale, padding=1, groups=channels)
    crop = surf_conv2d(x[:, :, -32:].contiguous(), weight, scale=scale[:, -32:].contiguous(),
                       padding=1, groups=channels)  # fmt: skip
    assert_same_bits(out[:, :, -16:], crop[:, :, -16:])


def test_no_warning_of_a_fallback() -> None:
    assert not os.environ.get("TRITON_INTERPRET")
    problem = to_gpu(make_problem())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        problem.gradients(surf_conv2d, torch.ones(problem.output_shape(), device="cuda"))
