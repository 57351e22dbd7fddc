"""Recorded inputs of any kind become the wrench that acted, or are refused with what is missing."""

import numpy as np
import pytest

from finssim.trials.findings import CalibrationError
from finssim.trials.inputs import applied_wrench, drive, implausible, require_fittable
from finssim.trials.trial import Header, Trial
from finssim.vehicles import Vehicle, load_vehicle

FINSROV = load_vehicle("finsrov")
RPM = 60.0 / (2.0 * np.pi)


def trial(channels, t=None, **header):
    """Return a trial of these columns."""
    n = len(next(iter(channels.values())))
    t = np.arange(n) * 0.02 if t is None else t
    return Trial(
        name="made",
        t=t,
        channels={k: np.asarray(v, float) for k, v in channels.items()},
        header=Header(**header),
    )


def forces(vehicle, n=40, seed=0):
    """Return smooth thrusts within the limits, (n, k)."""
    rng = np.random.default_rng(seed)
    k = len(vehicle.thrusters)
    phase, rate = rng.uniform(0.0, 6.0, k), rng.uniform(1.0, 3.0, k)
    return 0.5 * np.sin(np.arange(n)[:, None] * 0.02 * rate + phase) * vehicle.force_limits[1]


def propelled(name):
    """Return a vehicle with its thrusters alone."""
    return load_vehicle(name).model_copy(update={"actuators": {}})


@pytest.fixture(params=["finsrov", "bluerov2", "bluerov2_heavy", "lauv"])
def vehicle(request):
    """Vehicles of one, six and eight thrusters."""
    return propelled(request.param)


@pytest.mark.parametrize("kind", ["rpm", "force", "tau_cog", "tau_origin", "tau_point"])
def test_one_wrench_from_every_kind_of_input(vehicle, kind):
    """Shaft speeds, forces and wrenches about any point that describe the same thrusts give B f about the origin."""
    f = forces(vehicle)
    expected = f @ vehicle.thruster_matrix().T
    header, names = {}, vehicle.thruster_names
    if kind == "force":
        channels = {f"force_{name}": f[:, i] for i, name in enumerate(names)}
    elif kind == "rpm":
        omega = [vehicle.thrusters[name].speed(f[:, i]) for i, name in enumerate(names)]
        channels = {f"rpm_{name}": omega[i] * RPM for i, name in enumerate(names)}
    else:
        point = {
            "tau_cog": vehicle.body.center_of_gravity,
            "tau_origin": np.zeros(3),
            "tau_point": (0.3, -0.1, 0.2),
        }[kind]
        header = {
            "wrench_at": {
                "tau_cog": "center_of_gravity",
                "tau_origin": "origin",
                "tau_point": (0.3, -0.1, 0.2),
            }[kind]
        }
        tau = f @ vehicle.thruster_matrix(point).T
        channels = {f"tau_{axis}": tau[:, i] for i, axis in enumerate("xyzkmn")}
    made = trial(channels, **header)
    found = drive(made, vehicle)
    assert not found.commanded and found.thrusters == (not kind.startswith("tau"))
    np.testing.assert_allclose(applied_wrench(found, vehicle, made.t), expected, atol=1e-9)


def test_moments_are_about_the_wrench_reference_unless_said_otherwise():
    """A force along x through a point 0.08 m below the origin gives a pitch moment of -0.08 m times the
    force."""
    vehicle = load_vehicle("finsrov")
    height = float(vehicle.wrench_reference[2])
    assert height < 0.0
    tau = applied_wrench(drive(trial({"tau_x": [5.0, 5.0]}), vehicle), vehicle, np.array([0.0, 0.02]))
    np.testing.assert_allclose(tau, [[5.0, 0.0, 0.0, 0.0, height * 5.0, 0.0]] * 2)


def test_axes_of_a_wrench_without_a_column_are_zero_and_it_is_said():
    """A surge trial may log tau_x alone."""
    vehicle = load_vehicle("finsrov")
    found = drive(trial({"tau_x": [1.0, 2.0]}), vehicle)
    np.testing.assert_array_equal(found.force, [[1, 0, 0, 0, 0, 0], [2, 0, 0, 0, 0, 0]])
    assert found.findings[0].values["columns"] == ("tau_y", "tau_z", "tau_k", "tau_m", "tau_n")


