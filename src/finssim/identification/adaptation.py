"""Online estimation of changes of a vehicle in operation (payload, drag, thrusters), window by window.

The estimator is that of `simulation_error`. Each window of some seconds is fitted separately, with the vehicle file
as a weak prior, and yields information J and a solution x̂. The state of the filter is a mean m and a covariance P:

    P⁻¹ ← λ P⁻¹ + (1 - λ) P₀⁻¹,   λ = exp(-T / τ)     forgets old windows, down to the prior of the vehicle file
    J ← (J⁻¹ + Q)⁻¹                                    limits the information of a window by the model error
    P⁻¹ ← P⁻¹ + J,   m ← m + P J (x̂ - m)

A window whose x̂ - m is far outside P + J⁻¹ indicates that the vehicle has just changed: P is then reset to P₀.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from finssim.core.least_squares import arrow_reduced
from finssim.core.rotations import quat_to_euler
from finssim.identification.fit import Estimate
from finssim.identification.parameters import Coordinate, Plants
from finssim.identification.plant_terms import matrices
from finssim.identification.report import refuse_places
from finssim.identification.rollout import Segment, segments, streams
from finssim.identification.shooting import CUT, Shooting, blocks_of, solve
from finssim.identification.vehicle_file import SCALED, write_vehicle
from finssim.physics.types import MAX_THRUSTERS
from finssim.trials.conversion import EULER
from finssim.trials.findings import CalibrationError
from finssim.trials.free_motion import CHANNELS
from finssim.trials.trial import NU, Trial
from finssim.trials.trial_files import load_trials
from finssim.vehicles import HydrodynamicSet, Provenance, Vehicle, load_vehicle

__all__ = ["Adaptation", "Follower", "calibrate_changes", "windows_of"]

Array = NDArray[np.float64]

WINDOW, SEGMENT = 10.0, 5.0
"""Length of a window, and longest simulation without a restart [s]."""

STEP = 0.05
"""Time step of the simulation [s]."""

APART = 0.1
"""Least time between compared samples of a channel [s]."""

CORRELATED = 1.5
"""Correlation time of the errors of a robot's state estimate [s]: samples within it count as one."""

MEMORY = 20.0
"""Time constant τ with which windows are forgotten [s]."""

UNLIKE = 25.0
"""Square of the largest normalised innovation above which a window indicates a changed vehicle [-]."""

BLIND = 1e-6
"""Information along a direction, in the prior's units, below which the data are not informative and rounding
dominates."""

GAP = 0.5
"""Gap between states that ends a window [s]."""

ITERATIONS = 6
"""Largest number of iterations per window."""

FAR = 1e3
"""Bound of each y, in standard deviations."""

COARSE_STEP = 50.0
"""Scale of a coordinate y; its finite difference is a third of a standard deviation."""

RELEVANT = {"drag": 0.1, "thruster": 0.1}
"""Least relevant change of factors [-]; for the weight it is `RELEVANT_WEIGHT`."""

RELEVANT_WEIGHT = 0.005
"""Least relevant additional weight, relative to the vehicle's own weight [-]."""

DIFFERENT = 1.5
"""Least ratio of a change to the half width of its 95 % interval: among a dozen estimates, some exceed 1 by
chance."""


class _Coordinates:
    """Unknowns in standard deviations of the prior, with the interface of `parameters.Parameters`."""

    nuisances = 0
    axes = biases = ()
    """Empty: a push along x and y is one of the unknowns."""

    def __init__(self, of: Adaptation, mean: Array, std: Array) -> None:
        self.vehicle, self._of, self._mean, self._std = of.vehicle, of, mean, std
        n = len(mean)
        self.names = of.names
        self.start = self.expected = np.zeros(n)
        self.low, self.high = np.full(n, -FAR), np.full(n, FAR)
        self.scale = np.full(n, COARSE_STEP)
        self.coordinates = [Coordinate(name, "-", 0.0, -FAR, FAR, COARSE_STEP, 1.0) for name in of.names]

    def prior_rows(self) -> tuple[Array, Array]:
        """Return no rows (0, P) and no targets (0,): there is no other prior information."""
        return np.zeros((0, len(self.names))), np.zeros(0)

    def plants(self, y: Array) -> Plants:
        """Return the simulator's parameters for vectors (W, P)."""
        return self._of.plants(self._mean + np.atleast_2d(y) * self._std)


