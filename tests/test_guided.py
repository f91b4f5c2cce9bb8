"""DepthGuided as a module: what it accepts, keeps, says and stores."""

from __future__ import annotations

import warnings
import weakref
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import surfconv_ops.ambient
from guided_nets import Probe, frames, guided
from helpers import assert_same_bits
from surfconv_ops import DepthGuided, SurfConv2d, convert_conv2d
from test_errors import says


class ByHand(nn.Module):
    """What NETS['sequential'] does, with the depth handed over layer by layer."""

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.net = net

    def forward(self, x: Tensor, depth: Tensor) -> Tensor:
        x = torch.relu(self.net[0](x, depth))  # type: ignore[index]
        half = torch.zeros(x.shape[0], *x.shape[-2:])
        half[:] = depth[:, ::2, ::2]
        return self.net[4](torch.relu(self.net[2](x, half)), half)  # type: ignore[index]


def test_depth_reaches_every_layer() -> None:
    net = guided("sequential")
    x, depth = frames()
    depth = depth.clamp(min=0.5)
    assert_same_bits(net(x, depth=depth), ByHand(net.module)(x, depth))


def test_layer_at_two_resolutions_and_on_upsampled_maps() -> None:
    seen = []
    net = guided()
    for layer in (net.module.shared, net.module.head[0]):
        layer.register_forward_hook(lambda m, args, out: seen.append(tuple(args[0].shape[-2:])))
    net(*frames()[:1], depth=frames()[1])
    assert seen == [(10, 13), (5, 6), (20, 26)]


@pytest.mark.parametrize("given", ["(N,H,W)", "(N,1,H,W)", "(H,W)", "(1,H,W)"])
@pytest.mark.parametrize("batched", [True, False])
def test_forms_of_depth(given: str, batched: bool) -> None:
    x, depth = frames(1)
    forms = {"(N,H,W)": depth, "(N,1,H,W)": depth[:, None], "(H,W)": depth[0], "(1,H,W)": depth}
    net = nn.Sequential(nn.Conv2d(3, 4, 3, 2, 1), nn.Conv2d(4, 2, 3))
    net = DepthGuided(convert_conv2d(net, reference_depth=2.0))
    expected = net(x, depth=depth)
    out = net(x if batched else x[0], depth=forms[given])
    assert_same_bits(out, expected if batched else expected[0])


def test_arguments_pass_through() -> None:
    class Net(nn.Module):
        def forward(self, a: Tensor, b: Tensor, *, c: float = 1.0, d: Any = None) -> Any:
            return {"sum": a + b * c, "d": d}

    with pytest.warns(UserWarning, match="no layer inside takes depth"):
        out = DepthGuided(Net())(torch.ones(1), torch.ones(1), c=3.0, d="x", depth=torch.ones(2, 2))
    assert out["sum"].item() == 4.0 and out["d"] == "x"


MISTAKES: dict[str, tuple[Callable[[], Any], type[Exception], list[str]]] = {
    "no DepthGuided": (lambda: guided().module(frames()[0]), ValueError,
                       ["depth", "SurfConv2d", "None", "DepthGuided"]),
    "None": (lambda: guided()(frames()[0], depth=None), TypeError, ["depth", "NoneType"]),
    "integers": (lambda: guided()(frames()[0], depth=torch.ones(2, 20, 26, dtype=torch.int32)),
                 TypeError, ["depth", "int32", "millimetres"]),
    "five dimensions": (lambda: guided()(frames()[0], depth=torch.ones(1, 2, 1, 20, 26)),
                        ValueError, ["depth", "(1, 2, 1, 20, 26)", "(N, 1, H, W)"]),
    "two channels": (lambda: guided()(frames()[0], depth=torch.ones(2, 2, 20, 26)),
                     ValueError, ["depth", "(2, 2, 20, 26)"]),
    "no pixels": (lambda: guided()(frames()[0], depth=torch.ones(2, 0, 26)),
                  ValueError, ["depth", "(2, 0, 26)", "one pixel"]),
    "batch": (lambda: guided()(frames()[0], depth=torch.ones(3, 20, 26)),
              ValueError, ["depth", "'stem' (SurfConv2d)", "(2, 3, 20, 26)", "(3, 20, 26)"]),
    "folded batch": (
        lambda: DepthGuided(convert_conv2d(nn.Sequential(nn.Flatten(0, 1), nn.Unflatten(0, (-1, 1)),
                                                         nn.Conv2d(1, 2, 3)), reference_depth=1.0))(
            frames()[0], depth=frames()[1]),
        ValueError, ["depth", "'2' (SurfConv2d)", "(6, 1, 20, 26)", "(2, 20, 26)", "by hand"]),
    "device": (lambda: guided()(frames()[0], depth=torch.ones(2, 20, 26, device="meta")),
               ValueError, ["depth", "'stem' (SurfConv2d)", "cpu", "meta"]),
    "not a module": (lambda: DepthGuided(torch.relu), TypeError,  # type: ignore[arg-type]
                     ["module", "nn.Module", "builtin"]),
}  # fmt: skip


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes(case: str) -> None:
    call, error, words = MISTAKES[case]
    says(error, words, call)
    # And nothing is left behind by it.
    says(ValueError, ["depth", "None"], lambda: guided().module(frames()[0]))


def test_depth_forgotten() -> None:
    with pytest.raises(TypeError, match="missing 1 required keyword-only argument: 'depth'"):
        guided()(frames()[0])


