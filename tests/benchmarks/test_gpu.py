"""The GPU benchmark also runs on a CPU, names the parts that it skips, and evaluates differences."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import gpu


@pytest.mark.slow
def test_a_small_run_on_the_processor_has_every_figure(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Physics, a task, a learner, a camera and a sonar have rates; a missing learner is named."""
    monkeypatch.syspath_prepend(str(Path(gpu.__file__).parent))
    monkeypatch.setattr(gpu, "numeric_tasks", lambda: ["t1", "path"])
    monkeypatch.setattr(gpu, "LEARNERS", {"ppo": "t1", "nobody": "t1"})
    result = gpu.gpu(out=tmp_path / "gpu", device="cpu", scale=1e-4)
    rates = result["per_second"]
    assert set(rates) == {
        *(f"physics, {model}" for model in gpu.MODELS), "task, t1", "task, path", "learner, ppo",
        "camera, pool", "camera, dock", "sonar, pool",
    }  # fmt: skip
    assert all(rate > 0 for rate in rates.values())
    assert (
        list(result["left_out"]) == ["learner, nobody"] and "nobody" in result["left_out"]["learner, nobody"]
    )
    assert result["ok"] and result["differences"] == dict.fromkeys(gpu.TOLERANCES, 0.0)
    assert json.loads((tmp_path / "gpu" / "gpu.json").read_text())["machine"]["warp"]


def test_a_device_that_is_not_there_is_refused(tmp_path: Path) -> None:
    """A missing device is refused before anything is measured or written."""
    with pytest.raises(ValueError, match="device 'tpu' is not available"):
        gpu.gpu(out=tmp_path / "gpu", device="tpu")
    assert not (tmp_path / "gpu").exists()