def test_what_tells_most_comes_first(vehicle):
    """Order: shaft speeds, forces, a wrench, commands; a kind that covers only some thrusters is skipped."""
    names = vehicle.thruster_names
    channels = {f"command_{name}": np.ones(5) for name in names} | {"tau_x": np.full(5, 3.0)}
    assert drive(trial(channels), vehicle).source == "tau"
    channels |= {f"force_{name}": np.ones(5) for name in names}
    assert drive(trial(channels), vehicle).source == "force"
    channels |= {f"rpm_{names[0]}": np.ones(5)}
    found = drive(trial(channels), vehicle)
    assert found.source == ("rpm" if len(names) == 1 else "force")
    assert len(names) == 1 or found.findings[0].values["kind"] == "rpm_"


def test_commands_pass_the_motors_and_forces_do_not(vehicle):
    """`inputs` decides: commands act after delay and lag."""
    n = len(vehicle.thrusters)
    step = np.where(np.arange(100)[:, None] >= 20, 0.5 * vehicle.force_limits[1], 0.0)
    channels = {f"command_{name}": step[:, i] for i, name in enumerate(vehicle.thruster_names)}
    asked, acted = (drive(trial(channels, inputs=i), vehicle) for i in (None, "applied"))
    assert asked.commanded and not acted.commanded
    t = np.arange(100) * 0.02
    late, now = (applied_wrench(d, vehicle, t) for d in (asked, acted))
    np.testing.assert_allclose(now, step @ vehicle.thruster_matrix().T, atol=1e-9)
    axis = int(np.argmax(np.abs(now[-1])))
    thruster = next(iter(vehicle.thrusters.values()))
    part = late[20:, axis] / now[-1, axis]
    since = np.maximum(t[20:] - t[20] - thruster.delay, 0.0)
    lag = 1.0 - np.exp(-since / thruster.time_constant)
    np.testing.assert_allclose(part, lag**2 if thruster.domain == "speed" else lag, atol=1e-6 * n)


def test_pulse_widths_become_forces_through_the_speed_controller():
    """The pulse that gives a speed gives that speed's thrust; a higher battery voltage gives more."""
    vehicle = load_vehicle("bluerov2_heavy")
    if any(thruster.esc is None for thruster in vehicle.thrusters.values()):
        pytest.skip("the catalogue gives no speed controller")
    f = np.tile(np.linspace(-20.0, 20.0, 9)[:, None], 8)
    thrusters = vehicle.thrusters.values()
    pwm = [thruster.pulse(thruster.speed(f[:, i])) for i, thruster in enumerate(thrusters)]
    channels = {f"pwm_{name}": pwm[i] for i, name in enumerate(vehicle.thruster_names)}
    found = drive(trial(channels), vehicle)
    assert found.commanded and found.source == "pwm"
    np.testing.assert_allclose(found.force, f, atol=1e-6)
    strong = drive(trial(channels, voltage=20.0), vehicle).force
    by_column = drive(trial(channels | {"voltage": np.full(9, 20.0)}, voltage=10.0), vehicle).force
    assert strong[-1, 0] > 1.1 * f[-1, 0]
    np.testing.assert_allclose(by_column, strong)


def test_inputs_of_another_rate_are_held_or_go_straight():
    """A command is held until the next, a measured force is interpolated linearly; `inputs_between`
    overrides."""
    vehicle = propelled("lauv")
    name = vehicle.thruster_names[0]
    sparse = np.where(np.arange(21) % 10 == 0, np.arange(21) / 10.0, np.nan)
    middle = np.array([0.1])
    for column, header, expected in [
        ("command", {}, 0.0),
        ("force", {}, 0.5),
        ("force", {"inputs_between": "held"}, 0.0),
        ("command", {"inputs_between": "linear"}, 0.5),
    ]:
        found = drive(trial({f"{column}_{name}": sparse, "u": np.zeros(21)}, **header), vehicle)
        assert found.at(middle)[0, 0] == pytest.approx(expected)


