"""Navigation without the pool camera: Doppler log and compass, motion capture, acoustics, and the uncertainty."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import chi2

from finssim.localization.fusion.estimator import Estimator
from finssim.localization.fusion.fuse_settings import Aids, Settings, settings_of, site_of
from finssim.localization.fusion.streams import (
    DepthSample,
    HeadingSample,
    ImuSample,
    VelocitySample,
    VisionSample,
)
from finssim.vehicles import load_vehicle
from finssim.vehicles.defaults import with_navigation

VEHICLE = with_navigation(load_vehicle("bluerov2_heavy"))
SETTINGS, SITE = settings_of(VEHICLE), site_of(None, VEHICLE)
AIDS = SETTINGS.aids
RATE, DURATION, DEPTH = 50.0, 40.0, 5.0
SEEDS = range(6)


class Sea:
    """A level vehicle that follows a bend at 0.3 m/s, and instruments with the errors of its file."""

    def __init__(self, seed: int) -> None:
        self.random = random = np.random.default_rng(seed)
        self.compass = AIDS.heading_bias * random.standard_normal()
        self.scale = 1.0 + AIDS.velocity_scale * random.standard_normal()
        self.log = AIDS.velocity_bias * random.standard_normal(3)
        self.gyro = 0.002 * random.standard_normal(3)
        self.start = 0.05 * random.standard_normal(2)

    @staticmethod
    def yaw(t):
        return 0.3 + 0.8 * math.sin(0.1 * t)

    @staticmethod
    def velocity(t):
        return 0.3 * np.array([math.cos(Sea.yaw(t)), math.sin(Sea.yaw(t))])

    @staticmethod
    def position(t):
        s = np.linspace(0.0, t, 2000)
        yaw = 0.3 + 0.8 * np.sin(0.1 * s)
        return 0.3 * np.array([np.trapezoid(np.cos(yaw), s), np.trapezoid(np.sin(yaw), s)])

    def imu(self, t):
        noise = SETTINGS.imu.gyro.rate * math.sqrt(RATE) * self.random.standard_normal(3)
        r = 0.08 * math.cos(0.1 * t)
        # On a bend the acceleration is r x v, to the left of the path.
        force = np.array([0.0, 0.3 * r, SITE.gravity])
        force = force + SETTINGS.imu.accel_noise * math.sqrt(RATE) * self.random.standard_normal(3)
        return ImuSample(t, tuple(np.array([0.0, 0.0, r]) + self.gyro + noise), tuple(force), (0.0, 0.0))

    def doppler(self, t):
        own = self.scale * np.array([0.3, 0.0, 0.0]) + self.log
        return VelocitySample(t, tuple(own + AIDS.velocity_std * self.random.standard_normal(3)))

    def heading(self, t):
        return HeadingSample(t, self.yaw(t) + self.compass + AIDS.heading_std * self.random.standard_normal())

    def fix(self, t, std, *, yaw_std=0.0, outliers=0.0, late=0.0):
        x = self.position(t) + std * self.random.standard_normal(2)
        if self.random.random() < outliers:
            x = x + self.random.uniform(-15.0, 15.0, 2)
        yaw = self.yaw(t) + yaw_std * self.random.standard_normal() if yaw_std else None
        rows = ((std**2, 0.0, 0.0), (0.0, std**2, 0.0), (0.0, 0.0, max(yaw_std, 0.1) ** 2))
        return VisionSample(t, tuple(x), yaw, rows, t + late)


def swim(seed, *, log=True, rate=0.0, std=0.5, yaw_std=0.0, outliers=0.0, late=0.0, settings=SETTINGS):
    """Run samples of `DURATION` seconds through an estimator, fixes as late as they come; return error (2,),
    covariance."""
    sea, estimator = Sea(seed), Estimator(settings, SITE, mode="error-state")
    estimator.add(sea.fix(0.0, 0.05, yaw_std=yaw_std))
    waiting = []
    for k in range(1, round(DURATION * RATE) + 1):
        t = k / RATE
        estimator.add(sea.imu(t))
        if k % 5 == 0:
            estimator.add(DepthSample(t, DEPTH + 0.005 * sea.random.standard_normal()))
            if log:
                estimator.add(sea.heading(t))
        if log and k % 6 == 0:
            estimator.add(sea.doppler(t))
        if rate and k % round(RATE / rate) == 0:
            waiting.append(sea.fix(t, std, yaw_std=yaw_std, outliers=outliers, late=late))
        while waiting and waiting[0].arrival <= t + 1e-9:
            estimator.add(waiting.pop(0))
    for fix in waiting:  # fixes that are still pending
        estimator.add(fix)
    found = estimator.estimate(DURATION)
    return found.x[:2] - sea.position(DURATION), found.P[:2, :2], estimator


CHOICES = {
    "log and compass": {},
    "log, compass and acoustics": {"rate": 0.5, "std": 0.5, "outliers": 0.1, "late": 0.4},
    "motion capture": {"log": False, "rate": 25.0, "std": 0.002, "yaw_std": 0.005, "late": 0.02},
}


@pytest.mark.slow
@pytest.mark.parametrize("choice", CHOICES)
def test_errors_are_as_large_as_the_covariance_says(choice):
    """NEES of x and y at the end, summed over seeds, is inside the 99 % band of chi-square; acoustics have outliers."""
    options = dict(CHOICES[choice])
    if choice == "motion capture":
        options["settings"] = settings_of(load_vehicle("bluerov2_heavy"))
    ends = [swim(seed, **options)[:2] for seed in SEEDS]
    nees = sum(float(e @ np.linalg.solve(P, e)) for e, P in ends)
    low, high = chi2.ppf([0.005, 0.995], 2 * len(SEEDS))
    assert low < nees < high


@pytest.mark.slow
def test_fixes_bound_what_log_and_compass_alone_let_grow():
    """Fixes bound the error, which grows with log and compass alone, and an acoustic outlier is refused by the gate."""
    alone, fixed = swim(0)[1], swim(0, **CHOICES["log, compass and acoustics"])
    assert np.trace(fixed[1]) < np.trace(alone)
    assert fixed[2].counts["vision"].get("gate", 0) >= 1


@pytest.mark.slow
def test_a_late_fix_changes_what_it_would_have_changed_in_time():
    """After 0.4 s of delay, the state is the same as with fixes in time."""
    late, timely = (swim(1, **{**CHOICES["log, compass and acoustics"], "late": x}) for x in (0.4, 0.0))
    np.testing.assert_allclose(late[0], timely[0], atol=1e-9)
    np.testing.assert_allclose(late[1], timely[1], atol=1e-12)


def test_without_log_and_compass_nothing_is_added():
    """Settings of such a vehicle have no aids; samples of them are refused by name."""
    assert settings_of(load_vehicle("finsrov")).aids is None and Settings().aids is None
    for mode in ("constant-velocity", "error-state"):
        estimator = Estimator(mode=mode)
        assert estimator.add(VelocitySample(0.0, (0.1, 0.0, 0.0))) == "no heading"
        assert estimator.add(HeadingSample(0.1, 0.2)) == "no compass"
        assert estimator.add(VelocitySample(0.2, (math.nan, 0.0, 0.0))) == "not finite"


@pytest.mark.parametrize("std", [0.0, 0.5 * AIDS.velocity_std, 5.0 * AIDS.velocity_std])
def test_a_velocity_may_be_less_certain_than_the_log(std):
    """A velocity's own deviation is used where it exceeds the log's; a smaller one changes nothing."""
    distances = []
    for own in (0.0, std):
        estimator = Estimator(SETTINGS, SITE)
        estimator.add(VisionSample(0.0, (1.0, 2.0), None))
        for k in range(200):
            estimator.add(ImuSample(0.01 * k, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81), (0.0, 0.0)))
            estimator.add(HeadingSample(0.01 * k, 0.0))
            estimator.add(VelocitySample(0.01 * k, (0.3, 0.0, 0.0)))
        estimator.add(VelocitySample(2.0, (0.35, 0.0, 0.0), std=own))
        distances.append(estimator.health(estimator.estimate()).mahalanobis["velocity"])
    more = 0.05**2 / distances[1] - 0.05**2 / distances[0]  # r² / S
    assert more == pytest.approx(max(std**2 - AIDS.velocity_std**2, 0.0), abs=1e-8)


def test_a_compass_starts_the_heading_and_its_offset_stays_in_doubt():
    """The offset stays uncertain however many samples there are; a velocity is then rotated into the pool frame."""
    estimator = Estimator(Settings(aids=Aids(heading_bias=0.05, heading_std=0.01)), SITE)
    estimator.add(VisionSample(0.0, (1.0, 2.0), None))
    for k in range(100):
        estimator.add(ImuSample(0.01 * k, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81), (0.0, 0.0)))
        estimator.add(HeadingSample(0.01 * k, math.pi / 2.0))
        estimator.add(VelocitySample(0.01 * k, (0.3, 0.0, 0.0)))
    found = estimator.estimate(1.0)
    assert found.yaw == pytest.approx(math.pi / 2.0) and found.yaw_variance >= 0.05**2 - 1e-12
    np.testing.assert_allclose(found.x[3:5], [0.0, 0.3], atol=0.02)


def test_a_compass_sample_counts_with_its_offset_and_its_noise():
    """The second heading is weighted by the variances of noise and offset, as in a Kalman filter of one state."""
    aids = Aids(heading_bias=0.05, heading_std=0.01)
    estimator = Estimator(Settings(aids=aids), SITE)
    estimator.add(VisionSample(0.0, (1.0, 2.0), None))
    estimator.add(ImuSample(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81), (0.0, 0.0)))
    estimator.add(HeadingSample(0.0, 0.3))
    before = estimator.estimate()
    estimator.add(HeadingSample(1e-6, 0.4))
    gain = before.yaw_variance / (before.yaw_variance + 0.05**2 + 0.01**2)
    assert estimator.estimate().yaw - before.yaw == pytest.approx(0.1 * gain, rel=1e-6)
