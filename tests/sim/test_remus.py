"""REMUS 100 beside PythonVehicleSimulator: straight, depth and heading, with its propeller, fins and autopilot."""

import math

import pytest

from reference.remus import STEP, Autopilot, Remus, run, step_response

STRAIGHT, DEPTH, TURN = 60.0, 400.0, 200.0
"""Durations of the runs [s]."""


def steered(vehicle, duration, **targets):
    autopilot = Autopilot(**targets)

    def command(eta, nu):
        return *autopilot.command(eta[2], eta[4], eta[5], nu[2], nu[4], nu[5], STEP), 1525.0

    return run(vehicle, duration, command)


def test_the_reference_runs_as_pythonvehiclesimulator_reports():
    """148 m in 60 s and 2.55 m/s at 1525 rpm, to the digits that its own program gives: 148.345431, 2.553646."""
    _, eta, nu = run(Remus(), STRAIGHT, lambda eta, nu: (0.0, 0.0, 1525.0))
    assert eta[-1, 0] == pytest.approx(148.345431, abs=1e-5) and nu[-1, 0] == pytest.approx(
        2.5536456, abs=1e-6
    )
    assert eta[-1, 2] == pytest.approx(0.588508165, abs=1e-6) and eta[-1, 3] == pytest.approx(
        0.01778102, abs=1e-7
    )


@pytest.mark.slow
def test_the_reference_steps_as_pythonvehiclesimulator_does():
    """Its own program: 30 m of depth overshoots by 41.7439 mm and settles in 175.98 s, 50° of heading in 82.74 s."""
    times, eta, _ = steered(Remus(), DEPTH, depth=30.0)
    overshoot, settled = step_response(times, eta[:, 2], 30.0)
    assert overshoot * 30.0 == pytest.approx(0.041743944, abs=1e-6) and settled == pytest.approx(
        175.98, abs=1e-6
    )
    times, eta, nu = steered(Remus(), TURN, heading=math.radians(50.0))
    overshoot, settled = step_response(times, eta[:, 5], math.radians(50.0))
    assert overshoot == 0.0 and settled == pytest.approx(82.74, abs=1e-6)
    assert abs(nu[:, 1]).max() == pytest.approx(0.10792867, abs=1e-6)
