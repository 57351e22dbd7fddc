"""The benchmark measures what it says; its figures are not judged here."""

from __future__ import annotations

import json

import pytest

from finssim import boundary
from finssim.cli import app
from finssim.experiments import bench


@pytest.mark.slow
def test_the_object_has_every_figure(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rates keyed by model or action and world count, triangles, memory, the ratio to MuJoCo and the machine."""
    monkeypatch.setattr(bench, "SECONDS", 0.01)
    monkeypatch.setattr(bench, "WORLDS", (1, 64))
    monkeypatch.setattr(bench, "MEMORY_WORLDS", 64)
    assert boundary.run(app, ["bench", "--json"]) == 0
    out = json.loads(capsys.readouterr().out)
    assert {f"{m}/{w}" for m in bench.MODELS for w in (1, 64)} < set(out["physics_steps_per_s"])
    assert set(out["env_steps_per_s"]) == {f"{a}/{w}" for a in bench.ACTIONS for w in (1, 64)}
    assert all(rate > 0 for rate in out["physics_steps_per_s"].values())
    assert out["faces_per_s"] > 0 and out["memory_mb/64"] > 10 and out["machine"]["threads"] >= 1
    assert out["physics_substeps_over_mujoco_steps"] > 0
