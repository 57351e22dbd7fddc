"""The bridge enables thrusters only when armed, and every watchdog stops them."""

import math

import numpy as np
import pytest

from finssim.robot.bridge import Bridge, BridgeError, BridgeSettings
from finssim.robot.links.frames import StatusFlag
from finssim.vehicles import load_vehicle
from reference.bridge_rig import DT, Rig, echo, moves, quiet, reading, telemetry
from reference.cases import THRUSTED
from reference.finned import torpedo

FINSROV = load_vehicle("finsrov")
TILTED = (math.sin(0.2), 0.0, 0.0, math.cos(0.2))  # 0.4 rad of roll: over the file's 20 degrees


@pytest.fixture
def rig():
    """FinsROV, healthy and disarmed."""
    return Rig(FINSROV)


@pytest.mark.parametrize("name", THRUSTED)
def test_every_vehicle_runs_once_armed_and_not_before(name):
    """With or without an mcu and a safety section: zeros until armed, thrust while armed, zeros when
    disarmed."""
    vehicle = load_vehicle(name)
    rig = Rig(vehicle)
    assert all(map(quiet, rig.run(0.3)))
    rig.armed(0.5 * rig.bridge.motors.upper)
    np.testing.assert_allclose(rig.bridge.force, 0.5 * rig.bridge.motors.upper)
    rig.bridge.disarm(rig.now)
    assert all(map(quiet, rig.run(0.3, 1.0)))
    assert rig.bridge.state == "disarmed"


def test_thrust_needs_arming_and_no_command_arms(rig):
    """A disarmed bridge answers any number of commands with zeros and does not arm."""
    assert all(map(quiet, rig.run(3.0, 5.0)))
    assert not rig.bridge.command(rig.now, np.ones(8), "pid").any()


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda rig: rig.run(0.6, telemetry_=None), "no fresh telemetry"),
        (lambda rig: rig.run(1.7, telemetry_=lambda k, n: telemetry(5000)), "no fresh telemetry"),
        (lambda rig: rig.run(0.2, reading_=lambda t: reading(t, ready=False, reason="no tag")), "no tag"),
        (lambda rig: rig.run(0.2, reading_=lambda t: reading(t, mode="lost")), "vision is lost"),
        (lambda rig: rig.run(0.6, reading_=None), "older than 0.5 s"),
        (lambda rig: rig.run(0.2, 1.0), "command is not zero"),
        (lambda rig: [rig.step(0.0, source=s) for s in "ab"], "two publishers"),
        (lambda rig: rig.run(0.2, reading_=lambda t: reading(t, position=(2.2, 0.0, -0.5))), "workspace"),
        (lambda rig: rig.run(0.5, telemetry_=lambda k, n: telemetry(k, n, gyro=(0, 0, 0))), "frozen"),
        (lambda rig: rig.run(1.2, reading_=lambda t: reading(t, quaternion=TILTED)), "tilted"),
        (lambda rig: rig.bridge.stop(rig.now, "red button"), "acknowledge the fault first: red button"),
        (lambda rig: rig.armed(), "state armed already"),
    ],
)
def test_arming_is_refused_with_one_sentence(rig, spoil, why):
    """Each obstacle to arming is named, and the state does not change."""
    rig.run(0.2)
    spoil(rig)
    before = rig.bridge.state
    assert why in rig.bridge.arm(rig.now, "operator")
    assert rig.bridge.state == before


def test_a_bridge_that_heard_nothing_cannot_be_armed():
    """Without telemetry and without an estimator, arming is refused."""
    bridge = Bridge(FINSROV)
    assert "telemetry" in bridge.arm(5.0, "operator")
    bridge.telemetry(5.0, telemetry(1))
    assert "no output of the estimator yet" in bridge.arm(5.0, "operator")


