"""Speed of the simulation on this machine: `python benchmarks/engine.py [--json] [--device cuda]`.

Rates of physics, of the environment of T1 and of hull triangles, and the ratio to MuJoCo stepping one free body.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from finssim.cli.command_line import run_script
from finssim.core.progress import Progress
from finssim.core.provenance import provenance
from finssim.core.system import peak_memory, processor_name
from finssim.evaluation.tables import Table
from finssim.sim import Simulator
from finssim.sim.launch import default_threads
from finssim.sim.simulator import find_device
from finssim.tasks import Environment, StationKeeping

SECONDS = 1.0
"""Time for which each figure is measured [s]; the best round counts, since other load only slows a round down."""
ROUNDS = 10
PHYSICS_SUBSTEPS = 4
PHYSICS_STEP = 0.04
MODELS = ("calibrated", "simplified", "mesh")
ACTIONS = ("thruster8", "wrench6")
WORLDS = (1, 4096)
MEMORY_WORLDS = 16384

MUJOCO_BODY = """<mujoco><option timestep="0.01" integrator="Euler"/><worldbody><body><freejoint/>
<inertial pos="0 0 0" mass="12" diaginertia="0.13 0.23 0.25"/></body></worldbody></mujoco>"""


def best_rate(step: Callable[[], object], work: float, finish: Callable[[], object] = lambda: None) -> float:
    """Return the work per second of wall time in the best of several rounds, which last `SECONDS` in total.

    Args:
        step: Function that is timed; called often enough to fill the time.
        work: Work that one call does.
        finish: Waits for the work that steps have started: a GPU continues after a step returns.
    """
    step()
    finish()
    start = time.perf_counter()
    step()
    finish()
    calls = max(1, round(SECONDS / ROUNDS / max(time.perf_counter() - start, 1e-7)))
    best = 0.0
    for _ in range(ROUNDS):
        start = time.perf_counter()
        for _ in range(calls):
            step()
        finish()
        best = max(best, calls * work / (time.perf_counter() - start))
    return best


def physics_rate(model: str, worlds: int, threads: int | None = None, device: str = "cpu") -> float:
    """Measure control steps per second: FinsROV, 6x6 matrices, thruster lag and delay, 4 substeps, random thrust."""
    simulator = Simulator(
        "finsrov",
        worlds=worlds,
        hydrodynamics=model,
        control_step=PHYSICS_STEP,
        substeps=PHYSICS_SUBSTEPS,
        threads=threads,
        device=device,
    )
    simulator.place(position=(0.0, 0.0, -50.0))
    simulator.set_thrust(np.random.default_rng(0).uniform(-5.0, 5.0, (worlds, 1, 8)))
    return best_rate(simulator.step, worlds, finish=lambda: wp.synchronize_device(simulator.device))


def environment_rate(action: str, worlds: int, threads: int | None = None, device: str = "cpu") -> float:
    """Measure T1 steps per second at 10 Hz: physics, allocation, observation, reward and reset included."""
    environment = Environment(StationKeeping(), worlds=worlds, action=action, threads=threads, device=device)
    random = np.random.default_rng(0)
    actions = [
        random.uniform(-1.0, 1.0, (worlds, environment.action_size)).astype(np.float32) for _ in range(8)
    ]
    turn = iter(range(10**9))
    return best_rate(lambda: environment.step(actions[next(turn) % 8]), worlds)


def faces_rate(worlds: int = 1024) -> float:
    """Measure hull triangles per second and core with the mesh model: one thread, fully submerged."""
    simulator = Simulator("finsrov", hydrodynamics="mesh")
    faces = len(simulator.vehicles[0].hull_mesh()[1])
    return physics_rate("mesh", worlds, threads=1) * PHYSICS_SUBSTEPS * faces


def mujoco_rate() -> float | None:
    """Measure steps per second of MuJoCo with one free body; None if it is not installed."""
    try:
        import mujoco
    except ImportError:
        return None
    model = mujoco.MjModel.from_xml_string(MUJOCO_BODY)
    data = mujoco.MjData(model)

    def thousand() -> None:
        for _ in range(1000):
            mujoco.mj_step(model, data)

    return best_rate(thousand, 1000.0)


def memory_mb(worlds: int) -> float:
    """Measure the peak resident memory of a process that runs T1 in `worlds` worlds [MB], interpreter included."""
    done = subprocess.run(
        [sys.executable, "-c", f"from engine import use_memory; use_memory({worlds})"],
        cwd=Path(__file__).parent, capture_output=True, encoding="utf-8", check=True,
    )  # fmt: skip
    return float(done.stdout.split()[-1])


def use_memory(worlds: int) -> None:
    """Step T1 in `worlds` worlds, and print the peak memory of this process [MB]."""
    environment = Environment(StationKeeping(), worlds=worlds)
    action = np.zeros((worlds, environment.action_size), dtype=np.float32)
    for _ in range(3):
        environment.step(action)
    print(peak_memory())


def machine() -> dict[str, Any]:
    """Describe the machine: processor, threads, load and versions."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {"processor": processor_name(), "threads": default_threads(), "load_1min": load, **provenance()}


