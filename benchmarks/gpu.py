"""All rates on a GPU, in one script of a few minutes: `python benchmarks/gpu.py --device cuda --out gpu`.

Rates of physics, tasks, learners, cameras and sonars, memory by worlds, and the difference between the results of the
device and of the processor. Figures whose package is not installed are listed as missing.
"""

from __future__ import annotations

import math
import platform
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import warp as wp

import finssim
from finssim.cli.command_line import run_script
from finssim.core.progress import Progress
from finssim.core.provenance import provenance
from finssim.core.system import processor_name
from finssim.evaluation.campaign import write_json
from finssim.evaluation.tables import Table
from finssim.learning import learner_named
from finssim.sim import Simulator
from finssim.sim.simulator import find_device
from finssim.tasks import task_named
from finssim.tasks.catalogue import numeric_tasks

SECONDS, ROUNDS = 1.0, 3
"""Time for a figure [s], and number of rounds; the best counts."""
PHYSICS_WORLDS, TASK_WORLDS, CAMERA_WORLDS, LEARNER_WORLDS = 2**19, 2**17, 2048, 2**14
"""Worlds at full scale; other scales are proportional."""
MOST_WORLDS = 2**22
"""Largest number of worlds whose memory is measured."""
COMPARED_WORLDS, COMPARED_TIME = 64, 5.0
"""Worlds, and time, over which a device is compared with the processor [s]."""
TOLERANCES = {"position": 1e-4, "observation": 1e-3, "recording": 1e-3}
"""Largest difference from the processor: position [m], and element of an observation of T1 [-], after `COMPARED_TIME`;
single precision gives 1e-6 and 1e-4. Then that of a parameter of PPO with recordings from one without [-], after
`COMPARED_UPDATES`."""
COMPARED_UPDATES = 4
STEERED = ("path", "waypoints", "terrain", "homing")
"""Tasks of a vehicle with fins."""
LEARNERS = {"ppo": "t1", "sb3-ppo": "t1", "rsl-rl": "t1", "torchrl-ppo": "t1", "distill": "camera-docking"}
"""Learner -> task that it is measured with."""
MODELS = ("calibrated", "mesh", "simplified")
IMAGE = 64
"""Edge of an image [px]."""


def rate(step: Callable[[], object], work: float, device: str, seconds: float) -> float:
    """Return the work per second of the best round.

    Args:
        step: What is timed.
        work: Work of one call.
        device: It is waited for.
        seconds: Time for all rounds [s].
    """

    def timed(calls: int) -> float:
        wp.synchronize_device(device)
        began = time.perf_counter()
        for _ in range(calls):
            step()
        wp.synchronize_device(device)
        return time.perf_counter() - began

    timed(2)
    calls = max(1, round(seconds / ROUNDS / max(timed(1), 1e-7)))
    return max(calls * work / timed(calls) for _ in range(ROUNDS))


def physics_rate(model: str, worlds: int, device: str, seconds: float) -> float:
    """Return control steps of 40 ms, of four physics steps each, per second with random thrusts."""
    simulator = _thrusting(model, worlds, device)
    return rate(simulator.step, worlds, device, seconds)


def task_rate(name: str, worlds: int, device: str, seconds: float) -> float:
    """Return steps of a task's environment per second, of all agents' worlds, with random actions."""
    vehicle = "remus100" if name in STEERED else "finsrov"
    environment = finssim.make(name, worlds=worlds, vehicle=vehicle, device=device, seed=1)
    shape = environment.arrays.action.shape
    actions = np.random.default_rng(1).uniform(-1.0, 1.0, shape).astype(np.float32)
    environment.reset()
    environment.arrays.action.assign(actions)
    return rate(environment.advance, worlds, device, seconds)


def learner_of(name: str, task: str, worlds: int, device: str, **changes: Any) -> Any:
    """Return a learner at the start of an unlimited training; `changes` are changed settings."""
    kind, chosen = learner_named(name), task_named(task)
    settings = replace(kind.settings(chosen, worlds=worlds, steps=10**9, device=device), **changes)
    environment = finssim.make(chosen, worlds=worlds, seed=1, observe="training", device=device)
    return kind(environment, settings, seed=1, device=device)


def learner_rate(name: str, task: str, worlds: int, device: str, seconds: float, **changes: Any) -> float:
    """Return environment steps per second of training, rollouts and updates included."""
    learner = learner_of(name, task, worlds, device, **changes)
    for _ in range(COMPARED_UPDATES):  # record CUDA graphs before the measurement
        learner.update()
    before, began = learner.steps, time.perf_counter()
    while time.perf_counter() - began < seconds:
        learner.update()
    wp.synchronize_device(device)
    return (learner.steps - before) / (time.perf_counter() - began)


