"""Registration of terms, and generated functions that evaluate all terms and actuators of a simulation.

The functions of a term or of a kind of actuator are called by the names of their arguments:

    nu_r      velocity relative to the water at the reference point of the set, body frame [m/s, rad/s], vec6
    up        world's z axis in the body frame, vec3
    depth     depth of the body origin below the still surface [m]
    density   density of the water [kg/m³]
    thrust    thrust of each thruster [N], vec8
    value     value of an actuator: its angle, volume or position, float

and each parameter by its name: a float, vec3, vec6, vec8 or mat66. The engine scales a wrench by the submerged fraction
of the vehicle, and moves it from the reference point to the body origin.
"""

# mypy: disable-error-code="misc,no-any-return,no-untyped-call,no-untyped-def,untyped-decorator,valid-type"

import hashlib
import inspect
import linecache
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, get_type_hints

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from finssim.core.registry import TERMS
from finssim.physics.lanes import LaneRow, lane_function, zero_of
from finssim.physics.types import MAX_THRUSTERS, mat66, vec6, vec8, vec9
from finssim.vehicles.actuators import Actuator, ActuatorKind, InstalledActuator, installed
from finssim.vehicles.hydrodynamics import HydrodynamicSet, MeshSet
from finssim.vehicles.terms import Term
from finssim.vehicles.vehicle import Vehicle

STATE: dict[str, Any] = {"nu_r": vec6, "up": wp.vec3, "depth": float, "density": float, "thrust": vec8}
"""Arguments of a term's functions besides its parameters."""
VALUE: dict[str, Any] = {**STATE, "value": float}
"""Arguments of an actuator's functions besides its parameters."""
ROLES = {"wrench": vec6, "slope": vec6, "push": vec6, "yield": vec6, "shift": vec9, "carry": vec6}
"""Role -> type of its function's result: terms have `wrench` and `slope`, actuators `push`, `yield` (slope), `shift`
and `carry`."""
KINDS = {"float": float, "vec3": wp.vec3, "vec6": vec6, "vec8": vec8, "mat66": mat66}
"""Types of a parameter."""
PIECE = 8
"""Multiple to which a row of parameters is padded: the number of floats that a processor loads together."""


Item = Term | InstalledActuator
"""Terms and installed actuators: both have parameters in a row, and functions of them."""


class TermError(ValueError):
    """A term or a kind of actuator that cannot be used."""


def add_term(term: Term) -> Term:
    """Register a term: vehicle files may then use its key, and simulations of these vehicles evaluate it.

    Args:
        term: The term.

    Raises:
        RegistryError: Another term has that key.
        TermError: A function has an argument that is neither state nor parameter, or a unit is missing.
    """
    TERMS[term.name] = term
    return term


def check_registered(name: str, term: Any) -> None:
    """Refuse an object that is not a term, or a term that cannot be evaluated.

    Args:
        name: Key in a hydrodynamic set.
        term: The object that is registered under it.

    Raises:
        TermError: It is not a `Term`, has another name, has an argument that is neither state nor parameter, or lacks a
            unit.
    """
    if not isinstance(term, Term) or term.name != name:
        raise TermError(f"{name} is {term!r:.80}, expected a finssim.physics.terms.Term of that name")
    if term.name in {*HydrodynamicSet.model_fields, *MeshSet.model_fields} or not term.name.isidentifier():
        raise TermError(f"a term cannot be named '{term.name}': give it a key that no hydrodynamic set has")
    if set(term.units) != set(term.parameters):
        raise TermError(
            f"term '{term.name}' has units of {', '.join(term.units)}, expected of its parameters: "
            f"{', '.join(term.parameters)}"
        )
    _refuse_arguments(f"term '{term.name}'", _functions(term), STATE, term.parameters)


def check_actuator(name: str, kind: Any) -> None:
    """Refuse an object that is not a kind of actuator, or a kind that cannot be evaluated.

    Args:
        name: Value of `kind` in a vehicle file.
        kind: The object that is registered under it.

    Raises:
        TermError: It is not an `ActuatorKind`, has another name, or has an argument that is neither state nor
            parameter.
    """
    if not isinstance(kind, ActuatorKind) or kind.name != name or not name.isidentifier():
        raise TermError(
            f"{name} is {kind!r:.80}, expected a finssim.vehicles.actuators.ActuatorKind of that name"
        )
    if not issubclass(kind.schema, Actuator) or (kind.wrench is None and kind.shift is None):
        raise TermError(
            f"actuator '{name}': expected a schema derived from Actuator, and a wrench or a shift"
        )
    _refuse_arguments(f"actuator '{name}'", _functions(InstalledActuator(kind, 0)), VALUE, kind.units)


