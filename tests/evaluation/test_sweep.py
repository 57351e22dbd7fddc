"""`finssim sweep`: results of every job, from one machine or from two of which one fails."""

import asyncio
import contextlib
import json
import threading
import time
from dataclasses import replace
from html import escape
from pathlib import Path

import pytest
import yaml

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.control.policy import Policy
from finssim.evaluation import campaign
from finssim.evaluation.campaign import Checkpoints, ClusterError
from finssim.learning.train import TrainingSettings, train
from finssim.studies import sweep as command
from finssim.studies import transfer
from studies.anatomy import anatomy
from studies.faults import faults_experiment

ray = pytest.importorskip("ray")


@pytest.fixture(scope="module", autouse=True)
def nothing_left():
    """No Ray process outlives the tests."""
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
    """Return the ids of the Ray processes on this machine, whoever started them."""
    found = set()
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):  # it ended meanwhile
            words = path.read_bytes()
            if words.startswith(b"ray::") or b"/raylet\0" in words or b"/gcs_server\0" in words:
                found.add(int(path.parent.name))
    return found


@pytest.fixture
def sweep_file(tmp_path):
    """A sweep file with two action modes, each trained for one short update."""
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
    """Return the same file with other values."""
    plan = yaml.safe_load(file.read_text(encoding="utf-8"))
    file.write_text(yaml.safe_dump({**plan, **changes}), encoding="utf-8")


def swept(capsys, *words):
    status = boundary.run(app, ["sweep", *map(str, words), "--json"])
    lines = capsys.readouterr().out.splitlines()
    return status, json.loads(lines[-1]) if lines else None


@pytest.mark.slow
def test_a_sweep_is_done_once_and_goes_on_where_it_was(tmp_path, sweep_file, capsys):
    """Every training has a policy and a row; only a missing one is repeated; a failed one is in the table."""
    out = tmp_path / "out"
    status, result = swept(capsys, sweep_file, "--out", out, "--processes", 2)
    assert status == 0 and result["ok"] and len(result["rows"]) == 2
    for row in result["rows"]:
        assert set(row["plants"]) == {"current"} and row["plants"]["current"]["trials"] == 1
        assert Policy.load(out / "runs" / row["run"]).description.action["mode"] == row["options"]["action"]
        assert row["training_s"] > 0.0
    kept = {path: path.stat().st_mtime_ns for path in out.glob("*/*/policy.onnx")}
    evaluations = {path: path.stat().st_mtime_ns for path in (out / "evaluations").iterdir()}
    gone = next(iter(kept)).parent
    for path in gone.iterdir():
        path.unlink()
    gone.rmdir()
    changed(sweep_file, grid={"action": ["wrench6", "wrench4", "soup"]})
    status, again = swept(capsys, sweep_file, "--out", out, "--processes", 2)
    assert status == 3 and not again["ok"] and len(again["rows"]) == 3
    (failed,) = [row for row in again["rows"] if "error" in row]
    assert failed["name"] == "action-soup" and "soup" in failed["error"]
    assert escape(failed["error"]) in (out / "sweep.html").read_text(encoding="utf-8")
    now = {path: path.stat().st_mtime_ns for path in out.glob("*/*/policy.onnx")}
    assert now.keys() == kept.keys()
    assert {path for path in kept if now[path] != kept[path]} == {gone / "policy.onnx"}
    assert {row["run"] for row in result["rows"]} <= {row["run"] for row in again["rows"]}
    evaluated = {path: path.stat().st_mtime_ns for path in (out / "evaluations").iterdir()}
    assert evaluations.items() < evaluated.items() and len(evaluated) == 3  # one row of the repeated training


@pytest.fixture(scope="module")
def two_machines():
    """Two Ray nodes with one processor each, on the loopback interface; the last test kills the second one."""
    from ray._private import ray_constants
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_worker_niceness", "0")  # 15 by default, with which they wait for the other tests
        # Otherwise Ray uses 127.0.0.1 as this machine's network address, where these nodes do not listen.
        patch.setattr(ray_constants, "ENABLE_RAY_CLUSTER", False)
        node = {"num_cpus": 1, "node_ip_address": "127.0.0.1", "include_dashboard": False}
        cluster = Cluster(initialize_head=True, head_node_args=node)
        try:
            yield cluster, cluster.add_node(**node)
        finally:
            ray.shutdown()
            cluster.shutdown()


def test_a_table_without_a_policy_shows_the_errors():
    """If every training failed, the table shows the errors."""
    row = {"name": "run", "seed": 1, "run": "run-seed1", "options": {}, "error": "TrainingError: no"}
    (table,) = command.tables_of({"rows": [row]})
    assert table.rows == [["run", "1", "–", "–", "TrainingError: no"]] and len(table.heads) == 5


