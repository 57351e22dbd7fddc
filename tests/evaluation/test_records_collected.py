"""A lock-step run of the tuned PID in the virtual pool as training data: observations, actions, and a clone."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from finssim.agents.agent import PidAgent
from finssim.control.guidance import Station
from finssim.core.rotations import quat_from_yaw
from finssim.evaluation.records import collect_records
from finssim.learning.demonstrations import load
from finssim.learning.learners import learner_named
from finssim.pool import draw_plant
from finssim.pool.camera import PoolCamera, camera_of
from finssim.pool.virtual_pool import VirtualPool
from finssim.robot.lockstep import run_lockstep
from finssim.robot.perception import Perception
from finssim.robot.pilots import AgentPilot
from finssim.robot.recorder import Recorder
from finssim.robot.runtime import Runtime
from finssim.tasks import make
from finssim.vehicles import load_vehicle
from tests.reference.observed import published_t1

pytestmark = pytest.mark.slow

FINSROV = load_vehicle("finsrov")
STATIONS = (Station((0.6, 0.25, -0.4), 0.5), Station((-0.6, -0.25, -0.6), -0.5))
SECONDS = 6.0


class Watched(AgentPilot):
    """Pilot that stores its task observations and its actions as fractions of its limits."""

    def __init__(self):
        super().__init__(PidAgent("pid", FINSROV), FINSROV)
        self.seen, self.said = [], []

    def act(self, reading, guide, t):
        self.seen.append(published_t1(reading, guide, t))
        force = super().act(reading, guide, t)
        self.said.append(self.action)
        return force


def driven(path, station, seed):
    """Return a recorded run from the middle of the pool to a station."""
    true_site, known_site, settings = camera_of(FINSROV, 0, "nominal")
    pilot = Watched()
    pool = VirtualPool(
        FINSROV,
        draw_plant(FINSROV, 0, "nominal"),
        camera=PoolCamera(FINSROV, true_site, mode="corners", settings=settings, seed=seed),
        start=((0.0, 0.0, -0.5), quat_from_yaw(0.0)),
        seed=seed,
    )
    with Recorder(path, FINSROV, {"command": "finssim run"}, pictures="none") as recorder:
        runtime = Runtime(
            FINSROV, Perception(FINSROV, known_site), pilot, station, arm=True, recorder=recorder
        )
        run_lockstep(runtime, pool, SECONDS)
    pool.close()
    return pilot


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """Two runs, their pilots, and the data set of both."""
    folder = tmp_path_factory.mktemp("driven")
    records = [folder / f"{k}.mcap" for k in range(len(STATIONS))]
    pilots = [
        driven(record, station, k) for k, (record, station) in enumerate(zip(records, STATIONS, strict=True))
    ]
    told = collect_records(records, "t1", out=folder / "set")
    return pilots, told, folder / "set"


def test_what_the_pilot_saw_and_said_is_what_is_shown(shown):
    """Every second decision of a pilot at twice the task's rate agrees with the record."""
    pilots, told, place = shown
    found = load(place)
    assert told["episodes"] == 2 and told["expert"] == "pid" and told["steps"] > 2 * 40
    first = 0
    for pilot, source in zip(pilots, told["records"], strict=True):
        n = source["steps"]
        rows = slice(first, first + n)
        np.testing.assert_allclose(found.observation[rows], np.array(pilot.seen[: 2 * n : 2]), atol=1e-6)
        np.testing.assert_allclose(found.following[rows], np.array(pilot.seen[2 : 2 * n + 1 : 2]), atol=1e-6)
        off = np.abs(found.action[rows] - np.array(pilot.said[: 2 * n : 2])).max(axis=1)
        # Wrenches beyond the thrusters' reach, as in the initial rush, are delivered smaller than requested.
        assert np.median(off) < 1e-3 and np.mean(off < 0.02) > 0.8
        first += n


def test_a_clone_of_the_run_goes_the_same_way(shown):
    """At rest and level, half a metre from its goal, the clone pushes towards it along surge, sway and heave."""
    _, _, place = shown
    kind = learner_named("bc")
    environment = make("t1", worlds=4, seed=1)
    few = {"worlds": 4, "steps": 100_000, "rollout": 50_000, "batch": 128}
    settings = replace(kind.settings(environment.task), demonstrations=str(place), **few)
    learner = kind(environment, settings, seed=1)
    while learner.steps < settings.steps:
        learner.update()
    offsets = np.array([[0.5, 0.2, 0.1], [-0.5, -0.2, -0.1]], np.float32) / 3.0
    rest = np.zeros((2, 16), np.float32)
    rest[:, :3], rest[:, 3], rest[:, 7] = offsets, 1.0, 1.0
    rest[:, 15] = np.linalg.norm(offsets, axis=1)
    with torch.no_grad():
        action = learner.network()(torch.from_numpy(rest)).numpy()
    assert np.array_equal(np.sign(action[:, :3]), np.sign(offsets)) and np.abs(action[:, 0]).min() > 0.1