def test_teleoperation_may_arm_without_localization():
    """With need_reading=False telemetry alone is enough, and losing vision does not stop the operator."""
    rig = Rig(FINSROV, need_reading=False)
    rig.run(0.2, reading_=None)
    assert rig.bridge.arm(rig.now, "pad") == ""
    frames = rig.run(2.0, 2.0, reading_=lambda t: reading(t, ready=False))
    assert moves(frames[-1]) and rig.bridge.state == "armed"


def spoiled_telemetry(**changes):
    """Return loop turns in which the motor controller's telemetry has these changes."""
    return lambda rig: rig.step(2.0, telemetry_=lambda k, n: telemetry(k, n, **changes))


FROZEN = {"gyro": (0.1, 0.2, 0.3)}
FAULTS = {
    "silent telemetry": (lambda rig: rig.step(2.0, telemetry_=None), "no fresh telemetry", 0.5),
    "same message again and again": (
        lambda rig: rig.step(2.0, telemetry_=lambda k, n: telemetry(6000)), "no fresh telemetry", 0.55),
    "frozen gyro": (spoiled_telemetry(**FROZEN), "the gyro has repeated", 0.35),
    "frozen accelerometer": (spoiled_telemetry(accel=(0.0, 0.0, 9.81)), "the accel has repeated", 0.35),
    "NaN in telemetry": (spoiled_telemetry(depth=math.nan), "no fresh telemetry", 0.5),
    "too few motors": (spoiled_telemetry(motor_rpm=(0.0,) * 6), "no fresh telemetry", 0.5),
    "attitude of zeros": (spoiled_telemetry(quaternion=(0.0,) * 4), "no fresh telemetry", 0.5),
    "restart": (lambda rig: rig.step(2.0, telemetry_=lambda k, n: telemetry(k - 4990, n)), "restarted", 0.0),
    "tilt by telemetry": (spoiled_telemetry(quaternion=TILTED), "tilted beyond 20 degrees", 1.0),
    "tilt by the estimator": (
        lambda rig: rig.step(2.0, reading_=lambda t: reading(t, quaternion=TILTED)), "says the estimator", 1.0),
    "outside": (
        lambda rig: rig.step(2.0, reading_=lambda t: reading(t, position=(0.0, -1.15, -0.5))), "y is -1.15 m", 0.0),
    "second publisher": (lambda rig: (rig.step(2.0), rig.step(2.0, source="ros")), "two publishers", 0.05),
    "emergency stop": (lambda rig: (rig.bridge.stop(rig.now, "red button"), rig.step(2.0)), "red button", 0.0),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_stops_until_it_is_acknowledged(rig, name):
    """Zeros within the limit plus one turn; the end of the condition, commands and arming do not clear the
    fault."""
    spoil, why, limit = FAULTS[name]
    rig.armed()
    began = rig.now
    while rig.bridge.state != "fault":
        spoil(rig)
        assert rig.now - began <= limit + 3 * DT
    assert why in rig.bridge.reason and quiet(rig.frame)
    assert all(map(quiet, rig.run(2.0, 2.0)))
    assert rig.bridge.arm(rig.now, "operator")
    rig.bridge.disarm(rig.now)
    assert rig.bridge.state == "fault"
    rig.bridge.acknowledge(rig.now)
    assert rig.bridge.state == "disarmed" and all(map(quiet, rig.run(1.0, 2.0)))
    rig.run(0.6, telemetry_=telemetry)
    assert rig.bridge.arm(rig.now, "operator") == ""


WAITS = {
    "no command": (lambda rig: rig.step(None), "no command", 0.5),
    "wrong length": (lambda rig: (rig.bridge.command(rig.now, np.ones(7), "pid"), rig.step(None)), "no command", 0.5),
    "NaN command": (lambda rig: rig.step([math.nan] * 8), "no command", 0.5),
    "words": (lambda rig: (rig.bridge.command(rig.now, "full ahead", "pid"), rig.step(None)), "no command", 0.5),
    "old stamp": (
        lambda rig: (rig.bridge.command(rig.now, np.ones(8), "pid", stamp=rig.now - 0.6), rig.step(None)),
        "no command", 0.5),
    "stamp from the future": (
        lambda rig: (rig.bridge.command(rig.now, np.ones(8), "pid", stamp=rig.now + 9.0), rig.step(None)),
        "no command", 0.5),
    "estimator not ready": (
        lambda rig: rig.step(2.0, reading_=lambda t: reading(t, ready=False, reason="no tag")), "no tag", 0.0),
    "vision holds": (lambda rig: rig.step(2.0, reading_=lambda t: reading(t, mode="hold")), "vision is hold", 0.0),
    "silent estimator": (lambda rig: rig.step(2.0, reading_=None), "older than 0.5 s", 0.5),
    "estimator that stands still": (lambda rig: rig.step(2.0, reading_=lambda t: reading(100.7)), "older", 0.55),
    "NaN position": (
        lambda rig: rig.step(2.0, reading_=lambda t: reading(t, position=[math.nan] * 3)), "not finite", 0.0),
}  # fmt: skip


@pytest.mark.parametrize("name", WAITS)
def test_a_passing_condition_holds_and_thrust_returns_by_itself(rig, name):
    """A hold sends disabled zeros, thrust returns with the first command afterwards; after 5 s it becomes a
    fault."""
    spoil, why, limit = WAITS[name]
    rig.armed()
    began = rig.now
    while rig.bridge.state == "armed":
        spoil(rig)
        assert rig.now - began <= limit + 3 * DT
    assert rig.bridge.state == "hold" and why in rig.bridge.reason and quiet(rig.frame)
    while rig.now - began < 3.0:
        spoil(rig)
        assert quiet(rig.frame)
    rig.run(0.1)
    assert rig.bridge.state == "hold"  # nothing moves before the first command
    rig.run(0.1, 2.0)
    assert rig.bridge.state == "armed" and moves(rig.frame)
    while rig.bridge.state != "fault":
        spoil(rig)
        assert rig.now - began < 3.3 + limit + 5.0 + 4 * DT
    assert "held longer than 5 s" in rig.bridge.reason


def test_a_controller_that_is_silent_for_want_of_a_state_is_not_blamed(rig):
    """The reported reason is the estimator's, both in hold and in the fault that follows."""
    rig.armed()
    rig.run(2.0, reading_=lambda t: reading(t, ready=False, reason="no depth"))
    assert rig.bridge.state == "hold" and "no depth" in rig.bridge.reason
    rig.run(4.0, reading_=lambda t: reading(t, ready=False, reason="no depth"))
    assert rig.bridge.state == "fault" and "no depth" in rig.bridge.reason


def test_the_operator_may_hold_for_as_long_as_needed(rig):
    """The operator's own hold has no time limit and no thrust; other conditions still become faults."""
    rig.armed()
    rig.bridge.hold(rig.now)
    assert all(map(quiet, rig.run(20.0, 2.0))) and rig.bridge.state == "hold"
    rig.bridge.resume(rig.now)
    rig.run(0.1, 2.0)
    assert rig.bridge.state == "armed" and moves(rig.frame)
    rig.bridge.hold(rig.now)
    rig.run(0.6, 2.0, telemetry_=None)
    assert rig.bridge.state == "fault"


@pytest.mark.parametrize("jump", [-0.5, -3600.0, 1.5, 1e9, math.nan, math.inf])
def test_a_clock_that_jumps_is_a_fault(rig, jump):
    """A clock that jumps backwards, jumps more than a second forwards or is not a number causes a fault."""
    rig.armed()
    assert quiet(rig.bridge.tick(rig.now + jump)) and "clock" in rig.bridge.reason
    rig.bridge.acknowledge(rig.now)
    assert rig.bridge.state == "disarmed"


def test_a_loop_that_stood_still_is_a_fault(rig):
    """Messages kept arriving, but for more than a second the loop did not tick: thrust would have been blind."""
    rig.armed()
    for _ in range(65):
        rig.now, rig.count = rig.now + DT, rig.count + 1
        rig.bridge.telemetry(rig.now, telemetry(rig.count))
        rig.bridge.reading(rig.now, reading(rig.now))
        rig.bridge.command(rig.now, np.ones(8), "pid")
    assert quiet(rig.bridge.tick(rig.now)) and "stood still" in rig.bridge.reason


def test_lost_repeated_and_overtaken_messages_are_no_fault(rig):
    """Losing half of the telemetry, repeating every message and mixing in old ones does not stop the vehicle."""
    rig.armed()
    for turn in range(240):
        rig.step(2.0, telemetry_=telemetry if turn % 2 else None)
        rig.bridge.telemetry(rig.now, telemetry(rig.count - 20))
        rig.bridge.telemetry(rig.now, telemetry(rig.count - 1))
    assert rig.bridge.state == "armed" and moves(rig.frame)


def test_counters_of_the_controller_may_roll_over(rig):
    """The sequence (modulo 2^16) and the clock (modulo 2^32) roll over without a fault."""
    rig.armed()

    def rolling(k, n):
        return telemetry(
            k, n, sequence=(65536 - 5030 + k - 90) % 65536, mcu_ms=(2**32 + 10 * (k - 5090)) % 2**32
        )

    rig.bridge.disarm(rig.now)
    rig.run(0.6, telemetry_=None)
    rig.run(0.2, telemetry_=rolling)
    assert rig.bridge.arm(rig.now, "operator") == ""
    rig.run(3.0, 2.0, telemetry_=rolling)
    assert rig.bridge.state == "armed"


def test_refused_commands_become_a_fault_if_it_lasts(rig):
    """One rejected command is an event; half a second of nothing but rejections is a fault."""
    rig.armed()
    rig.bridge.drain()
    rig.bridge.echo(rig.now, echo(1))
    rig.bridge.echo(rig.now, echo(2, accepted=False, flags=8))
    rig.run(0.2, 2.0)
    assert rig.bridge.state == "armed"
    assert "flags 0x8" in next(e.text for e in rig.bridge.drain() if e.kind == "command rejected")
    rig.bridge.echo(rig.now, echo(3))
    for turn in range(40):
        rig.bridge.echo(rig.now, echo(4 + turn, accepted=False, flags=4))
        rig.step(2.0)
    assert rig.bridge.state == "fault" and "refused every command" in rig.bridge.reason


def test_a_controller_that_hears_no_command_is_a_fault(rig):
    """Status bits decide: a controller that follows commands, even intermittently, or does not report it is
    not at fault."""
    rig.armed()
    told = StatusFlag.DIAGNOSTICS
    rig.run(1.0, 2.0, telemetry_=lambda k, n: telemetry(k, n, flags=int(told | StatusFlag.DIRECT_THRUSTERS)))
    follows = [0, int(StatusFlag.DIRECT_THRUSTERS)]
    rig.run(1.0, 2.0, telemetry_=lambda k, n: telemetry(k, n, flags=int(told) | follows[k % 20 == 0]))
    rig.run(1.0, 2.0, telemetry_=lambda k, n: telemetry(k, n, flags=0))
    assert rig.bridge.state == "armed"
    rig.run(0.6, 2.0, telemetry_=lambda k, n: telemetry(k, n, flags=int(told)))
    assert rig.bridge.state == "fault" and "not followed any command" in rig.bridge.reason


def test_a_count_of_commands_that_begins_again_is_a_restart(rig):
    """An echo with a smaller count and a later clock means that the controller restarted."""
    rig.armed()
    rig.bridge.echo(rig.now, echo(500, mcu_ms=50_000))
    rig.bridge.echo(rig.now, echo(499, mcu_ms=49_990))  # arrived out of order
    assert rig.bridge.state == "armed"
    rig.bridge.echo(rig.now, echo(3, mcu_ms=50_100))
    assert rig.bridge.state == "fault" and "began again" in rig.bridge.reason


def test_commands_are_limited_in_force_and_in_slew():
    """±50 N are clipped to the limits of each thruster, which are approached at the configured slew rate."""
    rig = Rig(FINSROV, slew=np.full(8, 20.0))
    rig.run(0.2)
    rig.bridge.arm(rig.now, "operator")
    limited = rig.bridge.command(rig.now, np.full(8, 50.0), "pid")
    np.testing.assert_allclose(limited, rig.bridge.motors.upper)
    before = rig.bridge.force
    for command in [50.0] * 60 + [-50.0] * 60:
        rig.step(command)
        assert (np.abs(rig.bridge.force - before) <= 20.0 * DT + 1e-9).all()
        before = rig.bridge.force
    np.testing.assert_allclose(before, rig.bridge.motors.lower)


def test_thrust_after_a_hold_begins_at_zero():
    """The slew limit restarts from zero after a hold; thrust from before it is not carried over."""
    rig = Rig(FINSROV, slew=np.full(8, 20.0)).armed()
    rig.bridge.hold(rig.now)
    rig.run(0.2, 2.0)
    rig.bridge.resume(rig.now)
    while not rig.frame.enable:
        rig.step(2.0)
    assert (np.abs(rig.bridge.force) <= 20.0 * DT + 1e-9).all()


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_near_a_face_thrust_only_pushes_inwards(rig, axis, side):
    """Outward force is removed, inward force and the moment remain, at any heading."""
    rig.armed()
    position = np.array([0.0, 0.0, -0.5])
    face = FINSROV.safety.workspace_upper if side > 0 else FINSROV.safety.workspace_lower
    position[axis] = face[axis] + side * 0.05
    yaw = (0.0, 0.0, math.sin(0.4), math.cos(0.4))
    rig.step(0.0, reading_=lambda t: reading(t, position=position, quaternion=yaw))
    R = np.array([[math.cos(0.8), -math.sin(0.8), 0], [math.sin(0.8), math.cos(0.8), 0], [0, 0, 1.0]])
    B = FINSROV.control_matrix
    rng = np.random.default_rng(axis)
    for _ in range(20):
        force = rng.uniform(-1.0, 1.0, 8)
        limited = rig.bridge.command(rig.now, force, "pid")
        asked, given = B @ force, B @ limited
        push, left = R @ asked[:3], R @ given[:3]
        expected = np.where(np.arange(3) == axis, side * min(0.0, side * push[axis]), push)
        np.testing.assert_allclose(left, expected, atol=0.01)
        np.testing.assert_allclose(given[3:], asked[3:], atol=0.01)


def test_a_face_that_thrust_cannot_avoid_stops_it():
    """A vehicle with one thruster along its axis gets no thrust when it heads out of the box."""
    lauv = load_vehicle("lauv")
    rig = Rig(lauv, workspace_lower=np.full(3, -9.0), workspace_upper=np.full(3, 9.0))
    rig.armed()
    rig.step(5.0, reading_=lambda t: reading(t, position=(9.0, 0.0, -2.0)))
    assert not rig.bridge.command(rig.now, [5.0], "pid").any()
    assert rig.bridge.command(rig.now, [-5.0], "pid")[0] < 0.0


def test_events_tell_what_happened_once(rig):
    """A state change is one event; a thousand refused commands are logged as one line per second."""
    rig.armed()
    for _ in range(1000):
        rig.bridge.command(rig.now, np.ones(3), "pid")
    rig.bridge.stop(rig.now, "red button")
    events = rig.bridge.drain()
    assert [e.kind for e in events] == ["armed", "command refused", "fault"]
    assert rig.bridge.log.counts["command refused"] == 1000 and rig.bridge.drain() == []


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"command_timeout": 0.0}, "above 0"),
        ({"hold_limit": math.nan}, "above 0"),
        ({"workspace_margin": -0.1}, "0 m or more"),
        ({"workspace_lower": np.zeros(2)}, "three numbers"),
        ({"workspace_lower": np.full(3, 5.0)}, "below"),
        ({"slew": np.zeros(8)}, "above 0 N/s"),
        ({"colour": "red"}, "no bridge setting colour"),
    ],
)
def test_limits_that_cannot_be_kept_are_refused(changes, why):
    """Each invalid limit is named together with what was expected."""
    with pytest.raises(BridgeError, match=why):
        BridgeSettings.of(FINSROV, **changes)


