"""Ranges of domain randomisation: one YAML file, checked when it is read."""

import difflib
import math
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from finssim.yaml_file import read_mapping

SHIPPED = Path(__file__).parent / "ranges"
AXES = ("surge", "sway", "heave", "roll", "pitch", "yaw")


class RangesError(ValueError):
    """A ranges file that cannot be used."""


def _ordered(pair: tuple[float, float]) -> tuple[float, float]:
    if not all(math.isfinite(x) for x in pair) or pair[0] > pair[1]:
        raise ValueError(f"is {list(pair)}, expected two finite numbers [low, high] with low <= high")
    return pair


def _positive(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] < 0.0:
        raise ValueError(f"is {list(pair)}, expected numbers of 0 or more")
    return pair


Interval = Annotated[tuple[float, float], AfterValidator(_ordered)]
Scale = Annotated[Interval, AfterValidator(_positive)]


class Part(BaseModel):
    """Frozen, and no unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class AxisScales(Part):
    """A common factor and one factor per axis; an axis not named keeps its own factor at 1."""

    all: Scale = (1.0, 1.0)
    axes: dict[Literal["surge", "sway", "heave", "roll", "pitch", "yaw"], Scale] = Field(default_factory=dict)

    def bounds(self) -> tuple[list[float], list[float]]:
        """Low and high factor of each axis, six each."""
        pairs = [self.axes.get(axis, (1.0, 1.0)) for axis in AXES]  # type: ignore[call-overload]
        return [p[0] for p in pairs], [p[1] for p in pairs]


class ThrustScales(Part):
    """A factor common to all thrusters and one for each."""

    all: Scale = (1.0, 1.0)
    each: Scale = (1.0, 1.0)


class WaveRanges(Part):
    """Waves of random number, size and direction; the period follows from the length and the depth."""

    count: tuple[int, int]
    amplitude: Scale
    """[m]"""
    wavelength: Scale
    """[m]"""


class Ranges(Part):
    """What is drawn for every episode: factors on the vehicle file's numbers unless a unit is given."""

    name: str
    source: str = ""
    mass: Scale = (1.0, 1.0)
    volume: Scale | Literal["with_mass"] = (1.0, 1.0)
    """A factor, or `with_mass`: the volume follows the mass, so that the trim is kept."""
    inertia: Scale = (1.0, 1.0)
    center_of_gravity: Interval = (0.0, 0.0)
    """Offset along each axis [m]."""
    center_of_buoyancy: Interval = (0.0, 0.0)
    """Offset along each axis [m]."""
    added_mass: AxisScales = AxisScales()
    linear_damping: AxisScales = AxisScales()
    quadratic_damping: AxisScales = AxisScales()
    mesh_drag: Scale = (1.0, 1.0)
    """Factor on form and skin drag of the mesh model."""
    thrust: ThrustScales = ThrustScales()
    time_constant: Scale = (1.0, 1.0)
    delay: Scale = (1.0, 1.0)
    slew: Scale = (1.0, 1.0)
    current: Scale = (0.0, 0.0)
    """Horizontal speed [m/s], in a random direction."""
    waves: WaveRanges | None = None


def available() -> list[str]:
    """Names of the ranges that ship with FinsSim."""
    return sorted(path.stem for path in SHIPPED.glob("*.yaml"))


def load_ranges(name_or_path: str | Path) -> Ranges:
    """Read ranges by name or from a file.

    Args:
        name_or_path: One of `available()`, or a YAML file.

    Raises:
        RangesError: no such file, or a key or number in it is wrong; names file, key, value and expectation.
    """
    path = Path(name_or_path)
    if not path.is_file():
        path = SHIPPED / f"{name_or_path}.yaml"
    if not path.is_file():
        close = difflib.get_close_matches(str(name_or_path), available(), n=1)
        hint = f"; did you mean '{close[0]}'?" if close else ""
        raise RangesError(
            f"no ranges '{name_or_path}': give a YAML file or one of {', '.join(available())}{hint}"
        )
    data = read_mapping(path, RangesError, such_as="mass: [0.98, 1.02]")
    try:
        return Ranges.model_validate({"name": path.stem, **data})
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(x) for x in first["loc"])
        message = first["msg"].removeprefix("Value error, ")
        raise RangesError(f"{path}: {where}: {message}") from None
