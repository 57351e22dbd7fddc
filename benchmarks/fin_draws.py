"""Accuracy and interval coverage of fits of drawn vehicles with fins, from manoeuvres under their autopilot.

    python benchmarks/fin_draws.py [--vehicle remus100] [--draws 10] [--first 0] [--json FILE]

Every draw is the vehicle with its own added mass, drag and lift slope of the fins (factors of about 1.2 in either
direction), run through the manoeuvres by the autopilot of its file, and measured with noise and bias of its
gyroscopes, a velocity to 1 cm/s (DVL) and an attitude to 5 mrad. The fit starts from the file. Draws that the
autopilot cannot stabilise are omitted and counted. With --json, every finished draw is written to the file, and draws
in it are not repeated.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from finssim.identification.manoeuvres import manoeuvres, simulate_manoeuvres
from finssim.identification.simulation_error import fit_by_simulation
from finssim.studies.demo_course import drawn_body
from finssim.trials.findings import CalibrationError
from finssim.vehicles import AXES, Vehicle, load_vehicle

FITTED = ("surge", "sway", "heave", "pitch", "yaw")
RATE = 20.0
"""Rows of the trials [Hz]."""
LIMIT = 0.1
"""Required relative error [-]."""


def draw(vehicle: Vehicle, number: int) -> dict:
    """Fit one draw; return parameter -> true value, estimate and interval."""
    start = time.process_time()
    truth, slope = drawn_body(vehicle, number)
    try:
        trials = simulate_manoeuvres(manoeuvres(vehicle), vehicle, truth=truth, seed=number, rate=RATE)
    except CalibrationError as error:
        return {"draw": number, "lost": str(error)}
    fit = fit_by_simulation(trials, vehicle, axes=FITTED, estimate=("fin.lift_slope",))
    M, chosen, rows = truth.mass_matrix(), truth.hydrodynamics["calibrated"], {}

    def compare(name: str, value: float) -> None:
        estimate = fit.estimates.get(name)
        if estimate is not None:
            rows[name] = [value, estimate.estimate, *estimate.ci95]

    compare("fin.lift_slope", slope)
    compare("surge.d2", float(chosen.axis_drag[0]))
    for axis in FITTED[1:]:
        i = AXES.index(axis)
        compare(f"{axis}.m_eff", float(M[i, i]))
        compare(f"{axis}.d2", float(chosen.quadratic_damping[i, i]))
    found = sorted({one.code for one in fit.findings})
    return {"draw": number, "seconds": time.process_time() - start, "numbers": rows, "findings": found}


def summary(draws: list[dict]) -> None:
    """Print errors and interval coverage of the estimates."""
    lost = [d["draw"] for d in draws if "lost" in d]
    print(f"not held by the autopilot: {lost or 'none'}")
    draws = [d for d in draws if "lost" not in d]
    apart = [d["draw"] for d in draws if "not_converged" in d.get("findings", ())]
    print(f"not converged, as the fit says: {apart or 'none'}")
    print(f"{len(draws)} draws, {np.mean([d['seconds'] for d in draws]):.0f} processor-seconds each")
    print(f"{'':16s} {'median |error|':>14s} {'within 10 %':>12s} {'in interval':>12s} {'half width':>11s}")
    for name in draws[0]["numbers"]:
        rows = np.array([d["numbers"][name] for d in draws if name in d["numbers"]])
        true, found, low, high = rows.T
        error = np.abs(found / true - 1.0)
        inside = np.mean((low <= true) & (true <= high))
        width = np.median((high - low) / 2.0 / true)
        print(
            f"{name:16s} {np.median(error):14.3f} {np.mean(error < LIMIT):12.0%} {inside:12.1%} {width:11.3f}"
        )


def main() -> None:
    """Run the missing draws."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vehicle", default="remus100")
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    vehicle = load_vehicle(options.vehicle)
    done = (
        json.loads(options.json.read_text(encoding="utf-8")) if options.json and options.json.exists() else []
    )
    have = {entry["draw"] for entry in done}
    for number in range(options.first, options.first + options.draws):
        if number in have:
            continue
        done.append(draw(vehicle, number))
        print(f"draw {number}: {done[-1].get('lost') or round(done[-1]['seconds'])}", flush=True)
        if options.json:
            options.json.write_text(json.dumps(done, indent=1) + "\n", encoding="utf-8")
    summary(done)


if __name__ == "__main__":
    main()
