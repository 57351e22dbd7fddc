"""Launching kernels over all worlds: split over threads on a CPU, captured as a graph on a GPU.

Warp runs a CPU launch on the calling thread and releases the GIL meanwhile, so worlds are cut into one slice per thread
and each thread runs all stages of its slice. Worlds share no data: the result does not depend on the slicing.
"""

import os
import queue
import threading
from collections.abc import Callable, Sequence
from typing import Any

import warp as wp

from finssim.sim.plant_arrays import SimulatorError

MIN_SLICE = 64
"""Number of worlds below which a slice is not assigned to another thread."""

MANY = 1024
"""Number of worlds from which a second kernel is compiled that processes several worlds together."""


class _Job:
    """One slice of one run; its event is set when it has finished."""

    def __init__(self, commands: list[wp.Launch]) -> None:
        self.commands = commands
        self.queued = False
        self.done = threading.Event()
        self.error: BaseException | None = None

    def run(self) -> None:
        if self.done.is_set():
            return
        try:
            for command in self.commands:
                command.launch()
        except BaseException as error:
            self.error = error
        self.done.set()


class _Worker(threading.Thread):
    """A thread that runs slices, one after the other."""

    def __init__(self) -> None:
        super().__init__(daemon=True, name="finssim-slice")
        self.jobs: queue.SimpleQueue[_Job] = queue.SimpleQueue()
        self.start()

    def run(self) -> None:
        while True:
            self.jobs.get().run()


_workers: list[_Worker] = []
_pool_lock = threading.Lock()


def _forget_workers() -> None:
    """Forget the workers in a forked child: threads do not survive a fork, so the child starts its own when needed."""
    global _pool_lock
    _workers.clear()
    _pool_lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_workers)


def default_threads() -> int:
    """Return the number of threads of a simulator without an explicit one: FINSSIM_THREADS, else the
    available processors."""
    if given := os.environ.get("FINSSIM_THREADS"):
        if not given.isdecimal() or int(given) < 1:
            raise SimulatorError(f"FINSSIM_THREADS is '{given}', expected an integer of 1 or more")
        return int(given)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


class _Kernels:
    """Kernels that run one after the other without a function call in between, recorded by slice."""

    def __init__(self, slices: int) -> None:
        self.recorded: list[list[wp.Launch]] = [[] for _ in range(slices)]
        self.graph: Any = None

    def run(self, device: wp.Device) -> None:
        if device.is_cuda:
            self._run_graph(device)
        elif len(self.recorded) == 1:
            for command in self.recorded[0]:
                command.launch()
        else:
            self._run_threads()

    def _run_graph(self, device: wp.Device) -> None:
        if self.graph is None:
            with wp.ScopedCapture(device=device) as capture:
                for command in self.recorded[0]:
                    command.launch()
            self.graph = capture.graph
        wp.capture_launch(self.graph)

    def _run_threads(self) -> None:
        # One pipeline at a time: the workers are shared by every simulator of the process.
        with _pool_lock:
            while len(_workers) < len(self.recorded) - 1:
                _workers.append(_Worker())
            jobs = [_Job(commands) for commands in self.recorded]
            interrupt: BaseException | None = None
            try:
                for worker, job in zip(_workers, jobs[1:], strict=False):
                    job.queued = True
                    worker.jobs.put(job)
                jobs[0].run()
            except KeyboardInterrupt as error:
                interrupt = error
                for worker, job in zip(_workers, jobs[1:], strict=False):
                    if job.queued:  # it may not have reached the queue; running it twice has no effect
                        worker.jobs.put(job)
            interrupt = _finish(jobs) or interrupt
        for failure in (interrupt, *(job.error for job in jobs)):
            if failure is not None:
                raise failure


class KernelSequence:
    """A fixed sequence of kernels over all worlds, recorded once and run in every step.

    Every kernel has `world_offset` as its last argument and is launched over its slice's worlds, or over (worlds,
    vehicles). A function may be called between kernels, once for all worlds.
    """

    def __init__(self, worlds: int, device: wp.Device, threads: int | None = None) -> None:
        """Cut `worlds` into slices: one per thread on a CPU (`threads`, default all processors), one on a GPU."""
        self.worlds = worlds
        self.device = device
        count = 1
        if device.is_cpu:
            count = max(1, min(threads or default_threads(), worlds // MIN_SLICE))
        edges = [worlds * i // count for i in range(count + 1)]
        self.slices = [(a, b - a) for a, b in zip(edges, edges[1:], strict=False)]
        self._parts: list[_Kernels | Callable[[], None]] = []

    @property
    def in_blocks(self) -> bool:
        """Return True if kernels that process several worlds together repay their compilation time."""
        return self.device.is_cpu and self.worlds >= MANY

    def add(
        self, kernel: wp.Kernel, inputs: Sequence[Any], vehicles: int | None = None, block: int | None = None
    ) -> None:
        """Append a kernel.

        Args:
            kernel: Its last parameter is `world_offset`.
            inputs: All arguments but `world_offset`.
            vehicles: Launch over (worlds, vehicles) if given, else over worlds.
            block: Launch over blocks of this many worlds; the number of worlds then precedes `world_offset`.
        """
        last = self._parts[-1] if self._parts else None
        if not isinstance(last, _Kernels):
            last = _Kernels(len(self.slices))
            self._parts.append(last)
        last.graph = None
        for (offset, count), commands in zip(self.slices, last.recorded, strict=True):
            rows = count if block is None else -(-count // block)
            dim = rows if vehicles is None else (rows, vehicles)
            arguments = [*inputs, offset] if block is None else [*inputs, count, offset]
            command = wp.launch(kernel, dim=dim, inputs=arguments, device=self.device, record_cmd=True)
            commands.append(command)

    def call(self, function: Callable[[], None]) -> None:
        """Append a function: it runs after the preceding kernels have finished or, on a GPU, have been
        queued."""
        self._parts.append(function)

    def run(self) -> None:
        """Run all kernels in order and, on a CPU, return when they have finished."""
        for part in self._parts:
            if isinstance(part, _Kernels):
                part.run(self.device)
            else:
                part()


def _finish(jobs: list[_Job]) -> BaseException | None:
    """Wait for all queued jobs, also through Ctrl-C; return the interrupt, or None.

    Worlds must not change while a caller reads them, frees them or starts the next step.
    """
    interrupt: BaseException | None = None
    while True:
        try:
            for job in jobs:
                if job.queued:
                    job.done.wait()
            return interrupt
        except KeyboardInterrupt as error:
            interrupt = error
