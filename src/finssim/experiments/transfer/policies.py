"""The policies of an experiment: trained once each, kept in its folder, taken from there the next time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from finssim.control.policy import Policy
from finssim.control.policy_description import PolicyError
from finssim.experiments.running import Say
from finssim.learning.train import train
from finssim.vehicles import Vehicle

__all__ = ["Training", "finished", "trained"]


@dataclass(frozen=True, kw_only=True)
class Training:
    """What a policy is trained in."""

    name: str
    task: str = "t1"
    hydrodynamics: str = "calibrated"
    randomize: str | None = None
    """Name or file of ranges."""


def trained(
    trainings: Iterable[Training],
    seeds: Iterable[int],
    folder: Path,
    *,
    vehicle: str,
    steps: int | None = None,
    say: Say = lambda part, what: None,
) -> dict[tuple[str, int], Path]:
    """Policy directories of every training and seed; what is finished in the folder is not trained again.

    Args:
        trainings: Each under a name of its own.
        seeds: Of the trainings.
        folder: Where the directories are and come.
        vehicle: Name or file.
        steps: Control steps of each; the task's own if None.
        say: Told the share that is done and what comes next.

    Returns:
        (name, seed) -> directory.
    """
    plan = [(training, seed) for training in trainings for seed in seeds]
    found: dict[tuple[str, int], Path] = {}
    for done, (training, seed) in enumerate(plan):
        place = folder / f"{training.name}-seed{seed}"
        say(done / len(plan), f"training {training.name}, seed {seed}")
        if not finished(place):
            train(
                training.task,
                out=place,
                vehicle=vehicle,
                hydrodynamics=training.hydrodynamics,
                randomize=training.randomize,
                seed=seed,
                steps=steps,
                console=Console(stderr=True, quiet=True),
            )
        found[training.name, seed] = place
    return found


def finished(place: Path, vehicle: Vehicle | None = None) -> bool:
    """Whether a whole policy lies there: not one that was interrupted, or cut short while it was written.

    Args:
        place: Directory.
        vehicle: That it must be for; any if None.
    """
    try:
        return bool(Policy.load(place, vehicle=vehicle).description.training.get("complete"))
    except PolicyError:
        return False
