"""Launching kernels over all worlds: split over threads on a CPU, captured as a graph on a GPU.

Warp runs a CPU launch on the calling thread and releases the GIL meanwhile, so worlds are cut into one slice per thread
and each thread takes its slice through all stages. Nothing crosses worlds: the result is the same for any cut.
"""

import os
import queue
import threading
from collections.abc import Sequence
from typing import Any

import warp as wp

MIN_SLICE = 64
"""Worlds below which a slice is not worth waking a thread for."""


class _Worker(threading.Thread):
    """A thread that runs one slice when asked."""

    def __init__(self) -> None:
        super().__init__(daemon=True, name="finssim-slice")
        self._jobs: queue.SimpleQueue = queue.SimpleQueue()
        self._done = threading.Semaphore(0)
        self._error: BaseException | None = None
        self.start()

    def submit(self, commands: list[wp.Launch]) -> None:
        self._jobs.put(commands)

    def wait(self) -> None:
        self._done.acquire()
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    def run(self) -> None:
        while True:
            try:
                for command in self._jobs.get():
                    command.launch()
            except BaseException as error:
                self._error = error
            self._done.release()


_workers: list[_Worker] = []
_pool_lock = threading.Lock()


def default_threads() -> int:
    """Processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


class Pipeline:
    """A fixed sequence of kernels over all worlds, recorded once and run every step.

    Every kernel takes `world_offset` as its last argument and is launched over its slice's worlds, or over (worlds,
    vehicles).
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
        self._recorded: list[list[wp.Launch]] = [[] for _ in self.slices]
        self._graph: Any = None

    def add(self, kernel: wp.Kernel, inputs: Sequence[Any], vehicles: int | None = None) -> None:
        """Append a kernel.

        Args:
            kernel: Its last parameter is `world_offset`.
            inputs: All arguments but `world_offset`.
            vehicles: Launch over (worlds, vehicles) if given, else over worlds.
        """
        for (offset, count), commands in zip(self.slices, self._recorded, strict=True):
            dim = count if vehicles is None else (count, vehicles)
            command = wp.launch(
                kernel, dim=dim, inputs=[*inputs, offset], device=self.device, record_cmd=True
            )
            commands.append(command)
        self._graph = None

    def run(self) -> None:
        """Run all kernels in order and, on a CPU, return when they have finished."""
        if self.device.is_cuda:
            self._run_graph()
        elif len(self._recorded) == 1:
            for command in self._recorded[0]:
                command.launch()
        else:
            self._run_threads()

    def _run_graph(self) -> None:
        if self._graph is None:
            with wp.ScopedCapture(device=self.device) as capture:
                for command in self._recorded[0]:
                    command.launch()
            self._graph = capture.graph
        wp.capture_launch(self._graph)

    def _run_threads(self) -> None:
        # One pipeline at a time: the workers are shared by every simulator of the process.
        with _pool_lock:
            while len(_workers) < len(self._recorded) - 1:
                _workers.append(_Worker())
            used = _workers[: len(self._recorded) - 1]
            for worker, commands in zip(used, self._recorded[1:], strict=True):
                worker.submit(commands)
            for command in self._recorded[0]:
                command.launch()
            for worker in used:
                worker.wait()
