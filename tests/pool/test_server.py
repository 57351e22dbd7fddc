"""The virtual pool as a separate process: real time over UDP and shared memory, lock-step over TCP."""

import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from finssim.core import realtime
from finssim.localization.overhead_camera import load_pool
from finssim.pool.drawn_plant import draw_plant
from finssim.pool.fleet import Fleet
from finssim.pool.plan import make_plan
from finssim.pool.real_time import SiteWires, serve_realtime
from finssim.pool.servers import LockstepServer
from finssim.pool.virtual_pool import VirtualPool, read_truth
from finssim.robot.goals import station_of
from finssim.robot.links.frames import Decoder, LinkError
from finssim.robot.links.transports import UdpTransport, memory_pair
from finssim.robot.lockstep import LockstepClient, LockstepError, encode_request
from finssim.robot.messages import Telemetry
from finssim.robot.pictures import UdpPictures
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
HERE = "127.0.0.1"
START = station_of("0,0,-0.5,0")


def ports():
    """Three free ports in a row for the pool and two for the robot."""
    while True:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind((HERE, 0))
            first = free.getsockname()[1]
        try:
            for port in range(first, first + 5):
                for kind in (socket.SOCK_DGRAM, socket.SOCK_STREAM):
                    with socket.socket(socket.AF_INET, kind) as probe:
                        probe.bind((HERE, port))
            return first, first + 3
        except (OSError, OverflowError):
            continue


class Process:
    """A `finssim pool` process with some options, and its output."""

    def __init__(self, *words):
        self.port, self.robot = ports()
        command = [
            sys.executable,
            "-m",
            "finssim",
            "pool",
            "--port",
            self.port,
            "--robot",
            f"{HERE}:{self.robot}",
            *words,
        ]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        self.process = subprocess.Popen(
            [str(w) for w in command],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=environment,
        )
        self.lines = []

    def until(self, beginning):
        """Read up to a line with this beginning."""
        for line in self.process.stdout:
            self.lines.append(line.strip())
            if line.startswith(beginning):
                return self.lines[-1]
        raise AssertionError(f"no line {beginning!r} in {self.lines}")

    def end(self, number=None):
        """Return the exit status, after a signal if one is given."""
        if number is not None:
            self.process.send_signal(number)
        self.lines += [line.strip() for line in self.process.stdout]
        return self.process.wait(30.0)

    def __enter__(self):
        return self

    def __exit__(self, *problem):
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self.process.stdout.close()


class Clock:
    """A clock that advances only when something waits or when a test sets it."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now

    def wait(self, duration):
        self.now += duration


def world(**options):
    """Return a nominal pool."""
    return VirtualPool(FINSROV, draw_plant(FINSROV, 1, "nominal"), **options)


def alone(**options):
    """Return a nominal pool with nothing else in the water."""
    return Fleet({"it": world(**options)})


def telemetry(datagrams):
    """Return the telemetry frames among some datagrams."""
    decoder = Decoder()
    return [m for data in datagrams for m in decoder.feed(data) if isinstance(m, Telemetry)]


def test_a_pool_keeps_real_time():
    """Two seconds of the clock are two seconds in the pool, with 100 telemetry frames a second."""
    clock, (pool, robot) = Clock(), memory_pair()
    pace = serve_realtime(alone(), SiteWires({"it": pool}), duration=2.0, clock=clock, wait=clock.wait)
    assert clock.now == pytest.approx(102.0, abs=0.01) and pace.duration == 2.0 and pace.given_up == 0.0
    assert len(telemetry(robot.receive())) == pytest.approx(200, abs=3)


def test_a_pool_that_was_stopped_does_not_catch_up():
    """After a pause of 5 s the pool continues from where it stopped, and reports it."""
    clock, (pool, robot) = Clock(), memory_pair()
    paused = []

    def pause():
        if clock.now > 100.5 and not paused:
            paused.append(True)
            clock.now += 5.0
        return False

    pace = serve_realtime(
        alone(), SiteWires({"it": pool}), duration=1.0, clock=clock, wait=clock.wait, until=pause
    )
    assert pace.given_up == pytest.approx(5.0, abs=0.02) and "gave up 5.0" in pace.sentence
    assert len(telemetry(robot.receive())) == pytest.approx(100, abs=3)


def test_pictures_carry_the_time_of_the_machine():
    """The sink receives the arrival time on this machine's clock, no later than now."""
    plan = make_plan("finsrov", "1", "nominal", camera="corners")

    class Sink:
        times = []

        def send(self, picture, now):
            self.times.append((picture.time, now))

    clock, (pool, _) = Clock(), memory_pair()
    eye = plan.camera.camera()
    pace = serve_realtime(
        alone(camera=eye), SiteWires({"it": pool}, sinks=[Sink()]), duration=1.0, clock=clock, wait=clock.wait
    )
    assert pace.pictures == len(Sink.times) >= 27
    assert all(0.0 <= now - came < 0.01 and 100.0 < came < 101.1 for came, now in Sink.times)


