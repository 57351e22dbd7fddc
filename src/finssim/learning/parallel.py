"""Training in several processes, each with some of the worlds, on its own GPU or thread of a CPU.

Every process computes its part of each batch of PPO, and `torch.distributed` averages the gradients before each step
of the optimiser, so that all have the same networks. The caller's process is the first of the group: it evaluates and
writes checkpoints, and terminates the others.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np

from finssim.core.system import prepare_worker
from finssim.learning.layers import Array

LOOPBACK = {"linux": "lo", "darwin": "lo0"}
"""Platform -> network interface over which gloo connects the processes."""
PATIENCE = timedelta(minutes=30)
"""Time for which a process waits for the others; the first one also evaluates and writes checkpoints."""


class Group:
    """Group of processes that share one training."""

    def __init__(self, rank: int, size: int, meeting: Path, device: str) -> None:
        """Join the group, and wait until all processes have joined.

        Args:
            rank: Number of this process, from 0.
            size: Number of processes.
            meeting: File for the rendezvous of the processes.
            device: cpu (connected by gloo) or cuda (by NCCL).
        """
        import torch
        from torch import distributed

        if device != "cpu":
            torch.cuda.set_device(rank)
        if sys.platform in LOOPBACK:
            os.environ.setdefault("GLOO_SOCKET_IFNAME", LOOPBACK[sys.platform])
        self.rank, self.size = rank, size
        self.device = "cpu" if device == "cpu" else f"cuda:{rank}"
        distributed.init_process_group(
            "gloo" if device == "cpu" else "nccl", init_method=f"file://{meeting}", rank=rank, world_size=size,
            timeout=PATIENCE,
        )  # fmt: skip

    def average(self, array: Array) -> None:
        """Replace an array by its mean over all processes; every process must call this in the same order."""
        from torch import distributed

        distributed.all_reduce(array)
        array /= self.size

    def seed(self, seed: int) -> int:
        """Return the seed of this process's worlds and action noise: the training's own in the first process."""
        if self.rank == 0:
            return seed
        return int(np.random.SeedSequence([seed, self.rank]).generate_state(1)[0] >> 1)

    def close(self) -> None:
        """Leave the group."""
        from torch import distributed

        distributed.destroy_process_group()


@contextmanager
def leading(size: int, device: str, follow: Callable[..., None], *arguments: Any) -> Iterator[Group | None]:
    """Start the other processes of a training, and terminate them at the end of the block.

    Args:
        size: Number of processes, including this one; with 1 there is no group.
        device: cpu or cuda.
        follow: Module-level function that each of the others calls with its `Group` and the arguments.
        arguments: Further arguments of `follow`.

    Yields:
        The group with this process as the first; None if it is the only one.
    """
    if size == 1:
        yield None
        return
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory(prefix="finssim-training-") as folder:
        meeting = Path(folder) / "meeting"
        others = [
            context.Process(
                target=_join, args=(os.getpid(), rank, size, meeting, device, follow, arguments), daemon=True
            )
            for rank in range(1, size)
        ]
        for other in others:
            other.start()
        try:
            group = Group(0, size, meeting, device)
            yield group
            group.close()
        finally:
            for other in others:
                other.terminate()
                other.join()


def _join(
    parent: int,
    rank: int,
    size: int,
    meeting: Path,
    device: str,
    follow: Callable[..., None],
    arguments: tuple[Any, ...],
) -> None:
    prepare_worker(parent)
    follow(Group(rank, size, meeting, device), *arguments)
