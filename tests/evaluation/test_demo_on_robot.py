"""The whole loop on a robot: trials, vehicle, policy and report in one folder, resumable after an interruption."""

import json
from contextlib import nullcontext

import pytest
from rich.console import Console

from finssim.control.axis_model import axis_model
from finssim.control.policy import Policy
from finssim.evaluation.robot_trials import OnRobot, RobotError
from finssim.robot.wiring import Wiring
from finssim.studies import demo as demo_module
from finssim.studies.demo import DemoSettings, Scope, demo
from finssim.vehicles import load_vehicle
from finssim.vehicles.capability import terminal_speed
from reference.pools import Person, lockstep_pool

pytestmark = pytest.mark.slow

FINSROV = load_vehicle("finsrov")
SMALL = Scope(
    levels={"surge": [18.0]},
    shuttles={},
    held_out={"surge": [12.0]},
    setpoints=("P02",),
    pictures=("P02",),
    duration=3.0,
)
QUIET = Console(quiet=True)


def test_the_loop_goes_on_where_it_was_interrupted_and_ends_in_a_report(brief_steps, tmp_path, monkeypatch):
    """After q at the first of four programmes, the rest follows: a training, two controllers, and their results.

    The speed of the plant that the trials give is the catalogue's, within 5 %.
    """
    monkeypatch.setattr(demo_module, "running", lambda *_: nullcontext())  # compile the kernels first
    out, file = tmp_path / "demo", tmp_path / "pool.yaml"
    options = {"settings": DemoSettings(steps=8192, scope=SMALL), "console": QUIET}
    with lockstep_pool(FINSROV, file) as wiring, pytest.raises(KeyboardInterrupt):
        person = Person(("enter:", "\r"), ("enter:", "q"))
        demo(out, robot=OnRobot(wiring=wiring, pool_file=file, arm=True, attendant=person), **options)
    (first,) = (out / "trials" / "fit" / "records").glob("*.mcap")
    before = first.stat().st_mtime_ns
    with lockstep_pool(FINSROV, file, sessions=2) as wiring:
        robot = OnRobot(wiring=wiring, pool_file=file, arm=True, unattended=True)
        report = demo(out, robot=robot, **options)
    assert first.stat().st_mtime_ns == before
    vehicle = load_vehicle(out / "finsrov_identified.yaml")
    speeds = [
        terminal_speed(float(model.linear_damping[0]), float(model.quadratic_damping[0]), 18.0)
        for model in map(axis_model, (vehicle, FINSROV))
    ]
    assert speeds[0] == pytest.approx(speeds[1], rel=0.05)
    assert Policy.load(out / "policy", vehicle=vehicle).description.training["steps"] == 8192
    result = json.loads((out / "t1" / "t1.json").read_text())
    assert result["robot"] and {name: row["trials"] for name, row in result["rows"].items()} == dict.fromkeys(
        ("calibrated-pool", "pid"), 1
    )
    page = report.read_text()
    assert "integrating, hardware" in page and "setpoints on hardware" in page and "trials of a robot" in page
    assert f"finssim run --policy policy --vehicle {out / 'finsrov_identified.yaml'}" in page


def test_somebodys_folder_is_refused(tmp_path):
    """A folder with other files is refused before a robot is opened."""
    (tmp_path / "thesis.tex").write_text("years")
    robot = OnRobot(
        wiring=Wiring(robot="127.0.0.1:1", lockstep=True), pool_file=tmp_path / "p.yaml", arm=True
    )
    with pytest.raises(RobotError, match="holds other files"):
        demo(tmp_path, robot=robot, settings=DemoSettings(scope=SMALL), console=QUIET)
