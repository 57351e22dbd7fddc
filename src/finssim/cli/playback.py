"""`finssim play`: print the messages of a record, or film an episode of a policy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from finssim.agents.agent import agent_for, goals_in, rollout
from finssim.control.policy import read_description
from finssim.core.files import atomic_write
from finssim.core.progress import progress_bar
from finssim.core.quiet import start_warp
from finssim.evaluation.plants import load_plant
from finssim.robot.record_reader import play_record
from finssim.sim.site import described_world
from finssim.tasks import Environment, task_named
from finssim.vehicles import catalogue_vehicle, load_vehicle


class PlaybackError(ValueError):
    """Path that cannot be played."""


@dataclass(frozen=True, kw_only=True)
class FilmSettings:
    """Settings of the film of an episode."""

    speed: float = 1.0
    """(FACTOR) Speed factor of the film relative to the episode [-]."""
    video: Path | None = None
    """(FILE) Film to write (.mp4)."""
    task: str | None = None
    """(TASK) Task of the episode; default that of the policy's training. Your own: FILE.py:CLASS."""
    vehicle: str | None = None
    """(NAME|FILE) Vehicle in the episode; default that of the policy's training."""
    plant: str = "nominal"
    """(FILE|NAME) Plant of the episode, as in finssim evaluate."""
    seed: int = 1
    """Seed of the episode."""


def play(
    path: Path,
    *,
    topics: Annotated[Sequence[str] | None, ","] = None,
    start: Annotated[float, (0.0, None)] = 0.0,
    film: Annotated[FilmSettings, "options"] = FilmSettings(),
) -> None:
    """Print the messages of a record as JSON lines [SI units], or film an episode of a policy.

    Example: finssim play run.mcap --topics odom,events

    Example: finssim play runs/see --plant held_out --video see.mp4

    Args:
        path (FILE|DIR): Record of a run (.mcap), or directory of a policy.
        topics (NAMES): Topics of a record to print, separated by commas: odom,thruster_cmd.
        start: Offset from the start of the record [s].
        film: Film of an episode.

    Raises:
        RecordError: The file is not a record, or lacks a topic.
        PlaybackError: A policy directory is given without --video, or a record with --video or --speed.
        PolicyError: The policy cannot be used.
        PlantError: The plant cannot be used.
        EnvironmentSetupError: The task cannot be set up.
    """
    if not path.is_dir():
        if film.video is not None:
            raise PlaybackError(f"{path} is not a policy directory: only episodes of policies can be filmed")
        if film.speed != 1.0:
            raise PlaybackError(
                "--speed applies only to films: the messages of a record are printed without waiting, omit it"
            )
        play_record(path, topics=topics, start=start)
        return
    _film(path, film)


def _film(path: Path, film: FilmSettings) -> None:
    """Film an episode of the policy in a directory."""
    video = film.video
    if video is None or video.suffix != ".mp4":
        raise PlaybackError(f"{path} is a policy: give the film to write, --video FILE.mp4")
    if not film.speed > 0.0:
        raise PlaybackError(f"speed is {film.speed:g}, expected more than 0")
    start_warp()
    description = read_description(path)
    the_task = task_named(film.task or description.task)
    body = (
        load_vehicle(film.vehicle) if film.vehicle else catalogue_vehicle(description.vehicle.name, str(path))
    )
    agent = agent_for(path, body, the_task)
    environment = load_plant(film.plant).environment(agent, the_task, body, seed=film.seed, auto_reset=False)
    with atomic_write(video) as temporary, progress_bar("episode") as show:
        steps = round(the_task.time_limit / the_task.control_step)
        camera, pictures = described_world("pool").chase_camera(environment), []
        for k, step in rollout(agent, environment, steps, lambda t: goals_in(environment)):
            pictures.append(_with_observed(camera.picture(), environment))
            show(k / steps)
            if step is not None and (step.terminated[0] or step.truncated[0]):
                break
        _write_video(temporary, pictures, film.speed / the_task.control_step)
    outcome = environment.task.metrics(environment.arrays)
    success = {1.0: ", success", 0.0: ", no success"}.get(float(outcome.get("success", [np.nan])[0]), "")
    Console(stderr=True).print(
        f"film: {video}  ({len(pictures)} pictures{success})", highlight=False, soft_wrap=True, markup=False
    )


def _with_observed(picture: NDArray[np.uint8], environment: Environment) -> NDArray[np.uint8]:
    """Return the picture with the vehicle's own pictures in its corner, each at least about a quarter as wide."""
    if environment.sight is None:
        return picture
    corner = 0
    for small in environment.sight.shown(0).values():
        factor = max(1, round(picture.shape[1] / 4 / small.shape[1]))
        large = small.repeat(factor, 0).repeat(factor, 1)
        picture[corner : corner + large.shape[0], : large.shape[1]] = large
        corner += large.shape[0] + 2
    return picture


def _write_video(path: Path, pictures: list[NDArray[np.uint8]], rate: float) -> None:
    """Write pictures of equal size as a film (.mp4) with a frame rate [Hz]."""
    import cv2

    height, width = pictures[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate, (width, height))
    for picture in pictures:
        writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    writer.release()
