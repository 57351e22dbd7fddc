"""The loop decides on its grid, arms once, and stops when the pilot fails."""

import math
import signal
from dataclasses import replace

import numpy as np
import pytest

from finssim.agents.agent import PidAgent
from finssim.control import ControlError
from finssim.control.guidance import Station
from finssim.robot.links.frames import MCU, Decoder, encode_telemetry
from finssim.robot.lockstep import run_lockstep
from finssim.robot.messages import Delivery, Picture
from finssim.robot.perception import Perception
from finssim.robot.pilots import AgentPilot, make_pilot
from finssim.robot.runtime import Runtime
from finssim.vehicles import load_vehicle
from reference.rounds import Rounds, overhead, without_latency

VEHICLE = without_latency(load_vehicle("finsrov"))
POOL = overhead()
STATION = Station((0.5, 0.2, -0.5), 0.3)


class Shown:
    """A world with a vehicle on its rounds that ignores commands but keeps them."""

    def __init__(self, *, telemetry=lambda t: True, pictures=lambda t: True, **options):
        self.rounds, self.sent = Rounds(POOL, VEHICLE, **options), []
        self.telemetry, self.pictures = telemetry, pictures
        self.frames, self.seen = 0, 0

    def exchange(self, until, sent):
        self.sent += [(until, frame) for frame in sent]
        frames, pictures = [], []
        while self.frames * 0.01 <= until:
            t = self.frames * 0.01
            if self.telemetry(t):
                frames.append((t, encode_telemetry(self.rounds.telemetry(t, self.frames))))
            self.frames += 1
        while self.seen / 30.0 + POOL.latency <= until:
            if self.pictures(self.seen / 30.0):
                pictures.append(self.rounds.picture(self.seen / 30.0, self.seen))
            self.seen += 1
        return Delivery(until, tuple(frames), tuple(pictures))

    def commands(self):
        """Return time and command of each frame that was sent."""
        decoder = Decoder(MCU)
        return [(t, command) for t, frame in self.sent for command in decoder.feed(frame)]


class Constant:
    """A pilot with a constant command."""

    name, period, needs_state = "constant", 0.1, True

    def __init__(self, force=None):
        self.force, self.times = np.full(8, 1.0) if force is None else force, []

    def describe(self):
        return {"name": self.name}

    def reset(self):
        self.times = []

    def act(self, reading, guide, t):
        self.times.append(t)
        if isinstance(self.force, Exception):
            raise self.force
        return self.force


def test_a_decision_falls_on_every_multiple_of_the_pilots_period():
    """At 60 steps and 10 decisions a second no decision is missed, and each is within a step of its time."""
    pilot = Constant()
    runtime = Runtime(VEHICLE, Perception(VEHICLE, POOL), pilot, STATION, arm=True)
    run_lockstep(runtime, Shown(), 3.0)
    expected = 0.1 * np.arange(len(pilot.times))
    np.testing.assert_allclose(pilot.times, expected, atol=1e-6)
    assert len(pilot.times) >= 25 and runtime.counters.missed == 0


def test_a_late_loop_misses_decisions_and_counts_them():
    """After 0.35 s without a step, three decisions at 10 Hz are missed; the grid does not shift."""
    pilot = Constant()
    runtime, world = Runtime(VEHICLE, Perception(VEHICLE, POOL), pilot, STATION), Shown()
    for k in range(1, 121):
        now = k / 60 if k <= 60 else k / 60 + 0.35
        delivery = world.exchange(now, ())
        runtime.step(now, delivery.frames, delivery.pictures)
    assert runtime.counters.missed == 3
    assert pilot.times[-1] % 0.1 == pytest.approx(0.0, abs=0.02) or pilot.times[-1] % 0.1 > 0.08


