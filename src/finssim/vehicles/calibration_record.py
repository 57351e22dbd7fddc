"""What a vehicle file remembers of a calibration: which trials its numbers were fitted on, and how."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from finssim.vehicles.part import Part


class CalibrationRecord(Part):
    """One entry of `calibrations` in a vehicle file; no clock time is in it, so that equal fits write equal files."""

    kind: Literal["thruster", "motor", "hydrodynamics", "mounts"]
    """What was calibrated."""
    method: str
    """Estimator, such as `regression` or `simulation`."""
    trials: dict[str, str]
    """Name of each trial or table -> SHA-256 of its numbers."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Options of the method and its seed, as plain values."""
    start: str = ""
    """`sha256` of the vehicle that it started from."""
    finssim: str = ""
    """Version of FinsSim."""
    revision: str | None = None
    """Git commit of FinsSim, where it ran from a checkout."""
    interrupted: bool = False
    """Whether it was stopped before it converged."""

    def sentence(self) -> str:
        """`hydrodynamics by regression on 24 trials`, for lists and notes."""
        count = len(self.trials)
        noun = {"thruster": "table", "mounts": "recording"}.get(self.kind, "trial")
        words = f"{self.kind} by {self.method} on {count} {noun}{'' if count == 1 else 's'}"
        return f"{words} (interrupted)" if self.interrupted else words
