"""Images per processor-second: `python benchmarks/cameras.py [--json] [--site SITE] [--device cuda]`.

Cameras and a sonar of vehicles in many worlds, compared with the ray caster that renders them.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import warp as wp

from finssim.cli.command_line import run_script
from finssim.core.progress import Progress
from finssim.core.provenance import provenance
from finssim.core.system import peak_memory, processor_name
from finssim.evaluation.tables import Table
from finssim.extensions.perception import CameraBatch, SonarBatch, WorldBatch, load_world, poses_of
from finssim.sim import Simulator
from finssim.sim.launch import default_threads
from finssim.vehicles.device_files import CameraDevice, SonarDevice, load_device

SIZES = (16, 32, 64, 128)
"""Edge lengths of the images [px]."""
WORLDS = 256
MEMORY_WORLDS = 1024
ROUNDS = 5
"""Rounds, alternating with the bare sensor; the best of each counts, since other load only slows a round down."""
VEHICLE = "finsrov"


def bench_cameras(
    *, site: str = "pool", device: str = "cpu", progress: Progress = lambda part, text: None
) -> dict[str, Any]:
    """Measure images per processor-second: a vehicle's step, rays, water and noise, beside the bare rays.

    Each of 256 worlds has a vehicle with a square camera of 90°, and different objects and water. The bare rate is
    that of Newton's SensorCamera alone with depth, shape and normal, measured alternately.

    Example: python benchmarks/cameras.py --json

    Args:
        site (SITE|FILE): Site of the measurement.
        device (DEVICE): Compute device: cpu or cuda.
        progress: Receives the completed fraction and the next figure.
    """
    batch = WorldBatch(load_world(site), worlds=WORLDS, device=device)
    batch.draw(seed=1)
    simulator = _simulator(batch)
    frames, bare, clock = {}, {}, time.perf_counter if batch.device.is_cuda else time.process_time
    for k, size in enumerate(SIZES):
        progress(k / (len(SIZES) + 2), f"{size}x{size}")
        camera = CameraBatch(batch, square_camera(size))
        poses = poses_of(simulator.state)

        def step(camera: CameraBatch = camera, poses: wp.array = poses) -> None:
            simulator.step()
            camera.update(poses_of(simulator.state, poses), seed=1)

        frames[f"{size}x{size}"], bare[f"{size}x{size}"] = _rates(
            clock, batch, step, lambda camera=camera, poses=poses: camera.cast(poses)
        )
    progress(len(SIZES) / (len(SIZES) + 2), "sonar")
    device_file = load_device("gemini_720is")
    assert isinstance(device_file, SonarDevice)
    sonar, poses = SonarBatch(batch, device_file, beams=64, bins=64), poses_of(simulator.state)
    pings, fans = _rates(clock, batch, lambda: sonar.update(poses, seed=1), lambda: sonar.cast(poses))
    progress((len(SIZES) + 1) / (len(SIZES) + 2), "memory")
    return {
        "frames_per_s": frames,
        "bare_frames_per_s": bare,
        "ratio": {size: frames[size] / bare[size] for size in frames},
        "sonar_pings_per_s": {"64x64": pings},
        "bare_sonar_pings_per_s": {"64x64": fans},
        f"memory_mb/{MEMORY_WORLDS}/64x64": memory_mb(site, MEMORY_WORLDS),
        "worlds": WORLDS,
        "site": batch.world.name,
        "shapes": batch.model.shape_count // WORLDS,
        "device": device,
        "machine": {
            "processor": processor_name(),
            "threads": default_threads(),
            "load_1min": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
            **provenance(),
        },
    }


def square_camera(size: int) -> CameraDevice:
    """Return a camera of 90° in both directions, `size` pixels wide and high, with the catalogue camera's electronics.

    Args:
        size: Width and height [px].
    """
    camera = load_device("low_light_camera")
    return camera.model_copy(update={"width": size, "height": size, "focal_length": 0.5 * size})


def _simulator(batch: WorldBatch) -> Simulator:
    """Place vehicles at the site's viewpoint."""
    simulator = Simulator(VEHICLE, worlds=batch.worlds, threads=1, device=str(batch.device))
    pose = batch.world.viewpoint.pose
    simulator.place(position=pose[:3], quaternion=pose[3:])
    return simulator


def _rates(
    clock: Callable[[], float], batch: WorldBatch, full: Callable[[], object], bare: Callable[[], object]
) -> tuple[float, float]:
    """Measure views per second of two functions that cast the same rays, the best of alternating rounds."""
    best = [0.0, 0.0]
    for work in (full, bare):
        work()
    for _ in range(ROUNDS):
        for k, work in enumerate((full, bare)):
            wp.synchronize_device(batch.device)
            start = clock()
            work()
            wp.synchronize_device(batch.device)
            best[k] = max(best[k], batch.worlds / (clock() - start))
    return best[0], best[1]


def memory_mb(site: str, worlds: int) -> float:
    """Measure the peak resident memory of a process with vehicles and a 64x64 camera in `worlds` worlds [MB]."""
    done = subprocess.run(
        [sys.executable, "-c", f"from cameras import use_memory; use_memory({site!r}, {worlds})"],
        cwd=Path(__file__).parent, capture_output=True, encoding="utf-8", check=True,
    )  # fmt: skip
    return float(done.stdout.split()[-1])


def use_memory(site: str, worlds: int) -> None:
    """Step vehicles and cameras in `worlds` worlds, and print the peak memory of this process [MB]."""
    batch = WorldBatch(load_world(site), worlds=worlds)
    simulator = _simulator(batch)
    camera = CameraBatch(batch, square_camera(64))
    for _ in range(2):
        simulator.step()
        camera.update(poses_of(simulator.state), seed=1)
    print(peak_memory())


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """Return the rates of this machine as a table."""
    frames, bare = result["frames_per_s"], result["bare_frames_per_s"]
    rows = [
        [f"camera {s}", f"{frames[s]:,.0f}", f"{bare[s]:,.0f}", f"{result['ratio'][s]:.2f}"] for s in frames
    ]
    pings, fans = result["sonar_pings_per_s"]["64x64"], result["bare_sonar_pings_per_s"]["64x64"]
    rows.append(["sonar, 64 beams, 64 ranges", f"{pings:,.0f}", f"{fans:,.0f}", f"{pings / fans:.2f}"])
    memory = next(value for key, value in result.items() if key.startswith("memory_mb"))
    return [
        Table(
            title=f"pictures of {result['site']} ({result['shapes']} shapes), {result['worlds']} worlds",
            heads=["", "per s", "bare rays, per s", "ratio"],
            rows=rows,
            note="per second of one core; a vehicle's step, water and noise included; "
            f"{MEMORY_WORLDS} worlds at 64x64 take {memory:.0f} MB; on {result['machine']['processor']}, "
            f"load {result['machine']['load_1min']}",
        )
    ]


if __name__ == "__main__":
    run_script("__main__:bench_cameras")