def test_ctrl_c_interrupts_a_trial_and_ends_a_gentle_run_in_good_order():
    """An interrupted trial raises; an interrupted run of the robot ends with frames that stop its thrusters."""

    def press(runtime):
        if runtime.counters.decisions == 5:
            signal.raise_signal(signal.SIGINT)

    runtime, world = Runtime(VEHICLE, Perception(VEHICLE, POOL), Constant(), STATION, arm=True), Shown()
    with pytest.raises(KeyboardInterrupt):
        run_lockstep(runtime, world, 2.0, show=press)
    runtime, world = Runtime(VEHICLE, Perception(VEHICLE, POOL), Constant(), STATION, arm=True), Shown()
    assert run_lockstep(runtime, world, 2.0, gentle=True, show=press) < 1.0
    assert not any(world.commands()[-1][1].normalised)


def test_without_arming_no_thruster_is_ever_enabled():
    """A dry run makes decisions and sends zeros."""
    runtime, world = Runtime(VEHICLE, Perception(VEHICLE, POOL), Constant(), STATION), Shown()
    run_lockstep(runtime, world, 2.0)
    assert runtime.counters.decisions > 10
    assert not any(c.enable or any(c.normalised) for _, c in world.commands())


def test_an_armed_run_commands_and_ends_with_three_frames_without_thrust():
    """The run arms as soon as the state is ready, and disarms at the end."""
    runtime, world = Runtime(VEHICLE, Perception(VEHICLE, POOL), Constant(), STATION, arm=True), Shown()
    run_lockstep(runtime, world, 2.0)
    enabled = [c.enable for _, c in world.commands()]
    assert any(enabled) and enabled[-4:] == [True, False, False, False]
    assert runtime.bridge.state == "disarmed"


@pytest.mark.parametrize(
    "wish",
    [RuntimeError("broken network"), np.full(8, math.nan), np.zeros(7)],
    ids=["raises", "nan", "short"],
)
def test_a_pilot_that_fails_stops_the_vehicle(wish):
    """A fault with the reason follows, and zero frames until it is acknowledged."""
    runtime, world = Runtime(VEHICLE, Perception(VEHICLE, POOL), Constant(wish), STATION, arm=True), Shown()
    run_lockstep(runtime, world, 2.0)
    assert runtime.bridge.state == "fault" and "pilot constant" in runtime.bridge.reason
    assert not any(any(c.normalised) for _, c in world.commands())


def test_it_never_arms_a_second_time():
    """After a fault the vehicle stays stopped although all conditions are good again."""
    runtime = Runtime(VEHICLE, Perception(VEHICLE, POOL), Constant(), STATION, arm=True)
    world = Shown(telemetry=lambda t: not 1.5 < t < 2.5)
    run_lockstep(runtime, world, 4.0)
    late = [c for t, c in world.commands() if t > 2.2]
    assert runtime.bridge.state == "fault" and not any(c.enable for c in late)


def test_three_seconds_without_vision_hold_the_vehicle():
    """There is no thrust from one second after the last picture until pictures return; then thrust resumes by
    itself."""
    runtime = Runtime(VEHICLE, Perception(VEHICLE, POOL), Constant(), STATION, arm=True)
    world = Shown(pictures=lambda t: not 2.0 < t < 5.0)
    run_lockstep(runtime, world, 7.0)
    enabled = {round(60 * t): c.enable for t, c in world.commands()}
    assert enabled[round(60 * 1.9)] and not any(enabled[k] for k in range(round(60 * 3.0), round(60 * 5.0)))
    assert enabled[round(60 * 6.9)]


def test_the_latency_counts_from_the_newest_picture_in_the_state():
    """In lock-step a picture waits for the next decision, at most one period of the pilot."""
    runtime = Runtime(VEHICLE, Perception(VEHICLE, POOL), Constant(), STATION, arm=True)
    run_lockstep(runtime, Shown(), 3.0)
    summary = runtime.counters.summary()
    assert 0.0 <= summary["latency_s"]["p50"] <= summary["latency_s"]["p99"] <= 1 / 30 + 1 / 60 + 1e-6


