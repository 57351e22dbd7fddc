"""From logs as users record them to a vehicle file that replays other trials better than the catalogue's."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from finssim.identification.estimates import trim
from finssim.identification.fit import Estimate
from finssim.identification.hydrodynamics import fit_hydrodynamics, judged
from finssim.identification.prediction import replay
from finssim.identification.programme import programmes
from finssim.identification.replay_report import _remarks
from finssim.identification.report import fit_report
from finssim.identification.synthetic import simulate_programme
from finssim.identification.vehicle_file import calibrated
from finssim.trials.check import check_trials
from finssim.trials.findings import CalibrationError
from finssim.trials.importers.dispatch import read_trials
from finssim.vehicles import AXES, load_vehicle
from identification.made_fits import made_fit

DATA = Path(__file__).parents[1] / "data" / "standins"
DOCS = Path(__file__).parents[2] / "docs" / "reference" / "trial_format.md"


def read(pattern, name, folder, tmp):
    """Return the trials of a set, read with the map of this name on the page on trials."""
    block = DOCS.read_text(encoding="utf-8").split(f"# {name}\n", 1)[1].split("```", 1)[0]
    (tmp / name).write_text(block)
    files = sorted(path for p in pattern for path in (DATA / folder).glob(p))
    return read_trials(files, column_map=tmp / name)


def scores(vehicle, trials, **options):
    """Return the NRMSE by axis, as the median over the trials."""
    return replay(trials, vehicle, **options).aggregate("calibrated").by_axis


@pytest.fixture(scope="module")
def joystick(tmp_path_factory):
    """Trials to fit, and trials to replay."""
    tmp = tmp_path_factory.mktemp("map")
    held = [f"*_{level}.csv" for level in ("040", "060")]
    return read(["*_025.csv"], "joystick.yaml", "joystick_mocap", tmp), read(
        held, "joystick.yaml", "joystick_mocap", tmp
    )


@pytest.fixture(scope="module")
def by_sticks(joystick):
    """The fit of all axes."""
    fitted, held = joystick
    return fit_hydrodynamics(fitted, load_vehicle("bluerov2_heavy"), held_out=held)


@pytest.mark.slow
def test_sticks_and_motion_capture_at_5_hz(joystick, by_sticks):
    """A fit at a quarter of the sticks' range replays twice that below 0.04, better than the catalogue."""
    vehicle, fit, (_, held) = load_vehicle("bluerov2_heavy"), by_sticks, joystick
    found, before = scores(calibrated(fit), held), scores(vehicle, held)
    assert max(found[axis] for axis in ("surge", "sway", "yaw", "heave")) < 0.04, found
    assert len(fit.curves) == 6 and all("held-out trials" in curve.title for curve in fit.curves)
    assert found.keys() == before.keys() > {"roll", "pitch"}
    assert all(found[axis] < 0.8 * before[axis] for axis in found), (found, before)
    scale = fit.estimates["thrust_scale"]
    assert scale.ci95[0] < scale.estimate < scale.ci95[1] and scale.ci95[1] > 1.5 * scale.ci95[0]
    mass = fit.estimates["surge.m_eff"]
    assert mass.ci95[1] - mass.ci95[0] > 0.4 * mass.estimate and not mass.identifiable
    assert "voltage_unknown" in {one.code for one in fit.findings}


@pytest.mark.slow
def test_a_known_voltage_leaves_the_thrust_alone(joystick):
    """With the voltage in the header no scale is estimated, and the masses are more certain."""
    fitted, held = joystick
    vehicle = load_vehicle("bluerov2_heavy")
    told = [replace(t, header=t.header.model_copy(update={"voltage": 15.0})) for t in fitted]
    fit = fit_hydrodynamics(told, vehicle, axes=["yaw"], held_out=held)
    assert "thrust_scale" not in fit.estimates
    assert fit.estimates["yaw.m_eff"].identifiable


@pytest.mark.slow
def test_pulses_and_an_imu_without_any_velocity(tmp_path):
    """Gyro, attitude and depth alone predict roll, pitch, yaw three seconds ahead, and a yaw trial of a
    higher level."""
    vehicle = load_vehicle("bluerov2")
    fitted = read(["yaw_020*", "yaw_035*", "mixed_035*", "heave_050*"], "pulses.yaml", "pulses_imu", tmp_path)
    held = read(["yaw_050*", "mixed_050*"], "pulses.yaml", "pulses_imu", tmp_path)
    reports = check_trials(fitted, vehicle)
    for report in reports:
        assert {"heading_drift", "inputs_zero_after"} <= {one.code for one in report.findings}, (
            report.findings
        )
    fit = fit_hydrodynamics(fitted, vehicle, held_out=held)
    assert "not_converged" not in {one.code for one in fit.findings}
    moves = {"mixed_050": ("heave", "roll", "pitch", "yaw"), "yaw_050": ("yaw",)}
    held = [replace(t, header=t.header.model_copy(update={"axis": moves[t.name]})) for t in held]
    result = replay(held, calibrated(fit), horizon=3.0)
    ahead = {axis: result.ahead[axis]["calibrated"].nrmse[-1] for axis in ("roll", "pitch", "yaw")}
    assert max(ahead.values()) < 0.15, ahead
    (yaw,) = (
        s["yaw"].value
        for p, s in zip(result.pairs, result.scores["calibrated"], strict=True)
        if p.name == "yaw_050"
    )
    assert yaw < 0.10