@dataclass
class Adaptation:
    """Recursive estimate of changes of a vehicle: drag, an additional weight in water, and thrusters.

    Mass and added mass are those of the vehicle file; the thrust factors are inferred from the thrust that
    they require.

    Attributes:
        vehicle: The vehicle as identified.
        names: `drag` [-], `weight` [N] in water and its first moments about the body origin `weight_x`, `weight_y`,
            `weight_z` [N m], a factor `thruster.NAME` for each thruster [-], and `push_x` and `push_y` [N], a force
            along body x and y that is constant in one window, such as that of a current.
        mean: Estimates, in the units of `names`, (P,).
        covariance: Covariance of the estimates, in products of their units, (P, P).
        windows: Number of windows so far.
        renewed: Numbers of the windows, from 1, that contradicted the previous ones.
    """

    vehicle: Vehicle
    names: tuple[str, ...] = field(init=False)
    mean: Array = field(init=False)
    covariance: Array = field(init=False)
    windows: int = field(init=False, default=0)
    renewed: list[int] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        v = self.vehicle
        if not isinstance(v.hydrodynamics.get("calibrated"), HydrodynamicSet):
            raise CalibrationError(
                f"{v.name}: no calibrated hydrodynamics, expected added mass and damping: identify it first"
            )
        w, (length, width, height) = v.weight, v.body.size
        # Initial value, standard deviation, and effect of model errors (thrust that differs by direction, eddies) on
        # the estimate of a window.
        prior = {
            "drag": (1.0, 0.5, 0.05),
            "weight": (0.0, 0.05 * w, 0.001 * w),
            "weight_x": (0.0, 0.02 * w * length, 0.002 * w * length),
            "weight_y": (0.0, 0.02 * w * width, 0.002 * w * width),
            "weight_z": (0.0, 0.02 * w * height, 0.002 * w * height),
            **{f"thruster.{name}": (1.0, 0.3, 0.03) for name in v.thruster_names},
            "push_x": (0.0, 0.005 * w, 0.0),
            "push_y": (0.0, 0.005 * w, 0.0),
        }
        self.names = tuple(prior)
        self._start, std, self._discrepancy = (
            np.array(column) for column in zip(*prior.values(), strict=True)
        )
        self.mean, self.covariance = self._start.copy(), np.diag(std**2)
        self._prior = self.covariance.copy()
        plant = matrices(v)
        self._damping = plant.D1, plant.D2

    def plants(self, x: Array) -> Plants:
        """Return the simulator's parameters.

        Args:
            x: Vectors of estimates, in the units of `names`, (W, P).
        """
        v, W = self.vehicle, len(x)
        drag, weight, first, gains, push = x[:, :1], x[:, 1], x[:, 2:5], x[:, 5:-2], x[:, -2:]
        gravity = v.water.density * v.water.gravity
        before = v.body.displaced_volume
        volume = np.maximum(before - weight / gravity, 0.1 * before)
        moments = before * np.asarray(v.body.center_of_buoyancy) - first / gravity
        gain = np.ones((W, 1, MAX_THRUSTERS))
        gain[:, 0, : gains.shape[1]] = np.maximum(gains, 0.0)
        bias = np.zeros((W, 1, 6))
        bias[:, 0, :2] = push
        drag = np.maximum(drag, 0.0)[:, :, None, None]
        D1, D2 = (drag * D for D in self._damping)
        return Plants(
            fields={
                "D1": D1, "D2": D2, "gain": gain, "volume": volume[:, None],
                "r_b": (moments / volume[:, None])[:, None],
            },
            bias=bias, lag=None, delay=None,
        )  # fmt: skip

    def update(self, window: Sequence[Segment]) -> None:
        """Update the estimates with one window.

        Args:
            window: Segments of some seconds, in order; no segment may be used twice.
        """
        if not window:
            return
        keep = math.exp(-sum(segment.duration for segment in window) / MEMORY)
        precision = keep * np.linalg.inv(self.covariance) + (1.0 - keep) * np.linalg.inv(self._prior)
        covariance = np.linalg.inv(precision)
        mean = self.mean.copy()
        mean[-2:] = 0.0  # a current changes from one window to the next
        covariance[-2:], covariance[:, -2:] = 0.0, 0.0
        covariance[-2:, -2:] = self._prior[-2:, -2:]
        J, b = self._window_information(window)
        size, along, y = _whitened(_root(covariance), J, b - J @ mean)
        if float(np.max(y**2 * size / (1.0 + size))) > UNLIKE:
            self.renewed.append(self.windows + 1)
            covariance = self._prior
            size, along, y = _whitened(_root(covariance), J, b - J @ mean)
        root = _root(covariance) @ along
        self.mean = mean + root @ (y * size / (1.0 + size))
        self.covariance = root @ np.diag(1.0 / (1.0 + size)) @ root.T
        self.windows += 1

    def _window_information(self, window: Sequence[Segment]) -> tuple[Array, Array]:
        """Return the information J of a window, and J x for the solution x of the window alone."""
        n, std = len(self.names), np.sqrt(np.diag(self._prior))
        unknowns: Any = _Coordinates(self, self._start, std)
        problem = Shooting([_thinned(s) for s in window], unknowns, CHANNELS, correlated=False)
        start = problem.start()
        start.theta[:n] = (self.mean - self._start) / std
        start.theta[n - 2 : n] = 0.0
        solution = solve(problem, start, iterations=ITERATIONS)
        total = arrow_reduced(blocks_of(problem, solution.linear, solution.std, solution.point, CUT), 0.0)[0]
        own = total[:n, :n] - total[:n, n:] @ np.linalg.solve(total[n:, n:], total[n:, :n])
        y, alike = solution.point.theta[:n], max(1.0, CORRELATED / APART)
        J = (own - np.eye(n)) / alike
        right = own @ y / alike  # (1 + J) y = J y of the data alone
        J, right = J / np.outer(std, std), right / std + J @ (self._start / std) / std
        # The information of a window is limited by the model error: (J⁻¹ + Q)⁻¹.
        discrepancy = self._discrepancy + self._unfollowed_fraction(window)
        worse = np.linalg.inv(np.eye(n) + J @ np.diag(discrepancy**2))
        return worse @ J, worse @ right

    def _unfollowed_fraction(self, window: Sequence[Segment]) -> Array:
        """Return the fraction of each thruster's commands in a window that its motor may not follow, (P,); 0
        elsewhere.

        A motor may not rotate below its slowest speed, whether or not the simulated one does [-].
        """
        out = np.zeros(len(self.names))
        for i, (name, thruster) in enumerate(self.vehicle.thrusters.items()):
            command = np.concatenate(
                [s.drive.force[:, i] for s in window if s.drive.thrusters] or [np.zeros(1)]
            )
            turns = np.array([thruster.dead_rpm_minus, thruster.dead_rpm_plus]) * 2.0 * np.pi / 60.0
            low, high = thruster.thrust(turns)
            slow = np.where((low < command) & (command < high), command, 0.0)
            size = np.linalg.norm(command)
            out[self.names.index(f"thruster.{name}")] = np.linalg.norm(slow) / size if size > 0.0 else 0.0
        return out

    @property
    def estimates(self) -> dict[str, Estimate]:
        """Return the estimates with their 95 % intervals; an `identifiable` one differs from the vehicle file."""
        out = {}
        for name, value, start, std in zip(
            self.names[:-2], self.mean, self._start, np.sqrt(np.diag(self.covariance)), strict=False
        ):
            unit = "-" if start == 1.0 else "N" if name == "weight" else "N m"
            half = 1.96 * float(std)
            kind = name.partition(".")[0]
            least = RELEVANT.get(kind, RELEVANT_WEIGHT * self.vehicle.weight)
            least = least if kind in ("drag", "thruster", "weight") else 0.1 * least
            differs = abs(value - start) > max(DIFFERENT * half, least)
            out[name] = Estimate.within(name, value, half, unit, differs, "as in the vehicle file")
        return out

    def as_json(self) -> dict[str, Any]:
        """Return the estimates by name, as plain values, and the number of windows."""
        estimates = {name: estimate.as_json() for name, estimate in self.estimates.items()}
        return {"windows": self.windows, "renewed": list(self.renewed), "changes": estimates}

    def print(self, console: Console) -> None:
        """Print the estimates as a table in which those that differ from the vehicle file are marked."""
        table = Table("change", "estimate", "95 % interval", "unit", "", box=None)
        for name, e in self.estimates.items():
            low, high = e.ci95
            mark = "differs from the file" if e.identifiable else ""
            table.add_row(name, f"{e.estimate:.3g}", f"{low:.3g} to {high:.3g}", e.unit, mark)
        console.print(table)
        console.print(f"{self.vehicle.name}: {self.windows} windows of {WINDOW:g} s", highlight=False)

    @property
    def adapted(self) -> Vehicle:
        """Return the vehicle with the changed numbers; its mass and inertia are those of the file.

        An additional weight is represented by a smaller displaced volume and a shifted centre of buoyancy.
        """
        x = self._start.copy()
        for i, estimate in enumerate(self.estimates.values()):
            if estimate.identifiable:
                x[i] = estimate.estimate
        v, of = self.vehicle, dict(zip(self.names, x.tolist(), strict=True))
        plant = self.plants(x[None])
        changes: dict[str, Any] = {}
        if any(of[name] for name in ("weight", "weight_x", "weight_y", "weight_z")):
            changes["body.displaced_volume"] = float(plant.fields["volume"][0, 0])
            changes["body.center_of_buoyancy"] = plant.fields["r_b"][0, 0].tolist()
        if of["drag"] != 1.0:
            chosen = v.hydrodynamics["calibrated"]
            assert isinstance(chosen, HydrodynamicSet)
            for key in ("linear_damping", "quadratic_damping"):
                values = np.asarray(getattr(chosen, key), float) * of["drag"]
                changes[f"hydrodynamics.calibrated.{key}"] = values.tolist()
        for name in v.thruster_names:
            factor = of[f"thruster.{name}"]
            if factor != 1.0:
                for key in SCALED:
                    changes[f"thrusters.{name}.{key}"] = factor * float(getattr(v.thrusters[name], key))
        source = f"adaptation over {self.windows} windows of {WINDOW:g} s"
        return v.replace(changes, Provenance("measured", source)) if changes else v


