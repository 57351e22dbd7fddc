"""Where each segment begins: what was measured there, and how far a fit may move it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.simulation.segments import Segment
from finssim.geometry.rotations import quat_from_rotvec, quat_multiply

__all__ = ["STATES", "InitialStates"]

Array = NDArray[np.float64]

STATES = ("u", "v", "w", "p", "q", "r", "roll", "pitch", "yaw", "x", "y", "z")
"""Numbers of an initial state: nu, a small turn about the body axes [rad], a world displacement [m]."""

UNKNOWN = np.array([0.5, 0.5, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 1e-6, 1e-6, 1e-6, 1e-6])
"""Standard deviation of what nobody measured; heading and place do not matter then."""

LOOSE = np.array([0.2, 0.2, 0.2, 0.3, 0.3, 0.3, 0.1, 0.1, 0.1, 0.2, 0.2, 0.2])
"""Of what was measured and is compared: wide, for the same measurements count as residuals."""

TIGHT = np.array([0.03, 0.03, 0.03, 0.03, 0.03, 0.03, 0.02, 0.02, 0.02, 0.03, 0.03, 0.03])
"""Of what was measured and is not compared."""

SHOWN_BY = (
    *(("u", "x", "y"), ("v", "x", "y"), ("w", "z", "depth"), ("p", "roll"), ("q", "pitch"), ("r", "yaw")),
    *(("roll",), ("pitch",), ("yaw",), ("x",), ("y",), ("z", "depth")),
)
"""Channels that show a state, in the order of `STATES`."""

STEPS = np.array([0.002] * 9 + [0.005] * 3)
"""Of the finite differences: small, for what is unstable multiplies them."""


class InitialStates:
    """Deviations z of the segments' initial states from the measured ones, with a prior.

    Attributes:
        free: Which of `STATES` a fit moves, indices (q,).
        std: Of the prior, (S, q).
    """

    def __init__(self, segments: Sequence[Segment]) -> None:
        """Free velocities and tilt everywhere, heading and place where some segment knows them."""
        known = np.stack([s.known for s in segments])
        self.free = np.concatenate([np.arange(8), 8 + np.flatnonzero(known[:, 8:].any(axis=0))])
        seen = np.array([[any(c in s.measured for c in columns) for columns in SHOWN_BY] for s in segments])
        self.std = np.where(known, np.where(seen, LOOSE, TIGHT), UNKNOWN)[:, self.free]
        self._nu = np.stack([s.nu for s in segments])
        self._quaternion = np.stack([s.quaternion for s in segments])
        self._position = np.stack([s.position for s in segments])

    @property
    def steps(self) -> Array:
        """Finite difference of each free number, (q,)."""
        return np.asarray(STEPS[self.free])

    def initial(self, z: Array) -> dict[str, Array]:
        """`nu`, `quaternion` and `position` for `Rollouts.run`.

        Args:
            z: Deviations, (C, S, q); C may be 1.
        """
        full = np.zeros((*z.shape[:2], 12))
        full[..., self.free] = z
        return {
            "nu": self._nu + full[..., :6],
            "quaternion": quat_multiply(self._quaternion, quat_from_rotvec(full[..., 6:9])),
            "position": self._position + full[..., 9:],
        }
