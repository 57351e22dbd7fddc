"""Ranges written from intervals are accepted by training, and episodes stay inside them."""

import dataclasses
import math

import numpy as np
import pytest

from finssim.identification.fit import Estimate
from finssim.identification.vehicle_file import calibrated, range_factors, write_ranges
from finssim.sim.randomize import Randomization
from finssim.sim.ranges_file import load_ranges
from finssim.tasks import TASKS, Environment
from finssim.trials.findings import CalibrationError
from finssim.vehicles import load_vehicle
from identification.made_fits import SET, made_fit


def test_the_rule():
    """Determined: the interval over the estimate; undetermined or guessed: half to double; not fitted: a tenth."""
    fit = made_fit()
    factors = range_factors(fit, calibrated(fit))
    assert factors["linear_damping.surge"][:2] == pytest.approx((37.9 / 39.1, 40.2 / 39.1))
    assert factors["added_mass.surge"][:2] == pytest.approx((16.9 / 17.9, 19.0 / 17.9))
    assert factors["quadratic_damping.yaw"] == (0.5, 2.0, "undetermined")
    assert factors["linear_damping.heave"] == (0.5, 2.0, "undetermined")
    assert factors["linear_damping.roll"] == (0.5, 2.0, "guessed")
    assert factors["linear_damping.sway"] == (0.9, 1.1, "not fitted")
    assert factors["time_constant"][:2] == pytest.approx((0.1 / 0.15, 0.2 / 0.15))
    assert factors["thrust.all"][:2] == pytest.approx((0.95 / 0.97, 0.99 / 0.97), abs=0.001)
    assert "quadratic_damping.surge" not in factors  # a factor on zero has no effect


@pytest.mark.parametrize(
    ("estimate", "ci95", "expected"),
    [
        (10.0, (9.999, 10.001), (0.98, 1.02)),
        (10.0, (-3.0, 23.0), (0.0, 2.3)),
        (1.0, (0.5, 900.0), (0.5, 5.0)),
        (0.0, (-1.0, 1.0), (0.5, 2.0)),
        (10.0, (math.nan, 12.0), (0.5, 2.0)),
    ],
)
def test_factors_are_possible_whatever_the_interval(estimate, ci95, expected):
    """Factors are possible for intervals that are very narrow, across zero, very wide, around zero, or unknown."""
    one = Estimate(
        name="sway.d1",
        estimate=estimate,
        ci95=ci95,
        unit="N s/m",
        identifiable=True,
        path=f"{SET}.linear_damping.1",
    )
    fit = dataclasses.replace(made_fit(), estimates={"sway.d1": one}, changes={})
    assert range_factors(fit, calibrated(fit))["linear_damping.sway"][:2] == pytest.approx(expected)


def test_buoyancy_moves_the_volume():
    """For a vehicle of weight W, 1 N to 2 N of excess is a volume of (W + 1)/(W + 1.5) to (W + 2)/(W + 1.5)."""
    one = Estimate(name="buoyancy_excess", estimate=1.5, ci95=(1.0, 2.0), unit="N", identifiable=True)
    fit = dataclasses.replace(made_fit(), estimates={"buoyancy_excess": one}, changes={})
    vehicle = calibrated(fit)
    W = vehicle.weight
    assert range_factors(fit, vehicle)["volume"][:2] == pytest.approx(
        ((W + 1) / (W + 1.5), (W + 2) / (W + 1.5))
    )


def test_every_episode_stays_within_the_intervals(tmp_path):
    """In training's environment with these ranges, the drawn damping fills the 95 % interval and never leaves it."""
    fit = made_fit()
    vehicle = calibrated(fit)
    write_ranges(fit, tmp_path / "pool.yaml", vehicle)
    randomization = Randomization(tmp_path / "pool.yaml")
    assert randomization.ranges.name == "pool"
    environment = Environment(TASKS["t1"](), vehicle, worlds=512, randomization=randomization, seed=3)
    environment.reset()
    plant = environment.simulator.plant.array.numpy()[:, 0]
    surge, lag = plant["D1"][:, 0, 0], plant["time_constant"]
    assert 37.9 <= surge.min() < 38.3 and 39.8 < surge.max() <= 40.2 + 1e-4
    assert lag.min() >= 0.1 - 1e-6 and lag.max() <= 0.2 + 1e-6 and np.ptp(lag) > 0.08


def test_the_file_says_why(tmp_path):
    """Each line ends with its reason, and the source names calibration and vehicle."""
    fit = made_fit()
    write_ranges(fit, tmp_path / "r.yaml")
    text = (tmp_path / "r.yaml").read_text(encoding="utf-8")
    assert "surge: [0.9693, 1.028]  # determined" in text and "# guessed" in text and "# not fitted" in text
    assert calibrated(fit).sha256[:16] in load_ranges(tmp_path / "r.yaml").source


@pytest.mark.parametrize("name", ["bluerov2", "rexrov", "remus100", "warpauv"])
def test_other_vehicles(tmp_path, name):
    """Six thrusters, full matrices, one propeller, or no calibrated set before the fit each give a file that loads."""
    vehicle = load_vehicle(name)
    changes = {f"{SET}.linear_damping.0.0": 39.1}
    if "calibrated" not in vehicle.hydrodynamics:
        changes = {SET: {"linear_damping": [39.1, 1, 1, 1, 1, 1], "quadratic_damping": [0.0] * 6}}
    fit = made_fit(vehicle, changes=changes)
    write_ranges(fit, tmp_path / "r.yaml")
    load_ranges(tmp_path / "r.yaml")


def test_what_cannot_be_written_is_refused(tmp_path):
    """A file with another suffix is refused."""
    with pytest.raises(CalibrationError, match=r"expected \.yaml"):
        write_ranges(made_fit(), tmp_path / "r.json")
