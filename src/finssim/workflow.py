"""The steps of a study as functions: identify a vehicle, train a policy, evaluate it, and run it in the virtual pool.

They return objects and print nothing, and `finssim` exports them. Each corresponds to the command of the same
name.
"""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from finssim.core.progress import progress_bar, silent
from finssim.vehicles import Vehicle, load_vehicle

if TYPE_CHECKING:
    from finssim.control.policy import Policy
    from finssim.evaluation.evaluate import Evaluations
    from finssim.identification.fit import Fit
    from finssim.tasks import Task
    from finssim.trials.trial import Trial

__all__ = ["evaluate", "identify", "run_in_pool", "train"]


def identify(
    vehicle: Vehicle | str | Path,
    trials: Sequence[Trial | str | Path] | Trial | str | Path,
    *,
    axes: Sequence[str] | None = None,
    estimate: Sequence[str] = (),
    damping: str = "auto",
    progress: bool = False,
) -> Fit:
    """Fit a vehicle's added mass, damping, buoyancy and stiffness to trials.

    Args:
        vehicle: The vehicle to start from, the name of one in the catalogue, or the path of a vehicle file.
            It provides the rigid body, the thrusters and every parameter that is not fitted.
        trials: Trials, or paths of trial folders, of folders of them, or of tables with a trial's columns.
            Trials with the `role` held-out are not fitted; they validate the fit.
        axes: Axes to fit, of surge, sway, heave, roll, pitch and yaw; those that the trials excite if None.
        estimate: Further parameters to fit: thrust_scale, thrust_lag, thrust_delay, buoyancy_excess, k,
            or a parameter of one of the vehicle's terms.
        damping: Drag: linear, quadratic, both, or auto, which selects one of them.
        progress: Whether progress is shown on standard error.

    Returns:
        The fit: `vehicle`, `estimates` and their 95 % `intervals`, `findings`, `quality` and `plot()`.

    Raises:
        CalibrationError: No trial can be used, or an argument is unknown.
        VehicleError: There is no such vehicle.
    """
    from finssim.identification.hydrodynamics import fit_hydrodynamics
    from finssim.identification.report import usable
    from finssim.trials.findings import CalibrationError
    from finssim.trials.trial import Trial
    from finssim.trials.trial_files import load_trials

    body = load_vehicle(vehicle)
    given = [trials] if isinstance(trials, Trial | str | Path) else list(trials)
    if not given:
        raise CalibrationError("no trials were given: expected one or more trials or paths of trials")
    read = [t for item in given for t in ([item] if isinstance(item, Trial) else load_trials([item]))]
    used, remarks = usable(read)
    remarks += [item.about(trial.name) for trial in used for item in trial.findings]
    with silent(not progress), progress_bar("identify") as show:
        fit = fit_hydrodynamics(
            used,
            body,
            axes=[axes] if isinstance(axes, str) else axes,
            estimate=[estimate] if isinstance(estimate, str) else estimate,
            damping=damping,
            held_out=[trial for trial in read if trial.header.role == "held-out"],
            progress=show,
        )
    return replace(fit, findings=(*remarks, *fit.findings))


