"""Read the release of a real BlueROV2, thrusters off, from motion capture and IMU tables.

    python examples/passive_trials.py FOLDER [--picture FILE.png]

FOLDER holds NAME_mocap.csv and NAME_imu.csv as in tests/data/hinsdale. The picture needs the extra "logs".
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import finssim as fs
from finssim.identification import Curve
from finssim.trials import Header, Trial

MOCAP = ("", "x", "y", "z", "qx", "qy", "qz", "qw")
IMU = ("", "", "", "", "", "p", "q", "r")

HINSDALE = Path(__file__).parents[1] / "tests" / "data" / "hinsdale"
"""Recordings of a BlueROV2 that was released by hand."""


def read(folder: Path, name: str) -> Trial:
    """Return a trial from a pair of tables, on the union of their times."""
    tables = {
        part: np.genfromtxt(folder / f"{name}_{part}.csv", delimiter=",", skip_header=1)
        for part in ("mocap", "imu")
    }
    t = np.unique(np.concatenate([table[:, 0] for table in tables.values()]))
    channels = {}
    for table, columns in ((tables["mocap"], MOCAP), (tables["imu"], IMU)):
        for j, column in enumerate(columns):
            if column:
                channels[column] = np.full(len(t), np.nan)
                channels[column][np.searchsorted(t, table[:, 0])] = table[:, j]
    return Trial(name=name, t=t, channels=channels, header=Header(passive=True))


def draw(curves: list[Curve], path: Path) -> None:
    """Draw the measured and the fitted motion of every decay."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 2.4 * len(curves)), layout="constrained")
    for axes, curve in zip(np.atleast_1d(figure.subplots(len(curves), 1)), curves, strict=True):
        axes.plot(curve.x, curve.measured, ".", color="0.6", markersize=3, label="measured")
        axes.plot(curve.x, curve.fitted, color="C0", label="simulated")
        axes.set_title(curve.title, fontsize=10)
        axes.set_ylabel(curve.y_label)
        axes.grid(alpha=0.3)
        axes.legend(loc="upper right", fontsize=8)
    axes.set_xlabel("time [s]")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Print what each trial identifies; the other numbers are those of the BlueROV2 Heavy file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=HINSDALE)
    parser.add_argument("--picture", type=Path)
    given = parser.parse_args()
    names = sorted(path.name.removesuffix("_mocap.csv") for path in given.folder.glob("*_mocap.csv"))
    curves: list[Curve] = []
    for name in names:
        print(name)
        try:
            fit = fs.identify("bluerov2_heavy", [read(given.folder, name)], axes=["roll", "pitch"])
        except ValueError as error:
            print(f"  {error}")
            continue
        for e in fit.estimates.values():
            ends = f"[{e.ci95[0]:.4g}, {e.ci95[1]:.4g}]"
            print(f"  {e.name:24s} {e.estimate:9.4g} {ends} {e.unit:8s} {e.note}")
        for finding in fit.findings:
            print(f"  {finding}")
        for curve in fit.curves:
            if fit.quality[curve.title.partition(":")[0]]["r2"] > 0.5:
                curves.append(replace(curve, title=f"{name}, {curve.title}"))
    if given.picture:
        draw(curves, given.picture)


if __name__ == "__main__":
    main()
