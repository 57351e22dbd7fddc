"""Coasts of surge, sway and yaw: drag over inertia, its shape and its interval, from closed forms with noise."""

import numpy as np
import pytest

from finssim.identification.regression.passive import passive
from finssim.trials.findings import CalibrationError
from finssim.trials.trial import Header, Trial
from finssim.vehicles import load_vehicle

VEHICLE = load_vehicle("bluerov2")
SHAPES = {"linear": (0.25, 0.0), "quadratic": (0.0, 0.7), "both": (0.1, 0.5)}


def speed_and_way(t, v0, c1, c2):
    """v_dot = -c1 v - c2 |v| v and its integral."""
    c1, c2, a0 = c1 + 1e-12, c2 + 1e-12, abs(v0)
    fallen = -np.expm1(-c1 * t)
    v = a0 * (1.0 - fallen) / (1.0 + c2 * a0 / c1 * fallen)
    return np.sign(v0) * v, np.sign(v0) * np.log1p(c2 * a0 / c1 * fallen) / c2


def spins(rng, c1, c2, *, count=6, noise=0.004, column="yaw", rate=30.0, seconds=15.0):
    """Trials of heading, or of a rate or velocity."""
    out = []
    for k in range(count):
        t = np.arange(0.0, seconds, 1.0 / rate)
        v, s = speed_and_way(t, rng.choice([-1.0, 1.0]) * rng.uniform(0.8, 1.8), c1, c2)
        y = (rng.uniform(-3.0, 3.0) + s) if column == "yaw" else v
        channels = {column: y + noise * rng.standard_normal(len(t))}
        out.append(Trial(name=f"spin_{k}", t=t, channels=channels, header=Header(passive=True)))
    return out


@pytest.mark.parametrize(
    ("column", "shape"), [("yaw", "quadratic"), ("r", "both"), ("u", "linear"), ("v", "quadratic")]
)
def test_ratios_come_back(column, shape):
    """From a heading alone, a gyro, or a velocity."""
    c1, c2 = SHAPES[shape]
    axis = {"yaw": "yaw", "r": "yaw", "u": "surge", "v": "sway"}[column]
    fit = passive(spins(np.random.default_rng(1), c1, c2, column=column), VEHICLE)
    for name, value in (("d1", c1), ("d2", c2)):
        found = fit.estimates[f"{axis}.{name}/m_eff"]
        assert found.estimate == pytest.approx(value, rel=0.05, abs=1e-9), found
        assert found.ci95[0] <= value <= found.ci95[1] or abs(found.estimate - value) < 0.02 * max(value, 0.1)
    i = {"surge": 0, "sway": 1, "yaw": 5}[axis]
    m = VEHICLE.mass_matrix()[i, i]
    changed = VEHICLE.replace(fit.changes).hydrodynamics["calibrated"]
    assert changed.quadratic_damping[i, i] == pytest.approx(fit.estimates[f"{axis}.d2"].estimate)
    assert fit.estimates[f"{axis}.d2"].estimate == pytest.approx(
        m * fit.estimates[f"{axis}.d2/m_eff"].estimate, rel=0.02
    )


@pytest.mark.slow
def test_the_right_shape_in_nineteen_of_twenty_draws():
    """Linear or quadratic, where the other misses by a factor of 1.5 or more; the ratio's interval holds the truth."""
    rng = np.random.default_rng(5)
    right = held = 0
    draws = 24
    for k in range(draws):
        shape = ("linear", "quadratic")[k % 2]
        c1, c2 = SHAPES[shape]
        c1, c2 = c1 * rng.uniform(0.5, 2.0), c2 * rng.uniform(0.5, 2.0)
        fit = passive(spins(rng, c1, c2, noise=0.02, rate=10.0, count=4), VEHICLE)
        wrong = fit.quality["yaw"]["rmse_quadratic" if shape == "linear" else "rmse_linear"]
        assert wrong > 1.5 * 0.02
        name, value = ("d1", c1) if shape == "linear" else ("d2", c2)
        other = "d2" if shape == "linear" else "d1"
        right += fit.estimates[f"yaw.{other}/m_eff"].estimate == 0.0
        low, high = fit.estimates[f"yaw.{name}/m_eff"].ci95
        held += low <= value <= high
    assert right >= 0.95 * draws
    assert held >= 0.88 * draws


def test_one_coast_is_enough_and_a_push_ends_it():
    """A single trial gets its interval from blocks; what comes after another push does not count."""
    rng = np.random.default_rng(2)
    (one,) = spins(rng, 0.0, 0.7, count=1, column="r", noise=0.01)
    again = one.channels["r"].copy()
    again[300:] += np.sign(again[0]) * 0.4
    pushed = Trial(name="pushed", t=one.t, channels={"r": again}, header=one.header)
    for trial in (one, pushed):
        found = passive([trial], VEHICLE).estimates["yaw.d2/m_eff"]
        assert found.estimate == pytest.approx(0.7, rel=0.1)
        assert found.ci95[0] < 0.7 < found.ci95[1]


def test_what_does_not_coast_is_refused():
    """A vehicle at rest, and one that turns on, have no drag to show."""
    t = np.arange(0.0, 10.0, 0.05)
    for y in (0.001 * np.sin(t), np.full(len(t), 1.0)):
        trial = Trial(name="still", t=t, channels={"r": y}, header=Header(passive=True))
        with pytest.raises(CalibrationError, match="does not coast"):
            passive([trial], VEHICLE)
