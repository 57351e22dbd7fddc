"""A pilot's sticks through ArduSub's mixer become pulses that push the vehicle in the commanded direction."""

import numpy as np
import pytest

from finssim.trials.findings import CalibrationError
from finssim.trials.inputs import drive
from finssim.vehicles import load_vehicle
from trials.importers.tables import read

FRAMES = {"VECTORED": "bluerov2", "VECTORED_6DOF": "bluerov2_heavy"}
PUSHES = {
    "stick_forward": (0, 1.0),
    "stick_lateral": (1, -1.0),
    "stick_throttle": (2, 1.0),
    "stick_roll": (3, 1.0),
    "stick_pitch": (4, -1.0),
    "stick_yaw": (5, -1.0),
}
"""Stick -> axis of forward-left-up and its sign: right is -y, nose up is -pitch, clockwise from above is
-yaw."""


def trial(tmp_path, text, **columns):
    """Return the trial of a log of sticks under a map."""
    table = {"t": [0.1 * k for k in range(20)], **{name: [value] * 20 for name, value in columns.items()}}
    return read(tmp_path, table, f"{text}time: t\ncolumns: [{', '.join(columns)}]\n")


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("stick", PUSHES)
def test_each_stick_pushes_its_way(tmp_path, frame, stick):
    """Tested with the mixer, the vehicle file's thrusters and its speed controllers."""
    if (frame, stick) == ("VECTORED", "stick_pitch"):
        pytest.skip("six thrusters do not pitch")
    vehicle = load_vehicle(FRAMES[frame])
    found = drive(
        trial(tmp_path, f"vehicle: {vehicle.name}\nardusub: {{frame: {frame}}}\n", **{stick: 0.5}), vehicle
    )
    tau = vehicle.control_matrix @ found.force[-1]
    axis, sign = PUSHES[stick]
    assert sign * tau[axis] > (5.0 if axis < 3 else 0.5)
    if axis < 3:
        assert np.abs(np.delete(tau[:3], axis)).max() < 0.1 * abs(tau[axis])


def test_directions_and_gain(tmp_path):
    """MOT_n_DIRECTION reverses a motor's pulses; the pilot gain scales the sticks before the mixer; the map
    gives both."""
    text = "vehicle: bluerov2\nardusub: {frame: VECTORED, gain: 0.5, motor_directions: [1, 1, 1, 1, -1, 1]}\n"
    found = trial(tmp_path, text, stick_throttle=1.0)
    assert (found.series("pwm_T5")[1][0], found.series("pwm_T6")[1][0]) == (1700.0, 1300.0)


@pytest.mark.parametrize(
    "text, columns, said",
    [
        ("vehicle: bluerov2\n", {"stick_yaw": 0.1}, "frame"),
        ("vehicle: bluerov2\nardusub: {frame: VECTORED}\n", {"stick_yaw": 1600}, "scale and offset"),
        ("vehicle: bluerov2\nardusub: {frame: VECTORED}\n", {"stick_yaw": 0.1, "pwm_T1": 1500}, "not both"),
        ("vehicle: bluerov2_heavy\nardusub: {frame: VECTORED}\n", {"stick_yaw": 0.1}, "6 motors"),
    ],
)
def test_what_cannot_be_mixed_is_refused(tmp_path, text, columns, said):
    """The refusal is one sentence that says what to give."""
    with pytest.raises(CalibrationError, match=said):
        trial(tmp_path, text, **columns)


def test_gauge_pressure_has_its_zero_at_the_surface(tmp_path):
    """surface_pressure is 0."""
    found = trial(tmp_path, "vehicle: bluerov2\nsurface_pressure: 0\n", pressure=9810.0)
    np.testing.assert_allclose(found.series("depth")[1], 1.0, rtol=1e-6)
