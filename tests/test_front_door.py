"""The functions that `finssim` exports: a study in a script or notebook, with objects and without printed output."""

import subprocess
import sys

import numpy as np
import pytest

import finssim as fs
from finssim.evaluation.evaluate import EvaluationError
from finssim.sim import SimulatorError
from finssim.trials.findings import CalibrationError
from finssim.vehicles.part import VehicleError
from reference.cases import EVERY_VEHICLE_AND_MODEL, load, plain, random_states
from reference.motion import acceleration as reference_acceleration
from reference.motion import numbers

EPS = float(np.finfo(np.float32).eps)


@pytest.mark.slow
def test_importing_the_package_is_cheap_and_every_name_is_there():
    """`import finssim` imports neither NumPy nor Warp; all exported names are listed and usable."""
    code = "import sys, finssim; print(sorted({'numpy', 'warp', 'torch', 'scipy'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    for name in fs.__all__:
        assert getattr(fs, name) is not None and name in dir(fs)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = fs.nothing


# -- the model --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@EVERY_VEHICLE_AND_MODEL
def test_acceleration_is_that_of_the_reference(name, model):
    """nu_dot equals that of an independent float64 implementation in random states, to float32 rounding.

    The hull is compared by its matrices; fins and further terms have their own tests.
    """
    vehicle, rng = plain(load(name)), np.random.default_rng(5)
    length = max(vehicle.body.size)
    position, q, nu = (x.astype(float) for x in random_states(rng, 300, depth=(-6.0 * length, length)))
    tau = rng.normal(size=(300, 6)) * np.diag(vehicle.mass_matrix(model))
    expected, size = reference_acceleration(numbers(vehicle, model), model, position, q, nu, tau)
    found = fs.acceleration(vehicle, np.concatenate([position, q], -1), nu, tau, hydrodynamics=model)
    assert (np.abs(found - expected) / (EPS * size)).max() < (60.0 if model == "mesh" else 20.0)


def test_attitude_may_be_angles_and_axes_broadcast():
    """Roll, pitch and yaw give the same result as their quaternion; one state and many wrenches give many rows."""
    rpy = fs.acceleration("bluerov2", [0, 0, -3, 0.2, -0.1, 1.0], np.zeros(6))
    half = np.array([0.2, -0.1, 1.0]) / 2.0
    (c, s) = np.cos(half), np.sin(half)
    q = [
        s[0] * c[1] * c[2] - c[0] * s[1] * s[2],
        c[0] * s[1] * c[2] + s[0] * c[1] * s[2],
        c[0] * c[1] * s[2] - s[0] * s[1] * c[2],
        c[0] * c[1] * c[2] + s[0] * s[1] * s[2],
    ]
    np.testing.assert_allclose(
        fs.acceleration("bluerov2", [0, 0, -3, *q], np.zeros(6)), rpy, rtol=0, atol=1e-5
    )
    many = fs.acceleration("bluerov2", np.zeros((4, 1, 6)), np.zeros(6), np.zeros((3, 6)))
    assert many.shape == (4, 3, 6) and many.dtype == np.float64


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (([0, 0, 0], np.zeros(6)), r"eta has shape \(3,\), expected \(..., 6\) or \(..., 7\)"),
        ((np.zeros(6), np.zeros(5)), r"nu has shape \(5,\), expected \(..., 6\)"),
        ((np.zeros(6), [np.nan] * 6), "nu has a number that is not finite"),
        ((np.zeros(7), np.zeros(6)), "quaternion of length 0"),
        ((np.zeros((2, 6)), np.zeros((3, 6))), "do not broadcast"),
    ],
)
def test_states_that_make_no_sense_are_refused(arguments, said):
    with pytest.raises(SimulatorError, match=said):
        fs.acceleration("bluerov2", *arguments)
    with pytest.raises(SimulatorError, match="unknown hydrodynamic model 'measured'"):
        fs.acceleration("bluerov2", np.zeros(6), np.zeros(6), hydrodynamics="measured")


# -- the simulator ----------------------------------------------------------------------------------------------------


