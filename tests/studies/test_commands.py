"""Studies are programs whose options are the parameters of their functions."""

import inspect
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from finssim.cli.command_line import read
from reference.programs import study

ROOT = Path(__file__).resolve().parents[2]
STUDIES = {
    "anatomy": "anatomy",
    "changes": "changes",
    "faults": "faults_experiment",
    "open_water": "open_water",
    "soak": "soak",
    "stack": "play",
}
"""Module -> its function."""


def test_no_study_is_left_out():
    """Every module of the package is a study."""
    assert {path.stem for path in (ROOT / "studies").glob("[!_]*.py")} == set(STUDIES)


@pytest.mark.parametrize("name", STUDIES)
def test_help_explains_every_option_and_has_an_example(capsys, name):
    """The example uses only options of the study; all print JSON, and seeds begin at 1."""
    assert study(name, "--help") == 0
    text = " ".join(capsys.readouterr().out.split())
    example = re.search(rf"Example: (python -m studies\.{name} .*?)(?= Arguments:| Options:)", text)[1]
    assert set(re.findall(r"--[a-z-]+", example)) <= set(re.findall(r"--[a-z-]+", text.replace(example, "")))
    assert "--json" in text and re.search(r"--seed \S+ \S+ (?:(?! --).)*\[default: 1;", text)
    assert all(option.help for option in read(f"studies.{name}:{STUDIES[name]}").all_options())


@pytest.mark.parametrize("name", STUDIES)
def test_options_are_parameters_with_the_same_defaults(name):
    """Defaults read from the source equal those of the Python function."""
    parameters = inspect.signature(getattr(import_module(f"studies.{name}"), STUDIES[name])).parameters
    for option in read(f"studies.{name}:{STUDIES[name]}").all_options():
        assert parameters[option.name].default == option.default


@pytest.mark.slow
def test_a_study_runs_from_the_checkout(tmp_path):
    """It runs in its own process; an invalid word gives one sentence and exit status 2."""
    words = [sys.executable, "-m", "studies.faults", "--scenarios", "flood", "--out", str(tmp_path / "out")]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2 and done.stdout == ""
    assert "unknown scenario 'flood'; available: kill-robot" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr
