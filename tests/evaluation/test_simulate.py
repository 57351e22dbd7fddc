"""`finssim simulate` records the motion that the vehicle's file implies."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from finssim.cli.simulate import CommandError, simulate
from finssim.core.files import OutputError
from finssim.sim import SimulatorError
from finssim.vehicles import VehicleError, load_vehicle


def run(out, **changes):
    """Call the command with some arguments changed."""
    arguments = {
        "vehicle": "finsrov",
        "command": "surge=10",
        "duration": 2.0,
        "hydrodynamics": "calibrated",
        "depth": 5.0,
        "device": "cpu",
    }
    simulate(**(arguments | changes), out=Path(out))
    return pd.read_csv(out)


def test_the_recorded_speed_is_the_terminal_one(tmp_path):
    """Surge tends to tau / d1 after 12 s, seventeen time constants, within rounding and thruster arms."""
    table = run(tmp_path / "run.csv", duration=12.0)
    d1 = load_vehicle("finsrov").hydrodynamic_set("calibrated").linear_damping[0, 0]
    assert table["u"].iloc[-1] == pytest.approx(10.0 / d1, rel=5e-3)


def test_the_table_is_complete(tmp_path):
    """The table has one row per control step from rest, with SI units, a unit quaternion and every thruster by name."""
    table = run(tmp_path / "run.csv")
    vehicle = load_vehicle("finsrov")
    np.testing.assert_allclose(table["t"], np.arange(21) * 0.1)
    assert list(table.columns[-8:]) == [f"thrust_{name}" for name in vehicle.thruster_names]
    assert table.iloc[0][["x", "y", "z", "u", "r"]].tolist() == [0.0, 0.0, -5.0, 0.0, 0.0]
    np.testing.assert_allclose(np.linalg.norm(table[["qx", "qy", "qz", "qw"]], axis=1), 1.0, atol=1e-6)
    # Velocity is the derivative of position: without rotation, x grows by the mean of u, to the square of the step.
    np.testing.assert_allclose(
        np.diff(table["x"]), 0.1 * (table["u"][:-1].values + table["u"][1:].values) / 2, atol=2e-3
    )


def test_the_run_says_where_it_comes_from(tmp_path):
    """The file beside the table contains the vehicle's hash, the command and the versions."""
    run(tmp_path / "run.csv", command="yaw=1")
    about = json.loads((tmp_path / "run.csv.json").read_text())
    assert about["vehicle"] == {"name": "finsrov", "sha256": load_vehicle("finsrov").sha256}
    assert about["command"]["yaw"] == 1.0 and about["provenance"]["finssim"]
    assert sorted(file.name for file in tmp_path.iterdir()) == ["run.csv", "run.csv.json"]


def test_equal_runs_write_equal_files(tmp_path):
    """The same command gives the same bytes."""
    for name in ("a.csv", "b.csv"):
        run(tmp_path / name)
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


@pytest.mark.parametrize("model", ["calibrated", "simplified", "mesh"])
def test_every_model_moves_forward(tmp_path, model):
    """Each hydrodynamic model of FinsROV runs, and a push forward moves it forward."""
    assert run(tmp_path / "run.csv", hydrodynamics=model)["x"].iloc[-1] > 0.1


@pytest.mark.parametrize(
    ("changes", "error", "sentence"),
    [
        ({"vehicle": "finrov"}, VehicleError, "did you mean 'finsrov'"),
        ({"command": "surge=x"}, CommandError, "expected a number"),
        ({"duration": 0.0}, CommandError, "duration is 0.0 s, expected 0.1 to 86400 s"),
        ({"duration": float("nan")}, CommandError, "duration is nan s"),
        ({"depth": float("inf")}, CommandError, "depth is inf m"),
        ({"hydrodynamics": "fosen"}, SimulatorError, "unknown hydrodynamic model 'fosen'"),
        ({"vehicle": "lauv", "hydrodynamics": "mesh"}, ValueError, "mesh|hull"),
        ({"device": "tpu"}, SimulatorError, "device 'tpu' is not available"),
        ({"out": "run.txt"}, CommandError, "expected .csv"),
        ({"out": "/proc/finssim/run.csv"}, OutputError, "cannot write /proc/finssim/run.csv"),
    ],
)
def test_what_cannot_be_simulated_is_refused(tmp_path, changes, error, sentence):
    """An impossible simulation is refused in one sentence, and no file is written."""
    out = changes.get("out", tmp_path / "run.csv")
    with pytest.raises(error, match=sentence):
        run(out, **{name: value for name, value in changes.items() if name != "out"})
    assert list(tmp_path.iterdir()) == []
