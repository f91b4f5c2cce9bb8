"""Calls that run at once: Python threads, processes, and backward passes within other calls."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import torch.multiprocessing as mp
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from guided_nets import Probe, frames, sequential
from helpers import assert_same_bits
from ranks import rank_of_two
from surfconv_ops import DepthGuided, SurfConv2d, ambient, convert_conv2d


def in_threads(count: int, work: Callable[[int], None]) -> None:
    failures: list[BaseException] = []

    def guarded(index: int) -> None:
        try:
            work(index)
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=guarded, args=(i,)) for i in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert not any(thread.is_alive() for thread in threads)
    assert not failures, failures[0]


class InStep(nn.Module):
    """Layers between which all threads wait for one another, so that their calls overlap."""

    def __init__(self, barrier: threading.Barrier) -> None:
        super().__init__()
        self.barrier = barrier
        self.layers = nn.ModuleList([Probe() for _ in range(3)])

    def forward(self, x: Tensor) -> list[Tensor]:
        out = []
        for layer in self.layers:
            self.barrier.wait(30)
            out.append(layer(x))
            self.barrier.wait(30)
        return out


def test_threads_in_one_module_never_mix() -> None:
    net = DepthGuided(InStep(threading.Barrier(4)))

    def work(index: int) -> None:
        x = torch.zeros(1, 1, 3, 4)
        for turn in range(10):
            depth = torch.full((1, 6, 8), 1.0 + index + turn / 16)
            for out in net(x, depth=depth):
                assert out.unique().item() == depth[0, 0, 0].item()

    in_threads(4, work)


def test_call_of_another_thread_is_not_seen() -> None:
    inside, done = threading.Event(), threading.Event()

    class Waiting(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            inside.set()
            assert done.wait(30)
            return x

    def work(index: int) -> None:
        x, one = torch.zeros(1, 1, 2, 2), torch.ones(1, 2, 2)
        if index == 0:
            with pytest.warns(UserWarning, match="no layer inside"):
                DepthGuided(Waiting())(x, depth=one)
            return
        assert inside.wait(30)
        try:
            with pytest.raises(ValueError, match="got None"):
                Probe()(x)
        finally:
            done.set()

    in_threads(2, work)


class Checkpointed(nn.Module):
    """A net of which a part is checkpointed."""

    def __init__(self, reentrant: bool, contexts: bool = False) -> None:
        super().__init__()
        self.first = nn.Sequential(
            SurfConv2d(3, 4, 3, stride=2, padding=1, reference_depth=2.0),
            SurfConv2d(4, 4, 3, padding=1, reference_depth=2.0), nn.Sigmoid(),
        )  # fmt: skip
        # One resolution that came up before, and one that did not.
        self.part = nn.Sequential(
            SurfConv2d(4, 4, 3, padding=1, reference_depth=2.0), nn.Sigmoid(),
            SurfConv2d(4, 2, 3, stride=2, padding=1, reference_depth=2.0), nn.Sigmoid(),
            SurfConv2d(2, 2, 3, padding=1, reference_depth=2.0), nn.Sigmoid(),
        )  # fmt: skip
        self.options = {"use_reentrant": reentrant}
        if contexts:
            self.options["context_fn"] = DepthGuided.checkpoint_contexts  # type: ignore[assignment]
        self.on = True

    def forward(self, x: Tensor) -> Tensor:
        x = self.first(x)
        out: Tensor = checkpoint(self.part, x, **self.options) if self.on else self.part(x)
        return out


def step(net: nn.Module, call: Callable[[], Tensor]) -> list[Tensor]:
    net.zero_grad()
    call().square().sum().backward()
    return [p.grad.clone() for p in net.parameters() if p.grad is not None]


@pytest.mark.parametrize("reentrant", [False, True])
def test_checkpoint_around(reentrant: bool) -> None:
    net = DepthGuided(convert_conv2d(sequential(), reference_depth=2.0))
    x, depth = frames()
    x.requires_grad_()

    def around() -> Tensor:
        out: Tensor = checkpoint(lambda image: net(image, depth=depth), x, use_reentrant=reentrant)
        return out

    expected = step(net, lambda: net(x, depth=depth))
    for ours, wanted in zip(step(net, around), expected, strict=True):
        assert_same_bits(ours, wanted)


@pytest.mark.parametrize("reentrant", [False, True])
def test_checkpoint_inside_raises_after_the_call(reentrant: bool) -> None:
    net = DepthGuided(Checkpointed(reentrant))
    x, depth = frames()
    out = net(x, depth=depth)
    with pytest.raises(ValueError, match="got None"):
        out.sum().backward()


class During(nn.Module):
    """Runs somebody's backward pass while its own call is alive."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = SurfConv2d(3, 2, 3, padding=1, reference_depth=2.0)

    def forward(self, x: Tensor, loss: Tensor) -> Tensor:
        self.layer(x)
        # Re-entrant checkpoints run once without a graph.
        if loss.requires_grad:
            loss.backward()
        out: Tensor = self.layer(x)
        return out


