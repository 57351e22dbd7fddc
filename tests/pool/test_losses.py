"""Thrust is lost to the hull, to motion and to neighbours."""

import numpy as np
import pytest

from finssim.pool import draw_plant
from finssim.pool.plant import Plant, induced_shares
from finssim.pool.plant_spec import Basin, Circulation, Propellers
from finssim.vehicles import load_vehicle

LEVEL = (0.0, 0.0, 0.0, 1.0)
FINSROV = load_vehicle("finsrov")
NOMINAL = draw_plant(FINSROV, 0, "nominal").model_copy(
    update={"circulation": Circulation(), "basin": Basin(length=100.0, width=100.0, depth=50.0)}
)


def thrust(propellers, speed, surge=0.0, names=("H_LF",)):
    """Return the thrust of one thruster at a shaft speed while the vehicle moves [N]."""
    plant = Plant(
        FINSROV,
        NOMINAL.model_copy(update={"propellers": propellers}),
        start=((0.0, 0.0, -25.0), LEVEL),
    )
    index = [FINSROV.thruster_names.index(name) for name in names]
    plant.target[index] = speed
    for _ in range(400):
        plant.nu[:] = (surge, 0.0, 0.0, 0.0, 0.0, 0.0)
        plant.advance()
    return float(plant.thrust[index[0]]), float(plant.shaft_speed[index[0]])


def test_at_rest_and_alone_it_is_the_bollard_thrust():
    """The thrust is T = c ω² of the file."""
    T, omega = thrust(Propellers(), 150.0)
    assert T == pytest.approx(FINSROV.thrusters["H_LF"].thrust(omega), rel=1e-4)


def test_moving_along_the_thrust_costs_the_part_that_advance_says():
    """T = T_bollard (1 - V / (J0 n D)) with V the speed along the axis; for motion against the thrust it
    grows."""
    p = Propellers(own_share=1.0)
    T, omega = thrust(p, 150.0, surge=0.3)
    V = 0.3 * FINSROV.thrusters["H_LF"].axis[0]
    loss = V / (p.advance_at_zero_thrust * omega / (2.0 * np.pi) * p.diameter)
    assert T == pytest.approx(FINSROV.thrusters["H_LF"].thrust(omega) * (1.0 - loss), rel=1e-3)
    assert thrust(p, 150.0, surge=-0.3)[0] > T


def test_a_neighbour_takes_thrust_and_a_far_one_less():
    """The matrix of loss shares falls with distance and has a zero diagonal."""
    p = Propellers(induced_share=0.2)
    alone = thrust(p, 150.0)[0]
    assert thrust(p, 150.0, names=("H_LF", "V_LF"))[0] < thrust(p, 150.0, names=("H_LF", "H_RB"))[0] < alone
    shares = induced_shares(FINSROV, NOMINAL.model_copy(update={"propellers": p}))
    assert np.all(np.diag(shares) == 0.0) and np.allclose(shares, shares.T)


def test_the_deduction_and_the_gain_scale_the_thrust():
    """The thrust is as built, less the part that the jet takes back from the hull."""
    built = NOMINAL.thrusters["H_LF"].model_copy(update={"gain_plus": 1.2, "deduction": 0.1})
    spec = NOMINAL.model_copy(update={"thrusters": {**NOMINAL.thrusters, "H_LF": built}})
    plant = Plant(FINSROV, spec, start=((0.0, 0.0, -25.0), LEVEL))
    plant.target[4] = 150.0
    plant.advance(200)
    expected = 1.2 * 0.9 * FINSROV.thrusters["H_LF"].thrust(plant.shaft_speed[4])
    assert plant.thrust[4] == pytest.approx(expected, rel=1e-4)