def test_a_wrench_within_reach_is_met_and_one_beyond_keeps_the_limits():
    """B f = tau holds to a relative 1e-4 where the thrusters can reach it; no thrust ever exceeds its limits."""
    vehicle = fs.load_vehicle("bluerov2_heavy")
    six = fs.load_vehicle("bluerov2").replace({"water.gravity": vehicle.water.gravity})
    simulator = fs.Simulator([vehicle, six], worlds=3)
    wanted = np.array([10.0, -5.0, 3.0, 0.1, -0.2, 0.5])
    simulator.set_wrench(wanted)
    sent = simulator.command.thrust.numpy()
    np.testing.assert_allclose(sent[:, 0] @ vehicle.control_matrix.T, np.tile(wanted, (3, 1)), atol=2e-3)
    assert np.all(sent[:, 1, 6:] == 0.0), "the second vehicle has six thrusters"
    simulator.set_wrench(np.full((3, 1, 6), 1e4))
    lower, upper = vehicle.force_limits
    sent = simulator.command.thrust.numpy()[:, 0]
    assert np.all(sent >= lower) and np.all(sent <= upper)
    with pytest.raises(SimulatorError, match="wrench command has shape"):
        simulator.set_wrench(np.zeros(5))
    with pytest.raises(SimulatorError, match="not finite"):
        simulator.set_wrench([np.nan] * 6)


def test_pulses_give_the_thrust_of_the_speed_controller():
    """A neutral pulse gives no thrust, a full one the force of the curve at that speed; the voltage has an effect."""
    vehicle = fs.load_vehicle("bluerov2")
    simulator = fs.Simulator(vehicle, worlds=2)
    simulator.set_pwm(np.full((2, 1, 6), 1500.0) + np.array([0.0, 300.0])[:, None, None])
    sent = simulator.command.thrust.numpy()[:, 0, :6].copy()
    assert np.all(sent[0] == 0.0)
    expected = [t.thrust(t.shaft_speed(1800.0)) for t in vehicle.thrusters.values()]
    np.testing.assert_allclose(sent[1], expected, rtol=1e-6)
    simulator.set_pwm([1800.0] * 6, voltage=12.0)
    assert np.all(np.abs(simulator.command.thrust.numpy()[1, 0, :6]) < np.abs(sent[1]))
    with pytest.raises(VehicleError, match="no 'esc' section"):
        fs.Simulator("remus100").set_pwm([1600.0] * len(fs.load_vehicle("remus100").thrusters))


# -- trials -----------------------------------------------------------------------------------------------------------


def frame():
    t = np.arange(0.0, 10.0, 0.05)
    return {"t": 1e3 * t, "speed": 100 * np.sin(t), "depth": 150 + 10 * t, "force_T1": np.cos(t), "note": t}


def test_a_trial_is_made_of_a_frame_with_its_units_and_axes():
    """Columns, units and axes are converted; unused columns are a finding; a mapping works like a DataFrame."""
    import pandas as pd

    columns = {"v": "speed", "depth": "depth", "force_T1": "force_T1"}
    options = {"units": {"t": "ms", "v": "cm/s", "depth": "cm"}, "axes": "FRD", "vehicle": "bluerov2"}
    trial = fs.Trial.from_frame(pd.DataFrame(frame()), columns=columns, name="dive", **options)
    np.testing.assert_allclose(trial.t, np.arange(0.0, 10.0, 0.05), atol=1e-9)
    np.testing.assert_allclose(trial.channels["v"], -np.sin(trial.t), atol=1e-12)  # left, not right
    np.testing.assert_allclose(trial.channels["depth"], 1.5 + 0.1 * trial.t)
    assert trial.name == "dive" and trial.header.vehicle == "bluerov2"
    assert [(one.code, one.values["items"]) for one in trial.findings] == [("not_read", "columns note")]
    assert fs.Trial.from_frame(frame(), columns=columns, **options).sha256 == trial.sha256


def test_times_may_be_the_index_and_dates():
    import pandas as pd

    values = {"u": np.linspace(0.0, 1.0, 50), "force_T1": np.ones(50)}
    dates = pd.date_range("2026-05-01 12:00", periods=50, freq="100ms")
    trial = fs.Trial.from_frame(pd.DataFrame(values, index=dates), units={"t": "date"})
    np.testing.assert_allclose(trial.t, 0.1 * np.arange(50), atol=1e-6)
    named = pd.DataFrame(values, index=pd.Index(0.1 * np.arange(50), name="t"))
    np.testing.assert_allclose(fs.Trial.from_frame(named).t, 0.1 * np.arange(50), atol=1e-9)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"time": "clock"}, "no column 'clock' with the times; its columns are t, speed"),
        ({"columns": {"u": "sped"}}, "no column 'sped', did you mean 'speed'"),
        ({"columns": {"uu": "speed"}}, "names 'uu', did you mean 'u'"),
        ({"columns": {"speed": "u"}}, "a trial's column first and the frame's second: write {'u': 'speed'}"),
        ({"units": {"speed": "m"}}, "units names 'speed'"),
        (
            {"columns": {"u": "speed"}, "units": {"speed": "m/s"}},
            "units names 'speed', the frame's name of 'u': write 'u'",
        ),
        ({"units": {"depth": "kg"}}, "invalid unit"),
        ({"units": {"t": "fortnight"}}, "is 'fortnight', expected one of s, ms"),
        ({"axes": "NWU"}, "is 'NWU', expected FLU, FRD"),
        ({"vehicl": "bluerov2"}, r"unknown key 'vehicl', did you mean 'vehicle'\? known keys: vehicle, axis"),
        ({"name": "../dive"}, "name of the trial '../dive'"),
    ],
)
def test_what_a_frame_does_not_say_is_refused(change, said):
    with pytest.raises(CalibrationError, match=said):
        fs.Trial.from_frame(frame(), **change)