@pytest.mark.parametrize("reentrant", [False, True])
@pytest.mark.parametrize("through", ["first", "again"])
def test_checkpoint_inside_never_takes_another_calls_depth(reentrant: bool, through: str) -> None:
    """Its backward pass runs while a call with other depth is alive; also in one that began in a
    backward pass itself."""
    net, other = DepthGuided(Checkpointed(reentrant)), DepthGuided(During())
    x, depth = frames()
    x.requires_grad_()
    loss = net(x, depth=depth).sum()
    if through == "first":
        with pytest.raises(RuntimeError, match="was run by a backward pass"):
            other(x, loss, depth=depth + 1)
    else:
        out = checkpoint(lambda i: other(i, net(i, depth=depth).sum(), depth=depth + 1) * 1, x,
                         use_reentrant=True)  # fmt: skip
        with pytest.raises(RuntimeError, match="backward pass"):
            out.sum().backward()
    assert ambient._thread.call is None


def test_message_of_a_checkpoint_inside() -> None:
    class Own(nn.Module):
        """Asks for a gradient through its own checkpoint, in its own forward."""

        def __init__(self) -> None:
            super().__init__()
            self.part = Checkpointed(False)

        def forward(self, x: Tensor) -> Tensor:
            self.part(x).sum().backward()
            return x

    x, depth = frames()
    with pytest.raises(RuntimeError) as caught:
        DepthGuided(Own())(x, depth=depth)
    for words in ("'part.part.0' (SurfConv2d)", "around the DepthGuided", "checkpoint_contexts"):
        assert words in str(caught.value)


@pytest.mark.parametrize("needs", ["weights", "depth too"])
def test_checkpoint_inside_with_its_contexts(needs: str) -> None:
    """The recomputation finds its own call's depth, whatever runs when it happens."""
    net, other = DepthGuided(Checkpointed(False, contexts=True)), DepthGuided(During())
    x, depth = frames()
    depth.requires_grad_(needs == "depth too")

    def run(on: bool, late: bool) -> list[Tensor]:
        net.module.on = on
        net.zero_grad()
        depth.grad = None
        out = net(x, depth=depth).square().sum()
        if late:
            other(x, out, depth=torch.full_like(depth, 9.0))
        else:
            out.backward()
        grads = [p.grad.clone() for p in net.parameters() if p.grad is not None]
        return grads if depth.grad is None else [*grads, depth.grad]

    expected = run(on=False, late=False)
    assert len(expected) == (11 if needs == "depth too" else 10)
    for late in (False, True):
        for ours, wanted in zip(run(on=True, late=late), expected, strict=True):
            assert_same_bits(ours, wanted)
    assert ambient._thread.call is None


def test_contexts_outside_a_call() -> None:
    layer = SurfConv2d(1, 1, 3, reference_depth=2.0)
    x = torch.randn(1, 1, 4, 4, requires_grad=True)
    out = checkpoint(layer, x, torch.ones(1, 4, 4), use_reentrant=False,
                     context_fn=DepthGuided.checkpoint_contexts)  # fmt: skip
    out.sum().backward()
    assert x.grad is not None


def build() -> DepthGuided:
    torch.manual_seed(7)
    return DepthGuided(convert_conv2d(sequential(), reference_depth=2.0))


def train(rank: int, folder: str) -> None:
    with rank_of_two(rank, folder):
        net = nn.parallel.DistributedDataParallel(build())
        torch.manual_seed(5)
        x, depth = (part[2 * rank : 2 * rank + 2] for part in frames(4))
        net(x, depth=depth).square().mean().backward()
        grads = {name: p.grad for name, p in net.module.named_parameters()}
        torch.save(grads, Path(folder) / f"{rank}.pt")


def test_two_processes_have_the_gradients_of_one(tmp_path: Path) -> None:
    mp.spawn(train, (str(tmp_path),), nprocs=2)
    both = [torch.load(tmp_path / f"{rank}.pt") for rank in (0, 1)]
    net = build()
    torch.manual_seed(5)
    x, depth = frames(4)
    net(x, depth=depth).square().mean().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0
        assert_same_bits(both[0][name], both[1][name], name)
        torch.testing.assert_close(both[0][name], parameter.grad, rtol=1e-5, atol=1e-6)
