"""Conditions for the start of a robot trial: at rest at its start, or roughly there if it need not be exact."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from finssim.control.guidance import Station
from finssim.core.rotations import quat_from_yaw
from finssim.evaluation.robot_trials import RobotTrial, TrialStages, start_bounds
from finssim.robot.perception import Perception
from finssim.robot.pilots import WrenchPilot
from finssim.robot.reading import Reading
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
START = Station((0.5, -0.2, -0.5), 0.3)


def waited(attendant):
    """Return how and when [s] the wait ends for a vehicle that sends nothing for two minutes."""
    pilot = WrenchPilot(lambda: np.zeros(6), FINSROV, name="idle")
    trial = RobotTrial(name="x", pilot=pilot, guide=START, duration=1.0, over=lambda runtime: False)

    def drive(runtime, until, **_):
        for now in range(120):
            runtime.reading = Reading(
                time=float(now),
                position=np.full(3, np.nan),
                quaternion=quat_from_yaw(0.0),
                nu=np.zeros(6),
                ready=False,
                reason="no telemetry yet",
            )
            if until(runtime):
                return

    outcome = TrialStages(trial, FINSROV, START, start_bounds("pool", True), attendant=attendant).play(
        drive, Perception(FINSROV, None)
    )
    return outcome.ended, outcome.fault, outcome.runtime.reading.time


def test_nobody_waits_for_ever_for_a_vehicle_that_says_nothing():
    """Without an attendant the trial ends after a minute with a reason; an attendant may wait."""
    assert waited(None) == ("not there", "its state is unknown after 60 s: no telemetry yet", 61.0)
    beside = SimpleNamespace(keys=lambda: (), line=lambda text: None)
    assert waited(beside) == ("interrupted", "not finished", 119.0)


def begins(exact, off, turn_deg, speed, rate_deg, site="pool"):
    """Return when [s] a vehicle that circles its start at a distance and speed may begin; None if not within 20 s."""
    pilot = WrenchPilot(lambda: np.zeros(6), FINSROV, name="idle")
    trial = RobotTrial(name="x", pilot=pilot, guide=START, duration=1.0, over=lambda runtime: False)
    stages = TrialStages(trial, FINSROV, START, start_bounds(site, exact))
    for now in np.arange(0.0, 20.0, 0.1):
        reading = Reading(
            time=now,
            position=np.array(START.position) + (off, 0.0, 0.0),
            quaternion=quat_from_yaw(START.yaw + math.radians(turn_deg)),
            nu=np.array([speed, 0.0, 0.0, 0.0, 0.0, math.radians(rate_deg)]),
            ready=True,
        )
        if stages.there(reading, now):
            return now
    return None


@pytest.mark.parametrize("exact", [True, False])
def test_a_vehicle_at_rest_at_its_start_begins_after_two_seconds(exact):
    """A vehicle within 10 cm and 10°, slower than 5 cm/s and 5°/s, begins after two seconds."""
    assert begins(exact, 0.05, 5.0, 0.02, 2.0) == pytest.approx(2.0)


def test_one_that_circles_its_start_begins_where_it_need_not_be_exact():
    """A vehicle 12° off at 17°/s, as with a PID tuned from guesses, begins after 10 s, but never at an exact start."""
    assert begins(False, 0.05, 12.0, 0.02, 17.0) == pytest.approx(10.0)
    assert begins(True, 0.05, 12.0, 0.02, 17.0) is None


@pytest.mark.parametrize("far", [(0.2, 0.0, 0.0, 0.0), (0.0, 25.0, 0.0, 0.0), (0.0, 0.0, 0.15, 0.0)])
def test_one_that_is_farther_off_never_begins(far):
    """Beyond 15 cm, 20° or 10 cm/s the trial never begins."""
    assert begins(False, *far) is None


def test_in_waves_nothing_is_at_rest():
    """In open water 30 cm, 20° and 0.4 m/s are near enough, at any rate; farther off they are not."""
    assert begins(True, 0.25, 15.0, 0.3, 30.0, site="open-water") == pytest.approx(2.0)
    assert begins(True, 0.35, 15.0, 0.3, 30.0, site="open-water") is None
    assert begins(True, 0.25, 15.0, 0.3, 30.0, site="tank") is None
