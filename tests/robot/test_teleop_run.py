"""A whole teleoperated drive over a wire: it starts disarmed, thrusts while held, ends without thrust and is
recorded."""

import json
import os
import signal
import socket
from dataclasses import replace

import numpy as np
import pytest

from finssim.control.guidance import Station
from finssim.localization.overhead_camera import write_pool
from finssim.robot.interrupt import interruptible
from finssim.robot.links.frames import MCU, Decoder, encode_telemetry
from finssim.robot.links.transports import memory_pair
from finssim.robot.messages import Telemetry
from finssim.robot.teleop import DriveSettings, Handover, Hands, drive
from finssim.robot.wiring import Wires, Wiring, open_camera, run_realtime
from finssim.vehicles import load_vehicle
from reference.rounds import overhead

VEHICLE = load_vehicle("finsrov")


class Script:
    """Scripted hands: arm at 0.5 s, drive from 1 s to 2 s."""

    def __init__(self, drives=True):
        self.drives = drives

    def read(self, now):
        if 0.5 <= now < 0.6:
            return Hands(arm=True)
        return Hands(surge=1.0, dead_man=True) if 1.0 <= now < 2.0 and self.drives else Hands()


class World:
    """A clock that `wait` advances, and a motor controller that answers at every turn."""

    def __init__(self):
        self.now, self.sent = 0.0, 0
        self.ours, self.theirs = memory_pair()
        self.decoder = Decoder(MCU)
        self.frames = []

    def drive(self, runtime, **how):
        """Drive as with `wiring.connected`."""
        return run_realtime(runtime, Wires(self.ours), clock=self.clock, wait=self.wait, **how)

    def clock(self):
        return self.now

    def wait(self, seconds):
        self.now += max(seconds, 1e-4)
        self.sent += 1
        wobble = 1e-3 * (self.sent % 7)
        sample = Telemetry(
            self.sent,
            round(1000 * self.now),
            (0.0, 0.0, 1.0, 0.0),
            (wobble,) * 3,
            (wobble, 0.0, 9.81),
            0.5,
            1e5,
            0,
            (0.0,) * 8,
        )
        self.theirs.send(encode_telemetry(sample))
        for data in self.theirs.receive():
            self.frames += [(self.now, command) for command in self.decoder.feed(data)]


@pytest.fixture
def world():
    return World()


@pytest.mark.slow
def test_a_drive_by_hand(world):
    """Thrust occurs only during hand input; the last three frames are disabled."""
    runtime = drive(VEHICLE, Script(), world.drive, settings=DriveSettings(duration=3.0))
    moving = [t for t, frame in world.frames if frame.enable and any(frame.normalised)]
    assert 1.0 <= moving[0] < 1.2 and 2.0 <= moving[-1] < 2.3
    assert all(not frame.enable and not any(frame.normalised) for _, frame in world.frames[-3:])
    assert runtime.bridge.state == "disarmed"


@pytest.mark.slow
def test_nobody_arms_nothing_moves(world):
    class Held(Script):
        def read(self, now):
            return replace(super().read(now), arm=False, dead_man=True, surge=1.0)

    drive(VEHICLE, Held(), world.drive, settings=DriveSettings(duration=2.0))
    assert world.frames and not any(frame.enable for _, frame in world.frames)


@pytest.mark.slow
def test_a_device_that_vanishes_disarms(world):
    class Gone(Script):
        def read(self, now):
            return super().read(now) if now < 1.5 else Hands(present=False)

    runtime = drive(VEHICLE, Gone(), world.drive, settings=DriveSettings(duration=2.5))
    moving = [t for t, frame in world.frames if frame.enable]
    assert moving[-1] < 1.6 and runtime.bridge.state == "disarmed"


@pytest.mark.slow
def test_a_drive_is_recorded(world, tmp_path):
    """Telemetry, commands and events are recorded, and convert to a trial driven by its shaft speeds."""
    pytest.importorskip("mcap")
    pytest.importorskip("rosbags")
    from finssim.robot.record_reader import describe_record, open_record
    from finssim.robot.recorder import Recorder

    with Recorder(tmp_path / "drive.mcap", VEHICLE, {}) as recorder:
        drive(VEHICLE, Script(), world.drive, settings=DriveSettings(duration=3.0), recorder=recorder)
    with open_record(tmp_path / "drive.mcap") as record:
        told = describe_record(record)
    assert "armed" in [event["kind"] for event in told["events"]]
    assert told["topics"]["/finsrov/telemetry"]["messages"] > 100
    assert told["topics"]["/finsrov/thruster_cmd"]["messages"] > 100


