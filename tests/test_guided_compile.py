"""DepthGuided under torch.compile and torch.export."""

from __future__ import annotations

import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Iterator

import pytest
import torch
import torch._dynamo.testing
from torch import Tensor, nn
from torch._dynamo.backends.common import aot_autograd
from torch._functorch.partitioners import min_cut_rematerialization_partition
from torch.utils.checkpoint import checkpoint

from guided_nets import NETS, frames
from surfconv_ops import DepthGuided, DepthLevels, SurfConv2d, ambient, convert_conv2d

LEVELS = {"levels": DepthLevels([1.5], [1.0, 3.0]), "same_level_only": True}


@pytest.fixture(autouse=True)
def _fresh() -> Iterator[None]:
    torch._dynamo.reset()
    yield
    assert ambient.trace.call is None and ambient._thread.call is None


def guided(name: str = "sequential", **options: object) -> DepthGuided:
    options = {"reference_depth": 2.0} | options
    return DepthGuided(convert_conv2d(NETS[name](), **options)).eval()  # type: ignore[arg-type]


def same(net: DepthGuided, compiled: Callable[..., Tensor], x: Tensor, depth: Tensor) -> None:
    """Outputs and gradients, that of depth too."""
    results = []
    for call in (compiled, net):
        z = depth.clone().requires_grad_()
        out = call(x, depth=z)
        grads = torch.autograd.grad(out.square().sum(), [*net.parameters(), z])
        results.append([out.detach(), *grads])
    for ours, eager in zip(*results, strict=True):
        torch.testing.assert_close(ours, eager, rtol=1e-4, atol=1e-4)


def test_fullgraph() -> None:
    net = guided()
    same(net, torch.compile(net, fullgraph=True, backend="aot_eager"), *frames())


def test_fullgraph_in_levels_mode() -> None:
    net = guided("encoder-decoder", **LEVELS)
    compiled = torch.compile(net, fullgraph=True, backend="eager")
    x, depth = frames()
    torch.testing.assert_close(compiled(x, depth=depth), net(x, depth=depth))


def test_dynamic_sizes_compile_once() -> None:
    counter = torch._dynamo.testing.CompileCounterWithBackend("eager")
    net = guided()
    compiled = torch.compile(net, fullgraph=True, dynamic=True, backend=counter)
    for batch, height, width, full in ((2, 20, 26, 41), (3, 12, 14, 29), (4, 31, 17, 50)):
        x, _ = frames(batch, height, width)
        _, depth = frames(batch, full, full + 3)
        torch.testing.assert_close(compiled(x, depth=depth), net(x, depth=depth))
    assert counter.frame_count == 1


def test_machine_code() -> None:
    net = guided()
    x, depth = frames()
    same(net, torch.compile(net, fullgraph=True), x, depth)


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("dynamic", [False, True])
def test_each_resolution_is_computed_once_a_graph(training: bool, dynamic: bool) -> None:
    searches = []

    def count(graph: torch.fx.GraphModule, inputs: object) -> Callable[..., object]:
        searches.append(sum("amin" in str(node.target) for node in graph.graph.nodes))
        return graph.forward

    backend = aot_autograd(
        fw_compiler=count,
        bw_compiler=lambda graph, inputs: graph.forward,
        partition_fn=min_cut_rematerialization_partition,
    )
    net = nn.Sequential(nn.Conv2d(3, 3, 3, 2, 1), *[nn.Conv2d(3, 3, 3, padding=1)] * 3)
    net = DepthGuided(convert_conv2d(net, reference_depth=2.0))
    x, depth = frames()
    with torch.set_grad_enabled(training):
        torch.compile(net, fullgraph=True, backend=backend, dynamic=dynamic)(x, depth=depth)
    assert searches == [1]


@pytest.mark.parametrize(
    ("strict", "sizes"), [(False, "as the input"), (False, "of its own"), (True, "of its own")]
)
@pytest.mark.filterwarnings("ignore:While compiling, we found certain side effects")
def test_export(strict: bool, sizes: str) -> None:
    net = guided("encoder-decoder")
    batch = torch.export.Dim("batch", min=1, max=64)
    names = ("rows", "columns", "depth_rows", "depth_columns")
    dims = [torch.export.Dim(name, min=16, max=512) for name in names]
    own = dims[:2] if sizes == "as the input" else dims[2:]
    shapes = {
        "inputs": ({0: batch, 2: dims[0], 3: dims[1]},),
        "depth": {0: batch, 1: own[0], 2: own[1]},
    }
    x, depth = frames(2, 20, 26)
    program = torch.export.export(net, (x,), {"depth": depth}, dynamic_shapes=shapes, strict=strict)
    for size in ((2, 20, 26), (3, 32, 18)):
        x, depth = frames(*size)
        if sizes == "of its own":
            depth = frames(size[0], 45, 37)[1]
        torch.testing.assert_close(program.module()(x, depth=depth), net(x, depth=depth))


