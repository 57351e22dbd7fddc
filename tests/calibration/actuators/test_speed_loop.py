"""The speed loop: it follows, it holds in spite of an inexact model, and it knows the dead zone."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.made_steps import step_log
from finssim.calibration.actuators.motor import fit_motor
from finssim.calibration.actuators.speed_report import LoopPlant, simulate_step, tune
from finssim.vehicles import load_vehicle

PLANT = LoopPlant(gain=0.9, delay=0.05, time_constant=0.12, dead_minus=-30.0, dead_plus=35.0, limit=300.0)


@given(
    gain=st.floats(0.3, 3.0),
    delay=st.floats(0.0, 0.3),
    tau=st.floats(0.02, 0.5),
    rate=st.sampled_from([50.0, 200.0, 1000.0]),
    sign=st.sampled_from([-1.0, 1.0]),
)
@settings(max_examples=25, deadline=None)
def test_a_known_motor_is_followed_without_overshoot(gain, delay, tau, rate, sign):
    """An exact model leaves at most 10 % of overshoot and 1 % of steady error, whatever the motor."""
    plant = LoopPlant(gain=gain, delay=delay, time_constant=tau, limit=300.0)
    gains = tune(plant, loop_rate=rate)
    step = simulate_step(plant, gains, sign * 0.5 * gain * 300.0, duration=12.0 * (delay + tau + 0.05))
    assert step.overshoot < 0.10 and abs(step.steady_error) < 0.01


@pytest.mark.parametrize(
    "change", [{"gain": 0.72}, {"gain": 1.08}, {"delay": 0.07}, {"time_constant": 0.08}], ids=str
)
def test_integral_action_takes_out_what_the_model_misses(change):
    """A sagging battery takes a fifth of the speed of the feed-forward alone; the loop gives it back."""
    gains, other = tune(PLANT, loop_rate=200.0), replace(PLANT, **change)
    step = simulate_step(other, gains, 120.0, noise=1.0)
    assert abs(step.steady_error) < 0.01 and step.overshoot < 0.15
    alone = simulate_step(other, replace(gains, kp=0.0, ki=0.0, kd=0.0), 120.0)
    assert alone.steady_error == pytest.approx(1.0 - other.gain / PLANT.gain, abs=0.01)


def test_without_pid_the_rise_is_that_of_the_asked_speed():
    """The feed-forward's lead cancels the lag: what is left is the reference's low-pass, 2.2 λ_r from 10 to 90 %."""
    plant = replace(PLANT, dead_minus=0.0, dead_plus=0.0)
    gains = replace(tune(plant, loop_rate=1000.0), kp=0.0, ki=0.0, kd=0.0)
    step = simulate_step(plant, gains, 100.0)
    assert step.rise == pytest.approx(math.log(9.0) * gains.reference_time, rel=0.05)


def test_the_dead_zone_is_stepped_over_and_small_requests_come_out_at_its_edge():
    gains = tune(PLANT, loop_rate=200.0)
    above = simulate_step(PLANT, gains, 0.9 * 40.0)
    assert abs(above.steady_error) < 0.01
    below = simulate_step(PLANT, gains, 0.9 * 20.0)
    assert np.max(below.speed) == pytest.approx(0.9 * 35.0, rel=0.01), "the slowest speed that turns"
    ignorant = simulate_step(
        replace(PLANT, dead_plus=60.0), replace(gains, kp=0.0, ki=0.0, kd=0.0), 0.9 * 40.0
    )
    assert abs(ignorant.steady_error) > 0.3


def test_a_limited_command_does_not_wind_up():
    """A speed out of reach for a while: the integral waits, and there is no long overshoot after."""
    plant = replace(PLANT, limit=130.0)
    gains = tune(plant, loop_rate=200.0)
    step = simulate_step(replace(plant, gain=0.95 * plant.gain), gains, 110.0)
    assert step.overshoot < 0.05 and abs(step.steady_error) < 0.02


def test_the_fit_tunes_and_confirms_a_loop():
    """From a step log to gains; the simulated steps of the published trial meet 10 % overshoot, 1 % steady error."""
    vehicle = load_vehicle("finsrov").replace({"thrusters.*.domain": "speed"})
    pulses = (0, 1500, 0, -1500, 0, 2200, 0, -2200, 0)
    trial = step_log(vehicle.thrusters["H_LF"], "H_LF", pulses, domain="speed", gain=0.9)
    fit = fit_motor([trial], vehicle, loop_rate=100.0)
    assert fit.estimates["speed_loop.feedforward"].estimate == pytest.approx(1.0 / 0.9, rel=0.01)
    figures = fit.quality["speed_loop"]
    assert figures["loop_overshoot"] < 0.10 and figures["loop_steady_error"] < 0.01
    assert 0.0 < figures["loop_rise"] < 0.5
    theta = 0.05 + 1.5 / 100.0
    slow = fit.estimates["speed_loop.ki"].estimate
    assert slow <= 1.05 * 0.12 / (0.9 * 2.0 * theta) / 0.12, "the rule's integral gain, or a slower loop's"
