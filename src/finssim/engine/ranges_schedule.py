"""How ranges grow while a policy learns: with the training's progress, with success, or each end by itself."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from finssim.engine.distributions import Part

__all__ = ["Automatic", "Curriculum", "Success"]


class Success(Part):
    """When an episode counts as a success: exactly one of the two."""

    held: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)
    """The task's tolerance was kept for so long when the episode ended [s]."""
    episode_return: float | None = Field(default=None, allow_inf_nan=False)
    """The return was at least this."""

    @model_validator(mode="after")
    def _one(self) -> Success:
        if (self.held is None) == (self.episode_return is None):
            raise ValueError("expected either held [s] or episode_return")
        return self


class Judged(Part):
    """Steps that follow from the share of successes among some episodes."""

    success: Success | None = None
    """The task's own hold time if None."""
    episodes: int = Field(default=400, ge=1)
    """After so many the share of successes is looked at."""
    widen_at: float = Field(default=0.8, ge=0.0, le=1.0)
    """A share of at least this widens."""
    narrow_at: float = Field(default=0.4, ge=0.0, le=1.0)
    """A share below this narrows."""
    step: float = Field(default=0.1, gt=0.0, le=1.0)
    """By this part of the full width."""

    @model_validator(mode="after")
    def _apart(self) -> Judged:
        if self.narrow_at > self.widen_at:
            raise ValueError(f"narrow_at is {self.narrow_at}, expected at most widen_at, {self.widen_at}")
        return self


class Curriculum(Judged):
    """All ranges grow together from a part of their width to the whole."""

    by: Literal["progress", "steps", "success"] = "progress"
    """The share of the training done, the environment's own control steps, or the share of successes."""
    start: float = Field(default=0.0, ge=0.0, le=1.0)
    """Part of the width at the start; 0 is the vehicle of the file."""
    over: tuple[float, float] = (0.0, 1.0)
    """From where to where they grow: shares of the training, or control steps of all worlds together."""

    @model_validator(mode="after")
    def _forwards(self) -> Curriculum:
        low, high = self.over
        if not 0.0 <= low < high < float("inf") or (self.by == "progress" and high > 1.0):
            most = "1" if self.by == "progress" else "any number of steps"
            raise ValueError(f"over is {[low, high]}, expected [low, high] with 0 <= low < high up to {most}")
        return self

    def width(self, done: float) -> float:
        """Part of the full width when so much is done, in [0, 1]."""
        low, high = self.over
        part = min(max((done - low) / (high - low), 0.0), 1.0)
        return self.start + part * (1.0 - self.start)


class Automatic(Judged):
    """Automatic domain randomisation (OpenAI et al. 2019): each end of each range moves by itself.

    Some episodes set one parameter to one end of its present range. Where enough of them succeed that end moves
    outwards, where too few do it moves inwards.
    """

    start: float = Field(default=0.0, ge=0.0, le=1.0)
    """Part of the width at the start."""
    probability: float = Field(default=0.5, gt=0.0, le=1.0)
    """Of an episode that tries an end."""
    episodes: int = Field(default=50, ge=1)
    """At one end, after which it is judged."""