@pytest.mark.slow
def test_a_heading_that_decays(tmp_path):
    """Spun by hand with unknown inertia, a vehicle shows quadratic drag over inertia; an inertia scales it."""
    vehicle = load_vehicle("bluerov2")
    trials = read(["*.csv"], "decay.yaml", "yaw_decay", tmp_path)
    options = {"held_out": trials[:1]}  # a fit that replays worse is tested below
    fit = fit_hydrodynamics(trials, vehicle, **options)
    ratio = fit.estimates["yaw.d2/m_eff"]
    assert ratio.estimate == pytest.approx(0.775, rel=0.01) and ratio.ci95[0] < 0.775 < ratio.ci95[1]
    assert ratio.identifiable
    assert ratio.ci95[1] - ratio.ci95[0] < 0.05 * ratio.estimate
    assert scores(calibrated(fit), trials)["yaw"] < 0.02
    (curve,) = fit_hydrodynamics(trials, vehicle).curves
    assert curve.y_label == "yaw [rad]" and np.nanmax(np.abs(np.diff(curve.measured))) < 1.0
    assert any("yaw.m_eff (assumed" in sentence for sentence in fit_report(fit, calibrated(fit)).lead)
    linear = fit_hydrodynamics(trials, vehicle, damping="linear", **options)
    assert linear.estimates["yaw.d1/m_eff"].estimate > 0.1 and "yaw.d2/m_eff" not in linear.estimates
    assert fit.quality["yaw"]["rmse"] < 0.2 * linear.quality["yaw"]["rmse"]
    known = fit_hydrodynamics(trials, vehicle, known={"yaw": 0.5}, **options)
    assert known.estimates["yaw.d2"].estimate == pytest.approx(0.5 * ratio.estimate, rel=0.01)
    assert calibrated(known).mass_matrix()[5, 5] == pytest.approx(0.5, rel=1e-6)


@pytest.mark.slow
def test_a_fit_is_judged_by_what_was_not_fitted(tmp_path):
    """A fit is scored on segments left out or on held-out trials; the file keeps an axis that it predicts better."""
    vehicle = load_vehicle("bluerov2")
    slow = read(["spin_[1-3].csv"], "decay.yaml", "yaw_decay", tmp_path)
    words = []
    told = lambda part, text: words.append((part, text))  # noqa: E731
    fit = fit_hydrodynamics(slow, vehicle, progress=told)
    assert not {"replays_worse"} & {one.code for one in fit.findings}
    assert words[0][0] <= words[-1][0] <= 1.0 and any("validating" in text for _, text in words)
    figures = fit.quality["yaw"]
    assert 0.0 < figures["held_out"] < 0.3 * figures["file"]
    (drag,) = (path for path in fit.changes if "quadratic_damping" in path)
    bad = replace(fit, changes={**fit.changes, drag: 5.0})
    kept = judged(bad, slow)
    assert not any("damping" in path for path in kept.changes)
    assert calibrated(kept).hydrodynamics == vehicle.hydrodynamics
    (said,) = (one for one in kept.findings if one.code == "replays_worse")
    assert said.subject == "yaw" and said.values["after"] > said.values["before"]
    assert not kept.estimates["yaw.d2"].identifiable
    wild = replace(fit, changes={**fit.changes, drag: 500.0})  # no replay stays finite
    assert drag not in judged(wild, slow).changes
    assert judged(fit, slow).changes == fit.changes


@pytest.mark.slow
def test_an_axis_of_the_file_goes_with_the_scale_of_thrust(by_sticks):
    """Thrust scaled by s with s times mass and drag moves as the file does; the other axes keep their values."""
    quality = by_sticks.quality | {"surge": by_sticks.quality["surge"] | {"held_out": 1.0, "file": 0.9}}
    fit = judged(replace(by_sticks, quality=quality))
    before, after, scale = fit.before, calibrated(fit), fit.estimates["thrust_scale"].estimate
    old, new = (v.hydrodynamic_set("calibrated") for v in (before, after))
    assert new.quadratic_damping[0, 0] == pytest.approx(scale * old.quadratic_damping[0, 0], rel=1e-6)
    whole = max(scale * before.mass_matrix()[0, 0], before.body.mass)
    assert after.mass_matrix()[0, 0] == pytest.approx(whole, rel=1e-6)
    other = calibrated(by_sticks).hydrodynamic_set("calibrated")
    assert new.quadratic_damping[1, 1] == other.quadratic_damping[1, 1]


