"""Probability distributions that a ranges file gives for randomised parameters."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, TypeAlias

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

KINDS = ("uniform", "log_uniform", "normal", "choice")

MAX_CHOICES = 32

CUT = 4.0
"""Number of standard deviations at which a normal distribution is truncated, unless `within` is given."""

EXAMPLE = "{normal: [1.0, 0.1]}"

Pair: TypeAlias = tuple[float, float]


class RangesPart(BaseModel):
    """Base class of the sections of a ranges file: frozen, without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def unknown(key: object, names_in_use: Iterable[str]) -> str:
    """Return the message about a key that does not exist, with the most similar valid key."""
    names = list(names_in_use)
    close = difflib.get_close_matches(str(key), names, n=1)
    return f"unknown entry '{key}'; " + (
        f"did you mean '{close[0]}'?" if close else f"available: {', '.join(names)}"
    )


def sentence(error: ValidationError, model: type[BaseModel]) -> str:
    """Return the first error of a section of a ranges file as one message: location, problem and expectation."""
    first = error.errors()[0]
    location = [
        str(x) for x in first["loc"] if not any(c in str(x) for c in "[(")
    ]  # without pydantic's names of types
    text = first["msg"].removeprefix("Value error, ")
    if first["type"] == "extra_forbidden":
        allowed = _keys(model, first["loc"][:-1])
        return ": ".join(filter(None, [".".join(location[:-1]), unknown(location[-1], allowed)]))
    if first["type"] == "literal_error" and location[-1:] == [str(first["input"])]:
        allowed = [
            word.strip("'") for word in str(first["ctx"]["expected"]).replace(" or ", ", ").split(", ")
        ]
        text = unknown(location[-1], allowed)
    return ": ".join(filter(None, [".".join(location), text]))


def _keys(model: type[BaseModel], path: tuple[Any, ...]) -> list[str]:
    """Return the keys of the model at the end of a path, also through optional sections."""
    for step in path:
        field = model.model_fields.get(str(step))
        candidates = [] if field is None else [field.annotation, *getattr(field.annotation, "__args__", ())]
        inner = [c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel)]
        model = inner[0] if inner else model
    return list(model.model_fields)


def _is_number(x: object) -> bool:
    return isinstance(x, int | float) and not isinstance(x, bool)


class Distribution(RangesPart):
    """One of four distributions, sampled with a given probability; otherwise the vehicle file's value is
    used."""

    uniform: Pair | None = None
    """[low, high]"""
    log_uniform: Pair | None = None
    """[low, high], both above 0: equal weight to equal ratios."""
    normal: Pair | None = None
    """[mean, standard deviation] of the normal distribution before truncation."""
    within: Pair | None = None
    """[low, high] at which a normal distribution is truncated; 4 standard deviations from the mean if None."""
    choice: tuple[float, ...] | None = Field(default=None, min_length=1, max_length=MAX_CHOICES)
    """Discrete values, of which one is chosen, in the unit of the entry."""
    weights: tuple[float, ...] | None = None
    """Relative weights of the choices, normalised to probabilities; equal if None."""
    probability: float = Field(default=1.0, ge=0.0, le=1.0)

    @model_validator(mode="after")
    def _possible(self) -> Distribution:
        kinds = [kind for kind in KINDS if getattr(self, kind) is not None]
        if len(kinds) != 1:
            raise ValueError(
                f"gives {' and '.join(kinds) or 'no distribution'}, expected one of {', '.join(KINDS)}"
            )
        numbers = (*getattr(self, kinds[0]), *(self.within or ()), *(self.weights or ()))
        if not all(math.isfinite(x) for x in numbers):
            raise ValueError("expected finite numbers")
        if (self.within is not None) > (self.normal is not None):
            raise ValueError("within belongs to a normal distribution: omit it")
        if self.weights is not None and (self.choice is None or len(self.weights) != len(self.choice)):
            raise ValueError("weights belong to choices: give one for each")
        if self.weights is not None and (min(self.weights) < 0.0 or sum(self.weights) <= 0.0):
            raise ValueError(f"weights are {list(self.weights)}, expected 0 or more, and not all 0")
        self._check_ends(kinds[0])
        return self

    def _check_ends(self, kind: str) -> None:
        if self.normal is not None and self.normal[1] < 0.0:
            raise ValueError(f"normal: standard deviation is {self.normal[1]}, expected 0 or more")
        low, high = self.bounds()
        if low > high:
            raise ValueError(f"{kind}: is {[low, high]}, expected [low, high] with low <= high")
        if kind == "log_uniform" and low <= 0.0:
            raise ValueError(f"log_uniform: is {[low, high]}, expected numbers above 0")
        if self.normal is not None and not low <= self.normal[0] <= high:
            raise ValueError(f"normal: mean {self.normal[0]} lies outside of within {[low, high]}")

    @property
    def kind(self) -> str:
        """Kind of the distribution, one of `KINDS`."""
        return next(kind for kind in KINDS if getattr(self, kind) is not None)

    def bounds(self) -> Pair:
        """Return the lowest and highest value of the distribution, without the value used when it is not
        sampled."""
        if self.choice is not None:
            return min(self.choice), max(self.choice)
        if self.normal is not None:
            mean, std = self.normal
            return self.within or (mean - CUT * std, mean + CUT * std)
        return self.uniform or self.log_uniform  # type: ignore[return-value]

    def cumulative(self) -> list[float]:
        """Return the cumulative probabilities of the choices; empty without choices."""
        weights = self.weights or (1.0,) * len(self.choice or ())
        return [sum(weights[: i + 1]) / sum(weights) for i in range(len(weights))]


