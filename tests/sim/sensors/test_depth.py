"""The pressure gauge: geometry of its port, and its pressure."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp
from scipy import stats
from scipy.spatial.transform import Rotation

from finssim.sim.sensors import SensorSuite
from finssim.sim.sensors.depth import depth_of_point
from finssim.vehicles import catalogue, load_vehicle

WITH_DEPTH = [name for name in catalogue() if load_vehicle(name).sensors.depth is not None]


@pytest.mark.parametrize("name", WITH_DEPTH)
def test_pressure_grows_by_the_weight_of_the_water_above(name: str, rest: Any, ideal: Any) -> None:
    """p = p_atm + rho g d at the port, which hangs at its mount and not at the body origin."""
    vehicle = load_vehicle(name)
    suite = SensorSuite(vehicle, worlds=1, control_step=0.1)
    ideal(suite.depth)
    suite.reset(rest(1).put(position=[0.0, 0.0, -10.0]))
    depth = 10.0 - vehicle.sensors.depth.position[2]
    assert suite.depth.depth.numpy()[0, 0] == pytest.approx(depth, rel=1e-6)
    pressure = 101325.0 + vehicle.water.density * vehicle.water.gravity * depth
    assert suite.depth.pressure.numpy()[0, 0] == pytest.approx(pressure, rel=1e-6)


def test_it_measures_at_its_port_when_the_vehicle_leans() -> None:
    """A port below the origin rises by the cosines of roll and pitch: z_b = -depth - o_z cos φ cos θ (FinsROV)."""
    roll, pitch, z_b, o_z = 0.3, -0.2, -0.5, -0.115
    q = wp.quat(*Rotation.from_euler("ZYX", [1.1, pitch, roll]).as_quat())
    depth = depth_of_point(wp.vec3(3.0, -2.0, z_b), q, wp.vec3(0.0, 0.0, o_z))
    assert -depth - o_z * np.cos(roll) * np.cos(pitch) == pytest.approx(z_b, abs=1e-7)


def test_in_air_it_reads_the_atmosphere() -> None:
    """There is no negative depth: pressure above the surface is that of the air."""
    assert depth_of_point(wp.vec3(0.0, 0.0, 0.4), wp.quat_identity(), wp.vec3(0.0, 0.0, -0.1)) == 0.0


def test_noise_and_turn_on_bias_have_the_spread_of_the_file(vehicle: Any, rest: Any, ideal: Any) -> None:
    """Over many worlds the error of the first reading is normal with variance noise² + turn-on²."""
    worlds, noise, turn_on = 5000, 0.004, 0.03
    suite = SensorSuite(vehicle, worlds=worlds, control_step=0.1, seed=5)
    ideal(suite.depth).set(noise_std=noise, bias_initial=turn_on)
    suite.reset(rest(worlds).put(position=[0.0, 0.0, -1.0]))
    error = suite.depth.depth.numpy().ravel() - (1.0 - vehicle.sensors.depth.position[2])
    assert stats.kstest(error, stats.norm(0.0, np.hypot(noise, turn_on)).cdf).pvalue > 1e-4
    bias = suite.depth.bias.numpy().ravel()
    assert stats.kstest(bias, stats.norm(0.0, turn_on).cdf).pvalue > 1e-4
    assert 1e-4 < stats.chi2.cdf((((error - bias) / noise) ** 2).sum(), worlds) < 1 - 1e-4
