"""Table of all parameters that can be randomised, and the distributions that a ranges file states for them."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from finssim.physics.types import MAX_THRUSTERS
from finssim.sim.distributions import Distribution, Drawn, distribution_of, unknown
from finssim.sim.measured import SENSORS
from finssim.sim.ranges_file import AXES, MAX_WAVES, EachScales, Offsets, Ranges, SeaRanges
from finssim.vehicles.actuators import ActuatorKind
from finssim.vehicles.terms import Term

TURN = Distribution(uniform=(0.0, 6.2831853))
ALWAYS_FIRST = 0.999
"""Offset below the next whole number, so that rounding a uniform number down gives equal probabilities."""
TETHER = ("diameter", "drag_coefficient", "wet_weight")


@dataclass(frozen=True)
class DrawnNumber:
    """One number that is drawn in every episode."""

    name: str
    """Name as in a ranges file, with dots; `thrust.each.2` is that of the third thruster."""
    unit: str = "1"
    """Unit; `1` is a factor on the vehicle file's number."""
    nominal: float = 1.0
    """Value if no distribution is given, in the unit of the entry."""
    world: bool = False
    """True if the number is drawn once per world and not for each vehicle."""
    angle: bool = False
    """True for a direction or phase, which is always drawn from the full circle."""
    privileged: bool = True
    """True if the number is a privileged observation where it varies."""
    stream: int = -1
    """Stream of its random numbers, independent of other entries."""


def _table() -> Iterator[DrawnNumber]:
    yield from (DrawnNumber("mass"), DrawnNumber("volume"), DrawnNumber("inertia"))
    for center in ("center_of_gravity", "center_of_buoyancy"):
        yield from (DrawnNumber(f"{center}.{axis}", "m", 0.0) for axis in "xyz")
    for family in ("added_mass", "linear_damping", "quadratic_damping"):
        yield from (DrawnNumber(f"{family}.{axis}") for axis in ("all", *AXES))
    yield from (DrawnNumber("buoyancy"), DrawnNumber("mesh_drag"), DrawnNumber("thrust.all"))
    for kind in ("thrust.each", "thrust.failure"):
        yield from (DrawnNumber(f"{kind}.{k}") for k in range(MAX_THRUSTERS))
    yield DrawnNumber("time_constant.all")
    yield from (DrawnNumber(f"time_constant.each.{k}") for k in range(MAX_THRUSTERS))
    yield from (
        DrawnNumber("added_time_constant", "s", 0.0),
        DrawnNumber("delay"),
        DrawnNumber("added_delay", "s", 0.0),
    )
    yield from (DrawnNumber("command_jitter", "s", 0.0), DrawnNumber("slew"), DrawnNumber("dead_zone"))
    yield DrawnNumber("added_dead_zone", "N", 0.0)
    for name, unit in zip(TETHER, ("m", "1", "N/m"), strict=True):
        yield DrawnNumber(f"tether.{name}", unit, 0.0)
    for name in SENSORS:
        yield DrawnNumber(f"sensors.{name}", _sensor_unit(name), 0.0)
    yield from (
        DrawnNumber("current", "m/s", 0.0, world=True, privileged=False),
        DrawnNumber("vertical_current", "m/s", 0.0, world=True),
    )
    yield DrawnNumber("current.direction", "rad", 0.0, world=True, angle=True, privileged=False)
    yield from (
        DrawnNumber(f"current.{axis}", "m/s", 0.0, world=True) for axis in "xy"
    )  # from speed and direction
    yield DrawnNumber("current_drift.deviation", "m/s", 0.0, world=True)
    yield DrawnNumber("current_drift.time", "s", 0.0, world=True)
    yield DrawnNumber("waves.count", "1", 0.0, world=True, privileged=False)
    for i in range(MAX_WAVES):
        yield DrawnNumber(f"waves.{i}.amplitude", "m", 0.0, world=True)
        yield DrawnNumber(f"waves.{i}.wavelength", "m", 1.0, world=True)
        for name in ("heading", "phase"):
            yield DrawnNumber(f"waves.{i}.{name}", "rad", 0.0, world=True, angle=True, privileged=False)
    yield DrawnNumber("sea.height", "m", 0.0, world=True)
    yield DrawnNumber("sea.period", "s", 1.0, world=True)
    yield DrawnNumber("sea.heading", "rad", 0.0, world=True, angle=True, privileged=False)
    yield DrawnNumber("current_profile.scale", world=True)
    yield DrawnNumber("current_profile.turn", "rad", 0.0, world=True)


def _sensor_unit(name: str) -> str:
    quantity = name.split("_")[0]
    return {"position": "m", "yaw": "rad", "velocity": "m/s", "rate": "rad/s", "delay": "s"}.get(
        quantity, "1"
    )


ENTRIES = [replace(entry, stream=i) for i, entry in enumerate(_table())]
"""All entries; entries of a vehicle's terms are added when ranges first name the term."""
INDEX = {entry.name: i for i, entry in enumerate(ENTRIES)}
WORLD = next(i for i, entry in enumerate(ENTRIES) if entry.world)
"""Index of the first entry of the world; those of the world end before `WORLD_END`."""
WORLD_END = len(ENTRIES)


def term_entries(term: Term) -> list[DrawnNumber]:
    """Return the entries of a term: `lift.coefficient`, a factor on a parameter, and `lift.added_coefficient`, an
    offset.

    Only scalar parameters in a section of their own have an offset.
    """
    scalars, out = term.scalars(), []
    for name, path in term.parameters.items():
        out.append(DrawnNumber(path))
        if path in scalars and path != term.name:
            out.append(DrawnNumber(added_entry(path), term.units[name], 0.0))
    return _registered(out)


