"""False alarms of `trials check` on correct random logs, and its detection rate on logs with one known fault.

    python benchmarks/check_alarms.py [--logs 1000] [--faulty 100] [--out alarms.jsonl]

A log is a run of a random catalogue vehicle whose plant differs from its file, pushed along random axes at 0.5 to 60 %
of its wrench limits or drifting without thrust. The simulator moves it, and sensors with random noise, rate and
columns measure it. No finding may refuse such a log or ask for care, except those that are true of it (`TRUE`). The
first logs are then corrupted by one fault at a time; a fault counts as detected if a finding appears that the correct
log does not have. Results are stored by log in the file, and the next call continues there.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from finssim.identification.programme import Programme
from finssim.identification.synthetic import NoiseProfile, Recording, record, trials_of
from finssim.sim import Simulator
from finssim.trials.check import check_trials
from finssim.trials.trial import TAU, Header, Trial
from finssim.vehicles import Vehicle, load_vehicle

VEHICLES = ("bluerov2", "bluerov2_einarsson", "bluerov2_heavy", "bluerov2_heavy_morgan", "finsrov", "lauv", "remus100",
            "rexrov", "warpauv")  # fmt: skip
TRUE = {"slow", "saturated", "in_dead_zone", "command_beyond", "nothing_excited", "nothing_measured", "voltage_missing",
        "pulses_dead", "inputs_zero", }  # fmt: skip
GROUP = 10
"""Number of logs of one vehicle that are simulated together."""
COMMAND_RATE = 50.0
RATES = (5.0, 10.0, 20.0, 25.0, 50.0, 100.0)
GROUPS = {
    "velocity": ("u", "v", "w"),
    "rates": ("p", "q", "r"),
    "acceleration": ("ax", "ay", "az"),
    "position": ("x", "y", "z"),
    "depth": ("depth",),
}
ATTITUDES = (("roll", "pitch", "yaw"), ("qx", "qy", "qz", "qw"), ("yaw",), ("roll", "pitch"), ())
PLANTS = ("M_A", "D1", "D2", "gain")


def programme(vehicle: Vehicle, rng: np.random.Generator, name: str) -> Programme:
    """Return a programme of pushes of random duration, height and sign, or sums of sines, along one to three
    axes; often with a coast."""
    seconds = float(rng.uniform(10.0, 40.0))
    n = round(seconds * COMMAND_RATE)
    tau, t = np.zeros((n, 6)), np.arange(n) / COMMAND_RATE
    driven = np.flatnonzero(vehicle.wrench_limits > 0.0)
    for i in rng.choice(driven, min(len(driven), int(rng.integers(1, 4))), replace=False):
        level = 10.0 ** rng.uniform(-2.3, -0.2) * vehicle.wrench_limits[i]
        if rng.random() < 0.3:
            waves = [np.sin(2.0 * np.pi * (rng.uniform(0.05, 0.8) * t + rng.random())) for _ in range(4)]
            tau[:, i] = level * np.mean(waves, axis=0)
            continue
        at, one_sided = rng.uniform(0.5, 3.0), rng.random() < 0.2
        while at < seconds:
            length = 10.0 ** rng.uniform(-0.2, 0.9)
            height = 0.0 if rng.random() < 0.25 else rng.uniform(0.5, 1.0)
            height *= 1.0 if one_sided else rng.choice([-1.0, 1.0])
            tau[round(at * COMMAND_RATE) : round((at + length) * COMMAND_RATE), i] = height * level
            at += length
    tau[round(rng.uniform(0.6, 1.3) * n) :] = 0.0
    return Programme(name=name, axes=(), rate=COMMAND_RATE, tau_desired=tau, phase=np.full(n, ""))


def noise(rng: np.random.Generator) -> NoiseProfile:
    """Draw standard deviations over a wide range, or, half of the time, take those of the vehicle's IMU and
    pressure sensor."""
    spread = {
        "velocity_std": (0.001, 0.05), "attitude_std": (0.0005, 0.03), "yaw_std": (0.001, 0.06),
        "position_std": (0.001, 0.05), "depth_std": (0.001, 0.05), "gyro_std": (0.0005, 0.05), "accel_std": (0.01, 0.5),
    }  # fmt: skip
    values = {name: float(np.exp(rng.uniform(*np.log(limits)))) for name, limits in spread.items()}
    window = float(rng.uniform(0.4, 1.5)) if rng.random() < 0.25 else None
    return NoiseProfile(own_sensors=bool(rng.random() < 0.5), velocity_window=window, **values)


def plants(vehicle: Vehicle, worlds: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Draw added mass, damping and thrust of each world's plant: the file's, times a random factor."""
    truth = Simulator(vehicle, worlds=1).plant.fields
    drawn = {}
    for name in PLANTS:
        nominal = truth[name].numpy()[0, 0].astype(float)
        factor = np.exp((0.1 if name == "gain" else 0.3) * rng.standard_normal(worlds))
        drawn[name] = factor.reshape(-1, *[1] * nominal.ndim) * nominal
    return drawn


