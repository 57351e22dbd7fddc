"""Moving water of a site: currents, profiles over depth and time, regular waves and sea states. Plain data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Discriminator, Tag, ValidationError

from finssim.core.text_table import read_text_table
from finssim.core.yaml_file import first_problem, read_mapping
from finssim.physics.water import WaterArrays, dispersion, wave_number
from finssim.sim.site import SurroundingsError, require

__all__ = ["CurrentProfile", "SeaState", "Water", "Wave", "load_water", "read_profile", "sea_bands"]

Array = NDArray[np.float64]

MOST_ROWS = 100_000
"""Greatest number of rows in a current table."""
FASTEST = 10.0
"""Greatest speed of a current [m/s]."""
DEEP = 1e6
"""Depth of deep water: no wave reaches its floor [m]."""
COLUMNS = {"depth": "depth", "time": "time", "t": "time", "east": "east", "north": "north", "up": "up"}
"""Column of a current table -> its meaning: depth [m], time [s], velocities [m/s]."""


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
        require(self.wavelength > 0.0, f"wave: wavelength is {self.wavelength}, expected a length above 0 m")
        require(
            0.0 <= self.amplitude < 0.07 * self.wavelength,
            f"wave: amplitude {self.amplitude} m is not small for a wavelength of {self.wavelength} m: "
            "a linear wave breaks above 0.07 wavelengths; give less",
        )


@dataclass(frozen=True, kw_only=True)
class CurrentProfile:
    """Current over depth and time, linearly interpolated and constant outside the table; uniform in the horizontal
    plane."""

    depths: tuple[float, ...] = (0.0,)
    """Depths, ascending [m]."""
    times: tuple[float, ...] = (0.0,)
    """Times since the start of an episode, ascending [s]."""
    velocities: tuple[tuple[tuple[float, float, float], ...], ...]
    """Current by time and depth, world frame: east (x), north (y), up (z) [m/s]."""

    def __post_init__(self) -> None:
        shape = (len(self.times), len(self.depths), 3)
        values = np.asarray(self.velocities, float)
        require(
            values.shape == shape and values.size > 0,
            f"current profile: {values.shape} velocities, expected {shape}: one for each time and depth",
        )
        for name, grid in (("depths", self.depths), ("times", self.times)):
            steps = np.diff(grid)
            require(
                bool(np.all(np.isfinite(grid)) and np.all(steps > 0.0)),
                f"current profile: {name} are {list(grid)[:8]}, expected ascending finite numbers",
            )
        require(
            bool(np.all(np.abs(values) <= FASTEST)),
            f"current profile: a velocity is beyond {FASTEST:g} m/s: are the velocities in m/s?",
        )


def read_profile(path: str | Path) -> CurrentProfile:
    """Read a current table: columns depth [m], time [s], east, north and up [m/s], in any order.

    The columns depth, time and up are optional; there is one row for each pair of a depth and a time.

    Raises:
        SurroundingsError: The table cannot be read, has an unknown column or a cell that is not a number, or has no row
            or two rows for a pair of a depth and a time.
    """
    table = read_text_table(path, SurroundingsError)
    names = [COLUMNS.get(name.strip().lower(), "") for name in table.names]
    for column, name in zip(table.names, names, strict=True):
        require(
            bool(name) and names.count(name) == 1,
            f"{path}: column '{column[:40]}' is unknown or there twice, expected depth, time, east, north, up",
        )
    for name in ("east", "north"):
        require(name in names, f"{path}: no column '{name}': expected depth, time, east, north [m, s, m/s]")
    require(0 < len(table.rows) <= MOST_ROWS, f"{path}: {len(table.rows)} rows, expected 1 to {MOST_ROWS}")
    found: dict[tuple[float, float], tuple[float, float, float]] = {}
    for line, cells in zip(table.lines, table.rows, strict=True):
        row = dict.fromkeys(("depth", "time", "east", "north", "up"), 0.0)
        for name, cell in zip(names, cells, strict=False):
            value = table.number(cell)
            require(
                value is not None and math.isfinite(value),
                f"{path}: line {line}: {name} is '{cell[:40]}', expected a finite number",
            )
            row[name] = float(value or 0.0)
        require(len(cells) >= len(names), f"{path}: line {line}: {len(cells)} cells, expected {len(names)}")
        key = row["time"], row["depth"]
        require(key not in found, f"{path}: line {line}: depth {key[1]:g} m at {key[0]:g} s is there twice")
        found[key] = row["east"], row["north"], row["up"]
    times, depths = (tuple(sorted({key[i] for key in found})) for i in range(2))
    for time in times:
        for depth in depths:
            require(
                (time, depth) in found,
                f"{path}: no row for depth {depth:g} m at {time:g} s, expected one for each depth at each time",
            )
    velocities = tuple(tuple(found[time, depth] for depth in depths) for time in times)
    return CurrentProfile(depths=depths, times=times, velocities=velocities)


@dataclass(frozen=True, kw_only=True)
class SeaState:
    """Waves of a spectrum, with directional spreading: components of equal energy, drawn once from a seed.

    S(w) = w^-5 exp(-5/4 (wp/w)^4) g^exp(-(w/wp - 1)^2 / (2 s^2)), s = 0.07 below wp and 0.09 above it, scaled to
    m0 = H^2 / 16 (Hasselmann et al., 1973); g = 1 gives the Pierson-Moskowitz spectrum. The spreading function is
    cos^(2n) of half the angle from the heading, with n = 2 / spread^2 - 1.
    """

    spectrum: Literal["jonswap", "pierson-moskowitz"]
    height: float
    """Significant wave height H [m]."""
    period: float
    """Period of the spectrum's peak [s]."""
    heading: float = 0.0
    """Mean direction of travel, from world x towards y [rad]."""
    spread: float = 0.0
    """Standard deviation of the directions [rad]."""
    peak: float = 3.3
    """Enhancement g of JONSWAP's peak [-]."""
    components: int = 24
    """Number of waves; each one slows down every step."""
    seed: int = 1
    """Seed of phases, and of the assignment of directions to frequencies."""

    def __post_init__(self) -> None:
        require(
            self.spectrum in ("jonswap", "pierson-moskowitz"),
            f"sea state: spectrum is '{self.spectrum}', expected jonswap or pierson-moskowitz",
        )
        numbers = (self.height, self.period, self.heading, self.spread, self.peak)
        require(all(math.isfinite(x) for x in numbers), "sea state: every number must be finite")
        require(self.height > 0.0, f"sea state: height is {self.height} m, expected above 0 m")
        require(self.period > 0.0, f"sea state: period is {self.period} s, expected above 0 s")
        require(1.0 <= self.peak <= 10.0, f"sea state: peak is {self.peak}, expected 1 to 10")
        require(
            0.0 <= self.spread < 1.4, f"sea state: spread is {self.spread} rad, expected 0 to below 1.4 rad"
        )
        require(1 <= self.components <= 200, f"sea state: {self.components} components, expected 1 to 200")

    def waves(self, depth: float, gravity: float = 9.81) -> tuple[Wave, ...]:
        """Return the waves in water of a depth [m] under a gravity [m/s²].

        Raises:
            SurroundingsError: A wave of this height would break.
        """
        rng = np.random.default_rng(self.seed)
        ratios, turns = sea_bands(self.spectrum, self.peak, self.spread, self.components)
        k = wave_number(ratios * 2.0 * math.pi / self.period, depth, gravity)
        amplitude = self.height * math.sqrt(1.0 / (8.0 * self.components))
        turns, phases = rng.permutation(turns), rng.uniform(0.0, 2.0 * math.pi, self.components)
        try:
            return tuple(
                Wave(
                    amplitude=amplitude,
                    wavelength=2.0 * math.pi / float(number),
                    heading=self.heading + float(turn),
                    phase=float(phase),
                )
                for number, turn, phase in zip(k, turns, phases, strict=True)
            )
        except SurroundingsError:
            raise SurroundingsError(
                f"sea state: a height of {self.height:g} m with a period of {self.period:g} s breaks in {depth:g} m of "
                "water: give a lower height, a longer period or more components"
            ) from None