def picture_rate(site: str, worlds: int, device: str, seconds: float) -> float:
    """Return images per second of a square camera with water and noise."""
    from cameras import square_camera
    from finssim.extensions.perception import CameraBatch, WorldBatch, load_world, poses_of

    batch = WorldBatch(load_world(site), worlds=worlds, device=device)
    batch.draw(seed=1)
    simulator, pose = Simulator("finsrov", worlds=worlds, device=device), batch.world.viewpoint.pose
    simulator.place(position=pose[:3], quaternion=pose[3:])
    camera, poses = CameraBatch(batch, square_camera(IMAGE)), poses_of(simulator.state)
    return rate(lambda: camera.update(poses, seed=1), worlds, device, seconds)


def ping_rate(worlds: int, device: str, seconds: float) -> float:
    """Return pings per second of an imaging sonar with 64 beams and 64 range cells."""
    from finssim.extensions.perception import SonarBatch, WorldBatch, load_world, poses_of
    from finssim.vehicles.device_files import load_device

    batch = WorldBatch(load_world("pool"), worlds=worlds, device=device)
    batch.draw(seed=1)
    simulator = Simulator("finsrov", worlds=worlds, device=device)
    sonar = SonarBatch(batch, load_device("gemini_720is"), beams=64, bins=64)  # type: ignore[arg-type]
    poses = poses_of(simulator.state)
    return rate(lambda: sonar.update(poses, seed=1), worlds, device, seconds)


def device_memory(worlds: int, device: str) -> float | None:
    """Return the memory that T1 needs on the device [MB]; None on a processor, or if memory is insufficient."""
    if not device.startswith("cuda"):
        return None
    chosen = wp.get_device(device)
    before = chosen.free_memory
    try:
        environment = finssim.make("t1", worlds=worlds, device=device, seed=1)
        environment.reset()
    except RuntimeError:
        return None
    wp.synchronize_device(device)
    return (before - chosen.free_memory) / 1e6


def differences(device: str) -> dict[str, float]:
    """Return the differences between results of the device and of the processor after `COMPARED_TIME`; see
    `TOLERANCES`."""
    ends = {}
    for where in ("cpu", device):
        simulator = _thrusting("calibrated", COMPARED_WORLDS, where)
        for _ in range(round(COMPARED_TIME / 0.04)):
            simulator.step()
        environment = finssim.make("t1", worlds=COMPARED_WORLDS, device=where, seed=1)
        environment.reset()
        action = np.zeros((COMPARED_WORLDS, environment.action_size), np.float32)
        for _ in range(round(COMPARED_TIME / 0.1)):
            step = environment.step(action)
        ends[where] = simulator.numpy("position").copy(), np.array(step.observation)
    learned = []
    for recorded in (True, False):
        learner = learner_of("ppo", "t1", COMPARED_WORLDS, device, recorded=recorded)
        for _ in range(COMPARED_UPDATES):
            learner.update()
        learned.append(learner.learned()["numbers"]["policy"])
    pairs = zip((*ends["cpu"], learned[0]), (*ends[device], learned[1]), strict=True)
    return {name: float(np.abs(a - b).max()) for name, (a, b) in zip(TOLERANCES, pairs, strict=True)}


def _thrusting(model: str, worlds: int, device: str) -> Simulator:
    """Return a simulator of deeply submerged vehicles under constant random thrusts."""
    simulator = Simulator(
        "finsrov", worlds=worlds, hydrodynamics=model, control_step=0.04, substeps=4, device=device
    )
    simulator.place(position=(0.0, 0.0, -50.0))
    simulator.set_thrust(np.random.default_rng(0).uniform(-5.0, 5.0, (worlds, 1, 8)))
    return simulator


def describe(device: str) -> dict[str, Any]:
    """Return the device, its driver and the versions."""
    chosen = find_device(device)
    out: dict[str, Any] = {"device": str(chosen.name), "processor": processor_name(), **provenance()}
    out |= {"python": platform.python_version(), "warp": wp.config.version}
    if chosen.is_cuda:
        driver = getattr(wp, "get_cuda_driver_version", lambda: None)()
        out |= {"driver": driver, "memory_mb": chosen.total_memory / 1e6}
    return out