def train(
    task: str | Task = "t1",
    *,
    vehicle: Vehicle | str | Path = "finsrov",
    seed: int = 1,
    out: str | Path | None = None,
    learner: str | None = None,
    steps: int | None = None,
    worlds: int | None = None,
    randomize: str | Path | None = None,
    settings: Mapping[str, Any] | None = None,
    progress: bool = False,
    **options: Any,
) -> Policy:
    """Train a policy.

    Args:
        task: Task to learn: its name, FILE.py:CLASS, or a `Task`.
        vehicle: A vehicle, the name of one in the catalogue, or the path of a vehicle file.
        seed: Seed of every random number; equal seeds give equal results.
        out: Directory of the policy; if None, the policy is deleted with the object (see `Policy.save`).
        learner: Learner; ppo if None, and distill for tasks with images.
        steps: Control steps of the training, summed over all worlds; the task's default if None.
        worlds: Number of worlds simulated in parallel; the learner's default if None.
        randomize: Ranges of vehicle and water parameters: a name or a file.
        settings: Settings of the learner, such as {"learning_rate": 1e-3}.
        progress: Whether progress is shown on standard error.
        options: Further fields of `finssim.learning.train.TrainingSettings`, and `resume`.

    Returns:
        The policy, for `evaluate` and `run_in_pool`.

    Raises:
        TrainingError, LearningError, EnvironmentSetupError, VehicleError, OutputError: See these classes.
    """
    from rich.console import Console

    from finssim.control.policy import Policy
    from finssim.learning.train import TrainingSettings
    from finssim.learning.train import train as train_into

    body = load_vehicle(vehicle)
    folder = None if out is not None else tempfile.TemporaryDirectory(prefix="finssim-policy-")
    target = Path(out) if folder is None else Path(folder.name) / "policy"
    resume = options.pop("resume", False)
    training = TrainingSettings(
        learner=learner, vehicle=body, seed=seed, worlds=worlds, steps=steps, randomize=randomize,
        settings=settings or {}, **options,
    )  # fmt: skip
    train_into(task, training, out=target, resume=resume, console=Console(stderr=True, quiet=not progress))
    policy = Policy.load(target, vehicle=body)
    if folder is not None:
        weakref.finalize(policy, folder.cleanup)
    return policy


def evaluate(
    controller: Policy | str | Path,
    task: str | None = None,
    *,
    vehicle: Vehicle | str | Path | None = None,
    plant: str | Path | Sequence[str | Path] = "nominal",
    trials: int | None = None,
    seed: int = 1,
    progress: bool = False,
    **options: Any,
) -> Evaluations:
    """Evaluate a controller in simulated trials of a task.

    Args:
        controller: A policy, the path of its directory, the name of a baseline of the task such as pid, or
            the path of a record (.mcap) of a controller on a robot.
        task: Name of the task, or FILE.py:CLASS; if None, that of the policy, or t1 for a controller without
            one.
        vehicle: A vehicle, the name of one in the catalogue, or the path of a vehicle file; the policy's if
            None.
        plant: How the simulated vehicle and water differ from the vehicle file: a name, a file, or several.
        trials: Number of trials in each plant; if None the eight setpoints of t1, the four trajectories of
            t2, or the task's own number of episodes.
        seed: Seed of every random number.
        progress: Whether progress is shown on standard error.
        options: Further arguments of `finssim.evaluation.evaluate.evaluate`.

    Returns:
        The result: `table`, `metrics`, `plot()`, and `each` with the trials of every plant.

    Raises:
        EvaluationError, PolicyError, ControlError, PlantError, VehicleError: See these classes.
    """
    from finssim.control.policy import Policy
    from finssim.evaluation.evaluate import evaluate_in_plants

    named: Any = vehicle
    if isinstance(controller, Policy) and vehicle is None:
        named = _vehicle_of(controller)
    with silent(not progress):
        return evaluate_in_plants(
            controller.folder if isinstance(controller, Policy) else controller,
            task=task,
            vehicle=named,
            plant=plant,
            trials=trials,
            seed=seed,
            **options,
        )


