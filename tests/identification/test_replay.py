"""A model replayed on its own recordings is exact; missing columns are named; in-sample trials are labelled."""

from __future__ import annotations

import dataclasses
import io
import json

import numpy as np
import pytest
from rich.console import Console

from finssim.identification.prediction import replay, run_replay
from finssim.identification.programme import programmes
from finssim.identification.synthetic import simulate_programme
from finssim.trials.findings import CalibrationError
from finssim.trials.trial_files import write_trial
from finssim.vehicles import CalibrationRecord, load_vehicle

FINSROV = load_vehicle("finsrov")
MODELS = ("calibrated", "mesh", "simplified")
AXES = ("surge", "sway", "heave", "roll", "pitch", "yaw")
MIDDLE = {"surge": [8.0], "sway": [6.0], "heave": [6.0], "roll": [0.3], "pitch": [0.3], "yaw": [1.0]}


def make(axes, hydrodynamics="calibrated", noise="none", **options):
    """Return one trial in each direction of each axis."""
    plan = programmes(axes, FINSROV, levels=MIDDLE, coast=4.0)
    return simulate_programme(plan, FINSROV, noise=noise, hydrodynamics=hydrodynamics, seed=3, **options)


@pytest.fixture(scope="module")
def surge():
    """Two trials, one to each side, as measured by sensors."""
    return make("surge", noise="sensors")


def fitted_on(*trials):
    record = CalibrationRecord(kind="hydrodynamics", method="test", trials={t.name: t.sha256 for t in trials})
    return FINSROV.model_copy(update={"calibrations": (record,)})


def without(trial, *columns):
    return dataclasses.replace(trial, channels={k: v for k, v in trial.channels.items() if k not in columns})


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS)
def test_every_model_reproduces_trials_that_it_made(model):
    """Without noise the replay differs only by logging the inputs at 50 Hz; every other model is worse."""
    result = replay(make(AXES, model), FINSROV, hydrodynamics=[model, *[m for m in MODELS if m != model]])
    own, *others = (result.aggregate(m) for m in result.models)
    assert set(own.by_axis) == set(AXES)
    assert max(own.by_axis.values()) < 0.02
    assert all(other.value > 5.0 * own.value for other in others)


@pytest.mark.slow
def test_a_good_model_predicts_better_than_persistence_and_a_bad_one_is_told_by_its_skill(surge):
    result = replay(surge, FINSROV, hydrodynamics=("calibrated", "mesh"), horizon=3.0)
    good, bad = result.ahead["surge"]["calibrated"], result.ahead["surge"]["mesh"]
    np.testing.assert_allclose(good.seconds, [1.0, 2.0, 3.0])
    assert (good.skill > 0.9).all() and (good.nrmse < 0.05).all()
    assert (bad.rmse > 10.0 * good.rmse).all()
    np.testing.assert_allclose(good.persistence, bad.persistence)
    assert good.count[0] >= good.count[-1] > 10


def test_heights_from_another_zero_do_not_lift_the_vehicle_out_of_the_water():
    """Motion capture may count from the floor: a vehicle at +1 m and higher is no less submerged."""
    kept = without(make(["heave"])[0], "depth")
    z = kept.channels["z"]
    raised = dataclasses.replace(kept, channels={**kept.channels, "z": z - z.min() + 1.0})
    low, high = (replay([trial], FINSROV).aggregate("calibrated").value for trial in (kept, raised))
    assert high == pytest.approx(low, rel=0.01)


def test_trials_of_the_fit_are_in_sample_and_do_not_count_with_held_out_ones(surge):
    result = replay(surge, fitted_on(surge[0]))
    data = result.as_json()
    assert [data["trials"][t.name]["in_sample"] for t in surge] == [True, False]
    assert data["in_sample_trials"] == [surge[0].name] and not data["in_sample"]
    model = data["models"]["calibrated"]
    assert model["held_out"]["trials"] == model["in_sample_only"]["trials"] == 1
    assert model["aggregate"] == model["held_out"]["aggregate"] == data["nrmse"]["surge"][surge[1].name]


def test_with_in_sample_trials_alone_every_output_says_so(surge, tmp_path):
    result = replay(surge, fitted_on(*surge), out=tmp_path / "out")
    data = json.loads((tmp_path / "out" / "replay.json").read_text())
    assert result.in_sample and data["in_sample"] and data["models"]["calibrated"]["held_out"] is None
    assert "IN-SAMPLE" in (tmp_path / "out" / "replay.md").read_text()


def test_the_json_has_what_the_contract_names(surge):
    data = replay(surge, FINSROV).as_json()
    names = {t.name for t in surge}
    assert data["nrmse"].keys() == {"surge"} and data["nrmse"]["surge"].keys() == names
    low, high = data["ci95"]
    assert low <= data["aggregate"] <= high
    assert data["in_sample"] is False
    assert data["vehicle"]["sha256"] == FINSROV.sha256
    assert {data["trials"][n]["sha256"] for n in names} == {t.sha256 for t in surge}
    assert data["provenance"]["finssim"]
    json.dumps(data, allow_nan=False)


