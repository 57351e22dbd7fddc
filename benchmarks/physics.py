"""Accuracy and cost of the physics by integrator and number of physics steps, on one core.

    python benchmarks/physics.py            # both tables; minutes
    python benchmarks/physics.py accuracy
    python benchmarks/physics.py speed

Times are processor-seconds, the best of ten rounds, beside MuJoCo stepping one free body in the same run. Errors are of
positions after 2 s of random commands at 70 % of the limits, drawn anew every 0.1 s, against RK4 in steps of 1 ms.
"""

import argparse
import itertools
import time
from collections.abc import Callable

import mujoco
import numpy as np
import warp as wp

from engine import MUJOCO_BODY
from finssim.sim import Simulator
from finssim.tasks import Environment, StationKeeping

VEHICLES = ("finsrov", "bluerov2_heavy", "bluerov2")
WORLDS = 4096
ROUNDS = 10
SECONDS = 0.2


def positions(name: str, integrator: str, substeps: int, worlds: int = 256) -> np.ndarray:
    """Return the positions of the vehicles after 2 s of random commands, (worlds, 3) [m]."""
    random = np.random.default_rng(0)
    simulator = Simulator(name, worlds=worlds, substeps=substeps, integrator=integrator, threads=1)
    lower, upper = simulator.vehicles[0].force_limits
    q = random.normal(size=(worlds, 1, 4)) * [0.1, 0.1, 1.0, 1.0]
    simulator.place((0.0, 0.0, -5.0), q)
    for _ in range(20):
        simulator.set_thrust(0.7 * random.uniform(lower, upper, (worlds, 1, len(lower))))
        simulator.step()
    return simulator.numpy("position")[:, 0].astype(float)


def accuracy() -> None:
    """Print the root mean square error and the largest error, by vehicle and scheme."""
    print("position error after 2 s [mm], RMS / largest")
    for name in VEHICLES:
        exact = positions(name, "rk4", 100)
        for integrator, counts in (("midpoint", (2, 3, 4, 8)), ("rk4", (2, 4))):
            for substeps in counts:
                away = 1e3 * np.linalg.norm(positions(name, integrator, substeps) - exact, axis=1)
                rms = float(np.sqrt(np.mean(away**2)))
                print(f"{name:16s}{integrator:9s}{substeps:3d} steps  {rms:7.3f} / {away.max():7.3f}")


def processor_time(step: Callable[[], object]) -> float:
    """Return the processor-seconds of one call, the best of `ROUNDS`."""
    step()
    start = time.process_time()
    step()
    calls = max(1, round(SECONDS / max(time.process_time() - start, 1e-6)))
    best = np.inf
    for _ in range(ROUNDS):
        start = time.process_time()
        for _ in range(calls):
            step()
        best = min(best, (time.process_time() - start) / calls)
    return best


def speed() -> None:
    """Print nanoseconds per step of one vehicle, and the ratio to a step of MuJoCo's body."""
    model = mujoco.MjModel.from_xml_string(MUJOCO_BODY)
    data = mujoco.MjData(model)
    body = processor_time(lambda: [mujoco.mj_step(model, data) for _ in range(1000)]) / 1000.0
    print(f"MuJoCo, one free body: {1e9 * body:.0f} ns a step")
    random = np.random.default_rng(0)
    for substeps in (1, 2, 3, 4, 10):
        simulator = Simulator("finsrov", worlds=WORLDS, substeps=substeps, threads=1)
        simulator.place((0.0, 0.0, -5000.0))
        simulator.set_thrust(random.uniform(-5.0, 5.0, (WORLDS, 1, 8)))
        one = processor_time(simulator.step) / WORLDS
        print(f"control step of {substeps:2d} physics steps: {1e9 * one:.0f} ns, ratio {body / one:.2f}")
    for action in ("thruster8", "wrench6"):
        environment = Environment(StationKeeping(), worlds=WORLDS, action=action, threads=1)
        actions = random.uniform(-1.0, 1.0, (8, WORLDS, environment.action_size)).astype(np.float32)
        turn = itertools.cycle(actions)
        one = processor_time(lambda step=environment.step, turn=turn: step(next(turn))) / WORLDS
        print(f"T1, {action}: {1e9 * one:.0f} ns a step, ratio {body / one:.2f}")


def main() -> None:
    """Print the tables that are named, or both."""
    tables = {"accuracy": accuracy, "speed": speed}
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("table", nargs="?", choices=tables, help="the table to print; both without it")
    name = parser.parse_args().table
    wp.config.quiet = True
    for table in (tables[name],) if name else tables.values():
        table()


if __name__ == "__main__":
    main()
