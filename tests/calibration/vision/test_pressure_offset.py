"""Offset and scale of a pressure sensor come back from known depths, and a scale is not made up."""

import numpy as np
import pytest

from finssim.calibration.errors import CalibrationError
from finssim.calibration.vision.sensor_mounts import SALT, fit_depth


def readings(rng, span, *, offset=0.03, scale=1.0, noise=0.004, count=120):
    known = 0.6 + span * 0.5 * np.sin(np.linspace(0.0, 12.0, count))
    return known, scale * known + offset + noise * rng.standard_normal(count)


@pytest.mark.parametrize("scale", [1.0, SALT, 1.0 / SALT])
def test_offset_and_scale_come_back(scale):
    fit = fit_depth(*readings(np.random.default_rng(0), 0.8, scale=scale))
    assert fit.offset == pytest.approx(0.03, abs=0.004)
    assert fit.scale == pytest.approx(scale, abs=0.006)
    assert fit.estimates["depth.scale"].identifiable
    said = {1.0: "", SALT: "fresh water in salt water", 1.0 / SALT: "salt water in fresh water"}[scale]
    assert [one.values for one in fit.findings] == ([{"setting": said}] if said else [])


def test_one_depth_tells_the_offset_alone():
    """Within 5 cm no scale shows: it is taken as 1, and said."""
    fit = fit_depth(*readings(np.random.default_rng(0), 0.05))
    assert fit.scale == 1.0 and not fit.estimates["depth.scale"].identifiable
    assert fit.offset == pytest.approx(0.03, abs=0.002)
    assert fit.findings[0].code == "depths_alike"


def test_the_interval_holds_the_truth_and_takes_in_a_common_error():
    inside = []
    for seed in range(60):
        fit = fit_depth(*readings(np.random.default_rng(seed), 0.05))
        low, high = fit.estimates["depth.offset"].ci95
        inside.append(low < 0.03 < high)
    assert np.mean(inside) > 0.87
    wide = fit_depth(*readings(np.random.default_rng(0), 0.05), known_std=0.01)
    low, high = wide.estimates["depth.offset"].ci95
    assert high - low > 2 * 1.96 * 0.01


def test_wrong_samples_have_no_weight():
    known, reading = readings(np.random.default_rng(0), 0.8)
    reading[::10] += 0.5
    fit = fit_depth(known, reading)
    assert fit.offset == pytest.approx(0.03, abs=0.006)
    assert fit.rejected >= 12


def test_too_few_pairs_are_refused():
    with pytest.raises(CalibrationError, match="expected at least 5"):
        fit_depth([0.1, 0.2, np.nan, 0.4, 0.5], [0.1, 0.2, 0.3, 0.4, 0.5])
