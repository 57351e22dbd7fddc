"""`finssim randomize show`: the table in SI, the spread of step responses, and refusals."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from finssim import boundary
from finssim.cli import app
from finssim.engine.randomize import Randomization
from finssim.engine.ranges_file import Ranges, available, load_ranges
from finssim.experiments.randomize_show import STEPS, rows_of, step_responses
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")


def rows(**parts):
    return {row.entry: row for row in rows_of(Ranges.model_validate({"name": "test", **parts}), FINSROV)}


def test_rows_are_the_vehicles_own_numbers_times_the_factors():
    """In SI: mass, the product of common and own factor, offsets about where the file has them."""
    found = rows(
        mass=(0.9, 1.1),
        volume="with_mass",
        linear_damping={"all": [0.5, 2.0], "axes": {"surge": [0.8, 1.5]}},
        center_of_gravity={"z": [-0.01, 0.02]},
        thrust={
            "all": [0.9, 1.0],
            "each": [0.5, 1.2],
            "failure": {"uniform": [0.0, 0.3], "probability": 0.1},
        },
        added_delay=(0.0, 0.1),
    )
    mass, z = FINSROV.body.mass, FINSROV.body.center_of_gravity[2]
    assert (found["mass"].low, found["mass"].high) == pytest.approx((0.9 * mass, 1.1 * mass))
    volume = FINSROV.body.displaced_volume
    assert (found["volume"].low, found["volume"].high) == pytest.approx((0.9 * volume, 1.1 * volume))
    d1 = FINSROV.hydrodynamics["calibrated"].linear_damping
    assert (found["linear_damping.surge"].low, found["linear_damping.surge"].high) == pytest.approx(
        (0.4 * d1[0][0], 3.0 * d1[0][0])
    )
    assert (found["linear_damping.yaw"].low, found["linear_damping.yaw"].high) == pytest.approx(
        (0.5 * d1[5][5], 2.0 * d1[5][5])
    )
    assert (found["center_of_gravity.z"].low, found["center_of_gravity.z"].high) == pytest.approx(
        (z - 0.01, z + 0.02)
    )
    name = FINSROV.thruster_names[0]
    most = FINSROV.thrusters[name].force_max
    assert (found[f"thrust ({name})"].low, found[f"thrust ({name})"].high) == pytest.approx(
        (0.45 * most, 1.2 * most)
    )
    assert (found["thrust.failure, of each"].low, found["thrust.failure, of each"].high) == (0.0, 1.0)
    assert (found["added_delay"].low, found["added_delay"].high, found["added_delay"].unit) == (0.0, 0.1, "s")
    assert len(found) == 2 + 6 + 1 + 2 + 1


@pytest.mark.parametrize("name", available())
@pytest.mark.parametrize("vehicle", ["finsrov", "bluerov2_heavy"])
def test_every_set_has_rows_for_every_vehicle(name, vehicle):
    found = rows_of(load_ranges(name), load_vehicle(vehicle))
    assert found and all(row.low <= row.high for row in found)
    assert all(
        row.low - 1e-9 <= row.nominal <= row.high + 1e-9
        for row in found
        if row.nominal and name != "no_thruster_dynamics"
    )


def test_more_thrust_and_less_drag_go_faster():
    """Half and twice the thrust around the file's own response; nothing drawn is the file's own."""
    _, own = step_responses(FINSROV, None, "calibrated", 1, 0)
    for factor in (0.5, 1.0, 2.0):
        ranges = Ranges.model_validate(
            {"name": "t", "thrust": {"all": [factor, factor]}, "slew": [0.999, 0.9999]}
        )
        _, drawn = step_responses(FINSROV, Randomization(ranges), "calibrated", 2, 0)
        for axis in STEPS:
            ratio = drawn[axis][0, -1] / own[axis][0, -1]
            assert (
                (ratio > 1.2) if factor > 1.0 else (ratio < 0.8) if factor < 1.0 else abs(ratio - 1.0) < 1e-3
            )
            assert own[axis][0, -1] > 0.05


def run(*words: str) -> int:
    return boundary.run(app, list(words))


def test_the_command_writes_table_picture_and_record(tmp_path, capsys):
    out = tmp_path / "shown"
    assert run("randomize", "show", "pool", "--vehicle", "finsrov", "--out", str(out), "--samples", "20") == 0
    assert (out / "spread.png").read_bytes()[:4] == b"\x89PNG"
    record = json.loads((out / "show.json").read_text(encoding="utf-8"))
    assert record["vehicle"]["sha256"] == FINSROV.sha256 and record["samples"] == 20
    for axis in STEPS:
        speeds = record["speeds"][axis]
        assert speeds["p5"] <= speeds["p25"] <= speeds["p50"] <= speeds["p75"] <= speeds["p95"]
    with (out / "entries.csv").open(encoding="utf-8") as file:
        table = {row["entry"]: row for row in csv.DictReader(file)}
    assert float(table["mass"]["low"]) == pytest.approx(0.95 * FINSROV.body.mass)
    printed = capsys.readouterr().out
    assert "linear_damping.surge" in printed and "heave, down" in printed


@pytest.mark.slow
def test_equal_seeds_print_equal_records(tmp_path, capsys):
    records = []
    for name in ("a", "b"):
        assert run(
            "randomize", "show", "equivalent_box", "--vehicle", "finsrov", "--out", str(tmp_path / name),
            "--samples", "5", "--seed", "4", "--json",
        ) == 0  # fmt: skip
        records.append(json.loads(capsys.readouterr().out))
    assert records[0] == records[1]
    assert np.ptp([records[0]["speeds"]["heave"][p] for p in ("p5", "p95")]) > 0.01


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("masss: [0.9, 1.1]\n", "unknown entry 'masss'; did you mean 'mass'?"),
        ("linear_damping: {axes: {sorge: [1, 2]}}\n", "unknown entry 'sorge'; did you mean 'surge'?"),
    ],
)
def test_an_unknown_entry_is_refused_in_one_sentence(text, sentence, tmp_path, capsys):
    path = tmp_path / "ranges.yaml"
    path.write_text(text, encoding="utf-8")
    out = tmp_path / "shown"
    assert run("randomize", "show", str(path), "--vehicle", "finsrov", "--out", str(out)) == 2
    said = capsys.readouterr().err
    assert sentence in said and str(path) in said and said.count("\n") == 1
    assert not out.exists()


def test_ranges_from_a_fit_can_be_shown(tmp_path, capsys):
    """`randomize fit` writes what `randomize show` reads."""
    number = FINSROV.hydrodynamics["calibrated"].linear_damping[0][0]
    fit = {
        "vehicle": {"name": "finsrov", "sha256": FINSROV.sha256},
        "parameters": {
            "surge.d1": {
                "estimate": number,
                "ci95": [0.8 * number, 1.2 * number],
                "unit": "N s/m",
                "identifiable": True,
            }
        },
        "correlation": {"names": ["surge.d1"], "matrix": [[1.0]]},
    }
    (tmp_path / "fit.json").write_text(json.dumps(fit), encoding="utf-8")
    ranges = tmp_path / "ranges.yaml"
    assert (
        run("randomize", "fit", str(tmp_path / "fit.json"), "--vehicle", "finsrov", "--out", str(ranges)) == 0
    )
    assert load_ranges(ranges).linear_damping.axes["surge"].normal == pytest.approx((1.0, 0.10204), rel=1e-3)
    out = tmp_path / "shown"
    assert (
        run("randomize", "show", str(ranges), "--vehicle", "finsrov", "--out", str(out), "--samples", "3")
        == 0
    )
