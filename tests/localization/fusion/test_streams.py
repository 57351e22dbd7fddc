"""Samples that can never be used are refused."""

import math

import pytest

from finssim.localization.fusion.streams import DepthSample, ImuSample, VisionSample, refusal

I = ((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 1e-4))
BROKEN = [math.nan, math.inf, -math.inf]


@pytest.mark.parametrize("bad", BROKEN)
def test_numbers_that_are_none_are_refused(bad):
    """NaN and infinities in any number of any sample are refused; a bad time has its own reason."""
    assert refusal(DepthSample(bad, 0.5)) == "time not finite"
    assert refusal(DepthSample(1.0, 0.5, arrival=bad)) == "time not finite"
    assert refusal(DepthSample(1.0, bad)) == "not finite"
    assert refusal(ImuSample(1.0, (0.0, bad, 0.0))) == "not finite"
    assert refusal(ImuSample(1.0, (0.0, 0.0, 0.0), (bad, 0.0, 9.8))) == "not finite"
    assert refusal(ImuSample(1.0, (0.0, 0.0, 0.0), None, (0.0, bad))) == "not finite"
    assert refusal(VisionSample(1.0, (0.0, bad), 0.0)) == "not finite"
    assert refusal(VisionSample(1.0, (0.0, 0.0), bad)) == "not finite"


@pytest.mark.parametrize(
    "R",
    [
        ((1e-4, 2e-4, 0.0), (2e-4, 1e-4, 0.0), (0.0, 0.0, 1e-4)),
        ((1e-4, 1e-5, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 1e-4)),
        ((0.0, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 1e-4)),
        ((math.nan, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 1e-4)),
    ],
    ids=["indefinite", "asymmetric", "certain", "unknown"],
)
def test_a_matrix_that_is_no_covariance_is_refused(R):
    """The covariance of a fix must be positive: no measurement is exact."""
    assert refusal(VisionSample(1.0, (0.0, 0.0), 0.0, R)) == "covariance not positive"


def test_whole_samples_pass():
    """Optional parts may be missing."""
    assert refusal(VisionSample(1.0, (0.0, 0.0), None)) is None
    assert refusal(VisionSample(1.0, (0.0, 0.0), 0.1, I, 1.1)) is None
    assert refusal(ImuSample(1.0, (0.0, 0.0, 0.1))) is None
