"""Plays for campaigns: quick, and known beforehand."""

import os
import time
from pathlib import Path


def known(job, path: Path):
    """A result that follows from the job, and a mark that it was played."""
    with path.with_name("played.txt").open("a") as file:
        file.write(f"{job.target}\n")
    return {"success": job.target != "P02", "e_p_m": 0.01 * job.plant + 0.001 * job.seed, "fault": ""}


def failing(job, path: Path):
    """The trial of P02 breaks."""
    if job.target == "P02":
        raise RuntimeError("P02 broke")
    return known(job, path)


def endless(job, path: Path):
    """Tells its process, and never ends by itself."""
    path.with_name("pid.txt").write_text(str(os.getpid()))
    time.sleep(600.0)
