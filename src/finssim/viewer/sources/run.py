"""Frames of a run that the engine's recorder wrote."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from finssim.engine.recorder import ABOUT, read_run
from finssim.vehicles import catalogue_vehicle, load_vehicle
from finssim.viewer.frame import Curve, Frame, Stage, ViewError
from finssim.viewer.sources.series import PoseSeries, Series
from finssim.viewer.stages import box_of


class RunSource:
    """One vehicle of one world of a recorded run."""

    def __init__(self, folder: Path | str, *, world: int | None = None, vehicle: str | None = None) -> None:
        """
        Args:
            folder: Of the run.
            world: Which; the first that was recorded if None.
            vehicle: Name or file; as the run names it if None.

        Raises:
            SimulatorError: No run.
            ViewError: It has not that world.
            VehicleError: Its vehicle is not in the catalogue.
        """
        table = read_run(folder)
        worlds = sorted(table["world"].unique().tolist())
        chosen = worlds[0] if world is None else world
        if chosen not in worlds:
            raise ViewError(
                f"{folder}: world {chosen} was not recorded; it has {', '.join(map(str, worlds))}"
            )
        named = table.attrs["vehicles"][0]["name"]
        ours = load_vehicle(vehicle) if vehicle else catalogue_vehicle(named, f"{folder}: {ABOUT}")
        rows = table[(table["world"] == chosen) & (table["vehicle"] == 0)]
        time = rows["t"].to_numpy(float)
        self._poses = PoseSeries(
            time - time[0],
            rows[["x", "y", "z"]].to_numpy(float),
            rows[["qx", "qy", "qz", "qw"]].to_numpy(float),
        )
        names = [f"thrust_{name}" for name in ours.thruster_names]
        missing = sorted(set(names) - set(rows.columns))
        if missing:
            raise ViewError(
                f"{folder}: has no {missing[0]}: it was not recorded of {ours.name}; give --vehicle"
            )
        self._thrust = Series(time - time[0], rows[names].to_numpy(float))
        speed = np.linalg.norm(rows[["u", "v", "w"]].to_numpy(float), axis=1)
        self._curves = [Curve("speed [m/s]", "through the water", time - time[0], speed)]
        self.duration = float(time[-1] - time[0])
        lower, upper = box_of(ours, None, self._poses.position)
        title = f"{Path(folder).name}: {ours.name}, world {chosen}"
        self.stage = Stage(vehicle=ours, title=title, lower=lower, upper=upper, walls=False)

    def frame(self, time: float) -> Frame:
        """The moment at a time since the run's beginning [s]."""
        force = self._thrust.at(time)
        status = {} if force is None else {"thrust [N]": " ".join(f"{f:.1f}" for f in force)}
        return Frame(
            time=time,
            truth=self._poses.at(time),
            force=np.zeros(0) if force is None else force,
            trail=self._poses.trail(time),
            status=status,
        )

    def curves(self) -> Sequence[Curve]:
        """Its speed."""
        return self._curves

    def close(self) -> None:
        """Nothing is open."""
