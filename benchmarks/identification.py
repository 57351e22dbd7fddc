"""Accuracy of identified hydrodynamics, from synthetic trials with known truth.

    python benchmarks/identification.py [PART ...] [--vehicle finsrov] [--repetitions 5] [--json FILE]

Parts:
    coverage    published levels, 50 Hz, the vehicle's sensors: errors, and coverage of 95 % intervals
    slow        5 Hz, wrench and velocity alone
    replay      half of the trials fitted, the other half replayed
    dive        a weak dive (10 and 20 % of the limits), then the dive that its fit designs, or the first one repeated
    published   trials simulated with FinsROV's published raw fits, and what the published noise permits

The fits start from a file whose hydrodynamics are wrong by a factor of two.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.identification.fit import Estimate, Fit
from finssim.identification.hydrodynamics import fit_hydrodynamics
from finssim.identification.prediction import replay
from finssim.identification.programme import Programme, alternating, programmes
from finssim.identification.simulation_error import fit_by_simulation
from finssim.identification.synthetic import Recording, record, simulate_programme, trials_of
from finssim.trials.trial import Trial
from finssim.vehicles import AXES, Vehicle, load_vehicle
from finssim.vehicles.vehicle import moved_to_origin

FOUR = "surge,sway,heave,yaw"

CHUNK = 10
"""Number of repetitions whose noise is drawn together."""

RAW_FITS = {
    "surge": (27.1447, 39.0736, 0.0),
    "sway": (40.6159, 52.3070, 0.0),
    "heave": (35.4644, 80.0968, 483.087),
    "yaw": (0.8369, 0.3003, 0.4776),
}
"""m_eff, d1, d2 of FinsROV's fits before any manual change."""


def blind(vehicle: Vehicle) -> Vehicle:
    """Return the vehicle with wrong hydrodynamics: added mass halved, damping doubled or half of it
    quadratic."""
    chosen = vehicle.hydrodynamics["calibrated"]
    d1, d2 = chosen.linear_damping, chosen.quadratic_damping
    return vehicle.replace(
        {
            "hydrodynamics.calibrated.added_mass": (0.5 * chosen.added_mass).tolist(),
            "hydrodynamics.calibrated.linear_damping": (2.0 * d1 + 0.01 * np.eye(6)).tolist(),
            "hydrodynamics.calibrated.quadratic_damping": (0.5 * d2 + 0.1 * np.diag(np.diag(d1))).tolist(),
        }
    )


def truth(vehicle: Vehicle) -> dict[str, float]:
    """Return the true value of every parameter that a fit may name, for a plant equal to the vehicle's file."""
    chosen = vehicle.hydrodynamics["calibrated"]
    mass = moved_to_origin(vehicle.mass_matrix(), -vehicle.body.center_of_gravity)
    arm = vehicle.body.center_of_buoyancy[2] - vehicle.body.center_of_gravity[2]
    out = {"buoyancy_excess": vehicle.buoyancy - vehicle.weight, "thrust_scale": 1.0}
    for i, axis in enumerate(AXES):
        out[f"{axis}.m_eff"] = float(mass[i, i])
        out[f"{axis}.added_mass"] = float(chosen.added_mass[i, i])
        out[f"{axis}.d1"] = float(chosen.linear_damping[i, i])
        out[f"{axis}.d2"] = float(chosen.quadratic_damping[i, i])
        if i != 2:
            out[f"{axis}.bias"] = 0.0
    out["roll.k"] = out["pitch.k"] = vehicle.buoyancy * arm
    return out


@dataclasses.dataclass
class Row:
    """Statistics of one parameter over all repetitions."""

    name: str
    true: float
    unit: str
    estimates: list[float] = dataclasses.field(default_factory=list)
    covered: list[bool] = dataclasses.field(default_factory=list)
    half_widths: list[float] = dataclasses.field(default_factory=list)
    identifiable: list[bool] = dataclasses.field(default_factory=list)
    note: str = ""

    def add(self, e: Estimate) -> None:
        """Add the estimate of one repetition."""
        self.identifiable.append(e.identifiable)
        self.note = e.note or self.note
        if math.isfinite(e.estimate):
            self.estimates.append(e.estimate)
        low, high = e.ci95
        if math.isfinite(low) and math.isfinite(high):
            self.covered.append(low <= self.true <= high)
            self.half_widths.append(0.5 * (high - low))

    def figures(self) -> dict[str, Any]:
        """Return the reported figures; errors are in per cent of the truth unless that is 0."""
        x = np.array(self.estimates)
        size = abs(self.true)
        relative = 100.0 / size if size > 0.0 else math.nan
        return {
            "true": self.true,
            "mean": _mean(x),
            "worst_error_percent": float(np.abs(x - self.true).max() * relative) if len(x) else math.nan,
            "bias_percent": (_mean(x) - self.true) * relative,
            "spread": float(x.std(ddof=1)) if len(x) > 1 else math.nan,
            "half_width": _mean(np.array(self.half_widths)),
            "coverage_percent": 100.0 * _mean(np.array(self.covered, dtype=float)),
            "identifiable_percent": 100.0 * _mean(np.array(self.identifiable, dtype=float)),
            "unit": self.unit,
            "note": self.note,
        }