def _registered(entries: list[DrawnNumber]) -> list[DrawnNumber]:
    """Add missing entries to the table; their random streams follow from their names."""
    for entry in entries:
        if entry.name not in INDEX:
            INDEX[entry.name] = len(ENTRIES)
            ENTRIES.append(replace(entry, stream=(1 << 20) + zlib.crc32(entry.name.encode()) % (1 << 28)))
    return entries


def actuator_entries(kind: ActuatorKind) -> list[DrawnNumber]:
    """Return the entries of a kind of actuator: `fin.lift_slope`, a factor on that parameter of all actuators
    of the kind."""
    return _registered([DrawnNumber(f"{kind.name}.{name}") for name in kind.scalars])


def added_entry(path: str) -> str:
    """Return the name of the entry that is added to the parameter at a path."""
    term, _, name = path.rpartition(".")
    return f"{term}.added_{name}"


def varies(distribution: Distribution, nominal: float) -> bool:
    """Return whether a distribution has values other than the nominal one, both in one unit."""
    return distribution.probability > 0.0 and distribution.bounds() != (nominal, nominal)


def drawn_entries(ranges: Ranges, thrusters: int = MAX_THRUSTERS) -> dict[str, Distribution]:
    """Return the entries that a ranges file draws, with their distributions, in the order of the table.

    Args:
        ranges: The ranges.
        thrusters: Number of thrusters of the vehicle with the most; entries of further thrusters are omitted.
    """
    distributions = {
        name: distribution_of(drawn)
        for name, drawn in _stated_entries(ranges, thrusters)
        if drawn is not None
    }
    return {
        e.name: distributions[e.name]
        for e in ENTRIES
        if e.name in distributions
        and (varies(distributions[e.name], e.nominal) or e.name.startswith(("tether.", "sensors.")))
    }


def _stated_entries(ranges: Ranges, thrusters: int) -> Iterator[tuple[str, Drawn | None]]:
    yield from ranges.terms.items()
    for name in ("mass", "buoyancy", "inertia", "mesh_drag", "added_time_constant", "delay", "added_delay",
                 "command_jitter", "slew", "dead_zone", "added_dead_zone", "current", "vertical_current"):  # fmt: skip
        yield name, getattr(ranges, name)
    yield "volume", None if ranges.volume == "with_mass" else ranges.volume
    for name in ("center_of_gravity", "center_of_buoyancy"):
        offset = getattr(ranges, name)
        for axis in "xyz":
            yield f"{name}.{axis}", getattr(offset, axis) if isinstance(offset, Offsets) else offset
    for name in ("added_mass", "linear_damping", "quadratic_damping"):
        scales = getattr(ranges, name)
        yield f"{name}.all", scales.all
        yield from ((f"{name}.{axis}", drawn) for axis, drawn in scales.axes.items())
    lag = ranges.time_constant
    both = lag if isinstance(lag, EachScales) else EachScales(all=lag)
    for name, scales in (("thrust", ranges.thrust), ("time_constant", both)):
        yield f"{name}.all", scales.all
        yield from ((f"{name}.each.{k}", scales.each) for k in range(thrusters))
    yield from ((f"thrust.failure.{k}", ranges.thrust.failure) for k in range(thrusters))
    for part, names in (
        ("tether", TETHER),
        ("sensors", SENSORS),
        ("current_drift", ("deviation", "time")),
        ("current_profile", ("scale", "turn")),
    ):
        inner = getattr(ranges, part)
        if inner is not None:
            yield from ((f"{part}.{name}", getattr(inner, name)) for name in names)
    yield from _directions(ranges)


def _directions(ranges: Ranges) -> Iterator[tuple[str, Drawn]]:
    if distribution_of(ranges.current).bounds()[1] > 0.0:
        yield "current.direction", TURN
    if isinstance(ranges.waves, SeaRanges):
        yield from (
            ("sea.height", ranges.waves.height),
            ("sea.period", ranges.waves.period),
            ("sea.heading", TURN),
        )
        yield from ((f"waves.{i}.phase", TURN) for i in range(ranges.waves.components))
        return
    if ranges.waves is None or ranges.waves.count[1] == 0:
        return
    low, high = ranges.waves.count
    yield "waves.count", (float(low), high + ALWAYS_FIRST)
    for i in range(high):
        yield f"waves.{i}.amplitude", ranges.waves.amplitude
        yield f"waves.{i}.wavelength", ranges.waves.wavelength
        yield from ((f"waves.{i}.{name}", TURN) for name in ("heading", "phase"))


def check_correlated(ranges: Ranges) -> None:
    """Refuse correlated entries that are not drawn, are in two groups, or mix entries of worlds and of vehicles.

    Raises:
        ValueError: The correlations are invalid; the message is one sentence.
    """
    drawn: Mapping[str, Distribution] = drawn_entries(ranges)
    tied: set[str] = set()
    for group in ranges.correlated:
        for name in group.entries:
            if name not in INDEX:
                raise ValueError(f"correlated: {unknown(name, INDEX)}")
            if name not in drawn:
                raise ValueError(f"correlated: '{name}' is not drawn: give it a range")
            if name in tied:
                raise ValueError(f"correlated: '{name}' is in two groups: put them together")
            tied.add(name)
        if len({ENTRIES[INDEX[name]].world for name in group.entries}) > 1:
            raise ValueError(
                f"correlated: {', '.join(group.entries)}: some are drawn for a world and some for each vehicle in it, "
                "and cannot go together"
            )
