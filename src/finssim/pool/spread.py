"""How far the plants of each severity lie from the vehicle file."""

from __future__ import annotations

from dataclasses import dataclass

from finssim.pool.plant_spec import Severity

__all__ = ["SPREADS", "Spread"]


@dataclass(frozen=True, kw_only=True)
class Spread:
    """How far a plant of one severity lies from the vehicle file: ±, uniform, unless a name says otherwise."""

    hydrodynamics: float = 0.0
    """Of every diagonal entry of added mass and damping [-]."""
    center: float = 0.0
    """Of the points where they are diagonal, per axis [m]."""
    tilt_deg: float = 0.0
    """Of the axes in which they are [deg]."""
    hull_share: float = 0.0
    """Part of the drag, on the axis where it is largest, that the hull's panels make [-]."""
    own_share: float = 0.0
    """Of the vehicle's speed that enters its propellers [-]."""
    induced_share: float = 0.0
    """Of a neighbour's jet [-]."""
    deduction: tuple[float, float] = (0.0, 0.0)
    """Least and most of the thrust [-]."""
    thrust: float = 0.0
    """Of each propeller's thrust, in each direction [-]."""
    motor: float = 0.0
    """Of each motor's lag, delay and slowest speed [-]."""
    fade: float = 0.0
    """Of the battery in a quarter of an hour [-]."""
    resistance: float = 0.0
    """Of the battery [ohm]."""
    mass: float = 0.0
    """[kg]"""
    gravity_offset: tuple[float, float] = (0.0, 0.0)
    """Least and most distance of the centre of gravity from where the file has it [m]."""
    buoyancy: float = 0.0
    """Amplitude of its drift [g]."""
    current: tuple[float, float] = (0.0, 0.0)
    """Least and most of the pool's circulation [m/s]; none at 0."""
    tether_weight: float = 0.0
    """[N/m]"""
    tether: tuple[float, float] = (0.0, 0.0)
    """Shortest and longest [m]; none at 0."""
    noise: float = 1.0
    """Factor on the file's instrument noise [-]."""
    pressure_drift: float = 0.0
    """[m/√s]"""
    crystal: float = 0.0
    """[ppm]"""


SPREADS: dict[Severity, Spread] = {
    "nominal": Spread(noise=0.5),
    "realistic": Spread(
        hydrodynamics=0.1,
        center=0.012,
        tilt_deg=3.0,
        hull_share=0.1,
        own_share=0.4,
        induced_share=0.05,
        deduction=(0.02, 0.06),
        thrust=0.15,
        motor=0.2,
        fade=0.04,
        resistance=0.03,
        mass=0.012,
        gravity_offset=(0.003, 0.006),
        buoyancy=4.0,
        current=(0.02, 0.04),
        tether=(4.4, 5.0),
        tether_weight=0.015,
        pressure_drift=2.0e-4,
        crystal=30.0,
    ),
    "hard": Spread(
        hydrodynamics=0.2,
        center=0.025,
        tilt_deg=6.0,
        hull_share=0.2,
        own_share=0.7,
        induced_share=0.1,
        deduction=(0.04, 0.12),
        thrust=0.25,
        motor=0.35,
        fade=0.08,
        resistance=0.06,
        mass=0.025,
        gravity_offset=(0.006, 0.012),
        buoyancy=8.0,
        current=(0.04, 0.08),
        tether=(3.9, 4.5),
        tether_weight=0.03,
        noise=1.5,
        pressure_drift=4.0e-4,
        crystal=60.0,
    ),
}
"""What a careful laboratory would have, and about twice that."""
