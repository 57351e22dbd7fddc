"""Surroundings of the vehicles: a pool with walls, a tether, a dock. Plain data, validated on construction."""

import math
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import warp as wp

from finssim.core.registry import WORLDS
from finssim.physics.contact import PoolWalls
from finssim.physics.funnel import Funnel
from finssim.physics.tether import Tether


class SurroundingsError(ValueError):
    """A description of water, pool, tether or dock is invalid."""


def require(condition: bool, sentence: str) -> None:
    """Raise an error with the given message unless a condition is true."""
    if not condition:
        raise SurroundingsError(sentence)


@dataclass(frozen=True, kw_only=True)
class RectangularPool:
    """A rectangular pool centred on the world's z axis. The default is the paper's: 4 × 2 m, 1 m of water."""

    length: float = 4.0
    """Length along world x [m]."""
    width: float = 2.0
    """Width along world y [m]."""
    depth: float = 1.0
    """[m]"""
    stiffness: float = 4000.0
    """Stiffness of a wall, per corner of the vehicle [N/m]."""
    damping: float = 100.0
    """Damping of the approach to a wall, per corner [N s/m]."""
    friction: float = 0.2
    """Coulomb coefficient of walls and floor [-]."""

    def __post_init__(self) -> None:
        numbers = (self.length, self.width, self.depth, self.stiffness, self.damping, self.friction)
        require(all(math.isfinite(x) for x in numbers), "pool: every number must be finite")
        require(
            min(self.length, self.width, self.depth) > 0.0, "pool: length, width and depth must exceed 0 m"
        )
        require(
            min(self.stiffness, self.damping, self.friction) >= 0.0,
            "pool: wall coefficients must not be negative",
        )

    def walls(self) -> PoolWalls:
        """Return the struct for the kernels."""
        walls = PoolWalls()
        walls.present = 1
        walls.half_length, walls.half_width, walls.depth = 0.5 * self.length, 0.5 * self.width, self.depth
        walls.stiffness, walls.damping, walls.friction = self.stiffness, self.damping, self.friction
        return walls


@dataclass(frozen=True, kw_only=True)
class TetherLine:
    """A taut tether from an anchor to the vehicle."""

    anchor: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Point where the tether enters the water, world frame [m]."""
    attachment: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Point on the vehicle, body frame [m]."""
    diameter: float = 0.0076
    """[m]; the default is Blue Robotics' Fathom tether."""
    drag_coefficient: float = 1.2
    """Drag coefficient of a cylinder [-]."""
    wet_weight: float = 0.0
    """Weight in water per length [N/m]; 0 is neutral."""

    def __post_init__(self) -> None:
        numbers = (*self.anchor, *self.attachment, self.diameter, self.drag_coefficient, self.wet_weight)
        require(all(math.isfinite(x) for x in numbers), "tether: every number must be finite")
        require(self.diameter > 0.0, f"tether: diameter is {self.diameter}, expected more than 0 m")
        require(self.drag_coefficient >= 0.0, "tether: drag_coefficient must not be negative")

    def struct(self) -> Tether:
        """Return the struct for the kernels."""
        tether = Tether()
        tether.anchor, tether.attachment = wp.vec3(*self.anchor), wp.vec3(*self.attachment)
        tether.diameter, tether.drag_coefficient = self.diameter, self.drag_coefficient
        tether.wet_weight = self.wet_weight
        return tether


@dataclass(frozen=True, kw_only=True)
class Dock:
    """A block with a conical funnel and a tube, one in every world, with a pose per world.

    Dock axes: the origin is the middle of the throat, where cone and tube meet; x points into the tube.
    """

    mouth_radius: float
    """Radius of the cone's wide end [m]."""
    throat_radius: float
    """Radius of the cone's narrow end and of the tube [m]."""
    cone_length: float
    """[m]"""
    tube_length: float
    """[m]"""
    rim: float
    """Thickness of the block around the mouth and behind the tube [m]."""
    stiffness: float
    """Stiffness per point of the hull [N/m]."""
    damping: float
    """Damping of the approach, per point [N s/m]."""
    friction: float = 0.2
    """Coulomb coefficient of the dock's surface [-]."""
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
        """Return the struct for the kernels, with every dock at the origin and along world x."""
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


def described_world(name_or_path: "str | Path") -> Any:
    """Return a described world, read by the perception extension.

    Args:
        name_or_path: A site of `finssim worlds`, or a YAML file.

    Raises:
        WorldError: No world has that name, or the file is invalid.
        SurroundingsError, RegistryError: The extension is not installed, or cannot be used.
    """
    if "described" not in WORLDS:
        raise SurroundingsError(
            f"world '{name_or_path}': no extension reads described worlds; install finssim with its extensions"
        )
    return WORLDS["described"](name_or_path)