@pytest.mark.slow
def test_an_experiment_trains_and_plays_on_a_cluster(tmp_path, two_machines, monkeypatch):
    """Policies, results and motions return to this machine, where nothing remains to do; the table is the same."""
    cluster, _ = two_machines
    here = transfer.TransferSettings(rows=["calibrated", "pid"], plants=1, seeds=1, steps=4096, processes=1)
    there = replace(here, processes=None, address=cluster.address)
    away = transfer.t1(out=tmp_path, setpoints=["P01"], settings=there)
    assert (tmp_path / "policies" / "calibrated-seed1" / "policy.onnx").is_file()
    assert len(list((tmp_path / "trials").glob("*.npz"))) == 2

    def played_here(*_):
        raise AssertionError("was played already")

    monkeypatch.setattr("finssim.evaluation.robot_trials.play", played_here)
    again = transfer.t1(out=tmp_path, setpoints=["P01"], settings=here)
    assert again["rows"] == away["rows"] and away["rows"]["pid"]["success"] == 1
    found = anatomy(
        out=tmp_path / "anatomy", causes=("lag",), rows=("pid",), seeds=1, trials=1, address=cluster.address
    )
    assert found["foreign"]["pid"]["success"]["count"] == 10
    broken = faults_experiment(out=tmp_path / "faults", scenarios=["frozen-depth"], address=cluster.address)
    assert broken["ok"] and broken["trials"]


@pytest.mark.parametrize(
    ("address", "sentence"),
    [("127.0.0.1:9", "no Ray cluster answers at 127.0.0.1:9"), ("here", "expected HOST:PORT or auto")],
)
def test_where_nobody_answers_is_told(tmp_path, sweep_file, address, sentence):
    """An address without a cluster is refused at once in one sentence, and nothing is written."""
    with pytest.raises(ClusterError, match=sentence):
        command.sweep(sweep_file, out=tmp_path / "out", address=address)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_trainings_on_a_lost_machine_resume_from_their_checkpoints(
    tmp_path, sweep_file, two_machines, monkeypatch
):
    """One of two nodes is killed after both have sent a checkpoint: every training ends, one of them resumed."""
    changed(sweep_file, train={"steps": 8 * 4096, "worlds": 16})
    cluster, second = two_machines
    ended = threading.Event()

    class WatchedCheckpoints(Checkpoints):  # a class of this function is sent to Ray with its code
        async def store(self, number, files):
            super().store(number, files)
            (tmp_path / str(number)).touch()
            while not (tmp_path / "killed").exists():  # so that neither ends before the other has begun
                await asyncio.sleep(0.05)

    monkeypatch.setattr(campaign, "Checkpoints", WatchedCheckpoints)

    def kill_when_both_have_begun():
        while len(list(tmp_path.glob("[01]"))) < 2 and not ended.wait(0.05):
            pass
        cluster.remove_node(second, allow_graceful=False)
        (tmp_path / "killed").touch()

    killer = threading.Thread(target=kill_when_both_have_begun)
    killer.start()
    try:
        result = command.sweep(sweep_file, out=tmp_path / "out", address=cluster.address)
    finally:
        ended.set()
        killer.join()
    assert result["ok"] and all(row["plants"]["current"]["trials"] == 1 for row in result["rows"])
    policies = [Policy.load(tmp_path / "out" / "runs" / row["run"]) for row in result["rows"]]
    resumed = [policy.description.training.get("resumed_after", []) for policy in policies]
    assert sorted(map(len, resumed)) == [0, 1]
    (steps,) = max(resumed, key=len)
    assert 0 < steps < 8 * 4096 and steps % (2 * 4096) == 0


def test_an_interrupted_training_of_several_processes_begins_anew(tmp_path, monkeypatch):
    """Checkpoints contain only the state of the first process, and `train` refuses to resume from them."""
    called = []
    monkeypatch.setattr(transfer, "train", lambda *_, resume=False, **__: called.append(resume))
    (tmp_path / "run-training").mkdir()
    settings = TrainingSettings(worlds=16, processes=2)
    assert list(transfer.train_policies({tmp_path / "run": ("t1", settings)}))[0][1] is None
    assert called == [False]


@pytest.mark.slow
def test_an_interrupted_training_resumes_from_its_checkpoint(tmp_path):
    """On this machine, checkpoints of the training are beside the policy and are removed at the end."""
    policy, settings = tmp_path / "run", TrainingSettings(worlds=16, steps=4 * 4096)

    def interrupt(checkpoint):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train("t1", settings, out=policy, saved=interrupt)
    assert not transfer.finished(policy)
    assert list(transfer.train_policies({policy: ("t1", settings)})) == [(policy, None)]
    assert transfer.finished(policy) and [path.name for path in tmp_path.iterdir()] == ["run"]
    assert Policy.load(policy).description.training["resumed_after"] == [4096]
