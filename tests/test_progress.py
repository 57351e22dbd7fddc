"""Long work shows how far it is, by a bar or by lines; a silent command says within two seconds that it starts."""

import sys
import threading

from finssim.core import progress
from finssim.core.progress import progress_bar
from finssim.core.system import announce


def test_a_file_gets_a_line_at_once_and_one_every_ten_seconds(capsys, monkeypatch):
    """With the share that is done and the time that is left, of a clock that the test moves."""
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


def test_a_command_that_is_silent_says_that_it_starts(capsys, monkeypatch):
    """Once its time is over; not after it has printed something."""
    for printed in (False, True):
        monkeypatch.setattr(sys, "stdout", sys.stdout)
        timer = announce("finssim view: starting", after=0.05 if not printed else 30.0)
        if printed:
            print("a table")
        timer.join(20.0) if not printed else timer.join(2.0)
        assert not timer.is_alive() and threading.current_thread() is not timer
        captured = capsys.readouterr()
        assert captured.err == ("" if printed else "finssim view: starting\n")
