"""The benchmark of cameras measures every figure; the values are not checked here."""

import pytest

pytest.importorskip("newton", reason="finssim[perception] is not installed")

from benchmarks import cameras


@pytest.mark.slow
def test_the_object_has_rates_by_size_and_the_bare_sensor_beside(monkeypatch):
    """The object has frames per second by picture size, those of bare rays, their ratio, pings and memory."""
    for name, value in (("SIZES", (8, 16)), ("WORLDS", 4), ("ROUNDS", 2), ("MEMORY_WORLDS", 4)):
        monkeypatch.setattr(cameras, name, value)
    out = cameras.bench_cameras()
    for key in ("frames_per_s", "bare_frames_per_s", "ratio"):
        assert set(out[key]) == {"8x8", "16x16"} and all(rate > 0 for rate in out[key].values())
    assert out["ratio"]["8x8"] == out["frames_per_s"]["8x8"] / out["bare_frames_per_s"]["8x8"]
    assert out["sonar_pings_per_s"]["64x64"] > 0 and out["memory_mb/4/64x64"] > 50
    (table,) = cameras.tables_of(out)
    assert len(table.rows) == 3