def _root(covariance: Array) -> Array:
    return np.asarray(np.linalg.cholesky(covariance), float)


def _whitened(root: Array, J: Array, right: Array) -> tuple[Array, Array, Array]:
    """Return information, principal directions and solution of data in coordinates y with unit covariance.

    Args:
        root: Cholesky factor L of the prior's covariance L Lᵀ.
        J: Information of the data.
        right: J times the solution of the data, relative to the prior's mean.
    """
    size, along = np.linalg.eigh(root.T @ J @ root)
    seen = size > BLIND
    size = np.where(seen, size, 0.0)
    return size, along, np.where(seen, along.T @ root.T @ right, 0.0) / np.where(seen, size, 1.0)


def _thinned(segment: Segment) -> Segment:
    """Return a segment in which successive samples of each channel are at least `APART` apart."""
    measured: Mapping[str, tuple[Array, Array]] = {
        name: (t[rows], values[rows])
        for name, (t, values) in segment.measured.items()
        for rows in [np.unique(np.searchsorted(t, np.arange(0.0, t[-1] + 1e-9, APART) - 1e-9))]
    }
    return replace(segment, measured=dict(measured))


def windows_of(trial: Trial, vehicle: Vehicle) -> Iterator[list[Segment]]:
    """Cut a trial into windows; a remainder shorter than half a segment is omitted.

    Args:
        trial: Trial with inputs and motion.
        vehicle: Vehicle of the trial.

    Yields:
        Segments of each window, in order.
    """
    cut = segments(streams(trial, vehicle), vehicle, length=SEGMENT, step=STEP)
    whole = [segment for segment in cut if segment.duration > 0.5 * SEGMENT]
    size = round(WINDOW / SEGMENT)
    for i in range(0, len(whole), size):
        yield whole[i : i + size]


