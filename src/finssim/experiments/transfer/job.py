"""One trial in the virtual pool, as plain data: equal jobs give equal results, and a result is kept under its key."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from finssim.control.controllers import CONTROLLERS
from finssim.control.policy_description import DESCRIPTION_FILE, NETWORK_FILE
from finssim.experiments.setpoints import T1_SETPOINTS
from finssim.vehicles import load_vehicle

__all__ = ["Job"]


@dataclass(frozen=True, kw_only=True)
class Job:
    """A controller, what it knows, where it is put, and what it is to do."""

    row: str
    """Of the table."""
    controller: str
    """Policy directory, or the name of a PID."""
    target: str
    """Setpoint of T1 (P01 ...), or trajectory of T2."""
    vehicle: str = "finsrov"
    """Name or file of the vehicle as controller and localization know it."""
    pool_vehicle: str = "finsrov"
    """Name or file of the vehicle around which the pool's own is drawn."""
    plant: int = 1
    """Seed of the pool: vehicle, camera and water."""
    severity: str = "realistic"
    """nominal, realistic or hard."""
    seed: int = 1
    """Of the noise of this trial; trials of different targets never share noise."""
    camera: str = "pictures"
    """pictures (drawn and searched for tags) or corners (of the tags, with noise)."""
    fusion: bool = True
    """Whether the controller sees the fused state, or what each sensor said last."""
    trim: bool = False
    """Whether an integral stands in front of the policy."""
    position_noise: float = 0.0
    """Added to what the controller sees, per axis [m]."""
    yaw_noise: float = 0.0
    """Added to what the controller sees [rad]."""
    duration: float = 60.0
    """[s]; of T2 the trajectory's own."""

    @property
    def task(self) -> str:
        """t1 or t2."""
        return "t1" if self.target in T1_SETPOINTS else "t2"

    @property
    def pair(self) -> tuple[int, int, str]:
        """What trials of different rows have in common when they are compared: plant, seed and target."""
        return self.plant, self.seed, self.target

    def described(self) -> dict[str, Any]:
        """Everything that decides the result, with the contents of files in place of their names."""
        told = asdict(self)
        told.pop("row")
        if self.controller not in CONTROLLERS:
            folder = Path(self.controller)
            told["controller"] = {
                name: hashlib.sha256((folder / name).read_bytes()).hexdigest()
                for name in (DESCRIPTION_FILE, NETWORK_FILE)
            }
        for name in ("vehicle", "pool_vehicle"):
            told[name] = load_vehicle(getattr(self, name)).sha256
        return told

    def key(self) -> str:
        """File name of its result: readable first, then a digest of everything that decides it."""
        digest = hashlib.sha256(json.dumps(self.described(), sort_keys=True).encode()).hexdigest()[:10]
        return f"{self.row}_{self.target}_plant{self.plant}_seed{self.seed}_{digest}"
