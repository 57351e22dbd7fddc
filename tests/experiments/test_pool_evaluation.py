"""Results of the virtual pool in the form of an evaluation."""

import numpy as np
import pytest

from finssim.experiments.metrics import T1_SETPOINTS, measure_trial
from finssim.experiments.pool_trial import Job, pool_evaluation
from finssim.experiments.trials import Motion
from finssim.geometry.rotations import quat_from_yaw


def held(folder, job, until=60.0):
    """A trial that ends up 3 cm above its goal, as `play` leaves it; it may end early."""
    goal = T1_SETPOINTS[job.target]
    t = np.arange(0.003, until, 0.1)
    position = goal[:3] + (0.0, 0.0, 0.03) + np.exp(-t)[:, None] * (0.5, 0.0, 0.0)
    yaw = np.full(len(t), goal[3])
    Motion(t=t, position=position, quaternion=quat_from_yaw(yaw)).write(folder / job.key())
    measures = measure_trial(t, position, yaw, goal)
    return {
        "key": job.key(),
        "job": {"target": job.target},
        "fault": "",
        "provenance": {"finssim": "0"},
        **measures,
    }


@pytest.fixture
def jobs():
    return [Job(row="pid", controller="pid", target=t, camera="corners", plant=3) for t in ("P01", "P04")]


def test_measures_and_motion_are_those_of_the_trials(tmp_path, jobs):
    """Both held, 3 cm vertically; the motion from 0 to 60 s."""
    evaluation = pool_evaluation(jobs[0], [held(tmp_path, job) for job in jobs], tmp_path)
    result = evaluation.result
    assert (result["success"], result["trials"], evaluation.label) == (2, 2, "pid, pool")
    assert result["e_y_m"] == pytest.approx(0.03, abs=1e-3)
    assert [trial["setpoint"] for trial in result["per_trial"]] == ["P01", "P04"]
    trial = evaluation.trials[1]
    assert trial.motion.t[0] < 0.1 and trial.motion.t[-1] > 59.9
    np.testing.assert_allclose(trial.motion.position[-1], trial.goal[:3] + (0.0, 0.0, 0.03), atol=1e-3)


def test_a_trial_that_ended_early_has_no_motion_afterwards(tmp_path, jobs):
    results = [held(tmp_path, jobs[0]), held(tmp_path, jobs[1], until=20.0)]
    evaluation = pool_evaluation(jobs[0], results, tmp_path)
    assert evaluation.trials[1].motion.t[-1] < 20.0
    assert evaluation.result["valid"] == 1  # errors of the last twenty seconds
