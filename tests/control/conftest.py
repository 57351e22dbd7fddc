"""Thruster layouts for the control tests: the published FinsROV numbers, and layouts with fewer thrusters."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


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
    """Columns (axis, position x axis) of thrusters placed about the commanded point."""
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


@dataclass
class State:
    """A batch of vehicles as a controller measures them."""

    position: NDArray[np.float64]
    quaternion: NDArray[np.float64]
    nu: NDArray[np.float64]


def skew(a):
    """Matrix S with S b = a x b, of vectors (..., 3)."""
    S = np.zeros((*a.shape, 3))
    S[..., 2, 1], S[..., 0, 2], S[..., 1, 0] = np.moveaxis(a, -1, 0)
    return S - np.swapaxes(S, -1, -2)


def turn(rotvec):
    """Rotation matrices of rotation vectors, by Rodrigues' formula."""
    angle = np.linalg.norm(rotvec, axis=-1)[..., None, None]
    S = skew(rotvec)
    return np.eye(3) + np.sinc(angle / np.pi) * S + 0.5 * np.sinc(0.5 * angle / np.pi) ** 2 * S @ S


class Pool:
    """A second, independent simulation of a vehicle: float64, 6 DOF at the centre of gravity, diagonal model.

    (m + m_A) v_dot + omega x (m + m_A) v = force - D v, and Euler's equations with the Munk moment; weight and buoyancy
    at their centres; each thruster behind a pure delay and a first-order lag. Written from the vehicle's numbers alone.
    """

    STEP = 1.0 / 120.0

    def __init__(
        self, vehicle, worlds, position=(0.0, 0.0, -0.5), yaw=0.0, current=(0.0, 0.0, 0.0), load=0.0
    ):
        calibrated = vehicle.hydrodynamics["calibrated"]
        self.vehicle = vehicle
        self.g = np.array(vehicle.body.center_of_gravity)
        self.lever = np.array(vehicle.body.center_of_buoyancy) - self.g
        rigid = np.concatenate([np.full(3, vehicle.body.mass), np.diag(vehicle.body.inertia)])
        self.M = rigid + np.diag(calibrated.added_mass)
        self.d1, self.d2 = np.diag(calibrated.linear_damping), np.diag(calibrated.quadratic_damping)
        self.B = vehicle.thruster_matrix(vehicle.body.center_of_gravity)
        self.lower, self.upper = vehicle.force_limits
        lag = next(iter(vehicle.thrusters.values()))
        self.decay, self.delay = 1.0 - np.exp(-self.STEP / lag.time_constant), round(lag.delay / self.STEP)
        self.R = Rotation.from_rotvec(np.tile([0.0, 0.0, yaw], (worlds, 1))).as_matrix()
        self.p = np.tile(position, (worlds, 1)) + self.R @ self.g
        self.nu = np.zeros((worlds, 6))
        self.current, self.load = np.array(current), load
        self.thrust = np.zeros((worlds, self.B.shape[1]))
        self.queue = [self.thrust] * self.delay

    @property
    def measured(self):
        """Pose and velocity of the body origin."""
        nu = self.nu.copy()
        nu[:, :3] += nu[:, 3:] @ skew(self.g).T  # omega x r is -r x omega
        return State(self.p - self.R @ self.g, Rotation.from_matrix(self.R).as_quat(canonical=True), nu)

    def advance(self, command, period):
        """Moves on by one control period under commanded thrusts (worlds, n)."""
        assert (command <= self.upper).all() and (command >= self.lower).all()
        for _ in range(round(period / self.STEP)):
            self.queue.append(command)
            self.thrust = self.thrust + self.decay * (self.queue.pop(0) - self.thrust)
            up = self.R[:, 2]
            relative = self.nu.copy()
            relative[:, :3] -= self.current @ self.R
            tau = self.thrust @ self.B.T - (self.d1 + self.d2 * np.abs(relative)) * relative
            tau[:, :3] += (self.vehicle.buoyancy - self.vehicle.weight - self.load) * up
            tau[:, 3:] += self.vehicle.buoyancy * up @ skew(self.lever).T
            p, h = np.split((self.M * relative)[..., None], 2, axis=1)
            v, omega = skew(relative[:, :3]), skew(self.nu[:, 3:])
            tau[:, :3] -= (omega @ p)[..., 0]
            tau[:, 3:] -= (omega @ h + v @ p)[..., 0]
            self.nu = self.nu + self.STEP * tau / self.M
            self.p = self.p + self.STEP * (self.R @ self.nu[:, :3, None])[..., 0]
            self.R = self.R @ turn(self.STEP * self.nu[:, 3:])


@pytest.fixture(scope="session")
def pool():
    """The class of the independent simulation."""
    return Pool
