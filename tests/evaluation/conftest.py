"""Small experiments for the tests: they run in one process, since another takes seconds to start."""

import os
from dataclasses import replace

import pytest

from finssim.control.trajectories import TRAJECTORIES, polyline
from finssim.evaluation import metrics
from finssim.evaluation.records import read_record
from finssim.evaluation.robot_trials import RobotJob
from finssim.identification import programme

BRIEF_STEPS = (("rest", 0.5), ("baseline", 1.0), ("excitation", 4.0), ("coast", 2.0), ("rest", 0.5))


@pytest.fixture(scope="session", autouse=True)
def one_processor():
    """A machine with one processor: a default number of processes is one; an explicit number is kept."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "cpu_count", lambda: 1)
        yield


@pytest.fixture(scope="module")
def brief_t1():
    """Trials of T1 of 16 s instead of 60, with late errors from the last six, for tests of trials' outputs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(metrics, "EVALUATION_WINDOW", (10.0, 16.0))
        for function in (RobotJob.__init__, read_record):
            patch.setitem(function.__kwdefaults__, "duration", 16.0)
        yield


@pytest.fixture(scope="module")
def brief_steps():
    """Steps of force of 4 s instead of 9, for tests that do not check the fits."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(programme.PLANS, "step", BRIEF_STEPS)
        yield


@pytest.fixture
def brief_straight(monkeypatch):
    """The straight trajectory, ending after the first third of its path, at unchanged speed."""
    whole = TRAJECTORIES["straight"]
    first, last = (whole.at(t).position for t in (0.0, whole.duration))
    time, motion = polyline([first, first + (last - first) / 3.0], [whole.duration / 3.0])
    monkeypatch.setitem(TRAJECTORIES, "straight", replace(whole, duration=time, motion=motion))
