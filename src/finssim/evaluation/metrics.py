"""The paper's metrics of station keeping (T1, Table IV) and of trajectory tracking (T2, Table V).

T1: a trial holds one goal for 60 s. Its samples are resampled to 10 Hz; a grid point in a gap of more than 0.25 s
between samples has no value, and a trial with values at less than 0.9 of the window's points has no late errors.
Names are the paper's: e_y is the vertical error, as the paper's y axis points up.

T2: the paper reports three errors against the reference at the same time: horizontal RMSE, vertical RMSE and the 95th
percentile of the distance. The other metrics are those named in its published configuration; where it gives no
formula, the definition is ours and is documented here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray

from finssim.control.guidance import Guide
from finssim.core.rotations import quat_rotate
from finssim.vehicles import Vehicle
from finssim.vehicles.defaults import room

# Data of the paper: its eight setpoints and the start of T1 in our frames, and its results on its real vehicle.


PAPER: Mapping[str, Any] = yaml.safe_load(Path(__file__).with_name("paper.yaml").read_text(encoding="utf-8"))
"""Content of the paper's tables."""

T1_PUBLISHED: Mapping[str, tuple[float, float, float, float]] = PAPER["setpoints"]
"""Name -> (x, y, z [m], yaw [deg]) as published: controller frame, x forward, y up from the surface, z left."""


def from_published(setpoint: tuple[float, float, float, float]) -> NDArray[np.float64]:
    """Return a setpoint of the paper's controller frame in our world frame.

    The controller frame is our world with y and z exchanged, p_c = B p, det B = -1. Positions are multiplied by B.
    Angles transform as axial vectors, omega_c = det(B) B omega = [-omega_x, -omega_z, -omega_y]: a yaw about the
    controller's y has the opposite sign of ours about z, so its +90 deg is a turn to the right, our -90 deg.

    Args:
        setpoint: (x, y up, z left [m], yaw [deg]) in the controller frame.

    Returns:
        [x, y left, z up [m], yaw in (-pi, pi] [rad]] in the world frame, z = 0 at the surface, shape (4,).
    """
    x, up, y, yaw_deg = setpoint
    yaw = -math.radians(yaw_deg)
    return np.array([x, y, up, math.pi if yaw == -math.pi else yaw])


T1_SETPOINTS = MappingProxyType({name: from_published(setpoint) for name, setpoint in T1_PUBLISHED.items()})
"""Name -> [x, y, z [m], yaw [rad]], world frame."""

T1_START = from_published((0.0, -0.5, 0.0, 0.0))
"""Pose at the start of every trial [x, y, z [m], yaw [rad]], world frame, at rest and level."""


SITE_SIZES = {"pool": 1.0, "tank": 3.0, "open-water": 3.0}
"""Factor on the setpoints and the start of T1 by site: about a metre from the origin in the pool, three
metres elsewhere."""


def in_room(pose: NDArray[np.float64], vehicle: Vehicle, site: str = "pool") -> NDArray[np.float64]:
    """Return a published pose [x, y, z [m], yaw [rad]] scaled to the room of this vehicle; the yaw is unchanged."""
    size = room(vehicle.body.size) * SITE_SIZES[site]
    return pose * np.array([size, size, size, 1.0])


KEYS = ("e_p_m", "e_y_m", "e_psi_deg", "success", "trials", "t_s_s", "J_p_m", "J_psi_deg")

PAPER_T1: Mapping[str, Sequence[float | None]] = PAPER["station_keeping"]
"""Table of T1: training model (DR: domain randomisation) -> the figures in the order of `KEYS`, on hardware."""


def paper_row(name: str) -> dict[str, Any]:
    """Return one row with the keys of our own results, and `name`."""
    return {"name": name, **dict(zip(KEYS, PAPER_T1[name], strict=True))}


ERRORS = ("horizontal_rmse_m", "vertical_rmse_m", "p95_m")
"""Tracking errors that the paper reports."""
PAPER_T2: Mapping[str, Mapping[str, Sequence[float]]] = PAPER["tracking"]
"""Table of T2: controller -> trajectory -> the figures in the order of `ERRORS`."""


