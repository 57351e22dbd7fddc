"""Thruster layouts for the control tests: the published FinsROV numbers, and layouts with fewer thrusters."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray


@dataclass(frozen=True)
class Layout:
    """A thruster matrix about the commanded point (body forward/left/up), limits [N] and pure-axis wrench limits."""

    name: str
    B: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    wrench_limits: NDArray[np.float64]

    @property
    def weights(self) -> NDArray[np.float64]:
        return np.divide(1.0, self.wrench_limits, out=np.zeros(6), where=self.wrench_limits > 0.0)


def matrix(positions, axes) -> NDArray[np.float64]:
    """Return the columns (axis, position x axis) of thrusters positioned about the commanded point."""
    axes = np.array(axes, float)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return np.vstack([axes.T, np.cross(np.array(positions, float), axes).T])


# Published positions about the centre of mass, already in forward/left/up.
FINSROV_POSITIONS = [
    (0.08312216, 0.13304673, 0.04907), (-0.13687684, 0.13304667, 0.04907),
    (-0.13687672, -0.14295308, 0.04907), (0.08312222, -0.14295302, 0.04907),
    (0.19834375, 0.12746146, 0.03717), (-0.23286586, 0.14669480, 0.03717),
    (-0.23286586, -0.15660119, 0.03717), (0.19834371, -0.13736765, 0.03717),
]  # fmt: skip
FINSROV_AXES = [(0, 0, 1)] * 4 + [(1, -1, 0), (1, 1, 0), (-1, 1, 0), (-1, -1, 0)]
FINSROV_B = matrix(FINSROV_POSITIONS, FINSROV_AXES)
CC, CCW = (-5.7618, 7.3809), (-7.9750, 8.4749)
MEASURED = np.array([CCW, CC, CC, CCW, CC, CCW, CC, CCW])
SYMMETRIC_LIMITS = np.array([19.528527, 18.415027, 22.501886, 3.863995, 3.079985, 7.080833])
MEASURED_LIMITS = np.array([18.586585, 18.068824, 25.636077, 3.791353, 2.535180, 6.947713])

FINSROV = Layout("finsrov", FINSROV_B, np.full(8, -7.0), np.full(8, 7.0), SYMMETRIC_LIMITS)
FINSROV_MEASURED = Layout("finsrov measured", FINSROV_B, MEASURED[:, 0], MEASURED[:, 1], MEASURED_LIMITS)

# Four vectored and two vertical thrusters: pitch has no authority of its own.
SIX = Layout(
    "six",
    matrix(
        [(0.16, -0.11, 0), (0.16, 0.11, 0), (-0.16, -0.11, 0), (-0.16, 0.11, 0), (0, -0.11, 0), (0, 0.11, 0)],
        [(1, 1, 0), (1, -1, 0), (-1, 1, 0), (-1, -1, 0), (0, 0, 1), (0, 0, 1)],
    ),
    np.full(6, -40.0),
    np.full(6, 50.0),
    np.array([120.0, 120.0, 80.0, 8.8, 0.0, 24.0]),
)  # fmt: skip
# Two along, one across, two vertical: fewer thrusters than axes, so most wrenches are out of reach.
FIVE = Layout(
    "five",
    matrix(
        [(-0.3, 0.15, 0.0), (-0.3, -0.15, 0.0), (0.05, 0.0, 0.02), (0.25, 0.0, 0.1), (-0.25, 0.0, 0.1)],
        [(1, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 1)],
    ),
    np.array([-20.0, -20.0, -15.0, -12.0, -12.0]),
    np.array([30.0, 30.0, 15.0, 12.0, 12.0]),
    np.array([40.0, 15.0, 24.0, 1.0, 6.0, 7.0]),
)

LAYOUTS = [FINSROV, FINSROV_MEASURED, SIX, FIVE]
assert math.isclose(float(np.linalg.svd(FINSROV_B)[1][0]), 2.0008, abs_tol=1e-3)  # published singular value


@pytest.fixture(params=LAYOUTS, ids=lambda layout: layout.name)
def layout(request: pytest.FixtureRequest) -> Layout:
    """Each layout in turn."""
    return request.param


@pytest.fixture
def finsrov() -> Layout:
    """The published vehicle with limits of 7 N."""
    return FINSROV
