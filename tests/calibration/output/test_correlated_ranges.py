"""A calibration's covariance becomes ranges whose draws have it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from finssim.calibration.errors import CalibrationError
from finssim.calibration.output.ranges import correlated_normals, write_correlated_ranges
from finssim.engine.ranges_file import load_ranges
from finssim.vehicles import load_vehicle
from reference.draws import column, draw

FINSROV = load_vehicle("finsrov")
SET = FINSROV.hydrodynamics["calibrated"]
M, D1 = SET.added_mass[0][0], SET.linear_damping[0][0]


def estimate(value, std, identifiable=True):
    """As fit.json has it; a 95 % interval is 1.96 standard errors to either side."""
    ends = [value - 1.96 * std, value + 1.96 * std] if identifiable else [None, None]
    return {"estimate": value, "ci95": ends, "unit": "", "identifiable": identifiable, "note": ""}


def fit(**changes):
    found = {
        "kind": "hydrodynamics",
        "vehicle": {"name": "finsrov", "sha256": "0" * 64},
        "parameters": {
            "surge.m_eff": estimate(M + 12.0, 1.5),
            "surge.added_mass": estimate(M, 1.5),
            "surge.d1": estimate(1.1 * D1, 0.05 * D1),
            "heave.d2": estimate(100.0, 30.0, identifiable=False),
            "thrust_scale": estimate(0.9, 0.045),
            "surge.bias": estimate(0.1, 0.1),
        },
        "correlation": {
            "names": ["surge.m_eff", "surge.d1", "surge.bias", "thrust_scale"],
            "matrix": [
                [1.0, -0.6, 0.1, 0.5],
                [-0.6, 1.0, 0.2, 0.7],
                [0.1, 0.2, 1.0, 0.0],
                [0.5, 0.7, 0.0, None],
            ],
        },
    }
    found["correlation"]["matrix"][3][3] = 1.0
    return {**found, **changes}


def test_draws_have_the_covariance_of_the_fit(tmp_path):
    """cov(factor_i, factor_j) = R_ij std_i std_j / (nominal_i nominal_j), about estimate / nominal."""
    (tmp_path / "fit.json").write_text(json.dumps(fit()), encoding="utf-8")
    write_correlated_ranges(tmp_path / "fit.json", FINSROV, tmp_path / "ranges.yaml")
    ranges = load_ranges(tmp_path / "ranges.yaml")
    _, draws = draw(ranges.model_dump(exclude={"name"}), worlds=20_000)
    names = ["added_mass.surge", "linear_damping.surge", "thrust.all"]
    x = np.array([column(draws, name) for name in names])
    np.testing.assert_allclose(x.mean(axis=1), [1.0, 1.1, 1.0], atol=3e-3)
    # The vehicle is the calibrated one: its thrusters have been scaled by 0.9 already.
    std = np.array([1.5 / M, 0.05, 0.045 / 0.9])
    R = np.array([[1.0, -0.6, 0.5], [-0.6, 1.0, 0.7], [0.5, 0.7, 1.0]])
    values, vectors = np.linalg.eigh(R)
    assert values.min() < 0.0, (
        "this matrix is one that a fit rounds to, and no covariance: the nearest is drawn"
    )
    near = (vectors * np.maximum(values, 1e-4)) @ vectors.T
    near /= np.sqrt(np.outer(np.diag(near), np.diag(near)))
    np.testing.assert_allclose(np.cov(x) / np.outer(std, std), near, atol=0.05)


def test_what_the_fit_could_not_tell_is_drawn_widely(tmp_path):
    (tmp_path / "fit.json").write_text(json.dumps(fit()), encoding="utf-8")
    write_correlated_ranges(tmp_path / "fit.json", FINSROV, tmp_path / "ranges.yaml")
    drawn = load_ranges(tmp_path / "ranges.yaml").quadratic_damping.axes["heave"]
    assert drawn.log_uniform == (0.5, 2.0)


def test_the_vehicle_before_the_fit_has_other_factors():
    """They are on its own numbers: the thrust scale is not in its thrusters yet."""
    before = fit(vehicle={"name": "finsrov", "sha256": FINSROV.sha256})
    normals, untold, (names, R) = correlated_normals(before, FINSROV)
    assert normals["thrust.all"] == pytest.approx((0.9, 0.045), rel=1e-4)
    assert untold == ["quadratic_damping.heave"]
    assert (
        names == ["added_mass.surge", "linear_damping.surge", "thrust.all"]
        and np.linalg.eigvalsh(R).min() > 0.0
    )


def test_a_fit_that_says_more_than_it_can_know_is_widened():
    """At least one per cent."""
    normals, _, _ = correlated_normals(fit(parameters={"surge.d1": estimate(D1, 1e-6)}), FINSROV)
    assert normals["linear_damping.surge"].std == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("{", "not valid JSON"),
        ("{}", "expected a JSON object with the key 'parameters'"),
        ('{"parameters": {}, "correlation": null}', "the fit tells no added mass, damping or thrust"),
    ],
)
def test_what_is_no_fit_is_refused(content, sentence, tmp_path):
    (tmp_path / "fit.json").write_text(content, encoding="utf-8")
    with pytest.raises(CalibrationError, match=sentence) as caught:
        write_correlated_ranges(tmp_path / "fit.json", FINSROV, tmp_path / "ranges.yaml")
    assert str(tmp_path / "fit.json") in str(caught.value)
    assert not (tmp_path / "ranges.yaml").exists()


def test_another_suffix_is_refused(tmp_path):
    with pytest.raises(CalibrationError, match="expected .yaml"):
        write_correlated_ranges(tmp_path / "fit.json", FINSROV, tmp_path / "ranges.txt")
