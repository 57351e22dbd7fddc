"""The truth file: what really happened in the pool, written as it happens, for scoring afterwards alone."""

from __future__ import annotations

import json
import logging
import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.yaml_file import json_value

__all__ = ["Truth", "TruthError", "TruthWriter", "read_truth"]

Array = NDArray[np.float64]

FORMAT = "finssim-truth-1"

FLUSH = 50
"""Records after which they are handed to the system: half a second at 100 a second is lost at most."""

log = logging.getLogger(__name__)


class TruthError(ValueError):
    """A file that is no truth file."""


class Truth(NamedTuple):
    """A truth file's records, by time."""

    header: dict[str, Any]
    """Vehicle, its digest, plant, severity, seed and thruster names."""
    time: Array
    """[s], (k,)"""
    position: Array
    """Body origin, world frame [m], (k, 3)."""
    quaternion: Array
    """Body to world, xyzw, (k, 4)."""
    nu: Array
    """Body frame [m/s, rad/s], (k, 6)."""
    shaft_rpm: Array
    """Canonical order [rpm], (k, n)."""
    thrust: Array
    """Delivered, canonical order [N], (k, n)."""
    voltage: Array
    """Of the battery [V], (k,)."""
    current: Array
    """Velocity of the water at the body, world frame [m/s], (k, 3)."""


class TruthWriter:
    """Appends records of fixed length after one line of JSON: a file that was cut off anywhere still opens.

    A full disk ends the file, with a warning, and not the pool: the vehicle must not stop for a log.
    """

    def __init__(self, path: str | Path, thrusters: Sequence[str], header: dict[str, Any]) -> None:
        """Start a file.

        Args:
            path: Where; an earlier file there is replaced.
            thrusters: Names in canonical order.
            header: What a reader should know besides.
        """
        self.path = Path(path)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._file: BinaryIO | None = self.path.open("wb")
        self._count = 0
        line = json.dumps({"format": FORMAT, "thrusters": list(thrusters), **header})
        self._file.write(line.encode() + b"\n")
        self._file.flush()

    def write(self, time: float, values: Iterable[NDArray[np.float32]]) -> None:
        """Append one record.

        Args:
            time: [s]
            values: Position, quaternion, nu, shaft rpm, thrust, voltage and current, in this order; float32.
        """
        if self._file is None:
            return
        try:
            self._file.write(struct.pack("<d", time) + b"".join([v.tobytes() for v in values]))
            self._count += 1
            if self._count % FLUSH == 0:
                self._file.flush()
        except OSError as error:
            log.warning("%s: the truth ends at %.2f s: %s", self.path, time, error.strerror or error)
            self._file = None

    def close(self) -> None:
        """Write out what is left."""
        if self._file is not None:
            self._file.close()
            self._file = None


def read_truth(path: str | Path) -> Truth:
    """The records of a truth file, up to its last whole one.

    Raises:
        TruthError: It is not there or no truth file.
    """
    try:
        data = Path(path).read_bytes()
        header = json_value(data[: data.index(b"\n")], TruthError, str(path))
        if header["format"] != FORMAT:
            raise KeyError
    except OSError as error:
        raise TruthError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (ValueError, KeyError, TypeError):
        raise TruthError(f"{path}: is no truth file: give one that 'finssim pool --truth' wrote") from None
    n = len(header["thrusters"])
    fields = {
        "position": 3,
        "quaternion": 4,
        "nu": 6,
        "shaft_rpm": n,
        "thrust": n,
        "voltage": 1,
        "current": 3,
    }
    layout = np.dtype([("time", "<f8"), *((name, "<f4", (size,)) for name, size in fields.items())])
    body = data[data.index(b"\n") + 1 :]
    table = np.frombuffer(body, dtype=layout, count=len(body) // layout.itemsize)
    columns = {name: table[name].astype(float) for name in fields}
    columns["voltage"] = columns["voltage"][:, 0]
    return Truth(header=header, time=table["time"].astype(float), **columns)