def _refuse_arguments(
    label: str, functions: Mapping[str, Any], state: Mapping[str, Any], parameters: Mapping[str, Any]
) -> None:
    """Refuse functions with an argument that is neither state nor parameter, and parameters that no function uses."""
    used = set()
    for role, function in functions.items():
        for name, kind in _arguments(function).items():
            expected = [state[name]] if name in state else list(KINDS.values())
            if (name not in state and name not in parameters) or kind not in expected:
                raise TermError(
                    f"{label}: {role} has the argument '{name}: {getattr(kind, '__name__', kind)}', expected of: "
                    f"{', '.join([*state, *parameters])}; parameters are {', '.join(KINDS)}"
                )
            used.add(name)
    unused = [name for name in parameters if name not in used]
    if unused:
        raise TermError(f"{label}: no function uses the parameter '{unused[0]}'")


@cache  # not called while a term is added: this starts Warp, which a vehicle file alone does not need
def _require_zero(item: Item, role: str) -> None:
    """Refuse a function that is not zero where its parameters are: it is also evaluated for vehicles without the
    item."""
    function = _functions(item)[role]
    examples = (_example(name, kind) for name, kind in _arguments(function).items())
    result = lane_function(function)(*examples).numbers
    if any(float(x) != 0.0 for x in result):
        raise TermError(
            f"'{item.name}': its {role} is not zero when all its parameters are: make it zero there"
        )


def _functions(item: Item) -> dict[str, Any]:
    if isinstance(item, InstalledActuator):
        kind = item.kind
        functions = {"push": kind.wrench, "yield": kind.slope, "shift": kind.shift, "carry": kind.carry}
    else:
        functions = {"wrench": item.wrench, "slope": item.slope}
    return {role: function for role, function in functions.items() if function is not None}


@cache
def _arguments(function: Any) -> dict[str, Any]:
    hints = get_type_hints(function.func)
    return {name: hints.get(name) for name in inspect.signature(function.func).parameters}


def _example(name: str, kind: Any) -> Any:
    """Return an example of an argument: nonzero for the state, zero for parameters."""
    numbers = {
        "nu_r": (0.7, -0.4, 0.5, 0.3, -0.6, 0.2), "up": (0.6, 0.0, 0.8), "thrust": (5.0,) * 8, "value": (0.3,),
        "depth": (3.0,), "density": (3.0,),
    }.get(name)  # fmt: skip
    value = zero_of(kind)
    if numbers is None:
        return value
    return value.like(numbers) if isinstance(value, LaneRow) else numbers[0]


@dataclass(frozen=True)
class Slot:
    """Position of one parameter in a row of the array with the parameters of all terms and actuators of a
    simulation."""

    term: Item
    name: str
    path: str
    kind: Any
    first: int

    @property
    def entry(self) -> str:
        """Name in a ranges file: the path of a term's parameter; kind and parameter of an actuator, such as
        `fin.lift_slope`."""
        return f"{self.term.kind.name}.{self.name}" if isinstance(self.term, InstalledActuator) else self.path

    @property
    def size(self) -> int:
        """Number of floats in the parameter."""
        return 1 if self.kind is float else int(np.prod(self.kind._shape_))


@cache
def layout(terms: tuple[Item, ...]) -> tuple[Slot, ...]:
    """Return the position of the parameters of some terms and actuators in a row."""
    slots, first = [], 0
    for term in terms:
        kinds = {name: kind for f in _functions(term).values() for name, kind in _arguments(f).items()}
        for name, path in term.parameters.items():
            slots.append(Slot(term, name, path, kinds[name], first))
            first += slots[-1].size
    return tuple(slots)


