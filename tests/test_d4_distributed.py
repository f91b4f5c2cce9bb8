"""D4.all_reduce between two processes of the gloo backend."""

from __future__ import annotations

import datetime
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.distributed
import torch.multiprocessing

from surfconv_ops import D4, d4

WORLD = 2


def many(seed: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).lognormal(2.0, 0.7, count).astype(np.float32)


def parts_of(case: str) -> list[list[np.ndarray]]:
    """What each process sees in a case: nothing, little, or more than the exact limit."""
    much = [many(0, 400), many(1, 300)]
    return {
        "alike": [[many(2, 50)], [many(3, 40)]],
        "one saw nothing": [[many(4, 90)], []],
        "only holes": [[np.zeros(7)], [many(5, 20)]],
        "bins and exact": [much, [many(6, 3)]],
        "exact and bins": [[many(7, 4)], much],
        "bins": [much, [many(8, 500)]],
    }[case]


CASES = ["alike", "one saw nothing", "only holes", "bins and exact", "exact and bins", "bins"]


def message_of(action: Callable[[], Any]) -> str:
    try:
        action()
    except (RuntimeError, ValueError) as error:
        return f"{type(error).__name__}: {error}"
    return "no error"


def process(rank: int, folder: str) -> None:
    """One process: all cases, its results in a file."""
    # Few enough for small cases to be in bins, many enough for others to be exact.
    d4.EXACT_LIMIT = 100
    torch.distributed.init_process_group(
        "gloo",
        init_method=(Path(folder) / "meeting").as_uri(),
        rank=rank,
        world_size=WORLD,
        timeout=datetime.timedelta(seconds=60),
    )
    results: dict[str, Any] = {}
    for case in CASES:
        fitted = D4(4, 1.5)
        for depth in parts_of(case)[rank]:
            fitted.update(torch.from_numpy(depth))
        assert fitted.all_reduce() is fitted
        results[case] = {
            "exact": fitted.exact,
            "pixels": [fitted.pixels, fitted.valid_pixels],
            "table": [column.tolist() for column in fitted.table],
            **fitted.fit().to_dict(),
        }
        fitted.update(np.full(3, 1000.0))
        assert fitted.table.high[-1] == 1000.0
    alone = torch.distributed.new_group([1])
    results["gamma"] = message_of(D4(4, 1.0 + rank).all_reduce)
    results["group"] = message_of(lambda: D4(4).update(np.ones(3)).all_reduce(alone))
    results["nobody saw anything"] = message_of(lambda: D4(4).all_reduce().fit())
    (Path(folder) / f"{rank}.json").write_text(json.dumps(results))
    torch.distributed.destroy_process_group()


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    if not torch.distributed.is_available() or not torch.distributed.is_gloo_available():
        pytest.skip("this torch is built without gloo")
    folder = tmp_path_factory.mktemp("processes")
    torch.multiprocessing.spawn(process, (str(folder),), nprocs=WORLD)
    return [json.loads((folder / f"{rank}.json").read_text()) for rank in range(WORLD)]


@pytest.mark.parametrize("case", CASES)
def test_all_processes_hold_the_whole(
    case: str, results: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(d4, "EXACT_LIMIT", 100)
    whole = D4(4, 1.5)
    for part in parts_of(case):
        for depth in part:
            whole.update(depth)
    assert results[0][case] == results[1][case]
    result = results[0][case]
    assert result["exact"] == whole.exact == ("bins" not in case)
    assert result["pixels"] == [whole.pixels, whole.valid_pixels]
    for column, wanted in zip(result["table"], whole.table, strict=True):
        np.testing.assert_allclose(column, wanted, rtol=1e-13)
    assert result["edges"] == list(whole.fit().edges)
    assert result["centers"] == pytest.approx(whole.fit().centers, rel=1e-13)


def test_errors_in_a_group(results: list[dict[str, Any]]) -> None:
    for result in results:
        assert result["gamma"] == "ValueError: other: expected one with gamma = 1.0, got 2.0"
        assert result["nobody saw anything"].startswith("ValueError: depths: expected at least one")
    assert results[0]["group"] == "ValueError: group: this process is not a member of it"
    assert results[1]["group"] == "no error"


def test_without_process_group() -> None:
    with pytest.raises(RuntimeError, match=r"all_reduce: torch\.distributed is not initialised"):
        D4(4).update(torch.ones(3)).all_reduce()
