"""Objects of all processes, for classes that add them up."""

from __future__ import annotations

from typing import TypeVar

import torch

Part = TypeVar("Part")


def gather_parts(part: Part, group: torch.distributed.ProcessGroup | None) -> list[Part]:
    """Every process's ``part``, in the order of their ranks.

    Gathered, not reduced, so that all processes can add them in one order and get the same bits.

    Raises:
        RuntimeError: torch.distributed is not initialised.
        ValueError: This process is not in the group.
    """
    distributed = torch.distributed
    if not (distributed.is_available() and distributed.is_initialized()):
        raise RuntimeError(
            "all_reduce: torch.distributed is not initialised; call"
            " torch.distributed.init_process_group in every process first, or add up objects"
            " of one process with merge"
        )
    if distributed.get_rank(group) < 0:
        raise ValueError("group: this process is not a member of it")
    parts: list[Part | None] = [None] * distributed.get_world_size(group)
    distributed.all_gather_object(parts, part, group)
    return parts  # type: ignore[return-value]
