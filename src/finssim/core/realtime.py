"""Clock of everything that runs in real time: the machine's monotonic clock, slowed down by a rate from the
environment.

With `FINSSIM_CLOCK_RATE=0.25` the virtual pool and the robot's software run at a quarter of real time, so that a slow
or busy machine keeps up: both read the same slower clock, and rates, delays and watchdogs keep their meaning. Every
process of a session needs the same value. `finssim.robot.wiring.connected` refuses it for a vehicle.
"""

from __future__ import annotations

import os
import time

RATE = "FINSSIM_CLOCK_RATE"
"""Environment variable: session time per second of this machine; 1 if it is not set."""


class ClockRateError(ValueError):
    """Invalid clock rate."""


def clock_rate() -> float:
    """Return the session time that passes per second of this machine [-].

    Raises:
        ClockRateError: The environment variable is not a number between 0.01 and 1.
    """
    text = os.environ.get(RATE, "1")
    try:
        rate = float(text)
    except ValueError:
        rate = 0.0
    if not 0.01 <= rate <= 1.0:
        raise ClockRateError(f"{RATE}={text}: expected a number from 0.01 to 1, such as 0.25")
    return rate


def now() -> float:
    """Return the session time [s], which all processes of this machine share."""
    return time.monotonic() * clock_rate()


def wait(duration: float) -> None:
    """Wait for a duration of session time [s]."""
    time.sleep(max(duration, 0.0) / clock_rate())
