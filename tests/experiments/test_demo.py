"""`finssim demo`: the whole loop at a small size, and a report that stands alone."""

import contextlib
import io
import json
import re

import pytest

from finssim import boundary
from finssim.calibration.trials.trial_files import load_trials
from finssim.cli import app
from finssim.control.pid import axis_model
from finssim.control.policy import Policy
from finssim.experiments import demo as demo_module
from finssim.experiments.demo import FULL, Scope, demo, identify
from finssim.experiments.metrics import T1_SETPOINTS
from finssim.experiments.trials import Motion
from finssim.files import OutputError
from finssim.learning.training_loop import Loop
from finssim.pool import load_plant_spec
from finssim.vehicles import load_vehicle
from finssim.vehicles.capability import terminal_speed

pytestmark = pytest.mark.slow

SMALL = Scope(
    levels={"surge": [18.0]},
    shuttles={},
    held_out={"surge": [12.0]},
    setpoints=("P01",),
    pictures=("P02",),
    duration=2.0,
)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The command, with a policy that had no time to learn: its folder, what was identified, and what it told."""
    out, found, told = tmp_path_factory.mktemp("demo") / "demo", [], io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stderr(told):
        patch.setattr(demo_module, "identify", lambda *a, **k: found.append(identify(*a, **k)) or found[0])
        patch.setattr(demo_module, "FULL", SMALL)
        assert boundary.run(app, ["demo", "--steps", "8192", "--seed", "1", "--out", str(out)]) == 0
    return out, found[0], told.getvalue()


@pytest.fixture(scope="module")
def folder(made):
    return made[0]


def test_policy_results_and_report_are_there(folder):
    """And the training was as long as the command was told."""
    assert Policy.load(folder / "policy").description.training["steps"] == 8192
    assert [path.name for path in folder.parent.iterdir()] == ["demo"]
    assert {p.name for p in folder.iterdir()} == {
        "trials",
        "finsrov_rough.yaml",
        "finsrov_identified.yaml",
        "calibration",
        "replay.json",
        "replay.png",
        "pool.yaml",
        "policy",
        "policy-training",
        "deployed",
        "policy.json",
        "policy-with-pictures.json",
        "pid.json",
        "pid-paper.json",
        "envelopes.png",
        "paths.png",
        "training.png",
        "report.html",
    }


def test_the_identified_vehicle_is_as_fast_as_the_plant_and_the_policy_is_for_it(made):
    """Surge reaches in the identified vehicle what it reached in the pool's trials, within 10 %; trials by role."""
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
    """First the speeds that trials reached, then what was identified, then who held what."""
    lines = made[2].splitlines()
    at = [next(i for i, line in enumerate(lines) if line.startswith(s)) for s in ("identified", "holding")]
    assert sum(": up to " in line for line in lines[: at[0]]) == 4 and at[0] < at[1]
    assert sum(" at P01: " in line for line in lines[at[1] :]) == 3
    assert "  policy-with-pictures at P02: not held" in lines


def test_controllers_met_the_plant_that_the_trials_came_from_through_the_whole_stack(folder):
    """Every trial begins at the published start, in the pool of pool.yaml, and localization was at work in it."""
    assert load_plant_spec(folder / "pool.yaml").seed == 1
    for name, camera in (("policy", "corners"), ("pid", "corners"), ("policy-with-pictures", "pictures")):
        result = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
        (trial,) = result["per_trial"]
        assert result["camera"] == camera and trial["fault"] == ""
        assert trial["localization"]["position_m"] < 0.05
    for file in (folder / "deployed").glob("*.npz"):
        assert abs(Motion.read(file.with_suffix("")).position[0]).max() < 0.6


def test_the_full_demonstration_tries_all_setpoints_and_axes():
    assert FULL.setpoints == tuple(T1_SETPOINTS) and FULL.duration == 60.0 and FULL.pictures
    assert set(FULL.levels) == set(load_vehicle("finsrov").controlled_axes)
    fitted = [{*FULL.levels[axis], *FULL.shuttles.get(axis, [])} for axis in FULL.held_out]
    assert all(
        not set(FULL.held_out[axis]) & those for axis, those in zip(FULL.held_out, fitted, strict=True)
    )


def test_the_report_loads_nothing(folder):
    """Pictures are inside; no script, no style sheet, no address."""
    html = (folder / "report.html").read_text(encoding="utf-8")
    sources = re.findall(r'(?:src|href)="([^"]{0,30})', html)
    assert len(sources) == 4 and all(source.startswith("data:image/png;base64,") for source in sources)
    assert "http" not in re.sub(r'"data:[^"]*"', "", html) and "<script" not in html


def test_the_report_has_every_controller_the_paper_and_the_provenance(folder):
    html = (folder / "report.html").read_text(encoding="utf-8")
    policy = json.loads((folder / "policy.json").read_text(encoding="utf-8"))
    for word in (
        "policy, pool",
        "policy-with-pictures, pool",
        "pid, pool",
        "pid-paper, pool",
        "paper: PID",
        "P01",
        "Provenance",
        "surge.d1",
    ):
        assert f">{word}<" in html
    vehicle = f"--vehicle {folder / 'finsrov_identified.yaml'}"
    assert f"finssim train t1 {vehicle} --randomize pool --seed 1 --steps 8192 --out policy" in html
    assert "on hardware" in html
    assert policy["vehicle"]["sha256"] in html and str(policy["provenance"]["revision"]) in html


def interrupt(*_, **__):
    raise KeyboardInterrupt


@pytest.mark.parametrize("when", ["training", "deployment"])
def test_an_interrupted_demonstration_keeps_its_policy_where_it_says(
    tmp_path, monkeypatch, capsys, made, when
):
    """Ctrl-C in the second rollout, or in the pool: a whole policy beside the demonstration, and nothing else."""
    monkeypatch.setattr(demo_module, "identify", lambda *_, **__: made[1])
    update = Loop._update

    def stop(self, total):
        if len(self.curves) == 2:
            raise KeyboardInterrupt
        return update(self, total)

    if when == "training":
        monkeypatch.setattr(Loop, "_update", stop)
    else:
        monkeypatch.setattr(demo_module, "play_jobs", interrupt)
    with pytest.raises(KeyboardInterrupt):
        demo(tmp_path / "demo", steps=100_000 if when == "training" else 8192, scope=SMALL)
    kept = tmp_path / "demo-training" / "interrupted"
    assert Policy.load(kept).description.training["complete"] is (when == "deployment")
    assert f": {kept}" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["demo-training"]


def test_somebodys_files_are_not_replaced(tmp_path):
    (tmp_path / "thesis.tex").write_text("years", encoding="utf-8")
    with pytest.raises(OutputError, match="already holds files"):
        demo(tmp_path, steps=1)
