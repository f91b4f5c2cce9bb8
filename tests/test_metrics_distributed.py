"""SegmentationMetrics over two processes."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp

from surfconv_ops import SegmentationMetrics

PROCESSES = 2
pytestmark = pytest.mark.skipif(
    not (dist.is_available() and dist.is_gloo_available()), reason="torch has no gloo"
)


def problem() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    prediction, target = torch.randint(0, 4, (2, 5, 6, 7), generator=generator)
    return prediction, target, 30 * torch.rand(5, 6, 7, generator=generator) - 3


def work(rank: int, folder: str) -> None:
    torch.set_num_threads(1)
    dist.init_process_group(
        "gloo", init_method=f"file://{folder}/store", rank=rank, world_size=PROCESSES
    )
    # The second process has one image, the first has four.
    metrics = SegmentationMetrics(4)
    metrics.update(*(map[rank * 4 : rank * 4 + 4] for map in problem()))
    assert metrics.all_reduce() is metrics
    torch.save(metrics, f"{folder}/metrics{rank}.pt")
    differing = SegmentationMetrics(4, ignore_index=rank)
    try:
        differing.all_reduce()
    except ValueError as error:
        Path(folder, f"message{rank}").write_text(str(error))
    dist.destroy_process_group()


def test_all_reduce_over_two_processes(tmp_path: Path) -> None:
    mp.spawn(work, args=(str(tmp_path),), nprocs=PROCESSES)
    whole = SegmentationMetrics(4)
    whole.update(*problem())
    ranks = [
        torch.load(tmp_path / f"metrics{rank}.pt", weights_only=False) for rank in range(PROCESSES)
    ]
    for metrics in ranks:
        assert torch.equal(metrics.confusion_img, whole.confusion_img)
        torch.testing.assert_close(
            metrics.confusion_surf, whole.confusion_surf, rtol=1e-14, atol=0.0
        )
    assert repr(ranks[0].compute()) == repr(ranks[1].compute())
    for rank in range(PROCESSES):
        message = (tmp_path / f"message{rank}").read_text()
        assert message.startswith("other: expected the arguments of")


def test_without_a_process_group() -> None:
    with pytest.raises(RuntimeError, match="not initialised"):
        SegmentationMetrics(4).all_reduce()
