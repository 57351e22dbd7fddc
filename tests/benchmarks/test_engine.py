"""The benchmark of the engine measures every figure; the values are not checked here."""

from __future__ import annotations

import pytest

from benchmarks import engine


@pytest.mark.slow
def test_the_object_has_every_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    """The object has rates by model or action and world count, triangles, memory, the ratio to MuJoCo and the
    machine."""
    monkeypatch.setattr(engine, "SECONDS", 0.01)
    monkeypatch.setattr(engine, "WORLDS", (1, 64))
    monkeypatch.setattr(engine, "MEMORY_WORLDS", 64)
    out = engine.bench()
    assert {f"{m}/{w}" for m in engine.MODELS for w in (1, 64)} < set(out["physics_steps_per_s"])
    assert set(out["env_steps_per_s"]) == {f"{a}/{w}" for a in engine.ACTIONS for w in (1, 64)}
    assert all(rate > 0 for rate in out["physics_steps_per_s"].values())
    assert out["faces_per_s"] > 0 and out["memory_mb/64"] > 10 and out["machine"]["threads"] >= 1
    assert out["physics_substeps_over_mujoco_steps"] > 0


def test_a_device_that_is_not_there_is_refused() -> None:
    """A missing device is refused before anything is measured."""
    with pytest.raises(ValueError, match="device 'tpu' is not available"):
        engine.bench(device="tpu")
