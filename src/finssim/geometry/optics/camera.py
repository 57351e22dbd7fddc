"""A camera: a lens and where it stands."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from finssim.geometry.optics.errors import OpticsError
from finssim.geometry.optics.lens import Lens
from finssim.geometry.rotations import quat_to_matrix

__all__ = ["Camera"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Camera:
    """A lens at a pose T_pc = [R_pc, C_p] in the pool frame.

    Raises:
        OpticsError: Position or orientation is not finite or of the wrong shape, or the quaternion not of unit length.
    """

    lens: Lens
    position: Array
    """C_p: centre of the camera, pool frame [m], (3,)."""
    orientation: Array
    """q_pc (xyzw): optical axes to pool axes, (4,)."""

    def __post_init__(self) -> None:
        for name, size in (("position", 3), ("orientation", 4)):
            value = np.array(getattr(self, name), float)
            if value.shape != (size,) or not np.isfinite(value).all():
                raise OpticsError(f"camera {name} is {getattr(self, name)}, expected {size} finite numbers")
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        length = float(np.linalg.norm(self.orientation))
        if abs(length - 1.0) > 1e-6:
            raise OpticsError(f"camera orientation has length {length:.6g}, expected a unit quaternion xyzw")

    @cached_property
    def R_pc(self) -> Array:
        """Optical axes to pool axes, (3, 3)."""
        return quat_to_matrix(self.orientation / np.linalg.norm(self.orientation))
