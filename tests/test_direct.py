"""What direct.py asks of PyTorch is a short cut: without it the results are the same."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.nn import Module

from helpers import assert_same_bits
from surfconv_ops import SurfAvgPool2d, SurfConv2d, SurfMaxPool2d, direct

LAYERS: dict[str, Callable[[], Module]] = {
    "conv": lambda: SurfConv2d(3, 4, 3, padding=1, reference_depth=2.0),
    "max": lambda: SurfMaxPool2d(3, padding=1, reference_depth=2.0),
    "avg": lambda: SurfAvgPool2d(3, padding=1, reference_depth=2.0),
}


@pytest.mark.parametrize("name", LAYERS)
@pytest.mark.parametrize("missing", ["transforms", "below", "level"])
def test_without_pytorch_s_private_means(
    missing: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A torch that lacks them is slower, not different."""
    layer = LAYERS[name]()
    x, depth = torch.randn(1, 3, 6, 7, requires_grad=True), torch.rand(1, 6, 7) * 4 - 0.5
    leaves = (x, depth.requires_grad_(), *layer.parameters())

    def results() -> list[Tensor]:
        with torch.no_grad():
            plain = layer(x, depth)
        out = layer(x, depth)
        return [plain, out.detach(), *torch.autograd.grad(out.sum(), leaves)]

    expected = results()
    if missing == "transforms":
        monkeypatch.setattr(direct, "_transforms_active", lambda: True)
    if missing == "below":
        monkeypatch.setattr(direct, "_below_autograd", nullcontext)
    if missing == "level":
        monkeypatch.delattr(forward_ad, "_current_level")
        monkeypatch.setattr(
            forward_ad, "unpack_dual", lambda t: forward_ad.UnpackedDualTensor(t, None)
        )
    for ours, eager in zip(results(), expected, strict=True):
        assert_same_bits(ours, eager)
