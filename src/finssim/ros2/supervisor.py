"""Nodes as processes: started, watched, reported when they die, and ended in good order."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from finssim.robot.interrupt import PARENT
from finssim.ros2.graphs import Plan

__all__ = ["Supervisor"]

PATIENCE = 10.0
"""Time that a node has to end before it is killed [s]."""


@dataclass
class Child:
    """One node's process."""

    name: str
    process: subprocess.Popen[bytes]
    dead: bool = False


class Supervisor:
    """Runs the nodes of a plan. Use it as a context: whatever happens, no process is left."""

    def __init__(self, plan: Plan, parameters: Path, say: Callable[[str], None]) -> None:
        """
        Args:
            plan: Nodes and namespace.
            parameters: File that `plan.write` wrote.
            say: Takes a sentence for the person who watches.
        """
        self._plan, self._parameters, self._say = plan, parameters, say
        self.children: list[Child] = []

    def __enter__(self) -> Supervisor:
        return self

    def __exit__(self, *error: object) -> None:
        self.end()

    def start(self, name: str) -> Child:
        """Start a node; it ends with this process even if that is killed."""
        ros = ["--ros-args", "-r", f"__ns:=/{self._plan.namespace}", "--params-file", str(self._parameters)]
        words = [sys.executable, "-m", "finssim", "ros2", "node", name, *ros]
        environment = {**os.environ, PARENT: str(os.getpid())}
        # In a session of its own: Ctrl-C reaches us alone, and the nodes end in our order.
        process = subprocess.Popen(
            words,
            env=environment,
            start_new_session=True,
            stdin=subprocess.DEVNULL if name != "teleop" else None,
        )
        child = Child(name, process)
        self.children.append(child)
        self._say(f"{name}: process {process.pid}")
        return child

    def look(self) -> list[Child]:
        """Nodes that have died since the last look, each told once."""
        died = [c for c in self.children if not c.dead and c.process.poll() is not None]
        for child in died:
            child.dead = True
            self._say(
                f"{child.name} has died: process {child.process.pid}, {_status(child.process.returncode)}"
            )
        return died

    def end(self) -> None:
        """End all, those first that were started last."""
        for child in reversed(self.children):
            if child.process.poll() is None:
                child.process.send_signal(signal.SIGINT)
        limit = time.monotonic() + PATIENCE
        for child in reversed(self.children):
            try:
                child.process.wait(max(limit - time.monotonic(), 0.1))
            except subprocess.TimeoutExpired:
                self._say(f"{child.name} does not end: killed")
                child.process.kill()
                child.process.wait()
            child.dead = True


def _status(code: int) -> str:
    """A return code in words."""
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"status {code}"
