"""The Slocum glider of the catalogue: steady glides compared with its polar, and effects of its actuators."""

import math

import numpy as np
import pytest

from finssim.core.rotations import quat_to_euler
from finssim.sim import Simulator
from finssim.vehicles import load_vehicle

SLOCUM = load_vehicle("slocum")
POLAR = SLOCUM.hydrodynamics["calibrated"].lift_drag
MASS, BATTERY, GRAVITY = 50.0, 9.0, 9.816


def polar(path):
    """Return angle of attack and speed per root of net weight of a steady glide at a path angle, negative downwards.

    The forces L = l V² sin α cos α and D = (d + k sin² α) V² balance the net weight, and tan γ = -D/L. The bow is above
    the path of a dive, so that the wings lift. Returns α [rad] and V² / |W - B| [1/kg m].
    """
    alpha = np.linspace(1e-4, math.radians(20.0), 200_001)
    lift = POLAR.lift * np.sin(alpha) * np.cos(alpha)
    drag = POLAR.drag + POLAR.induced * np.sin(alpha) ** 2
    k = np.argmin(np.abs(drag / lift - math.tan(abs(path))))  # the flatter of the two solutions
    return alpha[k], 1.0 / math.hypot(lift[k], drag[k])


def shift_of(path, net):
    """Return the battery position [m] at which the pitching moments vanish in a glide, by hand.

    Moments are the Munk moment (A3 - A1) u w, the relief of 100 kg u w, and the battery's weight below the centre of
    buoyancy.
    """
    alpha, share = polar(path)
    pitch = path + (alpha if path < 0 else -alpha)  # nose up
    square = share * net
    u, w = math.sqrt(square) * math.cos(alpha), math.sqrt(square) * math.sin(alpha) * (1 if path < 0 else -1)
    added = SLOCUM.hydrodynamics["calibrated"].added_mass
    moment = (added[2, 2] - added[0, 0] - SLOCUM.hydrodynamics["calibrated"].munk_relief[2]) * u * w
    # z down and w positive downwards: nose-up moment of water; a battery ahead pitches nose down, one below rights.
    return (moment / (BATTERY * GRAVITY) - 0.05 * math.sin(pitch)) / math.cos(pitch), pitch, math.sqrt(square)


def glide(volume, way, rudder=0.0, duration=400.0):
    """Return final path angle, pitch (nose up) [rad], speed [m/s] and turning rate [rad/s] under these
    commands."""
    sim = Simulator(SLOCUM, control_step=0.1, substeps=2, threads=1)
    sim.place(position=(0.0, 0.0, -200.0))
    sim.set_actuators([volume, way, rudder])
    for _ in range(round(duration / 0.1)):
        sim.step()
    nu = sim.numpy("velocity")[0, 0].astype(float)
    yaw_rate = nu[5]
    roll, pitch, _ = (float(x) for x in quat_to_euler(sim.numpy("quaternion")[0, 0].astype(float)))
    rise = -math.sin(pitch) * nu[0] + math.cos(pitch) * (math.sin(roll) * nu[1] + math.cos(roll) * nu[2])
    speed = float(np.linalg.norm(nu[:3]))
    return math.asin(rise / speed), -pitch, speed, yaw_rate


@pytest.mark.slow
@pytest.mark.parametrize("path", [-0.44, -0.6, 0.44])
def test_steady_glides_are_those_of_the_polar(path):
    """Glide angle, pitch and speed match within 1 % at the polar's volume and battery position."""
    volume = math.copysign(1.0e-4, path)
    net = 1025.0 * GRAVITY * abs(volume)
    way, pitch, speed = shift_of(path, net)
    found = glide(volume, way)
    assert found[0] == pytest.approx(path, rel=0.01) and found[1] == pytest.approx(pitch, rel=0.01)
    assert found[2] == pytest.approx(speed, rel=0.01) and abs(found[3]) < 1e-4


def test_the_polar_of_the_source_at_its_own_glide():
    """AUG-Simulator's glide of 25° down at 0.3 m/s has 47 g of ballast, α of 2.0°, and its battery 20 mm
    ahead."""
    alpha, share = polar(math.radians(-25.0))
    assert math.degrees(alpha) == pytest.approx(2.0, abs=0.05)
    assert 0.09 / share / GRAVITY == pytest.approx(0.0471, abs=5e-4)
    assert shift_of(math.radians(-25.0), 0.09 / share)[0] == pytest.approx(0.0199, abs=2e-4)


@pytest.mark.slow
def test_its_rudder_turns_it():
    """In a dive a positive angle turns the glider to starboard, and a negative one equally to port."""
    way, _, _ = shift_of(-0.44, 1025.0 * GRAVITY * 1e-4)
    right, left = (glide(-1e-4, way, rudder)[3] for rudder in (0.2, -0.2))
    assert right < -0.005 and left == pytest.approx(-right, rel=0.02)
