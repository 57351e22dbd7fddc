"""Laws of the brake: zero when closed or at rest, dissipative, and proportional to its value."""

import numpy as np
from brake import BRAKE

import finssim as fs
from finssim.core import ACTUATORS

if "brake" not in ACTUATORS:  # not installed yet
    ACTUATORS["brake"] = BRAKE

DEEP = [0.0, 0.0, -10.0, 0.0, 0.0, 0.0]
NU = np.random.default_rng(1).uniform(-1.0, 1.0, (64, 6))


def wrench(nu, value):
    """Return the wrench that the actuator adds on a vehicle at velocities `nu`, body frame, (n, 6) [N, N m]."""
    plain = fs.load_vehicle("bluerov2")
    section = {"kind": "brake", "position": [-0.3, 0.0, 0.0], "size": 0.05, "minimum": 0.0, "maximum": 1.0}
    vehicle = plain.replace({"actuators": {"brake": section}})
    values = np.zeros(len(vehicle.channel_names))
    values[-1] = value
    gained = fs.acceleration(vehicle, DEEP, nu, actuators=values) - fs.acceleration(plain, DEEP, nu)
    return gained @ plain.mass_matrix().T


def test_it_does_nothing_when_closed_or_at_rest():
    np.testing.assert_allclose(wrench(NU, 0.0), 0.0, atol=1e-3)
    np.testing.assert_allclose(wrench(np.zeros((1, 6)), 1.0), 0.0, atol=1e-3)


def test_it_takes_power_in_proportion_to_its_value():
    tau = wrench(NU, 1.0)
    assert (np.sum(tau * NU, axis=1) < 1e-3).all()
    np.testing.assert_allclose(wrench(NU, 0.5), 0.5 * tau, rtol=1e-3, atol=1e-2)
