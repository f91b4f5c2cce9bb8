"""Whole nets on a GPU: autocast, compilation, graphs, streams, several processes."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from torch import nn

from gpu import MARKS, NETS, Net, assert_close, frame, settings, step
from surfconv_ops import SurfAvgPool2d, SurfMaxPool2d

pytestmark = MARKS
each_net = pytest.mark.parametrize("kind", NETS.values(), ids=NETS)


@each_net
def test_agrees_with_the_cpu(kind: Any) -> None:
    net, (x, depth) = kind().cuda(), frame()
    ours = step(net, net, x, depth)
    alone = copy.deepcopy(net).cpu()
    # A maximum that is all but shared may go to another tap there.
    assert_close([t.cpu() for t in ours], step(alone, alone, x.cpu(), depth.cpu()), 1e-3)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16], ids=str)
def test_autocast(dtype: torch.dtype) -> None:
    net, inputs = Net().cuda(), frame()
    expected = step(net, net, *inputs)
    with torch.autocast("cuda", dtype):
        assert net(*inputs).dtype == dtype
        assert_close(step(net, net, *inputs), expected, 3e-2)


@each_net
def test_compiles_into_one_graph(kind: Any) -> None:
    torch._dynamo.reset()
    net, inputs = kind().cuda(), frame()
    assert_close(step(torch.compile(net, fullgraph=True), net, *inputs), step(net, net, *inputs))


@each_net
@pytest.mark.parametrize("deterministic", [False, True])
def test_capture_as_a_graph(kind: Any, deterministic: bool) -> None:
    with settings(deterministic=deterministic):
        check_capture(kind().cuda())


def check_capture(net: nn.Module) -> None:
    """The layers have run before: a graph cannot hold what compiling a kernel does."""
    x, depth = frame()
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


@each_net
def test_runs_on_the_current_stream(kind: Any) -> None:
    net, (x, depth) = kind().cuda(), frame()
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
