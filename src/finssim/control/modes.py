"""Action modes: the meaning of a policy's outputs in [-1, 1]; limits and scale are part of the definition.

A mode maps the components of an action to fractions of the vehicle's wrench limits, which are allocated to the
thrusters, to fractions of the thrusters' own limits, or to the axes of an autopilot, whose mixer drives the
thrusters. The batch does this for all worlds and the robot for one vehicle, with the same function (`thrusts_of`) and
the same numbers (`mode_data`). `surfaces` commands every channel, including fins and other actuators; `course` and
`course_pitch` are references for the autopilot of `finssim.control.course`, which requires the vehicle's state.
"""
# mypy: disable-error-code="no-untyped-def,no-untyped-call,no-any-return,valid-type,misc,untyped-decorator"

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

from finssim.control import ControlError
from finssim.control.allocation import AllocationData, RowLaunch, allocate, allocation_data, axis_weights
from finssim.control.ardusub import FROM_BODY, MixerData, dead_band, mixed_thrusts, mixer_data, thrust_tables
from finssim.control.course import FARTHEST, STEEPEST, WIDEST, course_speeds
from finssim.control.policy import first_difference, plain_data
from finssim.physics.types import MAX_THRUSTERS, vec6, vec8

Array = npt.NDArray[np.float64]

AXES = ("surge", "sway", "heave", "roll", "pitch", "yaw")


QUIET = 0.01
"""Value up to which an axis of `pilot6` turns no motor [-]."""
TOLERANCE = 1e-6
"""Relative difference between computed limits and those of a policy's directory that is ignored."""


class ModeKind(NamedTuple):
    """Definition of an action mode, for any vehicle."""

    wrench: bool
    """True if the components are combined to a wrench, which is allocated to the thrusters; False if they
    command the thrusters directly."""
    labels: Callable[[Any], tuple[str, ...]]
    """Names of the components of an action for a vehicle, m of them."""
    mix: Callable[[Any], Array]
    """Function that returns the effect of each component at 1: fractions of the wrench limits (m, 6), of the
    limits of n thrusters (m, n), or of the autopilot's demands (m, 6)."""
    pilot: bool = False
    """True if the components are the axes of the vehicle's autopilot."""
    channels: bool = False
    """True if the components command all channels: thrusters, then the other actuators."""
    course: Literal["", "depth", "pitch"] = ""
    """Third component, depth or pitch, of actions that are references for the autopilot of
    `finssim.control.course`; empty for other actions."""


def _axes(*axes: int) -> ModeKind:
    """Return a mode whose components command axes of the wrench; the others are requested to be zero."""
    labels = tuple(AXES[axis] for axis in axes)
    return ModeKind(True, lambda vehicle: labels, lambda vehicle: np.eye(6)[list(axes)])


def _gain(vehicle: Any) -> float:
    autopilot = getattr(vehicle, "autopilot", None)
    return 1.0 if autopilot is None else float(autopilot.gain)


MODES: dict[str, ModeKind] = {
    "thruster8": ModeKind(
        False,
        lambda vehicle: tuple(vehicle.thruster_names),
        lambda vehicle: np.eye(len(vehicle.thruster_names)),
    ),
    "wrench6": _axes(0, 1, 2, 3, 4, 5),
    "wrench4": _axes(0, 1, 2, 5),
    "surfaces": ModeKind(
        False,
        lambda vehicle: tuple(vehicle.channel_names),
        lambda vehicle: np.eye(len(vehicle.channel_names)),
        channels=True,
    ),
    "course": ModeKind(
        False, lambda vehicle: ("speed", "course", "depth"), lambda vehicle: np.eye(3), course="depth"
    ),
    "course_pitch": ModeKind(
        False, lambda vehicle: ("speed", "course", "pitch"), lambda vehicle: np.eye(3), course="pitch"
    ),
    "pilot6": ModeKind(False, lambda vehicle: AXES, lambda vehicle: FROM_BODY.T * _gain(vehicle), pilot=True),
}
"""Action modes by name; a new mode is one entry."""


@wp.struct
class ModeData:
    """Numbers of each vehicle for `thrusts_of`, built by `mode_data`, with the vehicle as first index."""

    columns: wp.array2d(dtype=vec8)
    """Effect of each component at 1: a wrench [N, N m] or demands [-] and two zeros, or fractions of the
    thrusters' limits, (vehicles, m)."""
    lower: wp.array(dtype=vec8)
    """Least thrust [N], (vehicles,)."""
    upper: wp.array(dtype=vec8)
    """Greatest thrust [N], (vehicles,)."""
    wrench: wp.bool
    """True if the columns are wrenches."""
    allocation: AllocationData
    """Allocation of wrenches to the thrusters; empty if the columns are not wrenches."""
    pilot: wp.bool
    """True if the columns are demands."""
    dead_band: wp.array(dtype=vec8)
    """Fraction of each axis up to which no motor turns [-], (vehicles,); for demands."""
    mixer: MixerData
    """Mixer of demands to the thrusters; empty if the columns are not demands."""


