"""`finssim view`: make a source, serve its page, and end with Ctrl-C."""

from __future__ import annotations

import math
import sys
import time
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from finssim.robot.interrupt import interruptible
from finssim.vehicles import load_vehicle
from finssim.viewer.frame import Source, ViewError
from finssim.viewer.sources.guides import guide_for

__all__ = ["Choice", "open_source", "run"]


_DRIVEN = {"policy", "task", "goal", "trajectory", "seed"}
HEEDED = {
    "pool": _DRIVEN | {"plant", "severity", "camera"},
    "sim": _DRIVEN | {"hydrodynamics"},
    "record": {"truth", "truth_offset", "basin"},
    "folder": {"world"},
}
"""Kind of source -> the options, besides the vehicle, that it heeds."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """What a person wants to look at; fields as the options of the command."""

    source: str = "pool"
    vehicle: str | None = None
    policy: str = "pid"
    task: str | None = None
    goal: str | None = None
    trajectory: str | None = None
    plant: str = "1"
    severity: str = "realistic"
    camera: str = "corners"
    hydrodynamics: str = "calibrated"
    truth: Path | None = None
    truth_offset: float | None = None
    basin: str | None = None
    world: int | None = None
    seed: int = 0


def open_source(choice: Choice) -> Source:
    """The source that was asked for.

    Raises:
        ViewError: There is none of that name.
        ValueError: What it is made of is refused, in one sentence.
    """
    _refuse_strangers(choice)
    if choice.source == "pool":
        return _pool(choice)
    if choice.source == "sim":
        return _simulator(choice)
    path = Path(choice.source)
    if path.is_dir():
        from finssim.viewer.sources.run import RunSource

        return RunSource(path, world=choice.world, vehicle=choice.vehicle)
    if not path.is_file():
        raise ViewError(
            f"{choice.source}: no such file or folder; give pool, sim, a record (.mcap) or a run's folder"
        )
    from finssim.viewer.sources.record import RecordSource

    return RecordSource(
        path,
        truth=choice.truth,
        offset=choice.truth_offset,
        basin=None if choice.basin is None else _size(choice.basin),
        vehicle=choice.vehicle,
    )


def run(
    choice: Choice, *, speed: float, port: int, bind: str, browser: bool, duration: float | None = None
) -> None:
    """Show a source until Ctrl-C; arguments as of the command."""
    from finssim.viewer.app import View

    view = View(open_source(choice), bind=bind, port=port, speed=speed)
    typer.echo(f"{view.source.stage.title}\nview: {view.url}   (Ctrl-C ends)")
    sys.stdout.flush()
    if browser:
        webbrowser.open(view.url)
    end = time.monotonic() + (math.inf if duration is None else duration)
    try:
        with interruptible() as interrupted:
            view.run(lambda: interrupted() or time.monotonic() >= end)
    finally:
        view.close()


def _refuse_strangers(choice: Choice) -> None:
    """Refuse options that the source would not heed."""
    path = Path(choice.source)
    kind = choice.source if choice.source in HEEDED else "folder" if path.is_dir() else "record"
    usual = Choice()
    for name in sorted(set().union(*HEEDED.values()) - HEEDED[kind]):
        if getattr(choice, name) != getattr(usual, name):
            takers = " and ".join(other for other in HEEDED if name in HEEDED[other])
            raise ViewError(f"--{name.replace('_', '-')} is for {takers}, not for a {kind}: leave it out")


def _pool(choice: Choice) -> Source:
    from finssim.viewer.sources.pool import PoolSource

    name = choice.vehicle or "finsrov"
    guide = guide_for(choice.goal, choice.trajectory, choice.task, load_vehicle(name))
    kinds: Any = {"severity": choice.severity, "camera": choice.camera}  # checked where they are used
    return PoolSource(
        guide,
        vehicle=name,
        policy=choice.policy,
        task=choice.task,
        plant=choice.plant,
        seed=choice.seed,
        **kinds,
    )


def _simulator(choice: Choice) -> Source:
    from finssim.viewer.sources.simulator import SimulatorSource

    vehicle = load_vehicle(choice.vehicle or "finsrov")
    return SimulatorSource(
        vehicle,
        guide_for(choice.goal, choice.trajectory, choice.task, vehicle),
        policy=choice.policy,
        task=choice.task,
        hydrodynamics=choice.hydrodynamics,
        seed=choice.seed,
    )


def _size(text: str) -> tuple[float, float, float]:
    try:
        length, width, depth = (float(part) for part in text.split(","))
    except ValueError:
        length = width = depth = math.nan
    if not (min(length, width, depth) > 0.0 and math.isfinite(length + width + depth)):
        raise ViewError(f"basin '{text}': expected length,width,depth [m], such as 4,2,1")
    return length, width, depth
