"""Jobs on Ray: a local one, or a cluster that is there; a worker that is lost is made up for."""

from __future__ import annotations

import contextlib
import ipaddress
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
SINGLE_MACHINE = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
"""Variable that is 0 where Ray makes no clusters: only there it keeps 127.0.0.1 as a node's address and listens on it
alone; elsewhere it takes the machine's address on the network in its place, whatever address it is given."""
RETRIES = 3
"""How often a job is begun anew after its worker was lost."""


@contextlib.contextmanager
def running(address: str | None, processes: int | None) -> Iterator[int]:
    """Ray for as long as it is needed; gives how many jobs run at once.

    Args:
        address: Of a cluster to join; a local one, on the loopback interface alone, if None.
        processes: Of a local one; as many as there are processors if None.

    Raises:
        SweepError: Ray is not installed, nothing answers at the address, or a local one would listen on the network.
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
    with contextlib.nullcontext() if address else _loopback_alone():
        try:
            ray.init(
                **({"address": address} if address else local),
                log_to_driver=False,
                logging_level=logging.ERROR,
                runtime_env={"env_vars": {"OMP_NUM_THREADS": "1"}},
            )
        except (ConnectionError, ValueError, RuntimeError) as error:
            what = (
                f"no Ray cluster answers at {address}" if address else "a Ray of its own does not start here"
            )
            raise SweepError(f"{what}: {str(error).splitlines()[0]}") from error
        try:
            here = ray.util.get_node_ip_address()
            if not address and not ipaddress.ip_address(here).is_loopback:
                raise SweepError(
                    f"Ray {ray.__version__} listens at {here} and not on the loopback interface alone: "
                    "install the version of constraints.txt, or give --address of a cluster"
                )
            yield int(ray.cluster_resources().get("CPU", 1))
        finally:
            ray.shutdown()


@contextlib.contextmanager
def _loopback_alone() -> Iterator[None]:
    """A Ray that begins in here, and its processes, listen on the loopback interface alone."""
    from ray._private import ray_constants

    before, enabled = os.environ.get(SINGLE_MACHINE), ray_constants.ENABLE_RAY_CLUSTER
    os.environ[SINGLE_MACHINE] = "0"  # for the processes that Ray starts
    ray_constants.ENABLE_RAY_CLUSTER = False  # for this one, in which the variable has been read already
    try:
        yield
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = enabled
        os.environ.pop(SINGLE_MACHINE)
        if before is not None:
            os.environ[SINGLE_MACHINE] = before


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