def test_lockstep_gives_what_the_pool_gives():
    """Over TCP a robot receives bit for bit what a pool in its own process would give."""
    import threading

    plan = make_plan("finsrov", "2", "realistic", camera="corners")
    server, here = (
        LockstepServer((HERE, 0)),
        plan.world(plan.camera.camera(), start=START, seed=3, truth=None),
    )
    there = plan.world(plan.camera.camera(), start=START, seed=3, truth=None)
    thread = threading.Thread(target=server.serve, args=(there,), daemon=True)
    thread.start()
    with LockstepClient(f"{HERE}:{server.address[1]}") as robot:
        for k in range(1, 31):
            a, b = here.exchange(k / 60.0, []), robot.exchange(k / 60.0, [])
            assert (a.time, a.frames) == (b.time, b.frames)
            for p, q in zip(a.pictures, b.pictures, strict=True):
                assert (p.time, p.sequence) == (q.time, q.sequence)
                assert all(np.array_equal(s.corners, t.corners) for s, t in zip(p.tags, q.tags, strict=True))
        with pytest.raises(LockstepError, match="is in the past"):
            robot.exchange(0.1, [])
    thread.join(10.0)
    assert not thread.is_alive()


def test_lockstep_lets_in_one_robot_alone_and_outlives_no_garbage():
    """A second robot cannot connect; a peer with another protocol receives an error, and the server ends."""
    server, pool, ended = LockstepServer((HERE, 0)), world(), []
    thread = threading.Thread(target=lambda: ended.append(server.serve(pool)), daemon=True)
    thread.start()
    with socket.create_connection(server.address) as robot:
        robot.sendall(encode_request(0.1, []))
        robot.recv(4096)
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(server.address, timeout=1.0)
        robot.sendall(b"GET / HTTP/1.1\r\n\r\n")
        robot.recv(4096)
    thread.join(10.0)
    assert "refused" in ended[0]


def test_a_plan_follows_its_file_and_its_options(tmp_path):
    """A plant file provides its severity, seed and basin; the cameras are as requested."""
    spec = draw_plant(FINSROV, 7, "hard")
    spec.write(tmp_path / "plant.yaml")
    plan = make_plan("finsrov", str(tmp_path / "plant.yaml"), "nominal", camera="corners")
    drawn = make_plan("finsrov", "7", "hard", camera="corners")
    assert plan.spec.severity == "hard" and plan.camera.settings.ripples == 0.03
    assert plan.calibrated.sha256 == drawn.calibrated.sha256
    assert make_plan("finsrov", "7", "hard", camera="none").camera is None
    with pytest.raises(ValueError, match="pictures, corners, none"):
        make_plan("finsrov", "7", "hard", camera="film")


