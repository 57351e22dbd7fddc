"""Dead time and lag of motors from step logs, with intervals that cover, in the vehicle file's domain."""

import numpy as np
import pytest

from bench.made_steps import RPM, held, lagged, sampled, step_log
from finssim.bench.levels import find_steps, levels
from finssim.bench.motor import cut_steps, fit_motor, fit_response
from finssim.identification.programme import programmes
from finssim.identification.synthetic import simulate_programme
from finssim.trials.findings import CalibrationError
from finssim.trials.trial import Header, Trial
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
H_LF = FINSROV.thrusters["H_LF"]
PULSES = (0, 1500, 0, -1500, 0, 2200, 0, -2200, 0)
"""Pulses of both signs in the published procedure [rpm]."""


def log(
    delay, tau, *, rate=50.0, noise=0.02, seed=0, lost=0.0, pulses=(0, 0.5, 0, -0.5, 0, 1, 0, -1, 0), hold=2.5
):
    """Return command and response of a unit motor: times, values, times, values."""
    rng = np.random.default_rng(seed)
    t, u = held(pulses, hold)
    y, rows = lagged(u, delay, tau), sampled(t, rate)
    y = y[rows] + noise * rng.standard_normal(len(rows))
    kept = rng.random(len(rows)) >= lost
    return t[rows], u[rows], t[rows][kept], y[kept]


def response(command_times, command, t, y):
    return fit_response(cut_steps("a", t, y, command_times, find_steps(command_times, command)))


CASES = [  # delay [s], time constant [s], sampling [Hz]
    (0.05, 0.12, 50.0),
    (0.2, 0.3, 50.0),
    (0.3, 0.05, 20.0),
    (0.05, 0.12, 10.0),
    (0.05, 0.12, 200.0),
]


@pytest.mark.parametrize(("delay", "tau", "rate"), CASES)
def test_dead_time_and_lag_are_recovered(delay, tau, rate):
    """Noise is 2 % of the larger pulse and a fifth of the samples is lost; a lag near one sample is less accurate."""
    found = response(*log(delay, tau, rate=rate, lost=0.2))
    assert found.delay == pytest.approx(delay, abs=0.2 / rate + 0.002)
    assert found.time_constant == pytest.approx(tau, rel=0.05 if tau * rate > 2.0 else 0.1)
    assert found.used.sum() == 8


@pytest.mark.slow
@pytest.mark.parametrize(("delay", "tau", "rate"), [CASES[0], CASES[3]])
def test_intervals_cover_the_truth(delay, tau, rate):
    """In 25 repetitions, the 95 % intervals contain the truth in at least 84 %, and are narrower than the values."""
    hits = np.zeros(2)
    for seed in range(25):
        found = response(*log(delay, tau, rate=rate, seed=seed, lost=0.1))
        (a, b), (c, d) = found.delay_interval, found.time_constant_interval
        hits += [a <= delay <= b, c <= tau <= d]
        assert d - c < tau
    assert np.all(hits >= 0.84 * 25)


def test_without_noise_the_answer_is_that_of_the_closed_form():
    found = response(*log(0.1, 0.25, noise=0.0))
    assert found.delay == pytest.approx(0.1, abs=1e-3) and found.time_constant == pytest.approx(
        0.25, rel=2e-3
    )
    assert found.overshoot.max() < 1e-3 and found.error < 1e-3


def test_an_overshooting_motor_is_not_accepted():
    """A second-order motor of damping ratio 0.3, which overshoots by exp(-π 0.3 / √(1 - 0.09)) = 37 %, is refused."""
    t, u = held((0, 1, 0, -1, 0), 2.5)
    w, z, h = 20.0, 0.3, 1.0 / 2000.0
    y, v, ys = 0.0, 0.0, []
    for target in u:
        v += h * (w * w * (target - y) - 2.0 * z * w * v)
        y += h * v
        ys.append(y)
    rows = sampled(t, 100.0)
    found = response(t[rows], u[rows], t[rows], np.array(ys)[rows])
    assert not found.accepted.any()
    assert found.overshoot[0] == pytest.approx(0.37, abs=0.03)


def test_steps_are_found_in_what_is_held():
    t, u = held((0, 1, 1, 0.5, 0), 1.0)
    assert [s.time for s in find_steps(t[::40], u[::40])] == pytest.approx([1.0, 3.0, 4.0])
    assert find_steps(t, np.sin(t)) == [] and find_steps(t, np.ones_like(t)) == []
    noisy = u[::40] + 0.001 * np.random.default_rng(0).standard_normal(len(u[::40]))
    assert len(levels(noisy, 0.01)) == 4


