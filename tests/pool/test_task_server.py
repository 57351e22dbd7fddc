"""Several vehicles in real time: one process simulates the water, others are the robots; one camera sees all
tags."""

import json
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.control.guidance import Station, Track
from finssim.pool.fleet import Medium, one_picture
from finssim.pool.run import SiteChoice, swimming
from finssim.pool.servers import MediumServer
from finssim.robot.perception import Perception
from finssim.robot.pilots import make_pilot
from finssim.robot.record_reader import open_record
from finssim.robot.runtime import Runtime
from finssim.robot.team import decode_track, encode_track
from finssim.vehicles import load_vehicle
from finssim.vehicles.defaults import numbered

HERE = Track(np.array([1.0, 2.0, -3.0]), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(6), 0.0)


def test_a_message_reaches_the_others_and_nobody_under_a_strange_name():
    """Over sockets, a message of `left` reaches `right` but not `left`; a message of an unknown `eel` reaches
    no one."""
    server = MediumServer(
        ("127.0.0.1", 0), Medium(lambda: dict.fromkeys(("left", "right"), np.zeros(3))), ("left", "right")
    )
    ends = {name: socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for name in ("left", "right", "eel")}
    for name, end in ends.items():
        end.settimeout(2.0)
        end.sendto(encode_track(name, HERE, 0.0), server.address)
    for _ in range(2):
        server.poll(1.0)
    ends["left"].sendto(encode_track("left", HERE, 0.0), server.address)
    server.poll(2.0)
    assert decode_track(ends["right"].recv(2048), 2.0)[0] == "left"
    ends["eel"].settimeout(0.05)
    with pytest.raises(TimeoutError):
        ends["eel"].recv(2048)
    for end in (*ends.values(), server):
        end.close()


@pytest.mark.slow
def test_one_camera_tells_vehicles_apart_by_their_tags():
    """Three FinsROV in the pool, with everyone's tags in every picture, each locate themselves and reach
    their goals."""
    finsrov = load_vehicle("finsrov")
    fleet, known = swimming([finsrov] * 3, SiteChoice(severity="nominal"), None)
    names, sent = list(fleet.worlds), {name: [] for name in fleet.worlds}
    runtimes, tags = {}, set()
    for i, (name, world) in enumerate(fleet.worlds.items()):
        x, y, z = world.plant.position.astype(float)
        station = Station((x, y + 0.3, z), 0.0)
        pilot = make_pilot("pid", finsrov)
        runtimes[name] = Runtime(
            numbered(finsrov, i), Perception(numbered(finsrov, i), known), pilot, station, arm=True
        )
    for k in range(1, 541):
        arrived = {name: fleet.worlds[name].exchange(k / 60.0, sent[name]) for name in names}
        pictures = one_picture(p for delivery in arrived.values() for p in delivery.pictures)
        tags |= {tag.tag_id for picture in pictures for tag in picture.tags}
        for name in names:
            sent[name] = runtimes[name].step(k / 60.0, arrived[name].frames, pictures)
    assert tags == {15, 16, 17, 18, 19, 20}
    for name in names:
        runtime, truth = runtimes[name], fleet.worlds[name].plant.position
        assert np.linalg.norm(runtime.reading.position - truth) < 0.02 and not runtime.bridge.reason
        assert np.linalg.norm(truth - runtime.guide.position) < 0.05


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["pool", "--team", "finsrov,finsrov", "--task", "formation"],
            "--team names 2 vehicles, but task 'formation' has 3",
        ),
        (["pool", "--team", "finsrov,finsrov", "--camera", "pictures"], "give --camera corners, or none"),
        (["pool", "--team", "finsrov,finsrov,finsrov,finsrov"], "4 vehicles 1.1 m apart do not fit into 4 m"),
        (["run", "--team", "lead"], "--team lead is a baseline: give its task with --task"),
        (["run", "--team", "lead", "--task", "pursuit"], "has one agent: run it with --policy lead"),
        (["run", "--team", "consensus", "--task", "formation", "--agent", "corner_1"], "leave --agent"),
        (["run", "--team", "consensus", "--policy", "pid"], "no controller: give --policy"),
        (["run", "--arm"], "no controller: give --policy"),
    ],
)
def test_what_a_team_cannot_do_is_refused(words, sentence, capsys):
    """Each is refused in one sentence, before a socket is opened."""
    assert boundary.run(app, words) == 2
    assert sentence in " ".join(capsys.readouterr().err.split())


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return min(free.getsockname()[1], 65000)


