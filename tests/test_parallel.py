"""Other processes and other threads: DataLoader workers, DDP, two Python threads at once."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import pytest
import torch
import torch.multiprocessing as mp
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from helpers import assert_same_bits, make_problem
from ranks import rank_of_two
from surfconv_ops import SurfConv2d, surf_conv2d


class Filtered(Dataset[Tensor]):
    """Frames that a worker filters before it hands them over."""

    def __init__(self) -> None:
        torch.manual_seed(3)
        self.conv = SurfConv2d(3, 5, 3, padding=1, reference_depth=2.0).requires_grad_(False)
        self.frames, self.depths = torch.randn(6, 3, 40, 50), torch.rand(6, 40, 50) + 0.5

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Tensor:
        out: Tensor = self.conv(self.frames[index], self.depths[index])
        return out


@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_data_loader_workers(start: str) -> None:
    torch.set_num_threads(2)
    data = Filtered()
    expected = torch.stack([data[i] for i in range(6)])
    loader = DataLoader(
        data, batch_size=2, num_workers=2, multiprocessing_context=start, timeout=120
    )
    assert_same_bits(torch.cat(list(loader)), expected)


FORK = """
import os, sys, torch
from surfconv_ops import surf_conv2d
torch.manual_seed(0)
torch.set_num_threads(2)
x, w = torch.randn(2, 8, 60, 60), torch.randn(8, 8, 3, 3, requires_grad=True)
scale = torch.rand(2, 60, 60) * 2
def run():
    out = surf_conv2d(x, w, scale=scale, padding=1)
    return out.detach(), torch.autograd.grad(out.sum(), w)[0]
before = run()
child = os.fork()
if child == 0:
    # OpenMP's threads do not survive a fork; one thread is what torch's own workers use.
    torch.set_num_threads(1)
    after = run()
    os._exit(0 if all(torch.equal(a, b) for a, b in zip(before, after)) else 1)
_, status = os.waitpid(child, 0)
assert os.waitstatus_to_exitcode(status) == 0
assert all(torch.equal(a, b) for a, b in zip(before, run()))
"""


def test_plain_fork() -> None:
    # Autograd forbids backward in a fork once its own threads run; on the CPU it has none.
    subprocess.run([sys.executable, "-c", FORK], check=True, timeout=120)


def test_two_python_threads_at_once() -> None:
    torch.set_num_threads(2)
    problems = [
        make_problem(2, 12, 14, (20, 23), seed=seed, guide="levels", layout=layout)
        for seed, layout in enumerate(["contiguous", "channels_last"] * 2)
    ]
    grad = torch.randn(problems[0].output_shape())
    expected = [(p.run(surf_conv2d), p.gradients(surf_conv2d, grad)) for p in problems]
    failures: list[BaseException] = []

    def work(index: int) -> None:
        try:
            for _ in range(15):
                assert_same_bits(problems[index].run(surf_conv2d), expected[index][0], "output")
                for name, value in problems[index].gradients(surf_conv2d, grad).items():
                    assert_same_bits(value, expected[index][1][name], name)
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    assert not any(thread.is_alive() for thread in threads)
    assert not failures, failures[0]


class Net(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.first = SurfConv2d(3, 6, 3, padding=1, reference_depth=2.0)
        self.second = SurfConv2d(6, 2, 3, padding=1, reference_depth=2.0)

    def forward(self, x: Tensor, depth: Tensor) -> Tensor:
        return self.second(torch.relu(self.first(x, depth)), depth)


def batch() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(5)
    x = torch.randn(4, 3, 8, 9, generator=generator)
    return x, torch.rand(4, 8, 9, generator=generator) + 0.5


def train(rank: int, folder: str) -> None:
    with rank_of_two(rank, folder):
        torch.manual_seed(7)
        net = nn.parallel.DistributedDataParallel(Net())
        optimizer = torch.optim.SGD(net.parameters(), 0.05)
        x, depth = (part[2 * rank : 2 * rank + 2] for part in batch())
        for _ in range(3):
            optimizer.zero_grad()
            net(x, depth).square().mean().backward()
            optimizer.step()
        torch.save(net.module.state_dict(), Path(folder) / f"{rank}.pt")


def test_two_processes_train_as_one(tmp_path: Path) -> None:
    mp.spawn(train, (str(tmp_path),), nprocs=2)
    states = [torch.load(tmp_path / f"{rank}.pt") for rank in (0, 1)]
    torch.manual_seed(7)
    net = Net()
    optimizer = torch.optim.SGD(net.parameters(), 0.05)
    for _ in range(3):
        optimizer.zero_grad()
        net(*batch()).square().mean().backward()
        optimizer.step()
    for name, value in net.state_dict().items():
        assert_same_bits(states[0][name], states[1][name], name)
        torch.testing.assert_close(states[0][name], value, rtol=1e-5, atol=1e-6)
