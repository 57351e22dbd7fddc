"""ArduSub's mixer: the published tables, its limits, the catalogue's thrusters, and the inverse from thrusts."""

import numpy as np
import pytest

from finssim.control import ControlError
from finssim.control.ardusub import FROM_BODY, PULSES, Mixer, dead_band, thrust_tables
from finssim.control.modes import QUIET, action_mode, axis_dead_band, before_dead_band
from finssim.vehicles import VehicleError, load_vehicle
from finssim.vehicles.autopilot import DEMANDS

HEAVY, ROV = load_vehicle("bluerov2_heavy"), load_vehicle("bluerov2")
PUSHES = {
    "forward": (0, 1),
    "lateral": (1, -1),
    "throttle": (2, 1),
    "roll": (3, 1),
    "pitch": (4, -1),
    "yaw": (5, -1),
}
"""Demand -> axis of forward-left-up and its sign: right is -y, nose up is -pitch, clockwise from above is -yaw."""


def demand(**parts):
    return np.array([parts.get(name, 0.0) for name in DEMANDS])


def asked(vehicle, part):
    """Return the demand for a part of an axis: from the dead band, where motors begin to turn, up to the gain."""
    dead = dead_band(vehicle)
    return dead + (vehicle.autopilot.gain - dead) * (part - QUIET) / (1.0 - QUIET)


def test_the_vectored_frame_gives_way_to_the_throttle():
    """The pair at the rear in the direction of travel has a forward demand of at most 1 - |throttle|."""
    mixer = Mixer.of_frame("VECTORED")
    out = mixer.outputs(demand(forward=1.0, throttle=0.75))
    np.testing.assert_allclose(out[:4], [-1.0, -1.0, 0.25, 0.25])
    out = mixer.outputs(demand(forward=-1.0, throttle=0.75))
    np.testing.assert_allclose(out[:4], [0.25, 0.25, -1.0, -1.0])
    np.testing.assert_allclose(mixer.outputs(demand(forward=1.0, yaw=1.0))[:4], [0, -1, 0, 1])


def test_the_frame_of_six_axes_keeps_directions():
    """Horizontals and verticals are scaled down separately, so that full ahead and full right is still diagonal."""
    out = Mixer.of_frame("VECTORED_6DOF").outputs(demand(forward=1.0, lateral=1.0, throttle=0.3))
    np.testing.assert_allclose(out, [0.0, -1.0, 1.0, 0.0, -0.3, -0.3, -0.3, -0.3], rtol=1e-6)


def test_full_ahead_and_full_up_are_the_published_pulses():
    """Ahead: 1100 µs on motors 1, 2 and 1900 on 3, 4; up: 1100 on the verticals; directions invert a motor's pulses."""
    mixer = Mixer.of_frame("VECTORED_6DOF")
    np.testing.assert_allclose(
        mixer.pulses(demand(forward=1.0)), [1100, 1100, 1900, 1900, 1500, 1500, 1500, 1500]
    )
    np.testing.assert_allclose(mixer.pulses(demand(throttle=1.0)), [1500] * 4 + [1100] * 4)
    turned = Mixer.of_frame("VECTORED", [1, 1, 1, 1, -1, 1]).pulses(demand(throttle=0.5))
    np.testing.assert_allclose(turned[4:], [1700.0, 1300.0])


@pytest.mark.parametrize("vehicle", [HEAVY, ROV], ids=lambda v: v.name)
@pytest.mark.parametrize("name", PUSHES)
def test_each_demand_pushes_its_way(vehicle, name):
    """Mode, mixer, ESC and thrusters of the catalogue give a force along the named axis and no other."""
    if (vehicle, name) == (ROV, "pitch"):
        pytest.skip("six thrusters do not pitch")
    axis, sign = PUSHES[name]
    action = np.zeros(6)
    action[axis] = sign * 0.5
    tau = vehicle.control_matrix @ action_mode("pilot6", vehicle).to_thrusters(action)
    assert sign * tau[axis] > (5.0 if axis < 3 else 0.5)
    if axis < 3:
        assert np.abs(np.delete(tau[:3], axis)).max() < 0.1 * abs(tau[axis])


def test_thrusts_are_those_of_the_speed_controller():
    """Thrusts of an action are c ω² at the mixer's pulses by the ESC's law, also at another voltage."""
    for voltage in (None, 12.0):
        vehicle = HEAVY if voltage is None else HEAVY.replace({"autopilot.voltage": voltage})
        action = np.array([0.7, -0.2, 0.4, 0.05, -0.1, 0.3])
        f = action_mode("pilot6", vehicle).to_thrusters(action)
        pulses = Mixer.of(vehicle).pulses(
            demand(
                forward=asked(vehicle, 0.7),
                lateral=asked(vehicle, 0.2),
                throttle=asked(vehicle, 0.4),
                roll=asked(vehicle, 0.05),
                pitch=asked(vehicle, 0.1),
                yaw=-asked(vehicle, 0.3),
            )
        )
        expected = [
            np.clip(t.thrust(t.shaft_speed(pulse, voltage)), t.force_min, t.force_max)
            for t, pulse in zip(vehicle.thrusters.values(), pulses, strict=True)
        ]
        # Thrust is interpolated linearly in a table with 1 µs spacing.
        np.testing.assert_allclose(f, expected, atol=0.02)


