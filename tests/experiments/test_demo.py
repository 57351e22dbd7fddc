"""`finssim demo`: the whole loop at a small size, and a report that stands alone."""

import json
import re

import numpy as np
import pytest

from finssim.calibration.trials.trial_files import load_trials
from finssim.control.policy import Policy
from finssim.experiments import demo as demo_module
from finssim.experiments.demo import demo
from finssim.experiments.identify import identify
from finssim.experiments.plants import load_plant
from finssim.files import OutputError
from finssim.learning import ppo
from finssim.vehicles import load_vehicle


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A demonstration with a policy that had no time to learn: its folder, and what was identified."""
    out, found = tmp_path_factory.mktemp("demo") / "demo", []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo_module, "identify", lambda *a, **k: found.append(identify(*a, **k)) or found[0])
        assert demo(out, steps=8192) == out / "report.html"
    return out, found[0]


@pytest.fixture(scope="module")
def folder(made):
    return made[0]


def test_policy_results_and_report_are_there(folder):
    assert {p.name for p in folder.iterdir()} >= {
        "trials",
        "finsrov_rough.yaml",
        "finsrov_identified.yaml",
        "calibration",
        "replay.json",
        "replay.png",
        "pool.yaml",
        "policy",
        "policy.json",
        "pid.json",
        "pid-paper.json",
        "report.html",
    }
    assert json.loads((folder / "pid.json").read_text(encoding="utf-8"))["success"] == 8


def test_the_identified_vehicle_is_near_the_plant_and_the_policy_is_for_it(made):
    """Damping of the driven axes within 5 % of the truth; the policy and the trials are of that vehicle."""
    folder, found = made
    vehicle, truth = load_vehicle(folder / "finsrov_identified.yaml"), load_vehicle("finsrov")
    ours, theirs = (
        np.diag(v.hydrodynamic_set("calibrated").linear_damping)[[0, 1, 2, 5]] for v in (vehicle, truth)
    )
    np.testing.assert_allclose(ours, theirs, rtol=0.05)
    assert Policy.load(folder / "policy", vehicle=vehicle).description.vehicle.sha256 == vehicle.sha256
    for role in ("fit", "held-out"):
        for trial in load_trials([folder / "trials" / role]):
            assert trial.header.role == role and vehicle.fitted_on(trial.sha256) is (role == "fit")
    assert found.replay.aggregate("calibrated").value < 0.05
    assert load_plant(folder / "pool.yaml").changed(vehicle).sha256 == truth.sha256


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
        "pid, pool",
        "pid-paper, pool",
        "paper: PID",
        "P08",
        "Provenance",
        "surge.d1",
    ):
        assert f">{word}<" in html
    vehicle = f"--vehicle {folder / 'finsrov_identified.yaml'}"
    assert f"finssim train t1 {vehicle} --seed 1 --steps 8192 --out policy" in html
    assert f"finssim evaluate pid {vehicle} --plant {folder / 'pool.yaml'}" in html
    assert policy["vehicle"]["sha256"] in html and str(policy["provenance"]["revision"]) in html


def interrupt(*_, **__):
    raise KeyboardInterrupt


@pytest.mark.parametrize("when", ["training", "evaluation"])
def test_an_interrupted_demonstration_keeps_its_policy_where_it_says(
    tmp_path, monkeypatch, capsys, made, when
):
    """Ctrl-C in the second rollout, or in the evaluation: a whole policy beside the demonstration, and nothing else."""
    monkeypatch.setattr(demo_module, "identify", lambda *_, **__: made[1])
    record = ppo._Watch._on_rollout_end

    def stop(self):
        record(self)
        if len(self.curves) == 2:
            raise KeyboardInterrupt

    if when == "training":
        monkeypatch.setattr(ppo._Watch, "_on_rollout_end", stop)
    else:
        monkeypatch.setattr(demo_module, "evaluate_controller", interrupt)
    with pytest.raises(KeyboardInterrupt):
        demo(tmp_path / "demo", steps=100_000 if when == "training" else 8192)
    kept = tmp_path / "demo-training" / "interrupted"
    assert Policy.load(kept).description.training["complete"] is (when == "evaluation")
    assert f": {kept}" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["demo-training"]


def test_somebodys_files_are_not_replaced(tmp_path):
    (tmp_path / "thesis.tex").write_text("years", encoding="utf-8")
    with pytest.raises(OutputError, match="already holds files"):
        demo(tmp_path, steps=1)