@pytest.mark.slow
def test_places_that_the_file_has_wrong_are_found(by_sticks):
    """Thrusters that are too low in the file are moved, so that roll and pitch do not come out twice as large."""
    height = by_sticks.estimates["thruster_height"]
    assert height.identifiable and height.ci95[0] < -0.048 < height.ci95[1] < -0.0725 + 0.04
    said = {one.subject: one for one in by_sticks.findings if one.code == "place_contradicted"}
    assert said["height of T1, T2, T3, T4"].values["file"] == -0.0725
    vehicle = calibrated(by_sticks)
    for name, thruster in vehicle.thrusters.items():
        expected = height.estimate if name in ("T1", "T2", "T3", "T4") else 0.0
        assert thruster.position[2] == pytest.approx(expected, rel=1e-6)
    (b, g), k = (
        (vehicle.body.center_of_buoyancy[2], vehicle.body.center_of_gravity[2]),
        by_sticks.estimates["pitch.k"],
    )
    assert vehicle.buoyancy * b - vehicle.weight * g == pytest.approx(k.estimate, rel=1e-5)


@pytest.mark.slow
def test_a_known_inertia_tells_the_thrust(joystick, by_sticks):
    """With yaw's inertia given, the scale follows from the motion, and is more certain than batteries allow."""
    fitted, held = joystick
    ratio = by_sticks.estimates["yaw.m_eff"].estimate / by_sticks.estimates["thrust_scale"].estimate
    vehicle = load_vehicle("bluerov2_heavy")
    fit = fit_hydrodynamics(fitted, vehicle, axes=["yaw"], known={"yaw": 0.9}, held_out=held)
    scale = fit.estimates["thrust_scale"]
    assert scale.estimate == pytest.approx(0.9 / ratio, rel=0.03)
    assert scale.ci95[1] < 1.2 * scale.ci95[0]
    assert fit.estimates["yaw.m_eff"].ci95 == (0.9, 0.9)


@pytest.mark.slow
def test_published_numbers_are_data(joystick, by_sticks):
    """A bollard pull makes the thrust more certain and draws it towards the pull; a replay at twice the speed is
    reported as extrapolation; a top speed without surge and a pull where the thrust is known are refused."""
    fitted, held = joystick
    vehicle = load_vehicle("bluerov2_heavy")
    before, pull = by_sticks.estimates["thrust_scale"], 0.8 * float(vehicle.wrench_limits[0])
    fit = fit_hydrodynamics(
        fitted, vehicle, published={"bollard_pull": pull, "top_speed": 1.25}, held_out=held
    )
    after = fit.estimates["thrust_scale"]
    assert before.estimate < after.estimate < 0.8
    assert np.diff(after.ci95)[0] < 0.9 * np.diff(before.ci95)[0]
    assert fit.settings["published"] == {"bollard_pull": pull, "top_speed": 1.25}
    said = " ".join(_remarks(replay([t for t in held if t.name == "surge_060"], calibrated(fit))))
    assert "surge reaches 0.79 m/s, the fitted trials reach 0.4" in said and "extrapolated" in said
    yaw = [t for t in fitted if t.name.startswith("yaw")]
    told = [replace(t, header=t.header.model_copy(update={"voltage": 15.0})) for t in yaw]
    with pytest.raises(CalibrationError, match="but the fitted axes are yaw"):
        fit_hydrodynamics(yaw, vehicle, axes=["yaw"], published={"top_speed": 1.0})
    with pytest.raises(CalibrationError, match="a bollard pull shows the thrust"):
        fit_hydrodynamics(told, vehicle, axes=["yaw"], published={"bollard_pull": pull})


