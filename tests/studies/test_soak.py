"""`python -m studies.soak`: growing memory is distinguished from memory that does not grow."""

import csv
import gc
import json
import mmap

import numpy as np
import pytest

from reference.programs import study
from studies.soak import FLAT, memory_mib, verdict


def test_a_leak_is_told_from_a_cache_that_fills():
    """2 MiB an hour is growth; 30 MiB in the first minutes and nothing afterwards is not."""
    t = np.linspace(0.0, 4 * 3600.0, 200)
    noise = 0.2 * np.sin(t)
    leak, filled = (
        verdict(t, 300.0 + 2.0 * t / 3600.0 + noise),
        verdict(t, 330.0 - 30.0 * np.exp(-t / 300.0) + noise),
    )
    assert leak["verdict"] == "grows" and abs(leak["slope_mib_per_h"] - 2.0) < 0.1
    assert filled["verdict"] == "flat" and filled["slope_mib_per_h"] < FLAT
    assert verdict(t[:5], t[:5])["verdict"] == "too short to tell"


@pytest.mark.slow
def test_memory_is_that_of_this_process():
    """About 40 MiB of touched memory are measured, whatever the process used and released before."""
    gc.collect()
    before = memory_mib()
    with mmap.mmap(-1, 40 * 2**20) as kept:
        kept.write(b"1" * len(kept))
        assert 39.0 < memory_mib() - before < 44.0


@pytest.mark.slow
def test_a_short_soak_keeps_its_station_and_its_samples(capsys, tmp_path):
    """In 14 s of vehicle time it stays near the station and writes a row every 10 s."""
    assert study("soak", "--hours", "0.004", "--out", tmp_path, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert abs(result["vehicle_h"] - 0.004) < 1e-3 and result["error_max_m"] < 0.1 and not result["faults"]
    rows = list(csv.DictReader((tmp_path / "soak.csv").open()))
    assert [row["state"] for row in rows] == ["disarmed", "armed"] and float(rows[-1]["memory_mib"]) > 50.0
