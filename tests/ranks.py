"""Two processes that train one net with DistributedDataParallel."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch
import torch.distributed as dist


@contextmanager
def rank_of_two(rank: int, folder: str) -> Iterator[None]:
    """Makes a process that `mp.spawn` started one rank of a group, and ends the process after."""
    torch.set_num_threads(1)
    store = f"file://{folder}/store"
    dist.init_process_group("gloo", init_method=store, rank=rank, world_size=2)
    yield
    dist.destroy_process_group()
    # DDP keeps gloo's threads alive past this, and one that frees a gradient while the interpreter
    # ends aborts the process (pytorch/pytorch#190489): no ending of the interpreter, no abort.
    os._exit(0)
