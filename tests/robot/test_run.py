"""`finssim run` from the command line: against a lock-step world and on a wire without a peer."""

import json
import socket
import threading

import numpy as np
import pytest

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.localization.overhead_camera import write_pool
from finssim.pool import read_truth
from finssim.robot.links.frames import MCU, Decoder, encode_telemetry
from finssim.robot.lockstep import decode_request, encode_delivery, receive
from finssim.robot.messages import Delivery
from finssim.robot.record_reader import open_record
from finssim.robot.run import _used
from finssim.tasks import task_named
from finssim.vehicles import load_vehicle
from reference.policies import linear, written
from reference.pools import lockstep_pool
from reference.rounds import Rounds, overhead, without_latency

POOL = overhead()
VEHICLE = without_latency(load_vehicle("finsrov"))


@pytest.fixture
def pool_file(tmp_path):
    """Pool file of the camera that sees the rounds."""
    write_pool(POOL, tmp_path / "pool.yaml")
    return tmp_path / "pool.yaml"


class Served:
    """A vehicle on its rounds, in lock-step over TCP; keeps the commands that it receives."""

    def __init__(self, telemetry_ends=1e9):
        self.commands, self._ends = [], telemetry_ends
        self._server = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._server.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self):
        connection, _ = self._server.accept()
        rounds, decoder, before = Rounds(POOL, VEHICLE), Decoder(MCU), 0.0
        with self._server, connection:
            while (message := receive(connection)) is not None:
                until, sent = decode_request(*message)
                self.commands += [c for data in sent for c in decoder.feed(data)]
                ticks = np.arange(np.ceil(before * 100), np.ceil(until * 100)).astype(int)
                frames = [
                    (k / 100, encode_telemetry(rounds.telemetry(k / 100, k)))
                    for k in ticks.tolist()
                    if k / 100 < self._ends
                ]
                shots = np.arange(np.ceil((before - POOL.latency) * 30), np.ceil((until - POOL.latency) * 30))
                pictures = [rounds.picture(k / 30, k) for k in shots.astype(int).tolist() if k >= 0]
                connection.sendall(encode_delivery(Delivery(until, tuple(frames), tuple(pictures))))
                before = until

    def finish(self):
        self._thread.join(10.0)
        return self.commands


def finssim(*words):
    return boundary.run(app, ["run", *map(str, words)])


def told(capsys, *words):
    """Return the output of `--json`."""
    status = finssim(*words, "--json")
    return status, json.loads(capsys.readouterr().out)


def test_an_armed_run_in_lockstep_commands_records_and_tells(capsys, tmp_path, pool_file):
    """The run arms, makes every decision, disables the thrusters at the end, and writes a record that opens."""
    world, record = Served(), tmp_path / "run.mcap"
    words = ("--policy", "pid", "--goal", "0.5,0.2,-0.5,30", "--pool-file", pool_file, "--lockstep")
    status, summary = told(
        capsys, *words, "--robot", world.address, "--duration", 3, "--record", record, "--arm"
    )
    enabled = [c.enable for c in world.finish()]
    assert status == 0 and summary["state"] == "armed" and summary["missed"] == 0
    assert 0.1 < summary["position_rms_m"] < 1.0 and summary["steps"] == 180
    assert any(enabled) and enabled[-3:] == [False] * 3
    names = ("telemetry", "odom", "goal", "thruster_cmd", "thruster_state", "policy_info", "camera/tags")
    with open_record(record) as kept:
        assert set(kept.topics) >= {f"/finsrov/{name}" for name in names} and not kept.cut


def test_a_run_that_is_not_armed_says_so_and_turns_nothing(capsys, pool_file):
    """Decisions are made, and no frame is enabled."""
    world = Served()
    words = ("--policy", "pid-paper", "--goal", "0.5,0.2,-0.5,30", "--pool-file", pool_file, "--lockstep")
    assert finssim(*words, "--robot", world.address, "--duration", 2) == 0
    out, err = capsys.readouterr()
    assert "thrusters will not turn without --arm" in err and "disarmed" in out
    assert not any(c.enable for c in world.finish())


def test_a_run_that_ends_in_a_fault_tells_why_with_status_3(capsys, pool_file):
    """Telemetry ends at 2 s: a fault follows within a second and ends the run."""
    world = Served(telemetry_ends=2.0)
    words = ("--policy", "pid", "--goal", "0.5,0.2,-0.5,30", "--pool-file", pool_file, "--lockstep", "--arm")
    status, summary = told(capsys, *words, "--robot", world.address, "--duration", 60)
    world.finish()
    assert status == 3 and summary["state"] == "fault" and summary["duration_s"] < 3.0
    assert "telemetry" in summary["reason"] and len(summary["faults"]) >= 1


