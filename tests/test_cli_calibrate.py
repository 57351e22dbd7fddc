"""`finssim calibrate`, `replay` and `experiment`, with words as a user types them."""

import json
from pathlib import Path

import pytest

from finssim.sim.ranges_file import load_ranges
from finssim.trials.trial_files import load_trials, write_trial
from finssim.vehicles import load_vehicle
from reference.commands import finssim, refusal

PARAMETER = {"estimate", "ci95", "unit", "identifiable", "note"}
KEYS = {
    "kind", "method", "vehicle", "parameters", "quality", "correlation", "findings", "trials", "out", "provenance",
}  # fmt: skip


@pytest.fixture(scope="module")
def trials(tmp_path_factory):
    """Simulated trials of surge: six to fit on, two at another level to hold out."""
    folder = tmp_path_factory.mktemp("trials")
    words = ["--vehicle", "finsrov", "--simulate"]
    assert finssim("excite", "surge", *words, "--seed", "1", "--out", folder / "fit") == 0
    assert finssim("excite", "surge", *words, "--levels", "9", "--out", folder / "held-out") == 0
    return folder


@pytest.fixture(scope="module")
def fitted(trials):
    """A vehicle fitted on the trials, with its report and ranges."""
    words = ["calibrate", "hydrodynamics", trials / "fit", "--vehicle", "finsrov", "--axes", "surge"]
    folder = trials / "fitted"
    outputs = ["--out", folder / "v.yaml", "--report", folder / "report", "--ranges", folder / "r.yaml"]
    assert finssim(*words, *outputs) == 0
    return folder


@pytest.mark.slow
def test_hydrodynamics_writes_vehicle_report_and_ranges(fitted):
    """Surge damping becomes measured and near the truth; the file lists its trials; everything else is unchanged."""
    truth, vehicle = load_vehicle("finsrov"), load_vehicle(fitted / "v.yaml")
    d1 = vehicle.hydrodynamic_set("calibrated").linear_damping
    assert vehicle.origin_of("hydrodynamics.calibrated.linear_damping.0").origin == "measured"
    assert d1[0, 0] == pytest.approx(truth.hydrodynamic_set("calibrated").linear_damping[0, 0], rel=0.05)
    assert d1[1, 1] == truth.hydrodynamic_set("calibrated").linear_damping[1, 1]
    assert all(vehicle.fitted_on(trial.sha256) for trial in load_trials([fitted.parent / "fit"]))
    assert {"report.html", "fit.json"} <= {f.name for f in (fitted / "report").iterdir()}
    assert "finssim calibrate hydrodynamics" in (fitted / "report" / "report.html").read_text("utf-8")
    low, high = load_ranges(fitted / "r.yaml").linear_damping.axes["surge"]
    assert 0.8 < low < 1.0 < high < 1.2


@pytest.mark.slow
def test_hydrodynamics_as_json(capfd, tmp_path, trials):
    """`--json` prints one object with the keys of the contract, and nothing else on standard output."""
    words = ["calibrate", "hydrodynamics", trials / "fit" / "surge_plus_12", "--vehicle", "finsrov"]
    assert finssim(*words, "--axes", "surge", "--json", "--out", tmp_path / "v.yaml") == 0
    found = json.loads(capfd.readouterr().out)
    assert found.keys() >= KEYS and found["method"] == "simulation"
    assert found["parameters"]["surge.d1"].keys() == PARAMETER
    assert found["parameters"]["surge.d1"]["estimate"] == pytest.approx(39.07, rel=0.1)
    assert found["out"] == str(tmp_path / "v.yaml")


