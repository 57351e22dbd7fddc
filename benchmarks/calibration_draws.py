"""Accuracy and interval coverage of calibrations of drawn plants from logs such as users have.

    python benchmarks/calibration_draws.py [--draws 50] [--first 0] [--json FILE] [--passive] [--unequal 0.05]

Every draw is a BlueROV2 Heavy with its own coefficients, driven by stick commands, one axis per trial, recorded at
5 Hz: pulses without a battery voltage (thrust 0.65 to 1.1 of the table's), motion that leads or lags the pulses by up
to 0.1 s, a tether that pulls with up to 2 N in one direction of the world, a stiffness that differs from the file's,
horizontal thrusters and centres of gravity up to 5 cm from their positions in the file, and in every second draw no
roll or pitch. The lowest level is fitted, and the two higher ones are replayed; intervals are compared with the truth.
The plant itself replays these trials no better than tether, noise and clock allow; where the file is as good by chance,
there is nothing to gain. With --json, every finished draw is written to the file, and draws in it are not repeated.
With --passive, each draw consists of five spins and five coasts that are released without thrust: measured at 20, 5 or
1 Hz, with a slight pull, centres as in the file, and known inertia. With --unequal, the thrust of every thruster is
multiplied by its own factor, 1 with the given standard deviation.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from finssim.core.rotations import quat_conjugate, quat_rotate
from finssim.identification.hydrodynamics import fit_hydrodynamics
from finssim.identification.prediction import replay
from finssim.identification.programme import Programme
from finssim.identification.synthetic import NoiseProfile, record, trials_of
from finssim.identification.vehicle_file import calibrated, scaled_thrust
from finssim.sim import Simulator
from finssim.trials.findings import CalibrationError
from finssim.trials.trial import Header, Trial
from finssim.vehicles import AXES, Vehicle, load_vehicle

FITTED = ("surge", "sway", "heave", "yaw")
LEVELS = (0.15, 0.25, 0.4)
"""Levels as fractions of the vehicle's wrench limits; the first is fitted."""
RATE, SECONDS = 50.0, 26.0
NOISE = NoiseProfile(
    velocity_std=0.01, gyro_std=0.01, attitude_std=0.003, yaw_std=0.003, position_std=0.003, depth_std=0.01
)
SET = "hydrodynamics.calibrated"
PLACE = 0.05
"""Largest distance of a thruster's height or a centre from the file's [m]."""
GAIN = 1.2
"""Ratio of the file's NRMSE to that of the plant itself from which there is something to gain [-]."""


def drawn(vehicle: Vehicle, rng: np.random.Generator) -> tuple[Vehicle, float, np.ndarray]:
    """Draw a plant, the ratio of its thrust to the file's, and the tether's force on it [N], world frame,
    (3,)."""
    chosen = vehicle.hydrodynamics["calibrated"]
    size = lambda std: np.exp(std * rng.standard_normal(6))  # noqa: E731
    mass = np.diag(chosen.added_mass) * size(0.35)
    # The file has zero for some damping coefficients; every real axis has both linear and quadratic damping.
    typical = np.array([20.0, 25.0, 30.0, 0.3, 0.5, 0.3])
    linear = 0.4 * typical * size(0.6)
    quadratic = np.diag(chosen.quadratic_damping) * size(0.4)
    height = float(rng.uniform(0.01, 0.05))
    gravity = rng.uniform(-PLACE, PLACE, 3)
    trim = rng.uniform(-0.002, 0.002, 2)
    lower = float(rng.uniform(-PLACE, PLACE))
    plant = vehicle.replace(
        {
            "body.center_of_gravity": gravity.tolist(),
            **{f"thrusters.{name}.position.2": t.position[2] + lower for name, t in horizontal(vehicle)},
            f"{SET}.added_mass": mass.tolist(),
            f"{SET}.linear_damping": linear.tolist(),
            f"{SET}.quadratic_damping": quadratic.tolist(),
            "body.center_of_buoyancy": (gravity + [*trim, height]).tolist(),
            "body.displaced_volume": float(0.0135 * (1.0 + rng.uniform(0.0, 0.01))),
        }
    )
    tether = rng.uniform(-1.0, 1.0, 3) * rng.uniform(0.0, 2.0)
    return plant, float(rng.uniform(0.65, 1.1)), tether