def sea_bands(spectrum: str, peak: float, spread: float, components: int) -> tuple[Array, Array]:
    """Return relative frequencies of bands of equal energy, and their directions from the mean.

    Args:
        spectrum: Name of the spectrum.
        peak: Enhancement of the peak [-].
        spread: Standard deviation of the directions [rad].
        components: Number of bands n.

    Returns:
        Ratios of frequencies to that of the peak, ascending, and directions [rad], (n,) each: the median of each band.
    """
    x = np.linspace(0.4, 4.0, 4001)
    sigma = np.where(x <= 1.0, 0.07, 0.09)
    density = x**-5 * np.exp(-1.25 * x**-4)
    if spectrum == "jonswap":
        density = density * peak ** np.exp(-((x - 1.0) ** 2) / (2.0 * sigma**2))
    middle = (np.arange(components) + 0.5) / components
    energy = np.cumsum(density)
    ratios = np.interp(middle, energy / energy[-1], x)
    if spread == 0.0:
        return ratios, np.zeros(components)
    angle = np.linspace(-math.pi, math.pi, 4001)
    share = np.cumsum(np.cos(angle / 2.0) ** (2.0 * (2.0 / spread**2 - 1.0)))
    return ratios, np.interp(middle, share / share[-1], angle)


def _kind(value: Any) -> str:
    if isinstance(value, (dict, SeaState, CurrentProfile)):
        return "(one)"
    return "(file)" if isinstance(value, (str, Path)) else "(list)"


