"""Curves of a training in Weights & Biases, offline."""

import os
import re
import subprocess
import sys

import pytest

from finssim.learning.train import TrainingSettings, train


@pytest.mark.slow
def test_curves_go_to_one_run_which_a_resumed_training_goes_on_with(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    out, side = tmp_path / "policy", tmp_path / "policy-training"
    settings = {"worlds": 16, "steps": 1024, "seed": 1, "wandb": "swim"}
    train("t1", TrainingSettings(**settings), out=out)
    (first,) = (side / "wandb").glob("offline-run-*")
    number = (side / "wandb-run.txt").read_text().strip()
    (log,) = first.glob(f"run-{number}.wandb")
    data = log.read_bytes()
    for words in (b"swim", b"policy", b"learner/", b"episodes/", b"evaluation/success"):
        assert words in data
    train("t1", TrainingSettings(**settings), out=out, resume=True)
    assert all(run.name.endswith(number) for run in (side / "wandb").glob("offline-run-*"))


@pytest.mark.slow
def test_nobody_logged_in_is_one_sentence(tmp_path):
    """Without a login, a separate process (Weights & Biases reads its environment only once) prints one sentence."""
    words = [
        "train",
        "t1",
        "--worlds",
        "16",
        "--steps",
        "1024",
        "--out",
        tmp_path / "policy",
        "--wandb",
        "swim",
    ]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("WANDB")}
    done = subprocess.run(
        [sys.executable, "-m", "finssim", *map(str, words)],
        env=environment | {"NETRC": str(tmp_path / "netrc")}, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert re.search(r"finssim: Weights & Biases: .*or set WANDB_MODE=offline", " ".join(done.stderr.split()))
    assert not (tmp_path / "policy").exists()
