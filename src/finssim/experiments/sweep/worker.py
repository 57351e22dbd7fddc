"""What a worker of a sweep does: one training, its evaluation, and the whole of both back in one piece."""

from __future__ import annotations

import io
import os
import tarfile
import tempfile
import time
from pathlib import Path
from typing import Any

from finssim.experiments.sweep.plan import Job

__all__ = ["play", "unpack"]

POLICY = "policy"


def play(job: Job) -> tuple[dict[str, Any], bytes]:
    """Train and evaluate.

    Returns:
        A row of the table (results by plant, time, machine) and the policy directory, packed.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    import socket

    from rich.console import Console

    from finssim.experiments.evaluate import evaluate_controller
    from finssim.experiments.plants import load_plant
    from finssim.learning.train import train

    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / POLICY
        quiet = Console(file=io.StringIO())
        train(job.task, out=out, vehicle=job.vehicle, seed=job.seed, console=quiet, **job.options)
        trained = time.perf_counter() - began
        results = {
            plant.name: evaluate_controller(
                out, plant, task=job.task, vehicle=job.vehicle, trials=job.trials
            ).result
            for plant in map(load_plant, job.plants)
        }
        row = {"training_s": trained, "machine": socket.gethostname(), "plants": results}
        return row, _packed(out)


def _packed(folder: Path) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w:gz") as archive:
        for path in sorted(folder.iterdir()):
            archive.add(path, arcname=path.name)
    return stream.getvalue()


def unpack(content: bytes, folder: Path) -> None:
    """Write what `play` packed into a folder."""
    with tarfile.open(fileobj=io.BytesIO(content), mode="r:gz") as archive:
        archive.extractall(folder, filter="data")
