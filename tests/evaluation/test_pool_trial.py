"""A job plays the robot's whole software in the virtual pool, and each of its fields has an effect."""

import dataclasses

import numpy as np
import pytest

from finssim.evaluation import metrics
from finssim.evaluation.metrics import T1_SETPOINTS, T1_START, in_room
from finssim.evaluation.robot_trials import OnRobot, RobotError, RobotJob, play, play_jobs
from finssim.evaluation.trials import VehicleMotion
from finssim.robot.goals import GoalError
from finssim.robot.wiring import Wiring
from finssim.vehicles import load_vehicle

SHORT = RobotJob(row="pid", controller="pid", target="P03", camera="corners", duration=6.0)


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """Job -> its result and series; each job is played once."""
    folder, known = tmp_path_factory.mktemp("trials"), {}

    def of(**changes):
        job = dataclasses.replace(SHORT, **changes)
        if job not in known:
            path = folder / str(len(known))
            known[job] = play(job, path), VehicleMotion.read(path)
        return known[job]

    return of


def test_a_trial_starts_at_the_published_pose_and_goes_to_its_setpoint(played):
    """From the published pose to the setpoint, the estimate is within centimetres of the truth."""
    result, series = played()
    assert result["fault"] == "" and result["missed_decisions"] == 0
    np.testing.assert_allclose(series.position[0], T1_START[:3], atol=0.06)
    before, after = (np.linalg.norm(series.position[k] - T1_SETPOINTS["P03"][:3]) for k in (0, -1))
    assert after < 0.2 * before
    assert result["localization"]["horizontal_m"] < 0.03 and result["localization"]["heading_deg"] < 2.0


def test_equal_jobs_give_equal_results(played, tmp_path):
    """A job that is played again gives equal results to the last digit."""
    again = play(SHORT, tmp_path / "again")
    told = ("localization", "success", "t_s_s", "valid")
    assert {key: again[key] for key in told} == {key: played()[0][key] for key in told}
    assert np.array_equal(VehicleMotion.read(tmp_path / "again").position, played()[1].position)


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        {"plant": 2},
        {"seed": 2},
        {"severity": "nominal"},
        {"fusion": False},
        {"position_noise": 0.05},
        {"yaw_noise": 0.17},
        {"controller": "pid-paper"},
    ],
    ids=lambda change: next(iter(change)),
)
def test_every_field_of_a_job_changes_the_motion(played, change):
    """Every field of a job has an effect; none is merely recorded."""
    assert not np.array_equal(played(duration=2.0, **change)[1].position, played(duration=2.0)[1].position)


def test_noise_on_the_input_does_not_reach_the_estimate(played):
    """As in the paper, the noise is added only to the controller's input."""
    noisy = played(position_noise=0.05)[0]["localization"]["horizontal_m"]
    assert noisy < 2.0 * played()[0]["localization"]["horizontal_m"] + 0.005


@pytest.mark.slow
def test_pictures_and_corners_tell_nearly_the_same(played):
    """The fast camera can replace the slow one: in the same plant they agree within a few centimetres."""
    pictures = played(camera="pictures", duration=3.0)
    corners = played(duration=3.0)
    n = min(len(pictures[1].t), len(corners[1].t))
    apart = np.linalg.norm(pictures[1].position[:n] - corners[1].position[:n], axis=1)
    assert 0.0 < apart.max() < 0.08
    assert pictures[0]["localization"]["horizontal_m"] < 0.03


@pytest.mark.slow
def test_a_trajectory_is_followed_from_its_own_start(brief_straight, played):
    """T2 begins and ends with the path."""
    _, series = played(target="straight", duration=60.0)
    assert np.linalg.norm(series.position[0][:2] - [-1.0, -0.4]) < 0.06
    assert series.t[-1] == pytest.approx(10.0, abs=0.11)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bluerov2_heavy", "rexrov"])
def test_other_vehicles_hold_a_setpoint_of_their_own_pool(played, name):
    """With default tags, mcu and safety, a pool scaled to the vehicle, and a PID designed for it, the error is 5 cm."""
    vehicle = load_vehicle(name)
    result, series = played(vehicle=name, pool_vehicle=name, target="P01", duration=20.0)
    goal = in_room(T1_SETPOINTS["P01"], vehicle)[:3]
    assert result["fault"] == "" and result["localization"]["position_m"] < 0.05
    assert np.linalg.norm(series.position[-1] - goal) < 0.05
    np.testing.assert_allclose(result["goal"][:3], goal)


def test_a_robot_in_a_tank_may_go_where_the_tank_is(tmp_path):
    """Setpoints three times as far lie outside the workspace of the vehicle's file and inside that of the site."""
    job = RobotJob(row="pid", controller="pid", target="P01", vehicle="bluerov2_heavy", plant=0, severity="hardware",
              camera="hardware", site="tank", firmware="ardusub")  # fmt: skip
    there = OnRobot(wiring=Wiring(robot="mavlink", lockstep=True), pool_file=None, site="tank")
    with pytest.raises(RobotError, match="give --arm"):
        play_jobs([job], tmp_path, there)
    with pytest.raises(GoalError, match="outside the workspace"):
        play_jobs([job], tmp_path, dataclasses.replace(there, site="pool"))


@pytest.mark.slow
def test_an_autopilot_that_locates_itself_holds_its_setpoint(tmp_path, monkeypatch):
    """Without a Doppler log on the link, the vehicle is within 8 cm of the truth from 20 to 30 s."""
    monkeypatch.setattr(metrics, "EVALUATION_WINDOW", (20.0, 30.0))
    job = RobotJob(row="pid", controller="pid", target="P01", vehicle="bluerov2_heavy", pool_vehicle="bluerov2_heavy",
              plant=2, severity="realistic", seed=1, site="tank", firmware="ardusub-own", duration=30.0)  # fmt: skip
    result = play(job, tmp_path / "trial")
    assert result["success"] and result["fault"] == "" and result["e_p_m"] < 0.08