class Hold:
    """A controller with a constant command."""

    name, period, needs_state = "hold", 0.05, False

    def describe(self):
        return {"name": self.name}

    def reset(self):
        pass

    def act(self, reading, guide, t):
        return np.full(8, 1.0)


HELD = Handover(Hold(), Station((0.0, 0.0, 0.0), 0.0))


class Modes(Script):
    """The mode button at 1 s and at 2 s."""

    def __init__(self):
        super().__init__(drives=False)

    def read(self, now):
        return replace(super().read(now), mode=1.0 <= now < 1.1 or 2.0 <= now < 2.1)


@pytest.mark.slow
def test_the_mode_button_hands_over_to_a_controller_and_back(world):
    """Thrust is the controller's from 1 s, and the operator's zeros from 2 s."""
    drive(VEHICLE, Modes(), world.drive, settings=DriveSettings(duration=3.0), handover=HELD)
    moving = [t for t, frame in world.frames if frame.enable and any(frame.normalised)]
    assert 1.0 <= moving[0] < 1.2 and 2.0 <= moving[-1] < 2.3


@pytest.mark.slow
def test_who_steers_is_on_record(world, tmp_path):
    """Every press of the mode button is recorded as an event."""
    pytest.importorskip("mcap")
    pytest.importorskip("rosbags")
    from finssim.robot.record_reader import open_record
    from finssim.robot.recorder import Recorder

    with Recorder(tmp_path / "drive.mcap", VEHICLE, {}) as recorder:
        drive(
            VEHICLE,
            Modes(),
            world.drive,
            settings=DriveSettings(duration=3.0),
            recorder=recorder,
            handover=HELD,
        )
    with open_record(tmp_path / "drive.mcap") as record:
        told = [json.loads(entry.message.data) for entry in record.messages(["events"])]
    modes = [(event["text"], event["time"]) for event in told if event["kind"] == "mode"]
    assert modes == [("other", pytest.approx(1.0, abs=0.05)), ("person", pytest.approx(2.0, abs=0.05))]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--device", "wheel"], "unknown device 'wheel'"),
        (["--pictures", "none"], "give --pool-file"),
        (["--goal", "0,0,-0.5,0"], "give --policy"),
        (["--policy", "pid"], "give --pool-file and --goal"),
        (["--policy", "pid", "--goal", "9,0,-0.5,0", "--pool-file", "POOL"], "outside the workspace"),
    ],
)
def test_what_would_do_nothing_or_lead_out_of_the_pool_is_refused(capsys, tmp_path, words, sentence):
    """Status 2 and a sentence, before a device or a wire is opened."""
    from finssim.cli import boundary
    from finssim.cli.commands import app

    write_pool(overhead(), tmp_path / "pool.yaml")
    words = [str(tmp_path / "pool.yaml") if word == "POOL" else word for word in words]
    assert boundary.run(app, ["teleop", "--device", "keyboard", *words]) == 2
    assert sentence in capsys.readouterr().err


def test_pictures_come_to_the_port_after_the_robots_own():
    """The addresses are those of the requested end, in `run` and in `teleop`."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    source = open_camera(Wiring(bind=f"127.0.0.1:{port - 1}"), VEHICLE, overhead())
    try:
        assert f"127.0.0.1:{port} to 127.0.0.1:58767" in source.describe()
    finally:
        source.close()


def test_a_terminal_that_closes_ends_a_loop_in_good_order():
    """A hang-up ends the loop as Ctrl-C does; if it is ignored beforehand, it stays ignored."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup ignores it from the start
    try:
        with interruptible() as interrupted:
            os.kill(os.getpid(), signal.SIGHUP)
            assert interrupted()
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        with interruptible() as interrupted:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not interrupted()
    finally:
        signal.signal(signal.SIGHUP, before)
