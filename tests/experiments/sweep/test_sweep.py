"""`finssim sweep`: results of every job, from one machine or from two of which one is lost."""

import contextlib
import ipaddress
import json
import os
import sys
import time
from pathlib import Path

import pytest
import yaml

from finssim import boundary
from finssim.cli import app
from finssim.control.policy import Policy
from finssim.experiments.sweep import cluster, command
from finssim.experiments.sweep.plan import SweepError, load_sweep

ray = pytest.importorskip("ray")


@pytest.fixture(autouse=True)
def nothing_left():
    """No process of Ray outlives a test."""
    before = ray_processes()
    yield
    left = ray_processes() - before
    for _ in range(600):
        if not left:
            return
        time.sleep(0.1)
        left = ray_processes() - before
    pytest.fail(f"processes of Ray are left: {left}")


def ray_processes():
    """Numbers of the processes of Ray on this machine, whoever started them."""
    found = set()
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):  # it ended meanwhile
            words = path.read_bytes()
            if words.startswith(b"ray::") or b"/raylet\0" in words or b"/gcs_server\0" in words:
                found.add(int(path.parent.name))
    return found


def listening(processes):
    """Address, port and command of every socket on which processes listen, from the kernel's tables."""
    heard = {}
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            _, local, _, state, *others = line.split()
            if state == "0A":  # LISTEN
                address, port = local.split(":")
                words = [
                    int(address[i : i + 8], 16).to_bytes(4, sys.byteorder) for i in range(0, len(address), 8)
                ]
                heard[f"socket:[{others[5]}]"] = ipaddress.ip_address(b"".join(words)), int(port, 16)
    found = set()
    for process in processes:
        with contextlib.suppress(OSError):  # it ended meanwhile
            name = Path(f"/proc/{process}/cmdline").read_bytes().split(b"\0")[0].decode()
            for file in Path(f"/proc/{process}/fd").iterdir():
                with contextlib.suppress(OSError):
                    if (socket := os.readlink(file)) in heard:
                        found.add((*heard[socket], name))
    return found


def is_loopback(address):
    return (getattr(address, "ipv4_mapped", None) or address).is_loopback


@pytest.mark.slow
def test_a_ray_of_its_own_listens_on_the_loopback_interface_alone():
    """Every socket of this process and of every process that Ray starts: its servers, agents and workers."""
    before = ray_processes()
    with cluster.running(None, 1):
        worker = ray.get(ray.remote(lambda: os.getpid()).remote())
        sockets = listening({os.getpid(), *ray_processes() - before})
        mine = listening({worker})
    assert mine and len(sockets) >= 5  # driver, GCS server, raylet, agent of environments, worker
    assert [socket for socket in sockets if not is_loopback(socket[0])] == []


@pytest.fixture
def sweep_file(tmp_path):
    """Two settings, each trained for one short update."""
    path = tmp_path / "sweep.yaml"
    plan = {
        "task": "t1",
        "seeds": 1,
        "train": {"steps": 1024, "worlds": 16},
        "grid": {"action": ["wrench6", "wrench4"]},
        "evaluate": {"plants": ["current"], "trials": 1},
    }
    path.write_text(yaml.safe_dump(plan), encoding="utf-8")
    return path


def changed(file, **changes):
    """The same file with other values."""
    plan = yaml.safe_load(file.read_text(encoding="utf-8"))
    file.write_text(yaml.safe_dump({**plan, **changes}), encoding="utf-8")


def swept(capsys, *words):
    status = boundary.run(app, ["sweep", *map(str, words), "--json"])
    lines = capsys.readouterr().out.splitlines()
    return status, json.loads(lines[-1]) if lines else None


@pytest.mark.slow
def test_a_sweep_is_done_once_and_goes_on_where_it_was(tmp_path, sweep_file, capsys):
    """A policy and a row for every job; only a run that is missing is made again; one that fails is told."""
    out = tmp_path / "out"
    status, result = swept(capsys, sweep_file, "--out", out, "--processes", 2)
    assert status == 0 and result["ok"] and len(result["rows"]) == 2
    for row in result["rows"]:
        assert set(row["plants"]) == {"current"} and row["plants"]["current"]["trials"] == 1
        assert Policy.load(out / "runs" / row["run"]).description.action["mode"] == row["options"]["action"]
    kept = {path: path.stat().st_mtime_ns for path in (out / "runs").glob("*/policy.onnx")}
    gone = next(iter(kept)).parent
    for path in gone.iterdir():
        path.unlink()
    gone.rmdir()
    changed(sweep_file, settings={"": {}, "bad": {"hydrodynamics": "soup"}})
    status, again = swept(capsys, sweep_file, "--out", out, "--processes", 2)
    assert status == 3 and not again["ok"] and len(again["rows"]) == 4
    failed = [row for row in again["rows"] if "error" in row]
    assert len(failed) == 2 and all(
        row["name"].startswith("bad") and "soup" in row["error"] for row in failed
    )
    now = {path: path.stat().st_mtime_ns for path in (out / "runs").glob("*/policy.onnx")}
    assert now.keys() == kept.keys()
    assert {path for path in kept if now[path] != kept[path]} == {gone / "policy.onnx"}
    assert {row["run"] for row in result["rows"]} <= {row["run"] for row in again["rows"]}


@pytest.fixture
def two_machines(monkeypatch):
    """Two Ray nodes of one processor each, on the loopback interface; the second one can be killed."""
    from ray._private import ray_constants
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    # Otherwise Ray takes 127.0.0.1 for this machine's address on the network, where these nodes do not listen.
    monkeypatch.setattr(ray_constants, "ENABLE_RAY_CLUSTER", False)
    node = {"num_cpus": 1, "node_ip_address": "127.0.0.1", "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=node)
    try:
        yield cluster, cluster.add_node(**node)
    finally:
        ray.shutdown()
        cluster.shutdown()


@pytest.mark.slow
def test_a_machine_that_is_lost_half_way_is_made_up_for(tmp_path, sweep_file, two_machines, monkeypatch):
    """One of two nodes is killed while both work. Every job still has its row and its policy."""
    changed(sweep_file, seeds=2)
    cluster, second = two_machines
    keep, ended = command._keep, []

    def watched(job, *rest):
        ended.append(job.key)
        if len(ended) == 1:  # both nodes have work now: the one on its second job, or the other on its first
            cluster.remove_node(second, allow_graceful=False)
        return keep(job, *rest)

    monkeypatch.setattr(command, "_keep", watched)
    result = command.sweep(sweep_file, out=tmp_path / "out", address=cluster.address)
    assert result["ok"] and sorted(ended) == sorted(job.key for job in load_sweep(sweep_file).jobs())
    assert len(list((tmp_path / "out" / "runs").glob("*/policy.onnx"))) == 4


@pytest.mark.parametrize(
    ("address", "sentence"),
    [("127.0.0.1:9", "no Ray cluster answers at 127.0.0.1:9"), ("here", "expected HOST:PORT or auto")],
)
def test_where_nobody_answers_is_told(tmp_path, sweep_file, address, sentence):
    """One sentence at once, and nothing is written."""
    with pytest.raises(SweepError, match=sentence):
        command.sweep(sweep_file, out=tmp_path / "out", address=address)
    assert not (tmp_path / "out").exists()
