"""What the README and the examples tell a newcomer to type works."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BIN = Path(sys.executable).parent

SMALL = {"train": ["--steps", "4096", "--worlds", "64"], "evaluate": ["--trials", "2"]}
"""Options that make a command's run small; a later option wins over an earlier one."""


def blocks(language: str) -> list[str]:
    """Fenced code of one language, in the README's order."""
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.MULTILINE | re.DOTALL)


def commands() -> list[list[str]]:
    """Command lines of the README's bash blocks, as words."""
    lines = "\n".join(blocks("bash")).splitlines()
    return [words for words in (shlex.split(line, comments=True) for line in lines) if words]


def run(words: list[str], folder: Path) -> str:
    """Run a command in a folder and return what it printed; a failure shows it."""
    answer = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert answer.returncode == 0, f"{shlex.join(words)}\n{answer.stdout}\n{answer.stderr}"
    return answer.stdout + answer.stderr


def test_every_command_is_of_a_known_kind():
    """A command that the tests below would not run is noticed."""
    kinds = {words[0] for words in commands()}
    assert kinds <= {"make", "pip", ".venv/bin/finssim"}


def test_make_targets_exist_and_run_what_the_tests_run():
    """Each `make` line names a target; the targets are this test run and the demo, tested on their own."""
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
    for line in lines:
        assert set(re.search(r"\[(.*?)\]", line)[1].split(",")) <= declared


@pytest.mark.long
def test_finssim_lines_run_in_order(tmp_path):
    """A newcomer's session, with trainings and evaluations cut short: each line succeeds and says something."""
    for words in commands():
        if words[0] != ".venv/bin/finssim":
            continue
        said = run([str(BIN / "finssim"), *words[1:], *SMALL.get(words[1], [])], tmp_path)
        assert said.strip(), f"{shlex.join(words)} printed nothing"
    assert (tmp_path / "run.csv").stat().st_size > 0


@pytest.mark.parametrize("code", blocks("python"))
def test_python_blocks_run(code, tmp_path):
    """The README's Python runs as it stands."""
    assert run([sys.executable, "-c", code], tmp_path)


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.name)
def test_examples_run(path, tmp_path):
    """Every example runs as it stands, from any folder, and prints what it found."""
    assert run([sys.executable, str(path)], tmp_path)


def test_links_lead_somewhere():
    """Relative links of the README and the project's other front pages point at files."""
    for page in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"):
        for target in re.findall(r"\]\((?!https?:|#)([^)#]+)", (ROOT / page).read_text(encoding="utf-8")):
            assert (ROOT / target).exists(), f"{page}: {target}"
