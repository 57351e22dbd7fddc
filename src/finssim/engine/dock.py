"""The shape of a dock: a funnel with a tube behind it. Plain data, checked when made."""

import math
from dataclasses import astuple, dataclass, fields

import warp as wp

from finssim.engine.surroundings import SurroundingsError
from finssim.physics.funnel import Funnel


@dataclass(frozen=True, kw_only=True)
class Dock:
    """A block with a cone and a tube bored into it, one in every world; where they stand is set by world.

    Dock axes: the origin is the middle of the throat, where cone and tube meet; x points into the tube.
    """

    mouth_radius: float
    """Of the cone's wide end [m]."""
    throat_radius: float
    """Of its narrow end and of the tube [m]."""
    cone_length: float
    """[m]"""
    tube_length: float
    """[m]"""
    rim: float
    """Thickness of the block around the mouth and behind the tube [m]."""
    stiffness: float
    """Per point of the hull [N/m]."""
    damping: float
    """Against approach, per point [N s/m]."""
    friction: float = 0.2
    slip: float = 0.05
    """Speed below which friction is linear [m/s]."""

    def __post_init__(self) -> None:
        for name, value in zip((field.name for field in fields(self)), astuple(self), strict=True):
            zero = name in ("damping", "friction")
            if not math.isfinite(value) or value < 0.0 or (value == 0.0 and not zero):
                raise SurroundingsError(
                    f"dock: {name} is {value}, expected a finite number {'of 0 or more' if zero else 'above 0'}"
                )
        if self.mouth_radius <= self.throat_radius:
            raise SurroundingsError(
                f"dock: mouth_radius {self.mouth_radius} m, expected more than throat_radius {self.throat_radius} m"
            )

    def struct(self, worlds: int, vehicles: int, device: wp.Device) -> Funnel:
        """The struct that kernels take; every dock stands at the origin, pointing along world x."""
        funnel = Funnel()
        for name in ("mouth_radius", "throat_radius", "cone_length", "tube_length"):
            setattr(funnel, name, getattr(self, name))
        for name in ("stiffness", "damping", "friction", "slip"):
            setattr(funnel, name, getattr(self, name))
        funnel.outer_radius, funnel.back = self.mouth_radius + self.rim, self.rim
        funnel.position = wp.zeros(worlds, dtype=wp.vec3, device=device)
        funnel.quaternion = wp.full(worlds, value=wp.quat(0.0, 0.0, 0.0, 1.0), dtype=wp.quat, device=device)
        funnel.force = wp.zeros((worlds, vehicles), dtype=wp.float32, device=device)
        funnel.impulse = wp.zeros((worlds, vehicles), dtype=wp.float32, device=device)
        return funnel