@wp.func
def past_dead_band(part: float, dead_band: float) -> float:
    """Return an axis of an action beyond ± `QUIET`, shifted by the fraction at which no motor turns.

    Args:
        part: Value in [-1, 1].
        dead_band: Value up to which no motor turns [-], from `axis_dead_band`.
    """
    size = wp.abs(part)
    if size <= wp.static(QUIET):
        return part * dead_band / wp.static(QUIET)
    rest = (size - wp.static(QUIET)) / wp.static(1.0 - QUIET)
    return wp.sign(part) * (dead_band + (1.0 - dead_band) * rest)


@wp.func
def thrusts_of_shares(shares: vec8, lower: vec8, upper: vec8) -> vec8:
    """Return thrusts [N] from fractions [-1, 1] of the least and greatest thrusts [N]; larger fractions saturate."""
    f = vec8()
    for k in range(MAX_THRUSTERS):
        share = wp.clamp(shares[k], -1.0, 1.0)
        f[k] = wp.where(share >= 0.0, share * upper[k], -share * lower[k])
    return f


@wp.func
def thrusts_of(action: vec8, vehicle: int, data: ModeData) -> vec8:
    """Return the thrusts for an action, canonical order [N].

    Args:
        action: Components [-1, 1]; larger values saturate.
        vehicle: First index into `data`.
        data: Numbers from `mode_data`.
    """
    x = vec8()
    for k in range(data.columns.shape[1]):
        part = wp.clamp(action[k], -1.0, 1.0)
        if data.pilot:
            part = past_dead_band(part, data.dead_band[vehicle][k])
        x += part * data.columns[vehicle, k]
    if data.wrench:
        return allocate(vec6(x[0], x[1], x[2], x[3], x[4], x[5]), vehicle, data.allocation)
    if data.pilot:
        return mixed_thrusts(vec6(x[0], x[1], x[2], x[3], x[4], x[5]), vehicle, data.mixer)
    return thrusts_of_shares(x, data.lower[vehicle], data.upper[vehicle])


@wp.kernel(enable_backward=False)
def thrusts_row(action: wp.array(dtype=vec8), data: ModeData, force: wp.array(dtype=vec8)):
    """Run `thrusts_of` for the first vehicle.

    Args:
        action: Actions, (N,).
        data: Numbers from `mode_data`.
        force: Resulting thrusts, along the thrusters' axes, canonical order [N], (N,).
    """
    i = wp.tid()
    force[i] = thrusts_of(action[i], 0, data)


def mode_data(name: str, vehicles: Sequence[Any], scales: Sequence[Any], device: Any = "cpu") -> ModeData:
    """Return the numbers of a mode for `thrusts_of`.

    Args:
        name: Name of the mode.
        vehicles: Vehicles, with equal numbers of thrusters if components command thrusters.
        scales: Fraction of each limit at an action of 1, by vehicle, one number or one for each.
        device: Warp device.
    """
    kind, data = MODES[name], ModeData()
    limits = [_limits(kind, vehicle) for vehicle in vehicles]
    columns = [_columns(kind, *arguments) for arguments in zip(vehicles, scales, strict=True)]
    data.columns = wp.array(_padded(columns), dtype=vec8, device=device)
    data.lower = wp.array(_padded([lower for lower, _ in limits]), dtype=vec8, device=device)
    data.upper = wp.array(_padded([upper for _, upper in limits]), dtype=vec8, device=device)
    data.wrench, data.pilot = wp.bool(kind.wrench), wp.bool(kind.pilot)
    if kind.pilot:
        data.mixer = mixer_data(vehicles, device)
        bands = [axis_dead_band(vehicle, scale) for vehicle, scale in zip(vehicles, scales, strict=True)]
        data.dead_band = wp.array(_padded(bands), dtype=vec8, device=device)
    if kind.wrench:
        data.allocation = allocation_data(
            [vehicle.control_matrix for vehicle in vehicles],
            [lower for lower, _ in limits],
            [upper for _, upper in limits],
            [axis_weights(vehicle.wrench_limits) for vehicle in vehicles],
            device=device,
        )
    return data