def gpu(
    *,
    out: Path,
    device: str = "cuda",
    scale: Annotated[float, (1e-4, 1.0)] = 1.0,
    progress: Progress = lambda part, text: None,
) -> dict[str, Any]:
    """Measure everything on one device, and compare its results with the processor's.

    Exit status 3: a result differs by more than the tolerance.

    Example: python benchmarks/gpu.py --device cpu --scale 0.01 --out gpu

    Args:
        out (DIR): Directory for gpu.json and gpu.md.
        device (DEVICE): Compute device: cpu or cuda.
        scale: Part of the worlds and of the time of every figure.
        progress: Receives the completed fraction and the next figure.

    Returns:
        Content of `gpu.json`: rates per second by figure, memory [MB] by worlds, differences, and what was left out.
    """
    machine = describe(device)

    def of(worlds: int) -> int:
        return max(8, math.ceil(scale * worlds))

    seconds = max(0.05, scale * SECONDS)
    plan: dict[str, Callable[[], float | None]] = {
        f"physics, {model}": partial(physics_rate, model, of(PHYSICS_WORLDS), device, seconds)
        for model in MODELS
    }
    plan |= {
        f"task, {name}": partial(task_rate, name, of(TASK_WORLDS), device, seconds)
        for name in numeric_tasks()
    }
    plan |= {
        f"learner, {name}": partial(
            learner_rate,
            name,
            task,
            of(LEARNER_WORLDS if task == "t1" else CAMERA_WORLDS),
            device,
            5.0 * seconds,
        )
        for name, task in LEARNERS.items()
    }
    if find_device(device).is_cuda:
        figure = partial(learner_rate, recorded=False)
        plan["learner, ppo, not recorded"] = partial(
            figure, "ppo", "t1", of(LEARNER_WORLDS), device, 5.0 * seconds
        )
    plan |= {
        f"camera, {site}": partial(picture_rate, site, of(CAMERA_WORLDS), device, seconds)
        for site in ("pool", "dock")
    }
    plan["sonar, pool"] = partial(ping_rate, of(CAMERA_WORLDS), device, seconds)
    sizes = [2**k for k in range(12, 23, 2) if 2**k <= max(4096, scale * MOST_WORLDS)]
    plan |= {f"memory, {worlds}": partial(device_memory, worlds, device) for worlds in sizes}
    figures, left_out = _measured(plan, progress)
    apart = differences(device)
    rates = {name: value for name, value in figures.items() if not name.startswith("memory, ")}
    memory = {name.split(", ")[1]: value for name, value in figures.items() if name not in rates}
    result = {
        "experiment": "gpu", "machine": machine, "scale": scale, "per_second": rates,
        "memory_mb": {worlds: value for worlds, value in memory.items() if value is not None},
        "differences": apart, "tolerances": TOLERANCES, "left_out": left_out,
        "ok": all(apart[name] <= most for name, most in TOLERANCES.items()),
    }  # fmt: skip
    write_json(Path(out) / "gpu.json", result, tables_of(result))
    return result


def _measured(
    plan: Mapping[str, Callable[[], float | None]], progress: Progress
) -> tuple[dict[str, float | None], dict[str, str]]:
    """Return the figures, and why others are missing."""
    figures: dict[str, float | None] = {}
    left_out: dict[str, str] = {}
    for k, (name, figure) in enumerate(plan.items()):
        progress(k / len(plan), name)
        try:
            figures[name] = figure()
        except (ImportError, ValueError, RuntimeError) as error:
            left_out[name] = " ".join(str(error).split())[:200]
    return figures, left_out


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """Return the rates, the memory and the differences as tables."""

    def rows(values: Iterable[tuple[str, float]], form: str) -> list[list[str]]:
        return [[name, format(value, form)] for name, value in values]

    machine = result["machine"]
    note = "; ".join(f"left out: {name}: {why}" for name, why in result["left_out"].items())
    tables = [
        Table(
            title=f"Per second, {machine['device']}, scale {result['scale']:g}", heads=["", "per second"],
            rows=rows(result["per_second"].items(), ",.0f"), note=note,
        ),
        Table(
            title="Largest difference from the processor", heads=["", "difference"],
            rows=rows(result["differences"].items(), ".1e"),
        ),
    ]  # fmt: skip
    if result["memory_mb"]:
        memory = rows(result["memory_mb"].items(), ",.0f")
        tables.append(Table(title="Memory of T1", heads=["worlds", "MB"], rows=memory))
    return tables


if __name__ == "__main__":
    run_script("__main__:gpu")
