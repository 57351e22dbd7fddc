"""`finssim experiment stack`: any task through the deployed software in lock-step, beside the same in the batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from finssim.control.guidance import Guide
from finssim.pool.camera import PoolCamera
from finssim.pool.draw_plant import draw_plant
from finssim.pool.others import TrueState
from finssim.pool.plant_spec import Severity
from finssim.pool.site import camera_of
from finssim.pool.task_site import TaskSite, open_water
from finssim.robot.pilots import ObservingPilot
from finssim.tasks import Task
from finssim.tasks.communication import Communication
from finssim.tasks.observer import fitted_task
from finssim.vehicles import Vehicle

__all__ = ["site_of"]


def site_of(
    task: str | Task,
    who: str,
    vehicles: Sequence[Vehicle],
    *,
    seed: int = 0,
    plant: int = 0,
    severity: Severity = "nominal",
    guide: Guide | None = None,
    communication: Communication | None = None,
) -> TaskSite:
    """One episode of a task in the virtual site, with a controller for all agents.

    A task of the pool is located by the overhead camera through the water. In open water the site tells every vehicle
    its true pose, as an ideal acoustic positioning system would.

    Args:
        task: A task, its name, or FILE.py:CLASS of one's own.
        who: A policy's directory, or a baseline of the task.
        vehicles: One for each of its places.
        seed: Of the episode, of noise and of what is lost.
        plant: Seed of every vehicle's plant.
        severity: How far the plants are from the vehicle files.
        guide: The reference, of a task that follows one.
        communication: Of what the vehicles tell each other; the task's own if None.

    Raises:
        PolicyError, ControlError, BaselineError: Controller, vehicles and task do not fit.
    """
    fitted = fitted_task(task, vehicles)
    pool = fitted.arena() is not None and fitted.dock() is None
    one = vehicles[0]
    site, known, settings = camera_of(one, plant, severity)
    words: Any = task if isinstance(task, str) else fitted.name
    return TaskSite(
        task,
        vehicles,
        lambda v: (
            draw_plant(v, plant, severity) if pool else open_water(draw_plant(v, plant, severity), fitted, v)
        ),
        lambda name: ObservingPilot(who, vehicles[fitted.vehicles.index(name)], task=words, agent=name),
        known,
        seed=seed,
        guide=guide,
        communication=communication or getattr(fitted, "communication", None),
        camera=(lambda v: PoolCamera(v, site, mode="corners", settings=settings, seed=seed))
        if pool
        else None,
        perception=None if pool else TrueState,
    )
