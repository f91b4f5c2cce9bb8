"""Fixtures that every test shares; tolerances and problem builders are in helpers.py."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, settings

# Without a GPU the CUDA backend's kernels run in Triton's interpreter, which has to be chosen
# before they are imported.
if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")

settings.register_profile(
    "suite",
    deadline=None,
    derandomize=True,
    database=None,
    max_examples=60,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
settings.register_profile("thorough", settings.get_profile("suite"), max_examples=2000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "suite"))


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "core: the subset that runs under sanitizers")
    config.addinivalue_line("markers", "gpu: what needs a CUDA device (make test-gpu)")
    # Two workers with two threads each on two cores spend their time waiting for one another.
    if "PYTEST_XDIST_WORKER" in os.environ:
        torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _isolation() -> Iterator[None]:
    """Every test starts from one seed and leaves the thread count as it found it."""
    threads = torch.get_num_threads()
    torch.manual_seed(0)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def set_threads() -> Callable[[int], None]:
    """Sets torch's thread count for the rest of the test."""
    return torch.set_num_threads


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of real frames that SURFCONV_DATA names."""
    name = os.environ.get("SURFCONV_DATA")
    if not name:
        pytest.skip("SURFCONV_DATA is not set: no real frames to run on")
    folder = Path(name)
    if not folder.is_dir():
        pytest.fail(f"SURFCONV_DATA={name} is not a folder")
    return folder


@pytest.fixture
def compiled() -> None:
    """Skips where only the fallback is there to test."""
    from surfconv_ops import _loader  # not before the interpreter is chosen above

    if _loader.missing_library_reason is not None:
        pytest.skip(f"the compiled library is not loaded: {_loader.missing_library_reason}")