def test_any_bytes_are_survived():
    """Garbage, partial frames and frames of another kind do not stop the loop."""
    runtime, rng = (
        Runtime(VEHICLE, Perception(VEHICLE, POOL), make_pilot("pid", VEHICLE), STATION, arm=True),
        np.random.default_rng(0),
    )
    world = Shown()
    for k in range(1, 200):
        delivery = world.exchange(k / 60, ())
        noise = [(k / 60, rng.bytes(int(rng.integers(0, 200)))) for _ in range(3)]
        cut = [
            (t, frame[: int(rng.integers(0, len(frame)))])
            for t, frame in delivery.frames
            if rng.random() < 0.2
        ]
        runtime.step(k / 60, [*delivery.frames, *noise, *cut], delivery.pictures)
    assert runtime.bridge.state == "armed"


class Seeing(Constant):
    """A pilot that uses the picture of a vehicle camera, and keeps those that it receives."""

    def __init__(self):
        super().__init__()
        self.pictures, self.took, self.shown = {"front_camera": (2, 3, 3)}, 0.004, []

    def act(self, reading, guide, t):
        self.shown.append(reading.pictures["front_camera"].sequence)
        return super().act(reading, guide, t)


class Filmed(Shown):
    """The same world with readings of the vehicle's own sensors, 0.1 s late, from 1 s until a given end."""

    def __init__(self, end):
        super().__init__()
        self.end, self.filmed = end, 10

    def exchange(self, until, sent):
        delivery, own = super().exchange(until, sent), []
        while self.filmed / 10.0 + 0.1 <= min(until, self.end + 0.1):
            image = np.full((2, 3, 3), self.filmed, np.uint8)
            own.append(Picture(self.filmed / 10.0 + 0.1, self.filmed, image, source="front_camera"))
            own.append(Picture(until, self.filmed, source="stranger"))
            self.filmed += 1
        return replace(delivery, pictures=(*delivery.pictures, *own))


def test_a_pilot_that_sees_waits_for_pictures_and_stops_when_they_stop():
    """It is not armed before the first picture; thrust ends at most 0.5 s plus the camera's 0.1 s after the
    last one."""
    pilot, world = Seeing(), Filmed(end=3.0)
    runtime = Runtime(VEHICLE, Perception(VEHICLE, POOL), pilot, STATION, arm=True)
    run_lockstep(runtime, world, 5.0)
    assert runtime.started == pytest.approx(1.1, abs=0.02)
    assert pilot.shown[0] == 10 and pilot.shown[-1] == 30 and len(pilot.shown) == pytest.approx(26, abs=2)
    assert runtime.started + pilot.times[-1] == pytest.approx(3.55, abs=0.1)
    assert runtime.reading.reason.startswith("the last picture of front_camera is")
    assert runtime.bridge.state == "hold" or not any(world.commands()[-1][1].normalised)
    assert dict(runtime.counters.onboard) == {"front_camera": 21}


def test_the_age_of_pictures_at_the_command_is_measured():
    """With a 10 Hz camera that is 0.1 s late, exposures are 0.1 to 0.2 s old, depending on the phase of
    decisions."""
    pilot = Seeing()
    runtime = Runtime(VEHICLE, Perception(VEHICLE, POOL), pilot, STATION, arm=True)
    run_lockstep(runtime, Filmed(end=9.0), 6.0)
    told = runtime.counters.summary()
    assert 0.1 <= told["exposure_to_command_s"]["p50"] <= 0.2 + 1 / 60
    assert told["inference_s"]["p50"] == 0.004 and told["onboard"] == {"front_camera": 50}


def test_a_vehicle_without_the_camera_is_refused():
    """The refusal comes before anything runs and lists the available sensors."""
    with pytest.raises(ControlError, match="pid sees periscope, which finsrov does not have: .*front_camera"):
        AgentPilot(PidAgent("pid", VEHICLE), VEHICLE, pictures={"periscope": (4, 4, 3)})
