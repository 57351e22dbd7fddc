"""The vehicle check accepts sound files and names what is wrong in others."""

from __future__ import annotations

import numpy as np
import pytest

from finssim import acceleration
from finssim.vehicles import Vehicle, catalogue, check_vehicle, load_vehicle
from finssim.vehicles.capability import panel_drag


def failed(vehicle: Vehicle) -> dict[str, str]:
    return {finding.name: finding.sentence for finding in check_vehicle(vehicle) if not finding.passed}


@pytest.mark.parametrize("name", catalogue())
def test_every_catalogue_vehicle_passes(name):
    assert failed(load_vehicle(name)) == {}


@pytest.mark.parametrize("name", catalogue())
def test_findings_have_distinct_names_and_a_sentence(name):
    findings = check_vehicle(load_vehicle(name))
    assert len({finding.name for finding in findings}) == len(findings)
    assert all(len(finding.sentence.split()) > 4 for finding in findings)


def test_damping_that_feeds_energy_in_is_found():
    vehicle = load_vehicle("finsrov").replace({"hydrodynamics.calibrated.linear_damping.1.1": -1.0})
    assert "D1 -1" in failed(vehicle)["damping (calibrated)"]


def test_coupled_quadratic_damping_that_feeds_energy_in_is_found():
    D2 = np.diag([20.0, 20.0, 20.0, 1.0, 1.0, 1.0])
    D2[1, 5] = 200.0
    vehicle = load_vehicle("finsrov").replace({"hydrodynamics.calibrated.quadratic_damping": D2})
    assert "D2 couples axes" in failed(vehicle)["damping (calibrated)"]


def test_surge_damping_that_feeds_energy_in_is_found():
    vehicle = load_vehicle("remus100").replace(
        {"hydrodynamics.calibrated.surge_damping": [0, -3, 0, 0, 0, 0]}
    )
    assert "Du: -3" in failed(vehicle)["surge_damping (calibrated)"]


def test_an_axis_no_thruster_moves_is_found():
    vehicle = load_vehicle("bluerov2").replace(
        {"controlled_axes": ["surge", "sway", "heave", "roll", "pitch", "yaw"]}
    )
    assert "rank 5 for 6 controlled axes" in failed(vehicle)["allocation"]


def test_a_limit_beyond_the_thrust_curve_is_found():
    vehicle = load_vehicle("finsrov").replace({"thrusters.V_LB.force_max": 9.0})
    assert "(V_LB, forward)" in failed(vehicle)["thrust curves"]


def test_trim_out_of_reach_is_found():
    assert (
        "exceeds the limits of the thrusters"
        in failed(load_vehicle("finsrov").replace({"body.mass": 16.0}))["trim"]
    )


def test_a_vehicle_that_would_turn_over_is_found():
    vehicle = load_vehicle("finsrov").replace({"body.center_of_gravity": [0.0, 0.0, 0.05]})
    assert "turns over" in failed(vehicle)["upright"]


def test_a_hull_of_another_volume_is_found():
    assert set(failed(load_vehicle("rexrov").replace({"hull.scale": 1.0}))) == {"hull volume"}


def test_a_hull_that_cannot_be_built_is_found():
    assert "does not fit" in failed(load_vehicle("finsrov").replace({"body.size": [0.2, 0.2, 0.2]}))["hull"]


def remark(vehicle: Vehicle) -> str | None:
    (found,) = (finding for finding in check_vehicle(vehicle) if finding.name == "hydrodynamic sets")
    assert found.passed
    return found.sentence if found.remark else None


def test_sets_of_one_vehicle_that_disagree_are_remarked():
    """bluerov2_heavy: identified drag and that of its panels differ by a factor of 2.5 in surge, 1.4 in
    heave."""
    heavy = load_vehicle("bluerov2_heavy")
    assert "127 N of surge give 'calibrated' 0.90, 'mesh' 2." in (remark(heavy) or "")
    assert "heave" not in (remark(heavy) or "")
    sets = {"linear_damping": np.zeros(6), "quadratic_damping": np.diag([*panel_drag(heavy), 1.0, 1.0, 1.0])}
    alike = heavy.replace({f"hydrodynamics.calibrated.{key}": value for key, value in sets.items()})
    assert remark(alike) is None


@pytest.mark.parametrize("name", ["finsrov", "rexrov"])
def test_drag_of_panels_is_that_of_the_simulated_hull(name):
    """M dν/dt of a submerged level vehicle at 1 m/s, minus that at rest, is -d2 along the axis, in either
    direction."""
    vehicle = load_vehicle(name)
    eta, M = [0.0, 0.0, -50.0, 0.0, 0.0, 0.0], vehicle.mass_matrix("mesh")
    rest = acceleration(vehicle, eta, np.zeros(6), hydrodynamics="mesh")
    for axis in range(3):
        for sign in (1.0, -1.0):
            nu = sign * np.eye(6)[axis]
            force = M @ (acceleration(vehicle, eta, nu, hydrodynamics="mesh") - rest)
            assert -sign * force[axis] == pytest.approx(panel_drag(vehicle)[axis], rel=2e-3)