def world(recording: Recording, w: int) -> Recording:
    """Return the recording of one world."""
    parts = {f.name: getattr(recording, f.name)[:, w : w + 1] for f in fields(recording) if f.name != "step"}
    return replace(recording, **parts)


def measured(
    recording: Recording, plan: Programme, vehicle: Vehicle, rng: np.random.Generator, seed: int
) -> Trial:
    """Return a log as random equipment would write it: columns, rates, inputs."""
    rate = float(rng.choice(RATES))
    chosen = {group: columns for group, columns in GROUPS.items() if rng.random() < 0.75}
    if not {"velocity", "position", "rates"} & chosen.keys():
        chosen["velocity"] = GROUPS["velocity"]
    chosen["attitude"] = ATTITUDES[rng.choice(len(ATTITUDES), p=(0.5, 0.15, 0.1, 0.1, 0.15))]
    kinds = ["rpm", "wrench", "force", "command"]
    kinds += ["pwm"] if all(t.esc for t in vehicle.thrusters.values()) else []
    kind = str(rng.choice(kinds))
    (trial,) = trials_of(
        recording, [plan], vehicle, noise=noise(rng), seed=seed, rate=rate, inputs=(kind,),
        columns=[column for columns in chosen.values() for column in columns],
    )  # fmt: skip
    channels = dict(trial.channels)
    for columns in chosen.values():
        every = int(rng.choice([1, 1, 2, 5])) if rate > 10.0 else 1
        for column in columns:
            channels[column] = np.where(np.arange(len(trial.t)) % every, np.nan, channels[column])
    header = Header(vehicle=None, inputs=trial.header.inputs, voltage=16.0 if kind == "pwm" else None)
    quiet = np.abs(plan.tau_desired).max(axis=1) > 0.0
    last = float(np.flatnonzero(quiet)[-1]) / COMMAND_RATE + 1.5 if quiet.any() else 0.0
    trial = replace(trial, channels=channels, header=header, phase=None)
    if trial.t[-1] - last > 4.0 and rng.random() < 0.5:  # the drift after the pushes alone
        rows = trial.t > last
        kept = {c: v[rows] for c, v in channels.items() if not c.startswith(kind) and not c.startswith("tau")}
        trial = replace(trial, t=trial.t[rows], channels=kept, header=Header(passive=True))
    return trial


def logs(group: int) -> tuple[Vehicle, list[Trial]]:
    """Return the correct logs of one group."""
    rng = np.random.default_rng([32, group])
    vehicle = load_vehicle(VEHICLES[group % len(VEHICLES)])
    plans = [programme(vehicle, rng, f"log_{group * GROUP + k}") for k in range(GROUP)]
    recording = record(plans, vehicle, seed=group, plant=plants(vehicle, GROUP, rng), depth=30.0)
    return vehicle, [
        measured(world(recording, w), plan, vehicle, rng, 1000 * group + w) for w, plan in enumerate(plans)
    ]


