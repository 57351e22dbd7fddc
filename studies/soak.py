"""Memory use of the robot's software over hours of vehicle time: `python -m studies.soak --hours 20 --out soak`."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from finssim.cli.command_line import run_script
from finssim.core.progress import Progress
from finssim.core.provenance import provenance
from finssim.core.system import peak_memory
from finssim.evaluation.campaign import write_json
from finssim.evaluation.tables import Table
from finssim.pool.plan import make_plan
from finssim.robot.goals import station_of
from finssim.robot.lockstep import run_lockstep
from finssim.robot.perception import Perception
from finssim.robot.pilots import make_pilot
from finssim.robot.runtime import Runtime
from finssim.vehicles import load_vehicle

Array = NDArray[np.float64]

SAMPLED = 10.0
"""Interval of samples in vehicle time [s]."""
WARM = 0.25
"""Fraction at the start of a run that is ignored, since caches fill [-]."""
FLAT = 1.0
"""Growth per hour of vehicle time below which memory is flat [MiB/h]: 20 MiB in 20 hours."""
GOAL = "0,0,-0.5,0"
HEADS = ("vehicle_s", "wall_s", "memory_mib", "error_m", "state")


def soak(
    *,
    out: Path,
    hours: Annotated[float, (0.001, None)] = 20.0,
    seed: int = 1,
    severity: str = "realistic",
    vehicle: str = "finsrov",
    progress: Progress = lambda part, text: None,
) -> dict[str, Any]:
    """Keep a station for hours in lock-step and watch the memory [MiB]. Ctrl-C ends it with the results so far.

    Exit status 3: the memory grew, or the bridge stopped the vehicle.

    Example: python -m studies.soak --hours 20 --out soak

    Args:
        out (DIR): Directory for the result and the samples.
        hours: Vehicle time to keep a station [h].
        seed: Seed of every random number; equal seeds give equal results.
        severity (WORD): Deviation of the pools from the vehicle file: nominal, realistic or hard.
        vehicle (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file.
        progress: Receives the completed fraction and the state.

    Returns:
        Content of `soak.json`: `verdict`, `slope_mib_per_h`, first and last memory [MiB], errors [m], and totals.
    """
    duration, folder = 3600.0 * hours, Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    body, station = load_vehicle(vehicle), station_of(GOAL)
    plan = make_plan(body, str(seed), severity, camera="corners", seed=seed)  # type: ignore[arg-type]
    pool, site = plan.standing(station, seed=seed), plan.calibrated
    runtime = Runtime(body, Perception(body, site), make_pilot("pid", body), station, arm=True)
    began = time.perf_counter()
    samples: list[tuple[float, ...]] = []
    with (folder / "soak.csv").open("w", buffering=1, encoding="utf-8") as file:  # a line at a time
        print(*HEADS, sep=",", file=file)

        def sample(runtime: Runtime) -> None:
            """Write a row of the table every `SAMPLED` seconds of vehicle time."""
            if pool.time < len(samples) * SAMPLED:
                return
            error = float(np.linalg.norm(pool.plant.position - runtime.guide.at(0.0).position))
            row = (pool.time, time.perf_counter() - began, memory_mib(), error)
            samples.append(row)
            print(*(f"{value:.4f}" for value in row), runtime.bridge.state, sep=",", file=file)
            text = f"{row[0] / 3600.0:.2f} h, {row[2]:.1f} MiB, {runtime.bridge.state}"
            progress(min(pool.time / duration, 1.0), text)

        run_lockstep(
            runtime, pool, duration, gentle=True, show=sample, until=lambda r: r.bridge.state == "fault"
        )
    took = time.perf_counter() - began
    rows = np.array(samples, float)
    result = {
        "experiment": "soak",
        "vehicle_h": pool.time / 3600.0,
        "wall_s": took,
        "times_real_time": pool.time / took,
        **verdict(rows[:, 0], rows[:, 2]),
        "error_rms_m": float(np.sqrt(np.mean(rows[1:, 3] ** 2))) if len(rows) > 1 else None,
        "error_max_m": float(rows[1:, 3].max()) if len(rows) > 1 else None,
        "faults": [event.text for event in runtime.counters.events if event.kind == "fault"],
        "missed_decisions": runtime.counters.missed,
        "decisions": runtime.counters.decisions,
        "fixes": runtime.counters.fixes,
        "severity": severity,
        "seed": seed,
        "provenance": provenance(),
    }
    result["ok"] = result["verdict"] != "grows" and not result["faults"]
    write_json(folder / "soak.json", result)
    return result


def verdict(vehicle_s: Array, memory: Array) -> dict[str, Any]:
    """Return a verdict on whether memory is flat, from its least-squares slope after the warm-up.

    Args:
        vehicle_s: Vehicle time of each sample [s], (k,).
        memory: Memory of each sample [MiB], (k,).

    Returns:
        `verdict`: flat, grows, or too short to tell; `slope_mib_per_h`, None if too short; `first_mib`, `last_mib`.
    """
    selected = vehicle_s >= vehicle_s[-1] * WARM
    ends = {"first_mib": float(memory[0]), "last_mib": float(memory[-1])}
    if selected.sum() < 10:
        return {"verdict": "too short to tell", "slope_mib_per_h": None, **ends}
    slope = 3600.0 * float(np.polyfit(vehicle_s[selected], memory[selected], 1)[0])
    return {"verdict": "flat" if slope < FLAT else "grows", "slope_mib_per_h": slope, **ends}


def memory_mib() -> float:
    """Return the memory that this process uses now [MiB], or its peak if the system does not report it."""
    try:
        # statm may lag by tens of MiB on a machine with many processors.
        rollup = Path("/proc/self/smaps_rollup").read_text(encoding="ascii")
        return int(re.search(r"^Rss:\s+(\d+) kB", rollup, re.MULTILINE)[1]) / 1024.0  # type: ignore[index]
    except OSError:
        return peak_memory()


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """Return sentences about duration, speed, memory and vehicle."""
    slope = result["slope_mib_per_h"]
    grown = "" if slope is None else f", {slope:+.2f} MiB per hour of vehicle time"
    rms = result["error_rms_m"]
    lines = [
        f"{result['vehicle_h']:.2f} h of vehicle time in {result['wall_s'] / 60.0:.1f} min, "
        f"{result['times_real_time']:.1f} times real time",
        f"memory: {result['verdict']}{grown}; {result['first_mib']:.1f} MiB at the start, "
        f"{result['last_mib']:.1f} at the end",
        f"off the station: rms {math.nan if rms is None else 100.0 * rms:.1f} cm; "
        f"faults: {'; '.join(result['faults']) or 'none'}; "
        f"decisions missed: {result['missed_decisions']} of {result['decisions']}",
    ]
    return [Table(title="soak", sentences=lines)]


if __name__ == "__main__":
    run_script("studies.soak:soak")
