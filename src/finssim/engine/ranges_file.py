"""Ranges of domain randomisation: one YAML file, checked when it is read."""

import difflib
import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from finssim.engine.surroundings import SurroundingsError, Wave
from finssim.yaml_file import read_mapping

SHIPPED = Path(__file__).parent / "ranges"
AXES = ("surge", "sway", "heave", "roll", "pitch", "yaw")
MOST_WAVES = 8
"""Most waves that may be drawn for a world: every one costs time in every step."""


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


def _above_zero(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] <= 0.0:
        raise ValueError(f"is {list(pair)}, expected numbers above 0")
    return pair


def _factor_or_with_mass(value: Any) -> Any:
    if isinstance(value, str) and value != "with_mass":
        raise ValueError(f"is '{value}', expected two numbers [low, high] or with_mass")
    return value


def _positive_or_with_mass(value: Any) -> Any:
    return value if value == "with_mass" else _above_zero(_ordered(value))


def _count(pair: tuple[int, int]) -> tuple[int, int]:
    if not 0 <= pair[0] <= pair[1] <= MOST_WAVES:
        raise ValueError(
            f"is {list(pair)}, expected two whole numbers [low, high] with 0 <= low <= high <= {MOST_WAVES}"
        )
    return pair


Interval = Annotated[tuple[float, float], AfterValidator(_ordered)]
Scale = Annotated[Interval, AfterValidator(_positive)]
Above0 = Annotated[Interval, AfterValidator(_above_zero)]
Volume = Annotated[
    tuple[float, float] | Literal["with_mass"],
    BeforeValidator(_factor_or_with_mass),
    AfterValidator(_positive_or_with_mass),
]


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

    count: Annotated[tuple[int, int], AfterValidator(_count)]
    amplitude: Scale
    """[m]"""
    wavelength: Above0
    """[m]"""

    @model_validator(mode="after")
    def _unbroken(self) -> "WaveRanges":
        highest, shortest = self.amplitude[1], self.wavelength[0]
        try:
            Wave(amplitude=highest, wavelength=shortest)
        except SurroundingsError:
            raise ValueError(
                f"amplitude is {list(self.amplitude)}, expected less than 0.07 of the shortest wavelength, "
                f"{0.07 * shortest:.3g} m here: a linear wave breaks above it"
            ) from None
        return self


class Ranges(Part):
    """What is drawn for every episode: factors on the vehicle file's numbers unless a unit is given."""

    name: str
    source: str = ""
    mass: Above0 = (1.0, 1.0)
    volume: Volume = (1.0, 1.0)
    """A factor, or `with_mass`: the volume follows the mass, so that the trim is kept."""
    inertia: Above0 = (1.0, 1.0)
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
        where = ".".join(str(x) for x in first["loc"] if "[" not in str(x))  # not pydantic's names of types
        message = first["msg"].removeprefix("Value error, ")
        raise RangesError(f"{path}: {where}: {message}") from None
