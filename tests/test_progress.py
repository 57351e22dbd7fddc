"""Long work shows its progress by a bar or by lines; a silent command reports within two seconds that it starts."""

import io
import sys
import time

import pytest

from finssim.core import progress, system
from finssim.core.progress import progress_bar
from finssim.core.system import announce


def test_a_file_gets_a_line_at_once_and_one_every_ten_seconds(capsys, monkeypatch):
    """Each line has the completed share and the remaining time, by a clock that the test advances."""
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    with progress_bar("evaluate") as show:
        for second in range(1, 31):
            now[0] = float(second)
            show(second / 40.0, "lemniscate")
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "evaluate: lemniscate (2%)",
        "evaluate: lemniscate (28%, about 29 s left)",
        "evaluate: lemniscate (52%, about 19 s left)",
    ]


def test_progress_that_nobody_wants_is_not_shown(capsys):
    with progress_bar("evaluate", visible=False) as show:
        show(0.5, "lemniscate")
    assert capsys.readouterr().err == ""


class Terminal(io.StringIO):
    """Standard error, on a terminal or not."""

    def __init__(self, terminal):
        super().__init__()
        self.isatty = lambda: terminal


@pytest.mark.parametrize("terminal", [True, False])
def test_a_silent_command_counts_until_it_prints(monkeypatch, terminal):
    """On a terminal the count is one line, erased before the output; elsewhere each count is a line."""
    monkeypatch.setattr(system, "COUNT", (0.01, 0.01))
    out, error = io.StringIO(), Terminal(terminal)
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", error)
    announce("finssim view: starting", after=0.01)
    deadline = time.monotonic() + 20.0
    while error.getvalue().count("starting") < 3 and time.monotonic() < deadline:
        time.sleep(0.01)
    print("a table")
    said = error.getvalue()
    time.sleep(0.1)
    assert error.getvalue() == said and out.getvalue() == "a table\n"
    words = "finssim view: starting"
    first = f"\r{words}\r{words}, 0 s" if terminal else f"{words}\n{words}, 0 s\n"
    assert said.startswith(first) and said.endswith("\r\x1b[K" if terminal else " s\n")


def test_a_command_that_prints_says_nothing_else(capsys, monkeypatch):
    monkeypatch.setattr(sys, "stdout", sys.stdout)
    announce("finssim view: starting", after=0.2)
    print("a table")
    time.sleep(0.5)
    assert capsys.readouterr().err == ""
