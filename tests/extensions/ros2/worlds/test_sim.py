# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""A simulated vehicle on the wire: its messages, its commanders, and stopping it."""

import json
import math
import time

import numpy as np
import pytest

from finssim.extensions.ros2.backend import activate

activate(announce=False)

import rclpy
from rclpy.node import Node

from finssim.extensions.ros2.nodes.conversions import RosMessages, ros_type
from finssim.extensions.ros2.shim.arguments import parse_arguments
from finssim.extensions.ros2.topics import TOPICS, quality_profile
from finssim.extensions.ros2.worlds.sim import MOST_BEHIND, STEP, Sim

PATIENCE = 30.0  # [s] on a busy machine
STATES = ("disarmed", "armed", "hold", "fault")


class World:
    """Sim that the test advances, and a peer that communicates with it over the wire."""

    def __init__(self, sim, peer):
        self.sim, self.peer, self.heard = sim, peer, {}
        self.make, self._out = RosMessages(sim.vehicle), {}
        self.count = len(sim.vehicle.thruster_names)
        for key in ("odometry", "estimator", "thrusters", "imu", "pressure", "clock", "event"):
            self.heard[key] = []
            peer.create_subscription(
                ros_type(TOPICS[key].type), self.name(key), self.heard[key].append, self.quality(key)
            )
        for key in ("command", "arm", "stop", "acknowledge"):
            self.publisher(key)
        assert self.until(lambda: all(p.get_subscription_count() for p in self._out.values()))

    def name(self, key):
        return TOPICS[key].under("finsrov")

    def quality(self, key):
        return quality_profile(TOPICS[key].quality)

    def publisher(self, key):
        self._out[key] = self.peer.create_publisher(
            ros_type(TOPICS[key].type), self.name(key), self.quality(key)
        )
        return self._out[key]

    def send(self, key, message=None, **fields):
        self._out[key].publish(message or ros_type(TOPICS[key].type)(**fields))

    def ask(self, force, source="peer", stamp=None):
        """Send a command stamped with the current simulated time."""
        self.send("command", self.make.command(self.sim.ns(stamp or self.sim.time), force, source))

    def steps(self, n):
        """Run n steps of the world, each with the messages received so far."""
        for _ in range(n):
            for node in (self.sim, self.peer):
                for _ in range(20):
                    rclpy.spin_once(node, timeout_sec=0.0)
            self.sim._step()

    def until(self, condition, each=lambda: None):
        """Advance the world until a condition is true; return whether it became true in time."""
        end = time.monotonic() + PATIENCE
        while not condition() and time.monotonic() < end:
            each()
            self.steps(1)
            time.sleep(0.002)
        return condition()

    @property
    def state(self):
        return STATES[self.heard["thrusters"][-1].state] if self.heard["thrusters"] else ""

    def armed(self):
        """Arm by the topic with commands at zero; return whether the state is armed."""

        def each():
            self.ask(np.zeros(self.count))
            self.send("arm", data=True)

        return self.until(lambda: self.state == "armed", each)


@pytest.fixture(scope="module")
def wire():
    """Participant of this process."""
    rclpy.init(args=[])
    yield
    rclpy.try_shutdown()


@pytest.fixture
def world(wire):
    """Fresh sim that advances only on request."""
    sim, peer = Sim(), Node("peer")
    for timer in list(sim.timers):
        if timer.callback == sim._turn:
            sim.destroy_timer(timer)
    yield World(sim, peer)
    sim.destroy_node(), peer.destroy_node()


def test_time_goes_on_by_steps_and_everything_carries_it(world):
    """/clock, Odometry, EstimatorStatus and sensors of a step share one stamp; the state is the engine's."""
    assert world.until(lambda: world.heard["clock"] and world.heard["imu"] and world.heard["pressure"])
    world.steps(3)
    assert world.until(lambda: len(world.heard["odometry"]) > 3)
    odometry = world.heard["odometry"][-1]
    stamp = odometry.header.stamp.sec + 1e-9 * odometry.header.stamp.nanosec
    assert stamp / STEP == pytest.approx(round(stamp / STEP), abs=1e-4)
    assert odometry.pose.pose.position.z == pytest.approx(-0.5, abs=0.05)
    assert world.heard["estimator"][-1].ready
    force = world.heard["imu"][-1].linear_acceleration
    assert math.hypot(force.x, force.y, force.z) == pytest.approx(9.81, abs=0.5)