def test_a_slew_for_another_vehicle_is_refused():
    """The slew must have one rate per thruster."""
    with pytest.raises(BridgeError, match="expected 8"):
        Bridge(FINSROV, BridgeSettings.of(FINSROV, slew=np.ones(6)))


TORPEDO = torpedo()


def with_values(*values):
    """Return telemetry of version 2 with these values of the other actuators."""
    return lambda k, n: telemetry(k, n, actuators=values)


def test_setpoints_follow_the_thrusts_within_the_travel_of_each_actuator():
    """Channels beyond the thrusters are sent unchanged but limited; a command of thrusts alone leaves them as
    they are."""
    rig = Rig(TORPEDO)
    at = with_values(0.0, 0.0, 0.0, 0.0)
    rig.run(0.2, telemetry_=at)
    assert rig.bridge.arm(rig.now, "pid") == ""
    rig.n = 5
    rig.run(0.3, [5.0, 0.2, -1.0, 2e-4, 0.01], telemetry_=at)
    assert rig.bridge.state == "armed" and rig.frame.enable and rig.frame.normalised[0] > 0.0
    np.testing.assert_allclose(rig.frame.setpoints, [0.2, -0.35, 2e-4, 0.01])
    rig.n = 1
    rig.run(0.1, 5.0, telemetry_=at)
    np.testing.assert_allclose(rig.frame.setpoints, [0.2, -0.35, 2e-4, 0.01])
    rig.n = 3
    rig.run(0.1, 5.0, telemetry_=at)
    assert "expected 1 thrusts, or 5 numbers with the other actuators" in rig.bridge.drain()[-1].text


