"""Run any task through the deployed software, compared with the batch: `python -m studies.stack t3 --policy DIR`."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from finssim.cli.command_line import run_script
from finssim.control import ControlError
from finssim.control.guidance import Guide
from finssim.control.trajectories import TRAJECTORIES
from finssim.evaluation.campaign import keep_result, load_result
from finssim.evaluation.plants import load_plant
from finssim.evaluation.tables import Table, figure_text
from finssim.evaluation.trials import EpisodeError, TrialSettings, follows, run_episodes, summarize_episodes
from finssim.pool.camera import PoolCamera, camera_of
from finssim.pool.drawn_plant import draw_plant
from finssim.pool.drawn_plant import site_of as plant_at
from finssim.pool.plant_spec import Severity
from finssim.pool.task_site import PositionSources, TaskSite
from finssim.robot.pilots import make_pilot
from finssim.tasks import Task
from finssim.tasks.observer import fitted_task
from finssim.tasks.velocity import VelocityControl
from finssim.vehicles import Vehicle, load_vehicle

BATCH = 256
"""Number of episodes in the batch."""
ROWS = "episodes.json"


def site_of(
    task: str | Task,
    controller: str,
    vehicles: Sequence[Vehicle],
    *,
    seed: int = 0,
    plant: int = 0,
    severity: Severity = "nominal",
    guide: Guide | None = None,
    record: Path | None = None,
) -> TaskSite:
    """Return a virtual site with one episode of a task, with a controller for all agents.

    In the pool vehicles are located by the overhead camera through the water, in open water by fixes of motion capture
    on their wires: 50 Hz, 2 mm, 0.3°, 20 ms late, one in a hundred lost.

    Args:
        task: Task, its name, or FILE.py:CLASS of your own.
        controller: Directory of a policy, or a baseline of the task.
        vehicles: One for each agent of the task.
        seed: Seed of the episode, of noise and of losses.
        plant: Seed of every vehicle's plant.
        severity: Deviation of the plants from the vehicle files.
        guide: Reference of a task that follows one.
        record: Directory for PLACE.mcap and PLACE.truth of every agent; None: no records.

    Raises:
        PolicyError: The controller does not fit the task.
        ControlError: The task cannot be run on a robot, or the vehicles do not fit it.
        BaselineError: The baseline does not fit the task.
    """
    fitted = fitted_task(task, vehicles)
    if isinstance(fitted, VelocityControl):
        raise ControlError(
            f"task '{fitted.name}' draws velocities and attitudes in training alone: on a robot the velocity and the "
            "heading of a trajectory are its command, so that an episode of it cannot be played here"
        )
    pool = fitted.arena() is not None and fitted.dock() is None
    site = "pool" if pool else "open-water"
    vehicle = vehicles[0]
    true_camera, known, settings = camera_of(vehicle, plant, severity)
    if pool:
        positions = PositionSources(
            pool=known,
            camera=lambda v: PoolCamera(v, true_camera, mode="corners", settings=settings, seed=seed),
        )
    else:
        positions = PositionSources(positioning="motion-capture")
    task_argument: Any = task if isinstance(task, str) else fitted.name
    return TaskSite(
        task,
        vehicles,
        [(v, plant_at(site, draw_plant(v, plant, severity))) for v in vehicles],
        lambda name: make_pilot(
            controller, vehicles[fitted.vehicles.index(name)], task=task_argument, agent=name
        ),
        positions,
        seed=seed,
        guide=guide,
        record=record,
    )


def play(
    task: str,
    *,
    policy: str,
    episodes: Annotated[int, (1, 10000)] = 20,
    vehicle: str = "finsrov",
    plant: Annotated[int, (0, None)] = 0,
    severity: Severity = "nominal",
    seed: int = 1,
    out: Path | None = None,
    records: bool = False,
    show: Callable[[str], None] = lambda line: print(line, file=sys.stderr),
) -> dict[str, Any]:
    """Run any task through the deployed software, with all vehicles in lock-step; compare with the batch.

    Every vehicle has its plant, motor controller, bridge and pilot; robots exchange their positions, and the task
    scores the truth. Vehicles are located by the overhead camera in the pool, by motion capture in open water.

    Example: python -m studies.stack team-pursuit --policy runs/team --episodes 20 --out runs/team-stack

    Args:
        task (TASK): Task, or your own as FILE.py:CLASS.
        policy (DIR|NAME): Directory of a policy, or a baseline of the task.
        episodes: Number of episodes.
        vehicle (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file.
        plant: Seed of every vehicle's plant.
        severity (WORD): Deviation of the pools from the vehicle file: nominal, realistic or hard.
        seed: Seed of every random number; equal seeds give equal results.
        out (DIR): Directory that keeps every episode; an interrupted one is continued.
        records: Store in --out the record (.mcap) and the truth (.truth) of every agent.
        show: Receives a line after each episode.

    Returns:
        `stack` and `batch`, each as of `summarize_episodes`, and the settings.

    Raises:
        PolicyError, ControlError, BaselineError, VehicleError, OutputError: As they say.
    """
    if records and out is None:
        raise EpisodeError("--records needs a directory: give --out")
    body = load_vehicle(vehicle)
    fitted = fitted_task(task, body)
    vehicles = [body] * len(fitted.vehicles)
    about = {
        "task": fitted.name, "controller": policy, "vehicle": body.sha256,
        "plant": plant, "severity": severity, "seed": seed,
    }  # fmt: skip
    file = None if out is None else out / ROWS
    earlier = load_result(file) if file is not None and file.is_file() else {}
    rows = (
        list(earlier["episodes"]) if earlier and earlier == {**about, "episodes": earlier["episodes"]} else []
    )
    for k in range(len(rows), episodes):
        guide = list(TRAJECTORIES.values())[k % len(TRAJECTORIES)] if follows(fitted) else None
        record = out / f"episode_{k}" if out is not None and records else None
        if record is not None:
            shutil.rmtree(record, ignore_errors=True)  # of an interrupted episode
        site = site_of(
            task, policy, vehicles, seed=seed + k, plant=plant, severity=severity, guide=guide, record=record
        )
        measured = site.run()
        rows.append({"trial": k, **{name: x if np.isfinite(x) else None for name, x in measured.items()}})
        if file is not None:
            keep_result(file, {**about, "episodes": rows})
        show(f"episode {k + 1} of {episodes}: success {measured.get('success', float('nan')):g}")
    agent, nominal = make_pilot(policy, body, task=task).agent, load_plant("nominal")
    batch = run_episodes(
        agent, fitted_task(task, vehicles), body, nominal, TrialSettings(trials=BATCH, seed=seed)
    )
    return {**about, "stack": summarize_episodes(rows[:episodes]), "batch": summarize_episodes(batch)}


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """Return a table with a row for each measure, of the stack and of the batch."""
    stack, batch = result["stack"], result["batch"]
    title = f"{result['task']}, {result['controller']}"
    heads = [title, f"stack, {stack['trials']}", f"batch, {batch['trials']}"]
    rows = [
        [name, *(figure_text(entry["metrics"].get(name), ".3g") for entry in (stack, batch))]
        for name in stack["metrics"]
    ]
    return [Table(title=title, heads=heads, rows=rows, left=(0, 1, 2), intervals=True)]


if __name__ == "__main__":
    run_script("studies.stack:play")