Drawn: TypeAlias = Pair | Distribution
"""Two bounds of a uniform distribution, or a distribution."""


def bounds_of(drawn: Drawn) -> Pair:
    """Return the lowest and highest value."""
    return drawn.bounds() if isinstance(drawn, Distribution) else drawn


def distribution_of(drawn: Drawn) -> Distribution:
    """Return the distribution; for two numbers, the uniform distribution between them."""
    return drawn if isinstance(drawn, Distribution) else Distribution(uniform=drawn)


def _read(value: Any) -> Any:
    """Return a mapping as a distribution, and two numbers unchanged."""
    if isinstance(value, Mapping):
        return checked(Distribution, value)
    if isinstance(value, Distribution):
        return value
    if not (isinstance(value, list | tuple) and len(value) == 2 and all(map(_is_number, value))):
        raise ValueError(
            f"is {value!r}, expected two numbers [low, high] or a distribution such as {EXAMPLE}"
        )
    return value


def checked(model: type[BaseModel], value: Mapping[str, Any]) -> Any:
    """Build a section from a mapping; raise a ValueError with one sentence if it is invalid."""
    try:
        return model.model_validate(value)
    except ValidationError as error:
        raise ValueError(sentence(error, model)) from None


def _ordered(drawn: Drawn) -> Drawn:
    low, high = bounds_of(drawn)
    if not (math.isfinite(low) and math.isfinite(high)) or low > high:
        raise ValueError(f"is {[low, high]}, expected two finite numbers [low, high] with low <= high")
    return drawn


def _require(holds: Callable[[float, float], bool], expected: str) -> Callable[[Drawn], Drawn]:
    def check(drawn: Drawn) -> Drawn:
        low, high = bounds_of(drawn)
        if not holds(low, high):
            reach = (
                f"is {[low, high]}" if isinstance(drawn, tuple) else f"reaches from {low:.4g} to {high:.4g}"
            )
            raise ValueError(f"{reach}, expected {expected}")
        return drawn

    return check


Interval = Annotated[Pair | Distribution, BeforeValidator(_read), AfterValidator(_ordered)]
Scale = Annotated[Interval, AfterValidator(_require(lambda low, high: low >= 0.0, "numbers of 0 or more"))]
Above0 = Annotated[Interval, AfterValidator(_require(lambda low, high: low > 0.0, "numbers above 0"))]
Share = Annotated[
    Interval,
    AfterValidator(_require(lambda low, high: low >= 0.0 and high < 1.0, "numbers from 0 to below 1")),
]