def pulling(force: np.ndarray) -> Callable[[Simulator], None]:
    """Return a function that applies a force [N], (3,), in the world frame, to every vehicle."""

    def pull(simulator: Simulator) -> None:
        q = simulator.numpy("quaternion")[:, 0]
        body = quat_rotate(quat_conjugate(q), np.broadcast_to(force, (len(q), 3)))
        simulator.command.disturbance.numpy()[:, 0, :3] = body

    return pull


def horizontal(vehicle: Vehicle) -> list:
    """Return the horizontal thrusters with their names."""
    return [(name, t) for name, t in vehicle.thrusters.items() if abs(t.axis[2]) < 0.5]


def sticks(axis: str, level: float, vehicle: Vehicle, rng: np.random.Generator, name: str) -> Programme:
    """Return a programme of steps of random duration and height in both directions, with occasional pauses."""
    n = round(SECONDS * RATE)
    tau, t = np.zeros((n, 6)), 0.0
    i = AXES.index(axis)
    t += rng.uniform(0.8, 1.5)
    while t < SECONDS - 2.0:
        length = rng.uniform(1.0, 4.0)
        height = 0.0 if rng.random() < 0.15 else rng.choice([-1.0, 1.0]) * rng.uniform(0.6, 1.0)
        tau[round(t * RATE) : round((t + length) * RATE), i] = height * level * vehicle.wrench_limits[i]
        t += length
    return Programme(name=name, axes=(axis,), rate=RATE, tau_desired=tau, phase=np.full(n, ""))


def logged(trial: Trial, lead: float, tilt: bool) -> Trial:
    """Return a trial as logged at 5 Hz, with a separate clock of the motion, and without information in its
    header."""
    every, shift = 10, round(lead * RATE)
    rows = np.arange(10, len(trial.t) - 10, every)
    names = ["u", "v", "w", "p", "q", "r", "x", "y", "z"]
    names += ["qx", "qy", "qz", "qw"] if tilt else []
    channels = {c: v[rows].copy() for c, v in trial.channels.items() if c.startswith("pwm_")}
    channels |= {c: trial.channels[c][rows + shift].copy() for c in names}
    header = trial.header.model_copy(update={"axis": (), "description": "", "acceleration": "auto"})
    return replace(trial, t=trial.t[rows] - trial.t[rows[0]], channels=channels, phase=None, header=header)


def draw(seed: int, unequal: float = 0.0) -> dict[str, object]:
    """Fit one plant; return the scores of both files by axis, and each interval with the true value.

    Args:
        seed: Seed of the plant, its trials and their noise.
        unequal: Relative standard deviation of the thrusts of single thrusters [-].
    """
    rng = np.random.default_rng([7, seed])
    vehicle = load_vehicle("bluerov2_heavy")
    plant, scale, tether = drawn(vehicle, rng)
    lead = float(rng.uniform(-0.1, 0.1))
    programmes = [
        sticks(axis, level, vehicle, rng, f"{axis}_{round(100 * level):03d}")
        for axis in FITTED
        for level in LEVELS
    ]
    gains = scale * (1.0 + unequal * np.random.default_rng([9, seed]).standard_normal(len(plant.thrusters)))
    recording = record(programmes, plant, seed=seed, plant={"gain": gains}, each_step=pulling(tether))
    trials = trials_of(
        recording, programmes, plant, noise=NOISE, seed=seed, rate=RATE, inputs=("pwm",),
        columns=("u", "v", "w", "p", "q", "r", "x", "y", "z", "qx", "qy", "qz", "qw"),
    )  # fmt: skip
    trials = [logged(trial, lead, tilt=seed % 2 == 0) for trial in trials]
    low = f"_{round(100 * LEVELS[0]):03d}"
    begin = time.process_time()
    fit = fit_hydrodynamics([t for t in trials if t.name.endswith(low)], vehicle)
    spent = time.process_time() - begin
    after = calibrated(fit)
    held = [t for t in trials if not t.name.endswith(low)]
    true = plant.replace(scaled_thrust(plant, 1.0, gains.tolist()))
    bodies = {"file": vehicle, "calibrated": after, "truth": true}
    scores = {name: _by_axis(body, held) for name, body in bodies.items()}
    chosen = plant.hydrodynamics["calibrated"]
    truth: dict[str, float] = {"thrust_scale": float(gains.mean())}
    rigid = np.diag(plant.rigid_body_mass_matrix())
    for axis in AXES:
        i = AXES.index(axis)
        truth |= {
            f"{axis}.m_eff": float(rigid[i] + chosen.added_mass[i, i]),
            f"{axis}.d1": float(chosen.linear_damping[i, i]),
            f"{axis}.d2": float(chosen.quadratic_damping[i, i]),
        }
    body = plant.body
    k = plant.buoyancy * body.center_of_buoyancy[2] - plant.weight * body.center_of_gravity[2]
    truth |= {"roll.k": k, "pitch.k": k, "thruster_height": horizontal(plant)[0][1].position[2]}
    truth |= {f"gravity_{c}": float(x) for c, x in zip("xyz", body.center_of_gravity, strict=True)}
    truth |= {f"gain.{n}": float(g / gains.mean()) for n, g in zip(plant.thrusters, gains, strict=True)}
    truth["buoyancy_excess"] = plant.buoyancy - plant.weight + float(tether[2])
    found = {
        name: [fit.estimates[name].estimate, *fit.estimates[name].ci95, value]
        for name, value in truth.items()
        if name in fit.estimates
    }
    return {"seed": seed, "scores": scores, "estimates": found, "seconds": spent}


