"""Execution of experiments: a progress bar, and trials in several processes, which a later call continues."""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import json
import logging
import multiprocessing
import os
import re
import socket
import tempfile
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from finssim.agents.controllers import CONTROLLERS
from finssim.control.policy import DESCRIPTION_FILE, NETWORK_FILE
from finssim.core.files import atomic_write, contents, plain_name
from finssim.core.progress import Progress, progress_bar
from finssim.core.quiet import start_warp
from finssim.core.system import prepare_worker
from finssim.core.yaml_file import json_value, read_json
from finssim.evaluation.tables import Table, print_tables, write_page
from finssim.vehicles import load_vehicle

ONE_THREAD = {"OMP_NUM_THREADS": "1", "FINSSIM_THREADS": "1"}
"""Environment of a worker: one thread each, as there are as many workers as processors."""
SETTINGS = 4
"""Type of an HTTP/2 SETTINGS frame."""
PATIENCE = 10.0
"""Timeout of the first connection to a cluster [s]."""
RETRIES = 3
"""Number of restarts of work on a cluster after its worker was lost."""


class ClusterError(ValueError):
    """Ray cluster that is unavailable, or that lost its work."""


def run_experiment(
    name: str,
    work: Callable[..., dict[str, Any]],
    tables: Callable[[Mapping[str, Any]], Sequence[Table]],
    /,
    *,
    as_json: bool = False,
    bar: bool = True,
    **options: Any,
) -> dict[str, Any]:
    """Run an experiment with a progress bar on standard error and print its tables.

    Args:
        name: Label of the bar.
        work: The experiment, which writes its directory `out`, if it has one, itself; it is called with the
            options, and with `progress` if it accepts it.
        tables: Function that returns the tables of the result.
        as_json: True to print one JSON object instead of the tables.
        bar: True to show the bar; False if the work prints its own progress.
        options: Options of the work.

    Returns:
        The result of `work`.
    """
    start_warp()
    if {"progress", "options"} & set(inspect.signature(work).parameters):
        with progress_bar(name, visible=bar) as progress:
            result = work(progress=progress, **options)
    else:
        result = work(**options)
    if as_json:
        print(json.dumps(result, allow_nan=False))
        return result
    console = Console()
    print_tables(tables(result), console)
    if options.get("out") is not None:
        console.print(f"written: {options['out']}", highlight=False, soft_wrap=True)
    return result


def check_choices(
    names: Sequence[str], available: Mapping[str, Any] | Sequence[str], kind: str, error: type[Exception]
) -> None:
    """Refuse a name that does not exist, in a sentence with the available ones."""
    for name in names:
        if name not in available:
            raise error(f"unknown {kind} '{name}'; available: {', '.join(available)}")


class ResultError(ValueError):
    """Stored result that cannot be continued; the message is one sentence."""


