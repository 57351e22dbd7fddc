"""What a person sees while training: how far, how fast, how well, how long still."""

from __future__ import annotations

import time
from collections.abc import Mapping
from types import TracebackType
from typing import Any

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

__all__ = ["TrainingView"]


class _Results(ProgressColumn):
    """Rate, mean return and share of episodes held."""

    def render(self, task: Task) -> Text:
        return Text(summary(task.fields), style="cyan")


def summary(row: Mapping[str, Any]) -> str:
    """The figures of a row of the training curve in a few words."""
    if not row.get("steps_per_s"):
        return ""
    rate, held = row["steps_per_s"] / 1e3, 100.0 * row["held"]
    words = f"{rate:.0f} k steps/s  return {row['mean_return']:.1f}  held {held:.0f} %"
    success = row.get("evaluation_success")
    return words if success is None else f"{words}  evaluated {100.0 * success:.0f} %"


class TrainingView:
    """A live bar on a terminal; elsewhere a line for every tenth of the way."""

    def __init__(self, total: int, console: Console | None = None) -> None:
        """Watch a training of `total` control steps."""
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

    def go_on(self, steps: int) -> None:
        """Begin where so many steps were done before: they took no time of this training's."""
        self._first = steps
        self._next = (int(steps / self.total * 10.0) + 1) / 10.0
        self._progress.reset(self._task, completed=steps)

    def update(self, row: Mapping[str, Any]) -> None:
        """Show a row of the training curve: steps, steps_per_s, mean_return, held, evaluation_success if there."""
        self._progress.update(self._task, completed=row["steps"], **row)
        part = row["steps"] / self.total
        if not self._live and part >= self._next:
            elapsed = time.perf_counter() - self._start
            done = max(row["steps"] - self._first, 1)
            left = elapsed * max(self.total - row["steps"], 0) / done
            self.console.print(
                f"training {min(part, 1.0):4.0%}  {summary(row)}  {left:.0f} s left", highlight=False
            )
            self._next = (int(part * 10.0) + 1) / 10.0
