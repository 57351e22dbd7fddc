"""A recorded run equals the simulation, and an interrupted run opens up to the interruption."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from finssim.sim import Simulator, SimulatorError, StateRecorder, read_run
from reference.finned import torpedo


def run(folder: Path, steps: int, chunk: int, worlds: list[int] | None = None) -> Simulator:
    """Simulate three worlds under different thrusts and record them."""
    simulator = Simulator("finsrov", worlds=3, control_step=0.1, seed=7)
    simulator.set_thrust(np.linspace(-1.0, 1.0, 24).reshape(3, 1, 8))
    with StateRecorder(simulator, folder, worlds=worlds, chunk=chunk) as recorder:
        for _ in range(steps):
            simulator.step()
            recorder.record()
    return simulator


def test_the_last_row_is_the_last_state(tmp_path: Path) -> None:
    """Rows contain clocks, states, commands and thrusts of the requested worlds only."""
    simulator = run(tmp_path / "run", steps=12, chunk=1000, worlds=[0, 2])
    table = read_run(tmp_path / "run")
    assert sorted(table["world"].unique()) == [0, 2] and len(table) == 24
    last = table[(table["world"] == 2)].iloc[-1]
    assert last["t"] == pytest.approx(1.2)
    np.testing.assert_array_equal(
        last[["x", "y", "z"]].to_numpy(dtype=np.float32), simulator.numpy("position")[2, 0]
    )
    np.testing.assert_array_equal(
        last[["u", "v", "w", "p", "q", "r"]].to_numpy(np.float32), simulator.numpy("velocity")[2, 0]
    )
    names = simulator.vehicles[0].thruster_names
    thrust = last[[f"thrust_{name}" for name in names]].to_numpy(np.float32)
    np.testing.assert_array_equal(thrust, simulator.numpy("thrust")[2, 0])


def test_a_run_says_what_it_was(tmp_path: Path) -> None:
    """Vehicle hash, model, times and seed are stored with the run."""
    simulator = run(tmp_path / "run", steps=2, chunk=1000)
    about = read_run(tmp_path / "run").attrs
    assert about["vehicles"] == [{"name": "finsrov", "sha256": simulator.vehicles[0].sha256}]
    assert (about["hydrodynamics"], about["seed"], about["control_step"]) == ("calibrated", 7, 0.1)


def test_a_run_cut_short_opens_up_to_its_last_part(tmp_path: Path) -> None:
    """Parts are whole files: without a close, only the buffered rows are missing."""
    simulator = Simulator("finsrov", worlds=3)
    recorder = StateRecorder(simulator, tmp_path / "run", chunk=6)
    for _ in range(5):
        simulator.step()
        recorder.record()  # three rows each: two parts, and three rows that are never written
    table = read_run(tmp_path / "run")
    assert len(table) == 12
    assert len(pd.read_parquet(tmp_path / "run")) == 12


def test_an_error_in_the_run_keeps_its_rows(tmp_path: Path) -> None:
    """Leaving the context by an exception, Ctrl-C included, writes the recorded rows."""
    simulator = Simulator("finsrov")
    with pytest.raises(KeyboardInterrupt), StateRecorder(simulator, tmp_path / "run") as recorder:
        simulator.step()
        recorder.record()
        raise KeyboardInterrupt
    assert len(read_run(tmp_path / "run")) == 1


def test_a_used_folder_and_a_missing_world_are_refused(tmp_path: Path) -> None:
    """Nothing is overwritten, and a world that does not exist is named."""
    simulator = Simulator("finsrov", worlds=2)
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "notes.txt").write_text("mine")
    with pytest.raises(SimulatorError, match="not empty"):
        StateRecorder(simulator, tmp_path / "used")
    with pytest.raises(SimulatorError, match="worlds \\[5\\]: there are 0 to 1"):
        StateRecorder(simulator, tmp_path / "new", worlds=[5])
    with pytest.raises(SimulatorError, match="no recorded run"):
        read_run(tmp_path / "used")


def test_other_actuators_have_columns_too(tmp_path: Path) -> None:
    """Columns are commands of all channels, thrust of thrusters, and values of the others."""
    simulator = Simulator(torpedo(), control_step=0.1)
    simulator.place(position=(0.0, 0.0, -5.0))
    simulator.set_actuators([5.0, 0.2, 0.0, 1e-4, 0.0])
    with StateRecorder(simulator, tmp_path / "run") as recorder:
        for _ in range(12):
            simulator.step()
        recorder.record()
    last = read_run(tmp_path / "run").iloc[-1]
    assert last["command_rudder"] == pytest.approx(0.2) and last["actuator_rudder"] == pytest.approx(
        0.196, abs=1e-3
    )
    assert last["actuator_engine"] == pytest.approx(1e-4) and last["thrust_propeller"] > 1.0
