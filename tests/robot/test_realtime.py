"""The outermost loop: deadlines count from the start, overruns are counted, and thrusters stop however the
loop ends."""

import gc
import os
import signal
import threading

import numpy as np
import pytest

from finssim.control.guidance import Station
from finssim.robot.links.frames import MCU, Decoder, encode_telemetry
from finssim.robot.links.transports import memory_pair
from finssim.robot.messages import Picture
from finssim.robot.perception import Perception
from finssim.robot.pictures import TagFinder
from finssim.robot.pilots import make_pilot
from finssim.robot.runtime import Runtime
from finssim.robot.wiring import Wires, run_realtime
from finssim.vehicles import load_vehicle
from reference.rounds import Rounds, overhead, without_latency
from reference.tag_picture import draw, pose_corners

VEHICLE = without_latency(load_vehicle("finsrov"))
POOL = overhead()


class Acted:
    """Simulated clock, wire and camera of a vehicle on its rounds; `wait` advances the time."""

    def __init__(self):
        self.now, self.rounds = 100.0, Rounds(POOL, VEHICLE)
        self.ours, self.theirs = memory_pair()
        self.frames, self.seen, self.steps = 10_000, 3000, []
        self.closed = False

    def clock(self):
        return self.now

    def wait(self, time):
        self.now += time
        while self.frames * 0.01 <= self.now:
            self.theirs.send(encode_telemetry(self.rounds.telemetry(self.frames * 0.01, self.frames)))
            self.frames += 1

    def receive(self, now):
        pictures = []
        while self.seen / 30.0 + POOL.latency <= now:
            pictures.append(self.rounds.picture(self.seen / 30.0, self.seen))
            self.seen += 1
        return pictures

    def close(self):
        self.closed = True

    def runtime(self):
        return Runtime(
            VEHICLE,
            Perception(VEHICLE, POOL),
            make_pilot("pid", VEHICLE),
            Station((0.5, 0.2, -0.5), 0.3),
            arm=True,
        )

    def run(self, runtime, **options):
        return run_realtime(runtime, Wires(self.ours, self), clock=self.clock, wait=self.wait, **options)

    def commands(self):
        decoder = Decoder(MCU)
        return [command for data in self.theirs.receive() for command in decoder.feed(data)]


@pytest.mark.slow
def test_it_steps_at_its_rate_arms_and_ends_with_frames_without_thrust():
    """Two seconds at 60 Hz are 120 steps, none late; the last three frames are disabled."""
    world = Acted()
    runtime = world.runtime()
    assert world.run(runtime, duration=2.0) == pytest.approx(2.0, abs=0.02)
    assert runtime.counters.steps in (120, 121) and runtime.counters.overruns == 0
    enabled = [c.enable for c in world.commands()]
    assert any(enabled) and enabled[-4:] == [True, False, False, False]


@pytest.mark.slow
def test_a_late_step_is_an_overrun_and_shifts_no_deadline():
    """A step of 55 ms misses two deadlines; the next step follows at once, and later ones stay multiples of
    the period."""
    world, times = Acted(), []

    def show(runtime):
        times.append(world.now)
        if runtime.counters.steps == 30:
            world.now += 0.055

    runtime = world.runtime()
    world.run(runtime, duration=1.0, show=show)
    assert runtime.counters.overruns == 1
    turns = (np.array(times) - 100.0) * 60.0
    assert turns[30] == pytest.approx(29.0 + 0.055 * 60.0)
    turns = np.delete(turns, 30)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-6)
    assert len(times) == 58


@pytest.mark.slow
def test_what_was_decided_before_a_standstill_is_not_sent_after_it():
    """After 9 s of standstill within a step, as by SIGSTOP, no frame turns a thruster and the run is in
    fault."""
    world, enabled, said = Acted(), {}, []
    runtime = world.runtime()
    step = runtime.step

    def stopped(now, *what):
        made = step(now, *what)
        world.now += 9.0 if runtime.counters.steps == 90 else 0.0
        return made

    def show(runtime):
        enabled[runtime.counters.steps] = [command.enable for command in world.commands()]
        said.append(runtime.bridge.reason)

    runtime.step = stopped
    world.run(runtime, until=lambda r: r.counters.steps == 92, show=show)
    assert [enabled[k] for k in (89, 90, 91)] == [[True], [], [False]]
    assert said[-1] == "the clock jumped by +9.00 s"


@pytest.mark.slow
def test_until_ends_the_run():
    """`until` ends the run after the tenth step."""
    world = Acted()
    runtime = world.runtime()
    world.run(runtime, until=lambda r: r.counters.steps == 10)
    assert runtime.counters.steps == 10


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_run_between_two_steps(number):
    """The run is disarmed with zero frames; signal handlers and garbage collector are restored."""
    world, before = Acted(), signal.getsignal(number)

    def show(runtime):
        if runtime.counters.steps == 90:
            os.kill(os.getpid(), number)

    runtime = world.runtime()
    world.run(runtime, duration=60.0, show=show)
    assert runtime.counters.steps == 90 and runtime.bridge.state == "disarmed"
    assert [c.enable for c in world.commands()][-3:] == [False] * 3
    assert signal.getsignal(number) is before and gc.isenabled() and gc.get_freeze_count()


@pytest.mark.slow
def test_thrusters_stop_even_where_the_loop_breaks():
    """An error in the program itself still sends frames without thrust."""
    world = Acted()

    def show(runtime):
        if runtime.counters.steps == 90:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        world.run(world.runtime(), duration=60.0, show=show)
    enabled = [c.enable for c in world.commands()]
    assert any(enabled) and enabled[-3:] == [False] * 3


def test_tags_are_found_beside_the_loop():
    """A thread finds the tags of rendered pictures; a blank picture yields no tags."""
    corners = {tag: pose_corners(60.0, centre=(80.0 + 9 * tag, 70.0 * (tag - 14))) for tag in (15, 16)}
    image = draw((240, 400), corners, family=VEHICLE.tags.family)
    found, come = [], threading.Event()

    class Source:
        pictures = [image, np.full_like(image, 128)]
        closed = False

        def receive(self, now):
            return [Picture(now, 1, image=self.pictures.pop(0))] if self.pictures else []

        def close(self):
            self.closed = True

    source = Source()
    finder = TagFinder(source, VEHICLE, size=image.shape)
    for _ in range(1000):
        found += finder.receive(0.0)
        if len(found) == 2:
            break
        come.wait(0.02)
    finder.close()
    assert {tag.tag_id for tag in found[0].tags} == set(corners) and found[1].tags == ()
    assert found[1].image is None and source.closed


def test_a_picture_that_the_detector_chokes_on_is_one_without_tags(caplog):
    """The error is logged once; the finder keeps running and closes."""
    image = np.zeros((20, 20), np.uint8)

    class Source:
        def receive(self, now):
            return [Picture(0.0, 1, image=image)]

        def describe(self):
            return "a camera"

        def close(self):
            pass

    finder = TagFinder(Source(), VEHICLE, size=image.shape)
    finder._tracker.detect = lambda *a: 1 / 0
    found, come = [], threading.Event()
    for _ in range(1000):
        found += finder.receive(0.0)
        if sum(picture.image is None for picture in found) >= 3:
            break
        come.wait(0.01)
    finder.close()
    assert found[-1].image is None and found[-1].tags == ()
    assert caplog.text.count("ZeroDivisionError") == 1 and "tags cannot be sought" in finder.describe()