class Follower:
    """Estimator of changes while a robot runs: windows are fitted in order in a separate thread."""

    def __init__(self, vehicle: Vehicle) -> None:
        """Fit an empty window first, so that nothing is compiled during operation."""
        self.adaptation = Adaptation(vehicle)
        self._columns = [*NU, *EULER, "x", "y", "z", *(f"command_{name}" for name in vehicle.thruster_names)]
        self._rows: list[list[float]] = []
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="adaptation")
        self._jobs: list[Future[None]] = []
        rest = np.zeros((61, 1 + len(self._columns)))
        rest[:, 0], rest[:, 12] = np.linspace(0.0, 3.0, 61), -1.0
        Adaptation(vehicle).update(next(windows_of(self._trial(rest), vehicle)))

    def add(self, time: float, nu: Array, quaternion: Array, position: Array, force: Array) -> None:
        """Add a state of the vehicle in operation; a gap of more than 0.5 s starts a new window.

        Args:
            time: Time [s].
            nu: Velocity of the body origin and angular velocity, body frame [m/s, rad/s], (6,).
            quaternion: Body to world, xyzw, (4,).
            position: Position in the world frame [m], (3,).
            force: Commanded forces of the thrusters [N], (n,).
        """
        if self._rows and not 0.0 < time - self._rows[-1][0] < GAP:
            self._rows.clear()
        attitude = np.array(quat_to_euler(quaternion))
        self._rows.append([time, *nu.tolist(), *attitude.tolist(), *position.tolist(), *force.tolist()])
        if time - self._rows[0][0] >= WINDOW:
            self._jobs.append(self._worker.submit(self._learn, np.array(self._rows)))
            del self._rows[:-1]

    def _learn(self, rows: Array) -> None:
        for window in windows_of(self._trial(rows), self.adaptation.vehicle):
            self.adaptation.update(window)

    def _trial(self, rows: Array) -> Trial:
        columns = dict(zip(("t", *self._columns), rows.T, strict=True))
        columns["yaw"] = np.unwrap(columns["yaw"])
        return Trial.from_frame(columns, name="driving")

    def finish(self) -> Adaptation:
        """Wait until all windows are fitted, and return the estimates.

        Raises:
            CalibrationError: A window could not be simulated.
        """
        self._worker.shutdown()
        for job in self._jobs:
            job.result()
        return self.adaptation