class Broken(nn.Module):
    """Breaks the graph between its layers."""

    def __init__(self) -> None:
        super().__init__()
        self.first = SurfConv2d(3, 4, 3, 2, 1, reference_depth=2.0)
        self.second = SurfConv2d(4, 2, 3, reference_depth=2.0)
        self.at_break: list[object] = []
        self.pause: Callable[[], object] = list

    def forward(self, x: Tensor) -> Tensor:
        x = self.first(x)
        self.look()
        out: Tensor = self.second(x)
        return out

    @torch.compiler.disable
    def look(self) -> None:
        self.at_break.append(ambient.trace.call)
        self.pause()


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize("how", ["around", "inside", "in place"])
def test_graph_breaks(how: str, nested: bool) -> None:
    net = DepthGuided(Broken())
    compiled: Callable[..., Tensor] = torch.compile(net, backend="aot_eager")
    if how == "inside":
        compiled = DepthGuided(torch.compile(net.module, backend="aot_eager"))
    if how == "in place":
        compiled = DepthGuided(Broken())
        compiled.module.first, compiled.module.second = net.module.first, net.module.second
        compiled.module.at_break = net.module.at_break
        compiled.module.compile(backend="aot_eager")
    with warnings.catch_warnings(), torch._dynamo.config.patch(nested_graph_breaks=nested):
        warnings.filterwarnings("error", "DepthGuided")
        for _ in range(3):
            x, depth = frames()
            same(net, compiled, x, depth)
    # What is seen at a graph break is what another thread could see.
    assert net.module.at_break and not any(net.module.at_break)


def test_graph_breaks_in_two_threads() -> None:
    net = DepthGuided(Broken())
    compiled = torch.compile(net, backend="eager")
    inputs = [frames() for _ in range(2)]
    expected = [net(x, depth=depth) for x, depth in inputs]
    compiled(inputs[0][0], depth=inputs[0][1])
    net.module.pause = threading.Barrier(2, timeout=60).wait
    failures: list[BaseException] = []

    def work(index: int) -> None:
        try:
            for _ in range(3):
                out = compiled(inputs[index][0], depth=inputs[index][1])
                torch.testing.assert_close(out, expected[index])
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    assert not failures, failures[0]


def test_only_the_net_inside_without_graph_breaks_says_so() -> None:
    net = DepthGuided(torch.compile(guided().module, fullgraph=True, backend="eager"))
    x, depth = frames()
    with pytest.raises(torch._dynamo.exc.Unsupported, match="compile the DepthGuided"):
        net(x, depth=depth)


def test_forgotten_depth() -> None:
    net = guided().module
    with pytest.raises(torch._dynamo.exc.Unsupported, match="Observed exception"):
        torch.compile(net, fullgraph=True, backend="eager")(frames()[0])
    torch._dynamo.reset()
    with pytest.raises(ValueError, match="wrap the whole net in surfconv_ops"):
        torch.compile(net, backend="eager")(frames()[0])


def test_layer_with_depth_of_its_own_is_compiled_as_before() -> None:
    layer = SurfConv2d(3, 4, 3, reference_depth=2.0)
    compiled = torch.compile(layer, fullgraph=True, backend="eager")
    x, depth = frames()
    torch.testing.assert_close(compiled(x, depth), layer(x, depth))


def test_nested_calls() -> None:
    class Nested(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.a = SurfConv2d(3, 3, 3, padding=1, reference_depth=2.0)
            self.inner = guided()
            self.b = SurfConv2d(2, 2, 3, padding=1, reference_depth=2.0)

        def forward(self, x: Tensor, other: Tensor) -> Tensor:
            out: Tensor = self.b(self.inner(self.a(x), depth=other))
            return out

    net = DepthGuided(Nested())
    x, depth = frames()
    compiled = torch.compile(net, fullgraph=True, backend="eager")
    other = frames()[1]
    torch.testing.assert_close(compiled(x, other, depth=depth), net(x, other, depth=depth))


def test_checkpoint_in_what_is_compiled() -> None:
    """The compiler sees where the recomputed layers' depth comes from."""

    class Checkpointed(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.net = guided().module

        def forward(self, x: Tensor) -> Tensor:
            out: Tensor = checkpoint(self.net, x, use_reentrant=False)
            return out

    net = DepthGuided(Checkpointed())
    x, depth = frames()
    compiled = torch.compile(net, fullgraph=True, backend="aot_eager")
    ours = torch.autograd.grad(compiled(x, depth=depth).square().sum(), list(net.parameters()))
    plain = DepthGuided(net.module.net)
    wanted = torch.autograd.grad(plain(x, depth=depth).square().sum(), list(net.parameters()))
    for a, b in zip(ours, wanted, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


EAGER = """
import sys, torch
from torch import nn
from surfconv_ops import DepthGuided, convert_conv2d
net = DepthGuided(convert_conv2d(nn.Sequential(nn.Conv2d(3, 4, 3, 2), nn.Conv2d(4, 2, 3)),
                                 reference_depth=2.0))
net(torch.randn(1, 3, 16, 16), depth=torch.ones(1, 16, 16))
slow = {"torch._dynamo", "sympy", "torch.fx.experimental.symbolic_shapes"} & set(sys.modules)
assert not slow, slow
"""


def test_eager_calls_import_no_compiler() -> None:
    subprocess.run([sys.executable, "-c", EAGER], check=True, timeout=120)
