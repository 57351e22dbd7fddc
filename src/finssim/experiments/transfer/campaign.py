"""Many trials over several processes: resumable, each result a file of its own."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from pathlib import Path
from typing import Any

from finssim.experiments.running import Say
from finssim.experiments.transfer.job import Job
from finssim.files import atomic_write

__all__ = ["Play", "Show", "run_in_turn", "run_jobs"]

WATCH = 1.0
"""Time between two looks of a worker at its parent [s]."""

Play = Callable[[Job, Path], dict[str, Any]]
"""Plays a job, leaves its series in files that begin with the given path, and returns its result as plain data."""
Show = Callable[[Job, Mapping[str, Any]], None]
"""Given a job that has been played, and its result."""


def run_jobs(
    jobs: Sequence[Job],
    folder: Path,
    play: Play,
    *,
    processes: int | None = None,
    say: Say = lambda part, what: None,
    show: Show = lambda job, result: None,
) -> list[dict[str, Any]]:
    """Play what has no result yet; after Ctrl-C or a kill the next call goes on where this one was.

    Args:
        jobs: Trials; equal ones are played once.
        folder: Takes KEY.json of each, made if missing.
        play: A function of a module, as it is called in other processes.
        processes: As many as there are processors if None.
        say: Told the share that is done and what is left.
        show: Given each trial that is played now and its result, as soon as there is one.

    Returns:
        The results in the order of the jobs, each with its `job` and `key`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    keys = [job.key() for job in jobs]
    missing = {
        key: job for key, job in zip(keys, jobs, strict=True) if not (folder / f"{key}.json").is_file()
    }
    if missing:
        _play_all(missing, folder, play, processes or os.cpu_count() or 1, len(set(keys)), say, show)
    return [json.loads((folder / f"{key}.json").read_text(encoding="utf-8")) for key in keys]


def run_in_turn(
    jobs: Sequence[Job],
    folder: Path,
    play: Callable[[Job, Path], dict[str, Any] | None],
    *,
    show: Show = lambda job, result: None,
) -> list[dict[str, Any]]:
    """The same in this process, one after the other, for what there is only one of.

    Args:
        jobs: Trials; equal ones are played once, and those without a result are left out.
        folder: Takes KEY.json of each, made if missing.
        play: Its result; None: there is none yet, and the next call tries again.
        show: Given each trial that is played now and its result.
    """
    folder.mkdir(parents=True, exist_ok=True)
    results = []
    for job in {job.key(): job for job in jobs}.values():
        file = folder / f"{job.key()}.json"
        if not file.is_file():
            result = play(job, folder / job.key())
            if result is None:
                continue
            show(job, _write(job, folder, result))
        results.append(json.loads(file.read_text(encoding="utf-8")))
    return results


def _play_all(
    missing: dict[str, Job], folder: Path, play: Play, processes: int, total: int, say: Say, show: Show
) -> None:
    # A fork would copy the threads of Warp and torch half-alive.
    context = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(
        min(processes, len(missing)), mp_context=context, initializer=_prepare, initargs=(os.getpid(),)
    )
    try:
        jobs = {executor.submit(_play_one, key, job, folder, play): job for key, job in missing.items()}
        running: set[Future[dict[str, Any]]] = set(jobs)
        while running:
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                show(jobs[future], future.result())
            say(1.0 - len(running) / total, f"{len(running)} trials left")
    except BaseException:
        _stop(executor)
        raise
    executor.shutdown()


def _stop(executor: ProcessPoolExecutor) -> None:
    """End without waiting for trials that nobody will read."""
    workers = list((executor._processes or {}).values())
    executor.shutdown(wait=False, cancel_futures=True)
    for worker in workers:
        worker.terminate()


def _prepare(parent: int) -> None:
    """Of a worker: one thread, since there are as many workers as processors; no life without its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent hears Ctrl-C and ends its workers
    os.environ["OMP_NUM_THREADS"] = "1"
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    """End this process when its parent has gone, however that ended."""
    while os.getppid() == parent:
        time.sleep(WATCH)
    os._exit(1)


def _play_one(key: str, job: Job, folder: Path, play: Play) -> dict[str, Any]:
    return _write(job, folder, play(job, folder / key))


def _write(job: Job, folder: Path, played: Mapping[str, Any]) -> dict[str, Any]:
    """Write KEY.json of a result, with its job."""
    key = job.key()
    result = {"key": key, "job": {**job.described(), "row": job.row, "target": job.target}, **played}
    with atomic_write(folder / f"{key}.json") as temporary:
        temporary.write_text(json.dumps(result, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return result