def calibrate_changes(
    trials: Sequence[Path], *, vehicle: str, out: Path | None = None, as_json: bool = False
) -> Adaptation:
    """Estimate changes of an identified vehicle from trials in operation: payload, drag, thrusters.

    Weak thrusters, an additional weight with its position, and a factor on the drag are tracked through the
    trials in windows of 10 s. Estimates that differ from the vehicle file are marked.

    Example: finssim calibrate changes trials --vehicle mine.yaml --out now.yaml

    Args:
        trials (TRIAL): Trial folders, folders of them, or bare .csv or .parquet tables, in chronological order.
        vehicle (NAME|FILE): The identified vehicle: in the catalogue, or path of a vehicle file.
        out (FILE): Vehicle file to write with the changed numbers (.yaml).
        as_json: Print one JSON object instead of a table.

    Returns:
        The estimates after the last window.

    Raises:
        CalibrationError, VehicleError, OutputError: An input or output cannot be used.
    """
    if out is not None:
        refuse_places(out, None, "vehicle")
    body = load_vehicle(vehicle)
    adaptation = Adaptation(body)
    for trial in load_trials(trials):
        for window in windows_of(trial, body):
            adaptation.update(window)
    if not adaptation.windows:
        raise CalibrationError(
            f"{trials[0]}: no {0.5 * SEGMENT:g} s with commands and motion, so there is nothing to estimate"
        )
    if out is not None:
        write_vehicle(adaptation.adapted, out)
    if as_json:
        print(json.dumps(adaptation.as_json()))
    else:
        adaptation.print(Console())
    return adaptation