@pytest.mark.slow
def test_held_out_trials_are_left_out_and_it_is_said(capsys, tmp_path, trials):
    """A trial that its header marks as held out is excluded from the fit, and the command reports it."""
    every = load_trials([trials / "fit"])
    for trial in every:
        role = "held-out" if trial.name == "surge_plus_12" else "fit"
        header = trial.header.model_copy(update={"role": role})
        write_trial(type(trial)(**{**vars_of(trial), "header": header}), tmp_path / "t" / trial.name)
    words = ["calibrate", "hydrodynamics", tmp_path / "t", "--vehicle", "finsrov", "--axes", "surge"]
    assert finssim(*words, "--out", tmp_path / "v.yaml") == 0
    told = capsys.readouterr().err
    assert "surge_plus_12: left out: it is marked as held out" in told
    assert "calibrate hydrodynamics: reading the trials" in told
    vehicle = load_vehicle(tmp_path / "v.yaml")
    assert len(vehicle.calibrations[0].trials) == 5
    assert not any(vehicle.fitted_on(t.sha256) for t in every if t.name == "surge_plus_12")
    for folder in (tmp_path / "t").iterdir():
        text = (folder / "trial.yaml").read_text("utf-8").replace("role: fit", "role: held-out")
        (folder / "trial.yaml").write_text(text, "utf-8")
    assert "every trial is marked held-out" in refusal(
        capsys, *words, "--out", tmp_path / "w.yaml", notes=True
    )


def vars_of(trial):
    """Return the fields of a trial by name."""
    return {name: getattr(trial, name) for name in trial.__dataclass_fields__}


@pytest.mark.slow
def test_replay_labels_what_the_vehicle_was_fitted_on(capfd, tmp_path, trials, fitted):
    """In-sample trials are labelled as such; held-out ones are scored, as JSON and as a folder."""
    words = ["replay", trials / "held-out", "--vehicle", fitted / "v.yaml"]
    assert finssim(*words, "--json", "--out", tmp_path / "replay") == 0
    found = json.loads(capfd.readouterr().out)
    assert {"nrmse", "aggregate", "ci95", "in_sample"} <= found.keys() and found["in_sample"] is False
    assert any((tmp_path / "replay").iterdir())
    assert finssim("replay", trials / "fit", "--vehicle", fitted / "v.yaml", "--json") == 0
    assert json.loads(capfd.readouterr().out)["in_sample"] is True


def test_thruster_as_json_and_as_a_vehicle(capfd, tmp_path):
    """The curve from the published table of a T200 is written for every thruster of the group."""
    table = Path(__file__).parent / "data" / "t200" / "t200_16V_bluerobotics_2019.csv"
    words = ["calibrate", "thruster", table, "--vehicle", "bluerov2", "--out", tmp_path / "v.yaml"]
    assert finssim(*words, "--json") == 0
    found = json.loads(capfd.readouterr().out)
    assert found.keys() >= KEYS and found["kind"] == "thruster"
    assert all(parameter.keys() == PARAMETER for parameter in found["parameters"].values())
    vehicle = load_vehicle(tmp_path / "v.yaml")
    for thruster in vehicle.thrusters.values():
        assert thruster.c_plus == pytest.approx(found["parameters"]["T200.c_plus"]["estimate"], rel=1e-6)
    assert finssim(*words) == 0
    assert "T200.c_plus" in capfd.readouterr().out