def times(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda y: factor * y


def later(t: np.ndarray, seconds: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that shifts values as late stamps of a stream do."""

    def shifted(y: np.ndarray) -> np.ndarray:
        known = np.isfinite(y)
        moved = np.interp(t, t[known] + seconds, y[known])
        return np.where(known, moved, np.nan)

    return shifted


def faults(trial: Trial) -> dict[str, dict[str, Callable[[np.ndarray], np.ndarray]]]:
    """Return fault -> column -> function that corrupts it, for the columns that the log has."""
    turn, deg = times(-1.0), times(57.29578)
    wanted: dict[str, dict[str, Callable[[np.ndarray], np.ndarray]]] = {}
    for name in (*"uvwpqr", "roll", "pitch", "yaw", "ax", "ay", "az", "x", "y", "z", "depth"):
        wanted[f"{name} has the other sign"] = {name: turn}
    wanted["inputs have the other sign"] = {
        c: turn for c in trial.channels if c in TAU or c.startswith(("rpm_", "force_", "command_"))
    }
    wanted["acceleration has the other sign"] = dict.fromkeys(("ax", "ay", "az"), turn)
    for name in ("p", "q", "r", "roll", "pitch", "yaw"):
        wanted[f"{name} in degrees"] = {name: deg}
    wanted["acceleration in g"] = dict.fromkeys(("ax", "ay", "az"), times(1.0 / 9.80665))
    wanted["velocity in cm/s"] = dict.fromkeys("uvw", times(100.0))
    wanted["depth in cm"] = {"depth": times(100.0)}
    wanted["depth in ft"] = {"depth": times(1.0 / 0.3048)}
    wanted["z in mm"] = {"z": times(1000.0)}
    wanted["heading turned by 90 degrees"] = {"yaw": lambda y: y + 0.5 * np.pi}
    for group in ("velocity", "rates"):
        wanted[f"{group} 0.5 s late"] = {c: later(trial.t, 0.5) for c in GROUPS[group]}
    return {
        name: changes
        for name, changes in wanted.items()
        if changes and all(column in trial.channels and trial.has(column) for column in changes)
    }


def alarms(trial: Trial, vehicle: Vehicle) -> list[str]:
    """Return findings that refuse the log or ask for care, except those that are true of a correct log."""
    (report,) = check_trials([trial], vehicle)
    return [
        f"{f.severity}: {f.code}: {f}" for f in report.findings if f.severity != "note" and f.code not in TRUE
    ]


def examine(group: int, logged: int, faulty: int) -> list[dict]:
    """Return the alarms of each correct log of a group, and for the first logs the detected faults."""
    vehicle, trials = logs(group)
    rows = []
    for k, trial in enumerate(trials):
        index = group * GROUP + k
        if index >= logged:
            continue
        found = alarms(trial, vehicle)
        row: dict = {"log": index, "vehicle": vehicle.name, "alarms": found, "faults": {}}
        codes = {text.split(": ")[1] for text in found}
        for name, changes in faults(trial).items() if index < faulty else ():
            spoilt = {c: changes[c](v) if c in changes else v for c, v in trial.channels.items()}
            new = {text.split(": ")[1] for text in alarms(replace(trial, channels=spoilt), vehicle)}
            row["faults"][name] = sorted(new - codes)
        rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--logs", type=int, default=1000)
    parser.add_argument(
        "--faulty", type=int, default=100, help="logs that are also spoilt by one fault at a time"
    )
    parser.add_argument(
        "--first", type=int, default=0, help="number of the first log; thresholds were chosen on 0 to 999"
    )
    parser.add_argument("--out", type=Path, default=Path("alarms.jsonl"))
    args = parser.parse_args()
    rows = [json.loads(line) for line in args.out.read_text().splitlines()] if args.out.is_file() else []
    done = {row["log"] // GROUP for row in rows}
    last = args.first + args.logs
    left = [group for group in range(args.first // GROUP, -(-last // GROUP)) if group not in done]
    start = time.monotonic()
    for number, group in enumerate(left, 1):
        new = examine(group, last, args.faulty)
        rows += new
        with args.out.open("a", encoding="utf-8") as file:
            file.writelines(json.dumps(row) + "\n" for row in new)
        spent = time.monotonic() - start
        bad = sum(bool(row["alarms"]) for row in rows)
        print(f"{len(rows)} of {args.logs} logs, {bad} with a false alarm, "
              f"{spent * (len(left) - number) / number:.0f} s left", flush=True)  # fmt: skip
    report([row for row in rows if args.first <= row["log"] < last])


def report(rows: list[dict]) -> None:
    """Print false alarms by finding, and the detection rate of each fault."""
    bad = [row for row in rows if row["alarms"]]
    print(f"\nfalse alarms: {len(bad)} of {len(rows)} correct logs ({len(bad) / len(rows):.2%})")
    refused = [row for row in bad if any(text.startswith("refused") for text in row["alarms"])]
    print(f"  refused: {len(refused)}")
    counts = Counter(code for row in bad for code in {text.split(": ")[1] for text in row["alarms"]})
    for code, count in counts.most_common():
        print(f"  {code}: {count}")
    noticed: dict[str, list[bool]] = {}
    for row in rows:
        for name, codes in row["faults"].items():
            noticed.setdefault(name, []).append(bool(codes))
    print("\nfaults noticed:")
    for name, seen in noticed.items():
        print(f"  {name:34s} {np.mean(seen):6.1%} of {len(seen)}")
    every = [one for seen in noticed.values() for one in seen]
    if every:
        print(f"  all {sum(every)} of {len(every)}")


if __name__ == "__main__":
    main()