def test_only_an_explicit_word_arms(world):
    """Commands, acknowledgements and `false` do not arm; `true` on the topic does, and then thrust passes."""
    force = np.full(world.count, 1.0)
    for _ in range(20):
        world.ask(force)
        world.send("acknowledge")
        world.send("arm", data=False)
        world.steps(1)
    assert {m.state for m in world.heard["thrusters"]} == {0}
    assert not np.any([m.force for m in world.heard["thrusters"]])
    world.steps(40)  # until the last command is stale
    assert world.armed()
    assert world.until(lambda: np.any(world.heard["thrusters"][-1].force), lambda: world.ask(force))
    world.send("arm", data=False)
    assert world.until(lambda: world.state == "disarmed", lambda: world.ask(force))
    assert not np.any(world.heard["thrusters"][-1].force)


def test_a_stop_is_a_fault_until_it_is_acknowledged(world):
    """Arming is refused until then, and the acknowledged vehicle is disarmed."""
    assert world.armed()
    world.send("stop")
    assert world.until(lambda: world.state == "fault")
    world.steps(70)  # the same event is published once a second
    world.send("arm", data=True)
    world.steps(10)
    assert world.state == "fault" and "emergency stop" in world.heard["thrusters"][-1].reason
    told = [json.loads(m.data) for m in world.heard["event"]]
    assert any(e["kind"] == "refused" and "acknowledge" in e["text"] for e in told)
    world.send("acknowledge")
    assert world.until(lambda: world.state == "disarmed")


def test_a_silent_commander_leaves_no_thrust(world):
    """Thrust ends half a second after the last command."""
    assert world.armed()
    force = np.full(world.count, 1.0)
    assert world.until(lambda: np.any(world.heard["thrusters"][-1].force), lambda: world.ask(force))
    last = world.sim.time
    assert world.until(lambda: world.state == "hold")
    stamp = world.heard["thrusters"][-1].header.stamp
    assert stamp.sec + 1e-9 * stamp.nanosec - last < 0.5 + 10 * STEP
    assert not np.any(world.heard["thrusters"][-1].force)


@pytest.mark.parametrize("source", ["peer", "somebody else"])
def test_a_second_publisher_is_a_fault(world, source):
    """Another name is a fault at once; the same name is one because the topic has two publishers."""
    assert world.armed()
    first = world._out["command"]
    second = world.publisher("command")

    def both():
        for publisher, name in ((first, "peer"), (second, source)):
            publisher.publish(world.make.command(world.sim.ns(world.sim.time), np.zeros(world.count), name))

    assert world.until(lambda: world.state == "fault", both)
    assert "two publishers" in world.heard["thrusters"][-1].reason


@pytest.mark.parametrize("attempt", range(10))
def test_a_second_publisher_that_leaves_at_once_is_a_fault(world, attempt):
    """Under the same name and gone before a count, its one command moves nothing."""
    assert world.armed()
    rival = world.publisher("command")
    assert world.until(lambda: rival.get_subscription_count() == 1, lambda: world.ask(np.zeros(world.count)))
    rival.publish(world.make.command(world.sim.ns(world.sim.time), np.full(world.count, 3.0), "peer"))
    world.peer.destroy_publisher(rival)
    time.sleep(0.05 * attempt % 0.2)
    world.steps(3)
    assert world.until(lambda: world.state == "fault")
    assert "two publishers" in world.heard["thrusters"][-1].reason
    assert not np.any([m.force for m in world.heard["thrusters"]])


def test_malformed_commands_are_no_sign_of_life(world):
    """Wrong names, NaN, too few values and an old stamp neither raise nor move the vehicle, which holds its
    position."""
    assert world.armed()

    def bad():
        world.ask(np.full(world.count, math.nan))
        world.ask(np.ones(world.count - 1))
        world.ask(np.ones(world.count), stamp=world.sim.time - 5.0 if world.sim.time > 5.0 else 1e6)
        world.send("command", names=["nobody"], force=[1.0], source="peer")

    assert world.until(lambda: world.state == "hold", bad)
    assert not np.any([m.force for m in world.heard["thrusters"]])