def test_forces_of_thrusters_sampled_at_different_times_are_brought_together(vehicle):
    """Telemetry of several motor controllers never shares rows."""
    n, k = 200, len(vehicle.thrusters)
    f = forces(vehicle, n)
    rows = np.arange(n)
    channels = {
        f"force_{name}": np.where(rows % k == i, f[:, i], np.nan)
        for i, name in enumerate(vehicle.thruster_names)
    }
    found = drive(trial(channels), vehicle)
    inside = slice(k, n - k)
    t = np.arange(n) * 0.02
    scale = vehicle.force_limits[1]
    # Linear interpolation between samples k rows apart, of sines up to 3 rad/s: h² ω² / 8 of the amplitude.
    tolerance = (k * 0.02 * 3.0) ** 2 / 8.0
    np.testing.assert_allclose(found.at(t)[inside] / scale, f[inside] / scale, atol=tolerance)


def test_nothing_is_known_outside_the_inputs_or_in_their_gaps():
    """A measured force is not extrapolated; a command is held while the recording continues."""
    vehicle = propelled("lauv")
    name = vehicle.thruster_names[0]
    t = np.arange(300) * 0.02
    missing = ((t > 2.0) & (t < 4.0)) | (t < 0.5)
    for column, known_in_gap in (("force", False), ("command", True)):
        values = np.where(missing, np.nan, 1.0)
        made = trial({f"{column}_{name}": values, "u": np.zeros(300)}, t=t)
        tau = applied_wrench(drive(made, vehicle), vehicle, t)
        assert np.isnan(tau[t < 0.45]).all() and np.isfinite(tau[(t > 0.55) & (t < 2.0)]).all()
        assert np.isfinite(tau[t > 4.05]).all()
        assert np.isfinite(tau[(t > 2.2) & (t < 3.8)]).all() == known_in_gap
    stopped = (t < 2.0) | (t > 4.0)
    made = trial({f"command_{name}": np.ones(stopped.sum()), "u": np.zeros(stopped.sum())}, t=t[stopped])
    tau = applied_wrench(drive(made, vehicle), vehicle, t)
    assert np.isnan(tau[(t > 2.2) & (t < 3.8)]).all()


def test_a_passive_trial_needs_no_inputs():
    """With thrusters off the wrench is zero throughout, and six axes may take a disturbance."""
    vehicle = load_vehicle("bluerov2")
    made = trial({"p": np.zeros(5)}, passive=True)
    found = drive(made, vehicle)
    assert found.force.shape == (5, 6) and not found.commanded
    np.testing.assert_array_equal(applied_wrench(found, vehicle, made.t), np.zeros((5, 6)))


@pytest.mark.parametrize(
    ("channels", "said"),
    [
        ({"u": [0, 1]}, "no input columns, expected tau_x .* or write 'passive: true'"),
        (
            {"force_T1": [0, 1]},
            "force_T2, force_T3, force_T4, force_T5, force_T6 are missing, .* each of the 6 thrusters of bluerov2",
        ),
        ({"rpm_t1": [0, 1]}, "rpm_t1: bluerov2 has no thruster 't1', did you mean 'T1'"),
        ({"force_T9": [0, 1]}, "has no thruster 'T9'.* it has T1, T2"),
        (
            {f"pwm_T{i}": [1500, 1600] for i in range(1, 7)},
            "pwm_T1 needs an esc section .* 'finssim calibrate thruster'",
        ),
    ],
)
def test_inputs_that_cannot_be_used_are_refused_with_what_is_missing(channels, said):
    """The refusal is one sentence with the trial, the column and the remedy."""
    values = load_vehicle("bluerov2").values()
    for thruster in values["thrusters"].values():
        thruster.pop("esc", None)
    vehicle = Vehicle(**values, name="bluerov2")
    with pytest.raises(CalibrationError, match=said) as error:
        drive(trial(channels), vehicle)
    assert str(error.value).startswith("made: ") and "\n" not in str(error.value)


