"""A short run in the virtual pool, recorded with pictures and truth."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from finssim.control.guidance import Station
from finssim.localization.overhead_camera import write_pool
from finssim.pool.camera import PoolCamera, camera_of
from finssim.pool.drawn_plant import draw_plant
from finssim.pool.virtual_pool import VirtualPool
from finssim.robot.lockstep import run_lockstep
from finssim.robot.perception import Perception
from finssim.robot.pilots import make_pilot
from finssim.robot.recorder import Recorder
from finssim.robot.runtime import Runtime
from finssim.vehicles import load_vehicle

GOAL = Station((0.7, 0.3, -0.6), np.radians(40.0), name="station")


class Trial(NamedTuple):
    """Files of a run."""

    record: object
    truth: object
    duration: float = 6.0


@pytest.fixture(scope="session")
def trial(tmp_path_factory):
    """Run of six seconds towards a goal with ten pictures a second."""
    folder = tmp_path_factory.mktemp("trial")
    vehicle = load_vehicle("finsrov")
    true_site, known, settings = camera_of(vehicle, 1, "realistic")
    write_pool(known, folder / "pool.yaml")
    camera = PoolCamera(vehicle, true_site, settings=replace(settings, rate=10.0, dropout=0.0))
    world = VirtualPool(
        vehicle, draw_plant(vehicle, 1, "realistic"), camera=camera, truth=folder / "truth.fst"
    )
    made = Trial(folder / "run.mcap", folder / "truth.fst")
    with Recorder(made.record, vehicle, files={"pool.yaml": folder / "pool.yaml"}) as recorder:
        pilot = make_pilot("pid", vehicle)
        runtime = Runtime(vehicle, Perception(vehicle, known), pilot, GOAL, arm=True, recorder=recorder)
        run_lockstep(runtime, world, made.duration)
    world.close()
    assert runtime.counters.decisions > 30
    return made
