"""Surroundings of the vehicles: moving water, a pool with walls, a tether. Plain data, checked on construction."""

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from finssim.core.registry import WORLDS
from finssim.physics.contact import PoolWalls
from finssim.physics.funnel import Funnel
from finssim.physics.tether import Tether
from finssim.physics.water import WaterArrays, dispersion


class SurroundingsError(ValueError):
    """A description of water, pool or tether that cannot be."""


def _require(condition: bool, sentence: str) -> None:
    if not condition:
        raise SurroundingsError(sentence)


@dataclass(frozen=True, kw_only=True)
class Wave:
    """One linear wave; its period follows from its length and the depth."""

    amplitude: float
    """Half the height from trough to crest [m]."""
    wavelength: float
    """[m]"""
    heading: float = 0.0
    """Direction of travel, from world x towards y [rad]."""
    phase: float = 0.0
    """[rad]"""

    def __post_init__(self) -> None:
        _require(self.wavelength > 0.0, f"wave: wavelength is {self.wavelength}, expected a length above 0 m")
        _require(
            0.0 <= self.amplitude < 0.07 * self.wavelength,
            f"wave: amplitude {self.amplitude} m is not small for a wavelength of {self.wavelength} m: "
            "a linear wave breaks above 0.07 wavelengths; give less",
        )


@dataclass(frozen=True, kw_only=True)
class Water:
    """Moving water, the same in every world until it is randomised."""

    current: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Velocity at the still surface, world frame [m/s]."""
    shear: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Change of the current with height, d(current)/dz [1/s]."""
    drift_std: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Standard deviation of the slowly drifting part [m/s]."""
    drift_time: float = 15.0
    """Its correlation time [s]."""
    waves: Sequence[Wave] = ()
    depth: float = 1.0
    """Still water depth, for the wave dispersion [m]."""

    def __post_init__(self) -> None:
        numbers = (*self.current, *self.shear, *self.drift_std, self.drift_time, self.depth)
        _require(all(math.isfinite(x) for x in numbers), "water: every number must be finite")
        _require(self.depth > 0.0, f"water: depth is {self.depth}, expected more than 0 m")
        _require(min(self.drift_std) >= 0.0, "water: drift_std is a standard deviation, expected 0 or more")

    @property
    def drifting(self) -> bool:
        """True if the current has a random part that must be advanced every step."""
        return any(x > 0.0 for x in self.drift_std) and self.drift_time > 0.0

    @property
    def moving(self) -> bool:
        """True if there are currents or waves."""
        return self.drifting or bool(self.waves) or any((*self.current, *self.shear))

    def arrays(
        self, worlds: int, density: float, gravity: float, device: wp.Device, max_waves: int = 0
    ) -> WaterArrays:
        """Return the same water for every world, as Warp arrays with room for `max_waves` more waves.

        Args:
            worlds: How many.
            density: Of the water [kg/m³].
            gravity: [m/s²].
            device: Of the arrays.
            max_waves: How many more.
        """

        def full(value: object, dtype: object) -> wp.array:
            return wp.full(worlds, value=value, dtype=dtype, device=device)

        n = len(self.waves) + max_waves
        k = np.array([2.0 * math.pi / w.wavelength for w in self.waves])
        columns = {
            "wave_amplitude": [w.amplitude for w in self.waves],
            "wave_number": k,
            "wave_frequency": dispersion(k, self.depth, gravity),
            "wave_heading": [w.heading for w in self.waves],
            "wave_phase": [w.phase for w in self.waves],
        }
        out = WaterArrays()
        out.density, out.gravity, out.depth = density, gravity, self.depth
        out.n_waves, out.moving = n, int(self.moving or max_waves > 0)
        out.current = full(wp.vec3(*self.current), wp.vec3)
        out.shear = full(wp.vec3(*self.shear), wp.vec3)
        out.drift = wp.zeros(worlds, dtype=wp.vec3, device=device)
        out.drift_rate = wp.zeros(worlds, dtype=wp.vec3, device=device)
        out.drift_std = full(wp.vec3(*self.drift_std), wp.vec3)
        out.drift_time = full(self.drift_time if self.drifting else 0.0, float)
        for name, values in columns.items():
            # An unused component has amplitude 0; its wave number 1 keeps 1/(1 - exp(-2kh)) finite.
            table = np.full((worlds, max(n, 1)), 1.0 if name == "wave_number" else 0.0, dtype=np.float32)
            table[:, : len(self.waves)] = values
            setattr(out, name, wp.array(table, dtype=float, device=device))
        return out


@dataclass(frozen=True, kw_only=True)
class RectangularPool:
    """A rectangular pool centred on the world's z axis. The default is the paper's: 4 × 2 m, 1 m of water."""

    length: float = 4.0
    """Along world x [m]."""
    width: float = 2.0
    """Along world y [m]."""
    depth: float = 1.0
    """[m]"""
    stiffness: float = 4000.0
    """Stiffness of a wall, per corner of the vehicle [N/m]."""
    damping: float = 100.0
    """Against approach, per corner [N s/m]."""
    friction: float = 0.2
    """Coulomb coefficient of walls and floor [-]."""

    def __post_init__(self) -> None:
        numbers = (self.length, self.width, self.depth, self.stiffness, self.damping, self.friction)
        _require(all(math.isfinite(x) for x in numbers), "pool: every number must be finite")
        _require(
            min(self.length, self.width, self.depth) > 0.0, "pool: length, width and depth must exceed 0 m"
        )
        _require(
            min(self.stiffness, self.damping, self.friction) >= 0.0,
            "pool: wall coefficients must not be negative",
        )

    def walls(self) -> PoolWalls:
        """The struct that kernels take."""
        walls = PoolWalls()
        walls.present = 1
        walls.half_length, walls.half_width, walls.depth = 0.5 * self.length, 0.5 * self.width, self.depth
        walls.stiffness, walls.damping, walls.friction = self.stiffness, self.damping, self.friction
        return walls


@dataclass(frozen=True, kw_only=True)
class TetherLine:
    """A taut tether from an anchor to the vehicle."""

    anchor: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Point where it enters the water, world frame [m]."""
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
        _require(all(math.isfinite(x) for x in numbers), "tether: every number must be finite")
        _require(self.diameter > 0.0, f"tether: diameter is {self.diameter}, expected more than 0 m")
        _require(self.drag_coefficient >= 0.0, "tether: drag_coefficient must not be negative")

    def struct(self) -> Tether:
        """The struct that kernels take."""
        tether = Tether()
        tether.anchor, tether.attachment = wp.vec3(*self.anchor), wp.vec3(*self.attachment)
        tether.diameter, tether.drag_coefficient = self.diameter, self.drag_coefficient
        tether.wet_weight = self.wet_weight
        return tether


@dataclass(frozen=True, kw_only=True)
class Dock:
    """A block with a bored cone and tube in every world, placed by world.

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
    """Per point of the hull [N/m]."""
    damping: float
    """Against approach, per point [N s/m]."""
    friction: float = 0.2
    """Coulomb coefficient of its surface [-]."""
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
        """Return the struct that kernels take, with every dock at the origin, pointing along world x."""
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
    """Return a described world, which the extension for perception reads.

    Args:
        name_or_path: A site of `finssim worlds`, or a YAML file.

    Raises:
        WorldError: There is none of that name, or the file is refused.
        SurroundingsError, RegistryError: The extension is not installed, or cannot be used.
    """
    if "described" not in WORLDS:
        raise SurroundingsError(
            f"world '{name_or_path}': no extension reads described worlds; install finssim with its extensions"
        )
    return WORLDS["described"](name_or_path)
