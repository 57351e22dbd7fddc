"""Reaction torque of propellers: in the thrust matrix, in motion, and with a counter-rotating pair."""

import numpy as np
import pytest

import finssim as fs
from finssim.vehicles.part import VehicleError

K = 1.0e-4


def single(folder, constant=K):
    text = "extends: remus100\norigin: guessed\nsource: own\n"
    (folder / "screw.yaml").write_text(f"{text}thrusters: {{propeller: {{torque_constant: {constant}}}}}\n")
    return fs.load_vehicle(folder / "screw.yaml")


def test_the_matrix_has_the_torque_of_the_shaft_speed(tmp_path):
    """At every speed the moment is that of the arm minus k ω|ω| along the axis; left-handed propellers are
    opposite."""
    plain = fs.load_vehicle("remus100").replace({"thrusters.propeller.torque_constant": 0.0})
    for constant in (K, -K):
        vehicle = single(tmp_path, constant)
        thruster = vehicle.thrusters["propeller"]
        for omega in (-90.0, 30.0, 150.0):
            thrust = float(thruster.thrust(omega))
            expected = plain.thruster_matrix()[:, 0] * thrust
            expected[3:] -= constant * omega * abs(omega) * np.asarray(thruster.axis)
            np.testing.assert_allclose(
                vehicle.thruster_matrix()[:, 0] * thrust, expected, rtol=1e-12, atol=1e-12
            )
    assert single(tmp_path, 0.0).thruster_matrix().tolist() == plain.thruster_matrix().tolist()


@pytest.mark.parametrize(("constant", "side"), [(K, -1.0), (-K, 1.0)])
def test_a_vehicle_with_one_screw_rolls_against_it(tmp_path, constant, side):
    """It rolls about the heel at which weight balances the torque, because it gains speed and pitches
    meanwhile."""
    vehicle = single(tmp_path, constant)
    simulator = fs.Simulator(vehicle, control_step=0.02)
    simulator.place(position=(0.0, 0.0, -20.0))
    simulator.set_thrust([10.0])
    rolls = []
    for _ in range(150):
        simulator.step()
        x, y, z, w = simulator.numpy("quaternion")[0, 0].astype(float)
        rolls.append(np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)))
    torque = K * 10.0 / vehicle.thrusters["propeller"].c_plus
    weight = vehicle.body.mass * vehicle.water.gravity
    arm = vehicle.body.center_of_buoyancy[2] - vehicle.body.center_of_gravity[2]
    assert side * np.mean(rolls[-50:]) == pytest.approx(np.arcsin(torque / (weight * arm)), rel=0.2)


def test_two_that_turn_against_each_other_cancel(tmp_path):
    (tmp_path / "twin.yaml").write_text(
        "extends: finsrov\norigin: guessed\nsource: own\nthrusters:\n"
        "  H_LF: {torque_constant: 1.0e-5}\n  H_RB: {torque_constant: 1.0e-5}\n"
    )
    twin, plain = fs.load_vehicle(tmp_path / "twin.yaml"), fs.load_vehicle("finsrov")
    change = twin.thruster_matrix() - plain.thruster_matrix()
    for name in ("H_LF", "H_RB"):  # of one kind, with opposite axes
        thruster, column = twin.thrusters[name], change[:, twin.thruster_names.index(name)]
        q = -1.0e-5 / (0.5 * (thruster.c_plus + thruster.c_minus))
        np.testing.assert_allclose(column, [0.0, 0.0, 0.0, *(q * np.asarray(thruster.axis))], atol=1e-15)
    assert np.count_nonzero(np.abs(change).sum(axis=0)) == 2
    assert change[3].sum() == pytest.approx(0.0, abs=1e-12)


def test_a_constant_that_is_no_number_is_refused(tmp_path):
    with pytest.raises(VehicleError, match="torque_constant"):
        single(tmp_path, "fast")
