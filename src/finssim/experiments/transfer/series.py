"""What a trial leaves for figures: truth and estimate at 10 Hz, one compressed file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finssim.files import atomic_write

__all__ = ["read_series", "write_series"]

Array = NDArray[np.float64]


def write_series(path: Path, series: dict[str, Array]) -> None:
    """Write PATH.npz."""
    with atomic_write(path.with_name(f"{path.name}.npz")) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **series)


def read_series(path: Path) -> dict[str, Array]:
    """Read PATH.npz: `t` [s], `position` [m], `yaw` [rad] of the truth, `estimate` and `estimate_yaw`, and more."""
    with np.load(path.with_name(f"{path.name}.npz")) as file:
        return {name: file[name] for name in file.files}