HYDRODYNAMICS = ["calibrate", "hydrodynamics", "TRIALS", "--vehicle", "finsrov"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([*HYDRODYNAMICS, "--out", "v.json"], "v.json ends in '.json', expected .yaml"),
        ([*HYDRODYNAMICS, "--out", "/proc/x/v.yaml"], "write elsewhere"),
        ([*HYDRODYNAMICS, "--out", "v.yaml", "--axes", "surg"], "unknown axis 'surg'"),
        ([*HYDRODYNAMICS, "--out", "v.yaml", "--method", "simulation"], "No such option: --method"),
        ([*HYDRODYNAMICS, "--out", "v.yaml", "--estimate", "colour"], "cannot estimate 'colour'"),
        ([*HYDRODYNAMICS, "--out", "v.yaml", "--horizon", "-1"], "horizon is -1 s"),
        ([*HYDRODYNAMICS, "--out", "v.yaml", "--fix", "yaw=0.6"], "expected AXIS.m=NUMBER"),
        ([*HYDRODYNAMICS, "--out", "v.yaml", "--fix", "yaw.m=1e300"], "expected AXIS.m=NUMBER"),
        ([*HYDRODYNAMICS, "--out", "v.yaml", "--fix", "yaw.m=0.6"], "the inertia of yaw was given, but"),
        ([*HYDRODYNAMICS, "--out", "v.yaml", "--damping", "cubic"], "cubic"),
        ([*HYDRODYNAMICS, "--out", "v.yaml", "--ranges", "r.json"], "r.json ends in '.json'"),
        ([*HYDRODYNAMICS, "--out", "v.yaml", "--report", "/proc/x/r"], "write elsewhere"),
        (
            ["calibrate", "hydrodynamics", "nowhere", "--vehicle", "finsrov", "--out", "v.yaml"],
            "nowhere: no such",
        ),
        (["calibrate", "hydrodynamics", "TRIALS", "--vehicle", "finrov", "--out", "v.yaml"], "did you mean"),
        (["calibrate", "motor", "nowhere", "--vehicle", "finsrov", "--out", "v.yaml"], "nowhere: no such"),
        (["calibrate", "thruster", "nowhere.csv", "--vehicle", "bluerov2", "--out", "v.yaml"], "nowhere.csv"),
        (["replay", "TRIALS", "--vehicle", "finsrov", "--hydrodynamics", "fosen"], "fosen"),
        (["replay", "TRIALS", "--vehicle", "finsrov", "--horizon", "-1"], "horizon is -1 s"),
        (["replay", "TRIALS", "--vehicle", "finsrov", "--horizon", "1e-300"], "expected 0.1 to 60 s"),
        (["experiment", "replay", "--seeds", "0", "--out", "x"], "Invalid value for '--seeds'"),
        (["experiment", "replay", "--out", "/proc/x/y"], "write elsewhere"),
    ],
)
def test_what_cannot_be_done_is_refused_in_a_sentence(capsys, tmp_path, monkeypatch, trials, words, sentence):
    """Each request is refused in a sentence before any work begins, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    given = [trials / "fit" if word == "TRIALS" else word for word in words]
    assert sentence in refusal(capsys, *given, notes=True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_an_interrupted_fit_leaves_the_best_so_far(capsys, tmp_path, monkeypatch, trials):
    """Ctrl-C while candidates are simulated leaves a complete vehicle marked as interrupted, and status 130."""
    from finssim.identification import simulation_error

    whole = simulation_error.fit_by_simulation

    def interrupted(*args, progress=None, **options):
        def show(part, text):
            if text.startswith("fit"):
                raise KeyboardInterrupt

        return whole(*args, progress=show, **options)

    monkeypatch.setattr(simulation_error, "fit_by_simulation", interrupted)
    words = ["calibrate", "hydrodynamics", trials / "fit", "--vehicle", "finsrov", "--axes", "surge"]
    assert finssim(*words, "--out", tmp_path / "v.yaml") == 130
    assert load_vehicle(tmp_path / "v.yaml").calibrations[0].interrupted
    assert "(interrupted)" in capsys.readouterr().out


@pytest.mark.slow
def test_motors_from_steps(capfd, tmp_path):
    """Simulated steps with logged commands and thrust give back the lag and delay of the vehicle file."""
    words = ["excite", "surge", "--vehicle", "finsrov", "--simulate", "--levels", "6,12"]
    assert finssim(*words, "--inputs", "force,command", "--out", tmp_path / "steps") == 0
    words = ["calibrate", "motor", tmp_path / "steps", "--vehicle", "finsrov", "--out", tmp_path / "v.yaml"]
    capfd.readouterr()
    assert finssim(*words, "--json") == 0
    found = json.loads(capfd.readouterr().out)
    assert found.keys() >= KEYS and found["kind"] == "motor"
    thruster = load_vehicle(tmp_path / "v.yaml").thrusters["H_LF"]
    assert thruster.time_constant == pytest.approx(0.12, rel=0.1)
    assert thruster.delay == pytest.approx(0.05, abs=0.01)