def write_json(path: Path, result: Mapping[str, Any], tables: Sequence[Table] = ()) -> None:
    """Write a result, and its HTML page beside it with the suffix .html.

    Raises:
        ResultError: The result contains a non-finite number.
    """
    try:
        text = json.dumps(result, indent=1, allow_nan=False)
    except ValueError:
        raise ResultError(
            f"{path}: not written, since it contains a non-finite number: look for one in its inputs"
        ) from None
    with atomic_write(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
    if tables:
        write_page(path.with_suffix(".html"), tables[0].title, tables)


def keep_result(path: Path, result: Mapping[str, Any]) -> None:
    """Write a result that a later call continues, with its digest."""
    write_json(path, {**result, "sha256": _digest(result)})


def load_result(path: Path) -> dict[str, Any]:
    """Return a result that `keep_result` wrote.

    Raises:
        ResultError: The file has been changed.
    """
    try:
        result = read_json(path, ResultError, such_as="sha256")
    except ResultError as error:
        raise ResultError(f"{error}: remove it to compute it again") from None
    if result.pop("sha256") != _digest(result):
        raise ResultError(f"{path}: has been changed since it was written: remove it to compute it again")
    return result


def _digest(result: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the result as read from its file."""
    read = json_value(json.dumps(result), ResultError, "result")
    return hashlib.sha256(json.dumps(read, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True, kw_only=True)
class Job:
    """One trial as plain data: equal jobs have equal results, and a result is stored under its key."""

    row: str
    """Row of the table."""
    target: str
    """Goal of the trial."""
    plant: int = 1
    """Seed of the pool, or number of the plant."""
    seed: int = 1
    """Seed of the noise."""

    def described(self) -> dict[str, Any]:
        """Return all data that determines the result, with the contents of files instead of their names."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        del values["row"]
        return {name: _content(name, value) for name, value in values.items()}

    def key(self) -> str:
        """Return the file name of the result: a readable part, and a digest of all data that determines it."""
        digest = hashlib.sha256(json.dumps(self.described(), sort_keys=True).encode()).hexdigest()[:10]
        name = re.sub(r"[^A-Za-z0-9.+-]+", "_", f"{self.row}_{self.target}")
        return f"{name}_plant{self.plant}_seed{self.seed}_{digest}"


def _content(name: str, value: Any) -> Any:
    """Return a field of a job as plain data: the SHA-256 of a vehicle, of a policy's files, of a programme."""
    if name in ("vehicle", "pool_vehicle"):
        return load_vehicle(value).sha256
    if name == "controller" and value not in CONTROLLERS:
        files = {file: (Path(value) / file).read_bytes() for file in (DESCRIPTION_FILE, NETWORK_FILE)}
        return {file: hashlib.sha256(data).hexdigest() for file, data in files.items()}
    if hasattr(value, "model_dump"):
        return value.model_dump(mode="json")
    return value.sha256 if hasattr(value, "sha256") else value


Play = Callable[[Any, Path], dict[str, Any] | None]
"""Function that plays a job, writes its time series to files that begin with the given path, and returns its
result as plain data; None if there is no result yet, so that the next call tries again."""
Show = Callable[[Any, Mapping[str, Any]], None]
"""Function that is called with a job that has been played, and its result."""


def run_jobs(
    jobs: Sequence[Job],
    folder: Path,
    play: Play,
    *,
    processes: int | None = None,
    address: str | None = None,
    progress: Progress = lambda part, text: None,
    show: Show = lambda job, result: None,
    more: Callable[[], Sequence[Job]] = tuple,
) -> list[dict[str, Any]]:
    """Play the jobs without a result; after Ctrl-C or a kill, the next call continues.

    Args:
        jobs: Trials; equal ones are played once.
        folder: Folder for KEY.json of each job, created if missing.
        play: Function of a module, since it is called in other processes; any function with `processes=1`.
        processes: Number of processes; the number of processors if None; 1 to play in this process, one after
            the other.
        address: Ray cluster on which they are played instead, as for `spread`. Policies are sent and files
            are returned; vehicle files must have the same path on each machine.
        progress: Function that is called with the completed fraction and the number of remaining trials.
        show: Function that is called with each trial played in this call and its result, as soon as it is available.
        more: Function that prepares further jobs, as for `spread`.

    Returns:
        Results in the order of the jobs, each with its `job` and `key`; jobs without a result are omitted.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files: list[Path] = []
    left: set[str] = set()

    def planned(jobs: Sequence[Job]) -> list[tuple[Any, ...]]:
        """Return the arguments of `spread` for the jobs without a result."""
        keys = [job.key() for job in jobs]
        files.extend(folder / f"{key}.json" for key in keys)
        missing = {
            key: job for key, job in zip(keys, jobs, strict=True) if not (folder / f"{key}.json").is_file()
        }
        left.update(missing)
        return [(k, j) if address is None else (k, j, _policy_files(j)) for k, j in missing.items()]

    if address is None:
        work: Callable[..., Any] = partial(_play_job, folder=folder, play=play)
    else:
        work = partial(_play_away, play=play)
    with closing(spread(work, planned(jobs), processes, address, more=lambda: planned(more()))) as played:
        for (key, job, *_), outcome in played:
            result = outcome.result()
            if address is not None:
                result = _come_back(job, folder / key, *result)
            if result is not None:
                show(job, result)
            left.remove(key)
            progress(1.0 - len(left) / len(files), f"{len(left)} trials left")
    return [load_result(file) for file in files if file.is_file()]


class Checkpoints:
    """Newest checkpoint of each work item on a cluster, in the memory of an actor on the requesting machine:
    an item whose machine is lost resumes from it elsewhere.
    """

    def __init__(self) -> None:
        self._files: dict[int, dict[str, bytes]] = {}

    def store(self, number: int, files: dict[str, bytes]) -> None:
        """Replace the checkpoint of one work item: its files by name."""
        self._files[number] = files

    def load(self, number: int) -> dict[str, bytes]:
        """Return the files of the newest checkpoint, by name; empty if there is no checkpoint."""
        return self._files.get(number, {})


def spread(
    work: Callable[..., Any],
    items: Sequence[Any],
    processes: int | None = None,
    address: str | None = None,
    *,
    resumable: bool = False,
    more: Callable[[], Sequence[Any]] = tuple,
) -> Generator[tuple[Any, Future[Any]], None, None]:
    """Yield the results of items, computed in separate processes, as many as there are processors if None; in
    this process if 1.

    On a cluster, an item whose process or machine is lost is restarted elsewhere, up to `RETRIES` times.

    Args:
        work: Function of a module, since it is called in other processes.
        items: Arguments of the individual calls.
        processes: Number of parallel processes. Starting a separate process takes about 3 s, which is not
            worthwhile for a single item.
        address: HOST:PORT of a Ray cluster that does the work instead, or auto.
        resumable: True if, on a cluster, the work is called with an item, the files of its newest checkpoint
            by name (initially none), and a function that stores such files.
        more: Function that is called in this process while others work, and returns further items.

    Yields:
        An item and its outcome, as each ends. Stopping the iteration, by Ctrl-C or by closing the generator,
        ends all work.

    Raises:
        ClusterError: Ray is not installed, or there is no response at the address.
    """
    if address is not None:
        yield from _on_cluster(work, [*items, *more()], address, resumable)
        return
    processes = processes or os.cpu_count() or 1
    if processes == 1:
        for given in (lambda: items, more):
            for item in given():
                outcome: Future[Any] = Future()
                try:
                    outcome.set_result(work(item))
                except Exception as error:
                    outcome.set_exception(error)
                yield item, outcome
        return
    with _workers(processes) as executor:
        futures = {executor.submit(work, item): item for item in items}
        futures |= {executor.submit(work, item): item for item in more()}
        for future in as_completed(futures):
            yield futures[future], future


@contextmanager
def running(work: Callable[..., Any], *arguments: Any) -> Iterator[None]:
    """Run a function in a separate process during a block, whose end waits for it.

    The function only prepares data: its result or error is ignored.

    Args:
        work: Function of a module.
        arguments: Its arguments.
    """
    with _workers(1) as executor:
        future = executor.submit(work, *arguments)
        yield
        future.exception()


@contextmanager
def _workers(count: int) -> Iterator[ProcessPoolExecutor]:
    """Start processes, which an error or Ctrl-C ends without waiting for unread results."""
    # A fork would copy the threads of Warp and torch in an inconsistent state.
    executor = ProcessPoolExecutor(
        count,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_prepare,
        initargs=(os.getpid(),),
    )
    try:
        yield executor
    except BaseException:
        workers = list((executor._processes or {}).values())
        executor.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            worker.terminate()
        raise
    executor.shutdown()


def _on_cluster(
    work: Callable[..., Any], items: Sequence[Any], address: str, resumable: bool
) -> Generator[tuple[Any, Future[Any]], None, None]:
    if not items:
        return
    try:
        import ray
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy
    except ImportError as error:
        raise ClusterError("a cluster needs Ray: pip install 'finssim[sweep]'") from error
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    _knock(address)
    try:
        environment = {"env_vars": ONE_THREAD}
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, runtime_env=environment)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise ClusterError(f"no Ray cluster answers at {address}: {str(error).splitlines()[0]}") from error
    try:
        task = ray.remote(num_cpus=1, max_retries=RETRIES)(_call)
        actor = None
        if resumable:
            here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
            actor = ray.remote(num_cpus=0)(Checkpoints).options(scheduling_strategy=here).remote()
        waiting = {task.remote(work, item, number, actor): item for number, item in enumerate(items)}
        while waiting:
            (reference,), _ = ray.wait(list(waiting), num_returns=1)
            outcome: Future[Any] = Future()
            try:
                outcome.set_result(ray.get(reference))
            except ray.exceptions.RayTaskError as error:  # the work itself raised
                outcome.set_exception(error.cause or error)
            except ray.exceptions.RayError as error:
                outcome.set_exception(ClusterError(f"lost {RETRIES + 1} times: {str(error).splitlines()[0]}"))
            yield waiting.pop(reference), outcome
    finally:
        ray.shutdown()


def _call(work: Callable[..., Any], item: Any, number: int, checkpoints: Any) -> Any:
    """Call the work in a worker: Ray accepts only plain functions.

    Args:
        work: Function to call.
        item: Argument of the call.
        number: Number of this work item.
        checkpoints: Actor that stores the checkpoints; None if the work is not resumable.
    """
    if checkpoints is None:
        return work(item)
    import ray

    def store(files: dict[str, bytes]) -> None:
        ray.get(checkpoints.store.remote(number, files))

    return work(item, ray.get(checkpoints.load.remote(number)), store)


def _knock(address: str) -> None:
    """Refuse an address without a Ray server: Ray itself retries for minutes, or forever.

    Ray speaks gRPC, so its first frame is one of HTTP/2 settings.
    """
    if address == "auto":
        return
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit():
        raise ClusterError(f"address is '{address}', expected HOST:PORT or auto")
    try:
        with socket.create_connection((host, int(port)), timeout=PATIENCE) as connection:
            if os.environ.get("RAY_USE_TLS", "0") in ("0", ""):
                connection.sendall(
                    b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes((0, 0, 0, SETTINGS, 0, 0, 0, 0, 0))
                )
                if connection.recv(9)[3:4] != bytes((SETTINGS,)):
                    raise OSError("another program is listening there")
    except (OSError, OverflowError) as error:
        raise ClusterError(f"no Ray cluster answers at {address}: {error}") from error


def _prepare(parent: int) -> None:
    """Prepare a worker: one thread, as there are as many workers as processors, and termination with its parent."""
    os.environ.update(ONE_THREAD)
    prepare_worker(parent)


def _play_job(keyed: tuple[str, Job], folder: Path, play: Play) -> dict[str, Any] | None:
    """Play a job and write KEY.json of its result, with its job."""
    key, job = keyed
    return _stored(job, folder / key, play(job, folder / key))


def _stored(job: Job, path: Path, played: dict[str, Any] | None) -> dict[str, Any] | None:
    """Return the result with its job, written to PATH.json; None if there is no result."""
    if played is None:
        return None
    key = path.name
    result = {"key": key, "job": {**job.described(), "row": job.row, "target": job.target}, **played}
    keep_result(path.with_name(f"{key}.json"), result)
    return result


def _policy_files(job: Job) -> dict[str, bytes]:
    """Return the files of the job's policy by name; empty for a built-in controller."""
    controller = getattr(job, "controller", None)
    if controller is None or controller in CONTROLLERS:
        return {}
    return {name: (Path(controller) / name).read_bytes() for name in (DESCRIPTION_FILE, NETWORK_FILE)}


def _play_away(
    sent: tuple[str, Job, Mapping[str, bytes]], play: Play
) -> tuple[dict[str, Any] | None, dict[str, bytes]]:
    """Play a job on another machine: return its result, and the files that it wrote by name."""
    key, job, policy = sent
    with tempfile.TemporaryDirectory() as scratch:
        out, controller = Path(scratch) / "out", Path(scratch) / "policy"
        for folder in (out, controller):
            folder.mkdir()
        for name, content in policy.items():
            (controller / name).write_bytes(content)
        if policy:
            job = dataclasses.replace(job, controller=str(controller))  # type: ignore[call-arg]
        played = play(job, out / key)
        return played, contents(out)


def _come_back(
    job: Job, path: Path, played: dict[str, Any] | None, files: Mapping[str, bytes]
) -> dict[str, Any] | None:
    """Write the files of a remote job beside PATH.json of its result."""
    for name, content in files.items():
        with atomic_write(path.with_name(plain_name(name, "file of a trial", ClusterError))) as temporary:
            temporary.write_bytes(content)
    return _stored(job, path, played)
