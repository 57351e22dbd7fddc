"""`finssim demo`: the whole loop at a small size, and a self-contained report."""

import contextlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.cli.doctor import EXTRA_OF_MODULE
from finssim.control.axis_model import axis_model
from finssim.control.policy import Policy
from finssim.evaluation.figures import new_figure, save_figure
from finssim.evaluation.metrics import T1_SETPOINTS
from finssim.evaluation.robot_trials import RobotError
from finssim.evaluation.trials import VehicleMotion
from finssim.identification import programme
from finssim.identification.vehicle_file import write_vehicle
from finssim.learning.training_loop import TrainingLoop
from finssim.pool import load_plant_spec
from finssim.studies import demo as demo_module
from finssim.studies.demo import FULL, DemoSettings, Scope, demo, identify
from finssim.trials.trial_files import load_trials
from finssim.vehicles import load_vehicle
from finssim.vehicles.capability import terminal_speed

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]

SMALL = Scope(
    levels={"surge": [18.0]},
    shuttles={},
    held_out={"surge": [12.0]},
    setpoints=("P01",),
    pictures=("P02",),
    duration=2.0,
)


@pytest.fixture(scope="module")
def made(brief_steps, tmp_path_factory):
    """Folder, identification and messages of the command, with a policy that had no time to learn."""
    out, found, told = tmp_path_factory.mktemp("demo") / "demo", [], io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stderr(told):
        patch.setattr(demo_module, "identify", lambda *a, **k: found.append(identify(*a, **k)) or found[0])
        patch.setattr(demo_module, "FULL", SMALL)
        # Compile the kernels first.
        patch.setattr(demo_module, "running", lambda *_: contextlib.nullcontext())
        assert boundary.run(app, ["demo", "--steps", "8192", "--seed", "1", "--out", str(out)]) == 0
    return out, found[0], told.getvalue()


@pytest.fixture(scope="module")
def folder(made):
    return made[0]


def test_policy_results_and_report_are_there(folder):
    """The files exist, and the training has the requested length."""
    assert Policy.load(folder / "policy").description.training["steps"] == 8192
    assert [path.name for path in folder.parent.iterdir()] == ["demo"]
    assert {p.name for p in folder.iterdir()} == {
        "trials",
        "demo.yaml",
        "finsrov_rough.yaml",
        "finsrov_identified.yaml",
        "calibration",
        "replay.json",
        "replay.png",
        "trials.png",
        "pool.yaml",
        "policy",
        "t1",
        "paths.png",
        "training.png",
        "report.html",
    }


def test_the_identified_vehicle_is_as_fast_as_the_plant_and_the_policy_is_for_it(made):
    """Surge of the identified vehicle reaches the speed of the pool's trials, within 10 %; trials are filed by role."""
    folder, _, told = made
    vehicle = load_vehicle(folder / "finsrov_identified.yaml")
    assert Policy.load(folder / "policy", vehicle=vehicle).description.vehicle.sha256 == vehicle.sha256
    model, reached = axis_model(vehicle), float(re.search(r"surge_plus_18: up to ([\d.]+)", told)[1])
    fastest = terminal_speed(float(model.linear_damping[0]), float(model.quadratic_damping[0]), 18.0)
    assert fastest == pytest.approx(reached, rel=0.1)
    for role in ("fit", "held-out"):
        for trial in load_trials([folder / "trials" / role]):
            assert trial.header.role == role and vehicle.fitted_on(trial.sha256) is (role == "fit")
            assert (folder / "trials" / role / "records" / f"{trial.name}.mcap").is_file()


def test_each_trial_is_told_as_soon_as_it_is_over(made):
    """The order is: the speeds reached in trials, the identification, the controllers' results."""
    lines = made[2].splitlines()
    at = [next(i for i, line in enumerate(lines) if line.startswith(s)) for s in ("identified", "training")]
    assert sum(": up to " in line for line in lines[: at[0]]) == 4 and at[0] < at[1]
    assert sum(" at P01: " in line for line in lines[at[1] :]) == 2
    assert "  with-pictures at P02: not held" in lines


