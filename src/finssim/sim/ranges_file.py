"""Domain randomisation ranges: one YAML file, validated when it is read."""

import difflib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    Field,
    TypeAdapter,
    ValidationError,
    model_validator,
)

from finssim.core.registry import ACTUATORS, TERMS
from finssim.core.yaml_file import read_mapping
from finssim.sim.distributions import (
    Above0,
    Distribution,
    Interval,
    RangesPart,
    Scale,
    Share,
    bounds_of,
    checked,
    sentence,
    unknown,
)
from finssim.sim.site import SurroundingsError
from finssim.sim.water import DEEP, SeaState, Wave
from finssim.vehicles.actuators import ActuatorKind
from finssim.vehicles.terms import Term

SHIPPED = Path(__file__).parent / "ranges"
AXES = ("surge", "sway", "heave", "roll", "pitch", "yaw")
MAX_WAVES = 8
"""Greatest number of waves that may be drawn for a world; each one slows down every step."""
LONGEST = 2.0
"""Longest delay that may be drawn, of a command or of an observation [s]."""
FASTEST_WATER = 10.0
"""Greatest current speed that may be drawn [m/s]."""


class RangesError(ValueError):
    """A ranges file is invalid."""


def _either(part: type[BaseModel]) -> Callable[[Any], Any]:
    """Return a validator that reads a mapping with keys of `part` as that section, and passes other values
    on."""

    def read(value: Any) -> Any:
        named = isinstance(value, Mapping) and not set(value) & set(Distribution.model_fields)
        return checked(part, value) if named else value

    return read


def _factor_or_with_mass(value: Any) -> Any:
    if isinstance(value, str) and value != "with_mass":
        raise ValueError(f"is '{value}', expected two numbers [low, high] or with_mass")
    return value


def _count(pair: tuple[int, int]) -> tuple[int, int]:
    if not 0 <= pair[0] <= pair[1] <= MAX_WAVES:
        raise ValueError(
            f"is {list(pair)}, expected two integers [low, high] with 0 <= low <= high <= {MAX_WAVES}"
        )
    return pair


def _short(drawn: Any) -> Any:
    if bounds_of(drawn)[1] > LONGEST:
        raise ValueError(f"reaches {bounds_of(drawn)[1]:g} s, expected at most {LONGEST:g} s")
    return drawn


def _swimmable(drawn: Any) -> Any:
    if max(map(abs, bounds_of(drawn))) > FASTEST_WATER:
        raise ValueError(
            f"reaches {max(map(abs, bounds_of(drawn))):g} m/s, expected at most {FASTEST_WATER:g} m/s"
        )
    return drawn


Time = Annotated[Scale, AfterValidator(_short)]
ONE, NONE = (1.0, 1.0), (0.0, 0.0)


class AxisScales(RangesPart):
    """A common factor and one factor per axis; the factor of an omitted axis is 1."""

    all: Scale = ONE
    axes: dict[Literal["surge", "sway", "heave", "roll", "pitch", "yaw"], Scale] = Field(default_factory=dict)

    def bounds(self) -> tuple[list[float], list[float]]:
        """Return the low and high factor of each axis, six each."""
        pairs = [bounds_of(self.axes.get(axis, ONE)) for axis in AXES]  # type: ignore[call-overload]
        return [p[0] for p in pairs], [p[1] for p in pairs]


class Offsets(RangesPart):
    """An offset along each axis [m]."""

    x: Interval = NONE
    y: Interval = NONE
    z: Interval = NONE


class EachScales(RangesPart):
    """A factor common to all thrusters and one for each thruster."""

    all: Scale = ONE
    each: Scale = ONE


class ThrustScales(EachScales):
    """Factors on the thrust, and failures of thrusters."""

    failure: Scale = ONE
    """Remaining fraction of a failed thruster's thrust; its probability applies to each thruster
    independently."""


class WaveRanges(RangesPart):
    """Waves of random number, size and direction; the period follows from wavelength and depth."""

    count: Annotated[tuple[int, int], AfterValidator(_count)]
    amplitude: Scale
    """[m]"""
    wavelength: Above0
    """[m]"""

    @model_validator(mode="after")
    def _unbroken(self) -> "WaveRanges":
        highest, shortest = bounds_of(self.amplitude)[1], bounds_of(self.wavelength)[0]
        try:
            Wave(amplitude=highest, wavelength=shortest)
        except SurroundingsError:
            raise ValueError(
                f"amplitude is {list(bounds_of(self.amplitude))}, expected less than 0.07 of the shortest wavelength, "
                f"{0.07 * shortest:.3g} m here: a linear wave breaks above it"
            ) from None
        return self


