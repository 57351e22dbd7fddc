"""A body that moves and turns by known functions of time, and the readings of sensors anywhere on it."""

import numpy as np

from finssim.core.rotations import (
    quat_conjugate,
    quat_from_euler,
    quat_inverse_rotate,
    quat_multiply,
    quat_rotate,
    quat_to_euler,
)

GRAVITY = np.array([0.0, 0.0, -9.81])
H = 1e-3
"""Step of the fourth-order differences that approximate derivatives [s]."""


def derivative(f, t):
    """Return df/dt by central differences of fourth order."""
    return (8.0 * (f(t + H) - f(t - H)) - (f(t + 2 * H) - f(t - 2 * H))) / (12.0 * H)


class MovingBody:
    """Body with sums of sines in position and Euler angles; its derivatives are differences of these
    functions alone."""

    def __init__(self, seed=0, fastest=2.0, turns=False):
        """`fastest` [rad/s] bounds the sines; with `turns` the vehicle also rolls over steadily."""
        rng = np.random.default_rng(seed)
        self.rates, self.phases = rng.uniform(0.5, fastest, 6), rng.uniform(0.0, 6.28, 6)
        self.sizes = np.array([0.5, 0.4, 0.3, 0.3, 0.25, 0.9])
        self.turns = 0.6 if turns else 0.0

    def _sines(self, t):
        return self.sizes * np.sin(np.asarray(t)[:, None] * self.rates + self.phases)

    def position(self, t, point=(0.0, 0.0, 0.0)):
        """Return the position of a body point in the world, 3 m deep on average, (n, 3)."""
        return self._sines(t)[:, :3] + [0.0, 0.0, -3.0] + quat_rotate(self.quaternion(t), np.asarray(point))

    def quaternion(self, t):
        """Return the rotation from body to world, (n, 4), of continuous sign."""
        roll, pitch, yaw = self._sines(t)[:, 3:].T
        q = quat_from_euler(roll + self.turns * np.asarray(t), pitch, yaw)
        return q

    def omega(self, t):
        """Return the angular rate, body frame, (n, 3): 2 q* q_dot."""
        return 2.0 * quat_multiply(quat_conjugate(self.quaternion(t)), derivative(self.quaternion, t))[:, :3]

    def velocity(self, t, point=(0.0, 0.0, 0.0)):
        """Return the velocity of a body point, body frame, (n, 3)."""
        return quat_inverse_rotate(self.quaternion(t), derivative(lambda s: self.position(s, point), t))

    def nu(self, t):
        """Return the velocity of the body origin, (n, 6)."""
        return np.concatenate([self.velocity(t), self.omega(t)], axis=-1)

    def specific_force(self, t, point=(0.0, 0.0, 0.0)):
        """Return an accelerometer's reading at a body point: R' (second derivative of its position - g), (n, 3)."""
        a = derivative(lambda s: derivative(lambda z: self.position(z, point), s), t)
        return quat_inverse_rotate(self.quaternion(t), a - GRAVITY)

    def columns(self, t, *groups, at=(0.0, 0.0, 0.0)):
        """Return the columns of the named groups, as logged by sensors at a body point."""
        q = self.quaternion(t)
        made = {}
        for group in groups:
            names, values = {
                "velocity": ("uvw", lambda: self.velocity(t, at)),
                "rates": ("pqr", lambda: self.omega(t)),
                "acceleration": (("ax", "ay", "az"), lambda: self.specific_force(t, at)),
                "quaternion": (("qx", "qy", "qz", "qw"), lambda: q),
                "euler": (("roll", "pitch", "yaw"), lambda: np.stack(quat_to_euler(q), axis=-1)),
                "position": ("xyz", lambda: self.position(t, at)),
                "depth": (("depth",), lambda: -self.position(t, at)[:, 2:]),
            }[group]
            made |= dict(zip(names, values().T, strict=True))
        return made
