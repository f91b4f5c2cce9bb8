"""The implementations under test: the public function, and the readable reference."""

from __future__ import annotations

from helpers import Operator
from surfconv_ops import reference, surf_conv2d

OPERATORS: dict[str, Operator] = {"public": surf_conv2d, "reference": reference.surf_conv2d}

# Geometries that differ in kind; every file that needs a spread of them uses these.
GEOMETRIES = [
    {},
    {"stride": 2},
    {"padding": "same", "dilation": 2},
    {"padding": "valid"},
    {"kernel": (2, 4), "padding": "same"},
    {"kernel": (3, 2), "stride": (2, 3), "padding": (2, 0), "dilation": (1, 2)},
    {"kernel": 1, "padding": 0, "stride": 2},
    {"kernel": (5, 1), "padding": (3, 2), "dilation": (2, 1)},
    {"channels": 6, "out_channels": 4, "groups": 2},
    {"channels": 5, "out_channels": 10, "groups": 5},
    {"kernel": 4, "stride": 3, "padding": 5},
    {"size": (1, 1), "kernel": 3, "padding": 1},
    {"size": (2, 13), "kernel": 5, "padding": 2},
]


def name_of(case: dict[str, object]) -> str:
    return ",".join(f"{key}={value}" for key, value in case.items()).replace(" ", "") or "plain"