RELEASES, PUSHED = 5, 4.0
"""Number of trials of each axis without thrust, and the duration of the push before each [s]."""
TUGS = np.array([0.2, 0.2, 0.2, 0.0, 0.0, 0.03])
"""Standard deviation of the external pull, drawn for each release [N, N m]."""


def draw_released(seed: int) -> dict[str, object]:
    """Fit one plant that is released after a spin and after a surge run; return each interval with the
    true value, and the parameters that were written."""
    rng = np.random.default_rng([8, seed])
    vehicle = load_vehicle("bluerov2_heavy")
    plant, _, _ = drawn(vehicle, rng)
    body = plant.body
    plant = plant.replace(
        {
            "body.center_of_gravity": vehicle.body.center_of_gravity.tolist(),
            "body.center_of_buoyancy": (body.center_of_buoyancy - body.center_of_gravity).tolist(),
            **{f"thrusters.{name}.position.2": t.position[2] for name, t in horizontal(vehicle)},
        }
    )
    every = (1, 4, 20)[seed % 3]
    found, wrote, spent = {}, {}, 0.0
    for axis in ("yaw", "surge"):
        i, tau = AXES.index(axis), np.zeros((RELEASES, round(20.0 * RATE), 6))
        sign = rng.choice([-1.0, 1.0], RELEASES)
        if axis == "yaw":
            push = sign * rng.uniform(0.3, 0.7, RELEASES) * vehicle.wrench_limits[i]
            tau[:, : round(PUSHED * RATE), i] = push[:, None]
        programmes = [
            Programme(
                name=f"{axis}_{k}", axes=(axis,), rate=RATE, tau_desired=one, phase=np.full(len(one), "")
            )
            for k, one in enumerate(tau)
        ]
        recording = record(
            programmes, plant, seed=seed, disturbance=TUGS * rng.standard_normal((RELEASES, 6)),
            speed=sign * rng.uniform(0.4, 0.9, RELEASES) if axis == "surge" else 0.0,
        )  # fmt: skip
        columns = (*(("r",) if axis == "yaw" else ("u", "v", "w", "r")), "qx", "qy", "qz", "qw")
        trials = trials_of(recording, programmes, plant, noise=NOISE, seed=seed, rate=20.0, columns=columns)
        header = Header(passive=True)
        begin = round(20.0 * (PUSHED + 0.1)) if axis == "yaw" else 0
        cut = [slice(begin + rng.integers(every), None, every) for _ in trials]
        trials = [
            replace(t, t=t.t[s] - t.t[s][0], phase=None, header=header,
                    channels={c: t.channels[c][s].copy() for c in columns})
            for t, s in zip(trials, cut, strict=True)
        ]  # fmt: skip
        chosen = plant.hydrodynamics["calibrated"]
        mass = float(np.diag(plant.mass_matrix())[i])
        begin = time.process_time()
        try:
            fit = fit_hydrodynamics(trials, vehicle, axes=[axis], known={axis: mass})
        except CalibrationError as error:
            print(f"  {seed} {axis} at {20 // every} Hz: {error}")
            wrote[axis] = False
            continue
        spent += time.process_time() - begin
        wrote[axis] = any(path.startswith((f"{SET}.linear", f"{SET}.quadratic")) for path in fit.changes)
        for name, matrix in (("d1", chosen.linear_damping), ("d2", chosen.quadratic_damping)):
            e = fit.estimates.get(f"{axis}.{name}/m_eff")
            if e is None:
                print(f"  {seed} {axis} at {20 // every} Hz: {fit.estimates[f'{axis}.{name}'].note}")
                continue
            found[e.name] = [e.estimate, *e.ci95, float(matrix[i, i]) / mass]
    return {"seed": seed, "rate": 20 // every, "estimates": found, "written": wrote, "seconds": spent}


def _by_axis(vehicle: Vehicle, trials: list[Trial]) -> dict[str, float]:
    values: dict[str, list[float]] = {}
    for row in replay(trials, vehicle).scores["calibrated"]:
        for axis, score in row.items():
            if axis in FITTED:
                values.setdefault(axis, []).append(math.inf if score.value is None else score.value)
    return {axis: float(np.median(found)) for axis, found in values.items()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=50)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--passive", action="store_true")
    parser.add_argument("--unequal", type=float, default=0.0)
    args = parser.parse_args()
    rows: list[dict[str, object]] = []
    if args.json and args.json.exists():
        rows = json.loads(args.json.read_text())
    done = {row["seed"] for row in rows}
    for seed in range(args.first, args.first + args.draws):
        if seed in done:
            continue
        begin = time.perf_counter()
        rows.append(draw_released(seed) if args.passive else draw(seed, args.unequal))
        scores = rows[-1].get("scores")
        shown = rows[-1].get("written") if scores is None else {
            a: f"{scores['calibrated'][a]:.3f} < {v:.3f}" for a, v in scores["file"].items()
        }  # fmt: skip
        print(seed, shown, f"{time.perf_counter() - begin:.0f} s", flush=True)
        if args.json:
            part = args.json.with_suffix(".part")
            part.write_text(json.dumps(rows))
            part.replace(args.json)
    if not args.passive:
        report_scores(rows)
    report_intervals(rows)


def report_scores(rows: list[dict]) -> None:
    """Print the number of draws that are better on every axis."""
    found = np.array(
        [
            [[r["scores"][w].get(a, math.nan) for a in FITTED] for w in ("calibrated", "file", "truth")]
            for r in rows
        ]
    )  # (draws, 3, axes)
    after, before, true = found.transpose(1, 0, 2)
    better, gain = after < before, before > GAIN * true
    print(f"better than the file on every fitted axis: {better.all(axis=1).sum()} of {len(rows)} draws")
    print(
        f"  where the file is {GAIN} times worse than the plant itself: {(better | ~gain).all(axis=1).sum()}"
    )
    print(f"axes better than the file: {better.sum()} of {better.size}; of those with something to gain "
          f"{(better & gain).sum()} of {gain.sum()}")  # fmt: skip
    spent = np.median([r["seconds"] for r in rows])
    print(
        f"worst loss on an axis: {np.nanmax(after / before) - 1.0:+.1%}, {spent:.0f} processor-seconds a fit"
    )
    print(f"more than 2 % worse than the file: {(after > 1.02 * before).sum()} axes")
    for axis, a, b, c in zip(FITTED, after.T, before.T, true.T, strict=True):
        print(f"  {axis:6s} NRMSE, median: calibrated {np.nanmedian(a):.3f}, file {np.nanmedian(b):.3f}, "
              f"plant itself {np.nanmedian(c):.3f}")  # fmt: skip


def report_intervals(rows: list[dict]) -> None:
    """Print how often drag is written, and how often intervals contain the true value."""
    for axis in sorted({axis for r in rows for axis in r.get("written", {})}):
        print(
            f"  {axis}: drag written in {np.mean([r['written'][axis] for r in rows]):.0%} of {len(rows)} draws"
        )
    names = sorted({name for r in rows for name in r["estimates"]})
    inside = []
    for name in names:
        e = np.array([r["estimates"][name] for r in rows if name in r["estimates"]])
        known = np.isfinite(e).all(axis=1)
        e = e[known]
        held = (e[:, 1] <= e[:, 3]) & (e[:, 3] <= e[:, 2])
        inside += held.tolist()
        ratio = np.median(e[:, 0] / e[:, 3])
        print(f"  {name:18s} holds the truth in {held.mean():6.1%} of {len(e)}, estimate / truth {ratio:.2f}")
    print(f"all intervals together: {np.mean(inside):.1%}")


if __name__ == "__main__":
    main()
