"""`finssim train`: from a task and a vehicle to a policy directory, with any learner."""

from __future__ import annotations

import json
import threading
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console

from finssim.control.policy import DESCRIPTION_FILE, PolicyDescription, plain_data
from finssim.core.files import atomic_directory, refuse_unwritable
from finssim.core.quiet import start_warp
from finssim.learning.learners import learner_named
from finssim.sim.randomize import Randomization
from finssim.sim.water import load_water
from finssim.tasks import Environment, Task, make, task_named
from finssim.tasks.fitting import authority
from finssim.vehicles import Vehicle, load_vehicle


class TrainingError(ValueError):
    """A training cannot be started."""


@dataclass(frozen=True, kw_only=True)
class TrainingSettings:
    """Settings of a training: the vehicle, its actions and observations, and the learner."""

    learner: str | None = None
    """(NAME) Learner: ppo (FinsSim's own, the default), sb3-ppo or rsl-rl; for one agent also torchrl-ppo, for several
    torchrl-ippo or torchrl-mappo; from demonstrations bc or dagger; for tasks with images distill, their default; or
    your own, FILE.py:CLASS."""
    vehicle: str | Vehicle = "finsrov"
    """(NAME|FILE) Vehicle in the catalogue, or path of a vehicle file."""
    hydrodynamics: str = "calibrated"
    """(MODEL) Hydrodynamic model: calibrated, simplified or mesh."""
    action: str | None = None
    """(MODE) Action mode: wrench6, wrench4, thruster8, pilot6, surfaces, course or course_pitch; the
    task's own if not given."""
    randomize: str | Path | None = None
    """(FILE) Ranges of vehicle and water parameters: hold_for_position, fossen_learn_to_swim, equivalent_box, pool,
    open_water, cruise, no_thruster_dynamics, or a file."""
    observe: str = "training"
    """(FILE|NAME) Observation: training (the task's noise), sensors (the vehicle's own and position fixes, through a
    filter), a file of other fixes, estimator (typical errors of localization) or truth."""
    water: Path | None = None
    """(FILE) Water file (.yaml): currents, a profile over depth and time, waves or a sea state, in addition to the
    draws of --randomize."""
    seed: int = 1
    """Seed of every random number; equal seeds give equal results."""
    worlds: Annotated[int | None, (1, 10_000_000)] = None
    """Worlds simulated at once."""
    steps: Annotated[int | None, (1, 1_000_000_000_000)] = None
    """Control steps of the training, summed over all worlds; the task's default if not given."""
    until: float | None = None
    """(FRACTION) Success rate, such as 0.95, that ends the training early if reached in two consecutive
    evaluations."""
    init: str | Path | None = None
    """(NAME|DIR) Controller to imitate first (ppo only): a baseline of the task, such as pid, a policy directory, or
    none; pursuit, team-pursuit and formation default to their baselines. --set taught=FRACTION sets the fraction of the
    training."""
    settings: Annotated[Mapping[str, Any] | Sequence[str], "--set"] = ()
    """(NAME=VALUE) Change a setting of the learner, such as learning_rate=1e-3 or hidden=128,128. May be repeated."""
    wandb: str | None = None
    """(PROJECT) Project of Weights & Biases to send the curves to, besides TensorBoard; with WANDB_MODE=offline they
    are stored beside the policy for 'wandb sync'."""
    device: str = "cpu"
    """(DEVICE) Compute device: cpu or cuda."""
    processes: Annotated[int, (1, 1024)] = 1
    """Processes that share the worlds and each batch (ppo only, with torch), one for each GPU; on a CPU a single
    process is faster."""

    def check(self) -> None:
        """Refuse numbers that are out of range, and a missing installation of Weights & Biases.

        Raises:
            TrainingError: A number is out of its range.
            ModuleNotFoundError: The package wandb is missing.
        """
        for name, number in (("worlds", self.worlds), ("steps", self.steps)):
            if number is not None and number < 1:
                raise TrainingError(f"{name} is {number}, expected 1 or more")
        if self.until is not None and not 0.0 < self.until <= 1.0:
            raise TrainingError(f"until is {self.until}, expected a share of successes above 0, at most 1")
        if self.wandb is not None:
            import_module("wandb")  # fails here if the package is missing, before anything is created

    def environment(
        self, task: Task, worlds: int, randomization: Randomization | None, seed: int, **options: Any
    ) -> Environment:
        """Return worlds of a task, with the vehicle's authority as the wrench scale.

        Args:
            task: Task.
            worlds: Number of worlds.
            randomization: Ranges of their parameters; None for none.
            seed: Seed of all random numbers.
            options: Further arguments of `finssim.make`.
        """
        body = load_vehicle(self.vehicle)
        scale = authority(body) if (self.action or task.action).startswith("wrench") else 1.0
        return make(
            task, worlds=worlds, vehicle=body, hydrodynamics=self.hydrodynamics, action=self.action,
            randomize=randomization, observe=self.observe, device=self.device, seed=seed, wrench_scale=scale,
            water=None if self.water is None else load_water(self.water), **options,
        )  # fmt: skip