@pytest.mark.parametrize("vehicle", [HEAVY, ROV], ids=lambda v: v.name)
def test_demands_of_thrusts_give_these_thrusts_again(vehicle):
    """The inverse recovers the mixer's thrusts, with motors in the dead band and groups that saturate."""
    mode, mixer = action_mode("pilot6", vehicle), Mixer.of(vehicle)
    random, off = np.random.default_rng(0), []
    for _ in range(200):
        f = mode.to_thrusters(random.uniform(-1.0, 1.0, 6) * random.uniform(0.0, 1.0))
        again = before_dead_band(mixer.demands(f) / vehicle.autopilot.gain, axis_dead_band(vehicle))
        body = np.array([again[4], -again[5], again[3], again[0], -again[1], -again[2]])
        off.append(np.abs(mode.to_thrusters(body) - f).max())
    # Where the vectored frame clips single motors with all axes near full, the demand is not always met.
    assert np.percentile(off, 90.0) < 0.1
    np.testing.assert_array_equal(mixer.demands(np.zeros(len(f))), 0.0)


def test_a_motor_wired_and_declared_the_other_way_gives_the_same_push():
    """With MOT_3_DIRECTION -1 and a propeller of the other hand, pulses differ and the thrust direction does not."""
    turned = HEAVY.replace(
        {"thrusters.T3.axis": (-HEAVY.thrusters["T3"].axis).tolist(), "autopilot.directions": [1, 1, -1]}
    )
    ahead = np.array([0.8, 0, 0, 0, 0, 0])
    for vehicle in (HEAVY, turned):
        tau = vehicle.control_matrix @ action_mode("pilot6", vehicle).to_thrusters(ahead)
        assert tau[0] > 20.0
    assert Mixer.of(turned).pulses(demand(forward=0.5))[2] == pytest.approx(1300.0)


def test_a_frame_may_be_a_table():
    """A frame given by its factors equals the named frame, except that each motor is clipped separately."""
    rows = HEAVY.autopilot.factors.tolist()
    own = HEAVY.replace({"autopilot.frame": rows})
    small = demand(forward=0.2, yaw=0.1, throttle=-0.3)
    np.testing.assert_allclose(Mixer.of(own).outputs(small), Mixer.of(HEAVY).outputs(small), atol=1e-6)


def test_tables_rise_with_the_pulse_and_stand_still_about_neutral():
    for table, thruster in zip(thrust_tables(HEAVY), HEAVY.thrusters.values(), strict=True):
        assert (np.diff(table) >= 0.0).all()
        dead = (PULSES > thruster.esc.dead_minus) & (PULSES < thruster.esc.dead_plus)
        assert (table[dead] == 0.0).all()


@pytest.mark.parametrize(
    "changes, sentence",
    [
        ({"autopilot.frame": "VECTORED_6DOFF"}, "VECTORED_6DOF"),
        ({"autopilot.frame": "VECTORED"}, "6 motors"),
        ({"autopilot.directions": [-1]}, "motor 1 pushes thruster 'T1' opposite"),
        ({"autopilot.gain": 1.5}, "gain"),
        ({"autopilot.frame": [[0, 0, 1]]}, "6 long"),
    ],
)
def test_an_autopilot_that_cannot_be_is_refused(changes, sentence):
    with pytest.raises(VehicleError, match=sentence):
        HEAVY.replace(changes)


def test_a_vehicle_without_an_autopilot_has_no_axes():
    with pytest.raises(ControlError, match="no 'autopilot' section"):
        action_mode("pilot6", load_vehicle("finsrov"))


@pytest.mark.parametrize("gain", [0.25, 0.5, 1.0])
def test_motors_turn_from_one_percent_of_an_axis_at_any_gain(gain):
    """Just below `QUIET` no motor turns, just above it one does, and action 1 is the gain's full output."""
    vehicle = HEAVY.replace({"autopilot.gain": gain})
    mode = action_mode("pilot6", vehicle)
    for axis in range(6):
        action = np.zeros((3, 6))
        action[:, axis] = 0.95 * QUIET, 1.2 * QUIET, 1.0
        still, turning, full = mode.to_thrusters(action)
        assert np.abs(still).max() < 1e-6 < 0.01 < np.abs(turning).max()
        pulses = Mixer.of(vehicle).pulses(FROM_BODY @ action[2] * gain)
        expected = [
            np.clip(t.thrust(t.shaft_speed(pulse)), t.force_min, t.force_max)
            for t, pulse in zip(vehicle.thrusters.values(), pulses, strict=True)
        ]
        np.testing.assert_allclose(full, expected, rtol=1e-4, atol=1e-6)


def test_a_gain_that_turns_no_motor_is_refused():
    with pytest.raises(ControlError, match=r"no motor turns up to 0\.07.* autopilot\.gain is 0\.05"):
        action_mode("pilot6", HEAVY.replace({"autopilot.gain": 0.05}))


def test_the_way_back_past_the_dead_band_is_the_way_there():
    """`before_dead_band` inverts the mapping, also where an axis is scaled; an axis that is switched off is
    excluded."""
    scale = (1.0, 0.5, 0.3, 1.0, 0.0, 0.8)
    band = axis_dead_band(HEAVY, scale)
    assert band[0] == pytest.approx(dead_band(HEAVY) / HEAVY.autopilot.gain)
    assert band[4] == 1.0
    action = np.random.default_rng(3).uniform(-1.0, 1.0, (50, 6))
    size = np.abs(action)
    there = np.sign(action) * np.where(
        size <= QUIET, size * band / QUIET, band + (1.0 - band) * (size - QUIET) / (1.0 - QUIET)
    )
    back = before_dead_band(there, band)
    on = band < 1.0
    np.testing.assert_allclose(back[:, on], action[:, on], atol=1e-12)