def axis_dead_band(vehicle: Any, scale: Any = 1.0) -> Array:
    """Return the fraction of each axis of `pilot6` up to which no motor turns, at the autopilot's gain and
    voltage [-], (6,).

    Args:
        vehicle: Vehicle with an `autopilot` section.
        scale: Fraction of each axis that action 1 represents [-], one number or (6,); an axis at 0 turns no motor.

    Raises:
        ControlError: No motor turns even at action 1 of an axis.
    """
    band, gain = dead_band(vehicle), _gain(vehicle)
    if band >= gain:
        raise ControlError(
            f"{vehicle.name}: no motor turns up to {band:.3f} of full output, and autopilot.gain is {gain:g}: raise it"
        )
    full = np.broadcast_to(gain * np.asarray(scale, float), (6,))
    return np.minimum(np.divide(band, full, out=np.ones(6), where=full > 0.0), 1.0)


def before_dead_band(part: npt.ArrayLike, dead_band: npt.ArrayLike) -> Array:
    """Return the axes of an action that `past_dead_band` maps to `part`.

    Args:
        part: Values in [-1, 1], (..., 6).
        dead_band: Values from `axis_dead_band`, as a fraction of each axis' limit, (6,).
    """
    band, size = np.broadcast_to(dead_band, np.shape(part)), np.abs(part)
    rest = np.divide(size - band, 1.0 - band, out=np.ones_like(size), where=band < 1.0)
    return np.sign(part) * np.where(size <= band, size * QUIET / band, QUIET + (1.0 - QUIET) * rest)


def _limits(kind: ModeKind, vehicle: Any) -> tuple[Array, Array]:
    """Return the least and greatest thrusts [N], or values of all channels in their units."""
    lower, upper = vehicle.channel_limits if kind.channels else vehicle.force_limits
    return np.asarray(lower, float), np.asarray(upper, float)


def _columns(kind: ModeKind, vehicle: Any, scale: Any) -> Array:
    """Return the effect of each component at 1: a wrench [N, N m] or demands [-], (m, 6), or fractions of the
    thrusters' limits, (m, n)."""
    if kind.pilot:
        return np.asarray(kind.mix(vehicle) * np.reshape(scale, (-1, 1)))
    full = np.asarray(scale, float) * (np.asarray(vehicle.wrench_limits, float) if kind.wrench else 1.0)
    return np.asarray(kind.mix(vehicle) * full)


def _padded(rows: Sequence[npt.ArrayLike]) -> npt.NDArray[np.float32]:
    """Return rows padded with zeros for missing thrusters, (..., 8)."""
    arrays = [np.asarray(row, np.float32) for row in rows]
    return np.stack([np.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, MAX_THRUSTERS - a.shape[-1])]) for a in arrays])


@dataclass(frozen=True, kw_only=True)
class ActionMode:
    """Action mode for one vehicle.

    Note:
        It runs on the CPU and reuses its launch buffers, so each instance must be used by one thread only.
    """

    name: str
    labels: tuple[str, ...]
    """Names of the components."""
    definition: dict[str, tuple[float, ...]]
    """Limits and scale, as in `describe`: `scale`, with the `limits` of the wrench at action 1 and scale 1
    about `reference` [N, N m, m], or with `lower` and `upper` of the thrusters [N], of all channels in their
    units, or of speed [m/s], course [rad] and depth [m] or pitch [rad]; and for an autopilot its `factors`,
    row by row, `gain` and `dead_band` by axis [-]."""
    columns: Array = field(repr=False, compare=False)
    """Effect of each component at 1: a wrench about `reference` [N, N m] or demands of the autopilot [-], (m,
    6), or fractions of the thrusters' limits, (m, n)."""
    thrusters: int
    """Number of the vehicle's thrusters n, or of its channels if the mode commands them."""
    launch: RowLaunch | None = field(repr=False, compare=False)
    """Launch of `thrusts_of` from actions to thrusts; None if it requires the vehicle's state."""

    @property
    def size(self) -> int:
        """Number of components of an action, m."""
        return len(self.labels)

    @property
    def scale(self) -> tuple[float, ...]:
        """Fraction of the limits that action 1 represents."""
        return self.definition["scale"]

    @property
    def wrench(self) -> bool:
        """True if the components are combined to a wrench."""
        return MODES[self.name].wrench

    @property
    def pilot(self) -> bool:
        """True if the components are the axes of the vehicle's autopilot."""
        return MODES[self.name].pilot

    @property
    def ends(self) -> tuple[Array, Array]:
        """Effect of each component at -1 and at 1, (m,): on its axis [N, N m], of its thruster [N], or of full output
        [-]."""
        if self.pilot:
            return -np.abs(self.columns).sum(axis=1), np.abs(self.columns).sum(axis=1)
        if self.wrench:
            return -self.columns.sum(axis=1), self.columns.sum(axis=1)
        return self.columns @ self.definition["lower"], self.columns @ self.definition["upper"]

    def to_thrusters(self, action: npt.ArrayLike) -> Array:
        """Return thrusts in canonical order [N], (..., n), for actions (..., m); components beyond ±1 saturate.

        In mode `surfaces` the result contains all channels, in their units.

        Raises:
            ControlError: The action has another length, or contains NaN; or the mode requires the vehicle's state.
        """
        if self.launch is None:
            raise ControlError(
                f"{self.name} is carried out by an autopilot that needs the vehicle's state: use "
                "finssim.control.course.CoursePilot"
            )
        a = np.asarray(action, float)
        if a.shape[-1:] != (self.size,):
            raise ControlError(f"{self.name} action has shape {a.shape}, expected (..., {self.size})")
        if np.isnan(a).any():
            raise ControlError(f"{self.name} action contains NaN: the policy or its observation is broken")
        return self.launch(a)[..., : self.thrusters]

    def describe(self) -> dict[str, Any]:
        """Return everything that defines the mode, as plain data."""
        numbers = {name: list(values) for name, values in self.definition.items()}
        return {"mode": self.name, "size": self.size, "labels": list(self.labels), **numbers}