def train(
    task: str | Task,
    settings: Annotated[TrainingSettings, "options"] = TrainingSettings(),
    *,
    out: Path,
    resume: bool = False,
    saved: Callable[[Path], None] = lambda checkpoint: None,
    console: Console | None = None,
    as_json: bool = False,
) -> Path:
    """Train a policy and write it to a directory that runs without the learner.

    The folder `OUT-training` beside it contains the TensorBoard log and the last two checkpoints: policy directories
    from which an interrupted training resumes, with the same result.

    Example: finssim train t1 --vehicle finsrov --seed 1 --out runs/hold

    Example: finssim train docking --until 0.95 --out runs/dock

    Example: finssim train t2 --learner rsl-rl --randomize hold_for_position --set epochs=8 --out runs/track

    Args:
        task (TASK): Task to learn: t1 (station keeping), t2 (trajectory tracking), t3 (moving target), velocity6
            (velocity and attitude), docking, path, waypoints, terrain, homing, pursuit, team-pursuit, formation; with
            a camera camera-docking, pipeline or gate, with a sonar net; or your own, FILE.py:CLASS.
        settings: Settings of the training.
        out (DIR): Directory of the policy; an existing policy there is replaced at the end.
        resume: Resume an interrupted training from its last checkpoint.
        saved: Called with the directory of every checkpoint.
        console: Console for the progress; standard error if None.
        as_json: Print one JSON object about the policy, to standard output.

    Returns:
        The policy directory. After Ctrl-C the unfinished policy is there, or in `OUT-training/interrupted` if `out`
        contains an earlier policy.

    Raises:
        EnvironmentSetupError: Unknown task.
        TrainingError: A number is out of range.
        LearningError: Unknown learner or setting, a task that the learner does not support, or a diverged training.
        ResumeError: There is nothing to resume, or it is another training.
        KeyboardInterrupt: After Ctrl-C, once the policy so far, if there is one, has been written.
    """
    console = console or Console(stderr=True)
    settings.check()
    the_task = task_named(task)
    learner = settings.learner or ("distill" if the_task.pictures else "ppo")
    kind = learner_named(learner)
    kind.check(the_task)
    load_vehicle(settings.vehicle)
    randomization = Randomization(settings.randomize) if settings.randomize is not None else None
    refuse_unwritable(atomic_directory(out, replaces=DESCRIPTION_FILE))
    start_warp()
    side = training_folder(out)

    from finssim.learning.episodes import HELD_WORLDS, HeldEvaluation, held_seed
    from finssim.learning.export import description_of
    from finssim.learning.layers import single_thread
    from finssim.learning.parallel import leading
    from finssim.learning.training_loop import TrainingLoop, TrainingView, has_tensorboard, last_checkpoint

    if not has_tensorboard():
        console.print(
            "TensorBoard is not installed (pip install 'finssim[learn]'): the curves go to curves.csv alone",
            soft_wrap=True, markup=False,
        )  # fmt: skip
    checkpoint = last_checkpoint(side) if resume else None
    values = _values(settings, kind, learner, the_task)
    seed, device, until = settings.seed, settings.device, settings.until
    if settings.processes > 1:
        _check_processes(settings, learner, values.worlds, resume)
    environment = _share(settings, the_task, values, seed)
    fitted = environment.task
    if until is not None and "success" not in fitted.metrics(environment.arrays):
        raise TrainingError(
            f"until is {until}, but task '{fitted.name}' has no metric 'success': leave until out"
        )
    description = description_of(
        environment, learner=learner, algorithm=kind.what, **asdict(values), device=device,
        observe={"name": settings.observe}, until=until,
        **({} if settings.processes == 1 else {"processes": settings.processes}),
        **({} if settings.water is None else {"water": asdict(load_water(settings.water))}),
    )  # fmt: skip
    began = time.perf_counter()
    full = randomization and randomization.at_full_width()  # the evaluation always uses the full ranges
    held = settings.environment(fitted, HELD_WORLDS, full, held_seed(seed))
    with (
        single_thread(), leading(settings.processes, device, _follow, task, settings) as group,
        TrainingView(values.steps, console) as view, warnings.catch_warnings(),
    ):  # fmt: skip
        warnings.filterwarnings("ignore", message=".*mini-batch.*")  # a small last batch does no harm
        warnings.filterwarnings("ignore", message=".*on the GPU.*")
        loop = TrainingLoop(
            _learner(kind, environment, values, settings, group), description, side,
            evaluate=HeldEvaluation(held, device), show=view.update, progress=environment.set_progress,
            identity=_identity(description), until=until, saved=saved,
            project=settings.wandb,
        )  # fmt: skip
        if checkpoint is not None:
            loop.resume(checkpoint)
            view.resume_at(loop.learner.steps)
        elif resume:
            console.print(
                f"no checkpoint in {side} yet: starting from the beginning", soft_wrap=True, markup=False
            )
        stopped = loop.run()
    folder = _path_beside(Path(out), side) if stopped else Path(out)
    _finish(loop, folder, stopped, console, time.perf_counter() - began)
    if as_json:
        print(json.dumps({"policy": str(folder), "best_steps": loop.best.steps, **loop.curves[-1]}))
    return folder


