"""The loop around a learner: progress, curves, evaluation on fixed episodes, checkpoints, Ctrl-C, and resuming."""

from __future__ import annotations

import math
import os
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Column
from rich.text import Text

from finssim.control.policy import DESCRIPTION_FILE, PolicyDescription
from finssim.learning.export import export_policy, onnx_bytes
from finssim.learning.learners import Learner, LearningError
from finssim.learning.resume import RESUME_FILE, ResumeError, read_state, write_state

# Progress display: completed fraction, speed, results, remaining time.


class _Results(ProgressColumn):
    """Rate, mean return and success rate."""

    def render(self, task: Task) -> Text:
        return Text(summary(task.fields), style="cyan")


def summary(row: Mapping[str, Any]) -> str:
    """Return a short summary of a row of the training curve."""
    if not row.get("steps_per_s"):
        return ""
    rate, held = row["steps_per_s"] / 1e3, 100.0 * row["held"]
    text = f"{rate:.0f} k steps/s  return {row['mean_return']:.1f}  held {held:.0f} %"
    success = row.get("evaluation_success")
    return text if success is None else f"{text}  evaluated {100.0 * success:.0f} %"


class TrainingView:
    """Live progress bar on a terminal; otherwise a line for every tenth of the training."""

    def __init__(self, total: int, console: Console | None = None) -> None:
        """Show the progress of a training of `total` control steps."""
        self.total = total
        self.console = console or Console(stderr=True)
        self._live = self.console.is_terminal
        self._next = 0.1
        columns = (
            TextColumn("training"),
            BarColumn(bar_width=16),
            TaskProgressColumn(),
            _Results(table_column=Column(no_wrap=True)),
            TimeRemainingColumn(compact=True),
        )
        self._progress = Progress(*columns, console=self.console, disable=not self._live)
        self._task = self._progress.add_task("train", total=total)
        self._start, self._first = time.perf_counter(), 0

    def __enter__(self) -> TrainingView:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def resume_at(self, steps: int) -> None:
        """Start at a number of earlier steps, which do not count in the time of this training."""
        self._first = steps
        self._next = (int(steps / self.total * 10.0) + 1) / 10.0
        self._progress.reset(self._task, completed=steps)

    def update(self, row: Mapping[str, Any]) -> None:
        """Show a row of the training curve: steps, steps_per_s, mean_return, held, and evaluation_success if
        present."""
        self._progress.update(self._task, completed=row["steps"], **row)
        part = row["steps"] / self.total
        if not self._live and part >= self._next:
            elapsed = time.perf_counter() - self._start
            done = max(row["steps"] - self._first, 1)
            remaining = elapsed * max(self.total - row["steps"], 0) / done
            self.console.print(
                f"training {min(part, 1.0):4.0%}  {summary(row)}  {remaining:.0f} s left", highlight=False
            )
            self._next = (int(part * 10.0) + 1) / 10.0


CHECKPOINTS = 4
"""Least number of checkpoints in a training; their interval is at most `CHECKPOINT_STEPS`."""
CHECKPOINT_STEPS = 500_000
"""Greatest number of control steps, summed over all worlds, between two checkpoints."""
RETAINED = 2
"""Number of checkpoints that are kept: if the newest is damaged, there is an earlier one."""
EVALUATIONS = 10
"""Number of evaluations in a training; each takes about as long as an update."""


@dataclass(frozen=True)
class Best:
    """A network of a training, with its score."""

    score: tuple[float, float]
    """Success rate and return (a sum of rewards) in the evaluation."""
    steps: int
    """Number of training steps before the evaluation."""
    network: bytes
    """Network as ONNX."""


