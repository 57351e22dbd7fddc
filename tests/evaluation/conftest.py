"""Experiments of tests are small: they stay in one process, since another takes seconds to start."""

import os

import pytest

from finssim.evaluation import metrics
from finssim.evaluation.records import read_record
from finssim.evaluation.robot_trials import RobotJob


@pytest.fixture(scope="session", autouse=True)
def one_processor():
    """What asks for as many processes as there are processors gets one; who names a number gets that."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "cpu_count", lambda: 1)
        yield


@pytest.fixture(scope="module")
def brief_t1():
    """Trials of T1 last 20 s in place of 60, with the late errors from the last eight: where only what is made of a
    trial is tested."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(metrics, "EVALUATION_WINDOW", (12.0, 20.0))
        for function in (RobotJob.__init__, read_record):
            patch.setitem(function.__kwdefaults__, "duration", 20.0)
        yield