def paper_t2_row(name: str, trajectory: str) -> dict[str, Any] | None:
    """Return one controller on one trajectory, with the keys of our own results; None if the paper has no value."""
    values = PAPER_T2[name].get(trajectory)
    return values and dict(zip(ERRORS, values, strict=True))


Array = NDArray[np.float64]

POSITION_TOLERANCE = 0.10
"""Largest error on each axis for which the position counts as held [m]; in training, `StationKeeping` decides."""

YAW_TOLERANCE = math.radians(10.0)
"""Largest yaw error for which the heading counts as held [rad]."""

SUCCESS_DURATION = 10.0
"""Duration for which both must hold without interruption [s]."""

EVALUATION_WINDOW = (40.0, 60.0)
"""Time window in which the late errors are evaluated [s]."""

RATE = 10.0
"""Rate of the evaluation grid [Hz]."""

MAX_GAP = 0.25
"""Longest interval between two samples that is interpolated [s]."""

MIN_VALID = 0.9
"""Least fraction of the window's grid points that must have a value."""

MEANS = ("e_p_m", "e_y_m", "e_psi_deg", "J_p_m", "J_psi_deg", "t_s_s")


def measure_trial(t: ArrayLike, position: ArrayLike, yaw: ArrayLike, goal: ArrayLike) -> dict[str, Any]:
    """Return the metrics of one trial.

    With e = position - goal and e_psi the yaw error, over the grid points of the evaluation window: e_p = sqrt(mean
    |e|²), e_y = sqrt(mean e_z²), e_psi = sqrt(mean e_psi²). Success: |e_x|, |e_y|, |e_z| <= 0.10 m and |e_psi| <= 10
    deg for 10 s without interruption, at any time in the trial. t_s is the start of the first such 10 s. Jitter is
    the RMS deviation from the mean in those 10 s: J_p = sqrt(mean |p - mean p|²), and J_psi accordingly.

    Args:
        t: Time since the start of the hold [s], increasing, shape (T,).
        position: Position, world frame [m], shape (T, 3).
        yaw: Heading [rad], wrapped or not, shape (T,).
        goal: Constant goal [x, y, z [m], yaw [rad]], world frame, shape (4,).

    Returns:
        `success` (bool); `e_p_m`, `e_y_m`, `e_psi_deg` (None without enough samples); `t_s_s`, `J_p_m`, `J_psi_deg`
        (None without success); and `valid`, the fraction of the window's grid points with a value.

    Raises:
        ValueError: Times do not increase, or lengths differ.

    Note:
        The paper says "jitter" without a formula, and "time to the first satisfaction of the criterion sustained for
        10 s" without stating whether that is its start or its end; we use its start. The end is t_s + 10 s.
    """
    goal = np.asarray(goal, dtype=np.float64)
    grid, position, yaw = resample(t, position, yaw)
    error, yaw_error = pose_error(position, yaw, goal)
    in_window = (grid >= EVALUATION_WINDOW[0]) & (grid <= EVALUATION_WINDOW[1])
    valid = float(np.mean(np.isfinite(yaw_error[in_window])))
    measures: dict[str, Any] = {"success": False, "valid": valid}
    measures |= dict.fromkeys(("e_p_m", "e_y_m", "e_psi_deg", "t_s_s", "J_p_m", "J_psi_deg"))
    if valid >= MIN_VALID:
        measures["e_p_m"] = _rms(np.linalg.norm(error[in_window], axis=-1))
        measures["e_y_m"] = _rms(error[in_window, 2])
        measures["e_psi_deg"] = math.degrees(_rms(yaw_error[in_window]))
    held = np.all(np.abs(error) <= POSITION_TOLERANCE, axis=-1) & (np.abs(yaw_error) <= YAW_TOLERANCE)
    first = _first_run(held, round(SUCCESS_DURATION * RATE) + 1)
    if first is not None:
        measures["success"] = True
        measures["t_s_s"] = float(grid[first.start])
        measures["J_p_m"] = _rms(np.linalg.norm(error[first] - error[first].mean(axis=0), axis=-1))
        measures["J_psi_deg"] = math.degrees(_rms(yaw_error[first] - yaw_error[first].mean()))
    return measures


