"""Faults end to end: the robot's whole software against a pool, and a control without watchdogs."""

import pytest

from studies import faults
from studies.faults import AUTOPILOT, SCENARIOS, fault_job, play

ELSEWHERE = {"ap-none", "ap-origin", "ap-leap", "ap-lag-leap"}
"""Scenarios that `tests/robot/links/test_mavlink.py` tests more thoroughly, without the study."""


@pytest.fixture
def tried(tmp_path):
    """Function that plays a scenario."""

    def trial(scenario, variant="", motion="moving"):
        result = play(fault_job(scenario, variant, motion), tmp_path / "trial")
        assert not result["raised"] and result["thrust_n"] > 0.5  # there was thrust to stop
        assert not list(tmp_path.glob("*.mcap"))
        return result

    return trial


@pytest.mark.slow
def test_without_watchdogs_a_cut_link_drives_the_vehicle_out(tried):
    """In this control thrust never ends, the vehicle leaves the workspace, and the trial fails; with
    watchdogs it passes."""
    control = tried("control")
    assert not control["ok"] and control["thrust_gone_s"] is None and control["margin_m"] < 0.0
    assert control["speed_m_s"] > 0.2
    watched = tried("link-cut", "up")
    assert watched["ok"] and watched["frames_off_s"] < 0.3 and watched["margin_m"] > 0.0
    assert watched["state"] == "fault" and "telemetry" in watched["reason"]


@pytest.mark.slow
def test_a_clock_set_back_an_hour_stops_the_vehicle_and_not_the_record(tried):
    """The clock goes below zero, where a record has no valid time."""
    result = tried("robot-clock", "-3600 s")
    assert result["ok"] and "clock jumped" in result["reason"] and result["record_lost_s"] == 0.0


@pytest.mark.slow
def test_a_second_publisher_stops_the_vehicle(tried):
    """It stops at the next step."""
    result = tried("second-publisher")
    assert result["ok"] and "two publishers" in result["reason"] and result["frames_off_s"] < 0.1


@pytest.mark.slow
def test_a_full_disk_ends_the_record_and_not_the_trip(tried, caplog):
    """The vehicle continues; everything recorded before can be read."""
    result = tried("full-disk")
    assert result["ok"] and result["state"] == "armed" and result["thrust_gone_s"] is None
    assert result["record_lost_s"] < 1.0 and "recording stopped: File too large" in caplog.text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("row", "variant"),
    [
        (row, fault)
        for row, scenario in AUTOPILOT.items()
        if row not in ELSEWHERE
        for fault in scenario.faults
    ],
)
def test_what_befalls_an_autopilot_ends_as_its_page_says(tmp_path, monkeypatch, row, variant):
    """Each trial ends for its scenario's reason within its time limit, or stays armed if it must not end.

    It is observed for at least 6 s, and for at least 4 s beyond its limit.
    """
    monkeypatch.setattr(faults, "WATCHED", 6.0)
    result = play(fault_job(row, variant, "moving", vehicle="bluerov2_heavy"), tmp_path / "trial")
    assert result["ok"] and result["speed_m_s"] > 0.2, result


@pytest.mark.slow
def test_a_vehicle_that_is_blind_for_a_while_waits_and_goes_on(tried):
    """After 3 s without vision it stays armed and thrust returns; after 10 s there is a fault that names the
    camera."""
    short, long = tried("blind-3", motion="station"), tried("blind-10", motion="station")
    assert short["ok"] and short["state"] == "armed" and short["thrust_gone_s"] < 2.5
    assert long["ok"] and long["state"] == "fault" and "camera" in long["reason"]


def test_every_fault_of_the_contract_is_in_the_catalogue():
    """Each fault has a scenario that causes it."""
    wanted = {"loss-10", "loss-30", "loss-50", "reordering", "duplicates", "corrupt", "frozen-sensors"}
    wanted |= {
        "frozen-picture",
        "blind-3",
        "second-publisher",
        "mcu-reboot",
        "robot-clock",
        "mcu-clock",
        "full-disk",
    }
    wanted |= {f"nan-{field}" for field in ("quaternion", "gyro", "accel", "depth", "pressure", "motor_rpm")}
    assert wanted <= set(SCENARIOS)
    assert all(scenario.faults and scenario.motions for scenario in SCENARIOS.values())