Waves = Annotated[
    Annotated[Sequence[Wave], Tag("(list)")] | Annotated[SeaState, Tag("(one)")], Discriminator(_kind)
]
"""A sequence of waves, or a sea state."""
Current = Annotated[
    Annotated[tuple[float, float, float], Tag("(list)")]
    | Annotated[CurrentProfile, Tag("(one)")]
    | Annotated[Path, Tag("(file)")],
    Discriminator(_kind),
]
"""Velocity [m/s], its profile over depth and time, or the path of a current table."""


@dataclass(frozen=True, kw_only=True)
class Water:
    """Moving water, the same in every world until it is randomised."""

    current: Current = (0.0, 0.0, 0.0)
    """Velocity at the still surface, world frame [m/s]; or a profile over depth and time, or the path of a current
    table, which becomes `profile`."""
    shear: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Change of the current with height, d(current)/dz [1/s]."""
    drift_std: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Standard deviation of the slowly drifting component [m/s]."""
    drift_time: float = 15.0
    """Correlation time of the drifting component [s]."""
    waves: Waves = ()
    """Waves, as a sequence or of a spectrum."""
    depth: float | None = None
    """Still water depth, for the waves [m]; if None that of the pool, or deep water without a pool."""
    profile: CurrentProfile | None = None
    """Current over depth and time, which is added to `current`."""

    def __post_init__(self) -> None:
        given = self.current
        if isinstance(given, (str, Path, CurrentProfile)):
            require(
                self.profile is None, "water: current and profile both give a profile, expected one of them"
            )
            profile = given if isinstance(given, CurrentProfile) else read_profile(given)
            object.__setattr__(self, "profile", profile)
            object.__setattr__(self, "current", (0.0, 0.0, 0.0))
        numbers = (*self.uniform, *self.shear, *self.drift_std, self.drift_time, self.still_depth)
        require(all(math.isfinite(x) for x in numbers), "water: every number must be finite")
        require(self.still_depth > 0.0, f"water: depth is {self.depth}, expected more than 0 m")
        require(min(self.drift_std) >= 0.0, "water: drift_std is a standard deviation, expected 0 or more")
        _ = self.components  # raises an error for a sea that breaks

    @property
    def uniform(self) -> tuple[float, float, float]:
        """Current at the still surface without the profile, world frame [m/s]."""
        assert isinstance(self.current, tuple)
        return self.current

    @property
    def still_depth(self) -> float:
        """Still water depth [m]; a large finite value for deep water."""
        return DEEP if self.depth is None else self.depth

    @property
    def components(self) -> tuple[Wave, ...]:
        """Individual waves."""
        return self.waves.waves(self.still_depth) if isinstance(self.waves, SeaState) else tuple(self.waves)

    @property
    def drifting(self) -> bool:
        """True if the current has a random component that must be advanced in every step."""
        return any(x > 0.0 for x in self.drift_std) and self.drift_time > 0.0

    @property
    def moving(self) -> bool:
        """True if there are currents or waves."""
        return (
            self.drifting or bool(self.waves) or self.profile is not None or any((*self.uniform, *self.shear))
        )

    def arrays(
        self, worlds: int, density: float, gravity: float, device: wp.Device, max_waves: int = 0
    ) -> WaterArrays:
        """Return the water as Warp arrays, equal in every world, with room for `max_waves` more waves.

        Args:
            worlds: Number of worlds.
            density: Density of the water [kg/m³].
            gravity: [m/s²].
            device: Warp device of the arrays.
            max_waves: Number of additional waves.
        """

        def full(value: object, dtype: object) -> wp.array:
            return wp.full(worlds, value=value, dtype=dtype, device=device)

        waves = self.components
        n = len(waves) + max_waves
        k = np.array([2.0 * math.pi / w.wavelength for w in waves])
        columns = {
            "wave_amplitude": [w.amplitude for w in waves],
            "wave_number": k,
            "wave_frequency": dispersion(k, self.still_depth, gravity),
            "wave_heading": [w.heading for w in waves],
            "wave_phase": [w.phase for w in waves],
        }
        out = WaterArrays()
        out.density, out.gravity, out.depth = density, gravity, self.still_depth
        out.n_waves, out.moving = n, int(self.moving or max_waves > 0)
        out.current = full(wp.vec3(*self.uniform), wp.vec3)
        out.shear = full(wp.vec3(*self.shear), wp.vec3)
        out.drift = wp.zeros(worlds, dtype=wp.vec3, device=device)
        out.drift_rate = wp.zeros(worlds, dtype=wp.vec3, device=device)
        out.drift_std = full(wp.vec3(*self.drift_std), wp.vec3)
        out.drift_time = full(self.drift_time if self.drifting else 0.0, float)
        p = self.profile
        depths, times, flow = ((), (), ()) if p is None else (p.depths, p.times, p.velocities)
        table = np.asarray(flow, np.float32).reshape(len(times), len(depths), 3)
        out.profile_depth = wp.array(depths, dtype=float, device=device)
        out.profile_time = wp.array(times, dtype=float, device=device)
        out.profile = wp.array(table, dtype=wp.vec3, device=device)
        out.profile_turn = full(wp.vec2(1.0, 0.0), wp.vec2)
        for name, values in columns.items():
            # An unused component has amplitude 0; its wave number 1 keeps 1/(1 - exp(-2kh)) finite.
            table = np.full((worlds, max(n, 1)), 1.0 if name == "wave_number" else 0.0, dtype=np.float32)
            table[:, : len(waves)] = values
            setattr(out, name, wp.array(table, dtype=float, device=device))
        return out


class WaterFile(BaseModel):
    """Content of a water file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    water: Water


def load_water(path: str | Path) -> Water:
    """Read a water file: the fields of `Water`; a current table is looked up in the folder of the file.

    Raises:
        SurroundingsError: The file cannot be read, or has an unknown key or an invalid value.
    """
    path = Path(path)
    tree = read_mapping(path, SurroundingsError, such_as="current: profile.csv")
    try:
        return WaterFile.model_validate({"water": beside(tree, path.parent)}).water
    except ValidationError as error:
        raise SurroundingsError(f"{path}: {first_problem(error, WaterFile).removeprefix('water.')}") from None


def beside(water: Any, folder: Path) -> Any:
    """Return a water section with the path of its current table resolved in a folder."""
    if isinstance(water, dict) and isinstance(water.get("current"), str):
        return {**water, "current": folder / water["current"]}
    return water