def _check_processes(settings: TrainingSettings, learner: str, worlds: int, resume: bool) -> None:
    """Refuse a training that several processes cannot share.

    Raises:
        TrainingError: Another learner than ppo, worlds that cannot be divided, too few GPUs, or a training to resume.
        ModuleNotFoundError: The package torch is missing.
    """
    torch = import_module("torch")
    n = settings.processes
    if learner != "ppo":
        raise TrainingError(
            f"processes is {n}, but learner '{learner}' trains in one: leave it out, or use ppo"
        )
    if worlds % n:
        raise TrainingError(
            f"{worlds} worlds cannot be shared by {n} processes: give a multiple of {n} worlds"
        )
    if settings.device != "cpu" and n > torch.cuda.device_count():
        raise TrainingError(
            f"processes is {n}, but there are {torch.cuda.device_count()} GPUs: one process each"
        )
    if resume:
        raise TrainingError(
            "a training in several processes cannot be resumed: its checkpoints hold the first's state"
        )


def _share(settings: TrainingSettings, task: Task, values: Any, seed: int) -> Environment:
    """Return the worlds of this process.

    Args:
        settings: Settings of the training.
        task: Task.
        values: Settings of the learner.
        seed: Seed of these worlds.
    """
    randomization = Randomization(settings.randomize) if settings.randomize is not None else None
    asymmetric = randomization is not None and getattr(values, "asymmetric", False)
    worlds = values.worlds // settings.processes
    return settings.environment(task, worlds, randomization, seed, privileged=asymmetric)


def _learner(kind: Any, environment: Environment, values: Any, settings: TrainingSettings, group: Any) -> Any:
    """Return the learner; with several processes its arrays are those of the group."""
    from finssim.learning.layers import Arrays

    shared = {} if group is None else {"arrays": Arrays(settings.seed, group.device, group)}
    return kind(environment, values, seed=settings.seed, device=settings.device, **shared)