def test_services_say_what_the_topics_do(world):
    """set_armed returns an answer, and reset returns the vehicle to the start."""
    world.steps(5)
    for name, kind, wanted in (
        ("set_armed", "std_srvs/srv/SetBool", {"data": True}),
        ("reset", "std_srvs/srv/Trigger", {}),
    ):
        client = world.peer.create_client(ros_type(kind), f"/finsrov/{name}")
        assert client.wait_for_service(PATIENCE)
        future = client.call_async(ros_type(kind).Request(**wanted))
        assert world.until(future.done)
        assert future.result().success
        assert world.until(lambda wanted=wanted: world.state == ("armed" if wanted else "disarmed"))
    world.steps(2)
    assert world.heard["odometry"][-1].pose.pose.position.z == pytest.approx(-0.5, abs=0.01)


def sim_in(namespace):
    """Return a simulator as started with `--namespace`."""
    context = rclpy.get_default_context()
    before, words = context.arguments, ["--ros-args", "-r", f"__ns:=/{namespace}"]
    context.arguments = parse_arguments(words)
    try:
        return Sim()
    finally:
        context.arguments = before


@pytest.fixture
def pair(wire):
    """Two simulators of one domain with their own time stopped; the later one's name sorts first."""
    sims = [sim_in("robot_2"), sim_in("robot_1")]
    for sim in sims:
        for timer in list(sim.timers):
            if timer.callback == sim._turn:
                sim.destroy_timer(timer)
    yield sims
    for sim in sims:
        sim.destroy_node()


def spun(nodes, condition, each=lambda: None):
    """Run callbacks until a condition is true; return whether it became true in time."""
    end = time.monotonic() + PATIENCE
    while not condition() and time.monotonic() < end:
        each()
        for node in nodes:
            rclpy.spin_once(node, timeout_sec=0.002)
    return condition()


def test_of_two_simulators_one_publishes_the_clock_and_both_live_by_it(pair):
    """/clock has one publisher; every stamp of the second is of that time, and its vehicle moves by the same
    steps."""
    first, second = pair
    heard, peer = [], Node("peer")
    kind, quality = ros_type(TOPICS["odometry"].type), quality_profile(TOPICS["odometry"].quality)
    peer.create_subscription(kind, "/robot_1/odom", heard.append, quality)
    assert first.clock.ours and not second.clock.ours
    assert peer.count_publishers("/clock") == 1
    first.time = 40.0
    assert spun([first, second, peer], lambda: heard, first._step), (first.time, second.time)
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in heard]
    assert 40.0 - MOST_BEHIND * STEP < min(stamps) and max(stamps) <= first.time + 1e-6
    before = len(heard)
    for _ in range(10):  # one step at a time, so that none is lost
        first._step()
        assert spun([second, peer], lambda: second.time == pytest.approx(first.time, abs=0.1 * STEP))
    assert spun([peer], lambda: len(heard) >= before + 10)
    peer.destroy_node()


def test_a_simulator_that_cannot_keep_up_leaves_steps_out_but_not_time(pair):
    """After a leap its stamps are those of the clock, so that its state is not mistaken for an old one."""
    first, second = pair
    assert spun([second], lambda: second.time > 0.0, first._step)
    made = []
    step = second._step
    second._step = lambda: (made.append(second.time), step())
    second._follow(second.time + 100 * STEP)
    assert len(made) == MOST_BEHIND and made[0] == pytest.approx(second.time - MOST_BEHIND * STEP)
    second._follow(1.0)
    assert second.time == 1.0, "the other clock began anew"


def test_who_followed_takes_over_without_a_jump(pair):
    """The second continues when the first simulator has left."""
    first, second = pair
    first.time = 7.0
    assert spun([second], lambda: second.time > 7.0, first._step)
    time_then = second.time
    first.destroy_node()
    assert spun([second], lambda: second.clock.ours)
    second._step()
    assert time_then <= second.time <= first.time + 1.1 * STEP and second.count_publishers("/clock") == 1


def test_of_two_that_started_together_one_gives_way(pair, monkeypatch):
    """Both published before they discovered each other: the first by name continues, and soon there is one
    clock."""
    # For any duration of the test.
    monkeypatch.setattr("finssim.extensions.ros2.worlds.clock.CLAIMING", math.inf)
    first, second = pair
    now = 1e-9 * second.clock._steady.now().nanoseconds
    second.clock._claim(now)
    first.clock._claimed = now
    assert spun([first], lambda: first.count_publishers("/clock") == 2)
    for sim in (second, first):
        sim.clock.look()
    assert second.clock.ours and not first.clock.ours
    assert spun([first], lambda: first.count_publishers("/clock") == 1)
    second.time = 3.0
    assert spun([first], lambda: first.time > 3.0, second._step)
