"""A task's site in real time: one process is the water and the prey, another the robot that pursues it."""

import json
import socket
import subprocess
import sys

import numpy as np
import pytest

from finssim.control.tracking import Track
from finssim.pool.medium import Medium
from finssim.pool.task_server import MediumServer
from finssim.robot.team import decode_track, encode_track

HERE = Track(np.array([1.0, 2.0, -3.0]), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(6), 0.0)


def test_a_message_reaches_the_others_and_nobody_under_a_strange_name():
    """Over sockets: what `left` sends comes to `right`, not back; what an eel sends comes to nobody."""
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
def test_a_pursuer_in_another_process_is_told_of_the_prey_and_follows_it():
    """Located by motion capture on its wire; it decides ten times a second and comes nearer."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = min(free.getsockname()[1], 65000)
    finssim = [sys.executable, "-m", "finssim"]
    words = [
        "pool",
        "--task",
        "pursuit",
        "--plant",
        "0",
        "--severity",
        "nominal",
        "--positioning",
        "motion-capture",
    ]
    ends = ["--port", str(port), "--robot", f"127.0.0.1:{port + 100}", "--seed", "3"]
    with subprocess.Popen([*finssim, *words, *ends], stdout=subprocess.PIPE, text=True) as site:
        try:
            while not site.stdout.readline().startswith("messages"):
                pass
            words = [
                "run",
                "--policy",
                "lead",
                "--task",
                "pursuit",
                "--site",
                "open-water",
                "--pool-file",
                "none",
            ]
            ends = ["--robot", f"udp://127.0.0.1:{port}", "--bind", f"127.0.0.1:{port + 100}"]
            more = ["--team", f"127.0.0.1:{port + 5}", "--duration", "8", "--arm", "--json"]
            run = subprocess.run(
                [*finssim, *words, *ends, *more], stdout=subprocess.PIPE, text=True, timeout=120
            )
        finally:
            site.terminate()
            said = site.stdout.read()
    told = json.loads(run.stdout)
    assert run.returncode == 0 and told["state"] != "fault" and told["decisions"] > 30
    assert "episode: not ended after" in said or "captured 1" in said