class SeaRanges(RangesPart):
    """A sea state of random height, period and direction: the components of `SeaState`, whose phases are drawn too."""

    spectrum: Literal["jonswap", "pierson-moskowitz"]
    height: Scale
    """Significant wave height [m]."""
    period: Above0
    """Period of the spectrum's peak [s]."""
    spread: float = Field(default=0.0, ge=0.0, lt=1.4)
    """Standard deviation of the directions [rad]."""
    peak: float = Field(default=3.3, ge=1.0, le=10.0)
    """Enhancement of JONSWAP's peak [-]."""
    components: int = Field(default=MAX_WAVES, ge=1, le=MAX_WAVES)
    """Number of waves."""

    @model_validator(mode="after")
    def _unbroken(self) -> "SeaRanges":
        height, period = bounds_of(self.height)[1], bounds_of(self.period)[0]
        if height > 0.0:
            try:
                sea = SeaState(
                    spectrum=self.spectrum, height=height, period=period, peak=self.peak, components=self.components
                )  # fmt: skip
                sea.waves(DEEP)
            except SurroundingsError as error:
                raise ValueError(str(error)) from None
        return self


class ProfileRanges(RangesPart):
    """The current profile of the given water, with a random factor and turned by a random angle."""

    scale: Scale = ONE
    turn: Interval = NONE
    """[rad]"""


def _waves_or_sea(value: Any) -> Any:
    """Read a mapping with a spectrum as a sea state, so that an error message lists only the keys of a sea
    state."""
    return checked(SeaRanges, value) if isinstance(value, Mapping) and "spectrum" in value else value


class DriftRanges(RangesPart):
    """A slow random component of the current, along each horizontal axis."""

    deviation: Scale
    """Its standard deviation [m/s]."""
    time: Above0 = (15.0, 15.0)
    """Its correlation time [s]."""


class TetherRanges(RangesPart):
    """Tether of the vehicle; omitted keys keep the values of the environment's own tether."""

    diameter: Above0 | None = None
    """[m]"""
    drag_coefficient: Scale | None = None
    wet_weight: Interval | None = None
    """Weight in water per length [N/m]; negative floats."""


class SensorRanges(RangesPart):
    """Noise, delay and dropouts of the controller's observations; omitted keys keep the environment's values."""

    position_std: Scale | None = None
    """Standard deviation of the noise, per axis [m]."""
    yaw_std: Scale | None = None
    """[rad]"""
    velocity_std: Scale | None = None
    """[m/s]"""
    rate_std: Scale | None = None
    """[rad/s]"""
    position_bias: Scale | None = None
    """Standard deviation of an offset that lasts an episode, per axis [m]."""
    yaw_bias: Scale | None = None
    """[rad]"""
    velocity_bias: Scale | None = None
    """[m/s]"""
    rate_bias: Scale | None = None
    """[rad/s]"""
    dropout: Share | None = None
    """Probability that a control step has no new sample."""
    delay: Time | None = None
    """Age of the observation [s]."""


class Correlated(RangesPart):
    """Entries with rank-correlated draws; each keeps its own distribution."""

    entries: tuple[str, ...] = Field(min_length=2)
    """Names as in the table of entries, such as linear_damping.surge."""
    correlation: tuple[tuple[float, ...], ...]
    """Correlation of the underlying normal numbers, (n, n); for normal distributions with little truncation also that
    of the draws."""

    @model_validator(mode="after")
    def _positive(self) -> "Correlated":
        n = len(self.entries)
        if any(len(row) != n for row in self.correlation) or len(self.correlation) != n:
            raise ValueError(f"correlation is not {n} by {n}, expected a row and a column for every entry")
        R = np.array(self.correlation)
        if not np.isfinite(R).all() or abs(R - R.T).max() > 1e-6 or abs(np.diag(R) - 1.0).max() > 1e-6:
            raise ValueError("correlation: expected a symmetric matrix with 1 on its diagonal")
        if np.linalg.eigvalsh(R).min() < -1e-6:
            raise ValueError(
                "correlation: expected a matrix without negative eigenvalues: these cannot go together"
            )
        if len(set(self.entries)) != n:
            raise ValueError("entries: one is named twice")
        return self


