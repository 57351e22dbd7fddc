"""The commands, with words as a user types them."""

import json
import re
import signal
import subprocess
import sys
import threading
import time

import pytest
import typer
import yaml
from typer.main import get_command

from finssim import __version__
from finssim.cli import boundary
from finssim.cli.commands import app
from reference.commands import finssim, refusal

COMMANDS = [
    "demo",
    "train",
    "evaluate",
    "simulate",
    "vehicles",
    "vehicles show",
    "vehicles import",
    "doctor",
    "new",
    "trials",
    "trials check",
    "trials import",
    "excite",
    "calibrate",
    "calibrate changes",
    "calibrate thruster",
    "calibrate motor",
    "calibrate hydrodynamics",
    "replay",
    "experiment",
    "experiment replay",
    "experiment localization",
    "calibrate camera",
    "calibrate pool",
    "calibrate mounts",
    "localize",
    "fuse",
    "project",
    "backproject",
    "run",
    "pool",
    "ardusub-sitl",
    "tasks",
    "tasks show",
    "collect",
    "datasets",
    "sweep",
    "record",
    "record info",
    "record repair",
    "play",
    "view",
    "teleop",
    "ros2",
    "ros2 node",
    "ros2 up",
    "worlds",
    "worlds show",
]


def test_commands_are_those_of_the_contract():
    """The commands are exactly those of the contract."""
    assert set(get_command(app).list_commands(None)) == {name for name in COMMANDS if " " not in name}


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example_that_the_parser_takes(capsys, command):
    """Every command's help ends with an example of that command, whose options exist."""
    assert finssim(*command.split(), "--help") == 0
    help_text = " ".join(capsys.readouterr().out.split())
    example = re.search(rf"Example: (finssim {command}.*?)(?= Arguments:| Options:)", help_text)[1]
    assert set(re.findall(r"--[a-z-]+", example)) <= set(
        re.findall(r"--[a-z-]+", help_text.replace(example, ""))
    )


def test_version(capsys):
    """`--version` prints the package's version."""
    assert finssim("--version") == 0
    assert capsys.readouterr().out == f"finssim {__version__}\n"


def test_no_command_shows_the_help(capsys):
    """`finssim` alone prints the help."""
    assert finssim() == 0
    assert "Identify a vehicle:" in capsys.readouterr().out


def test_vehicles_lists_the_catalogue(capsys):
    """Every vehicle of the catalogue is listed by its name."""
    from finssim.vehicles import catalogue

    assert finssim("vehicles") == 0
    out = capsys.readouterr().out
    assert all(name[:12] in out for name in catalogue())


def test_a_vehicle_is_shown_and_drawn(capsys, tmp_path):
    """`vehicles show` prints the vehicle and writes a complete picture."""
    assert finssim("vehicles", "show", "finsrov", "--picture", tmp_path / "finsrov.png") == 0
    assert "12.11" in capsys.readouterr().out
    assert (tmp_path / "finsrov.png").read_bytes().startswith(b"\x89PNG")
    assert [file.name for file in tmp_path.iterdir()] == ["finsrov.png"]


def test_a_picture_needs_a_known_format(capsys, tmp_path):
    """A format that cannot be drawn is refused before anything is printed."""
    assert "expected one of .png .svg .pdf" in refusal(
        capsys, "vehicles", "show", "finsrov", "--picture", tmp_path / "x.doc"
    )


def test_a_mistyped_vehicle_gets_its_name(capsys):
    """The refusal of an unknown vehicle names the nearest match and all that exist."""
    sentence = refusal(capsys, "vehicles", "show", "finrov")
    assert "did you mean 'finsrov'?" in sentence and "rexrov" in sentence


def test_doctor_as_json(capsys):
    """`doctor --json` prints one object."""
    assert finssim("doctor", "--json") == 0
    assert json.loads(capsys.readouterr().out)["healthy"] is True