def run_in_pool(
    controller: Policy | str | Path,
    task: Literal["t1", "t2"] = "t1",
    *,
    plant: int = 1,
    vehicle: Vehicle | str | Path | None = None,
    targets: Sequence[str] | None = None,
    severity: str = "realistic",
    camera: str = "corners",
    site: str = "pool",
    firmware: Literal["mcu", "ardusub"] = "mcu",
    duration: float = 60.0,
    seed: int = 1,
    progress: bool = False,
) -> Evaluations:
    """Run the robot's complete software against the virtual pool in lock-step, faster than real time where
    possible.

    The vehicle in the pool differs from the controller's model: mass, drag, thrusters, sensors and delays are
    drawn around the vehicle file. The controller observes only the estimates of localization and the fusion
    filter.

    Args:
        controller: A policy, the path of its directory, or pid or pid-paper.
        task: t1 (station keeping) or t2 (trajectory tracking).
        plant: Seed from which the pool's vehicle is drawn.
        vehicle: The vehicle that the robot's software assumes: a vehicle, a name or a file; the policy's if
            None.
        targets: Names of setpoints (t1) or of trajectories (t2); all of the paper's if None.
        severity: Difference between the drawn vehicle and the vehicle file: nominal, realistic or hard.
        camera: Output of the overhead camera: tag corners with noise, or rendered pictures in which tags are
            detected.
        site: Where the vehicle is: pool, tank or open-water.
        firmware: mcu (a motor controller), or ardusub: the emulated autopilot, with a Doppler log and a compass instead
            of the camera.
        duration: Length of a trial of t1 [s].
        seed: Seed of all noise.
        progress: Whether progress is shown on standard error.

    Returns:
        The result, computed from the true motion: `table`, `metrics`, `plot()`.

    Raises:
        EvaluationError: Another task, or unknown firmware or site.
        PolicyError, ControlError, PlantSpecError, VehicleError: See these classes.
    """
    from finssim.control.policy import Policy
    from finssim.evaluation.evaluate import FORMS, EvaluationError, Evaluations, evaluation
    from finssim.evaluation.robot_trials import RobotJob, play_trial
    from finssim.robot.pilots import make_pilot
    from finssim.vehicles.defaults import SITES

    if task not in FORMS:
        raise EvaluationError(f"run_in_pool plays {', '.join(FORMS)}, but the task is '{task}'")
    for kind, value, known in (("firmware", firmware, ("mcu", "ardusub")), ("site", site, tuple(SITES))):
        if value not in known:
            raise EvaluationError(f"unknown {kind} '{value}'; available: {', '.join(known)}")
    if vehicle is None:
        vehicle = _vehicle_of(controller) if isinstance(controller, Policy) else "finsrov"
    body = load_vehicle(vehicle)
    name = str(controller.folder if isinstance(controller, Policy) else controller)
    about = make_pilot(name, body, task=task).describe()
    eyes = f"seen by {camera}" if firmware == "mcu" else firmware
    names = FORMS[task].targets if targets is None else [targets] if isinstance(targets, str) else targets
    if task == "t1" and (unknown := [name for name in names if name not in FORMS[task].targets]):
        raise EvaluationError(f"unknown setpoint '{unknown[0]}'; available: {', '.join(FORMS[task].targets)}")
    measures, trials = [], []
    with silent(not progress), progress_bar(f"virtual pool, plant {plant}") as show:
        for k, target in enumerate(names):
            show(k / len(names), target)
            job = RobotJob(
                row=name, target=target, plant=plant, seed=seed, controller=name, vehicle=body, pool_vehicle=body,
                severity=severity, camera=camera, site=site, firmware=firmware, duration=duration,
            )  # fmt: skip
            result, trial = play_trial(job)
            measures.append(result)
            trials.append(trial)
    where = {"name": f"pool {plant}", "title": f"virtual pool, plant {plant}, {severity}, {eyes}"}
    return Evaluations((evaluation(about, task, body, where, measures, trials, seed=seed),))


def _vehicle_of(policy: Policy) -> Vehicle:
    """Return the vehicle that a policy was trained for, if the policy contains it or the catalogue does.

    Raises:
        EvaluationError: The policy was trained for another vehicle.
    """
    from finssim.evaluation.evaluate import EvaluationError
    from finssim.vehicles import catalogue

    if isinstance(policy.vehicle, Vehicle):
        return policy.vehicle
    trained = policy.description.vehicle
    vehicle = load_vehicle(trained.name) if trained.name in catalogue() else None
    if vehicle is None or vehicle.sha256 != trained.sha256:
        raise EvaluationError(
            f"the policy was trained for a vehicle '{trained.name}' that is not in the catalogue: pass it as vehicle="
        )
    return vehicle