def _mean(x: NDArray[np.float64]) -> float:
    return float(x.mean()) if len(x) else math.nan


def collect(fits: Iterable[Fit], true: dict[str, float]) -> dict[str, dict[str, Any]]:
    """Return the figures of every parameter with a known truth."""
    rows: dict[str, Row] = {}
    for fit in fits:
        for name, e in fit.estimates.items():
            if name in true:
                rows.setdefault(name, Row(name, true[name], e.unit)).add(e)
    return {name: row.figures() for name, row in rows.items()}


def copies(recording: Recording, count: int) -> Recording:
    """Repeat a motion in `count` times as many worlds."""
    fields = {f.name: getattr(recording, f.name) for f in dataclasses.fields(recording) if f.name != "step"}
    tiled = {name: np.tile(value, (1, count, 1)) for name, value in fields.items()}
    return Recording(step=recording.step, **tiled)


def measured_again(
    recording: Recording, plan: Sequence[Programme], vehicle: Vehicle, count: int, **arguments: Any
) -> Iterable[list[Trial]]:
    """Yield the trials of one motion, `count` times with other noise."""
    for first in range(0, count, CHUNK):
        n = min(CHUNK, count - first)
        trials = trials_of(copies(recording, n), list(plan) * n, vehicle, seed=1000 + first, **arguments)
        for i in range(n):
            yield trials[i * len(plan) : (i + 1) * len(plan)]


def coverage(
    vehicle: Vehicle, axes: str, repetitions: int, *, repeats: int = 1, **arguments: Any
) -> dict[str, Any]:
    """Return errors and coverage over repetitions of the noise."""
    plan = programmes(axes, vehicle, repeats=repeats)
    recording = record(plan, vehicle, seed=1)
    guess = blind(vehicle)
    start = time.perf_counter()
    fits = []
    for trials in measured_again(recording, plan, vehicle, repetitions, **arguments):
        fits.append(fit_by_simulation(trials, guess))
    return {
        "repetitions": repetitions,
        "seconds": time.perf_counter() - start,
        "parameters": collect(fits, truth(vehicle)),
        "findings": sorted({str(one) for fit in fits[:1] for one in fit.findings}),
    }


def held_out(vehicle: Vehicle, axes: str) -> dict[str, Any]:
    """Return the NRMSE of replayed trials at validation levels, with the fit of the published levels."""
    fitted = simulate_programme(programmes(axes, vehicle), vehicle, seed=1)
    kept = simulate_programme(programmes(axes, vehicle, kind="validation"), vehicle, seed=2)
    guess = blind(vehicle)
    fit = fit_by_simulation(fitted, guess)
    report = replay(kept, guess.replace(fit.changes), hydrodynamics=("calibrated",), seed=0)
    return report.as_json()


def second_dive(vehicle: Vehicle, axes: str, seed: int) -> dict[str, Any]:
    """Return the ratio of interval widths: after a second dive that the first one designed, over a repeated
    first dive."""
    chosen = _without_pulses(axes, vehicle).split(",")
    limit = dict(zip(AXES, vehicle.wrench_limits.tolist(), strict=True))
    plan = programmes(
        chosen, vehicle, levels={a: (0.1 * limit[a], 0.2 * limit[a]) for a in chosen}, coast=6.0
    )
    file, rate = blind(vehicle), 20.0
    first = simulate_programme(plan, vehicle, seed=seed, rate=rate)
    dive = fit_hydrodynamics(first, file, design=True).next_dive
    assert dive is not None
    legs = [alternating(leg, n + 1) for leg in dive.legs for n in range(leg.times)]
    again = simulate_programme(plan, vehicle, seed=100 + seed, rate=rate)
    seconds = {
        "repeated": [dataclasses.replace(t, name=f"{t.name}_again") for t in again],
        "designed": simulate_programme(legs, vehicle, seed=100 + seed, rate=rate),
    }
    found = {name: fit_hydrodynamics([*first, *second], file) for name, second in seconds.items()}
    widths = {
        name: float(np.diff(ends)[0] / np.diff(found["repeated"].intervals[name])[0])
        for name, ends in found["designed"].intervals.items()
        if not name.endswith(("added_mass", "bias")) and np.isfinite(found["repeated"].intervals[name]).all()
    }
    times = {f"{name}_s": sum(t.duration for t in second) for name, second in seconds.items()}
    return {"seed": seed, "median": float(np.median(list(widths.values()))), "widths": widths, **times}