def row_length(terms: tuple[Item, ...]) -> int:
    """Return the number of floats in a row, a multiple of `PIECE`."""
    return PIECE * max(1, -(-sum(slot.size for slot in layout(terms)) // PIECE))


def parameter_row(terms: tuple[Item, ...], numbers: Mapping[str, Any]) -> NDArray[np.float64]:
    """Return the row of parameters by path, each in the unit of its term, zero for missing ones, (`row_length`,)."""
    row = np.zeros(row_length(terms))
    for slot in layout(terms):
        row[slot.first : slot.first + slot.size] = np.ravel(numbers.get(slot.path, 0.0))
    return row


@cache
def composed(terms: tuple[Item, ...], role: str) -> Any:
    """Return the sum of terms or actuators as a `wp.func` of (x, w, v, nu_r, up, depth, density, thrust).

    Args:
        terms: Terms and actuators, in the order of their rows.
        role: A key of `ROLES`.

    Returns:
        The function, whose x holds the parameters, (worlds, vehicles, `row_length`); None if no item has that role.
    """
    space: dict[str, Any] = {"wp": wp, "vec6": vec6, "vec8": vec8, "mat66": mat66, "vec3": wp.vec3}
    calls = []
    for item in terms:
        function = _functions(item).get(role)
        if function is None:
            continue
        _require_zero(item, role)
        places = {slot.name: _read(slot) for slot in layout(terms) if slot.term == item}
        if isinstance(item, InstalledActuator):
            places["value"] = f"thrust[{item.channel}]"
        arguments = [name if name in STATE else places[name] for name in _arguments(function)]
        space[f"t_{item.name}"] = function
        calls.append(f"t_{item.name}({', '.join(arguments)})")
    if not calls:
        return None
    head = (
        "x: wp.array3d(dtype=float), w: int, v: int, nu_r: vec6, up: wp.vec3, depth: float, density: float, "
        "thrust: vec8"
    )
    text = f"def added_{role}({head}):\n    return {' + '.join(calls)}\n"
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    position = f"<{role} of {', '.join(item.name for item in terms)}, {digest}>"
    lines = text.splitlines(keepends=True)
    linecache.cache[position] = (len(text), None, lines, position)  # Warp reads the source
    space["__name__"] = f"{__name__}_{digest}"
    exec(compile(text, position, "exec"), space)
    return wp.func(space[f"added_{role}"], module=wp.get_module(space["__name__"]))


def _read(slot: Slot) -> str:
    numbers = [f"x[w, v, {slot.first + i}]" for i in range(slot.size)]
    kind = next(name for name, kind in KINDS.items() if kind is slot.kind)
    return numbers[0] if kind == "float" else f"{kind}({', '.join(numbers)})"


@cache
def _sampler(terms: tuple[Item, ...], role: str) -> wp.Kernel:
    added_wrench = composed(terms, role)

    @wp.kernel(enable_backward=False, module="unique")
    def sample(
        x: wp.array3d(dtype=float),
        nu_r: wp.array(dtype=vec6),
        up: wp.array(dtype=wp.vec3),
        depth: wp.array(dtype=float),
        thrust: wp.array(dtype=vec8),
        density: float,
        tau: wp.array2d(dtype=vec6),
    ):
        i, k = wp.tid()
        tau[i, k] = added_wrench(x, k, 0, nu_r[i], up[i], depth[i], density, thrust[i])

    return sample


def term_wrenches(
    terms: tuple[Item, ...],
    rows: ArrayLike,
    nu_r: ArrayLike,
    up: ArrayLike,
    depth: ArrayLike,
    density: float,
    channels: ArrayLike = (0.0,) * MAX_THRUSTERS,
) -> NDArray[np.float64]:
    """Return the wrench of terms, or of actuators, in given motions, from the functions that simulations use.

    Args:
        terms: Only terms, or only actuators.
        rows: Their parameters in the units of the terms, in several versions, (k, `row_length`).
        nu_r: Velocity relative to the water at the reference point of terms, or at the body origin for actuators, body
            frame [m/s, rad/s], (n, 6).
        up: World z in the body frame, unit vectors, (n, 3).
        depth: Depth of the body origin [m], (n,) or one number.
        density: Density of the water [kg/m³].
        channels: Value of each channel [N, rad, m³ or m], (n, 8), or (8,) for all.

    Returns:
        Wrench about the same point, body frame [N, N m], (n, k, 6).
    """
    n, k = len(np.asarray(nu_r)), len(np.asarray(rows))
    x = np.ascontiguousarray(np.asarray(rows, np.float32)[:, None])
    shapes = ((nu_r, (n, 6)), (up, (n, 3)), (depth, (n,)), (channels, (n, MAX_THRUSTERS)))
    single = [np.ascontiguousarray(np.broadcast_to(np.asarray(a, np.float32), shape)) for a, shape in shapes]
    tau = np.zeros((n, k, 6), np.float32)
    kinds = (float, vec6, wp.vec3, float, vec8, vec6)
    arrays: list[Any] = [
        wp.array(a, dtype=kind, device="cpu", copy=False)
        for a, kind in zip((x, *single, tau), kinds, strict=True)
    ]
    role = "push" if isinstance(terms[0], InstalledActuator) else "wrench"
    wp.launch(
        _sampler(terms, role), dim=(n, k), inputs=[*arrays[:5], float(density), arrays[5]], device="cpu"
    )
    return tau.astype(float)


def actuator_wrenches(
    vehicle: Vehicle, nu_r: ArrayLike, up: ArrayLike, depth: ArrayLike, channels: ArrayLike
) -> NDArray[np.float64]:
    """Return the wrench of a submerged vehicle's actuators, without the static thrust of its propellers.

    It contains the wrench of fins, buoyancy engines and gimbals, and the effect of inflow on propellers; it does not
    contain the weight of moved masses.

    Args:
        vehicle: The vehicle.
        nu_r: Velocity of the body origin relative to the water, body frame [m/s, rad/s], (n, 6).
        up: World z in the body frame, unit vectors, (n, 3).
        depth: Depth of the body origin [m], (n,) or one number.
        channels: Value of each channel, in the order of `Vehicle.channel_names` [N, rad, m³ or m], (n, c).

    Returns:
        Wrench about the body origin, body frame [N, N m], (n, 6).
    """
    found = {item: part for item, part in installed(vehicle).items() if item.kind.wrench is not None}
    values = np.asarray(channels, float)
    if not found:
        return np.zeros((len(values), 6))
    items = tuple(sorted(found, key=lambda item: item.name))
    numbers = {path: x for item in items for path, x in item.numbers(found[item], vehicle).items()}
    padded = np.pad(values, ((0, 0), (0, MAX_THRUSTERS - values.shape[1])))
    row = parameter_row(items, numbers)
    return term_wrenches(items, [row], nu_r, up, depth, vehicle.water.density, padded)[:, 0]
