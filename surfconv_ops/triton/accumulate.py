"""Sums that many programs add to: by floating-point atomics, or bit for bit the same every time.

Floating-point atomics add in the order in which they arrive. Where torch asks for deterministic
algorithms, contributions are rounded to multiples of a common power of two and added as 64-bit
integers, whose sum does not depend on the order. That power is so small that 2^62 of it hold the
largest sum there can be; float64 has a second word for what the first rounds off.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

#: Bits of a 64-bit word that a sum may fill, with room for its sign and its roundings.
_BITS = 61


@triton.jit
def accumulate(sums_ptr, at, value, mask, factors_ptr, extent, WORDS: tl.constexpr):
    """Add ``value`` at places ``at``; ``WORDS`` is 0 for floating-point sums."""
    if WORDS == 0:
        tl.atomic_add(sums_ptr + at, value, mask=mask, sem="relaxed")
    else:
        scaled = value.to(tl.float64) * tl.load(factors_ptr)
        whole = tl.floor(scaled + 0.5)
        tl.atomic_add(sums_ptr + at, whole.to(tl.int64), mask=mask, sem="relaxed")
        if WORDS == 2:
            rest = tl.floor((scaled - whole) * tl.load(factors_ptr + 1) + 0.5)
            tl.atomic_add(sums_ptr + extent + at, rest.to(tl.int64), mask=mask, sem="relaxed")


@dataclass(frozen=True)
class Sums:
    """Where contributions go, and how the sums are read back."""

    words: int
    totals: Tensor
    factors: Tensor | None

    @classmethod
    def floating(cls, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Sums:
        """Sums in the order of arrival."""
        return cls(0, torch.zeros(shape, dtype=dtype, device=device), None)

    @classmethod
    def exact(cls, shape: tuple[int, ...], bound: Tensor, terms: int, words: int) -> Sums:
        """Sums of at most ``terms`` contributions, each at most ``bound`` in magnitude.

        A bound that is not finite makes every sum NaN.
        """
        bound = bound.double()
        # 2^exponent exceeds bound. Nothing is contributed where it is 0.
        exponent = torch.frexp(torch.where((bound > 0) & bound.isfinite(), bound, 1.0)).exponent
        spread = terms.bit_length()
        one = torch.ones_like(bound)
        first = torch.ldexp(one, _BITS - spread - exponent)
        first = torch.where(bound.isfinite(), first, torch.nan)
        factors = torch.stack((first, torch.ldexp(one, torch.full_like(exponent, _BITS - spread))))
        totals = torch.zeros((words, *shape), dtype=torch.int64, device=bound.device)
        return cls(words, totals, factors)

    def zero_(self) -> None:
        """Forget what was added."""
        self.totals.zero_()

    def result(self, dtype: torch.dtype) -> Tensor:
        """The sums in ``dtype``."""
        if self.factors is None and self.totals.dtype == dtype:
            return self.totals
        shape = self.totals.shape if self.factors is None else self.totals.shape[1:]
        return self.write(torch.empty(shape, dtype=dtype, device=self.totals.device))

    def write(self, out: Tensor) -> Tensor:
        """The sums, in ``out``: no second tensor of their size but where they are exact."""
        if self.factors is None:
            return out.copy_(self.totals)
        total = self.totals[0].double()
        if self.words == 2:
            total += self.totals[1].double() / self.factors[1]
        return out.copy_(total.div_(self.factors[0]))
