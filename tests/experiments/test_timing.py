"""`finssim experiment timing`: figures of real processes, and of lock-step."""

import json

import pytest

from finssim import boundary
from finssim.cli import app
from finssim.experiments import reliability
from finssim.experiments.reliability import lockstep_speed


def test_lockstep_is_timed_by_the_vehicles_time():
    """Without pictures, some times real time on any machine."""
    assert lockstep_speed("finsrov", "corners", duration=2.0) > 0.2


def test_an_unknown_camera_is_refused_before_anything_starts(capsys, tmp_path):
    """With the names of those there are."""
    words = ["experiment", "timing", "--camera", "eyes", "--out", str(tmp_path)]
    assert boundary.run(app, words) == 2
    assert "unknown camera 'eyes'; available: pictures, corners" in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_in_real_time_is_timed(capsys, tmp_path, monkeypatch):
    """Both processes' own words, each figure against its limit."""
    monkeypatch.setattr(reliability, "TRIED", {"corners": 2.0, "pictures": 1.0})
    monkeypatch.setattr(reliability, "WARM_UP", 0.2)
    words = [
        "experiment",
        "timing",
        "--minutes",
        "0.1",
        "--camera",
        "corners",
        "--out",
        str(tmp_path),
        "--json",
    ]
    assert boundary.run(app, words) == 0
    result = json.loads(capsys.readouterr().out)
    told = result["realtime"]["robot"]
    assert told["steps"] > 60 and told["pictures"] > 10 and set(told["latency_s"]) >= {"p50", "p99"}
    assert set(result["reached"]) == {
        "no decision missed", "picture to command, p99", "lock-step, corners", "lock-step, pictures",
    }  # fmt: skip