@pytest.mark.parametrize("domain", ["force", "speed"])
@pytest.mark.parametrize("asked", ["command", "rpm_command"])
def test_the_vehicle_files_domain_is_respected(domain, asked):
    """The lag is recovered in the vehicle file's domain, from commanded thrusts or speeds."""
    vehicle = FINSROV.replace({"thrusters.*.domain": domain})
    trial = step_log(vehicle.thrusters["H_LF"], "H_LF", PULSES, domain=domain, asked=asked)
    fit = fit_motor([trial], vehicle)
    tau, delay = fit.estimates["H_LF.time_constant"], fit.estimates["delay"]
    assert tau.estimate == pytest.approx(0.12, rel=0.05) and tau.ci95[0] <= 0.12 <= tau.ci95[1]
    assert delay.estimate == pytest.approx(0.05, abs=0.004) and delay.ci95[0] <= 0.05 <= delay.ci95[1]
    assert fit.estimates["H_LF.gain"].estimate == pytest.approx(1.0, abs=0.02)
    assert fit.quality["H_LF"]["nrmse"] < 0.3 * fit.quality["H_LF"]["nrmse_other_domain"]
    fitted = vehicle.replace(fit.changes)
    assert {t.delay for t in fitted.thrusters.values()} == {delay.estimate}, "all share one link"
    assert fitted.thrusters["H_LF"].time_constant == tau.estimate


def test_the_wrong_domain_is_told():
    trial = step_log(H_LF, "H_LF", PULSES, domain="speed")
    fit = fit_motor([trial], FINSROV)
    assert [one.values["domain"] for one in fit.findings if one.code == "other_domain"] == ["speed"]


def test_the_dead_zone_lies_between_the_commands_that_show_it():
    tried = (0, 250, 0, 350, 0, 1500, 0, -250, 0, -350, 0, -1500, 0)
    trial = step_log(H_LF, "H_LF", tried, dead_rpm=300.0)
    fit = fit_motor([trial], FINSROV)
    plus, minus = fit.estimates["H_LF.dead_rpm_plus"], fit.estimates["H_LF.dead_rpm_minus"]
    assert plus.ci95 == pytest.approx((250.0, 350.0), rel=1e-3) and plus.identifiable
    assert minus.ci95 == pytest.approx((-350.0, -250.0), rel=1e-3)
    assert FINSROV.replace(fit.changes).thrusters["H_LF"].dead_rpm_plus == pytest.approx(300.0, rel=1e-3)
    unseen = fit_motor([step_log(H_LF, "H_LF", PULSES)], FINSROV).estimates["H_LF.dead_rpm_plus"]
    assert not unseen.identifiable and "already turns the shaft" in unseen.note


def test_what_sampling_hides_is_said():
    """A delay of 12 ms at 50 Hz is within one sample; a lag of 2 ms is not distinguishable from none. Both
    are reported."""
    fit = fit_motor([step_log(H_LF, "H_LF", PULSES, delay=0.012)], FINSROV)
    assert "is below one sample of 0.02 s" in fit.estimates["H_LF.delay"].note
    low, high = fit.estimates["H_LF.delay"].ci95
    assert low <= 0.012 <= high and high - low >= 0.02
    fast = fit_motor([step_log(H_LF, "H_LF", PULSES, tau=0.002, noise_rpm=1.0)], FINSROV)
    assert not fast.estimates["H_LF.time_constant"].identifiable
    assert not any(path.endswith("H_LF.time_constant") for path in fast.changes)


def test_a_motor_that_does_not_follow_keeps_its_numbers():
    trial = step_log(H_LF, "H_LF", PULSES)
    dead = Trial(name="dead", t=trial.t, channels=trial.channels | {"rpm_H_LF": np.zeros(len(trial.t))})
    fit = fit_motor([dead], FINSROV)
    assert fit.changes == {} and "not_followed" in {one.code for one in fit.findings}


def test_several_trials_and_thrusters_are_fitted_together():
    """Thrusters without steps get their group's mean; another group keeps its values, and both are reported."""
    trials = [step_log(H_LF, "H_LF", PULSES, seed=seed, tau=0.15) for seed in range(4)]
    fit = fit_motor(trials, FINSROV)
    fitted = FINSROV.replace(fit.changes)
    assert fitted.thrusters["H_RB"].time_constant == pytest.approx(0.15, rel=0.03), "the same propeller group"
    assert fitted.thrusters["V_LF"].time_constant == FINSROV.thrusters["V_LF"].time_constant
    assert "group_mean" in {one.code for one in fit.findings}
    assert "file_response" in {one.code for one in fit.findings}
    assert set(fit.trials) == {f"steps{seed}" for seed in range(4)}


