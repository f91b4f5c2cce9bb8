"""The kernels, loaded without torch's operator library in between."""

from __future__ import annotations

from types import ModuleType

import build_kernels
import pytest
from native_operator import INSTRUCTION_SETS, NativeOperator


@pytest.fixture(scope="session")
def kernels() -> ModuleType:
    reason = build_kernels.why_not()
    if reason is not None:
        pytest.skip(reason)
    return build_kernels.load()


@pytest.fixture(params=INSTRUCTION_SETS)
def native(request: pytest.FixtureRequest, kernels: ModuleType) -> NativeOperator:
    """Each instruction set in turn."""
    if request.param not in kernels.names():
        pytest.skip(f"this processor does not run {request.param}")
    return NativeOperator(kernels, request.param)