def action_mode(name: str, vehicle: Any, scale: float | Sequence[float] = 1.0) -> ActionMode:
    """Return the mode of a name for a vehicle.

    Args:
        name: Key of `MODES`.
        vehicle: Vehicle with its limits, thrusters and control matrix.
        scale: Fraction of each limit that action 1 represents [-], one number or one for each axis or thruster.

    Raises:
        ControlError: There is no such mode, or the scale is invalid.
    """
    if name not in MODES:
        raise ControlError(f"unknown action mode '{name}'; available: {', '.join(MODES)}")
    kind = MODES[name]
    size = np.shape(kind.mix(vehicle))[1]
    try:
        parts = np.broadcast_to(np.asarray(scale, float), (size,))
    except ValueError:
        raise ControlError(
            f"{name} scale has shape {np.shape(scale)}, expected one number or {size}"
        ) from None
    if not ((parts >= 0.0) & (parts <= 1.0)).all():
        raise ControlError(f"{name} scale is {tuple(parts.tolist())}, expected numbers in 0 to 1")
    if kind.wrench:
        numbers = {"limits": vehicle.wrench_limits, "scale": parts, "reference": vehicle.wrench_reference}
    elif kind.pilot:
        tables = thrust_tables(vehicle)
        numbers = {
            "lower": tables.min(axis=1),
            "upper": tables.max(axis=1),
            "scale": parts,
            "factors": (vehicle.autopilot.factors * vehicle.autopilot.signs(len(tables))[:, None]).ravel(),
            "gain": [vehicle.autopilot.gain],
            "dead_band": axis_dead_band(vehicle, parts),
        }
    elif kind.course:
        speeds, dive = course_speeds(vehicle), FARTHEST if kind.course == "depth" else STEEPEST
        ends = [speeds[0], -WIDEST, -dive], [speeds[-1], WIDEST, dive]
        numbers = {"lower": ends[0], "upper": ends[1], "scale": parts}
    else:
        lower, upper = _limits(kind, vehicle)
        numbers = {"lower": lower, "upper": upper, "scale": parts}
    return ActionMode(
        name=name,
        labels=kind.labels(vehicle),
        definition={key: tuple(map(float, values)) for key, values in numbers.items()},
        columns=_columns(kind, vehicle, parts),
        thrusters=len(vehicle.channel_names if kind.channels or kind.course else vehicle.thruster_names),
        launch=None if kind.course else RowLaunch(thrusts_row, vec8, mode_data(name, [vehicle], [parts])),
    )


def mode_from_dict(description: Mapping[str, Any], vehicle: Any) -> ActionMode:
    """Return the mode that `describe()` recorded, for the vehicle that it will command.

    Raises:
        ControlError: The vehicle's limits, names or reference differ from those of the description, so that
            actions would have another meaning.
    """
    mode = action_mode(str(description.get("mode")), vehicle, description.get("scale", 1.0))
    here = mode.describe()
    recorded = plain_data({**dict.fromkeys(here), **description})
    difference = first_difference(recorded, here, mode.name, tolerance=TOLERANCE)
    if difference:
        raise ControlError(f"{difference}: use the vehicle file that the policy was trained with")
    return mode