def test_simulate_writes_what_it_says(capfd, tmp_path):
    """The README's example prints a table and the output path, and nothing on standard error."""
    words = ["simulate", "--vehicle", "finsrov", "--command", "surge=10 yaw=1", "--duration", "1"]
    assert finssim(*words, "--out", tmp_path / "first.csv") == 0
    capfd.readouterr()  # the first call may compile, and reports it
    assert finssim(*words, "--out", tmp_path / "run.csv") == 0
    out, err = capfd.readouterr()
    assert err == "" and "delivered wrench" in out and "run.csv" in out.replace("\n", "")
    assert (tmp_path / "run.csv").exists()


def test_simulate_refuses_in_a_sentence(capsys, tmp_path):
    """A wrong word in the command and an unwritable output directory are each refused in a sentence."""
    words = ["simulate", "--vehicle", "finsrov", "--duration", "1", "--out"]
    assert "did you mean 'surge'?" in refusal(capsys, *words, tmp_path / "run.csv", "--command", "surg=10")
    assert "write elsewhere" in refusal(capsys, *words, "/proc/x/run.csv", "--command", "surge=10")


@pytest.mark.slow
def test_an_interrupted_training_leaves_a_policy(tmp_path):
    """Control-C ends training with 130, one sentence and no traceback; the policy so far is complete and
    marked unfinished."""
    out = tmp_path / "hold"
    words = ["train", "t1", "--steps", "2000000", "--out", str(out)]
    run = subprocess.Popen([sys.executable, "-m", "finssim", *words], stderr=subprocess.PIPE, text=True)
    seen = next(line for line in run.stderr if "training" in line)
    run.send_signal(signal.SIGINT)
    # Python drops an interruption that arrives in a destructor.
    again = threading.Timer(20.0, run.send_signal, (signal.SIGINT,))
    again.start()
    said = seen + run.stderr.read()
    again.cancel()
    assert run.wait() == 130
    assert "finssim: interrupted" in said and "Traceback" not in said
    description = yaml.safe_load((out / "policy.yaml").read_text())
    assert description["training"]["complete"] is False
    assert not [path for path in tmp_path.rglob("*") if ".partial" in path.name]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["train", "t9"], "unknown task 't9'; available: t1"),
        (["train", "nowhere.py:Mine"], "there is no file nowhere.py: give FILE.py:CLASS"),
        (["train", "t1", "--action", "wrench7"], "unknown action mode 'wrench7'"),
        (["train", "t1", "--vehicle", "finrov"], "did you mean 'finsrov'"),
        (["train", "t1", "--hydrodynamics", "fosen"], "unknown hydrodynamic model 'fosen'"),
        (["train", "t1", "--randomize", "nowhere.yaml"], "nowhere.yaml"),
        (["train", "t1", "--device", "tpu"], "device 'tpu' is not available"),
        (["train", "t1", "--learner", "sb4"], "unknown learner 'sb4'; available: ppo"),
        (["train", "t1", "--learner", "torchrl-mappo"], "task 't1' has one agent"),
        (["train", "t1", "--set", "gamma=0.9"], "unknown setting 'gamma'"),
        (["train", "t1", "--set", "epochs=many"], "setting epochs is 'many', expected int such as 3"),
        (["train", "t1", "--set", "epochs"], "setting 'epochs': expected NAME=VALUE"),
        (["train", "t1", "--resume"], "nothing to resume"),
        (["train", "t1", "--worlds", "0"], "Invalid value for '--worlds'"),
        (["train", "t1", "--seed", "-1"], "Invalid value for '--seed'"),
        (
            ["train", "t1", "--seed", "4294967296"],
            "'--seed': Input should be less than or equal to 2147483647",
        ),
    ],
)
def test_train_refuses_in_a_sentence(capsys, tmp_path, words, sentence):
    """A training that is not possible is refused, and nothing is written."""
    assert sentence in refusal(capsys, *words, "--out", tmp_path / "policy")
    assert list(tmp_path.iterdir()) == []


def test_train_refuses_a_place_before_it_works(capsys, tmp_path):
    """A directory with other files and an unwritable directory are refused before training begins."""
    (tmp_path / "thesis.tex").touch()
    assert "already holds files" in refusal(capsys, "train", "t1", "--out", tmp_path)
    assert "write elsewhere" in refusal(capsys, "train", "t1", "--out", "/proc/x/policy")


