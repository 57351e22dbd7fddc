"""One registry for every family: members of FinsSim, of installed packages and of a program."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from finssim.core.registry import (
    COMMANDS,
    FAMILIES,
    SENSORS,
    TASKS,
    VEHICLES,
    Family,
    RegistryError,
    RegistryWarning,
)
from finssim.learning.learners import LearningError, learner_named
from finssim.sim import site
from finssim.tasks import EnvironmentSetupError, StationKeeping, task_named
from finssim.vehicles import VehicleError, catalogue, load_vehicle
from reference.commands import EVERY, finssim
from reference.installed import install

PACKAGE = '''
from pathlib import Path
from finssim.learning.learners.ppo import Ppo
from finssim.tasks import StationKeeping

MINI = Path(__file__).parent / "mini.yaml"

def hover():
    return StationKeeping(hold=3.0)

class Slow(Ppo):
    """PPO with another name."""

def greet(name: str = "all", *, twice: bool = False) -> None:
    """Greet a vehicle.

    Args:
        name (NAME): Its name.
        twice: Greet two times.
    """
    print("hello " * (1 + twice) + name)
'''
MEMBERS = {
    "vehicles": {"mini": "outside:MINI"},
    "tasks": {"hover": "outside:hover"},
    "learners": {"slow": "outside:Slow"},
    "commands": {"greet": "outside:greet"},
}


@pytest.fixture
def outside(tmp_path, monkeypatch):
    """An installed package with a vehicle, a task, a learner and a command."""
    install(tmp_path, monkeypatch, "outside", PACKAGE, MEMBERS)
    folder = tmp_path / "site_outside"
    (folder / "mini.yaml").write_text("extends: bluerov2\nbody: {mass: {value: 10.5, origin: guessed}}\n")
    return folder


@pytest.fixture
def broken(tmp_path, monkeypatch):
    """An installed package that cannot be imported, with a member of every family."""
    members = {f"{family.noun}s": {"lost": "broken:lost"} for family in FAMILIES}
    install(tmp_path, monkeypatch, "broken", "import no_such_module\n", members)
    return tmp_path / "site_broken"


def command(*words, path: Path):
    """Run a command in a process that finds the package."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(path), *sys.path])}
    return subprocess.run(
        [sys.executable, "-m", "finssim", *words],
        capture_output=True,
        text=True,
        env=environment,
        timeout=300,
    )


def test_every_member_of_finssim_can_be_imported():
    """Each textual reference leads to an object that its family accepts."""
    assert {words.split()[0] for words in EVERY} == {words.split()[0] for words in COMMANDS}
    for family in FAMILIES:
        assert family.failures() == {}
        ours = [name for name, package in family.packages().items() if package.startswith("finssim")]
        assert ours and all(family[name] is not None for name in ours)


def test_names_of_packages_work_as_those_of_finssim(outside):
    """A vehicle, a task and a learner are found by name."""
    assert "mini" in catalogue() and load_vehicle("mini").body.mass == 10.5
    assert task_named("hover").hold == 3.0
    kind = learner_named("slow")
    assert kind.own is not None and kind.what == "PPO with another name."
    assert VEHICLES.packages()["mini"] == "outside 1.0"


def test_a_broken_package_is_named_and_stops_only_what_needs_it(broken):
    """A broken package is named in one sentence at its first use; everything else is unaffected."""
    sentence = (
        "'lost' of package broken 1.0 cannot be used: broken:lost: ModuleNotFoundError: No module named"
    )
    with pytest.raises(VehicleError, match=sentence):
        load_vehicle("lost")
    with pytest.raises(EnvironmentSetupError, match=sentence):
        task_named("lost")
    with pytest.raises(LearningError, match=sentence):
        learner_named("lost")
    with pytest.raises(VehicleError, match=sentence):
        load_vehicle("bluerov2").replace({"sensors.lost": {"rate": 1.0, "position": [0.0, 0.0, 0.0]}})
    assert load_vehicle("bluerov2") and task_named("t1") and learner_named("ppo")
    with pytest.warns(RegistryWarning, match=sentence):
        assert "lost" not in TASKS.usable() and "lost" in TASKS


