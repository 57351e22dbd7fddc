"""kill -9 of real processes on real wires."""

import pytest

from studies.faults import fault_job, play_kill


@pytest.mark.slow
def test_a_killed_robot_leaves_motors_that_stop_and_a_record_that_opens(tmp_path):
    """The controller's own timeout of 0.5 s stops them; the record misses at most one second."""
    result = play_kill(fault_job("kill-robot"), tmp_path)
    assert result["ok"], result
    assert 0.3 < result["thrust_gone_s"] < 1.5 and result["record_lost_s"] <= 1.0 and result["thrust_n"] > 0.5


@pytest.mark.slow
def test_a_robot_whose_pool_is_killed_stops_commanding_and_says_why(tmp_path):
    """Its process ends by itself, with a fault that names the silence of the pool."""
    result = play_kill(fault_job("kill-pool"), tmp_path)
    assert result["ok"], result
    assert result["state"] == "fault" and "telemetry" in result["reason"] and result["frames_off_s"] <= 0.5