def summarize(
    trials: Sequence[Mapping[str, Any]],
    counts: str = "success",
    valid: str = "e_p_m",
    means: Sequence[str] = MEANS,
) -> dict[str, Any]:
    """Return one controller's row of the table, from the metrics of its trials.

    Each figure is a mean over the trials with a value, errors over all, jitters over the successful ones; t_s is the
    median. A trial without errors (it ended early, or its samples are missing) still counts as an unsuccessful trial.

    Args:
        trials: Results of `measure_trial` or `measure_tracking`, possibly with more keys.
        counts: Key whose true values are counted.
        valid: Key of an error that every valid trial has.
        means: Keys of the figures.

    Returns:
        `trials`, `valid` (trials with errors), `success` or the other counted key, and the figures, None if
        no trial has a value.
    """
    row: dict[str, Any] = {
        "trials": len(trials),
        "valid": sum(trial[valid] is not None for trial in trials),
        counts: sum(bool(trial[counts]) for trial in trials),
    }
    for key in means:
        values = [trial[key] for trial in trials if trial[key] is not None]
        statistic: Any = np.median if key == "t_s_s" else np.mean
        row[key] = float(statistic(values)) if values else None
    return row


def pose_error(position: Array, yaw: Array, goal: Array) -> tuple[Array, Array]:
    """Return the position and yaw errors.

    Args:
        position: Position in the world frame [m], shape (..., 3).
        yaw: Heading [rad], shape (...,).
        goal: Goal [x, y, z [m], yaw [rad]], world frame, shape (..., 4).

    Returns:
        position - goal, world frame [m], shape (..., 3), and yaw - goal yaw in [-pi, pi) [rad], shape (...,).
    """
    return position - goal[..., :3], (yaw - goal[..., 3] + math.pi) % (2.0 * math.pi) - math.pi


def resample(t: ArrayLike, position: ArrayLike, yaw: ArrayLike) -> tuple[Array, Array, Array]:
    """Return a trial on the 10 Hz evaluation grid, from 0 to 60 s or to its own end if that is later.

    Values are interpolated linearly, yaw along the shorter arc. Non-finite samples are ignored. A grid point
    before the first sample, after the last, or between two samples more than 0.25 s apart is NaN.

    Args:
        t: Time since the start of the hold [s], increasing, shape (T,).
        position: Position in the world frame [m], shape (T, 3).
        yaw: Heading [rad], wrapped or not, shape (T,).

    Returns:
        Grid times [s], shape (G,); position, shape (G, 3); unwrapped yaw, shape (G,).

    Raises:
        ValueError: Times do not increase, or lengths differ.
    """
    t, position, yaw = (np.asarray(x, dtype=np.float64) for x in (t, position, yaw))
    if t.ndim != 1 or position.shape != (*t.shape, 3) or yaw.shape != t.shape:
        raise ValueError(
            f"t, position and yaw are {t.shape}, {position.shape}, {yaw.shape}, expected (T,), (T, 3), (T,)"
        )
    if np.any(np.diff(t) <= 0.0):
        raise ValueError("sample times do not increase: sort the samples and drop repeated ones")
    finite = np.isfinite(position).all(axis=-1) & np.isfinite(yaw)
    t, position, yaw = t[finite], position[finite], np.unwrap(yaw[finite])
    end = max(EVALUATION_WINDOW[1], t[-1] if len(t) else 0.0)
    grid = np.arange(math.floor(end * RATE + 1e-6) + 1) / RATE
    if len(t) == 0:
        return grid, np.full((len(grid), 3), np.nan), np.full(len(grid), np.nan)
    after = np.clip(np.searchsorted(t, grid), 1, max(len(t) - 1, 1))
    before, after = after - 1, np.minimum(after, len(t) - 1)
    nearest = np.where(np.abs(t[before] - grid) <= np.abs(t[after] - grid), t[before], t[after])
    inside = (t[before] <= grid) & (grid <= t[after]) & (t[after] - t[before] <= MAX_GAP)
    # A sample at the grid point itself, with a time rounded by the log.
    inside |= np.abs(nearest - grid) <= 1e-3
    columns = [np.where(inside, np.interp(grid, t, column), np.nan) for column in (*position.T, yaw)]
    return grid, np.stack(columns[:3], axis=-1), columns[3]


