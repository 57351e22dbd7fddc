"""Progress of a training without a terminal: a line for every tenth, with the remaining time."""

import io

from rich.console import Console

from finssim.learning import training_loop
from finssim.learning.training_loop import TrainingView, summary

ROW = {"steps": 0, "steps_per_s": 50_000, "mean_return": 1.25, "held": 0.5}


def lines(monkeypatch, steps, begun=0):
    """Return the printed lines, with a clock that advances by a second at every reading."""
    ticks = iter(range(1000))
    monkeypatch.setattr(training_loop.time, "perf_counter", lambda: float(next(ticks)))
    console = Console(file=io.StringIO(), width=200)
    view = TrainingView(1000, console)
    if begun:
        view.resume_at(begun)
    for done in steps:
        view.update({**ROW, "steps": done})
    return console.file.getvalue().splitlines()


def test_the_time_left_follows_from_the_steps_of_this_run(monkeypatch):
    """250 steps in the first second leave 3 s; for a training resumed at 500, 250 in a second leave 1 s."""
    assert lines(monkeypatch, [250])[0].endswith("held 50 %  3 s left")
    assert lines(monkeypatch, [750], begun=500)[0].startswith("training  75%")
    assert lines(monkeypatch, [750], begun=500)[0].endswith("1 s left")


def test_success_on_held_episodes_is_told():
    assert (
        summary({**ROW, "evaluation_success": 0.75}) == "50 k steps/s  return 1.2  held 50 %  evaluated 75 %"
    )
