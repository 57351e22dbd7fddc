"""Laws of the wing: zero at rest and without parameters, and dissipative."""

import numpy as np
from wing import WING

import finssim as fs
from finssim.core import TERMS
from finssim.physics import add_term

if "wing" not in TERMS:  # not installed yet
    add_term(WING)

DEEP = [0.0, 0.0, -10.0, 0.0, 0.0, 0.0]
NU = np.random.default_rng(1).uniform(-1.0, 1.0, (64, 6))


def wrench(nu, **parameters):
    """Return the wrench that the term adds on a vehicle at velocities `nu`, body frame, (n, 6) [N, N m]."""
    plain = fs.load_vehicle("bluerov2")
    vehicle = plain.replace({"hydrodynamics.calibrated.wing": parameters})
    gained = fs.acceleration(vehicle, DEEP, nu) - fs.acceleration(plain, DEEP, nu)
    return gained @ plain.mass_matrix().T


def test_it_does_nothing_at_rest_and_without_parameters():
    np.testing.assert_allclose(wrench(np.zeros((1, 6)), lift=40.0), 0.0, atol=1e-3)
    np.testing.assert_allclose(wrench(NU, lift=0.0), 0.0, atol=1e-3)


def test_it_takes_power_and_grows_with_its_parameter():
    tau = wrench(NU, lift=40.0, moment=5.0)
    assert (np.sum(tau * NU, axis=1) < 1e-3).all()
    np.testing.assert_allclose(wrench(NU, lift=80.0, moment=10.0), 2.0 * tau, rtol=1e-3, atol=1e-2)