class Success(RangesPart):
    """Criterion of a successful episode: exactly one of the two."""

    held: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)
    """Time for which the task's tolerance was met without interruption at the end of the episode, at least
    [s]."""
    episode_return: float | None = Field(default=None, allow_inf_nan=False)
    """Return of the episode (sum of rewards), at least."""

    @model_validator(mode="after")
    def _single(self) -> "Success":
        if (self.held is None) == (self.episode_return is None):
            raise ValueError("expected either held [s] or episode_return")
        return self


class Curriculum(RangesPart):
    """Schedule by which all ranges grow together from a fraction of their width to the full width."""

    by: Literal["progress", "steps", "success"] = "progress"
    """Measure of progress: fraction of the training, the environment's own control steps, or the success rate."""
    start: float = Field(default=0.0, ge=0.0, le=1.0)
    """Fraction of the full width at the start; 0 is the vehicle of the file."""
    over: tuple[float, float] = (0.0, 1.0)
    """Start and end of the growth, as a fraction of the training or a number of control steps of all worlds."""
    success: Success | None = None
    """Criterion of success; the task's own hold time if None."""
    episodes: int = Field(default=400, ge=1)
    """Number of episodes after which the success rate is evaluated."""
    widen_at: float = Field(default=0.8, ge=0.0, le=1.0)
    """Success rate from which the ranges are widened [-]."""
    narrow_at: float = Field(default=0.4, ge=0.0, le=1.0)
    """Success rate below which the ranges are narrowed [-]."""
    step: float = Field(default=0.1, gt=0.0, le=1.0)
    """Change of the width in each step, as a fraction of the full width."""

    @model_validator(mode="after")
    def _possible(self) -> "Curriculum":
        if self.narrow_at > self.widen_at:
            raise ValueError(f"narrow_at is {self.narrow_at}, expected at most widen_at, {self.widen_at}")
        low, high = self.over
        if not 0.0 <= low < high < float("inf") or (self.by == "progress" and high > 1.0):
            limit = "1" if self.by == "progress" else "any number of steps"
            raise ValueError(
                f"over is {[low, high]}, expected [low, high] with 0 <= low < high up to {limit}"
            )
        return self

    def width(self, done: float) -> float:
        """Return the fraction of the full width at a stage of progress, in [0, 1]."""
        low, high = self.over
        part = min(max((done - low) / (high - low), 0.0), 1.0)
        return self.start + part * (1.0 - self.start)


class Ranges(RangesPart):
    """Distributions drawn for every episode: factors on the vehicle file's numbers, unless a unit is given."""

    name: str
    source: str = ""
    mass: Above0 = ONE
    volume: Annotated[Above0 | Literal["with_mass"], BeforeValidator(_factor_or_with_mass)] = ONE
    """A factor, or `with_mass`: the volume follows the mass, so that the trim is preserved."""
    buoyancy: Above0 = ONE
    """Factor on the displaced volume, on top of `volume`'s."""
    inertia: Above0 = ONE
    center_of_gravity: Annotated[Interval | Offsets, BeforeValidator(_either(Offsets))] = NONE
    """Offset along each axis [m]."""
    center_of_buoyancy: Annotated[Interval | Offsets, BeforeValidator(_either(Offsets))] = NONE
    """Offset along each axis [m]."""
    added_mass: AxisScales = AxisScales()
    linear_damping: AxisScales = AxisScales()
    quadratic_damping: AxisScales = AxisScales()
    terms: dict[str, Interval] = Field(default_factory=dict)
    """Distributions of the vehicle's terms and actuators by entry (see `term_entries`); a ranges file lists them under
    the name of the term or of the kind of actuator."""
    mesh_drag: Scale = ONE
    """Factor on form and skin drag of the mesh model."""
    thrust: ThrustScales = ThrustScales()
    time_constant: Annotated[Scale | EachScales, BeforeValidator(_either(EachScales))] = ONE
    added_time_constant: Time = NONE
    """[s]"""
    delay: Scale = ONE
    added_delay: Time = NONE
    """[s]"""
    command_jitter: Time = NONE
    """Longest additional delay of a command, drawn every control step [s]."""
    slew: Scale = ONE
    dead_zone: Scale = ONE
    added_dead_zone: Scale = NONE
    """Widening of the dead zone on either side [N]."""
    current: Annotated[Scale, AfterValidator(_swimmable)] = NONE
    """Horizontal speed [m/s], in a random direction."""
    vertical_current: Annotated[Interval, AfterValidator(_swimmable)] = NONE
    """Upward speed [m/s]."""
    current_drift: DriftRanges | None = None
    waves: Annotated[WaveRanges | SeaRanges | None, BeforeValidator(_waves_or_sea)] = None
    current_profile: ProfileRanges | None = None
    tether: TetherRanges | None = None
    sensors: SensorRanges | None = None
    correlated: tuple[Correlated, ...] = ()
    curriculum: Curriculum | None = None

    @property
    def most_waves(self) -> int:
        """Return the greatest number of waves that can be drawn for a world."""
        waves = self.waves
        return waves.components if isinstance(waves, SeaRanges) else 0 if waves is None else waves.count[1]

    @model_validator(mode="before")
    @classmethod
    def _terms_by_entry(cls, data: Any) -> Any:
        if not isinstance(data, Mapping):
            return data
        out, terms = dict(data), {}
        for entry, drawn in dict(out.pop("terms", {})).items():  # flat names, as in the record of a training
            name, _, parameter = entry.partition(".")
            out[name] = {**out.get(name, {}), parameter: drawn} if parameter else drawn
        for name in [name for name in out if name not in cls.model_fields]:
            family = TERMS if name in TERMS else ACTUATORS
            member = family.get(str(name))
            if member is not None:  # other names are refused as unknown entries
                terms |= _of_member(member, out.pop(name))
        return {**out, "terms": terms} if terms else out

    @model_validator(mode="after")
    def _consistent(self) -> "Ranges":
        from finssim.sim.ranges_table import check_correlated  # the table imports this module

        check_correlated(self)
        return self


