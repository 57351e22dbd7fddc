"""The commands in the README and the examples work for a new user."""

import re
import runpy
import shlex
import subprocess
import sys
import types
from pathlib import Path

import pytest

from finssim import __version__
from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.control import TRAJECTORIES
from finssim.evaluation.plants import available_plants
from finssim.vehicles import load_vehicle

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BIN = Path(sys.executable).parent

SMALL = {"train": ["--steps", "4096", "--worlds", "64"], "evaluate": ["--trials", "2"]}
"""Options that make a command's run small; a later option wins over an earlier one."""

EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
EXAMPLES.append(ROOT / "examples" / "bluerov2" / "loop.py")
"""Example scripts; the templates of `finssim new` are below `examples/own`, with tests of their own."""

SHORT = {
    "loop.py": ("if status := finssim(line).wait():", "if status := boundary.run(app, line.split()):"),
    "learn_with_pettingzoo.py": ("TURNS, TRIES = 30, 4", "TURNS, TRIES = 2, 2"),
    "learn_with_rsl_rl.py": ("60", "2"),
    "learn_with_sb3.py": ("500_000", "16_384"),
    "learn_with_torchrl.py": ("ROLLOUTS, STEPS, WORLDS, BATCH = 60,", "ROLLOUTS, STEPS, WORLDS, BATCH = 2,"),
    "train_and_evaluate.py": ("600_000", "16_384"),
}
"""Replacements that shorten an example or keep it from starting a process."""


def blocks(language: str) -> list[str]:
    """Return the fenced code of one language, in the README's order."""
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.MULTILINE | re.DOTALL)


def commands() -> list[list[str]]:
    """Return the command lines of the README's bash blocks, split into words."""
    lines = "\n".join(blocks("bash")).splitlines()
    return [words for words in (shlex.split(line, comments=True) for line in lines) if words]


def shortened(line: str) -> list[str]:
    """Return the words of a recipe with at most two plants and trajectories."""
    for option, known in (("--plant", available_plants()), ("--trajectory", TRAJECTORIES)):
        named = re.findall(rf" {option} (\S+)", line)
        assert set(named) <= set(known), line
        for name in named[2:]:
            line = line.replace(f" {option} {name}", "")
    return shlex.split(line, comments=True)


def run(words: list[str], folder: Path) -> str:
    """Run a command in a folder and return its output; a failure shows the output."""
    answer = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert answer.returncode == 0, f"{shlex.join(words)}\n{answer.stdout}\n{answer.stderr}"
    return answer.stdout + answer.stderr


def test_every_command_is_of_a_known_kind():
    """A command of a kind that the tests below do not run fails here."""
    kinds = {words[0] for words in commands()}
    assert kinds <= {"make", "pip", ".venv/bin/finssim"}


@pytest.mark.slow
def test_make_targets_exist_and_run_what_the_tests_run():
    """Each `make` line names a target; the targets are this test run and the demo, which is tested separately."""
    targets = {words[1] for words in commands() if words[0] == "make"}
    dry = run(["make", "--dry-run", "--always-make", *sorted(targets)], ROOT)
    assert targets == {"demo", "test"}
    assert "finssim demo" in dry and "pytest" in dry


def test_pip_line_names_what_is_declared():
    """The extras in the pip line are those of the package."""
    lines = [" ".join(words) for words in commands() if words[0] == "pip"]
    declared = set(
        re.findall(r"^(\w+) = \[", (ROOT / "pyproject.toml").read_text(encoding="utf-8"), flags=re.MULTILINE)
    )
    extras = [re.search(r"\[(.*?)\]", line) for line in lines]
    assert any(extras) and all(set(words[1].split(",")) <= declared for words in filter(None, extras))


@pytest.mark.slow
def test_finssim_lines_run_in_order(tmp_path, monkeypatch, capfd):
    """In a new user's session, with shortened trainings and evaluations, each line succeeds and prints something."""
    monkeypatch.chdir(tmp_path)
    for words in commands():
        if words[0] != ".venv/bin/finssim":
            continue
        status = boundary.run(app, [*words[1:], *SMALL.get(words[1], [])])
        printed = "".join(capfd.readouterr())
        assert status == 0 and printed.strip(), f"{shlex.join(words)}\n{printed}"
    assert (tmp_path / "run.csv").stat().st_size > 0


@pytest.mark.slow
def test_the_recipes_that_need_no_file_of_the_reader_run_in_order(tmp_path, monkeypatch, capfd):
    """Shortened trainings and evaluations of the recipes page run with its files and a user's controller."""
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "reference" / "recipes.md").read_text(encoding="utf-8")
    water, camera = re.findall(r"^```yaml\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL)
    Path("water.yaml").write_text(water, encoding="utf-8")
    Path("camera.yaml").write_text(camera, encoding="utf-8")
    assert "front_camera" in load_vehicle("camera.yaml").perception
    own = (ROOT / "examples" / "own" / "agent" / "homing.py").read_text(encoding="utf-8")
    Path("mine.py").write_text(own.replace("Homing", "Mine"), encoding="utf-8")
    lines = re.findall(r"^finssim (?:train|evaluate|worlds)\b.*$", page, flags=re.MULTILINE)
    assert len(lines) > 8
    for line in lines:
        words = shortened(line)
        status = boundary.run(app, [*words[1:], *SMALL.get(words[1], [])])
        assert status == 0, f"{line}\n{''.join(capfd.readouterr())}"


@pytest.mark.slow
def test_the_installed_command_starts(tmp_path):
    """The command at the start of the README's lines exists, and belongs to this package."""
    assert run([str(BIN / "finssim"), "--version"], tmp_path) == f"finssim {__version__}\n"


@pytest.mark.parametrize("code", blocks("python"))
def test_python_blocks_run(code, tmp_path, monkeypatch, capsys):
    """The README's Python runs unchanged."""
    (tmp_path / "block.py").write_text(code, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    runpy.run_path("block.py", run_name="__main__")
    assert capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_examples_run(path, tmp_path, monkeypatch, capsys):
    """Every example runs from any folder and prints its results, unchanged except for the replacements in `SHORT`."""
    code = path.read_text(encoding="utf-8")
    if path.name in SHORT:
        words, fewer = SHORT[path.name]
        assert words in code
        code = code.replace(words, fewer)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(path)])
    module = types.ModuleType("__main__")
    module.__file__ = str(path)
    vars(module).update(boundary=boundary, app=app)
    monkeypatch.setitem(sys.modules, "__main__", module)
    exec(compile(code, path, "exec"), vars(module))
    assert capsys.readouterr().out


def test_links_lead_somewhere():
    """Relative links of the README and the project's other front pages lead to files."""
    for page in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"):
        for target in re.findall(r"\]\((?!https?:|#)([^)#]+)", (ROOT / page).read_text(encoding="utf-8")):
            assert (ROOT / target).exists(), f"{page}: {target}"