def test_the_error_state_estimator_can_be_chosen(capsys, pool_file):
    """An unknown estimator is refused before anything starts."""
    world = Served()
    words = ("--policy", "pid", "--goal", "0.5,0.2,-0.5,30", "--pool-file", pool_file, "--lockstep")
    status, summary = told(
        capsys, *words, "--robot", world.address, "--duration", 1, "--estimator", "error-state"
    )
    assert status == 0 and summary["fixes"] > 20
    assert finssim(*words, "--robot", world.address, "--estimator", "psychic") == 2
    assert "unknown estimator 'psychic'" in capsys.readouterr().err


@pytest.mark.slow
def test_dead_reckoning_begins_where_the_vehicle_was_let_in(capsys, tmp_path):
    """In open water with log, compass, gauge and IMU the run arms only if the start is given, and then
    reaches its goal."""
    heavy, truth = load_vehicle("bluerov2_heavy"), tmp_path / "truth"
    words = ("--policy", "pid", "--vehicle", "bluerov2_heavy", "--site", "open-water", "--pool-file", "none")
    words += ("--goal", "3.6,-2,-5,0", "--lockstep", "--arm")
    how = {"site": "open-water", "severity": "realistic", "position": (3.0, -2.0, -5.0), "truth": truth}
    with lockstep_pool(heavy, None, **how) as wiring:
        status, summary = told(capsys, *words, "--robot", wiring.robot, "--duration", "1")
    assert status == 0 and summary["reason"] == "no position fix yet, and where it was let in is not given"
    with lockstep_pool(heavy, None, **how) as wiring:
        place = ("--let-in", "3,-2")
        status, summary = told(capsys, *words, *place, "--robot", wiring.robot, "--duration", "20")
    assert status == 0 and summary["state"] == "armed" and summary["faults"] == []
    assert np.linalg.norm(read_truth(truth).position[-1] - (3.6, -2.0, -5.0)) < 0.1
    assert finssim(*words, "--let-in", "3", "--robot", "127.0.0.1:9") == 2
    assert "expected two numbers x,y" in capsys.readouterr().err


@pytest.mark.slow
def test_a_policy_runs_where_the_vehicle_is_equipped_otherwise(capsys, tmp_path):
    """In open water with another workspace, a log and a compass, policy and record remain those of the
    vehicle's file."""
    policy = written(linear(np.zeros((6, 16), np.float32)), tmp_path / "policy", task_named("t1"), 6)
    words = ("--policy", str(policy), "--goal", "0,0,-5,0", "--pool-file", "none", "--site", "open-water")
    ends = ("--robot", "udp://127.0.0.1:9", "--bind", "127.0.0.1:0", "--duration", "0.5")
    record = tmp_path / "run.mcap"
    assert boundary.run(app, ["run", *words, *ends, "--record", str(record)]) == 4  # no peer is present
    capsys.readouterr()
    with open_record(record) as opened:
        assert opened.metadata["vehicle_sha256"] == load_vehicle("finsrov").sha256
        assert opened.metadata["site"] == "open-water"


def test_without_a_pool_file_it_says_where_one_comes_from(capsys, tmp_path, monkeypatch):
    """The default file is looked up in the current folder; a missing named file gives another message."""
    monkeypatch.chdir(tmp_path)
    assert finssim("--policy", "pid", "--goal", "0,0,-0.5,0") == 2
    assert "there is no pool.yaml in this folder: name the pool file" in capsys.readouterr().err
    assert finssim("--policy", "pid", "--goal", "0,0,-0.5,0", "--pool-file", "other.yaml") == 2
    assert "other.yaml: cannot be read" in capsys.readouterr().err


def test_what_became_part_of_the_state_is_named_by_what_came():
    """Sources of the state are pictures if there is a camera, and fixes, velocities and headings if the site
    has them."""
    seen = {"fixes": 7, "pictures": 9, "samples": {"vision": {"accepted": 7, "gated": 2}, "velocity": {}}}
    assert _used(seen) == {"pictures used": "7 of 9"}
    verdicts = {"vision": {"initialized": 1, "accepted": 4, "late": 1}, "velocity": {"accepted": 3}}
    assert _used({"fixes": 0, "pictures": 0, "samples": verdicts}) == {
        "position fixes used": "5 of 6",
        "velocities used": "3 of 3",
    }
    assert _used({"fixes": 0, "pictures": 0, "samples": {}}) == {"pictures used": "0 of 0"}


def test_a_trajectory_can_be_followed_in_place_of_a_goal(capsys, pool_file):
    """A trajectory is chosen by name; its goal moves with the time since the start."""
    world = Served()
    words = ("--policy", "pid", "--trajectory", "straight", "--pool-file", pool_file, "--lockstep")
    status, summary = told(capsys, *words, "--robot", world.address, "--duration", 2, "--vehicle", "finsrov")
    assert status == 0 and summary["goal"] == "straight" and summary["decisions"] > 20