@pytest.mark.parametrize("end", ["disarm", "stop"])
def test_fins_go_to_zero_and_an_engine_stays_when_the_bridge_is_not_armed(end):
    """On disarming and in a fault an actuator goes to its `off` value or, without one, keeps the newest
    measured value."""
    rig = Rig(TORPEDO)
    at = with_values(0.1, 0.1, 3e-4, 0.02)
    rig.run(0.2, telemetry_=at)
    assert rig.bridge.arm(rig.now, "pid") == ""
    rig.n = 5
    rig.run(0.3, [5.0, 0.2, 0.2, 2e-4, 0.01], telemetry_=at)
    getattr(rig.bridge, end)(rig.now, *(["red button"] if end == "stop" else []))
    rig.step(telemetry_=at)
    assert quiet(rig.frame)
    np.testing.assert_allclose(rig.frame.setpoints, [0.0, 0.0, 3e-4, 0.02])


def test_a_controller_of_version_1_is_refused_where_there_are_other_actuators():
    """The refusal names the actuators in one sentence; a vehicle with thrusters alone still arms."""
    rig = Rig(TORPEDO)
    rig.run(0.2, telemetry_=lambda k, n: telemetry(k, n))
    reason = rig.bridge.arm(rig.now, "pid")
    assert reason == (
        "the motor controller uses version 1 of the protocol, which has thrusters alone: rudder, elevator, engine, "
        "battery need a firmware with version 2"
    )
