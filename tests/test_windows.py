"""The commands without features that Python on Windows lacks: SIGHUP, resource, termios, fork, UTF-8 output."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from finssim.core.system import peak_memory, stop_signals
from finssim.robot import teleop
from reference.commands import EVERY

SHIM = Path(__file__).parent / "reference" / "as_windows.py"


def start(words, folder):
    """Start a process that runs commands one after the other, with its output in code page 1252."""
    command = [sys.executable, "-X", "warn_default_encoding", str(SHIM), json.dumps(words)]
    environment = {**os.environ, "PYTHONIOENCODING": "cp1252", "PYTHONUTF8": "0"}
    return subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def statuses(process):
    """Return the exit statuses of its commands and its standard error."""
    out, err = process.communicate(timeout=600)
    assert process.returncode == 0, err.decode("cp1252")
    return json.loads(out.decode("cp1252").splitlines()[-1]), err.decode("cp1252")


@pytest.mark.slow
def test_every_command_is_there_and_the_short_ones_run(tmp_path):
    """Every command's help imports its dependencies; lists, a simulation, trials, a check and a replay end with 0."""
    helps = [[*name.split(), "--help"] for name in EVERY]
    runs = [
        ["vehicles"],
        ["vehicles", "show", "finsrov"],
        ["tasks"],
        ["worlds"],
        ["doctor"],
        ["simulate", "--vehicle", "finsrov", "--command", "surge=10", "--duration", "1", "--out", "run.csv"],
        ["excite", "surge", "--vehicle", "finsrov", "--simulate", "--out", "trials"],
        ["trials", "check", "trials", "--vehicle", "finsrov"],
        ["pool", "--camera", "none", "--port", "0", "--lockstep"],
    ]
    answers, complaints = statuses(start(helps + runs, tmp_path))
    wrong = [(words, status) for words, status in zip(helps + runs, answers, strict=True) if status != 0]
    assert wrong == [(runs[-1], 2)], complaints  # port 0 is refused, in order
    assert (tmp_path / "run.csv").exists() and any((tmp_path / "trials").iterdir())


@pytest.mark.slow
def test_a_robot_runs_in_a_pool_in_lockstep(tmp_path):
    """Two processes without SIGHUP: the robot arms, drives and ends, and so does the pool."""
    from finssim.pool.run import MCU_PORT

    port = MCU_PORT + 400
    pool = start(
        [["pool", "--lockstep", "--camera", "corners", "--port", str(port), "--pool-file", "pool.yaml"]],
        tmp_path,
    )
    while not (line := pool.stdout.readline()).startswith(b"lock-step"):
        assert line
    words = [
        "run",
        "--policy",
        "pid",
        "--goal",
        "0.2,0,-0.5,0",
        "--robot",
        f"127.0.0.1:{port + 2}",
        "--lockstep",
    ]
    answers, complaints = statuses(
        start([[*words, "--duration", "3", "--arm", "--json", "--record", "r.mcap"]], tmp_path)
    )
    assert answers == [0], complaints
    assert statuses(pool)[0] == [0]


def test_keys_of_windows_console_are_those_of_a_terminal(monkeypatch):
    """Arrows arrive as two characters, the first 0 or 0xe0; Ctrl-C is a key and interrupts."""

    class Console:
        def __init__(self, keys):
            self.keys = list(keys)

        def kbhit(self):
            return bool(self.keys)

        def getwch(self):
            return self.keys.pop(0)

    assert teleop._windows_keys(Console("w\xe0H\x00Kq")) == ["w", "\x1b[A", "\x1b[D", "q"]
    with pytest.raises(KeyboardInterrupt):
        teleop._windows_keys(Console("w\x03"))


def test_a_python_that_reads_no_keys_is_refused_in_a_sentence(monkeypatch):
    """Keys are refused in a sentence where neither termios nor msvcrt exists."""
    monkeypatch.setitem(sys.modules, "termios", None)

    class Terminal:
        def isatty(self):
            return True

        def fileno(self):
            return 0

    with pytest.raises(teleop.TeleopError, match="use a gamepad"):
        with teleop.Keyboard(Terminal()):
            pass


def test_peak_memory_is_in_mebibytes_on_every_system(monkeypatch):
    """Linux counts kibibytes, macOS bytes, and Windows has no such function."""
    import resource

    class Usage:
        ru_maxrss = 3 * 2**20

    monkeypatch.setattr(resource, "getrusage", lambda who: Usage)
    assert peak_memory() == 3 * 2**10
    monkeypatch.setattr(sys, "platform", "darwin")
    assert peak_memory() == 3.0
    monkeypatch.setitem(sys.modules, "resource", None)
    assert peak_memory() != peak_memory()


def test_stop_signals_are_those_that_the_system_has(monkeypatch):
    """Without SIGHUP two signals remain; SIGBREAK of Windows counts where it exists."""
    import signal

    monkeypatch.delattr(signal, "SIGHUP")
    assert stop_signals() == [signal.SIGINT, signal.SIGTERM]
    monkeypatch.setattr(signal, "SIGBREAK", signal.SIGUSR1, raising=False)
    assert stop_signals()[-1] == signal.SIGUSR1
