"""What convert_conv2d leaves alone, and what the conversion report says."""

from __future__ import annotations

import copy
import io
import pickle
import warnings
from collections.abc import Callable

import pytest
import torch
from torch import nn
from torch.nn.utils import parametrizations, prune, spectral_norm

from surfconv_ops import DepthGuided, SurfConv2d, conversion_report
from test_convert import LEVELS, convert


class Own(nn.Conv2d):
    pass


def replaced_forward() -> nn.Module:
    conv = nn.Conv2d(1, 1, 3)
    conv.forward = lambda x: x  # type: ignore[method-assign]
    return conv


def old_weight_norm() -> nn.Module:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return torch.nn.utils.weight_norm(nn.Conv2d(1, 1, 3))


ALONE: dict[str, tuple[Callable[[], nn.Module], str]] = {
    "1 x 1": (lambda: nn.Conv2d(1, 1, 1, stride=2), "1 x 1"),
    "subclass": (lambda: Own(1, 1, 3), "subclass of nn.Conv2d"),
    "lazy": (lambda: nn.LazyConv2d(1, 3), "subclass of nn.Conv2d"),
    "reflect": (lambda: nn.Conv2d(1, 1, 3, padding_mode="reflect"), "padding_mode='reflect'"),
    "circular": (lambda: nn.Conv2d(1, 1, 3, padding_mode="circular"), "padding_mode='circular'"),
    "weight norm": (lambda: parametrizations.weight_norm(nn.Conv2d(1, 1, 3)), "subclass"),
    "old weight norm": (old_weight_norm, "computed"),
    "spectral norm": (lambda: parametrizations.spectral_norm(nn.Conv2d(1, 1, 3)), "subclass"),
    "old spectral norm": (lambda: spectral_norm(nn.Conv2d(1, 1, 3)), "computed"),
    "pruned": (lambda: prune.l1_unstructured(nn.Conv2d(1, 1, 3), "weight", 2), "computed"),
    "pruned bias": (lambda: prune.random_unstructured(nn.Conv2d(1, 3, 3), "bias", 2), "computed"),
    "complex": (lambda: nn.Conv2d(1, 1, 3, dtype=torch.complex64), "complex64"),
    "forward": (replaced_forward, "forward was replaced"),
    "transposed": (lambda: nn.ConvTranspose2d(1, 1, 3), "counterpart"),
    "3D": (lambda: nn.Conv3d(1, 1, 3), "counterpart"),
    "max pool": (lambda: nn.MaxPool2d(2), "pools=True"),
    "average pool": (lambda: nn.AvgPool2d((2, 3)), "pools=True"),
    "adaptive": (lambda: nn.AdaptiveAvgPool2d(1), "counterpart"),
}  # fmt: skip


@pytest.mark.parametrize("case", ALONE)
def test_left_alone_and_reported(case: str) -> None:
    make, reason = ALONE[case]
    net = nn.Sequential(make(), nn.Conv2d(1, 1, 3))
    layer = net[0]
    for state in (net, convert(net)):
        row = conversion_report(state).rows[0]
        assert row.name == "0" and row.now == "unchanged" and reason in row.why
    assert net[0] is layer and type(net[1]) is SurfConv2d


TABLE = """\
layer  was                           now                                        why
0      Conv2d(3, 8, 7 x 7)           SurfConv2d(reference_depth=2.0, levels=3)
1      MaxPool2d(3 x 3)              unchanged                                  convert_conv2d changes pools with pools=True only
2      Conv2d(8, 4, 1 x 1)           unchanged                                  its 1 x 1 window reaches no neighbour
3      ConvTranspose2d(4, 2, 2 x 2)  unchanged                                  only nn.Conv2d, nn.MaxPool2d and nn.AvgPool2d have a counterpart
1 layers take depth, 3 are unchanged"""  # noqa: E501


def reloaded(net: nn.Module) -> nn.Module:
    buffer = io.BytesIO()
    torch.save(net, buffer)
    buffer.seek(0)
    loaded: nn.Module = torch.load(buffer, weights_only=False)
    return loaded


def test_report() -> None:
    net = nn.Sequential(nn.Conv2d(3, 8, 7), nn.MaxPool2d(3), nn.Conv2d(8, 4, 1),
                        nn.ConvTranspose2d(4, 2, 2))  # fmt: skip
    before = conversion_report(net)
    assert not before.converted and before.rows[0].why == "convert_conv2d was not called on it"
    convert(net, levels=LEVELS)
    for copied in (net, copy.deepcopy(net), pickle.loads(pickle.dumps(net)), reloaded(net)):
        assert str(conversion_report(copied)) == TABLE
    assert conversion_report(DepthGuided(net)).rows[0].name == "module.0"
    assert conversion_report(nn.Sequential(SurfConv2d(1, 1, 3, reference_depth=1.0))).rows == (
        ("0", "SurfConv2d(1, 1, 3 x 3)", "SurfConv2d(reference_depth=1.0)", ""),
    )
    assert str(conversion_report(nn.ReLU())).endswith("0 layers take depth, 0 are unchanged")