def _first_run(held: NDArray[np.bool_], length: int) -> slice | None:
    """Return the first `length` consecutive true elements, or None."""
    count = np.concatenate([[0], np.cumsum(held)])
    starts = np.flatnonzero(count[length:] - count[:-length] == length)
    return slice(starts[0], starts[0] + length) if len(starts) else None


def _rms(x: Array) -> float:
    """Return the root mean square of the finite values."""
    return math.sqrt(float(np.nanmean(np.square(x))))


DENSE_RATE = 50.0
"""Rate of the samples of the reference on which a position is projected [Hz]."""

SEARCH_WINDOW = 2.0
"""Longest time after the previous projection, and after the sample's own time, that is searched for a
projection [s]."""
SEARCH_WAY = 0.3
"""Least path length that is searched ahead, however slow the reference is there [m]."""

COMPLETE = 0.98
"""Fraction of the path that counts as complete."""

SATURATED = 0.99
"""Fraction of its limit above which a thruster counts as saturated."""

MEASURES = (
    *ERRORS,
    *("cross_track_rmse_m", "cross_track_p95_m", "completion"),
    *("energy", "smoothness_per_s", "saturation", "max_tilt_deg"),
)
"""All metrics that `measure_tracking` returns."""


def measure_tracking(
    t: ArrayLike,
    position: ArrayLike,
    guide: Guide,
    *,
    quaternion: ArrayLike | None = None,
    thrust: ArrayLike | None = None,
    limits: tuple[ArrayLike, ArrayLike] | None = None,
) -> dict[str, Any]:
    """Return the metrics of one run, over the samples from the start to the end of the trajectory.

    With e = position - reference at the same time:

        horizontal = sqrt(mean(e_x² + e_y²))    vertical = sqrt(mean e_z²)    p95: 95th percentile of |e|

    Cross-track errors are distances to the nearest point of the path (`projected_times`); `completion` is the
    fraction of the path length before the last sample's projection.

    Args:
        t: Times since the start of the trajectory [s], increasing, (T,).
        position: Body origin, world frame [m], (T, 3); NaN where unknown.
        guide: Reference to follow.
        quaternion: Body to world, xyzw, (T, 4), for the tilt.
        thrust: Thrust of each thruster [N], (T, n), for energy, smoothness and saturation.
        limits: Lower and upper limit of each thruster [N], (n,) each; required with `thrust`.

    Returns:
        `MEASURES`, None if their inputs are missing; `valid`, the fraction of samples with a position; `complete`.

    Raises:
        ValueError: Times do not increase, or lengths differ.
    """
    t, position = np.asarray(t, np.float64), np.asarray(position, np.float64)
    if t.ndim != 1 or position.shape != (len(t), 3):
        raise ValueError(f"t and position are {t.shape} and {position.shape}, expected (T,) and (T, 3)")
    if np.any(np.diff(t) <= 0.0):
        raise ValueError("sample times do not increase: sort the samples and drop repeated ones")
    during = (t >= 0.0) & (t <= guide.duration + 1e-6)
    valid = during & np.isfinite(position).all(axis=-1)
    measures: dict[str, Any] = dict.fromkeys(MEASURES)
    measures["valid"] = float(valid.sum() / max(during.sum(), 1))
    measures["complete"] = False
    if measures["valid"] >= MIN_VALID:
        measures |= _errors(t[valid], position[valid], guide)
    if quaternion is not None:
        up = quat_rotate(np.asarray(quaternion, np.float64)[valid], [0.0, 0.0, 1.0])[:, 2]
        measures["max_tilt_deg"] = math.degrees(np.arccos(np.clip(up.min(initial=1.0), -1.0, 1.0)))
    if thrust is not None and limits is not None and valid.sum() > 1:
        measures |= effort_measures(t[valid], np.asarray(thrust, np.float64)[valid], limits)
    return measures


