"""`finssim run --team POLICY`: a stack of its own for every agent of a task, each in a process of its own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from finssim.control.errors import ControlError
from finssim.control.policy_description import read_description
from finssim.robot.interrupt import PARENT, interruptible
from finssim.robot.link.transports import host_port
from finssim.robot.summary import show
from finssim.robot.wiring import POOL_ADDRESS
from finssim.vehicles import load_vehicle

__all__ = ["APART", "run_team"]

APART = 10
"""Ports between one vehicle of a team and the next."""
MESSAGES = 5
"""The messages of a team are so far from the first vehicle's port."""
POLL = 0.05
"""Between looks whether they have ended [s]."""


def run_team(
    policy: str,
    options: Sequence[str],
    *,
    task: str | None,
    vehicle: str,
    robot: str = "pool",
    bind: str = "127.0.0.1:54321",
    messages: str = "",
    record: Path | None = None,
    as_json: bool = False,
) -> int:
    """Run every agent of a task, and print how each went; one that ends leaves the others alone.

    Args:
        policy: A policy's directory, or a baseline of the task, for all.
        options: Of `finssim run`, the same for all.
        task: Of several vehicles; the policy's if None.
        vehicle: Name or file.
        robot: Motor controller of the first; the others' are ten ports on, each. `pool`: that of this machine.
        bind: Own end of the first, likewise.
        messages: What carries messages between them; the port five after `robot` if empty.
        record: Folder that takes AGENT.mcap of each; nothing is kept if None.
        as_json: Print one JSON object, by agent.

    Returns:
        The greatest exit status of them.

    Raises:
        ControlError, PolicyError, LinkError: Policy, task, vehicle and addresses do not fit.
    """
    from finssim.tasks.observer import fitted_task

    words = task or (read_description(Path(policy)).task if Path(policy).is_dir() else None)
    if words is None:
        raise ControlError(f"--team {policy} is a baseline: give its task with --task")
    agents = fitted_task(words, load_vehicle(vehicle)).agents
    if len(agents) < 2:
        raise ControlError(f"task '{words}' has one agent: run it with --policy {policy}, and --messages")
    kind, _, address = (POOL_ADDRESS if robot == "pool" else robot).rpartition("//")
    if kind not in ("", "udp:"):
        raise ControlError(
            f"--robot {robot}: a team's motor controllers are at udp://HOST:PORT, ten ports apart"
        )
    (theirs, port), (host, own) = host_port(address, "--robot"), host_port(bind, "--bind")
    alike = [
        *("--policy", policy, "--task", words, "--vehicle", vehicle, "--json"),
        *("--messages", messages or f"{theirs}:{port + MESSAGES}"),
        *options,
    ]
    children: dict[str, subprocess.Popen[str]] = {}
    environment = {**os.environ, PARENT: str(os.getpid())}
    with interruptible() as interrupted:
        try:
            for i, agent in enumerate(agents):
                ends = [
                    "--robot",
                    f"udp://{theirs}:{port + APART * i}",
                    "--bind",
                    f"{host}:{own + APART * i}",
                ]
                kept = [] if record is None else ["--record", str(record / f"{agent}.mcap")]
                children[agent] = subprocess.Popen(
                    [sys.executable, "-m", "finssim", "run", "--agent", agent, *ends, *kept, *alike],
                    env=environment,
                    start_new_session=True,  # Ctrl-C reaches us alone, and we tell them once
                    stdout=subprocess.PIPE,
                    text=True,
                )
            while not interrupted() and any(child.poll() is None for child in children.values()):
                time.sleep(POLL)
        finally:
            for child in children.values():
                if child.poll() is None:
                    child.send_signal(signal.SIGINT)
            said = {agent: child.communicate()[0] for agent, child in children.items()}
    _tell({agent: json.loads(text) if text.strip() else None for agent, text in said.items()}, as_json)
    return max(abs(child.returncode) for child in children.values())


def _tell(told: dict[str, Any], as_json: bool) -> None:
    """How each went."""
    if as_json:
        print(json.dumps(told))
        return
    console = Console()
    for agent, one in told.items():
        console.print(agent if one is not None else f"{agent}: did not run, see above", highlight=False)
        if one is not None:
            show(one, console)
