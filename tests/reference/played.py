"""Trial functions for campaigns: quick, with known results."""

import os
import time
from pathlib import Path


def known(job, path: Path):
    """Return a result that follows from the job, and write a mark that it was played."""
    with path.with_name("played.txt").open("a") as file:
        file.write(f"{job.target}\n")
    return {"success": job.target != "P02", "e_p_m": 0.01 * job.plant + 0.001 * job.seed, "fault": ""}


def failing(job, path: Path):
    """Fail in the trial of P02."""
    if job.target == "P02":
        raise RuntimeError("P02 broke")
    return known(job, path)


def endless(job, path: Path):
    """Write the process id, and run without end."""
    path.with_name("pid.txt").write_text(str(os.getpid()))
    time.sleep(600.0)
