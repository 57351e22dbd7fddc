"""A programme as a trial of a robot, and the calibration's trial that its record makes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from finssim.calibration.excitation.programmes import Programme
from finssim.calibration.importers.dispatch import read_trials
from finssim.calibration.trials.trial import Trial
from finssim.control.guidance import Station
from finssim.experiments.excitation.places import Place
from finssim.experiments.on_robot.play import RobotTrial
from finssim.robot.programme_pilot import ProgrammePilot
from finssim.robot.runtime import Runtime
from finssim.vehicles import AXES, Vehicle

__all__ = ["ESTIMATOR", "about_programme", "fastest", "programme_trial", "trial_of_record"]

ESTIMATOR = "error-state"
"""Mode of the estimator: it predicts with the accelerometer, so that its velocity does not lag behind the motion."""


def programme_trial(
    programme: Programme, vehicle: Vehicle, place: Place, *, hold: str | None = "pid"
) -> RobotTrial:
    """The trial that plays a programme, and ends with it; its record has the phases.

    Args:
        programme: What to play.
        vehicle: As the robot knows it.
        place: Where it begins, and how far it may go.
        hold: PID that keeps the other axes; None leaves them alone.
    """
    pilot = ProgrammePilot(
        programme.tau_desired,
        programme.phase,
        programme.rate,
        programme.axes,
        vehicle,
        room=place.room,
        ascent_speed=programme.ascent_speed,
        ascent_time=programme.ascent_time,
        hold=hold,
    )
    return RobotTrial(
        name=programme.name,
        pilot=pilot,
        guide=Station(place.position, place.yaw, name=programme.name),
        duration=programme.duration,
        over=lambda runtime: pilot.finished,
        watch=_Phases(pilot, AXES.index(programme.axes[0])),
    )


class _Phases:
    """Tells the record when the programme's phase changes, and remembers how fast the vehicle was."""

    def __init__(self, pilot: ProgrammePilot, axis: int) -> None:
        self._pilot, self._axis, self._said, self.fastest = pilot, axis, "", 0.0

    def __call__(self, runtime: Runtime) -> None:
        if self._said and runtime.reading is not None:
            self.fastest = max(self.fastest, abs(float(runtime.reading.nu[self._axis])))
        if self._pilot.phase != self._said and runtime.reading is not None and runtime.recorder is not None:
            self._said = self._pilot.phase
            runtime.recorder.event(runtime.reading.time, "phase", self._said)


def fastest(trial: RobotTrial) -> float:
    """Highest speed along the first axis of a programme that was played, as the robot knows it [m/s, rad/s]."""
    return trial.watch.fastest if isinstance(trial.watch, _Phases) else 0.0


def about_programme(programme: Programme, where: str) -> dict[str, Any]:
    """What a record says of the trial that it makes."""
    return {"trial": {"axis": list(programme.axes), "description": f"{where}: {programme.name}"}}


def trial_of_record(record: Path, name: str, role: str) -> Trial:
    """The trial of a record, from where its programme began.

    Args:
        record: MCAP of one programme.
        name: Of the trial.
        role: fit or held-out.
    """
    trial = read_trials([record], split="phase")[0]
    return replace(trial, name=name, header=trial.header.model_copy(update={"role": role}))
