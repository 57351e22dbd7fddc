"""The canonical columns of a trial: names, units, frames."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["COLUMNS", "INPUT_PREFIXES", "NU", "TAU", "Column", "column_of"]


class Column(NamedTuple):
    """One canonical column."""

    group: str
    """Columns of one group come from one sensor: command velocity rates acceleration attitude position depth."""
    unit: str
    meaning: str


TAU = ("tau_x", "tau_y", "tau_z", "tau_k", "tau_m", "tau_n")
"""Wrench, body frame; moments about the header's `wrench_at`."""

NU = ("u", "v", "w", "p", "q", "r")
"""nu, body frame."""

COLUMNS: dict[str, Column] = {
    **{name: Column("command", "N", f"force on the vehicle along body {name[-1]}") for name in TAU[:3]},
    **{
        name: Column("command", "N m", f"moment about body {axis}")
        for name, axis in zip(TAU[3:], "xyz", strict=True)
    },
    **{
        name: Column("velocity", "m/s", f"velocity along body {axis}")
        for name, axis in zip(NU[:3], "xyz", strict=True)
    },
    **{
        name: Column("rates", "rad/s", f"angular rate about body {axis}")
        for name, axis in zip(NU[3:], "xyz", strict=True)
    },
    **{f"a{axis}": Column("acceleration", "m/s²", f"acceleration along body {axis}") for axis in "xyz"},
    "roll": Column("attitude", "rad", "about body x, the last of yaw-pitch-roll (z-y-x)"),
    "pitch": Column("attitude", "rad", "about body y; positive is nose down, for z is up"),
    "yaw": Column("attitude", "rad", "about world z, to the left"),
    **{f"q{c}": Column("attitude", "-", "quaternion body to world, xyzw") for c in "xyzw"},
    **{axis: Column("position", "m", f"world {axis}; z up, 0 on the still surface") for axis in "xyz"},
    "depth": Column("depth", "m", "of the pressure sensor below the still surface, positive down"),
    "voltage": Column("command", "V", "battery"),
}
"""Columns with fixed names."""

INPUT_PREFIXES: dict[str, Column] = {
    "force_": Column("command", "N", "thrust of one thruster"),
    "rpm_": Column("command", "rpm", "shaft speed of one thruster, positive for positive thrust"),
    "pwm_": Column("command", "µs", "pulse width sent to the speed controller of one thruster"),
    "command_": Column("command", "N", "thrust asked of one thruster"),
}
"""Columns named PREFIX + thruster name."""


def column_of(name: str) -> Column | None:
    """The canonical column of that name, or None."""
    if name in COLUMNS:
        return COLUMNS[name]
    for prefix, column in INPUT_PREFIXES.items():
        if name.startswith(prefix) and len(name) > len(prefix):
            return column
    return None