def bench(*, device: str = "cpu", progress: Progress = lambda part, text: None) -> dict[str, Any]:
    """Measure this machine's speed: physics steps/s, environment steps/s, mesh faces/s.

    Example: python benchmarks/engine.py --json > engine.json

    Args:
        device (DEVICE): Compute device: cpu or cuda.
        progress: Receives the completed fraction and the next figure.
    """
    find_device(device)  # refuses one that is not there before anything is measured
    plan: dict[tuple[str, str], Callable[[], float | None]] = {
        ("physics", f"{model}/{worlds}"): partial(physics_rate, model, worlds, device=device)
        for model in MODELS
        for worlds in WORLDS
    }
    single_core = f"calibrated/{WORLDS[-1]}/1 thread"
    plan["physics", single_core] = partial(physics_rate, "calibrated", WORLDS[-1], threads=1)
    for action in ACTIONS:
        for worlds in WORLDS:
            plan["T1", f"{action}/{worlds}"] = partial(environment_rate, action, worlds, device=device)
    plan["faces", ""], plan["MuJoCo", ""] = faces_rate, mujoco_rate
    plan["memory", ""] = partial(memory_mb, MEMORY_WORLDS)
    figures: dict[tuple[str, str], Any] = {}
    for (kind, name), figure in plan.items():
        progress(len(figures) / len(plan), f"{kind} {name}".strip())
        figures[kind, name] = figure()
    physics, reference = figures["physics", f"calibrated/{WORLDS[-1]}"], figures["MuJoCo", ""]
    return {
        "physics_steps_per_s": {name: rate for (kind, name), rate in figures.items() if kind == "physics"},
        "env_steps_per_s": {name: rate for (kind, name), rate in figures.items() if kind == "T1"},
        "faces_per_s": figures["faces", ""],
        "single_step_us": 1e6 / figures["physics", "calibrated/1"],
        "mujoco_steps_per_s": reference,
        "physics_substeps_over_mujoco_steps": reference and PHYSICS_SUBSTEPS * physics / reference,
        f"memory_mb/{MEMORY_WORLDS}": figures["memory", ""],
        "device": device,
        "machine": machine(),
    }


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """Return the rates of this machine as a table."""
    rates = {
        **{f"physics, {name}": rate for name, rate in result["physics_steps_per_s"].items()},
        **{f"T1, {name}": rate for name, rate in result["env_steps_per_s"].items()},
        "hull triangles, one core": result["faces_per_s"],
        "MuJoCo, one free body": result["mujoco_steps_per_s"],
    }
    ratio, on = result["physics_substeps_over_mujoco_steps"], result["machine"]
    table = Table(
        title="steps per second",
        heads=["", "per second"],
        rows=[[name, f"{rate:,.0f}"] for name, rate in rates.items() if rate],
        note=f"one step from Python {result['single_step_us']:.1f} us; {MEMORY_WORLDS} worlds "
        f"{result[f'memory_mb/{MEMORY_WORLDS}']:.0f} MB"
        + (f"; batched physics substeps over MuJoCo steps: {ratio:.0f}" if ratio else "")
        + f"; on {on['processor']}, {on['threads']} threads, load {on['load_1min']}",
    )
    return [table]


if __name__ == "__main__":
    run_script("__main__:bench")
