"""`finssim new` writes packages that run, pass their tests and, once installed, are found by every command."""

import json
import re
import subprocess
import sys

import pytest

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.cli.new import KINDS, new
from reference.installed import install

NAMES = {
    "vehicle": "squid", "task": "stay_low", "term": "keel", "sensor": "beacon_range", "actuator": "drogue",
    "agent": "spring", "study": "in_currents",
}  # fmt: skip


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """One package of each kind, each with its own name."""
    place = tmp_path_factory.mktemp("own")
    for kind, name in NAMES.items():
        assert new(kind, name, out=place / name) == place / name
    return place


def test_every_kind_is_tested():
    assert set(NAMES) == set(KINDS)


@pytest.mark.parametrize("kind", NAMES)
def test_nothing_of_the_old_name_is_left(written, kind):
    """No form of the old name remains; the file and its test have the new one."""
    old, name = KINDS[kind][0], NAMES[kind]
    files = {path.name: path.read_text(encoding="utf-8") for path in (written / name).iterdir()}
    assert f"test_{name}.py" in files
    left = rf"(?<![a-z])({old}|{old.replace('_', '-')}|{old.upper()})(?![a-z])"
    for file, text in files.items():
        assert kind == "study" or not re.search(left, text), file
        if file.endswith(".py"):
            compile(text, file, "exec")


@pytest.mark.slow
def test_what_it_writes_passes_its_tests(written):
    """All written tests pass, each from its own directory."""
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *map(str, written.iterdir())]
    run = subprocess.run(words, cwd=written, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr


@pytest.mark.slow
def test_an_agent_of_ones_own_is_evaluated_like_ours(written, capsys):
    """A user's agent is evaluated by file and class, beside the trials of a PID."""
    spring = f"{written / 'spring' / 'spring.py'}:Spring"
    assert boundary.run(app, ["evaluate", spring, "--task", "t1", "--trials", "1"]) == 0
    assert "spring" in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["task", "term", "sensor", "actuator"])
def test_once_installed_every_command_finds_it(written, kind, tmp_path, monkeypatch):
    """Commands find the package by the entry point of its pyproject.toml."""
    from finssim.core.registry import FAMILIES

    name = NAMES[kind]
    project = (written / name / "pyproject.toml").read_text(encoding="utf-8")
    group, key, target = re.search(r"""finssim\.(\w+)"\]\n(\S+) = '(\S+)'""", project).groups()
    source = (written / name / f"{name}.py").read_text(encoding="utf-8")
    install(tmp_path, monkeypatch, name, source, {group: {key: target}})
    (family,) = [family for family in FAMILIES if f"{family.noun}s" == group]
    assert family[key] is getattr(sys.modules[name], target.partition(":")[2])
    assert family.packages()[key] == f"{name} 1.0"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("boat", "x"), "unknown kind 'boat'; available: vehicle, task"),
        (("term", "Keel"), "name 'Keel', expected small letters"),
        (("term", "json"), "Python has a module 'json' already"),
        (("task", "class"), "name 'class', expected small letters"),
    ],
)
def test_what_cannot_be_made_is_refused(words, sentence, capsys, tmp_path, monkeypatch):
    """Each request is refused in one sentence, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    assert boundary.run(app, ["new", *words]) == 2
    assert sentence in " ".join(capsys.readouterr().err.split())
    assert not list(tmp_path.iterdir())


def test_json_is_one_object(tmp_path, capsys):
    assert boundary.run(app, ["new", "term", "keel", "--out", str(tmp_path / "k"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["written"] == str(tmp_path / "k")


def test_what_is_there_is_kept(written, capsys):
    assert boundary.run(app, ["new", "term", "keel", "--out", str(written / "keel")]) == 2
    assert "keel" in capsys.readouterr().err