def raw_fits(vehicle: Vehicle) -> Vehicle:
    """Return FinsROV with the raw fits of its own identification."""
    changes: dict[str, float] = {}
    for axis, (m_eff, d1, d2) in RAW_FITS.items():
        i = AXES.index(axis)
        rigid = vehicle.body.mass if i < 3 else vehicle.body.inertia[i - 3, i - 3]
        for key, value in (("added_mass", m_eff - rigid), ("linear_damping", d1), ("quadratic_damping", d2)):
            changes[f"hydrodynamics.calibrated.{key}.{i}.{i}"] = float(value)
    return vehicle.replace(changes)


def print_parameters(title: str, figures: dict[str, dict[str, Any]]) -> None:
    """Print one line for each parameter."""
    print(f"\n{title}")
    heads = ("parameter", "true", "mean", "worst %", "bias %", "spread", "±95 %", "cover %", "ident %")
    print("  {:<20}{:>11}{:>11}{:>9}{:>8}{:>10}{:>10}{:>9}{:>9}".format(*heads))
    keys = ("true", "mean", "worst_error_percent", "bias_percent", "spread", "half_width")
    for name, f in figures.items():
        values = [f[k] for k in keys] + [f["coverage_percent"], f["identifiable_percent"]]
        print(
            "  {:<20}{:>11.4g}{:>11.4g}{:>9.2f}{:>8.2f}{:>10.3g}{:>10.3g}{:>9.1f}{:>9.0f}".format(
                name, *values
            )
        )
        if f["note"]:
            print(f"    {f['note']}")


def main() -> None:
    """Run the requested parts, print tables, and write JSON."""
    parts = ("coverage", "slow", "replay", "dive", "published")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help="which parts; all if none")
    parser.add_argument("--vehicle", default="finsrov", help="name or file")
    parser.add_argument("--axes", default="all", help="axes, separated by commas")
    parser.add_argument("--repetitions", type=int, default=5, help="of the noise, or draws of a plant")
    parser.add_argument("--repeats", type=int, default=1, help="of every programme in a set of trials")
    parser.add_argument("--json", type=Path, help="file for the figures")
    given = parser.parse_args()
    if unknown := set(given.parts) - set(parts):
        parser.error(f"unknown part {', '.join(sorted(unknown))}; available: {', '.join(parts)}")
    vehicle, result = load_vehicle(given.vehicle), {}
    for part in given.parts or parts:
        start = time.perf_counter()
        result[part] = run(part, vehicle, given)
        print(f"  [{part}: {time.perf_counter() - start:.1f} s]")
    if given.json:
        given.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


def run(part: str, vehicle: Vehicle, given: argparse.Namespace) -> Any:
    """Measure and print one part."""
    if part == "coverage":
        out = coverage(vehicle, given.axes, given.repetitions, repeats=given.repeats)
        print_parameters(
            f"{vehicle.name}, 50 Hz, {given.repetitions} repetitions of the noise", out["parameters"]
        )
        return out
    if part == "slow":
        columns = ("u", "v", "w", "p", "q", "r")
        arguments = {"rate": 5.0, "columns": columns, "inputs": ("wrench",), "repeats": given.repeats}
        out = coverage(vehicle, _without_pulses(given.axes, vehicle), given.repetitions, **arguments)
        print_parameters(f"{vehicle.name}, 5 Hz, wrench and velocity", out["parameters"])
        return out
    if part == "replay":
        out = held_out(vehicle, given.axes)
        print(f"\n{vehicle.name}, held-out replay: NRMSE {out['aggregate']:.4f}")
        for axis, by_trial in out["nrmse"].items():
            scores = [x for x in by_trial.values() if x is not None]
            print(f"  {axis:<8} mean {np.mean(scores):.4f}, worst trial {max(scores):.4f}")
        return out
    if part == "dive":
        out = [second_dive(vehicle, given.axes, seed) for seed in range(1, given.repetitions + 1)]
        for row in out:
            print(f"  designed {row['designed_s']:.0f} s, repeated {row['repeated_s']:.0f} s: widths, median "
                  f"{row['median']:.2f}, {', '.join(f'{n} {x:.2f}' for n, x in row['widths'].items())}")  # fmt: skip
        return out
    raw = raw_fits(load_vehicle("finsrov"))
    out = {"raw": coverage(raw, FOUR, given.repetitions)}
    print_parameters("FinsROV's raw fits", out["raw"]["parameters"])
    out["noise"] = coverage(load_vehicle("finsrov"), "all", given.repetitions, noise="published")
    print_parameters("FinsROV's profile under its published noise", out["noise"]["parameters"])
    return out


def _without_pulses(axes: str, vehicle: Vehicle) -> str:
    """Return the axes without roll and pitch, which oscillate at more than 1 Hz and are not resolved at 5 Hz."""
    chosen = vehicle.controlled_axes if axes == "all" else axes.split(",")
    return ",".join(a for a in chosen if a not in ("roll", "pitch"))


if __name__ == "__main__":
    main()
