"""Experiments as campaigns: a progress bar, and trials over several processes that a later call continues."""

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
"""Environment of a worker: one thread each, for there are as many workers as processors."""
SETTINGS = 4
"""Type of a frame of HTTP/2."""
PATIENCE = 10.0
"""For a cluster's answer to a first knock [s]."""
RETRIES = 3
"""Number of restarts of work on a cluster after its worker was lost."""


class ClusterError(ValueError):
    """A Ray cluster that is not there, or lost what it was given."""


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
        name: What the bar is called.
        work: The experiment, which writes its directory `out`, if it has one, itself; called with `progress`, if
            it takes that, and the options.
        tables: Those of its result.
        as_json: Print one JSON object in place of the tables.
        bar: Show it; False where the work has a line of its own on the screen.
        options: Of the work.

    Returns:
        What `work` returned.
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
    """Refuse a name that does not exist, in a sentence with those that do."""
    for name in names:
        if name not in available:
            raise error(f"unknown {kind} '{name}'; available: {', '.join(available)}")


class ResultError(ValueError):
    """A result that was kept cannot be gone on with; the message is one sentence."""


def write_json(path: Path, result: Mapping[str, Any], tables: Sequence[Table] = ()) -> None:
    """Write a result, and beside it, with the suffix .html, its page.

    Raises:
        ResultError: It holds a number that is not finite.
    """
    try:
        text = json.dumps(result, indent=1, allow_nan=False)
    except ValueError:
        raise ResultError(
            f"{path}: not written, since it would hold a number that is not finite: look for one in its inputs"
        ) from None
    with atomic_write(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
    if tables:
        write_page(path.with_suffix(".html"), tables[0].title, tables)


def keep_result(path: Path, result: Mapping[str, Any]) -> None:
    """Write a result that a later call continues with, with its digest."""
    write_json(path, {**result, "sha256": _digest(result)})


def load_result(path: Path) -> dict[str, Any]:
    """A result that `keep_result` wrote.

    Raises:
        ResultError: It is not as it was written.
    """
    try:
        result = read_json(path, ResultError, such_as="sha256")
    except ResultError as error:
        raise ResultError(f"{error}: remove it, and it is made again") from None
    if result.pop("sha256") != _digest(result):
        raise ResultError(f"{path}: is not as it was written: remove it, and it is made again")
    return result


def _digest(result: Mapping[str, Any]) -> str:
    """SHA-256 of what a reader of the result gets."""
    read = json_value(json.dumps(result), ResultError, "result")
    return hashlib.sha256(json.dumps(read, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True, kw_only=True)
class Job:
    """One trial as plain data: equal jobs give equal results, and a result is kept under its key."""

    row: str
    """Row of the table."""
    target: str
    """Goal of the trial."""
    plant: int = 1
    """Seed of the pool, or number of the plant."""
    seed: int = 1
    """Seed of the noise."""

    def described(self) -> dict[str, Any]:
        """Everything that decides the result, with the contents of files in place of their names."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        del values["row"]
        return {name: _content(name, value) for name, value in values.items()}

    def key(self) -> str:
        """File name of its result: readable first, then a digest of everything that decides it."""
        digest = hashlib.sha256(json.dumps(self.described(), sort_keys=True).encode()).hexdigest()[:10]
        name = re.sub(r"[^A-Za-z0-9.+-]+", "_", f"{self.row}_{self.target}")
        return f"{name}_plant{self.plant}_seed{self.seed}_{digest}"


def _content(name: str, value: Any) -> Any:
    """A field of a job as plain data: SHA-256 of a vehicle, of a policy's files, of a programme."""
    if name in ("vehicle", "pool_vehicle"):
        return load_vehicle(value).sha256
    if name == "controller" and value not in CONTROLLERS:
        files = {file: (Path(value) / file).read_bytes() for file in (DESCRIPTION_FILE, NETWORK_FILE)}
        return {file: hashlib.sha256(data).hexdigest() for file, data in files.items()}
    if hasattr(value, "model_dump"):
        return value.model_dump(mode="json")
    return value.sha256 if hasattr(value, "sha256") else value


Play = Callable[[Any, Path], dict[str, Any] | None]
"""Plays a job, leaves its series in files that begin with the given path, and returns its result as plain data; None:
there is none yet, and the next call tries again."""
Show = Callable[[Any, Mapping[str, Any]], None]
"""Called with a job that has been played, and its result."""


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
    """Play the jobs that have no result yet; after Ctrl-C or a kill the next call continues.

    Args:
        jobs: Trials; equal ones are played once.
        folder: Takes KEY.json of each, made if missing.
        play: A function of a module, as it is called in other processes; any function with `processes=1`.
        processes: As many as there are processors if None; 1: in this process, one after the other.
        address: Of a Ray cluster on which they are played instead, as of `spread`. Policies go there and files come
            back; vehicle files must be at the same place on each machine.
        progress: Told the share that is done and what is left.
        show: Called with each trial that is played now and its result, as soon as there is one.
        more: Prepares further jobs, as of `spread`.

    Returns:
        The results in the order of the jobs, each with its `job` and `key`; jobs without a result are left out.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files: list[Path] = []
    left: set[str] = set()

    def planned(jobs: Sequence[Job]) -> list[tuple[Any, ...]]:
        """Return what `spread` takes of the jobs that have no result."""
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
    """The newest checkpoint of each piece of work on a cluster, in the memory of an actor on the machine that asked
    for it: work whose own machine is lost resumes from it elsewhere.
    """

    def __init__(self) -> None:
        self._files: dict[int, dict[str, bytes]] = {}

    def store(self, number: int, files: dict[str, bytes]) -> None:
        """Replace the checkpoint of one piece of work: its files by name."""
        self._files[number] = files

    def load(self, number: int) -> dict[str, bytes]:
        """Return the files of the newest checkpoint, by name; none if there is no checkpoint."""
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
    """Yield the results of items in separate processes, as many in parallel as there are processors if None; in this
    process if 1.

    On a cluster work whose process or machine is lost begins anew elsewhere, `RETRIES` times.

    Args:
        work: A function of a module, as it is called in other processes.
        items: What it is called with, each by itself.
        processes: At once. A process of one's own takes some 3 s to start, which a single one does not make up for.
        address: HOST:PORT of a Ray cluster on which it is done instead, or auto.
        resumable: Whether on a cluster the work is called with an item, the files of its newest checkpoint by name,
            none at first, and a function that stores such files.
        more: Called in this process while others do the work, and returns further items.

    Yields:
        An item and its outcome, as each ends. Whoever stops iterating, by Ctrl-C or by closing this, ends them all.

    Raises:
        ClusterError: Ray is not installed, or nothing answers at the address.
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
    """Run a function in a process of its own beside a block, whose end waits for it.

    It only prepares: what it returns or raises is not read.

    Args:
        work: A function of a module.
        arguments: Its arguments.
    """
    with _workers(1) as executor:
        future = executor.submit(work, *arguments)
        yield
        future.exception()


@contextmanager
def _workers(count: int) -> Iterator[ProcessPoolExecutor]:
    """Start processes, which an error or Ctrl-C ends without waiting for results that are not read."""
    # A fork would copy the threads of Warp and torch half-alive.
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
    """Call the work in a worker: Ray takes plain functions alone.

    Args:
        work: What is called.
        item: What it is called with.
        number: Number of this piece of work.
        checkpoints: Actor that keeps a checkpoint of each; None for work that does not resume.
    """
    if checkpoints is None:
        return work(item)
    import ray

    def store(files: dict[str, bytes]) -> None:
        ray.get(checkpoints.store.remote(number, files))

    return work(item, ray.get(checkpoints.load.remote(number)), store)


def _knock(address: str) -> None:
    """Refuse an address where nothing answers as Ray does: Ray itself tries for minutes, or for ever.

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
                    raise OSError("it is another program")
    except (OSError, OverflowError) as error:
        raise ClusterError(f"no Ray cluster answers at {address}: {error}") from error


def _prepare(parent: int) -> None:
    """Prepare a worker: one thread, since there are as many workers as processors, and an end with its parent."""
    os.environ.update(ONE_THREAD)
    prepare_worker(parent)


def _play_job(keyed: tuple[str, Job], folder: Path, play: Play) -> dict[str, Any] | None:
    """Play a job and write KEY.json of its result, with its job."""
    key, job = keyed
    return _stored(job, folder / key, play(job, folder / key))


def _stored(job: Job, path: Path, played: dict[str, Any] | None) -> dict[str, Any] | None:
    """The result with its job, written to PATH.json; None where there is none."""
    if played is None:
        return None
    key = path.name
    result = {"key": key, "job": {**job.described(), "row": job.row, "target": job.target}, **played}
    keep_result(path.with_name(f"{key}.json"), result)
    return result


def _policy_files(job: Job) -> dict[str, bytes]:
    """Content of the policy that steers, by file name; nothing where a name of ours does."""
    controller = getattr(job, "controller", None)
    if controller is None or controller in CONTROLLERS:
        return {}
    return {name: (Path(controller) / name).read_bytes() for name in (DESCRIPTION_FILE, NETWORK_FILE)}


def _play_away(
    sent: tuple[str, Job, Mapping[str, bytes]], play: Play
) -> tuple[dict[str, Any] | None, dict[str, bytes]]:
    """Play a job on another machine: its result, and the files that it left by name."""
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
    """Write what a job left elsewhere beside PATH.json of its result."""
    for name, content in files.items():
        with atomic_write(path.with_name(plain_name(name, "file of a trial", ClusterError))) as temporary:
            temporary.write_bytes(content)
    return _stored(job, path, played)
