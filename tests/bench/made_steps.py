"""Synthetic step logs of a motor: first order plus dead time with a dead zone, in closed form."""

import math

import numpy as np
from scipy.signal import lfilter

from finssim.trials.trial import Trial

RPM = math.pi / 30.0
FINE = 2000.0
"""Steps per second of the exact solution, from which the log is subsampled."""


def held(levels, hold):
    """Return times and values of a command that holds each level for `hold` seconds."""
    t = np.arange(0.0, len(levels) * hold, 1.0 / FINE)
    return t, np.asarray(levels, float)[np.minimum((t / hold).astype(int), len(levels) - 1)]


def lagged(target, delay, tau):
    """Return the exact response, first order plus dead time, to a held target."""
    d = round(delay * FINE)
    late = np.concatenate([np.full(d, target[0]), target])[: len(target)]
    a = math.exp(-1.0 / (FINE * tau))
    return lfilter([0.0, 1.0 - a], [1.0, -a], late)


def sampled(t, rate):
    return np.round(np.arange(0.0, t[-1], 1.0 / rate) * FINE).astype(int)


def step_log(
    thruster,
    name,
    rpm_levels,
    *,
    domain="force",
    delay=0.05,
    tau=0.12,
    gain=1.0,
    dead_rpm=0.0,
    rate=50.0,
    hold=2.5,
    noise_rpm=5.0,
    asked="command",
    seed=0,
):
    """Return a trial with `command_NAME` [N] or `rpm_command_NAME`, and `rpm_NAME`; the lag is of thrust or speed."""
    rng = np.random.default_rng(seed)
    t, rpm = held(rpm_levels, hold)
    turning = np.where(np.abs(rpm) < dead_rpm, 0.0, rpm) * RPM
    target = gain * (thruster.thrust(turning) if domain == "force" else turning)
    response = lagged(target, delay, tau)
    speed = thruster.speed(response) if domain == "force" else response
    rows = sampled(t, rate)
    command = {
        "command": (f"command_{name}", thruster.thrust(rpm * RPM)[rows]),
        "rpm_command": (f"rpm_command_{name}", rpm[rows]),
    }[asked]
    channels = {
        command[0]: command[1],
        f"rpm_{name}": speed[rows] / RPM + noise_rpm * rng.standard_normal(len(rows)),
    }
    return Trial(name=f"steps{seed}", t=t[rows], channels=channels)