def test_controllers_met_the_plant_that_the_trials_came_from_through_the_whole_stack(folder):
    """Every trial begins at the published start, in the pool of pool.yaml, and uses localization."""
    assert load_plant_spec(folder / "pool.yaml").seed == 1
    result = json.loads((folder / "t1" / "t1.json").read_text(encoding="utf-8"))
    rows = {trial["job"]["row"]: trial for trial in result["trials"]}
    assert set(rows) == {"calibrated-pool", "with-pictures", "pid"}
    assert [path.name for path in (folder / "t1" / "policies").iterdir()] == ["calibrated-pool-seed1"]
    for name, trial in rows.items():
        assert trial["job"]["camera"] == ("pictures" if name == "with-pictures" else "corners")
        assert (
            trial["job"]["plant"] == 1 and trial["fault"] == "" and trial["localization"]["position_m"] < 0.05
        )
        motion = VehicleMotion.read(folder / "t1" / "trials" / trial["key"])
        assert abs(motion.position[0]).max() < 0.6


def test_the_full_demonstration_tries_all_setpoints_and_axes():
    assert FULL.setpoints == tuple(T1_SETPOINTS) and FULL.duration == 60.0 and FULL.pictures
    assert set(FULL.levels) == set(load_vehicle("finsrov").controlled_axes)
    fitted = [{*FULL.levels[axis], *FULL.shuttles.get(axis, [])} for axis in FULL.held_out]
    assert all(
        not set(FULL.held_out[axis]) & those for axis, those in zip(FULL.held_out, fitted, strict=True)
    )


def test_the_report_loads_nothing(folder):
    """The report begins with a picture; pictures are embedded; there is no script, style sheet or address."""
    html = (folder / "report.html").read_text(encoding="utf-8")
    assert html.index("<figure>") < html.index('<p class="lead">') < html.index("<details")
    sources = re.findall(r'(?:src|href)="([^"]{0,30})', html)
    assert len(sources) == 4 and all(source.startswith("data:image/png;base64,") for source in sources)
    assert "http" not in re.sub(r'"data:[^"]*"', "", html) and "<script" not in html


def test_the_report_has_every_controller_and_the_provenance(folder):
    html = (folder / "report.html").read_text(encoding="utf-8")
    result = json.loads((folder / "t1" / "t1.json").read_text(encoding="utf-8"))
    for word in (
        "Pool ranges, integrating",
        "The same, by pictures",
        "PID, tuned from the model",
        "PID, tuned from the model, P01",
        "Provenance",
        "surge.d1",
    ):
        assert f">{word}<" in html
    vehicle = f"--vehicle {folder / 'finsrov_identified.yaml'}"
    assert f"finssim train t1 {vehicle} --randomize pool --seed 1 --steps 8192 --out policy" in html
    assert result["vehicle"]["sha256"] in html and str(result["provenance"]["revision"]) in html


def test_an_interrupted_demonstration_goes_on(tmp_path, monkeypatch, made):
    """After Ctrl-C in the second rollout, the same call identifies, trains and deploys; other settings are refused."""

    def identified(folder, *_, **__):
        write_vehicle(made[1].vehicle, folder / "finsrov_identified.yaml")
        save_figure(new_figure(1.0, 1.0), folder / "replay.png")
        return made[1]

    monkeypatch.setattr(demo_module, "identify", identified)
    update = TrainingLoop._update

    def stop(self, total):
        if len(self.curves) == 2:
            raise KeyboardInterrupt
        return update(self, total)

    settings = DemoSettings(steps=32_768, scope=replace(SMALL, pictures=()))
    console = Console(quiet=True)
    with monkeypatch.context() as patch:
        patch.setattr(TrainingLoop, "_update", stop)
        with pytest.raises(KeyboardInterrupt):
            demo(tmp_path / "demo", settings=settings, console=console)
    assert demo(tmp_path / "demo", settings=settings, console=console) == tmp_path / "demo" / "report.html"
    assert Policy.load(tmp_path / "demo" / "policy").description.training["complete"]
    with pytest.raises(RobotError, match="results of other settings"):
        demo(tmp_path / "demo", settings=replace(settings, seed=2), console=console)