@pytest.mark.slow
def test_changes_are_followed_while_it_runs(capsys, tmp_path):
    """A window of 10 s is fitted during the run and the vehicle file is written; an unarmed run writes
    nothing."""
    pool, now = tmp_path / "pool.yaml", tmp_path / "now.yaml"
    words = (
        "--policy",
        "pid",
        "--goal",
        "0.8,0.3,-0.6,60",
        "--pool-file",
        pool,
        "--lockstep",
        "--identify",
        now,
    )
    with lockstep_pool(load_vehicle("finsrov"), pool, sessions=2) as wiring:
        unarmed = told(capsys, *words, "--robot", wiring.robot, "--duration", "11")[1]
        assert unarmed["windows"] == 0 and not now.exists()
        status, summary = told(capsys, *words, "--robot", wiring.robot, "--duration", "12", "--arm")
    assert status == 0 and summary["windows"] == 1 and summary["changes"]["drag"]["unit"] == "-"
    assert load_vehicle(now).body.mass == load_vehicle("finsrov").body.mass
    assert finssim(*words[:-1], tmp_path / "now.txt", "--robot", "127.0.0.1:9") == 2
    assert "expected .yaml" in capsys.readouterr().err


@pytest.mark.slow
def test_on_a_wire_with_nobody_at_its_end_nothing_is_armed(capsys, pool_file):
    """In real time over UDP without a camera the run stays disarmed and gives the reason."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        free = f"127.0.0.1:{one.getsockname()[1]}"
    words = ("--policy", "pid", "--goal", "0.5,0.2,-0.5,30", "--pool-file", pool_file, "--pictures", "none")
    status, summary = told(
        capsys, *words, "--robot", "udp://127.0.0.1:9", "--bind", free, "--duration", 0.3, "--arm"
    )
    assert status == 4 and summary["state"] == "disarmed" and summary["decisions"] == 0
    assert summary["reason"] == "no inertial data"


@pytest.mark.slow
def test_a_vehicle_that_says_nothing_is_told_of(capsys, pool_file):
    """Silence of the vehicle is reported once, after three seconds."""
    words = ("--policy", "pid", "--goal", "0.5,0.2,-0.5,30", "--pool-file", pool_file, "--pictures", "none")
    assert finssim(*words, "--robot", "udp://127.0.0.1:9", "--bind", "127.0.0.1:0", "--duration", 3.5) == 4
    assert capsys.readouterr().err.count("no telemetry from udp://127.0.0.1:9") == 1


@pytest.mark.slow
def test_a_duration_of_zero_is_no_time_and_not_for_ever(capsys, pool_file):
    """A duration of zero sends only the frames of the end."""
    words = ("--policy", "pid", "--goal", "0.5,0.2,-0.5,30", "--pool-file", pool_file, "--pictures", "none")
    status, summary = told(
        capsys, *words, "--robot", "udp://127.0.0.1:9", "--bind", "127.0.0.1:0", "--duration", 0, "--arm"
    )
    assert status == 0 and summary["steps"] == 0


def test_no_record_is_left_of_a_run_that_could_not_be_connected(capsys, tmp_path, pool_file):
    """A failed connection leaves no new record and does not touch an existing one."""
    words = ("--policy", "pid", "--goal", "0,0,-0.5,0", "--pool-file", pool_file, "--bind", "127.0.0.1:0")
    record = tmp_path / "run.mcap"
    assert finssim(*words, "--pictures", "eyes", "--record", record) == 2
    assert not record.exists()
    record.write_text("mine")
    assert finssim(*words, "--pictures", "eyes", "--record", record) == 2
    assert record.read_text() == "mine" and "never replaced" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--policy", "pid"), "either a goal"),
        (("--policy", "pid", "--goal", "1,2,3"), "expected four numbers"),
        (("--policy", "pid", "--goal", "0,0,0.5,0"), "0.50 m above the surface"),
        (("--policy", "nobody", "--goal", "0,0,-0.5,0"), "neither pid nor pid-paper"),
        (("--policy", "pid", "--goal", "0,0,-0.5,0", "--robot", "tin://can"), "unknown wire"),
        (("--policy", "pid", "--goal", "0,0,-0.5,0", "--pictures", "eyes", "--bind", "127.0.0.1:0"), "eyes"),
        (("--policy", "pid", "--goal", "0,0,-0.5,0", "--lockstep", "--robot", "127.0.0.1:1"), "no world in"),
        (
            ("--policy", "pid", "--goal", "0,0,-0.5,0", "--lockstep", "--robot", "udp://127.0.0.1:1"),
            "HOST:PORT",
        ),
        (("--policy", "pid", "--goal", "0,0,-0.5,0", "--lockstep", "--pictures", "none"), "leave --bind"),
        (("--policy", "pid", "--goal", "0,0,-0.5,0", "--task", "t9"), "unknown task 't9'"),
    ],
)
def test_what_cannot_be_run_is_refused_in_a_sentence(capsys, pool_file, words, sentence):
    """The command ends with status 2 before anything is sent."""
    assert finssim(*words, "--pool-file", pool_file) == 2
    assert sentence in capsys.readouterr().err
