"""Where a vehicle swims: pool, tank or open water, and how it learns where it is there."""

from __future__ import annotations

import math

import numpy as np

from finssim.pool.plant_spec import Basin, PlantSpec, PlantSpecError
from finssim.pool.positioning import POSITIONING, Positioning
from finssim.pool.water_spec import Circulation, Swell
from finssim.vehicles.defaults import SITES

__all__ = ["positioning_of", "site_of"]

TANK, OPEN = (
    Basin(length=size[0], width=size[1], depth=size[2]) for size in SITES.values() if size is not None
)
STREAM = {"nominal": 0.0, "realistic": 0.1, "hard": 0.25}
"""Current of open water by severity [m/s]."""
SWELL = {"nominal": 0.0, "realistic": 0.05, "hard": 0.15}
"""Amplitude of the longest of its three waves [m]."""


def site_of(name: str, spec: PlantSpec) -> PlantSpec:
    """The plant at a site: the vehicle as it is built, in other water.

    Args:
        name: pool, tank (10 m x 6 m, 5 m deep, still but for the pool's own eddies) or open-water (20 m deep, without
            walls that it could meet or a tether, with a stream and three waves by severity).
        spec: Drawn for the pool.

    Raises:
        PlantSpecError: There is no such site, or the vehicle has no room in it.
    """
    if name not in SITES:
        raise PlantSpecError(f"unknown site '{name}'; available: {', '.join(SITES)}")
    if name == "pool":
        return spec
    if name == "tank":
        if spec.basin.length > TANK.length:
            raise PlantSpecError(
                f"{spec.vehicle} needs {spec.basin.length:.1f} m, the tank has {TANK.length:g} m: take open-water"
            )
        return spec.model_copy(update={"basin": TANK, "tether": None})
    random = np.random.default_rng([spec.seed, 0x5EA])
    towards, speed = float(random.uniform(-math.pi, math.pi)), STREAM[spec.severity]
    waves = tuple(
        Swell(
            amplitude=SWELL[spec.severity] * share,
            wavelength=length,
            heading=towards + float(random.uniform(-0.5, 0.5)),
            phase=float(random.uniform(-math.pi, math.pi)),
        )
        for share, length in ((1.0, 12.0), (0.5, 7.0), (0.3, 4.0))
        if SWELL[spec.severity]
    )
    stream = (speed * math.cos(towards), speed * math.sin(towards), 0.0)
    return spec.model_copy(
        update={"basin": OPEN, "tether": None, "circulation": Circulation(stream=stream, waves=waves)}
    )


def positioning_of(name: str, seed: int) -> Positioning | None:
    """The positioning system of that name; None for `none`.

    Raises:
        PlantSpecError: There is no such system.
    """
    if name == "none":
        return None
    if name not in POSITIONING:
        raise PlantSpecError(f"unknown positioning '{name}'; available: none, {', '.join(POSITIONING)}")
    return Positioning(POSITIONING[name], seed)
