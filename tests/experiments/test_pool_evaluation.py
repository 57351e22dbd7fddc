"""Results of the virtual pool in the form of an evaluation, and what its camera saw."""

import numpy as np
import pytest

from finssim.experiments.demo import camera_view
from finssim.experiments.metrics import T1_SETPOINTS, measure_trial
from finssim.experiments.pool_trial import pool_evaluation, pool_jobs, write_series
from finssim.geometry.rotations import quat_from_yaw


def held(folder, job, until=60.0):
    """A trial that ends up 3 cm above its goal, as `play` leaves it; it may end early."""
    goal = T1_SETPOINTS[job.target]
    t = np.arange(0.003, until, 0.1)
    position = goal[:3] + (0.0, 0.0, 0.03) + np.exp(-t)[:, None] * (0.5, 0.0, 0.0)
    yaw = np.full(len(t), goal[3])
    series = {"t": t, "position": position, "yaw": yaw, "quaternion": quat_from_yaw(yaw)}
    write_series(folder / job.key(), series)
    measures = measure_trial(t, position, yaw, goal)
    return {"key": job.key(), "job": {}, "fault": "", "provenance": {"finssim": "0"}, **measures}


@pytest.fixture
def jobs():
    return pool_jobs({"pid": "pid"}, ("P01", "P04"), camera="corners", plant=3)


def test_measures_and_motion_are_those_of_the_trials(tmp_path, jobs):
    """Both held, 3 cm vertically; the motion on a grid from 0 to 60 s."""
    evaluation = pool_evaluation(jobs, [held(tmp_path, job) for job in jobs], tmp_path)
    result = evaluation.result
    assert (result["success"], result["trials"], evaluation.label) == (2, 2, "pid, pool")
    assert result["e_y_m"] == pytest.approx(0.03, abs=1e-3)
    assert [trial["setpoint"] for trial in result["per_trial"]] == ["P01", "P04"]
    t, position, _, goal = evaluation.trials.series(1)
    assert t[0] == 0.0 and t[-1] == 60.0 and np.isfinite(position).all()
    np.testing.assert_allclose(position[-1], goal[:3] + (0.0, 0.0, 0.03), atol=1e-3)


def test_a_trial_that_ended_early_has_no_motion_afterwards(tmp_path, jobs):
    results = [held(tmp_path, jobs[0]), held(tmp_path, jobs[1], until=20.0)]
    evaluation = pool_evaluation(jobs, results, tmp_path)
    t, position, _, _ = evaluation.trials.series(1)
    assert np.isfinite(position[t < 19.9]).all() and np.isnan(position[t > 20.1]).all()
    assert evaluation.result["valid"] == 1  # errors of the last twenty seconds


@pytest.mark.slow
def test_the_camera_view_shows_the_tags_of_the_vehicle(tmp_path, jobs, monkeypatch):
    """FinsROV's two tags are found where it is, and the answer is a PNG."""
    held(tmp_path, jobs[0])
    from finssim.experiments import demo as module

    seen, draw = [], module._drawn
    monkeypatch.setattr(module, "_drawn", lambda image, found: seen.extend(found) or draw(image, found))
    assert camera_view(jobs[0], tmp_path / jobs[0].key(), 12.0, seed=1).startswith(b"\x89PNG")
    assert sorted(d.tag for d in seen) == [15, 16]
