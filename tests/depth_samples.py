"""Depths to fit levels to, and how to stream them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import strategies as st

from surfconv_ops import D4

INVALID = [0.0, -0.0, -2.0, math.nan, math.inf, -math.inf]
# What an edge from bins can be off by: 12 bits of the mantissa.
BIN = 2.0**-12
few_levels = pytest.mark.filterwarnings("ignore:depth levels. asked for")

coarse = st.integers(1, 12).map(float)
# Several to a bin: 5 m lies in bins of 2**-10 m.
close = st.integers(0, 40).map(lambda i: 5.0 + i * 2.0**-12)
metres = st.floats(2.0**-10, 2.0**10, width=32)
depth_lists = st.lists(st.one_of(coarse, close, metres, st.sampled_from(INVALID)), max_size=40)
some_valid = st.tuples(depth_lists, metres).map(lambda parts: [*parts[0], parts[1]])
level_counts = st.integers(1, 9)
whole_gammas = st.integers(-3, 4)


def stream(depths: list[float], num_levels: int, gamma: float, chunk: int = 3) -> D4:
    fitted = D4(num_levels, gamma)
    for start in range(0, len(depths), chunk):
        fitted.update(np.array(depths[start : start + chunk]))
    return fitted


def normal_depths(count: int = 6000) -> np.ndarray:
    return np.random.default_rng(0).lognormal(2.0, 0.8, count).astype(np.float32)
