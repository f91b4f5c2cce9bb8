"""What the CUDA backend allocates beside its results; no kernel runs here."""

from __future__ import annotations

import weakref
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

pytest.importorskip("triton", reason="the CUDA backend's kernels need Triton")

from surfconv_ops.triton import gradients, kernels


class Live(TorchDispatchMode):
    """Counts the bytes of all storages made under it, and the most at a time."""

    def __init__(self, given: list[Tensor]) -> None:
        super().__init__()
        self.now = self.peak = 0
        self._known = {t.untyped_storage()._cdata: 0 for t in given}

    def __torch_dispatch__(self, call: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        made = call(*args, **(kwargs or {}))
        for tensor in tree_leaves(made):
            if not isinstance(tensor, Tensor):
                continue
            storage = tensor.untyped_storage()
            if storage._cdata not in self._known:
                self._known[storage._cdata] = storage.nbytes()
                self.now += storage.nbytes()
                self.peak = max(self.peak, self.now)
                weakref.finalize(storage, self._forget, storage._cdata)
        return made

    def _forget(self, key: int) -> None:
        self.now -= self._known.pop(key)


class NoKernel:
    def __getitem__(self, grid: Any) -> Any:
        return lambda *args, **constants: None


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32], ids=str)
@pytest.mark.parametrize(("channels", "size"), [(64, (60, 80)), (256, (60, 80)), (512, (30, 40))])
def test_beside_the_results(
    channels: int, size: tuple[int, int], dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Output and gradients are what nn.Conv2d holds as well; 15 % more is allowed."""
    monkeypatch.setattr(kernels, "needs_float32", lambda input: False)
    monkeypatch.setattr(kernels, "forward_kernel", NoKernel())
    monkeypatch.setattr(gradients, "_LEAST_SUM_BYTES", 0)
    for name in ("backward_data_kernel", "backward_weight_kernel"):
        monkeypatch.setattr(gradients, name, NoKernel())
    x = torch.empty(8, channels, *size, dtype=dtype).to(memory_format=torch.channels_last)
    grad = torch.empty_like(x)
    weight, bias = torch.empty(channels, channels, 3, 3, dtype=dtype), torch.empty(channels)
    scale = torch.empty(8, 1, *size)
    options = (None, 0.0, (1, 1), (1, 1), (1, 1), 1)
    live = Live([x, grad, weight, bias, scale])
    with live:
        kept = kernels.forward(x, weight, bias.to(dtype), scale, *options)
        needed = kernels.backward(grad, x, weight, scale, *options, True, True, True, True)
    results = sum(t.nbytes for t in (kept, *needed))
    assert results < live.peak <= 1.15 * results