def test_a_vehicle_that_lies_tilted_keeps_its_tilt():
    """The centre of buoyancy that follows from constant roll and pitch moments gives the same tilt as they do."""
    k, buoyancy, tilts = 2.0, 110.0, {"roll.bias": 0.2, "pitch.bias": -0.3}
    found = {
        name: Estimate(name=name, estimate=b, ci95=(b - 0.1, b + 0.1), unit="N m", identifiable=True)
        for name, b in tilts.items()
    }
    moved = trim(found, buoyancy, (0.01, 0.0, 0.05))
    arm = buoyancy * np.array(
        [moved["body.center_of_buoyancy.0"] - 0.01, moved["body.center_of_buoyancy.1"], k / buoyancy]
    )
    # Level: the moment that b subtracts on the left side of the equation.
    moment = np.cross(arm, [0.0, 0.0, 1.0])
    np.testing.assert_allclose(moment[:2], [-tilts["roll.bias"], -tilts["pitch.bias"]], atol=1e-12)
    unsure = {"roll.bias": replace(found["roll.bias"], ci95=(-0.1, 0.5))}
    assert trim(unsure, buoyancy, (0.0, 0.0, 0.05)) == {}


@pytest.mark.parametrize("lead", [0.0, 0.1])
def test_a_replay_allows_for_two_clocks(lead):
    """Motion stamped a tenth of a second early is reported, and the score is that of one clock."""
    vehicle = load_vehicle("bluerov2_heavy")
    (trial,) = simulate_programme(programmes("yaw", vehicle)[:1], vehicle, seed=2, inputs=("command",))
    n = round(lead * 50)
    channels = {c: v[: len(v) - n] if c.startswith("command") else v[n:] for c, v in trial.channels.items()}
    moved = replace(trial, t=trial.t[: len(trial.t) - n], channels=channels, phase=None)
    result = replay([moved], vehicle)
    assert result.pairs[0].late.get("calibrated", 0.0) == pytest.approx(-lead, abs=0.011)
    assert result.scores["calibrated"][0]["yaw"].value < 0.03


@pytest.mark.slow
def test_unequal_thrusters_are_found_in_a_slow_log():
    """In steps at 5 Hz with thrusters up to 6 % off, each gain is in its interval of ±1.5 %, and in the file."""
    vehicle, axes = load_vehicle("bluerov2_heavy"), ("surge", "sway", "heave", "yaw")
    gains = np.array([1.06, 0.95, 1.0, 0.97, 1.03, 0.98, 1.05, 0.96])
    levels = {a: [part * vehicle.wrench_limits[AXES.index(a)] for part in (0.12, 0.25)] for a in axes}
    plan = [p for p in programmes(axes, vehicle, levels=levels) if "dive" not in p.name]
    trials = simulate_programme(
        plan, vehicle, seed=3, plant={"gain": gains}, rate=5.0, inputs=("pwm",),
        columns=("u", "v", "w", "p", "q", "r", "qx", "qy", "qz", "qw"),
    )  # fmt: skip
    told = {"axis": (), "description": "", "voltage": 16.0}
    fit = fit_hydrodynamics([replace(t, header=t.header.model_copy(update=told)) for t in trials], vehicle)
    assert "thrust_scale" not in fit.estimates
    after = calibrated(fit)
    for (name, thruster), gain in zip(vehicle.thrusters.items(), gains, strict=True):
        found = fit.estimates[f"gain.{name}"]
        assert found.ci95[0] < gain < found.ci95[1] < found.ci95[0] + 0.03 and found.identifiable
        assert after.thrusters[name].c_plus == pytest.approx(found.estimate * thruster.c_plus, rel=1e-6)
    true = vehicle.hydrodynamic_set("calibrated")
    assert after.hydrodynamic_set("calibrated").quadratic_damping[5, 5] == pytest.approx(
        true.quadratic_damping[5, 5], rel=0.02
    )
    assert np.abs(np.subtract(after.body.center_of_gravity, vehicle.body.center_of_gravity)).max() < 0.002


def test_couplings_of_an_axis_of_the_file_stay_symmetric():
    """If sway keeps the file's values, its coupling with yaw follows yaw's alone, in both rows."""
    vehicle, path = load_vehicle("remus100"), "hydrodynamics.calibrated.added_mass"
    own = vehicle.hydrodynamic_set("calibrated").added_mass
    new = {
        f"{path}.1.1": 2.0 * own[1][1],
        f"{path}.5.5": 4.0 * own[5][5],
        **{f"{path}.{i}.{j}": np.sqrt(8.0) * own[i][j] for i, j in ((1, 5), (5, 1))},
    }
    quality = {"sway": {"held_out": 1.0, "file": 0.5}, "yaw": {"held_out": 0.5, "file": 1.0}}
    kept = judged(made_fit(vehicle, changes=new, quality=quality))
    twice = {f"{path}.{i}.{j}": 2.0 * own[i][j] for i, j in ((1, 5), (5, 1))}
    assert kept.changes == pytest.approx({f"{path}.5.5": 4.0 * own[5][5], **twice})
    assert calibrated(kept).hydrodynamic_set("calibrated").added_mass[1][5] == pytest.approx(2.0 * own[1][5])