@dataclass
class TrainingLoop:
    """Loop that trains a learner to its end, or until Ctrl-C."""

    learner: Learner
    description: PolicyDescription
    """Description of the final policy."""
    side: Path
    """Folder of checkpoints and logs."""
    evaluate: Callable[[Any], Mapping[str, float]]
    """Function that evaluates a network on fixed episodes."""
    show: Callable[[Mapping[str, Any]], None]
    """Called with every row of the curves."""
    progress: Callable[[float], None]
    """Function that is called with the completed fraction of the training before each update: ranges may grow with
    it."""
    identity: Mapping[str, Any]
    """Values that must be equal for a training to continue from a checkpoint."""
    until: float | None = None
    """Success rate [-] that ends the training if reached in two consecutive evaluations; None: no early end."""
    saved: Callable[[Path], None] = lambda checkpoint: None
    """Called with the directory of every checkpoint."""
    project: str | None = None
    """Project of Weights & Biases to which the curves are sent; None: nothing is sent."""
    curves: list[dict[str, Any]] = field(default_factory=list)
    best: Best | None = None
    """Network with the best evaluation, the later of equals: the result of the training."""
    seconds: float = 0.0
    """Time of the updates and evaluations so far [s], summed over all runs of a resumed training."""

    def run(self) -> bool:
        """Update until all steps are done, or the evaluation reaches `until`.

        Returns:
            True if it was interrupted by Ctrl-C.

        Raises:
            LearningError: A number of the learner stopped being finite.
        """
        run = _wandb_run(self.project, self.side, self.identity) if self.project is not None else None
        log = _CurveLog(self.side / "tensorboard", self.learner.steps, run)
        total = self.learner.settings.steps
        try:
            while self.learner.steps < total and not self.reached:
                row = self._update(total)
                self.curves.append(row)
                log.add(row)
                self.show(row)
                every = min(CHECKPOINT_STEPS, math.ceil(total / CHECKPOINTS))
                if self._passed(every):
                    self._save()
        except KeyboardInterrupt:
            return True
        finally:
            log.close()
        return False

    @property
    def reached(self) -> bool:
        """Return whether the last two evaluations reached `until`."""
        if self.until is None:
            return False
        every = math.ceil(self.learner.settings.steps / EVALUATIONS)
        measured = [0, *(row["steps"] // every for row in self.curves)]
        shares = [
            row["evaluation_success"]
            for row, before, now in zip(self.curves, measured, measured[1:], strict=False)
            if now > before
        ]
        return len(shares) >= 2 and min(shares[-2:]) >= self.until

    def _update(self, total: int) -> dict[str, Any]:
        began = time.perf_counter()
        self.progress(self.learner.steps / total)
        learned = self.learner.update()
        bad = [name for name, value in learned.items() if not math.isfinite(value)]
        if bad:
            raise LearningError(
                f"{bad[0]} stopped being finite after {self.learner.steps:,} steps: the learner has diverged, or the "
                "task's reward is not finite; use a smaller learning rate or another seed, or check a task of your own"
            )
        if self._passed(math.ceil(total / EVALUATIONS)) or self.learner.steps >= total or not self.curves:
            network = self.learner.network()
            held = dict(self.evaluate(network))
            if self.best is None or _score(held) >= self.best.score:
                content = onnx_bytes(network, self.description)
                self.best = Best(_score(held), self.learner.steps, content)
        else:
            held = {name: value for name, value in self.curves[-1].items() if name.startswith("evaluation_")}
        self.seconds += time.perf_counter() - began
        steps = self.learner.steps
        counted = {
            "steps": steps,
            "seconds": round(self.seconds, 3),
            "steps_per_s": round(steps / self.seconds),
        }
        return {**counted, **learned, **held}

    def _passed(self, every: int) -> bool:
        """Return whether the last update passed a multiple of `every` steps."""
        rows = (
            self.curves if self.curves and self.curves[-1]["steps"] < self.learner.steps else self.curves[:-1]
        )
        before = rows[-1]["steps"] if rows else 0
        return bool(self.learner.steps // every > before // every)

    def _save(self) -> None:
        """Write a checkpoint: a policy that can be run, and the state to continue from. Remove older checkpoints.

        Checkpoints of an earlier training with more steps are also removed: `last_checkpoint` would take them for
        newer.
        """
        steps = self.learner.steps
        state = {
            "identity": dict(self.identity),
            "learner": self.learner.state(),
            "curves": self.curves,
            "seconds": self.seconds,
            "resumed_after": self.description.training.get("resumed_after", []),
            "best": [*self.best.score, self.best.steps, np.frombuffer(self.best.network, np.uint8)]
            if self.best
            else None,
        }
        checkpoint = self.side / f"checkpoint-{steps:09d}"
        export_policy(
            self.learner.network(),
            checkpoint,
            after(self.description, steps, False, steps),
            curves=self.curves,
            also=lambda folder: write_state(state, folder / RESUME_FILE),
        )
        checkpoints = _checkpoints(self.side)
        after_this = checkpoints.index(checkpoint) + 1
        for other in (*checkpoints[: max(after_this - RETAINED, 0)], *checkpoints[after_this:]):
            shutil.rmtree(other)
        self.saved(checkpoint)

    def resume(self, state: Mapping[str, Any]) -> None:
        """Continue from the result of `last_checkpoint`.

        Raises:
            ResumeError: The checkpoint is of another training.
        """
        for name, value in self.identity.items():
            saved = state["identity"].get(name)
            if saved != value:
                raise ResumeError(
                    f"cannot continue in {self.side}: {name} was {saved!r} and is {value!r} now: "
                    "give the original settings, or omit --resume"
                )
        if "best" not in state:
            raise ResumeError(f"{self.side}: the checkpoint is of an earlier version: leave out --resume")
        self.learner.load(state["learner"])
        self.curves, self.seconds = list(state["curves"]), float(state["seconds"])
        resumed = [*state.get("resumed_after", []), self.learner.steps]
        record = {**self.description.training, "resumed_after": resumed}
        self.description = self.description.model_copy(update={"training": record})
        if state["best"]:
            success, total, steps, network = state["best"]
            self.best = Best((success, total), steps, network.tobytes())


def _score(row: Mapping[str, Any]) -> tuple[float, float]:
    """Return the score of an evaluation: the success rate, if the task defines success, then the return."""
    share, total = (float(row.get(f"evaluation_{name}", 0.0)) for name in ("success", "return"))
    return (share if math.isfinite(share) else 0.0, total if math.isfinite(total) else -1e300)


def _checkpoints(side: Path) -> list[Path]:
    """Return the checkpoints in a folder, the newest last; incomplete ones have other names."""
    return sorted(path for path in side.glob("checkpoint-*") if (path / DESCRIPTION_FILE).is_file())


def last_checkpoint(side: Path) -> dict[str, Any] | None:
    """Return the newest readable state; None if no checkpoint was written yet.

    Raises:
        ResumeError: There was no training, or none of its checkpoints can be read.
    """
    if not side.is_dir():
        raise ResumeError(f"nothing to resume: there is no folder {side}: leave out --resume")
    failure: ResumeError | None = None
    for path in reversed(_checkpoints(side)):
        try:
            return read_state(path / RESUME_FILE)
        except ResumeError as error:
            failure = error
    if failure is not None:
        raise failure
    return None


def after(description: PolicyDescription, steps: int, complete: bool, best: int) -> PolicyDescription:
    """Return the description of a network after a number of training steps; it was best after `best` of them."""
    record = {**description.training, "steps_done": steps, "best_after": best, "complete": complete}
    return description.model_copy(update={"training": record})


def has_tensorboard() -> bool:
    """Return whether TensorBoard is installed; otherwise a training only writes its curves as CSV."""
    return find_spec("tensorboard") is not None


class _CurveLog:
    """Log of the curves for TensorBoard, if installed, and for Weights & Biases."""

    def __init__(self, folder: Path, steps: int, run: Any = None) -> None:
        """Continue after a number of steps: TensorBoard discards later entries of an interrupted or earlier training.

        Args:
            folder: Folder of TensorBoard.
            steps: Steps done so far.
            run: Run of Weights & Biases that also receives the rows.
        """
        self._run, self._writer = run, None
        if not has_tensorboard():
            return
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog
        from tensorboard.compat.proto.summary_pb2 import Summary
        from tensorboard.summary.writer.event_file_writer import EventFileWriter

        os.makedirs(folder, exist_ok=True)
        self._event, self._summary = Event, Summary
        self._writer = EventFileWriter(str(folder))
        start = SessionLog(status=SessionLog.START)
        self._writer.add_event(Event(wall_time=time.time(), step=steps + 1, session_log=start))

    def add(self, row: Mapping[str, Any]) -> None:
        """Log a row."""
        if self._writer is not None:
            values = [self._summary.Value(tag=_tag(name), simple_value=value) for name, value in row.items()]
            summary = self._summary(value=values)
            self._writer.add_event(self._event(wall_time=time.time(), step=row["steps"], summary=summary))
        if self._run is not None:
            self._run.log({_tag(name): value for name, value in row.items()}, step=row["steps"])

    def close(self) -> None:
        """Write the remaining rows."""
        if self._writer is not None:
            self._writer.close()
        if self._run is not None:
            self._run.finish()


def _wandb_run(project: str, side: Path, identity: Mapping[str, Any]) -> Any:
    """Return the run of Weights & Biases for a training; a resumed training continues the same run.

    Raises:
        LearningError: It cannot be started: there is no login, or the server does not respond.
    """
    import wandb

    side.mkdir(parents=True, exist_ok=True)
    file = side / "wandb-run.txt"
    name = side.name.removesuffix("-training")
    number = file.read_text(encoding="utf-8").strip() if file.is_file() else None
    try:
        run = wandb.init(
            project=project, name=name, id=number, resume="allow", dir=side, config=dict(identity),
            settings=wandb.Settings(silent=True, console="off"),
        )  # fmt: skip
    except wandb.errors.Error as error:
        raise LearningError(
            f"Weights & Biases: {' '.join(str(error).split()).rstrip('.')}, or set WANDB_MODE=offline"
        ) from error
    file.write_text(f"{run.id}\n", encoding="utf-8")
    return run


def _tag(name: str) -> str:
    """Return the name of a curve in TensorBoard, with its group."""
    for group, names in {
        "time": ("seconds", "steps_per_s", "steps"),
        "episodes": ("mean_return", "mean_length", "held", "mean_reward"),
    }.items():
        if name in names:
            return f"{group}/{name}"
    for group in ("evaluation", "earned"):
        if name.startswith(f"{group}_"):
            return name.replace("_", "/", 1)
    return f"learner/{name}"
