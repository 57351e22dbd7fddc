"""Speed controllers: the law between pulse width, voltage and shaft speed, and their keys in a vehicle file."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from finssim.vehicles import Esc, VehicleError, load_vehicle
from vehicles.minnow import MINNOW

ESC = load_vehicle("bluerov2").thrusters["T1"].esc
NUMBERS = {name: getattr(ESC, name) for name in Esc.model_fields}


@given(pulse=st.floats(1100.0, 1900.0), voltage=st.floats(8.0, 22.0))
def test_the_motor_voltage_balances_back_emf_and_load(pulse, voltage):
    """d V = e ω + r ω² holds wherever the shaft turns."""
    omega = float(ESC.shaft_speed(pulse, voltage))
    if omega == 0.0:
        low, high = ESC.dead_band(voltage)
        assert low < pulse < high
    elif omega > 0.0:
        duty = (pulse - ESC.zero_plus) / 400.0
        assert duty * voltage == pytest.approx(ESC.emf_plus * omega + ESC.load_plus * omega**2)
    else:
        duty = (ESC.zero_minus - pulse) / 400.0
        assert duty * voltage == pytest.approx(-ESC.emf_minus * omega + ESC.load_minus * omega**2)


@given(omega=st.floats(-250.0, 250.0), voltage=st.floats(12.0, 20.0))
def test_pulse_inverts_shaft_speed(omega, voltage):
    slow_minus, slow_plus = ESC.slowest
    back = float(ESC.shaft_speed(ESC.pulse(omega, voltage), voltage))
    if slow_minus < omega < slow_plus:
        assert ESC.pulse(omega, voltage) == ESC.pulse_neutral and back == 0.0
    else:
        assert back == pytest.approx(omega, rel=1e-9)


def test_the_dead_band_narrows_with_voltage_as_the_slowest_speed_stays():
    """From 10 V to 20 V the manufacturer's table shows no motion up to ±40, 36, 32, 28, 28, 26 µs."""
    widths = [ESC.dead_band(volts)[1] - 1500.0 for volts in (10, 12, 14, 16, 18, 20)]
    np.testing.assert_allclose(widths, [40, 36, 32, 28, 28, 28], atol=4.0)  # the table steps by 4 µs
    assert ESC.shaft_speed([1470.5, 1529.5]).tolist() == [0.0, 0.0]
    np.testing.assert_allclose(ESC.shaft_speed([1470.0, 1530.0]), ESC.slowest)


def test_pulses_broadcast_with_voltages_and_saturate():
    speeds = ESC.shaft_speed([[1900.0], [2100.0]], [12.0, 16.0])
    assert speeds.shape == (2, 2)
    np.testing.assert_array_equal(speeds[0], speeds[1])
    assert speeds[0, 0] < speeds[0, 1]
    assert ESC.shaft_speed(0.0) == 0.0, "no signal: the motor is off"
    assert np.isnan(ESC.shaft_speed(np.nan)) and np.isnan(ESC.shaft_speed(1700.0, np.nan))
    np.testing.assert_array_equal(ESC.pulse([-1e4, 0.0, 1e4]), [1100.0, 1500.0, 1900.0])


def test_reversed_wiring_mirrors_the_pulse():
    """With motor_sign -1 short pulses give positive thrust, by the forward law; no signal still means off."""
    vehicle = load_vehicle("bluerov2")
    plain = vehicle.thrusters["T1"]
    turned = vehicle.replace({"thrusters.T1.motor_sign": -1, "autopilot.directions": [-1]}).thrusters["T1"]
    np.testing.assert_allclose(
        turned.shaft_speed([1300.0, 1800.0, 0.0]), plain.shaft_speed([1700.0, 1200.0, 0.0])
    )
    np.testing.assert_allclose(turned.shaft_speed(turned.pulse([-100.0, 120.0])), [-100.0, 120.0])


@given(force=st.floats(-50.0, 50.0))
def test_speed_inverts_thrust(force):
    thruster = load_vehicle("bluerov2").thrusters["T1"]
    assert thruster.thrust(thruster.speed(force)) == pytest.approx(force, abs=1e-12)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"dead_plus": 1490.0}, "must rise in this order"),
        ({"zero_minus": 1450.0}, "must rise in this order"),
        ({"emf_plus": 0.0, "load_plus": 0.0}, "emf_plus and load_plus are both 0"),
        ({"emf_minus": -1.0}, "emf_minus is -1.0, expected >= 0"),
    ],
)
def test_impossible_numbers_are_refused_by_name(change, said):
    vehicle = load_vehicle("bluerov2")
    with pytest.raises(VehicleError, match=f"esc.*{said}"):
        vehicle.replace({f"thrusters.T1.esc.{key}": value for key, value in change.items()})


def test_a_thruster_without_the_section_says_what_to_do():
    with pytest.raises(VehicleError, match="no 'esc' section.*finssim calibrate thruster"):
        load_vehicle("finsrov").thrusters["V_LF"].shaft_speed(1600.0)


def test_a_group_gives_its_thrusters_their_speed_controller(tmp_path):
    """`esc` is allowed in `thruster_groups`; a vehicle without one keeps the digest from before the key
    existed."""
    numbers = ", ".join(f"{key}: {value}" for key, value in NUMBERS.items())
    with_esc = MINNOW.replace("domain: speed,", f"domain: speed, esc: {{{numbers}}},")
    for name, text in (("plain", MINNOW), ("wired", with_esc)):
        (tmp_path / f"{name}.yaml").write_text(text)
    plain, wired = (load_vehicle(tmp_path / f"{name}.yaml") for name in ("plain", "wired"))
    assert all(thruster.esc == ESC for thruster in wired.thrusters.values())
    assert wired.origin_of("thrusters.up.esc.load_plus").origin == "measured"
    assert all("esc" not in thruster for thruster in plain.values()["thrusters"].values())
    assert plain.sha256 != wired.sha256
