"""Motor map: order, sign and curve; thrusts too small to hold are correct on average, by an independent motor."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from finssim.control import ControlError
from finssim.control.motor_map import SHORTEST_PULSE, MotorMap
from finssim.vehicles import load_vehicle
from reference.cases import THRUSTED

DT = 1.0 / 60.0
FINE = 16  # steps of the independent motor per command
RPM = 2.0 * np.pi / 60.0
VEHICLES = {name: load_vehicle(name) for name in THRUSTED}
WITH_DEAD_ZONE = [
    name
    for name, vehicle in VEHICLES.items()
    if any(t.dead_rpm_plus > 0.0 for t in vehicle.thrusters.values())
]
SMALL = [0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0]
FINSROV = VEHICLES["finsrov"]


def commands(motors, requests):
    """Return canonical shaft speeds [rpm], (steps, n), for requests [N], (steps, n)."""
    memory, told = motors.reset(), []
    for request in requests:
        normalised, _, memory = motors.normalised(request, memory, DT)
        assert np.abs(normalised).max() <= 1.0
        told.append(motors.canonical_rpm(normalised) * motors.full_scale)
    return np.array(told)


def delivered(vehicle, rpm):
    """Return the thrust [N], (steps*FINE, n), of motors with a dead zone, a first-order shaft lag and T = c ω|ω|."""
    thrusts = []
    for t, column in zip(vehicle.thrusters.values(), rpm.T, strict=True):
        turning = np.where((column > t.dead_rpm_minus) & (column < t.dead_rpm_plus), 0.0, column) * RPM
        decay = np.exp(-DT / FINE / t.time_constant)
        omega = lfilter([1.0 - decay], [1.0, -decay], np.repeat(turning, FINE))
        thrusts.append(t.thrust(omega))
    return np.array(thrusts).T


def pulse_impulse(motors):
    """Return the impulse of one pulse per direction and thruster [N s], (2, n)."""
    return np.array([[2.0 * side.half for side in (m.minus, m.plus)] for m in motors._motors]).T


@pytest.mark.slow
@pytest.mark.parametrize("name", VEHICLES)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_mean_thrust_is_what_was_asked(name, sign):
    """Mean T = f within 3 % plus the share of one unfinished pulse, for requests from 0.02 to 1 N in both
    directions."""
    vehicle, duration = VEHICLES[name], 60.0
    motors = MotorMap.from_vehicle(vehicle)
    n = motors.thrusters
    lag = max(t.time_constant for t in vehicle.thrusters.values())
    for start in range(0, len(SMALL), n) if n > 1 else range(len(SMALL)):
        request = sign * np.array([SMALL[(start + k) % len(SMALL)] for k in range(n)])
        thrust = delivered(vehicle, commands(motors, np.tile(request, (round(duration / DT), 1))))
        mean = thrust.sum(axis=0) * DT / FINE / duration
        # Each motor lags once: by at most 1.5 time constants of a shaft that starts from rest.
        hidden = pulse_impulse(motors)[int(sign > 0.0)] + 1.5 * lag * np.abs(request)
        np.testing.assert_array_less(np.abs(mean - request), 0.03 * np.abs(request) + hidden / duration)


@pytest.mark.parametrize("name", WITH_DEAD_ZONE)
def test_a_small_request_never_falls_into_the_dead_zone(name):
    """Every commanded speed is either zero or turns the shaft, and both occur."""
    vehicle = VEHICLES[name]
    rpm = commands(MotorMap.from_vehicle(vehicle), np.full((600, len(vehicle.thrusters)), 0.05))
    for t, column in zip(vehicle.thrusters.values(), rpm.T, strict=True):
        assert ((column == 0.0) | (column > t.dead_rpm_plus)).all()
        assert (column == 0.0).any() and (column > 0.0).any()


def test_pulses_and_gaps_are_never_shorter_than_the_motor_needs():
    """A constant request turns the motor on and off for at least its time constant each time."""
    for request in (0.05, 0.2, 0.5):
        rpm = commands(MotorMap.from_vehicle(FINSROV), np.full((3600, 8), request))
        for t, column in zip(FINSROV.thrusters.values(), rpm.T, strict=True):
            edges = np.flatnonzero(np.diff(column != 0.0))
            assert (np.diff(edges) * DT > max(t.time_constant, SHORTEST_PULSE) - DT).all()


def test_no_request_is_no_thrust_at_once_and_leaves_nothing():
    """Zero commands exactly zero, even during a pulse, and the pulses start afresh after it."""
    motors = MotorMap.from_vehicle(FINSROV)
    memory = motors.reset()
    for _ in range(37):
        told, _, memory = motors.normalised(np.full(8, 0.3), memory, DT)
        assert (motors.normalised(np.zeros(8), memory, DT)[0] == 0.0).all()
    assert told.any()
    _, _, memory = motors.normalised(np.zeros(8), memory, DT)
    assert all(motor.owed == 0.0 and motor.pulse == 0.0 for motor in memory)


def test_a_changed_sign_ends_the_pulse_and_leaves_no_residue():
    """No pulse opposes the request, and the impulse after a reversal is the new request's within one pulse."""
    motors = MotorMap.from_vehicle(FINSROV)
    requests = np.repeat([[0.1] * 8, [-0.05] * 8], [413, 3600], axis=0)
    rpm = commands(motors, requests)
    assert (rpm[:413] >= 0.0).all() and (rpm[413:] <= 0.0).all()
    impulse = delivered(FINSROV, rpm)[413 * FINE :].sum(axis=0) * DT / FINE
    assert (np.abs(impulse + 0.05 * 60.0) < 1.5 * pulse_impulse(motors).max() + 0.03 * 3.0).all()