def test_after_a_gap_the_replay_starts_anew(surge):
    trial = surge[0]
    keep = (trial.t < 5.0) | (trial.t > 7.0)
    cut = dataclasses.replace(
        trial,
        t=trial.t[keep],
        phase=trial.phase[keep],
        channels={k: v[keep] for k, v in trial.channels.items()},
    )
    (pair,) = replay([cut], FINSROV).pairs
    inside = (pair.t > 5.1) & (pair.t < 6.9)
    assert (pair.segment[inside] == -1).all() and np.isnan(pair.simulated["calibrated"]["u"][inside]).all()
    assert set(pair.segment) == {-1, 0, 1}
    assert replay([cut], FINSROV).aggregate("calibrated").value < 0.05


def test_an_axis_that_nobody_measured_is_named_and_not_scored(surge):
    # Only rates and attitude: the surge velocity is not observed.
    blind = [without(t, "u", "v", "w", "x", "y", "z", "depth") for t in surge]
    result = replay(blind, FINSROV)
    data = result.as_json()
    assert data["aggregate"] is None and data["ci95"] is None and data["why"]
    assert data["trials"][surge[0].name]["models"]["calibrated"]["why"] == {"surge": "not measured"}


def test_a_velocity_from_position_is_labelled_as_derived(surge):
    derived = [without(t, "u", "v", "w") for t in surge]
    result = replay(derived, FINSROV)
    assert result.as_json()["trials"][surge[0].name]["source"]["u"] == "derived from position"
    console = Console(width=140, record=True, file=io.StringIO())
    from finssim.identification.replay_report import print_replay

    print_replay(result, console)
    assert "not measured but derived from position" in console.export_text()
    assert result.aggregate("calibrated").value < 0.1


@pytest.mark.parametrize("rate", [5.0, 10.0, 25.0])
def test_a_slow_log_is_compared_at_its_own_rate(rate):
    slow = make("surge", rate=rate, columns=("u", "v", "w", "r"), inputs=("wrench",))
    result = replay(slow, FINSROV)
    assert {pair.rate for pair in result.pairs} == {rate}
    assert result.aggregate("calibrated").value < 0.06


@pytest.mark.slow
@pytest.mark.parametrize("inputs", ["rpm", "force", "wrench", "command"])
def test_every_kind_of_input_drives_the_replay(inputs):
    result = replay(make("yaw", inputs=(inputs,)), FINSROV)
    assert result.aggregate("calibrated").value < 0.03


def test_a_passive_trial_is_replayed_from_its_initial_state():
    """With thrusters off, the replay is a free decay in roll and pitch from the initial tilt."""
    (trial, _) = make("roll", spread=5.0)
    rows = trial.t < 2.0
    passive = dataclasses.replace(
        without(trial, *(c for c in trial.channels if c.startswith(("rpm_", "tau_")))),
        header=trial.header.model_copy(update={"passive": True, "axis": (), "inputs": None}),
        phase=None,
    )
    passive = dataclasses.replace(
        passive, t=trial.t[rows], channels={k: v[rows] for k, v in passive.channels.items()}
    )
    result = replay([passive], FINSROV, hydrodynamics=("calibrated", "mesh"))
    (pair,) = result.pairs
    assert {"roll", "pitch"} <= set(pair.axes) and set(pair.phase) == {"coast"}
    scores = {m: result.scores[m][0]["roll"].value for m in result.models}
    assert scores["calibrated"] < 0.1 < scores["mesh"]


def test_a_diverging_model_has_no_aggregate_and_says_so(surge):
    """Damping that adds energy accelerates the body without end, which is reported."""
    broken = FINSROV.replace({"hydrodynamics.calibrated.quadratic_damping": [-1e4, 0, 0, 0, 0, 0]})
    found = replay(surge, broken)
    total = found.aggregate("calibrated")
    assert total.value is None and "does not stay finite" in total.why
    assert all("does not stay finite" in s["surge"].why for s in found.scores["calibrated"])


@pytest.mark.slow
def test_the_command_reads_trials_and_writes_its_folder(surge, tmp_path, capsys):
    for trial in surge:
        write_trial(trial, tmp_path / "trials" / trial.name)
    options = {"vehicle": "finsrov", "hydrodynamics": MODELS, "out": tmp_path / "out"}
    run_replay([tmp_path / "trials"], as_json=True, **options)
    data = json.loads(capsys.readouterr().out)
    assert data["models"].keys() == set(MODELS)
    files = {p.relative_to(tmp_path / "out").as_posix() for p in (tmp_path / "out").rglob("*.*")}
    assert {"replay.json", "replay.md", "envelope.png"} | {f"trials/{t.name}.png" for t in surge} == files
    run_replay([tmp_path / "trials"], **options)
    assert "aggregate" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"hydrodynamics": "fossen"}, "unknown hydrodynamic model 'fossen'"),
        ({"hydrodynamics": ()}, "no model to replay"),
        ({"horizon": -1.0}, "horizon is -1 s"),
        ({"horizon": float("nan")}, "horizon is nan s"),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(surge, options, words):
    with pytest.raises(CalibrationError, match=words):
        replay(surge, FINSROV, **options)
    with pytest.raises(CalibrationError, match="no trial to replay"):
        replay([], FINSROV)


def test_a_trial_that_cannot_be_replayed_leaves_the_others(surge):
    mute = dataclasses.replace(
        without(surge[0], *(c for c in surge[0].channels if c.startswith(("rpm_", "tau_")))), name="mute"
    )
    result = replay([mute, surge[1]], FINSROV)
    assert [pair.name for pair in result.pairs] == [surge[1].name]
    assert len(result.left_out) == 1 and result.left_out[0].subject == "mute"
    with pytest.raises(CalibrationError, match="no trial could be replayed: mute"):
        replay([mute], FINSROV)
