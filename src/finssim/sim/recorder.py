"""Recording of a run: state, commands and thrusts of selected worlds, in a folder of Parquet files for pandas."""

import json
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from finssim.core.files import atomic_write
from finssim.core.provenance import provenance
from finssim.core.yaml_file import read_json
from finssim.sim.plant_arrays import SimulatorError

if TYPE_CHECKING:
    import pandas

    from finssim.sim.simulator import Simulator

STATE_COLUMNS = {
    "position": ("x", "y", "z"),
    "quaternion": ("qx", "qy", "qz", "qw"),
    "velocity": ("u", "v", "w", "p", "q", "r"),
    "acceleration": ("u_dot", "v_dot", "w_dot", "p_dot", "q_dot", "r_dot"),
}
"""Field of the simulator's state -> its columns, SI; world frame for the first two, body frame for the others."""

ABOUT = "_run.json"
"""Description of the run: vehicles with their hashes, model, times, seed, revision. Parquet readers skip names with a
`_`."""


class StateRecorder:
    """Recorder of one row per recorded world, vehicle and call of `record`.

    A file is written completely every `chunk` rows, so an interrupted run can be read up to its last file:
    `pandas.read_parquet(folder)` or `read_run(folder)`. Use it as a context manager.
    """

    def __init__(
        self,
        simulator: "Simulator",
        folder: str | Path,
        worlds: Sequence[int] | None = None,
        chunk: int = 20_000,
    ) -> None:
        """Start a run.

        Args:
            simulator: The simulator to record.
            folder: New or empty folder for the files.
            worlds: Indices of the worlds to record; all if None.
            chunk: Number of rows per file.

        Raises:
            SimulatorError: The folder is not empty, or a world does not exist.
        """
        self.simulator, self.folder, self.chunk = simulator, Path(folder), chunk
        self.worlds = np.arange(simulator.worlds) if worlds is None else np.asarray(worlds, dtype=int)
        if self.worlds.size == 0 or self.worlds.min() < 0 or self.worlds.max() >= simulator.worlds:
            raise SimulatorError(
                f"cannot record worlds {self.worlds.tolist()}: there are 0 to {simulator.worlds - 1}"
            )
        if self.folder.exists() and any(self.folder.iterdir()):
            raise SimulatorError(f"{self.folder} is not empty: give a new folder for the run")
        self._rows: list[NDArray[Any]] = []
        self._waiting = 0
        self._parts = 0
        most = max(simulator.vehicles, key=lambda v: len(v.channel_names))
        self._channels = len(most.channel_names)
        self.columns = ["world", "vehicle", "t", *(c for group in STATE_COLUMNS.values() for c in group)]
        self.columns += [f"command_{name}" for name in most.channel_names]
        self.columns += [f"thrust_{name}" for name in most.thrusters]
        self.columns += [f"actuator_{name}" for name in most.actuators]
        with atomic_write(self.folder / ABOUT) as temporary:
            temporary.write_text(json.dumps(self._about(), indent=2) + "\n", encoding="utf-8")

    def _about(self) -> dict[str, Any]:
        s = self.simulator
        return {
            "vehicles": [{"name": v.name, "sha256": v.sha256} for v in s.vehicles],
            "hydrodynamics": s.hydrodynamics,
            "integrator": s.integrator,
            "control_step": s.control_step,
            "substeps": s.substeps,
            "worlds": s.worlds,
            "seed": s.seed,
            "units": "SI; columns x y z qx qy qz qw in the world frame, u v w p q r in the body frame",
            "provenance": provenance(),
        }

    def record(self) -> None:
        """Add the current state of the recorded worlds."""
        s, chosen = self.simulator, self.worlds
        shape = (len(chosen), len(s.vehicles))
        world = np.broadcast_to(chosen[:, None], shape)
        vehicle = np.broadcast_to(np.arange(shape[1]), shape)
        t = np.broadcast_to(s.numpy("steps")[chosen, None] * s.control_step, shape)
        n = self._channels
        command = s.command.thrust.numpy()[chosen][..., :n]
        parts = [world[..., None], vehicle[..., None], t[..., None]]
        parts += [s.numpy(name)[chosen] for name in STATE_COLUMNS]
        parts += [command, s.numpy("thrust")[chosen][..., :n]]
        rows = np.concatenate(parts, axis=-1, dtype=np.float64).reshape(-1, len(self.columns))
        self._rows.append(rows)
        self._waiting += len(rows)
        if self._waiting >= self.chunk:
            self.flush()

    def flush(self) -> None:
        """Write the buffered rows as a file."""
        if not self._rows:
            return
        import pyarrow
        import pyarrow.parquet

        rows = np.concatenate(self._rows)
        kinds = {"world": np.int32, "vehicle": np.int32, "t": np.float64}
        table = {c: rows[:, i].astype(kinds.get(c, np.float32)) for i, c in enumerate(self.columns)}
        with atomic_write(self.folder / f"part-{self._parts:06d}.parquet") as temporary:
            pyarrow.parquet.write_table(pyarrow.table(table), temporary)
        self._rows, self._waiting = [], 0
        self._parts += 1

    def __enter__(self) -> "StateRecorder":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.flush()


def read_run(folder: str | Path) -> "pandas.DataFrame":
    """Read a recorded run up to its last complete file.

    Args:
        folder: Folder of a `StateRecorder`.

    Returns:
        One row per world, vehicle and time; `.attrs` has the content of `_run.json`.

    Raises:
        SimulatorError: The folder contains no run.
    """
    import pandas

    folder = Path(folder)
    parts = sorted(folder.glob("part-*.parquet"))
    if not (folder / ABOUT).is_file() or not parts:
        raise SimulatorError(f"{folder} holds no recorded run: expected {ABOUT} and part-*.parquet in it")
    table = pandas.concat([pandas.read_parquet(part) for part in parts], ignore_index=True)
    table.attrs = read_json(folder / ABOUT, SimulatorError, such_as="vehicles")
    return table
