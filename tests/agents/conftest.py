"""A second, independent simulation of a vehicle, for the tests of the controllers."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


@dataclass
class State:
    """A batch of vehicle states as a controller measures them."""

    position: NDArray[np.float64]
    quaternion: NDArray[np.float64]
    nu: NDArray[np.float64]


def skew(a):
    """Return the matrix S with S b = a x b, of vectors (..., 3)."""
    S = np.zeros((*a.shape, 3))
    S[..., 2, 1], S[..., 0, 2], S[..., 1, 0] = np.moveaxis(a, -1, 0)
    return S - np.swapaxes(S, -1, -2)


def turn(rotvec):
    """Return rotation matrices of rotation vectors, by Rodrigues' formula."""
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
        """Return pose and velocity of the body origin."""
        nu = self.nu.copy()
        nu[:, :3] += nu[:, 3:] @ skew(self.g).T  # since omega x r = -r x omega
        return State(self.p - self.R @ self.g, Rotation.from_matrix(self.R).as_quat(canonical=True), nu)

    def advance(self, command, period):
        """Advance by one control period under commanded thrusts (worlds, n)."""
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
