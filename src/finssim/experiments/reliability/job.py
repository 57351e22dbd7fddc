"""One trial of a fault as plain data: equal jobs give equal results, and a result is kept under its key."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import asdict, dataclass
from typing import Any

from finssim.vehicles import load_vehicle

__all__ = ["FaultJob"]


@dataclass(frozen=True, kw_only=True)
class FaultJob:
    """A fault, in what motion, in which pool."""

    scenario: str
    """Of the catalogue."""
    variant: str = ""
    motion: str = "station"
    """What the vehicle does: station or moving."""
    plant: int = 1
    """Seed of the pool: vehicle, camera and water."""
    severity: str = "realistic"
    """nominal, realistic or hard."""
    seed: int = 1
    """Of the noise."""
    vehicle: str = "finsrov"
    """Name or file."""

    @property
    def row(self) -> str:
        """Of the table."""
        return self.scenario

    @property
    def target(self) -> str:
        """Variant and motion."""
        return f"{self.variant} {self.motion}".strip()

    def described(self) -> dict[str, Any]:
        """Everything that decides the result."""
        return {**asdict(self), "vehicle": load_vehicle(self.vehicle).sha256}

    def key(self) -> str:
        """File name of its result: readable first, then a digest of everything that decides it."""
        digest = hashlib.sha256(json.dumps(self.described(), sort_keys=True).encode()).hexdigest()[:10]
        name = re.sub(r"[^A-Za-z0-9.+-]+", "_", f"{self.scenario}_{self.target}")
        return f"{name}_plant{self.plant}_seed{self.seed}_{digest}"