@pytest.mark.parametrize("rate", [5.0, 50.0])
def test_a_wrench_that_jumps_between_exact_levels_was_held(rate):
    """Steps set by a program act from their row on; the same steps after a motor, or with noise, are sampled."""
    t = np.arange(0.0, 6.0, 1.0 / rate)
    steps = np.where((t > 1.9) & (t < 3.9), 6.0, 0.0)
    lagged = np.where(t > 1.9, 6.0 * (1.0 - np.exp(-(t - 1.9) / 0.5)), 0.0)
    noisy = steps + np.random.default_rng(0).normal(0.0, 0.1, len(t))
    vehicle = load_vehicle("finsrov")

    def read(force, **header):
        channels = {"tau_x": force, "u": np.zeros(len(t))}
        return drive(Trial(name="a", t=t, channels=channels, header=Header(**header)), vehicle)

    assert read(steps).held and "inputs_held" in {one.code for one in read(steps).findings}
    assert not read(lagged).held
    assert not read(noisy).held
    assert not read(steps, inputs_between="linear").held


@pytest.mark.parametrize(
    "after, last, ends, pushes",
    [
        (None, 1700.0, 4.0, None),
        (None, 1500.0, 10.0, 0.0),
        ("held", 1700.0, 10.0, 1.0),
        ("zero", 1700.0, 10.0, 0.0),
    ],
)
def test_inputs_have_an_end(after, last, ends, pushes):
    """If a stream of pulses stops while the recording continues, it is unknown from there, or held or zero if the
    header says so; a last pulse without thrust is held."""
    vehicle = load_vehicle("bluerov2")
    t = np.arange(0.0, 10.0, 0.1)
    pulses = np.where(t < 2.0, 1500.0, 1700.0)
    pulses[t >= 3.5] = last
    pulses[t >= 4.0] = np.nan
    channels = {f"pwm_{name}": pulses for name in vehicle.thruster_names} | {"r": np.sin(t)}
    found = drive(trial(channels, t, **({} if after is None else {"inputs_after": after})), vehicle)
    assert found.spans[-1, 1] == pytest.approx(ends, abs=0.15)
    assert (found.end is None) == (ends > 5.0)
    tau = applied_wrench(found, vehicle, t)
    assert np.isfinite(tau[t < 3.9]).all()
    if pushes is None:
        assert np.isnan(tau[t > 4.2]).all()
    else:
        assert (np.abs(tau[t > 4.5]).max() > 1.0) == bool(pushes)


def test_pulses_in_another_unit_are_not_fitted():
    """Tested with normalised values and ms taken for µs; a column of zeros, which a disarmed autopilot logs,
    is no input."""
    t = np.linspace(0.0, 4.0, 40)
    for scale, wrong in ((1.0, False), (1e-3, True), (0.0, False)):
        made = trial(
            {"pwm_T1": scale * (1500.0 + 100.0 * np.sin(t)), "pwm_T2": 0.0 * t, "u": 0.1 * np.sin(t)}, t
        )
        assert [one.code for one in implausible(made)] == (["pulse_unit"] if wrong else [])
    normalised = trial({"pwm_T1": np.sin(t), "u": 0.1 * np.sin(t)}, t)
    assert "pwm_T1 are -0.7568 to 0.9995 µs" in implausible(normalised)[0].text


@pytest.mark.parametrize(
    ("speed", "passive", "code"),
    [
        (0.3, False, None),
        (300.0, True, "speed_unit"),
        (5.0, False, "speed_beyond"),
        (2.5, False, "energy"),
        (5.0, True, None),
    ],
)
def test_what_no_vehicle_can_have_done_is_not_fitted(speed, passive, code):
    """mm/s taken for m/s; five times the terminal speed; energy that thrust of 1 N over 0.8 s cannot give to
    12 kg."""
    slow = np.full(40, 0.0)
    given = {"tau_x": slow + 1.0} if not passive else {}
    made = trial({"u": np.linspace(0.0, speed, 40), "v": slow, "w": slow, **given}, passive=passive)
    assert [one.code for one in implausible(made, FINSROV)] == ([code] if code else [])
    if code:
        with pytest.raises(CalibrationError, match="made: "):
            require_fittable([made], FINSROV)
