"""`finssim randomize show`: the table in SI, and refusals."""

from __future__ import annotations

import json

import pytest

from finssim import boundary
from finssim.cli import app
from finssim.engine.ranges_file import Ranges, available, load_ranges
from finssim.experiments.randomize_show import rows_of
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


def run(*words: str) -> int:
    return boundary.run(app, list(words))


def test_the_command_prints_the_table_and_its_record(capsys):
    """The same numbers as JSON, where that is asked for."""
    assert run("randomize", "show", "pool", "--vehicle", "finsrov") == 0
    assert "linear_damping.surge" in capsys.readouterr().out
    assert run("randomize", "show", "pool", "--vehicle", "finsrov", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert record["vehicle"]["sha256"] == FINSROV.sha256
    table = {one["entry"]: one for one in record["entries"]}
    assert table["mass"]["low"] == pytest.approx(0.95 * FINSROV.body.mass)


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
    assert run("randomize", "show", str(path), "--vehicle", "finsrov") == 2
    said = capsys.readouterr().err
    assert sentence in said and str(path) in said and said.count("\n") == 1


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
    assert run("randomize", "show", str(ranges), "--vehicle", "finsrov") == 0