def test_pulses_and_unsigned_speeds_with_lost_samples_and_spikes():
    """A vehicle with hobby speed controllers logs pulses at 50 Hz and unsigned speeds at 20 Hz, some of them lost."""
    vehicle = load_vehicle("bluerov2")
    thruster = vehicle.thrusters["T2"]
    rng = np.random.default_rng(3)
    t, pulse = held((1500, 1650, 1500, 1350, 1500, 1750, 1500, 1250, 1500), 2.5)
    speed = thruster.speed(lagged(thruster.thrust(thruster.shaft_speed(pulse, 15.0)), 0.1, 0.15))
    rows = sampled(t, 100.0)
    rpm = np.abs(speed[rows]) / RPM + 5.0 * rng.standard_normal(len(rows))
    rpm[np.arange(len(rows)) % 5 != 0] = np.nan  # 20 Hz
    rpm[[300, 1000, 1500]] = 0.0  # lost packets
    pwm = pulse[rows].copy()
    pwm[np.arange(len(rows)) % 2 == 1] = np.nan
    trial = Trial(
        name="bench", t=t[rows], channels={"pwm_T2": pwm, "rpm_T2": rpm}, header=Header(voltage=15.0)
    )
    fit = fit_motor([trial], vehicle)
    assert fit.estimates["T2.time_constant"].estimate == pytest.approx(0.15, rel=0.1)
    assert fit.estimates["T2.delay"].estimate == pytest.approx(0.1, abs=0.01)
    assert fit.estimates["T2.gain"].estimate == pytest.approx(1.0, abs=0.03)
    assert "sign_of_command" in {one.code for one in fit.findings}
    assert "spikes" in {one.code for one in fit.findings}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "asked"), [("finsrov", "command"), ("bluerov2", "pwm")])
def test_the_simulators_motors_are_recovered_from_trials_of_the_whole_vehicle(name, asked):
    """The engine solves delay and lag independently; its noise-free logs give back the vehicle file's values."""
    vehicle = load_vehicle(name)
    trials = simulate_programme(programmes(["yaw"], vehicle), vehicle, inputs=(asked, "rpm"))
    fit = fit_motor(trials[:2], vehicle)
    for thruster in vehicle.thrusters:
        found = fit.estimates.get(f"{thruster}.time_constant")
        if found is not None:
            assert found.estimate == pytest.approx(vehicle.thrusters[thruster].time_constant, rel=2e-3)
            assert fit.estimates[f"{thruster}.gain"].estimate == pytest.approx(1.0, abs=1e-3)
    delay = next(iter(vehicle.thrusters.values())).delay
    assert fit.estimates["delay"].estimate == pytest.approx(delay, abs=1e-3)


def test_a_thrust_response_serves_where_no_speed_was_measured():
    trial = step_log(H_LF, "H_LF", PULSES)
    omega = trial.channels["rpm_H_LF"] * RPM
    force = Trial(
        name="scale",
        t=trial.t,
        channels={"command_H_LF": trial.channels["command_H_LF"], "force_H_LF": H_LF.thrust(omega)},
    )
    fit = fit_motor([force], FINSROV)
    assert fit.estimates["H_LF.time_constant"].estimate == pytest.approx(0.12, rel=0.05)


@pytest.mark.parametrize(
    ("channels", "said"),
    [
        (lambda t: {"u": t}, "no thruster of finsrov has a command .* and a response"),
        (lambda t: {"rpm_H_LF": t, "force_H_LF": t}, "no thruster of finsrov has a command"),
        (
            lambda t: {"command_H_LF": np.sin(t), "rpm_H_LF": np.sin(t)},
            "no command holds a level and changes",
        ),
        (lambda t: {"command_T9": np.sign(t - 5), "rpm_T9": t}, "its thrusters are V_LF"),
    ],
)
def test_logs_that_show_no_response_are_refused(channels, said):
    t = np.arange(0.0, 10.0, 0.02)
    with pytest.raises(CalibrationError, match=said):
        fit_motor([Trial(name="a", t=t, channels=channels(t))], FINSROV)
