"""A robot and an emulated ArduSub as a user starts them: two processes, UDP and TCP."""

import json
import re
import socket
import time

import numpy as np
import pytest

from finssim.pool import read_truth
from studies.faults import Process

VEHICLE = ["--vehicle", "bluerov2_heavy", "--site", "tank"]


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
        end.bind(("127.0.0.1", 0))
        return end.getsockname()[1]


def until(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)
    return condition()


@pytest.mark.slow
def test_a_pid_goes_to_its_goal_over_real_sockets(tmp_path, slow_clock):
    """`finssim run --robot mavlink://...` beside `finssim pool --firmware ardusub` arms, moves and disarms."""
    ground, truth = f"127.0.0.1:{free_port()}", tmp_path / "truth.fst"
    free = ["--port", "0", "--tcp", "127.0.0.1:0", "--dvl", "127.0.0.1:0", "--ground", ground]
    world = ["pool", "--firmware", "ardusub", "--truth", str(truth), *free, *VEHICLE]
    with Process(world, tmp_path, "pool") as pool:
        assert until(lambda: "Doppler log: " in pool.output), pool.complained
        log = re.search(r"Doppler log: (\S+)", pool.output)[1]
        robot = ["run", "--robot", f"mavlink://udpin:{ground}?dvl={log}", "--policy", "pid", *VEHICLE]
        robot += ["--pool-file", "none", "--let-in", "0,0", "--goal", "0.3,0,-0.6,0", "--duration", "5"]
        with Process([*robot, "--arm", "--json"], tmp_path, "robot") as run:
            assert until(lambda: not run.running) and run.broke() == ""
            summary = json.loads(run.output)
        assert pool.end() == 0
    assert summary["state"] == "armed" and summary["faults"] == []
    assert summary["samples"]["velocity"]["accepted"] > 20
    course = read_truth(truth)
    assert course.position[-1, 0] - course.position[0, 0] > 0.15
    assert np.abs(course.thrust[-1]).max() == pytest.approx(0.0, abs=0.05)