@pytest.mark.slow
def test_the_command_in_lockstep(tmp_path):
    """A subprocess exchanges messages, starts at the given pose, and writes pool file and truth."""
    pool_file, truth = tmp_path / "pool.yaml", tmp_path / "truth.fst"
    words = ["--lockstep", "--camera", "corners", "--severity", "nominal", "--start", "0.3,-0.2,-0.6,90"]
    with Process(*words, "--pool-file", pool_file, "--truth", truth, "--duration", 1.0) as pool:
        assert pool.until("lock-step") == f"lock-step: {HERE}:{pool.port + 2}"
        with LockstepClient(f"{HERE}:{pool.port + 2}") as robot:
            got = [robot.exchange(k / 20.0, []) for k in range(1, 21)]
            with pytest.raises(LockstepError, match="the pool ends at 1 s"):
                robot.exchange(1.1, [])
        assert pool.end() == 0
        assert any("seed 1" in line for line in pool.lines)
    assert len(telemetry(data for d in got for _, data in d.frames)) == pytest.approx(100, abs=4)
    assert {t.tag_id for d in got for p in d.pictures for t in p.tags} == {15, 16}
    happened = read_truth(truth)
    assert np.allclose(happened.position[0], [0.3, -0.2, -0.6], atol=1e-6) and happened.time[
        -1
    ] == pytest.approx(1.0)
    assert np.allclose(happened.quaternion[0], [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-6)
    assert load_pool(pool_file).camera.lens.width == 1280


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_ends_lockstep_in_order(number):
    """Ctrl-C works too, even if a script started the process in the background with SIGINT ignored."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN), signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        pool = Process("--lockstep", "--camera", "none")
    finally:
        signal.signal(signal.SIGINT, before[0])
        signal.signal(signal.SIGHUP, before[1])  # ignored if the tests run under nohup
    with pool:
        pool.until("lock-step")
        assert pool.end(number) == 0
    assert pool.lines[-1].startswith("stopped at")


@pytest.mark.slow
def test_the_command_in_real_time(tmp_path, slow_clock):
    """Telemetry and tags of a subprocess arrive at the rates of their instruments; Ctrl-C closes its files."""
    truth = tmp_path / "truth.fst"
    with Process("--camera", "corners", "--truth", truth) as pool:
        link = UdpTransport((HERE, pool.robot), (HERE, pool.port))
        source = UdpPictures((HERE, pool.robot + 1), (HERE, pool.port + 1))
        pool.until("pictures")
        frames, pictures, end = [], [], time.monotonic() + 60.0
        while (len(frames) < 200 or len(pictures) < 60) and time.monotonic() < end:
            frames += link.receive()
            pictures += source.receive(realtime.now())
            time.sleep(0.005)
        assert pool.end(signal.SIGINT) == 0
        assert any("frames in" in line for line in pool.lines)
        link.close()
        source.close()
    sequence = [m.sequence for m in telemetry(frames)]
    assert len(sequence) >= 200 and sequence == sorted(sequence)
    assert len(pictures) >= 60 and {t.tag_id for p in pictures for t in p.tags} == {15, 16}
    steps = np.diff([p.time for p in pictures]) / np.maximum(np.diff([p.sequence for p in pictures]), 1)
    assert np.median(steps) == pytest.approx(1.0 / 30.0, abs=0.01)
    assert read_truth(truth).time[-1] > 1.5


@pytest.mark.slow
def test_the_command_draws_pictures():
    """The detector finds the tags in a subprocess's drawn pictures, while telemetry continues."""
    from finssim.localization.detection.detector import detector

    with Process("--camera", "pictures", "--severity", "nominal", "--duration", "60") as pool:
        link = UdpTransport((HERE, pool.robot), (HERE, pool.port))
        source = UdpPictures((HERE, pool.robot + 1), (HERE, pool.port + 1))
        frames, pictures, end = [], [], time.monotonic() + 60.0
        while len(pictures) < 5 and time.monotonic() < end:
            frames += link.receive()
            pictures += source.receive(time.monotonic())
            time.sleep(0.005)
        assert pool.end(signal.SIGTERM) == 0
        link.close()
        source.close()
    assert len(pictures) >= 5 and len(telemetry(frames)) > 5
    found = detector(FINSROV.tags.family).detect(pictures[-1].image)
    assert {d.tag for d in found} >= {15, 16}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--camera", "film"], "unknown camera 'film'"),
        (["--severity", "easy"], "easy"),
        (["--camera", "none", "--pool-file", "x.yaml"], "omit one"),
        (["--start", "0,0"], "0,0"),
        (["--plant", "nowhere.yaml"], "nowhere.yaml"),
        (["--port", "70000"], "70000"),
        (["--robot", "elsewhere"], "elsewhere"),
        (["--start", "9,0,-0.5,0"], "outside the pool"),
        (["--start", "0,0,0.5,0"], "outside the pool"),
    ],
)
def test_the_command_refuses_in_one_sentence(capsys, tmp_path, monkeypatch, words, sentence):
    """A wrong option ends the command with status 2 and a line that names it."""
    from finssim.cli import boundary
    from finssim.cli.commands import app

    monkeypatch.chdir(tmp_path)
    assert boundary.run(app, ["pool", *words]) == 2
    assert sentence in capsys.readouterr().err


def test_a_pool_that_finds_its_port_taken_leaves_the_files_of_the_other_alone(tmp_path, capsys):
    """Pool file and truth are written only after every wire is open."""
    from finssim.cli import boundary
    from finssim.cli.commands import app

    files = tmp_path / "pool.yaml", tmp_path / "truth.fst"
    for file in files:
        file.write_text("of the pool that is running")
    port, _ = ports()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((HERE, port))
        words = ["--port", port, "--camera", "corners", "--pool-file", files[0], "--truth", files[1]]
        assert boundary.run(app, ["pool", *map(str, words)]) == 2
    assert str(port) in capsys.readouterr().err
    assert [file.read_text() for file in files] == ["of the pool that is running"] * 2


def test_guests_that_are_no_robot_do_not_end_lockstep():
    """One connects and leaves, one sends garbage and disconnects, one requests a page, ten are silent; then a
    robot connects."""
    server, ended = LockstepServer((HERE, 0)), []
    thread = threading.Thread(target=lambda: ended.append(server.serve(world())), daemon=True)
    thread.start()
    socket.create_connection(server.address).close()
    with socket.create_connection(server.address) as rude:
        rude.sendall(b"garbage of some length")
        rude.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    with socket.create_connection(server.address, timeout=10.0) as browser:
        browser.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert b"no lock-step message" in browser.recv(4096)
    silent = [socket.create_connection(server.address) for _ in range(10)]
    with LockstepClient(f"{HERE}:{server.address[1]}", timeout=10.0) as robot:
        assert robot.exchange(0.1, []).time == pytest.approx(0.1)
    thread.join(10.0)
    assert ended == ["the robot has left"]
    for guest in silent:
        guest.settimeout(10.0)
        assert guest.recv(1) == b""
        guest.close()


def test_a_port_that_is_taken_is_named():
    """Neither real time nor lock-step takes a port that is in use."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as other:
        other.bind((HERE, 0))
        other.listen()
        with pytest.raises(LinkError, match=str(other.getsockname()[1])):
            LockstepServer(other.getsockname())
