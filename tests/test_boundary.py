"""The command line reports refused input in one sentence with status 2; a bug in FinsSim keeps its traceback."""

import json
import os
import subprocess
import sys

import pytest
import typer

from finssim.cli.boundary import run
from finssim.cli.commands import app as commands
from finssim.core.files import OutputError


class OurError(ValueError):
    """Stand-in for an error family such as VehicleError."""


OurError.__module__ = "finssim.somewhere"

app = typer.Typer(add_completion=False)


@app.command()
def fail(kind: str, number: int = 0):
    """Raise one kind of error, as a command may."""
    if kind == "missing":
        import cv2.no_such_part  # noqa: F401
    if kind == "fault":
        json.loads("{")  # a ValueError from deep in a library
    if kind == "interrupt":
        raise KeyboardInterrupt
    errors = {
        "refused": OurError("minnow.yaml: mass is -1,\n   expected above 0"),
        "several": OurError("minnow.yaml: mass is -1\nminnow.yaml: size is 0"),
        "output": OutputError("cannot write x: the disk is full"),
        "system": FileNotFoundError(2, "No such file or directory", "plant.yaml"),
        "fault-key": KeyError("x"),
        "memory": MemoryError("Unable to allocate 83.7 TiB"),
    }
    if kind in errors:
        raise errors[kind]


@app.command()
def other():
    """A second command, so that the app has subcommands."""


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["fail", "refused"], "minnow.yaml: mass is -1, expected above 0"),
        (["fail", "several"], "minnow.yaml: mass is -1; minnow.yaml: size is 0"),
        (["fail", "memory"], "not enough memory: Unable to allocate 83.7 TiB: ask for less"),
        (["fail", "output"], "cannot write x: the disk is full"),
        (["fail", "system"], "plant.yaml: No such file or directory"),
        (["fale", "x"], "No such command 'fale'. Did you mean 'fail'?"),
        (["fail", "x", "--numbr", "3"], "No such option: --numbr"),
        (["fail", "x", "--number", "three"], "Invalid value for '--number'"),
        (["fail"], "Missing argument"),
    ],
)
def test_a_refused_input_is_one_sentence(capsys, words, sentence):
    """Standard error contains one line that names the problem, standard output is empty, and the status is 2."""
    assert run(app, words) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith(f"finssim: {sentence}") and err.count("\n") == 1


def test_a_missing_extra_is_named(capsys, monkeypatch):
    """The message about a library that is not installed names the extra to install."""
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert run(app, ["fail", "missing"]) == 2
    assert capsys.readouterr().err == "finssim: cv2 is not installed: pip install 'finssim[vision]'\n"


def test_a_file_of_ones_own_that_needs_an_extra_names_it(capsys, monkeypatch, tmp_path):
    """A user's task that imports torch is refused with the extra to install, where only the core is installed."""
    monkeypatch.setitem(sys.modules, "torch", None)
    (tmp_path / "mine.py").write_text("import torch\n", encoding="utf-8")
    assert run(commands, ["tasks", "show", f"{tmp_path / 'mine.py'}:Mine"]) == 2
    assert "torch is not installed: pip install 'finssim[learn]'" in capsys.readouterr().err


@pytest.mark.parametrize(("kind", "error"), [("fault", json.JSONDecodeError), ("fault-key", KeyError)])
def test_a_fault_is_not_dressed_up_as_a_refusal(kind, error):
    """An exception that FinsSim did not raise on purpose reaches the top with its traceback."""
    with pytest.raises(error):
        run(app, ["fail", kind])


def test_debugging_keeps_every_traceback(monkeypatch):
    """FINSSIM_DEBUG=1 shows where a refusal was raised."""
    monkeypatch.setenv("FINSSIM_DEBUG", "1")
    with pytest.raises(OurError):
        run(app, ["fail", "refused"])


def test_interruption_has_its_status(capsys):
    """Control-C ends the command with status 130, as the shell expects, and without a traceback."""
    assert run(app, ["fail", "interrupt"]) == 130
    assert capsys.readouterr().err == "finssim: interrupted: no incomplete file is left\n"


@pytest.mark.slow
def test_a_reader_that_leaves_early_is_no_error():
    """`finssim --help | head -0` prints no traceback."""
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as pipe:
        answer = subprocess.run(
            [sys.executable, "-m", "finssim", "--help"], stdout=pipe, stderr=subprocess.PIPE, text=True
        )
    assert answer.stderr == "" and answer.returncode in (0, 1)