@pytest.mark.slow
def test_one_command_runs_a_team_and_who_is_lost_stops_alone(tmp_path, slow_clock):
    """The site connects three robot processes; one is killed, and the others end on time."""
    port = free_port()
    finssim, ends = [sys.executable, "-m", "finssim"], ["--robot", f"127.0.0.1:{port + 100}"]
    words = "--team finsrov,finsrov,finsrov --task formation --plant 0 --severity nominal --seed 3"
    site = subprocess.Popen(
        [*finssim, "pool", *words.split(), "--positioning", "motion-capture", "--port", str(port), *ends],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        lines = iter(site.stdout.readline, "")
        goal = next(line for line in lines if line.startswith("goal: ")).removeprefix("goal: ").strip()
        assert any(line.startswith("messages") for line in lines)
        words = f"run --team consensus --task formation --goal={goal} --duration 8 --arm --json --record {tmp_path}"
        ends = ["--robot", f"udp://127.0.0.1:{port}", "--bind", f"127.0.0.1:{port + 100}"]
        team = subprocess.Popen([*finssim, *words.split(), *ends], stdout=subprocess.PIPE, text=True)
        lost = process_of(team, "corner_2", tmp_path / "corner_2.mcap")
        subprocess.run(["kill", "-KILL", str(lost)], check=True)
        told = json.loads(team.communicate(timeout=200)[0])
    finally:
        site.send_signal(signal.SIGTERM)
        site.wait(30)
    assert told["corner_2"] is None and team.returncode == 9
    for name in ("corner_1", "corner_3"):
        assert told[name]["faults"] == [] and told[name]["duration_s"] > 7.9
        assert told[name]["decisions"] > 50
        with open_record(tmp_path / f"{name}.mcap") as record:
            fixes = sum(1 for _ in record.messages(("positioning/pose",)))
        assert fixes > 30


def process_of(team, name, record):
    """Return the process of an agent, once it has recorded for some seconds."""
    end = time.monotonic() + 120.0
    while not (record.exists() and record.stat().st_size > 100_000):
        assert time.monotonic() < end and team.poll() is None
        time.sleep(0.2)
    listed = subprocess.run(
        ["ps", "--ppid", str(team.pid), "-o", "pid=,args="], stdout=subprocess.PIPE, text=True, check=True
    ).stdout
    (line,) = [line for line in listed.splitlines() if f"--agent {name} " in line]
    return int(line.split()[0])


@pytest.mark.slow
@pytest.mark.parametrize(("task", "policy"), [("pursuit", "lead"), ("t3", "pid")])
def test_who_pursues_in_another_process_is_told_of_the_prey_and_follows_it(task, policy, slow_clock):
    """It receives the prey or the moving goal, is located by motion capture on its wire, and decides ten
    times a second."""
    port = free_port()
    finssim = [sys.executable, "-m", "finssim"]
    words = f"pool --task {task} --plant 0 --severity nominal --positioning motion-capture".split()
    ends = ["--port", str(port), "--robot", f"127.0.0.1:{port + 100}", "--seed", "3"]
    with subprocess.Popen([*finssim, *words, *ends], stdout=subprocess.PIPE, text=True) as site:
        try:
            assert any(line.startswith("messages") for line in iter(site.stdout.readline, ""))
            words = f"run --policy {policy} --task {task} --site open-water --pool-file none".split()
            ends = ["--robot", f"udp://127.0.0.1:{port}", "--bind", f"127.0.0.1:{port + 100}"]
            more = ["--team", f"127.0.0.1:{port + 5}", "--duration", "5", "--arm", "--json"]
            run = subprocess.run(
                [*finssim, *words, *ends, *more], stdout=subprocess.PIPE, text=True, timeout=120
            )
        finally:
            site.terminate()
            said = site.stdout.read()
    told = json.loads(run.stdout)
    assert run.returncode == 0 and told["state"] != "fault" and told["decisions"] > 20
    assert "episode: not ended after" in said or "captured 1" in said
    assert task != "t3" or (told["goal"] == "target" and told["position_rms_m"] < 2.0)