def test_layer_of_three_dimensions_only() -> None:
    says(ValueError, ["input", "(3, 4)"],
         lambda: DepthGuided(SurfConv2d(1, 1, 3, reference_depth=1.0))(
             torch.ones(3, 4), depth=torch.ones(3, 4)))  # fmt: skip


class Nested(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.before, self.inner, self.after = Probe(), DepthGuided(Probe()), Probe()

    def forward(self, x: Tensor, inner_depth: Tensor) -> list[Tensor]:
        return [self.before(x), self.inner(x, depth=inner_depth), self.after(x)]


def test_inner_call_wins_and_outer_comes_back() -> None:
    x, one = torch.zeros(1, 1, 2, 2), torch.ones(1, 2, 2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        out = DepthGuided(Nested())(x, 2 * one, depth=one)
    assert [o.unique().item() for o in out] == [1.0, 2.0, 1.0]


def test_exception_ends_the_call() -> None:
    class Failing(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            raise RuntimeError("own")

    x, one = torch.zeros(1, 1, 2, 2), torch.ones(1, 2, 2)
    outer = Nested()
    outer.inner = DepthGuided(Failing())
    with pytest.raises(RuntimeError, match="own"):
        DepthGuided(outer)(x, one, depth=one)
    assert surfconv_ops.ambient._thread.call is None
    says(ValueError, ["depth", "None"], lambda: Probe()(x))


def test_depth_given_to_a_layer_by_hand_wins() -> None:
    class ByHandInside(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.probe = Probe()

        def forward(self, x: Tensor) -> Tensor:
            out: Tensor = self.probe(x, torch.full((1, 2, 2), 7.0))
            return out

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        out = DepthGuided(ByHandInside())(torch.zeros(1, 1, 2, 2), depth=torch.ones(1, 2, 2))
    assert out.unique().item() == 7.0


def test_each_resolution_is_computed_once_a_call(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = []
    plain = surfconv_ops.ambient.resize_depth

    def counted(depth: Tensor, height: int, width: int) -> Tensor:
        sizes.append((height, width))
        return plain(depth, height, width)

    monkeypatch.setattr(surfconv_ops.ambient, "resize_depth", counted)
    net = nn.Sequential(*[nn.Conv2d(3, 3, 3, padding=1) for _ in range(3)], nn.AvgPool2d(2),
                        *[nn.Conv2d(3, 3, 3, padding=1) for _ in range(3)])  # fmt: skip
    net = DepthGuided(convert_conv2d(net, reference_depth=2.0))
    x, depth = frames()
    for calls in (1, 2):
        net(x, depth=torch.ones(2, 40, 52))
        assert sizes == [(20, 26), (10, 13)] * calls
    net(x, depth=depth)
    assert sizes[4:] == [(10, 13)]


def test_nothing_is_kept_after_the_call() -> None:
    net = guided()
    x, depth = frames()
    maps = []

    def remember(module: nn.Module, args: Any, out: Any) -> None:
        call = surfconv_ops.ambient._thread.call
        assert call is not None
        maps.extend(weakref.ref(known.depth) for known in call._resized)

    net.module.head[0].register_forward_hook(remember)
    gone = weakref.ref(depth)
    with torch.no_grad():
        net(x, depth=depth)
    del depth
    assert len(maps) >= 3
    # Not even a cycle that only the garbage collector would find.
    assert gone() is None and all(m() is None for m in maps)


@pytest.mark.parametrize("first", ["no_grad", "inference_mode"])
def test_part_of_the_net_without_gradients(first: str) -> None:
    """A map made without a graph is not handed to layers that need one."""

    class Frozen(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.frozen = SurfConv2d(1, 1, 3, padding=1, reference_depth=1.5)
            self.trained = SurfConv2d(1, 1, 3, padding=1, reference_depth=1.5)

        def forward(self, x: Tensor) -> Tensor:
            with getattr(torch, first)():
                y = self.frozen(x)
            out: Tensor = self.trained(x + y.clone() if first == "no_grad" else x)
            return out

    net = DepthGuided(Frozen())
    depth = (torch.rand(1, 8, 8) + 1).requires_grad_()
    x = torch.randn(1, 1, 4, 4)
    (grad,) = torch.autograd.grad(net(x, depth=depth).square().sum(), depth)
    assert (grad[:, ::2, ::2] != 0).any() and (grad[:, 1::2] == 0).all()
    detached = depth.detach()
    net(x, depth=detached).sum().backward()


def test_idle_layers_are_named_once() -> None:
    class Choice(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.a, self.b, self.c = Probe(), Probe(), Probe()

        def forward(self, x: Tensor, names: str) -> None:
            for name in names:
                getattr(self, name)(x)

    net = DepthGuided(Choice())
    x, one = torch.zeros(1, 1, 2, 2), torch.ones(1, 2, 2)

    def messages(names: str) -> list[str]:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            net(x, names, depth=one)
        return [str(w.message) for w in caught]

    assert messages("abc") == []
    (message,) = messages("a")
    assert message == ("DepthGuided: 2 of 3 layers that take depth did not run in this call: b, c")
    assert messages("a") == []
    (message,) = messages("ab")
    assert message.endswith(": c")
    assert messages("a") == messages("ab") == messages("abc") == []
    with pytest.warns(UserWarning, match=": b"):
        net(x, "ac", depth=one)


def test_warning_points_at_the_caller() -> None:
    with pytest.warns(UserWarning, match="no layer") as caught:
        DepthGuided(nn.Identity())(torch.ones(1), depth=torch.ones(2, 2))
    assert caught[0].filename == __file__
