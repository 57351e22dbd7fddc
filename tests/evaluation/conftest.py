"""Experiments of tests are small: they stay in one process, since another takes seconds to start."""

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
    """What asks for as many processes as there are processors gets one; who names a number gets that."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "cpu_count", lambda: 1)
        yield


@pytest.fixture(scope="module")
def brief_t1():
    """Trials of T1 last 16 s in place of 60, with the late errors from the last six: where only what is made of a
    trial is tested."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(metrics, "EVALUATION_WINDOW", (10.0, 16.0))
        for function in (RobotJob.__init__, read_record):
            patch.setitem(function.__kwdefaults__, "duration", 16.0)
        yield


@pytest.fixture(scope="module")
def brief_steps():
    """Steps of force last 4 s in place of 9: where the fits that they are made for are not tested."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(programme.PLANS, "step", BRIEF_STEPS)
        yield


@pytest.fixture
def brief_straight(monkeypatch):
    """The straight trajectory ends after the first third of its way, at the speed that it has."""
    whole = TRAJECTORIES["straight"]
    first, last = (whole.at(t).position for t in (0.0, whole.duration))
    time, motion = polyline([first, first + (last - first) / 3.0], [whole.duration / 3.0])
    monkeypatch.setitem(TRAJECTORIES, "straight", replace(whole, duration=time, motion=motion))
