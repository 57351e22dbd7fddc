"""Stability without control: eigenvalues of the linear model in closed form, and growth in the simulation."""

import json
import math

import numpy as np
import pytest

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.sim.free_motion import FreeMotion, stability
from finssim.vehicles import load_vehicle
from finssim.vehicles.capability import restoring
from reference.imported import simulated
from vehicles.minnow import MINNOW


def course_matrix(vehicle, u):
    """Return A of (sway, yaw rate) at surge u with the centre of gravity above the origin (Fossen 2021, eq. 6.104).

    The rudder is at zero deflection: its lift is proportional to v + x r.
    """
    chosen, m = vehicle.hydrodynamics["calibrated"], vehicle.body.mass
    A, Du, both = chosen.added_mass, chosen.surge_damping, np.ix_([1, 5], [1, 5])
    rudder, a = vehicle.actuators["rudder"], A.diagonal()[:2] - chosen.munk_relief[:2]
    lift, x = 0.5 * vehicle.water.density * rudder.area * rudder.lift_slope, rudder.position[0]
    fin = lift * np.array([[1.0, x], [x, x * x]])
    N = u * (Du[both] + fin + [[0.0, m + a[0]], [a[1] - a[0], A[1, 5]]])
    return -np.linalg.solve(vehicle.mass_matrix()[both], N)


def test_course_of_remus_in_closed_form():
    """Munk moment, lift and yaw damping are all proportional to the speed, so the course is unstable at any
    speed."""
    vehicle = load_vehicle("remus100")
    top, motions = stability(vehicle)
    expected = np.linalg.eigvals(course_matrix(vehicle, top)).real.max()
    assert motions["course"].at_top_speed.real == pytest.approx(expected, rel=0.01) and expected > 1.0
    slowest = 5e-3 / expected * top  # where the rate is 5e-3 1/s
    assert slowest <= motions["course"].unstable_above <= slowest + 0.02 * top
    assert motions["pitch"].unstable_above == pytest.approx(0.62, abs=0.03)


def test_roll_of_a_vehicle_without_linear_damping_swings_at_its_natural_frequency():
    vehicle = load_vehicle("bluerov2_heavy")
    roll = stability(vehicle)[1]["roll"]
    assert abs(roll.at_rest.imag) == pytest.approx(
        2 * math.pi * restoring(vehicle).natural_frequency[0], rel=0.01
    )
    assert roll.unstable_above is None


@pytest.mark.slow
def test_a_disturbance_grows_in_the_simulation_as_it_is_reported():
    """REMUS 100 at 2 m/s with a yaw rate of 0.002 rad/s grows e-fold in the time of the eigenvalue."""
    vehicle = load_vehicle("remus100")
    values, vectors = np.linalg.eig(course_matrix(vehicle, 2.0))
    k = values.real.argmax()
    nu, tau = np.zeros((1, 6)), np.zeros((1, 6))
    nu[0, 0], nu[0, [1, 5]] = 2.0, 0.002 * vectors[:, k].real
    tau[0, :3] = [6.109 * 4.0, 0.0, vehicle.weight - vehicle.buoyancy]
    found = simulated(vehicle, np.eye(3)[None], nu, tau, 1.0)[:, 0, 5]
    rate = math.log(found[-1] / found[0])
    top, motions = stability(vehicle)
    assert rate == pytest.approx(motions["course"].at_top_speed.real * 2.0 / top, rel=0.03)


def test_an_eigenvalue_in_words():
    assert FreeMotion.words(complex(-0.5, 0.0)) == "dies out in 2 s"
    assert FreeMotion.words(complex(0.25, math.pi)) == "grows e-fold in 4 s, period 2 s"
    assert FreeMotion.words(complex(0.0, 2 * math.pi)) == "neutral, period 1 s"


@pytest.mark.slow
def test_show_says_what_a_vehicle_does_without_control(capsys):
    assert boundary.run(app, ["vehicles", "show", "remus100"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "Without control" in text and "unstable above" in text and "grows e-fold in 0.584 s" in text
    assert boundary.run(app, ["vehicles", "show", "finsrov", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["without_control"]
    assert told["roll"][2] is None and 0.1 < told["course"][2] < 0.3


@pytest.mark.slow
def test_show_of_a_vehicle_whose_set_has_another_name(tmp_path, capsys):
    """No simulation model has this parameter set; the rest is shown."""
    (tmp_path / "minnow.yaml").write_text(MINNOW.replace("  calibrated:", "  mine:"))
    assert boundary.run(app, ["vehicles", "show", str(tmp_path / "minnow.yaml")]) == 0
    assert "Without control" not in capsys.readouterr().out