def test_what_is_no_table_is_refused():
    with pytest.raises(CalibrationError, match="a list, expected a pandas DataFrame or a mapping"):
        fs.Trial.from_frame([1, 2])
    with pytest.raises(CalibrationError, match="expected one-dimensional ones of equal length"):
        fs.Trial.from_frame({"t": np.arange(5.0), "u": np.arange(4.0)})
    import pandas as pd

    with pytest.raises(CalibrationError, match="column 'u' occurs twice"):
        fs.Trial.from_frame(pd.DataFrame(np.zeros((5, 3)), columns=["t", "u", "u"]))


@pytest.mark.parametrize(("unit", "n"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_times_that_are_not_in_seconds_are_refused_with_their_unit(unit, n):
    """The remedy works: the same table with this unit is a trial."""
    table = {"t": n * 0.05 * np.arange(50), "u": np.linspace(0.0, 1.0, 50)}
    with pytest.raises(CalibrationError, match=rf"are in {unit}, .*units={{'t': '{unit}'}}"):
        fs.Trial.from_frame(table)
    assert fs.Trial.from_frame(table, units={"t": unit}).duration == pytest.approx(2.45)


def test_a_fit_without_trials_and_one_axis_by_name():
    with pytest.raises(CalibrationError, match="no trials were given"):
        fs.identify("finsrov", [])
    trial = fs.Trial.from_frame({"t": 0.05 * np.arange(50), "u": np.ones(50), "tau_x": np.ones(50)})
    with pytest.raises(CalibrationError, match="unknown axis 'yow'"):
        fs.identify("finsrov", trial, axes="yow")


# -- a study ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_study_from_trials_to_the_pool(capfd, tmp_path):
    """Each step takes the result of the previous step; nothing is printed on standard output."""
    from finssim.identification.programme import programmes
    from finssim.identification.synthetic import simulate_programme

    truth = fs.load_vehicle("finsrov").replace({"hydrodynamics.calibrated.linear_damping.5.5": 1.2})
    trials = simulate_programme(programmes(["yaw"], truth)[::3], truth, inputs=("rpm",))
    fit = fs.identify("finsrov", trials, axes=["yaw"])
    assert fit.vehicle.calibrations and fit.before.name == fit.vehicle.name == "finsrov"
    low, high = fit.intervals["yaw.m_eff"]
    inertia = truth.mass_matrix("calibrated")[5, 5]
    assert low < inertia < high or fit.estimates["yaw.m_eff"].estimate == pytest.approx(inertia, rel=0.02)
    assert fit.plot().axes
    policy = fs.train("t1", vehicle=fit.vehicle, seed=1, steps=20_000, worlds=64)
    assert policy.folder.is_dir()
    result = fs.evaluate(policy)
    assert result.metrics["trials"] == 8 and "P01" in str(result.table) and result.plot().axes
    assert policy.save(tmp_path / "policy").joinpath("policy.onnx").is_file()
    with pytest.raises(EvaluationError, match="not in the catalogue: pass it as vehicle="):
        fs.evaluate(fs.Policy.load(tmp_path / "policy"))
    folder = policy.folder
    del policy
    assert not folder.exists()
    run = fs.run_in_pool("pid", vehicle=fit.vehicle, plant=2, targets=["P01"], duration=20.0)
    assert run.metrics["trials"] == 1 and run.each[0].trials[0].motion.t[-1] == pytest.approx(20.0, abs=0.2)
    assert "<table>" in run._repr_html_()
    assert capfd.readouterr().out == ""


def test_a_task_without_a_figure_and_one_that_is_not_for_the_pool_are_refused():
    with pytest.raises(EvaluationError, match="run_in_pool plays t1, t2, but the task is 'docking'"):
        fs.run_in_pool("pid", "docking")
    with pytest.raises(EvaluationError, match="unknown firmware 'px4'; available: mcu, ardusub"):
        fs.run_in_pool("pid", vehicle="bluerov2_heavy", firmware="px4")
    with pytest.raises(EvaluationError, match="unknown site 'lake'"):
        fs.run_in_pool("pid", site="lake")
    with pytest.raises(EvaluationError, match="unknown setpoint 'P99'; available: P01, P02"):
        fs.run_in_pool("pid", targets=["P99"])