CORE_ALONE = """
import os
import sys
from importlib.machinery import PathFinder

EXTRAS = {modules!r}


class CoreFinder(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] in EXTRAS else super().find_spec(name, path, target)


sys.meta_path[sys.meta_path.index(PathFinder)] = CoreFinder
os.cpu_count = lambda: 1
"""
"""Hides the packages of every extra from a process, and all processors but one (see `one_processor` of conftest.py)."""


@pytest.fixture
def installed(tmp_path):
    """Environment of a process in which the wheel of this source is installed, without any extra."""
    words = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path / "dist")]
    subprocess.run(words, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = (tmp_path / "dist").glob("finssim-*.whl")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--target"]
    subprocess.run([*pip, str(tmp_path / "site"), str(wheel)], check=True, capture_output=True)
    modules = {*EXTRA_OF_MODULE, "ray", "MAVProxy"}
    text = CORE_ALONE.format(modules=modules)
    (tmp_path / "site" / "sitecustomize.py").write_text(text, encoding="utf-8")
    return {**os.environ, "PYTHONPATH": str(tmp_path / "site")}


def test_a_wheel_demonstrates_itself_without_any_extra(installed, folder, tmp_path):
    """`pip install .` suffices, without torch, OpenCV and TensorBoard, and omissions are reported.

    The fitted trials are those of the earlier demonstration; the others are recorded.
    """
    shutil.copytree(folder / "trials" / "fit", tmp_path / "demo" / "trials" / "fit")
    shutil.copy(folder / "demo.yaml", tmp_path / "demo")
    settings = DemoSettings(steps=8192, scope=replace(SMALL, duration=1.0))
    program = (
        f"from finssim.identification import programme; programme.PLANS['step'] = {programme.PLANS['step']}; "
        f"from finssim.studies.demo import DemoSettings, Scope, demo; demo('demo', settings={settings!r})"
    )
    run = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=installed, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    assert "OpenCV is not installed" in run.stderr
    result = json.loads((tmp_path / "demo" / "t1" / "t1.json").read_text(encoding="utf-8"))
    assert {trial["job"]["row"] for trial in result["trials"]} == {"calibrated-pool", "pid"}
    doctor = [sys.executable, "-m", "finssim", "doctor", "--json"]
    found = json.loads(subprocess.run(doctor, cwd=tmp_path, env=installed, capture_output=True).stdout)
    assert found["healthy"] and set(found["core"]) >= {"warp-lang", "matplotlib", "mcap"}


def test_somebodys_files_are_not_replaced(tmp_path):
    (tmp_path / "thesis.tex").write_text("years", encoding="utf-8")
    with pytest.raises(RobotError, match="holds other files"):
        demo(tmp_path, settings=DemoSettings(steps=1))


def test_a_training_curve_leaves_out_rows_without_a_number():
    """Success and return of the evaluations come first; rows before the end of the first episode have no return."""
    kinds = [("steps", float), ("mean_return", float), ("held", float), ("evaluation_return", float)]
    rows = [(100.0, np.nan, 0.1, np.nan), (200.0, 2.0, 0.2, np.nan), (300.0, 3.0, 0.3, np.nan)]
    figure = demo_module._training(np.array(rows, dtype=kinds))
    held, returns = (axes.lines[0].get_xydata() for axes in figure.axes)
    np.testing.assert_allclose(held, [[1e-4, 0.1], [2e-4, 0.2], [3e-4, 0.3]])
    np.testing.assert_allclose(returns, [[2e-4, 2.0], [3e-4, 3.0]])
