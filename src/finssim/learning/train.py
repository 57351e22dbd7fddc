"""`finssim train`: from a task and a vehicle to a policy directory."""

from __future__ import annotations

import time
import warnings
from pathlib import Path
from typing import Any

from rich.console import Console

from finssim.control.modes import action_mode
from finssim.control.policy_description import DESCRIPTION_FILE, PolicyDescription, VehicleIdentity
from finssim.engine.randomize import Randomization
from finssim.files import atomic_directory, refuse_unwritable
from finssim.learning.description import observation_schema, task_record
from finssim.quiet import start_warp
from finssim.tasks import TASKS, Environment
from finssim.vehicles import Vehicle, load_vehicle

__all__ = ["TrainingError", "train"]


class TrainingError(ValueError):
    """A training that cannot be started."""


def train(
    task: str,
    *,
    out: Path,
    vehicle: str | Vehicle = "finsrov",
    hydrodynamics: str = "calibrated",
    action: str = "wrench6",
    randomize: str | Path | None = None,
    seed: int = 42,
    worlds: int | None = None,
    steps: int | None = None,
    device: str = "cpu",
    console: Console | None = None,
    shown: Path | None = None,
    interrupted: Path | None = None,
) -> Path:
    """Train a policy and write its directory.

    The folder `OUT-training` beside it takes the TensorBoard log and the checkpoints, each a policy directory too.

    Args:
        task: Key of `TASKS`.
        out: Policy directory to write; an earlier policy there is replaced.
        vehicle: A vehicle, a catalogue name or a file.
        hydrodynamics: calibrated, mesh or simplified.
        action: wrench6, wrench4 or thruster8.
        randomize: Name or file of ranges that vehicle and water are drawn from in every episode.
        seed: Of everything random.
        worlds: Worlds at once; the settings' own if None.
        steps: Control steps of all worlds together; the settings' own if None.
        device: cpu or cuda.
        console: Where progress is shown; standard error if None.
        shown: Name of the directory in messages, where `out` is a temporary one.
        interrupted: Where the policy so far goes after Ctrl-C; if None, `out`, or `OUT-training/interrupted` where
            `out` holds an earlier policy.

    Returns:
        The policy directory.

    Raises:
        TrainingError: Unknown task, or numbers that do not fit.
        KeyboardInterrupt: After Ctrl-C, when the policy so far, if there is one, has been written.
    """
    console = console or Console(stderr=True)
    for name, number in (("worlds", worlds), ("steps", steps)):
        if number is not None and number < 1:
            raise TrainingError(f"{name} is {number}, expected 1 or more")
    if task not in TASKS:
        raise TrainingError(f"unknown task '{task}'; available: {', '.join(TASKS)}")
    chosen = vehicle if isinstance(vehicle, Vehicle) else load_vehicle(vehicle)
    randomization = Randomization(randomize) if randomize is not None else None
    refuse_unwritable(atomic_directory(out, replaces=DESCRIPTION_FILE))
    start_warp()
    environment_task = TASKS[task]()
    mode = action_mode(action, chosen)

    import torch

    from finssim.learning.export import export_policy
    from finssim.learning.ppo import settings_for, settings_record, train_ppo
    from finssim.learning.progress import TrainingView
    from finssim.learning.sb3 import Sb3VecEnv

    settings = settings_for(task, randomized=randomization is not None, worlds=worlds, steps=steps)
    # A second thread gains little on so small a network, and loses much where anything else computes.
    torch.set_num_threads(1)
    environment = Environment(
        environment_task,
        chosen,
        worlds=settings.worlds,
        hydrodynamics=hydrodynamics,
        action=action,
        randomization=randomization,
        noise=environment_task.training_noise,
        device=device,
        seed=seed,
    )
    description = PolicyDescription(
        task=environment_task.name,
        observation=observation_schema(environment_task),
        action=mode.describe(),
        control_period=environment_task.control_step,
        vehicle=VehicleIdentity(name=chosen.name, sha256=chosen.sha256),
        hydrodynamics=hydrodynamics,
        seed=seed,
        training={
            **settings_record(settings),
            "device": device,
            "randomization": randomization.ranges.model_dump(mode="json") if randomization else None,
            "task": task_record(environment_task),
        },
    )
    side = Path(out).with_name(f"{Path(out).name}-training")

    def checkpoint(network: Any, done: int, curves: list[dict[str, Any]]) -> None:
        export_policy(
            network, side / f"checkpoint-{done:09d}", _after(description, done, False), curves=curves
        )

    began = time.perf_counter()
    with TrainingView(settings.steps, console) as view, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*mini-batch.*")  # a last small batch does no harm
        warnings.filterwarnings("ignore", message=".*on the GPU.*")
        run = train_ppo(
            Sb3VecEnv(environment, stagger=True),
            settings,
            seed=seed,
            device=device,
            log=side / "tensorboard",
            show=view.update,
            checkpoint=checkpoint,
        )
    place, what, where = Path(out), "policy", shown or Path(out)
    if run.interrupted:
        if not run.learned:
            console.print("no policy: interrupted before anything was learned", soft_wrap=True)
            raise KeyboardInterrupt
        place = where = interrupted or _place_beside(place, side)
        what = "policy so far"
    done = run.curves[-1]["steps"]
    export_policy(run.network, place, _after(description, done, not run.interrupted), curves=run.curves)
    took = time.perf_counter() - began
    console.print(f"{what}: {where}  ({done:,} steps in {took:.1f} s)", highlight=False, soft_wrap=True)
    if run.interrupted:
        raise KeyboardInterrupt
    return place


def _place_beside(out: Path, side: Path) -> Path:
    """Where an unfinished policy goes: a finished one that is there already must not be lost to it."""
    return side / "interrupted" if (out / DESCRIPTION_FILE).is_file() else out


def _after(description: PolicyDescription, steps: int, complete: bool) -> PolicyDescription:
    """The description of the network as it is after so many steps."""
    record = {**description.training, "steps_done": steps, "complete": complete}
    return description.model_copy(update={"training": record})