@pytest.mark.parametrize("amplitude", [0.02, 0.1, 0.11])
def test_jitter_around_zero_starts_no_motor(amplitude):
    """A policy that alternates between ±0.1 N at 10 Hz requests zero on average, and gets zero."""
    signs = np.repeat(np.tile([1.0, -1.0], 300), 6)
    assert not commands(MotorMap.from_vehicle(FINSROV), amplitude * np.tile(signs, (8, 1)).T).any()


def test_jitter_around_a_small_request_gives_its_mean():
    """0.06 N plus ±0.1 N of 10 Hz is 0.06 N on average: the remainder survives the changes of sign."""
    motors = MotorMap.from_vehicle(FINSROV)
    request = 0.06 + 0.1 * np.repeat(np.tile([1.0, -1.0], 600), 6)
    mean = delivered(FINSROV, commands(motors, np.tile(request, (8, 1)).T)).mean(axis=0)
    np.testing.assert_allclose(mean, 0.06, rtol=0.06)


@pytest.mark.slow
@pytest.mark.parametrize("name", VEHICLES)
@given(share=st.floats(-3.0, 3.0, allow_subnormal=False), dt=st.floats(0.0, 1.0))
def test_a_held_thrust_comes_out_as_its_speed(name, share, dt):
    """T(commanded rpm) = the request within the limits, unless it is too small to be held; never beyond full scale."""
    motors = MotorMap.from_vehicle(VEHICLES[name])
    told, mean, _ = motors.normalised(share * motors.upper, motors.reset(), dt)
    np.testing.assert_array_equal(mean, np.clip(share * motors.upper, motors.lower, motors.upper))
    assert np.abs(told).max() <= 1.0 and told.shape == (motors.outputs,)
    held = np.abs(mean) >= np.where(mean < 0.0, *motors.slowest)
    thrust = motors.force(motors.canonical_rpm(told) * motors.full_scale)
    np.testing.assert_allclose(thrust[held], mean[held], rtol=1e-9)


def test_each_output_drives_its_thruster_with_its_sign():
    """Thruster and sign agree with FinsROV's published table of outputs M1 to M8."""
    table = ["-H_LF", "-H_LB", "-V_LF", "+V_LB", "-V_RB", "+H_RF", "-H_RB", "-V_RF"]
    motors = MotorMap.from_vehicle(FINSROV)
    for output, (sign, name) in enumerate((word[0], word[1:]) for word in table):
        force = np.where(np.array(FINSROV.thruster_names) == name, 2.0, 0.0)
        told = motors.normalised(force, motors.reset(), DT)[0]
        assert np.flatnonzero(told).tolist() == [output] and (told[output] > 0.0) == (sign == "+")


def test_full_thrust_is_the_fastest_speed_of_the_file():
    """c± at the published rpm limits gives the published force limit, so full thrust commands that speed of
    3000 rpm."""
    motors = MotorMap.from_vehicle(FINSROV)
    rpm = motors.canonical_rpm(motors.normalised(motors.upper, motors.reset(), DT)[0]) * 3000.0
    expected = [t.rpm_max for t in FINSROV.thrusters.values()]
    np.testing.assert_allclose(rpm, expected, rtol=1e-4)  # the file rounds the forces


def test_outputs_that_cannot_be_are_refused():
    """An output used twice or beyond the controller's range, and an mcu without a motor_index, are named."""
    with pytest.raises(ControlError, match="correct motor_index"):
        MotorMap.from_vehicle(FINSROV.replace({"thrusters.H_LF.motor_index": 3}))
    with pytest.raises(ControlError, match="lie in 0 to 7"):
        MotorMap.from_vehicle(FINSROV.replace({"thrusters.H_LF.motor_index": 8}))
    bare = {
        "left": SimpleNamespace(motor_index=None, motor_sign=1),
        "right": SimpleNamespace(motor_index=0, motor_sign=1),
    }
    with pytest.raises(ControlError, match="'left' has no motor_index"):
        MotorMap.from_vehicle(SimpleNamespace(name="minnow", mcu=FINSROV.mcu, thrusters=bare))
