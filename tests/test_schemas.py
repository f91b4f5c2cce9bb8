"""The operators' schemas: one in C++, one for machines without a compiler, both the same."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from surfconv_ops import _fallback, depth_ops, depth_resize, pool_fallback

SOURCE = Path(__file__).parent.parent / "csrc" / "library.cpp"
SCHEMAS = {
    "surf_conv2d": _fallback.FORWARD_SCHEMA,
    "surf_conv2d_backward": _fallback.BACKWARD_SCHEMA,
    "level_values": _fallback.LEVEL_VALUES_SCHEMA,
    "nearest_depth": depth_resize.SCHEMA,
    "depth_to_scale": depth_ops.FORWARD_SCHEMA,
    "depth_to_scale_backward": depth_ops.BACKWARD_SCHEMA,
} | pool_fallback.SCHEMAS


def normal(schema: str) -> str:
    return re.sub(r"\s+", "", schema)


@pytest.mark.parametrize("name", SCHEMAS)
def test_registered_schema(name: str) -> None:
    registered = str(getattr(torch.ops.surfconv, name).default._schema)
    assert normal(registered) == normal("surfconv::" + SCHEMAS[name])


@pytest.mark.parametrize("name", SCHEMAS)
def test_source_schema(name: str) -> None:
    """Adjacent string literals joined as the compiler does."""
    text = re.sub(r'"\s*"', "", SOURCE.read_text())
    found = [s for s in re.findall(r'"([^"]*)"', text) if s.startswith(name + "(")]
    assert [normal(s) for s in found] == [normal(SCHEMAS[name])]


def test_capability(compiled: None) -> None:
    assert torch.ops.surfconv.cpu_capability() in ("default", "avx2", "avx512")
