"""The clock of a session, slowed by an environment variable."""

import time

import pytest

from finssim.core import realtime
from finssim.robot.links.frames import LinkError
from finssim.robot.wiring import Wiring, connected
from finssim.vehicles import load_vehicle


def test_a_slow_clock_runs_and_waits_at_its_rate(monkeypatch):
    """At a rate of a quarter, 20 ms of the session are 80 ms of the machine, and all processes read the same clock."""
    monkeypatch.setenv(realtime.RATE, "0.25")
    assert realtime.now() == pytest.approx(0.25 * time.monotonic(), abs=0.01)
    before, began = realtime.now(), time.monotonic()
    realtime.wait(0.02)
    assert time.monotonic() - began >= 0.08
    assert realtime.now() - before == pytest.approx(0.25 * (time.monotonic() - began), abs=1e-3)


@pytest.mark.parametrize("text", ["0", "2", "-1", "nan", "fast", ""])
def test_a_rate_that_is_none_is_refused(monkeypatch, text):
    """The refusal names the variable, its value and the expected values."""
    monkeypatch.setenv(realtime.RATE, text)
    with pytest.raises(
        realtime.ClockRateError, match=f"FINSSIM_CLOCK_RATE={text}: expected a number from 0.01 to 1"
    ):
        realtime.now()


@pytest.mark.parametrize(
    "robot",
    [
        "udp://192.168.2.2:58766",
        "serial:/dev/ttyACM0",
        "mavlink://tcp:10.0.0.2:5760",
        "mavlink://serial:/dev/ttyACM0,57600",
        "mavlink://udpin:127.0.0.1:14550?dvl=192.168.2.95",
    ],
)
def test_a_vehicle_is_never_driven_by_a_slow_clock(monkeypatch, robot):
    """The vehicle's watchdogs run in real time; only a pool on this machine shares the slow clock."""
    monkeypatch.setenv(realtime.RATE, "0.5")
    with pytest.raises(LinkError, match="unset FINSSIM_CLOCK_RATE"):
        with connected(Wiring(robot=robot), load_vehicle("finsrov"), None):
            pass