@pytest.mark.slow
def test_train_then_evaluate(capfd, tmp_path):
    """`evaluate` reads the output of `train`; its result is a JSON object and a directory."""
    policy = tmp_path / "policy"
    assert finssim("train", "t1", "--steps", "20000", "--worlds", "64", "--seed", "3", "--out", policy) == 0
    capfd.readouterr()
    words = ["evaluate", policy, "--task", "t1", "--trials", "2", "--out", tmp_path / "result", "--json"]
    assert finssim(*words) == 0
    result = json.loads(capfd.readouterr().out)
    keys = {"trials", "success", "e_p_m", "e_y_m", "e_psi_deg", "t_s_s", "J_p_m", "J_psi_deg", "per_trial"}
    assert keys <= result.keys() and result["trials"] == len(result["per_trial"]) == 2
    assert json.loads((tmp_path / "result" / "evaluation.json").read_text()) == result
    assert (tmp_path / "result" / "error_envelope.png").stat().st_size > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["evaluate", "nowhere"], "nowhere"),
        (["evaluate", "pid", "--task", "t9"], "unknown task 't9'"),
        (["evaluate", "pid", "--plant", "currant"], "current"),
        (["evaluate", "pid", "--trials", "0"], "Invalid value for '--trials'"),
        (["evaluate", "pid", "--out", "/proc/x/result"], "write elsewhere"),
        (["demo", "--out", "/proc/x/demo"], "write elsewhere"),
    ],
)
def test_experiments_refuse_in_a_sentence(capsys, words, sentence):
    """A request that cannot be evaluated or shown is refused before any work begins."""
    assert sentence in refusal(capsys, *words)


@pytest.mark.parametrize("words", ["vehicles", "tasks", "worlds"])
def test_lists_fit_into_80_columns(words, monkeypatch, capsys):
    """No heading is cut or broken, and descriptions keep several words on a line."""
    monkeypatch.setenv("COLUMNS", "80")
    assert boundary.run(app, [words]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert all(len(line) <= 80 and "…" not in line for line in lines)
    headings = {"vehicles": "thrusters  axes  description", "tasks": "observed  actions", "worlds": ""}[words]
    assert any(headings in " ".join(line.split()) or headings in line for line in lines)
    assert sum(len(line.split()) == 1 for line in lines) < 0.3 * len(lines)


class Dropped:
    """Object whose finalizer is interrupted, where Python (as pydantic's compiled code may) drops the exception."""

    def __del__(self):
        signal.raise_signal(signal.SIGINT)


def drop():
    dropped = [Dropped() for _ in range(3)]
    del dropped
    time.sleep(30.0)


def create_a_class():
    class Interrupted:
        field = type("Field", (), {"__set_name__": lambda *_: signal.raise_signal(signal.SIGINT)})()

    return Interrupted


@pytest.mark.parametrize("work", [drop, create_a_class])
def test_control_c_that_python_drops_or_wraps_ends_the_command(work, capsys):
    """An interruption in a finalizer is repeated; one that Python 3.11 wraps in a RuntimeError is recognised."""
    commands = typer.Typer()
    commands.command()(work)
    begun = time.monotonic()
    assert boundary.run(commands, [], script="work") == boundary.INTERRUPTED
    assert time.monotonic() - begun < 20.0 and "Exception ignored" not in capsys.readouterr().err


@pytest.mark.slow
def test_a_command_that_handled_control_c_ends_with_its_own_status(tmp_path):
    """The command keeps its own status even after an interrupted `exec`, where `python -m` would end by SIGINT."""
    (tmp_path / "work.py").write_text("""
import contextlib, sys, typer
from finssim.cli import boundary
app = typer.Typer()

@app.command()
def work():
    with contextlib.suppress(KeyboardInterrupt):
        exec("raise KeyboardInterrupt")

sys.exit(boundary.run(app, [], script="work"))
""")
    assert subprocess.run([sys.executable, "-m", "work"], cwd=tmp_path, timeout=60.0).returncode == 0
