"""Base class and field types of all sections of a vehicle file.

Arrays are read-only NumPy float64; every error message states the invalid value and the expected one.
"""

from __future__ import annotations

import difflib
import json
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, model_validator
from pydantic_core import PydanticCustomError

from finssim.core.page import notebook_html

UNIT_TOLERANCE = 1e-3
SYMMETRY_TOLERANCE = 1e-3
"""Relative asymmetry that is accepted as rounding of printed digits."""


def refuse_value(message: str) -> PydanticCustomError:
    """Return an error about one key; `message` continues after the key's name ("is -3, expected > 0: ...")."""
    return PydanticCustomError("value", "{message}", {"message": message})


def refuse_section(message: str) -> PydanticCustomError:
    """Return an error about a section; `message` is the complete sentence."""
    return PydanticCustomError("section", "{message}", {"message": message})


def did_you_mean(word: str, available: list[str]) -> str:
    """Return `, did you mean 'x'?` for the nearest known word, or `;` if none is similar."""
    close = difflib.get_close_matches(word, available, n=1)
    return f", did you mean '{close[0]}'?" if close else ";"


class Part(BaseModel):
    """Frozen section of a vehicle file: unknown keys are refused, and equality compares the numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True)

    @model_validator(mode="before")
    @classmethod
    def _known_keys_only(cls, data: Any) -> Any:
        if isinstance(data, dict):
            allowed = [name for name, field in cls.model_fields.items() if not field.exclude]
            for key in data:
                if key not in cls.model_fields:
                    raise refuse_section(
                        f"unknown key '{key}'{did_you_mean(str(key), allowed)} known keys: {', '.join(allowed)}"
                    )
        return data

    def _repr_html_(self) -> str:
        rows = [(name, f"{getattr(self, name)}") for name in type(self).model_fields]
        return notebook_html(type(self).__name__, ("", ""), rows)

    def values(self) -> dict[str, Any]:
        """Return the explicitly set values as a plain nested dict (lists for arrays), which can be validated
        again."""
        return self.model_dump(exclude_unset=True)

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and self.values() == other.values()

    def __hash__(self) -> int:
        return hash(json.dumps(self.values(), sort_keys=True, default=str))


def _array(value: Any, shape: tuple[int, ...], expected: str) -> NDArray[np.float64]:
    def is_number(x: Any) -> bool:
        return isinstance(x, (int, float, np.number)) and not isinstance(x, bool)

    def refuse_non_numbers(x: Any) -> None:
        if isinstance(x, (list, tuple)):
            for item in x:
                refuse_non_numbers(item)
        elif not is_number(x):
            raise refuse_value(f"contains {x!r}, expected {expected}")

    if not isinstance(value, (list, tuple, np.ndarray)):
        raise refuse_value(f"is {value!r}, expected {expected}")
    if not isinstance(value, np.ndarray):
        refuse_non_numbers(value)
    try:
        array = np.array(value, dtype=np.float64)
    except ValueError:
        raise refuse_value(f"has rows of unequal length, expected {expected}") from None
    if array.shape != shape:
        raise refuse_value(f"has shape {array.shape}, expected {expected}")
    if not np.all(np.isfinite(array)):
        raise refuse_value(
            f"contains {array[~np.isfinite(array)][0]}, expected finite numbers: give {expected}"
        )
    return array


def _frozen(array: NDArray[np.float64]) -> NDArray[np.float64]:
    array = array + 0.0  # -0.0 becomes 0.0, so that equal numbers have equal hashes
    array.flags.writeable = False
    return array


def _vector3(value: Any) -> NDArray[np.float64]:
    return _frozen(_array(value, (3,), "3 numbers [x, y, z]"))


def _vector6(value: Any) -> NDArray[np.float64]:
    return _frozen(_array(value, (6,), "6 numbers [surge, sway, heave, roll, pitch, yaw]"))


def _positive3(value: Any) -> NDArray[np.float64]:
    array = _vector3(value)
    if np.any(array <= 0.0):
        raise refuse_value(f"is {array.tolist()}, expected 3 numbers > 0")
    return array


def _unit(array: NDArray[np.float64], remedy: str) -> NDArray[np.float64]:
    length = float(np.linalg.norm(array))
    if abs(length - 1.0) > UNIT_TOLERANCE:
        raise refuse_value(f"has length {length:.7g}, expected 1: give a {remedy}")
    # A vector that is already normalised remains bitwise unchanged, so that its file keeps its hash.
    return _frozen(array if abs(length - 1.0) < 4.0 * np.finfo(np.float64).eps else array / length)


def _axis(value: Any) -> NDArray[np.float64]:
    return _unit(_vector3(value), "body-frame unit vector")


def _quaternion(value: Any) -> NDArray[np.float64]:
    return _unit(_array(value, (4,), "4 numbers [x, y, z, w]"), "unit quaternion [x, y, z, w]")


def _square(value: Any, n: int) -> NDArray[np.float64]:
    expected = f"{n} diagonal entries or {n} rows of {n}"
    if isinstance(value, (list, tuple, np.ndarray)) and len(value) == n and np.ndim(value[0]) == 0:
        return np.diag(_array(value, (n,), expected))
    return _array(value, (n, n), expected)


def _symmetric(value: Any, n: int) -> NDArray[np.float64]:
    matrix = _square(value, n)
    gap = np.abs(matrix - matrix.T)
    if gap.max() > SYMMETRY_TOLERANCE * np.abs(matrix).max():
        i, j = np.unravel_index(int(np.argmax(gap)), gap.shape)
        raise refuse_value(
            f"has {matrix[i, j]:.6g} at row {i + 1}, column {j + 1} but {matrix[j, i]:.6g} across the diagonal, "
            "expected a symmetric matrix"
        )
    return (matrix + matrix.T) / 2.0


def _inertia(value: Any) -> NDArray[np.float64]:
    matrix = _symmetric(value, 3)
    moments = np.linalg.eigvalsh(matrix)
    printed = ", ".join(f"{moment:.6g}" for moment in moments)
    if moments[0] <= 0.0:
        raise refuse_value(f"has principal moments {printed} kg m², expected all > 0")
    if moments[2] > (moments[0] + moments[1]) * (1.0 + 1e-9):
        raise refuse_value(
            f"has principal moments {printed} kg m², expected the largest to be at most the sum of the other two: "
            "no body of positive mass has these"
        )
    return _frozen(matrix)


_as_lists = PlainSerializer(lambda array: array.tolist())

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0)]
NonNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0)]
Negative = Annotated[float, Field(strict=True, allow_inf_nan=False, lt=0.0)]
NonPositive = Annotated[float, Field(strict=True, allow_inf_nan=False, le=0.0)]
Probability = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0, le=1.0)]
Vector3 = Annotated[NDArray[np.float64], BeforeValidator(_vector3), _as_lists]
Positive3 = Annotated[NDArray[np.float64], BeforeValidator(_positive3), _as_lists]
Vector6 = Annotated[NDArray[np.float64], BeforeValidator(_vector6), _as_lists]
Axis = Annotated[NDArray[np.float64], BeforeValidator(_axis), _as_lists]
Quaternion = Annotated[NDArray[np.float64], BeforeValidator(_quaternion), _as_lists]
Inertia = Annotated[NDArray[np.float64], BeforeValidator(_inertia), _as_lists]
Matrix6 = Annotated[NDArray[np.float64], BeforeValidator(lambda v: _frozen(_square(v, 6))), _as_lists]
Symmetric6 = Annotated[NDArray[np.float64], BeforeValidator(lambda v: _frozen(_symmetric(v, 6))), _as_lists]


def zeros(*shape: int) -> NDArray[np.float64]:
    """Return read-only zeros, for defaults that mean "none". They have the unit of the field."""
    return _frozen(np.zeros(shape))


def identity_quaternion() -> NDArray[np.float64]:
    """Return the read-only quaternion [0, 0, 0, 1]: mounted along the body axes."""
    return _frozen(np.array([0.0, 0.0, 0.0, 1.0]))


def sentence_of(detail: Any, label: str, missing: str = "add it, with its origin") -> str:
    """Return one pydantic error as a sentence `file: section: key value, expectation: remedy`.

    Args:
        detail: One item of `ValidationError.errors()`.
        label: Name of the file in messages.
        missing: Remedy for a missing key.
    """
    location = [str(item) for item in detail["loc"] if not str(item).startswith("<")]
    kind, value, context = detail["type"], detail.get("input"), detail.get("ctx", {})
    if kind == "section":
        return ": ".join(filter(None, [label, ".".join(location), context["message"]]))
    if not location:  # raised by a library for several sections
        return f"{label}: {str(detail['msg']).removeprefix('Value error, ')}"
    bounds = {
        "greater_than": ("gt", ">"),
        "greater_than_equal": ("ge", ">="),
        "less_than": ("lt", "<"),
        "less_than_equal": ("le", "<="),
    }
    if kind == "value":
        problem = context["message"]
    elif kind == "missing":
        problem = f"is missing: {missing}"
    elif kind in bounds:
        key, sign = bounds[kind]
        problem = f"is {value}, expected {sign} {context[key]:g}"
    elif kind == "finite_number":
        problem = f"is {value}, expected a finite number"
    elif kind in ("float_type", "int_type", "float_parsing", "int_parsing"):
        problem = f"is {value!r}, expected {'a whole' if kind.startswith('int') else 'a'} number"
    elif kind == "literal_error":
        problem = f"is {value!r}, expected {context['expected']}"
    elif kind in ("model_type", "model_attributes_type", "dict_type"):
        problem = f"is {value!r}, expected a section of keys"
    else:
        problem = f"is {value!r}: {detail['msg']}"
    return ": ".join(filter(None, [label, ".".join(location[:-1]), f"{location[-1]} {problem}"]))


class VehicleError(ValueError):
    """Invalid vehicle file, or invalid value for a vehicle; the message states location, error and remedy."""


class VehicleWarning(UserWarning):
    """Some numbers of a vehicle are guesses because another program's file lacks them."""
