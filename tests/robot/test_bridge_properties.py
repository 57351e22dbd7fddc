"""Thrust occurs only while armed, and only `arm` with no fault since arms, for any inputs in any order."""

import math

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from finssim.robot.bridge import STATES, Bridge, BridgeSettings
from finssim.vehicles import load_vehicle
from reference.bridge_rig import DT, echo, moves, quiet, reading, telemetry

FINSROV = load_vehicle("finsrov")
SLEW = 60.0  # [N/s]: 1 N a turn, so that thrust carried over from before a hold would show
RPM_LIMITS = np.array([(t.rpm_min, t.rpm_max) for t in FINSROV.thrusters.values()])
ODD = st.sampled_from([math.nan, math.inf, -math.inf, 1e308, -0.0])
NUMBERS = st.floats(-20.0, 20.0) | ODD
FORCES = st.lists(NUMBERS, min_size=8, max_size=8) | st.lists(NUMBERS, max_size=9) | st.none()
SOURCES = st.sampled_from(["pid", "pid", "pid", "ros"])
JUMPS = st.sampled_from([-1e6, -3.0, -0.2, 0.0, 0.9, 1.5, 3600.0, math.nan, math.inf])


class AnyOrder(RuleBasedStateMachine):
    """A healthy loop with random disturbances."""

    def __init__(self):
        super().__init__()
        self.bridge = Bridge(FINSROV, BridgeSettings.of(FINSROV, slew=np.full(8, SLEW)))
        self.now, self.count = 50.0, 100
        self.frame = self.bridge.tick(self.now)
        self.sent = np.zeros(8)  # thrusts of the last frame: none where it is not enabled
        self.allowed = False  # arm() succeeded, and nothing has disarmed or faulted since
        self.healthy_telemetry = self.healthy_command = -math.inf

    def note(self):
        """Withdraw the permission of a bridge in fault or disarmed, whatever the cause."""
        if self.bridge.state in ("fault", "disarmed"):
            self.allowed = False

    def tick(self):
        self.frame = self.bridge.tick(self.now)
        self.note()
        before, self.sent = self.sent, self.bridge.force * self.frame.enable
        assert (np.abs(self.sent - before) <= SLEW * DT + 1e-6).all() or not self.frame.enable
        if self.frame.enable:
            assert self.now - self.healthy_telemetry <= 0.5 + 1e-9
            assert self.now - self.healthy_command <= 0.5 + 1e-9
            rpm = self.bridge.motors.canonical_rpm(self.frame.normalised) * 3000.0
            assert (rpm >= RPM_LIMITS[:, 0] * (1 + 1e-4)).all() and (
                rpm <= RPM_LIMITS[:, 1] * (1 + 1e-4)
            ).all()

    @rule(turns=st.integers(1, 40), force=st.floats(-9.0, 9.0), commands=st.booleans())
    def healthy(self, turns, force, commands):
        for _ in range(turns):
            self.now, self.count = self.now + DT, self.count + 1
            self.bridge.telemetry(self.now, telemetry(self.count))
            self.bridge.reading(self.now, reading(self.now))
            self.healthy_telemetry = self.now
            if commands:
                self.bridge.command(self.now, np.full(8, force), "pid")
                self.healthy_command = self.now
            self.tick()

    @rule(turns=st.integers(1, 40), telemetry_comes=st.booleans(), junk=st.none() | st.just([1.0] * 7))
    def silence(self, turns, telemetry_comes, junk):
        for _ in range(turns):
            self.now, self.count = self.now + DT, self.count + 1
            if telemetry_comes:
                self.bridge.telemetry(self.now, telemetry(self.count))
                self.bridge.reading(self.now, reading(self.now))
                self.healthy_telemetry = self.now
            if junk:
                self.bridge.command(self.now, junk, "pid")
            self.tick()

    @rule()
    def arm(self):
        for _ in range(40):  # earlier messages may be too recent to arm on
            self.now, self.count = self.now + DT, self.count + 1
            self.bridge.telemetry(self.now, telemetry(self.count))
            self.bridge.reading(self.now, reading(self.now))
            self.healthy_telemetry = self.now
            self.tick()
        was = self.bridge.state
        refused = self.bridge.arm(self.now, "operator")
        assert refused == "" if was == "disarmed" else refused
        if not refused:
            self.allowed = True
            self.healthy_command = self.now  # the wait for the first command begins

    @rule()
    def arm_at_any_time(self):
        if self.bridge.arm(self.now, "operator") == "":
            assert self.now - self.healthy_telemetry <= 0.5 + 1e-9
            self.allowed = True
            self.healthy_command = self.now

    @rule(force=FORCES, source=SOURCES, age=st.none() | st.floats(-2.0, 2.0) | ODD)
    def command(self, force, source, age):
        stamp = None if age is None else self.now - age
        returned = self.bridge.command(self.now, force, source, stamp)
        fit = force is not None and len(force) == 8 and np.isfinite(force).all()
        if fit and (stamp is None or -0.1 <= self.now - stamp <= 0.5):
            self.healthy_command = self.now
        assert returned.shape == (8,) and np.isfinite(returned).all()
        assert (returned >= self.bridge.motors.lower).all() and (returned <= self.bridge.motors.upper).all()
        self.note()
        assert self.allowed or not returned.any()

    @rule(
        number=NUMBERS,
        place=st.sampled_from(["quaternion", "gyro", "accel", "depth", "motor_rpm"]),
        back=st.integers(-300, 300),
    )
    def odd_telemetry(self, number, place, back):
        size = {"quaternion": 4, "gyro": 3, "accel": 3, "motor_rpm": 7}.get(place)
        value = number if size is None else (number,) * size
        self.bridge.telemetry(self.now, telemetry(max(self.count + back, 0), **{place: value}))
        if math.isfinite(number):
            self.healthy_telemetry = self.now  # at most; the bridge may be stricter
        self.note()

    @rule(number=NUMBERS, ready=st.booleans(), mode=st.sampled_from(["fresh", "coast", "hold", "lost"]))
    def odd_reading(self, number, ready, mode):
        self.bridge.reading(self.now, reading(self.now, position=(number, 0.0, -0.5), ready=ready, mode=mode))
        self.note()

    @rule(count=st.integers(0, 500), ms=st.integers(0, 2**32 - 1), accepted=st.booleans())
    def any_echo(self, count, ms, accepted):
        self.bridge.echo(self.now, echo(count, accepted, mcu_ms=ms))
        self.note()

    @rule(jump=JUMPS)
    def clock(self, jump):
        was = self.bridge.state
        self.frame = self.bridge.tick(self.now + jump)
        self.note()
        self.sent = self.bridge.force * self.frame.enable
        if not (-0.05 <= jump <= 1.0) and was in ("armed", "hold"):
            assert self.bridge.state == "fault"
        if math.isfinite(jump) and abs(jump) < 1e4:
            self.now += max(jump, 0.0) if -0.05 <= jump <= 1.0 else jump
            self.healthy_telemetry = min(self.healthy_telemetry, self.now)
            self.healthy_command = min(self.healthy_command, self.now)

    @rule()
    def reboot(self):
        was = self.bridge.state
        self.now, self.count = self.now + DT, 0
        self.bridge.telemetry(self.now, telemetry(0))
        self.healthy_telemetry = self.now
        assert was not in ("armed", "hold") or self.bridge.state == "fault" or was == self.bridge.state
        self.note()

    @rule(call=st.sampled_from(["disarm", "hold", "resume"]))
    def operator(self, call):
        was = self.bridge.state
        getattr(self.bridge, call)(self.now)
        assert (self.bridge.state == "fault") == (was == "fault")
        self.note()

    @rule()
    def stop(self):
        self.bridge.stop(self.now, "red button")
        assert self.bridge.state == "fault"
        self.note()

    @precondition(lambda self: self.bridge.state == "fault")
    @rule()
    def acknowledge(self):
        self.bridge.acknowledge(self.now)
        assert self.bridge.state == "disarmed"

    @invariant()
    def thrust_only_while_armed(self):
        assert self.bridge.state in STATES
        assert all(-1.0 <= part <= 1.0 for part in self.frame.normalised)
        assert quiet(self.frame) or self.frame.enable
        if self.bridge.state in ("armed", "hold"):
            assert self.allowed
        again = self.bridge.tick(self.now)
        self.note()
        self.sent = self.bridge.force * again.enable
        if again.enable:
            assert self.bridge.state == "armed" and self.allowed
        else:
            assert quiet(again)


TestAnyOrder = AnyOrder.TestCase
TestAnyOrder.settings = settings(max_examples=35, stateful_step_count=40)


def test_the_machine_gets_under_way():
    """The property above is not vacuous: its healthy steps do arm the bridge and turn motors."""
    machine = AnyOrder()
    machine.arm()
    machine.healthy(40, 3.0, True)
    assert moves(machine.frame)
