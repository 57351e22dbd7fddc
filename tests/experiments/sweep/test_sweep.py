"""`finssim sweep`: results of every job, from one machine or from two of which one is lost."""

import json

import pytest
import yaml

from finssim import boundary
from finssim.cli import app
from finssim.control.policy import Policy
from finssim.experiments.sweep import command
from finssim.experiments.sweep.plan import SweepError, load_sweep

ray = pytest.importorskip("ray")


@pytest.fixture
def sweep_file(tmp_path):
    """Four trainings of two updates."""
    path = tmp_path / "sweep.yaml"
    plan = {
        "task": "t1",
        "seeds": 2,
        "train": {"steps": 16384, "worlds": 64},
        "grid": {"action": ["wrench6", "wrench4"]},
        "evaluate": {"plants": ["nominal", "current"], "trials": 1},
    }
    path.write_text(yaml.safe_dump(plan), encoding="utf-8")
    return path


def swept(capsys, *words):
    status = boundary.run(app, ["sweep", *map(str, words), "--json"])
    lines = capsys.readouterr().out.splitlines()
    return status, json.loads(lines[-1]) if lines else None


@pytest.mark.long
def test_a_sweep_is_done_once_and_goes_on_where_it_was(tmp_path, sweep_file, capsys):
    """A policy and a row for every job; only a run that is missing is made again; one that fails is told."""
    out = tmp_path / "out"
    status, result = swept(capsys, sweep_file, "--out", out, "--processes", 2)
    assert status == 0 and result["ok"] and len(result["rows"]) == 4
    for row in result["rows"]:
        assert set(row["plants"]) == {"nominal", "current"} and row["plants"]["current"]["trials"] == 1
        assert Policy.load(out / "runs" / row["run"]).description.action["mode"] == row["options"]["action"]
    kept = {path: path.stat().st_mtime_ns for path in (out / "runs").glob("*/policy.onnx")}
    gone = next(iter(kept)).parent
    for path in gone.iterdir():
        path.unlink()
    gone.rmdir()
    plan = yaml.safe_load(sweep_file.read_text(encoding="utf-8"))
    sweep_file.write_text(yaml.safe_dump({**plan, "settings": {"": {}, "bad": {"hydrodynamics": "soup"}}}))
    status, again = swept(capsys, sweep_file, "--out", out, "--processes", 2)
    assert status == 3 and not again["ok"] and len(again["rows"]) == 8
    failed = [row for row in again["rows"] if "error" in row]
    assert len(failed) == 4 and all(
        row["name"].startswith("bad") and "soup" in row["error"] for row in failed
    )
    now = {path: path.stat().st_mtime_ns for path in (out / "runs").glob("*/policy.onnx")}
    assert now.keys() == kept.keys()
    assert {path for path in kept if now[path] != kept[path]} == {gone / "policy.onnx"}
    assert {row["run"] for row in result["rows"]} <= {row["run"] for row in again["rows"]}


@pytest.mark.long
def test_a_machine_that_is_lost_half_way_is_made_up_for(tmp_path, sweep_file, monkeypatch):
    """Two Ray nodes; one is killed while both work. Every job still has its row, and equal seeds their equal policy."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(
        initialize_head=True,
        head_node_args={"num_cpus": 1, "include_dashboard": False, "node_ip_address": "127.0.0.1"},
    )
    second = cluster.add_node(num_cpus=1, node_ip_address="127.0.0.1")
    keep, ended = command._keep, []

    def watched(job, *rest):
        ended.append(job.key)
        if len(ended) == 1:  # both nodes have work now: the one on its second job, or the other on its first
            cluster.remove_node(second, allow_graceful=False)
        return keep(job, *rest)

    monkeypatch.setattr(command, "_keep", watched)
    try:
        result = command.sweep(sweep_file, out=tmp_path / "out", address=cluster.address)
    finally:
        cluster.shutdown()
    assert result["ok"] and sorted(ended) == sorted(job.key for job in load_sweep(sweep_file).jobs())
    assert len(list((tmp_path / "out" / "runs").glob("*/policy.onnx"))) == 4


def test_where_nobody_answers_is_told(tmp_path, sweep_file):
    """One sentence, and nothing is written."""
    with pytest.raises(SweepError, match="no Ray cluster answers at 127.0.0.1:9"):
        command.sweep(sweep_file, out=tmp_path / "out", address="127.0.0.1:9")
    assert not (tmp_path / "out").exists()