def _errors(t: Array, position: Array, guide: Guide) -> dict[str, Any]:
    error = position - guide.at(t).position
    projected = projected_times(t, position, guide)
    away = np.linalg.norm(position - guide.at(projected).position, axis=-1)
    completion = _way_share(guide, float(projected[-1]))
    return {
        "horizontal_rmse_m": _rms(np.linalg.norm(error[:, :2], axis=-1)),
        "vertical_rmse_m": _rms(error[:, 2]),
        "p95_m": float(np.percentile(np.linalg.norm(error, axis=-1), 95.0)),
        "cross_track_rmse_m": _rms(away),
        "cross_track_p95_m": float(np.percentile(away, 95.0)),
        "completion": completion,
        "complete": completion >= COMPLETE,
    }


def projected_times(t: Array, position: Array, guide: Guide) -> Array:
    """Return times at which the reference is nearest to each position, (T,): never decreasing, and never far ahead.

    Both are relevant where a path crosses or repeats itself. The reference is searched at 50 Hz from the last
    projection to 2 s or 0.3 m after it (the reference rests at corners, where the search would otherwise stop), but
    not to more than 2 s after the sample's own time. A vehicle that stops is projected to where it stopped.

    Args:
        t: Times since the start of the reference [s], increasing, (T,).
        position: Body origin, world frame [m], (T, 3).
        guide: The reference.

    Returns:
        Times since the start of the reference [s], (T,).
    """
    times = np.arange(math.floor(guide.duration * DENSE_RATE + 1e-6) + 1) / DENSE_RATE
    way = guide.at(times).position
    window = round(SEARCH_WINDOW * DENSE_RATE)
    latest = np.searchsorted(times, t + SEARCH_WINDOW + 1e-9)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=-1))])
    further = np.searchsorted(length, length + SEARCH_WAY)
    nearest, reached = np.zeros(len(t), dtype=int), 0
    for i, x in enumerate(position):
        end = max(min(max(reached + window, int(further[reached])), int(latest[i])), reached) + 1
        reached += int(np.argmin(np.sum((way[reached:end] - x) ** 2, axis=-1)))
        nearest[i] = reached
    return np.asarray(times[nearest])


def _way_share(guide: Guide, time: float) -> float:
    """Return the fraction of the path length before a time: near a rest, seconds correspond to millimetres."""
    times = np.linspace(0.0, guide.duration, round(guide.duration * DENSE_RATE) + 2)
    length = np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(guide.at(times).position, axis=0), axis=-1))]
    )
    return float(np.interp(time, times, length) / length[-1])


def effort_measures(t: Array, thrust: Array, limits: tuple[ArrayLike, ArrayLike]) -> dict[str, float]:
    """Return measures of the thrusters' effort.

        energy = ∫ sum |f|^1.5 dt [N^1.5 s]: up to a factor, a propeller's shaft energy (momentum theory)
            smoothness = RMS of the rate of change of the thrusts, relative to their limits [1/s]; 0 is smoothest
            saturation = fraction of samples and thrusters at 99 % of the limit or more

    Args:
        t: Times [s], (T,).
        thrust: Thrusts [N], (T, n).
        limits: Lower and upper limits [N], (n,) each.
    """
    lower, upper = (np.asarray(x, np.float64) for x in limits)
    part = np.where(thrust >= 0.0, thrust / upper, thrust / lower)
    step = np.diff(t)
    power = np.sum(np.abs(thrust) ** 1.5, axis=-1)
    reach = np.maximum(upper, -lower)
    return {
        "energy": float(np.sum(0.5 * (power[1:] + power[:-1]) * step)),
        "smoothness_per_s": _rms(np.diff(thrust / reach, axis=0) / step[:, None]),
        "saturation": float(np.mean(part >= SATURATED)),
    }


summarize_tracking = partial(summarize, counts="complete", valid="p95_m", means=MEASURES)
"""Function for one row of the table of T2: `trials`, `valid`, `complete` (count) and the means of `MEASURES`."""