def _of_member(member: Term | ActuatorKind, stated: Any) -> dict[str, Any]:
    """Return the distributions of a term or a kind of actuator by entry.

    Raises:
        ValueError: An entry does not exist or its range is invalid; the message is one sentence.
    """
    from finssim.sim.ranges_table import actuator_entries, term_entries  # the table imports this module

    found = term_entries(member) if isinstance(member, Term) else actuator_entries(member)
    entries = {entry.name: entry for entry in found}
    if member.name in entries:
        stated = {member.name: stated}
    elif isinstance(stated, Mapping):
        stated = {f"{member.name}.{key}": drawn for key, drawn in stated.items()}
    else:
        raise ValueError(f"{member.name}: is {stated!r}, expected ranges of {', '.join(entries)}")
    out = {}
    for name, drawn in stated.items():
        if name not in entries:
            raise ValueError(f"{member.name}: {unknown(name, entries)}")
        try:
            kind: Any = Scale if entries[name].unit == "1" else Interval
            out[name] = TypeAdapter(kind).validate_python(drawn)
        except ValidationError as error:
            raise ValueError(f"{name}: {error.errors()[0]['msg'].removeprefix('Value error, ')}") from None
    return out


def available() -> list[str]:
    """Return the names of the ranges that ship with FinsSim."""
    return sorted(path.stem for path in SHIPPED.glob("*.yaml"))


def load_ranges(name_or_path: str | Path) -> Ranges:
    """Read ranges by name or from a file.

    Args:
        name_or_path: One of `available()`, or a YAML file.

    Raises:
        RangesError: There is no such file, or a key or value in it is invalid; the message names file, key and value.
    """
    path = Path(name_or_path)
    if not path.is_file() and str(name_or_path) in available():
        path = SHIPPED / f"{name_or_path}.yaml"
    if not path.is_file():
        close = difflib.get_close_matches(str(name_or_path), available(), n=1)
        hint = f"; did you mean '{close[0]}'?" if close else ""
        raise RangesError(
            f"no ranges '{name_or_path}': give a YAML file or one of {', '.join(available())}{hint}"
        )
    data = read_mapping(path, RangesError, such_as="mass: [0.98, 1.02]")
    if not all(isinstance(key, str) for key in data):
        key = next(key for key in data if not isinstance(key, str))
        raise RangesError(f"{path}: {key}: expected the name of an entry, such as mass")
    try:
        return Ranges.model_validate({"name": path.stem, **data})
    except ValidationError as error:
        raise RangesError(f"{path}: {sentence(error, Ranges)}") from None
