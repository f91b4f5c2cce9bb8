"""A guided net's checkpoints and copies, and what torch's transforms make of it."""

from __future__ import annotations

import copy
import gc
import io
import pickle
import warnings
import weakref
from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from guided_nets import NETS, frames, guided
from helpers import assert_same_bits
from surfconv_ops import DepthGuided, SurfConv2d, convert_conv2d


@pytest.mark.parametrize("kind", ["plain net", "converted net", "own"])
def test_checkpoints(kind: str) -> None:
    torch.manual_seed(3)
    plain = NETS["encoder-decoder"]()
    source = DepthGuided(convert_conv2d(copy.deepcopy(plain), reference_depth=2.0))
    states = {"plain net": plain, "converted net": source.module, "own": source}
    buffer = io.BytesIO()
    torch.save(states[kind].state_dict(), buffer)
    buffer.seek(0)
    torch.manual_seed(4)
    target = guided()
    before = list(torch.load(buffer).items())
    buffer.seek(0)
    state = torch.load(buffer)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert str(target.load_state_dict(state)) == "<All keys matched successfully>"
    x, depth = frames()
    assert_same_bits(target.eval()(x, depth=depth), source.eval()(x, depth=depth))
    assert list(state) == [name for name, _ in before]
    if kind != "plain net":
        with pytest.warns(UserWarning, match="reference_depth=2.0, this layer has"):
            guided(reference_depth=3.0).load_state_dict(state)
    missing, unexpected = target.load_state_dict({"head.0.bias": torch.zeros(4)}, strict=False)
    assert "module.stem.weight" in missing and not unexpected


def test_net_with_a_child_called_module() -> None:
    class Wrapper(nn.Module):
        def __init__(self, module: nn.Module) -> None:
            super().__init__()
            self.module = module

        def forward(self, x: Tensor) -> Tensor:
            out: Tensor = self.module(x)
            return out

    net = DepthGuided(Wrapper(SurfConv2d(1, 1, 3, reference_depth=1.0)))
    for state in (net.state_dict(), net.module.state_dict()):
        net.module.module.weight.data.zero_()
        wanted = {name: torch.ones_like(value) for name, value in state.items()}
        assert not any(net.load_state_dict(wanted))
        assert net.module.module.weight.unique().item() == 1.0


def through_pickle(net: nn.Module) -> nn.Module:
    copied: nn.Module = pickle.loads(pickle.dumps(net))
    return copied


def through_save(net: nn.Module) -> nn.Module:
    buffer = io.BytesIO()
    torch.save(net, buffer)
    buffer.seek(0)
    loaded: nn.Module = torch.load(buffer, weights_only=False)
    return loaded


@pytest.mark.parametrize("make", [copy.deepcopy, through_pickle, through_save])
def test_copies(make: Callable[[nn.Module], nn.Module]) -> None:
    net = guided().eval()
    x, depth = frames()
    expected = net(x, depth=depth)
    copied = make(net)
    assert_same_bits(copied(x, depth=depth), expected)
    copied.module.stem.weight.data.zero_()  # type: ignore[union-attr]
    assert_same_bits(net(x, depth=depth), expected)
    assert not copied.training and copied.train().module.head[0].training  # type: ignore[index]


def test_training_and_evaluation() -> None:
    net = guided("residual")
    x, depth = frames()
    net.train()(x, depth=depth)
    mean = net.module[0].norm1.running_mean.clone()
    net.eval()(x, depth=depth)
    assert_same_bits(net.module[0].norm1.running_mean, mean)
    assert mean.abs().sum() > 0


def test_functional_call_and_gradients_per_sample() -> None:
    net = guided("sequential")
    x, depth = frames(3)
    parameters = {name: p.detach() for name, p in net.named_parameters()}

    def loss(values: dict[str, Tensor], image: Tensor, z: Tensor) -> Tensor:
        call = torch.func.functional_call(net, values, (image[None],), {"depth": z[None]})
        return call.square().sum()

    each = torch.func.vmap(torch.func.grad(loss), (None, 0, 0))(parameters, x, depth)
    for n in range(3):
        alone = torch.autograd.grad(
            net(x[n : n + 1], depth=depth[n : n + 1]).square().sum(), list(net.parameters())
        )
        for ours, wanted in zip(each.values(), alone, strict=True):
            torch.testing.assert_close(ours[n], wanted, rtol=1e-4, atol=1e-5)


def test_transform_inside_the_net() -> None:
    """A map that is made within a transform of the net's own serves layers outside it too."""

    class Inside(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.layer = SurfConv2d(1, 1, 3, padding=1, reference_depth=1.5)

        def forward(self, x: Tensor) -> Tensor:
            slope = torch.func.grad(lambda y: self.layer(y).square().sum())(x)
            out: Tensor = self.layer(slope)
            return out

    net = DepthGuided(Inside())
    x, depth = torch.randn(1, 1, 4, 4), torch.rand(1, 8, 8) + 1
    reduced = depth[:, ::2, ::2]
    layer, y = net.module.layer, x.clone().requires_grad_()
    (slope,) = torch.autograd.grad(layer(y, reduced).square().sum(), y)
    torch.testing.assert_close(net(x, depth=depth), layer(slope, reduced))


def test_autocast() -> None:
    net = guided("sequential")
    x, depth = frames()
    with torch.autocast("cpu", torch.bfloat16):
        out = net(x, depth=depth)
    assert out.dtype == torch.bfloat16
    assert (out.float() - net(x, depth=depth)).abs().max() < 0.05


def test_garbage_in_a_cycle() -> None:
    gc.collect()
    net = guided("sequential")
    gone = weakref.ref(net)
    net(*frames()[:1], depth=frames()[1])
    del net
    gc.collect()
    assert gone() is None
