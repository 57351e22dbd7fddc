"""A torpedo through the whole stack: pilot, bridge, wire, firmware, plant, telemetry, record."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mcap")
pytest.importorskip("rosbags")

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.control.guidance import Station
from finssim.control.path_following import Waypoints
from finssim.control.trajectories import load_trajectory
from finssim.pool import VirtualPool, draw_plant, read_truth
from finssim.pool.drawn_plant import site_of
from finssim.robot.bridge import Bridge
from finssim.robot.lockstep import run_lockstep
from finssim.robot.messages import Delivery
from finssim.robot.perception import Perception
from finssim.robot.pilots import AgentPilot
from finssim.robot.reading import Reading
from finssim.robot.record_reader import open_record
from finssim.robot.recorder import Recorder
from finssim.robot.runtime import Runtime
from finssim.vehicles import load_vehicle
from finssim.vehicles.defaults import vehicle_at
from reference.finned import torpedo, torpedo_file
from reference.pools import lockstep_pool

TORPEDO = vehicle_at("open-water", torpedo())
START = (0.0, 0.0, -8.0)
AHEAD = Station(START, 0.0, name="ahead")


class Scripted:
    """Ahead with the propeller, later with the rudder to starboard."""

    name, period, needs_state = "script", 0.1, True

    def describe(self):
        return {"name": self.name}

    def reset(self):
        pass

    def act(self, reading, guide, t):
        return np.array([25.0, 0.2 if t > 3.0 else 0.0, 0.0, 2e-4, 0.0])


def robot(recorder=None):
    perception = Perception(TORPEDO, None, let_in=START[:2])
    return Runtime(
        TORPEDO, perception, Scripted(), AHEAD, arm=True, bridge=Bridge(TORPEDO), recorder=recorder
    )  # fmt: skip


def water():
    spec = site_of("open-water", draw_plant(TORPEDO, 1, "nominal"))
    return VirtualPool(TORPEDO, spec, start=(START, (0.0, 0.0, 0.0, 1.0)))


@pytest.mark.slow
def test_a_scripted_pilot_turns_a_torpedo_and_is_recorded(tmp_path):
    """The bow turns to starboard and values follow requests; after the end the fins are at 0 and the engine
    keeps its value."""
    world = water()
    with Recorder(tmp_path / "run.mcap", TORPEDO) as recorder:
        runtime = robot(recorder)
        run_lockstep(runtime, world, 8.0)
    assert runtime.bridge.reason == "" and world.plant.nu[0] > 1.0 and world.plant.nu[5] < -0.1
    world.exchange(world.time + 0.4)  # less than the firmware's own timeout, so the bridge caused this
    np.testing.assert_allclose(world.plant.values, [0.0, 0.0, 2e-4, 0.0], atol=0.01)
    assert world.plant.values[2] == pytest.approx(2e-4, rel=1e-3)
    with open_record(tmp_path / "run.mcap") as record:
        asked, states = (
            [m.message.position for m in record.messages([n])] for n in ("actuator_cmd", "actuator_states")
        )
    viewer = pytest.importorskip("finssim.extensions.viewer.sources")
    source = viewer.RecordSource(tmp_path / "run.mcap", vehicle=str(torpedo_file(tmp_path)))
    assert source.frame(6.0).values[0] == pytest.approx(0.196, abs=1e-3)
    np.testing.assert_allclose(asked[-1], [0.2, 0.0, 2e-4, 0.0])
    assert np.array(states)[:, 0].max() == pytest.approx(0.196, abs=1e-3)  # less its play


@pytest.mark.slow
def test_a_run_along_a_path_stays_on_it(capsys, tmp_path):
    """`finssim run` with line of sight, autopilot, wire and fins stays within a metre of a descending path at
    2 m/s."""
    file, way, truth = torpedo_file(tmp_path), tmp_path / "way.csv", tmp_path / "truth"
    way.write_text("t,x,y,z\n0,0,0,-8\n20,30,0,-8\n40,55,15,-10\n", encoding="utf-8")
    words = f"run --vehicle {file} --site open-water --pool-file none --let-in 0,0 --lockstep".split()
    words += f"--policy line-of-sight --task path --trajectory {way} --duration 22 --arm --json".split()
    with lockstep_pool(load_vehicle(file), None, site="open-water", position=START, truth=truth) as wiring:
        status = boundary.run(app, [*map(str, words), "--robot", wiring.robot])
    report = json.loads(capsys.readouterr().out)
    assert status == 0 and report["state"] == "armed" and report["faults"] == []
    assert report["position_rms_m"] < 0.3  # distance from the path, by the estimate
    path, leg = Waypoints.along(load_trajectory(way)), np.zeros(1, dtype=int)
    true, worst = read_truth(truth), 0.0
    for x in true.position[true.time > 8.0]:
        errors, leg, _ = path.errors(leg, x)
        worst = max(worst, abs(errors.across[0]), abs(errors.above[0]))
    assert true.position[-1, 0] > 40.0 and worst < 1.0


def test_an_agent_of_all_channels_commands_them():
    """Actions of mode `surfaces` are fractions of the limits of propeller, fins, engine and mass."""

    class Agent:
        name, period, action, wrench_scale = "agent", 0.1, "surfaces", 1.0

        def reset(self, n):
            return None

        def act(self, memory, reading, goal):
            return np.array([[0.5, 1.0, -1.0, 0.1, 0.0]]), memory

    pilot = AgentPilot(Agent(), TORPEDO)
    reading = Reading(0.0, np.array(START), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(6), True)
    channels = pilot.act(reading, AHEAD, 0.0)
    np.testing.assert_allclose(
        channels, [0.5 * TORPEDO.force_limits[1][0], 0.35, -0.35, 1e-4, 0.0], rtol=1e-5
    )


@pytest.mark.slow
def test_a_robot_does_not_arm_on_a_controller_of_version_1():
    """Telemetry of version 1 has no actuators: arming is refused in one sentence, and no thruster turns."""
    world = water()

    class Old:
        """The same water behind a firmware of version 1."""

        def exchange(self, until, sent):
            telemetry, world.firmware.telemetry = world.firmware.telemetry, old
            try:
                return Delivery(until, world.exchange(until, sent).frames)
            finally:
                world.firmware.telemetry = telemetry

    measured = world.firmware.telemetry

    def old(*args):
        newest = measured(*args)
        return None if newest is None else replace(newest, actuators=())

    runtime = robot()
    run_lockstep(runtime, Old(), 3.0)
    assert "uses version 1 of the protocol, which has thrusters alone: rudder, elevator" in runtime.refusal
    assert math.isnan(runtime.started) and not world.plant.shaft_speed.any()
