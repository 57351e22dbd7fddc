"""Synthetic trials: programmes run in the simulator, measured with noise, logged as a robot would log them.

Time stamps. Row k of a trial at `rate` has time t_k = k / rate and holds

- the state at t_k: velocity of the body origin, attitude, position, angular rate, and what an accelerometer at the
  IMU's place reads at t_k (later by the sensor's latency where the vehicle's own sensors measure);
- commands that are held over [t_k, t_k + 1/rate);
- applied inputs (`rpm_*`, `force_*`, `tau_*`) as `sampling` says: `instant`, the value at t_k, as telemetry gives it
  (motors lag, so they are continuous); or `held`, the mean over [t_k, t_k + 1/rate), the impulse of the row.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.excitation.measurement import NOISE_PROFILES, NoiseProfile, measure
from finssim.calibration.excitation.programmes import Programme
from finssim.calibration.excitation.recording import Recording, record
from finssim.calibration.trials.columns import TAU
from finssim.calibration.trials.header import Header, TrialWater
from finssim.calibration.trials.trial import Trial
from finssim.vehicles import Vehicle

__all__ = ["DEFAULT_COLUMNS", "simulate_programme", "trials_of"]

Array = NDArray[np.float64]

DEFAULT_COLUMNS = (
    *("u", "v", "w", "p", "q", "r", "ax", "ay", "az"),
    *("qx", "qy", "qz", "qw", "x", "y", "z", "depth"),
)
"""Measured columns of a synthetic trial."""

INPUTS = ("rpm", "force", "wrench", "pwm", "command")

Input = Literal["rpm", "force", "wrench", "pwm", "command"]


def simulate_programme(
    programmes: Sequence[Programme],
    vehicle: Vehicle,
    *,
    noise: NoiseProfile | str = "sensors",
    seed: int = 0,
    rate: float = 50.0,
    columns: Sequence[str] | None = None,
    inputs: Sequence[Input] = ("rpm", "wrench"),
    sampling: Literal["instant", "held"] = "instant",
    **plant: Any,
) -> list[Trial]:
    """Trials of a vehicle, one for each programme: `record` and then `trials_of`.

    Args:
        programmes: What to run.
        vehicle: The vehicle, whose file says what it believes of itself.
        noise: A profile or the name of one.
        seed: Of initial conditions and noise; equal seeds give equal trials.
        rate: Of the rows [Hz].
        columns: Measured columns to log; `DEFAULT_COLUMNS` if None.
        inputs: Which inputs to log.
        sampling: See the module.
        plant: As for `record`: hydrodynamics, plant, disturbance, water, pool, tether, depth, spread, threads.

    Raises:
        CalibrationError: An argument that cannot be.
    """
    recording = record(programmes, vehicle, seed=seed, **plant)
    water = plant.get("water")
    return trials_of(
        recording,
        programmes,
        vehicle,
        noise=noise,
        seed=seed,
        rate=rate,
        columns=columns,
        inputs=inputs,
        sampling=sampling,
        current=tuple(water.current) if water is not None and any(water.current) else None,
    )


def trials_of(
    recording: Recording,
    programmes: Sequence[Programme],
    vehicle: Vehicle,
    *,
    noise: NoiseProfile | str = "sensors",
    seed: int = 0,
    rate: float = 50.0,
    columns: Sequence[str] | None = None,
    inputs: Sequence[Input] = ("rpm", "wrench"),
    sampling: Literal["instant", "held"] = "instant",
    current: tuple[float, float, float] | None = None,
) -> list[Trial]:
    """Trials that measure a recording; arguments as for `simulate_programme`.

    Calling it again with another seed gives the same motion with other noise.

    Args:
        current: What the header says of the water's velocity, world frame [m/s].

    Raises:
        CalibrationError: A rate, column, input or profile that cannot be.
    """
    profile = _profile(noise)
    every = round(1.0 / (rate * recording.step))
    if every < 1 or abs(every * recording.step * rate - 1.0) > 1e-6:
        raise CalibrationError(
            f"rate is {rate:g} Hz, expected {1.0 / recording.step:g} Hz over a whole number"
        )
    chosen = DEFAULT_COLUMNS if columns is None else tuple(columns)
    measured = measure(recording, vehicle, profile, every=every, seed=seed)
    for name in chosen:
        if name not in measured:
            raise CalibrationError(
                f"synthetic trials have no column '{name}'; available: {', '.join(measured)}"
            )
    logged = _inputs(recording, vehicle, inputs, every, sampling)
    water = TrialWater(current=current) if current is not None else TrialWater()
    out = []
    for w, programme in enumerate(programmes):
        end = _end(programme, recording, w)
        t = np.arange(0.0, end - 1e-9, 1.0 / rate)
        rows = np.minimum(np.floor(t * programme.rate + 1e-6).astype(int), len(programme.phase) - 1)
        out.append(
            Trial(
                name=programme.name,
                t=t,
                channels={name: logged[name][: len(t), w].copy() for name in logged}
                | {name: measured[name][: len(t), w].copy() for name in chosen},
                phase=programme.phase[rows],
                header=Header(
                    vehicle=vehicle.name,
                    axis=programme.axes,
                    description=f"simulated: {programme.name}",
                    inputs="commanded" if set(inputs) <= {"command", "pwm"} else "applied",
                    inputs_between="held" if sampling == "held" else None,
                    acceleration="specific_force",
                    water=water,
                ),
            )
        )
    return out


def _profile(noise: NoiseProfile | str) -> NoiseProfile:
    if isinstance(noise, NoiseProfile):
        return noise
    if noise not in NOISE_PROFILES:
        raise CalibrationError(f"unknown noise '{noise}'; available: {', '.join(NOISE_PROFILES)}")
    return NOISE_PROFILES[noise]


def _inputs(
    recording: Recording, vehicle: Vehicle, inputs: Sequence[str], every: int, sampling: str
) -> dict[str, Array]:
    """Input columns, (rows, W) each."""
    for name in inputs:
        if name not in INPUTS:
            raise CalibrationError(f"unknown input '{name}'; available: {', '.join(INPUTS)}")
    thrust = recording.thrust.astype(float)
    if sampling == "held":
        # Thrust is linear between states, to second order in the step: the mean is the trapezoid's.
        rows = (len(thrust) - 1) // every
        middle = 0.5 * (thrust[1:] + thrust[:-1])[: rows * every]
        thrust = middle.reshape(rows, every, *thrust.shape[1:]).mean(axis=1)
    else:
        thrust = thrust[::every]
    command = recording.command[::every].astype(float)
    out: dict[str, Array] = {}
    names = vehicle.thruster_names
    if "rpm" in inputs:
        out |= {f"rpm_{name}": _rpm(thrust[..., k], vehicle, k) for k, name in enumerate(names)}
    if "force" in inputs:
        out |= {f"force_{name}": thrust[..., k] for k, name in enumerate(names)}
    if "wrench" in inputs:
        tau = thrust @ vehicle.control_matrix.T
        out |= {name: tau[..., i] for i, name in enumerate(TAU)}
    if "command" in inputs:
        out |= {f"command_{name}": command[..., k] for k, name in enumerate(names)}
    if "pwm" in inputs:
        out |= {f"pwm_{name}": _pulse(command[..., k], vehicle, k) for k, name in enumerate(names)}
    return out


def _rpm(thrust: Array, vehicle: Vehicle, k: int) -> Array:
    """Shaft speed at which the file says thruster k gives a thrust [rpm]."""
    return vehicle.thrusters[vehicle.thruster_names[k]].speed(thrust) * (60.0 / (2.0 * np.pi))


def _pulse(thrust: Array, vehicle: Vehicle, k: int) -> Array:
    """Pulse width at which the file says thruster k gives a thrust [µs]."""
    thruster = vehicle.thrusters[vehicle.thruster_names[k]]
    return thruster.pulse(thruster.speed(thrust))


def _end(programme: Programme, recording: Recording, world: int) -> float:
    """When the trial ends [s]: with the programme, or with the part of the coast that shows a steady ascent."""
    if programme.ascent_speed is None:
        return programme.duration
    t = np.arange(len(recording.position)) * recording.step
    coasting = np.flatnonzero(programme.phase == "coast") / programme.rate
    rising = (
        np.gradient(recording.position[:, world, 2].astype(float), recording.step) > programme.ascent_speed
    )
    since = np.where((t >= coasting[0]) & rising, t, np.inf)
    found = float(since.min()) + programme.ascent_time
    return min(programme.duration, found)