def _follow(group: Any, task: str | Task, settings: TrainingSettings) -> None:
    """Participate in the training of a group's first process, until that terminates this process."""
    from finssim.learning.layers import single_thread

    start_warp()
    the_task = task_named(task)
    kind = learner_named("ppo")
    values = _values(settings, kind, "ppo", the_task)
    settings = replace(settings, device=group.device)
    environment = _share(settings, the_task, values, group.seed(settings.seed))
    with single_thread():
        learner = _learner(kind, environment, values, settings, group)
        while learner.steps < values.steps:
            environment.set_progress(learner.steps / values.steps)
            learner.update()
    threading.Event().wait()


def training_folder(policy: Path) -> Path:
    """Return the folder of checkpoints and logs of the training of a policy directory."""
    return Path(policy).with_name(f"{Path(policy).name}-training")


def _values(settings: TrainingSettings, kind: Any, learner: str, task: Task) -> Any:
    """Return the learner's own settings for a task, with the changes and the teacher.

    Args:
        settings: Settings of the training.
        kind: Class of the learner.
        learner: Name of the learner.
        task: Task.
    """
    given = settings.settings
    changes = dict(given) if isinstance(given, Mapping) else parse_settings(given)
    teacher = settings.init not in (None, "none") or "teacher" in changes  # a teacher acts on the host
    values = kind.settings(
        task, randomized=settings.randomize is not None, worlds=settings.worlds, steps=settings.steps, changes=changes,
        device="cpu" if teacher else settings.device,
    )  # fmt: skip
    return _taught(values, settings.init, learner, (settings.action or task.action) == task.action)


def _taught(values: Any, init: str | Path | None, learner: str, default_action: bool) -> Any:
    """Return the settings with the teacher; the task's default teacher is used only in the task's own action mode."""
    if not hasattr(values, "teacher"):
        if init is None:
            return values
        raise TrainingError(f"learner '{learner}' has no initial imitation: omit init, or use ppo")
    if init is not None:
        return replace(values, teacher="" if str(init) == "none" else str(init))
    return values if default_action else replace(values, teacher="")


def parse_settings(texts: Sequence[str]) -> dict[str, Any]:
    """Return changes of settings from NAME=VALUE; a value with commas is a list.

    Raises:
        TrainingError: A word has no name or no value.
    """
    changes: dict[str, Any] = {}
    for word in texts:
        name, _, value = word.partition("=")
        if not name or not value:
            raise TrainingError(f"setting '{word}': expected NAME=VALUE, such as learning_rate=1e-3")
        changes[name] = value.split(",") if "," in value else value
    return changes


def _finish(loop: Any, folder: Path, stopped: bool, console: Console, took: float) -> None:
    """Write the final policy, or the policy so far; re-raise the interrupt after Ctrl-C."""
    from finssim.learning.export import export_policy
    from finssim.learning.training_loop import after

    if not loop.curves:
        console.print("no policy: interrupted before anything was learned", soft_wrap=True)
        raise KeyboardInterrupt
    done = loop.curves[-1]["steps"]
    best = loop.best
    title = "policy so far" if stopped else "policy"
    export_policy(
        best.network, folder, after(loop.description, done, not stopped, best.steps), curves=loop.curves
    )
    best_text = f", best after {best.steps:,}" if best.steps < done else ""
    message = f"{title}: {folder}  ({done:,} steps in {took:.1f} s{best_text})"
    console.print(message, highlight=False, soft_wrap=True, markup=False)
    if stopped:
        raise KeyboardInterrupt


def _path_beside(out: Path, side: Path) -> Path:
    """Return the directory of an unfinished policy, which must not replace a finished one."""
    return side / "interrupted" if (out / DESCRIPTION_FILE).is_file() else out


def _identity(description: PolicyDescription) -> dict[str, Any]:
    """Return the values that must be equal for an exact continuation of a training, by their names in messages."""
    described = plain_data(
        description.model_dump(mode="json", include={"task", "action", "hydrodynamics", "seed"})
    )
    training = plain_data(description.training)
    return {**described, "vehicle": description.vehicle.sha256[:12], **training}
