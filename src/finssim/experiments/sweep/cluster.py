"""Jobs on Ray: a local one, or a cluster that is there; a worker that is lost is made up for."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from finssim.experiments.sweep.plan import Job, SweepError
from finssim.experiments.sweep.worker import play

__all__ = ["running", "spread"]

PATIENCE = 10.0
"""For an answer to a first knock [s]."""
RETRIES = 3
"""How often a job is begun anew after its worker was lost."""


@contextlib.contextmanager
def running(address: str | None, processes: int | None) -> Iterator[int]:
    """Ray for as long as it is needed; gives how many jobs run at once.

    Args:
        address: Of a cluster to join; a local one, on the loopback interface alone, if None.
        processes: Of a local one; as many as there are processors if None.

    Raises:
        SweepError: Ray is not installed, or nothing answers at the address.
    """
    try:
        import ray
    except ImportError as error:
        raise SweepError("a sweep needs Ray: pip install 'finssim[sweep]'") from error
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if address is not None:
        _knock(address)
    local: dict[str, Any] = {
        "address": "local",  # without it Ray joins a cluster that RAY_ADDRESS names, or the last one begun here
        "num_cpus": processes,
        "include_dashboard": False,
        "_node_ip_address": "127.0.0.1",
    }
    try:
        ray.init(
            **({"address": address} if address else local),
            log_to_driver=False,
            logging_level=logging.ERROR,
            runtime_env={"env_vars": {"OMP_NUM_THREADS": "1"}},
        )
    except (ConnectionError, ValueError, RuntimeError) as error:
        what = f"no Ray cluster answers at {address}" if address else "a Ray of its own does not start here"
        raise SweepError(f"{what}: {str(error).splitlines()[0]}") from error
    try:
        yield int(ray.cluster_resources().get("CPU", 1))
    finally:
        ray.shutdown()


def _knock(address: str) -> None:
    """Refuse an address where nothing listens at once: Ray itself tries for minutes."""
    if address == "auto":
        return
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit():
        raise SweepError(f"address is '{address}', expected HOST:PORT or auto")
    try:
        socket.create_connection((host, int(port)), timeout=PATIENCE).close()
    except (OSError, OverflowError) as error:
        raise SweepError(f"no Ray cluster answers at {address}: {error}") from error


def spread(jobs: Sequence[Job], done: Callable[[Job, dict[str, Any] | None, bytes, str], None]) -> None:
    """Run jobs, each on a processor of its own, in any order.

    A job whose worker or whose machine is lost begins anew elsewhere, `RETRIES` times.

    Args:
        jobs: What to do.
        done: Told of every job as it ends: its row and its policy, or None, nothing and what went wrong.
    """
    import ray

    task = ray.remote(num_cpus=1, max_retries=RETRIES)(play)
    waiting = {task.remote(job): job for job in jobs}
    while waiting:
        ready, _ = ray.wait(list(waiting), num_returns=1)
        for reference in ready:
            job = waiting.pop(reference)
            try:
                row, content = ray.get(reference)
            except ray.exceptions.RayTaskError as error:  # the job itself raised
                cause = error.cause or error
                done(job, None, b"", f"{type(cause).__name__}: {cause}")
            except ray.exceptions.RayError as error:
                done(job, None, b"", f"lost {RETRIES + 1} times: {str(error).splitlines()[0]}")
            else:
                done(job, row, content, "")