def test_an_object_that_is_no_member_is_refused(tmp_path, monkeypatch):
    """A number is refused as a task, as a vehicle and as a sensor."""
    members = {family: {"odd": "numbered:ODD"} for family in ("tasks", "vehicles", "sensors", "learners")}
    install(tmp_path, monkeypatch, "numbered", "ODD = 7\n", members)
    for family in (TASKS, VEHICLES, SENSORS):
        with pytest.raises(
            RegistryError, match="package numbered 1.0 cannot be used.*odd is .?7.?, expected"
        ):
            family["odd"]


def test_a_name_belongs_to_one_package(tmp_path, monkeypatch):
    """Two packages with the same name are both named; FinsSim's own member keeps its name, and the clash is
    reported."""
    for name in ("first", "second"):
        members = {"tasks": {"hover": f"{name}:hover", "t1": f"{name}:hover"}}
        install(tmp_path, monkeypatch, name, "def hover(): ...\n", members)
    with pytest.raises(RegistryError, match="(first|second) 1.0 and (first|second) 1.0 both register a task"):
        TASKS["hover"]
    assert TASKS["t1"] is StationKeeping
    assert "'t1' of package" in TASKS.failures()["t1"] and "is not used" in TASKS.failures()["t1"]


def test_a_program_adds_and_redefines_its_own_members_only():
    """A notebook cell that is executed again replaces its class; another object of that name is refused."""
    family = Family("thing", {"ours": "math:pi"})
    first, second, other = (type(name, (), {}) for name in ("Mine", "Mine", "Other"))
    family["mine"] = first
    family["mine"] = second
    assert family["mine"] is second and family.packages()["mine"] == "this program"
    with pytest.raises(RegistryError, match="there is a thing 'mine' already, of this program"):
        family["mine"] = other
    with pytest.raises(RegistryError, match="there is a thing 'ours' already, of finssim"):
        family["ours"] = other
    del family["mine"]
    assert list(family) == ["ours"] and len(family) == 1
    with pytest.raises(KeyError):
        family["none"]


@pytest.mark.slow
def test_commands_of_packages(outside):
    """A package's command is in the help, has the options of its function, and runs."""
    shown = command("--help", path=outside)
    assert "Extensions" in shown.stdout and "Greet a vehicle." in shown.stdout
    run = command("greet", "mini", "--twice", path=outside)
    assert (run.returncode, run.stdout) == (0, "hello hello mini\n")
    assert command("greet", "--no-such", path=outside).returncode == 2


@pytest.mark.slow
def test_the_doctor_lists_members_and_reports_broken_ones(outside, broken, capsys):
    """Members are listed by family and package; a broken member is reported in a sentence and does not
    prevent the start."""
    assert finssim("doctor", "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["registered"]["tasks"]["outside 1.0"] == ["hover"]
    assert "t1" in report["registered"]["tasks"]["finssim"]
    assert sum("package broken 1.0" in sentence for sentence in report["failures"]) == len(FAMILIES)
    assert not any("outside" in sentence for sentence in report["failures"])
    assert finssim("doctor") == 0 and finssim("vehicles") == 0 and finssim("tasks") == 0
    printed = capsys.readouterr()
    assert "package broken 1.0 cannot be used" in " ".join(printed.out.split())
    for left_out in ("vehicle", "task"):
        assert f"warning: {left_out} 'lost' of package broken 1.0" in printed.err
    lost = command("lost", path=broken)
    assert lost.returncode == 2 and "package broken 1.0" in lost.stderr and "Traceback" not in lost.stderr
    assert "lost" in command("--help", path=broken).stdout


def test_a_described_world_is_refused_where_no_extension_reads_it(monkeypatch):
    """The refusal is one sentence that names the world."""
    monkeypatch.setattr(site, "WORLDS", Family("unregistered-world", {}))
    with pytest.raises(site.SurroundingsError, match="world 'dock': no extension reads described worlds"):
        site.described_world("dock")
