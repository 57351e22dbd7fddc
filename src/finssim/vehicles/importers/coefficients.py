"""Importer of coefficients of Fossen's equations from a Python or MATLAB file, such as the vehicles of MSS.

Equations of these programs (Fossen 2021), body axes x forward, y right, z down:

    (M_RB + M_A) nu_dot + C_RB nu + C_A nu + D nu + D_n |nu| nu + g(eta) = tau

The importer reads conventional names: `m`, `W`, `B`, `Ix`, `r_bg`, `MRB`, `MA`, `Xudot`, `Xu`, `Xuu` and their
variants. For a torpedo of PythonVehicleSimulator it also reads the hull drag, which functions of its library compute.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.core.importer import Importer
from finssim.vehicles.importers import torpedo
from finssim.vehicles.importers.assignments import Assignments, read_assignments
from finssim.vehicles.importers.draft import SHARE, Draft, put_controlled_axes, put_envelope
from finssim.vehicles.importers.rigid import flu_of_frd, plain
from finssim.vehicles.part import VehicleError
from finssim.vehicles.vehicle import AXES, skew

__all__ = ["COEFFICIENTS", "draft_of", "one_sign", "read_coefficients", "symbol_of"]

Array = NDArray[np.float64]

FORCES, VELOCITIES = "XYZKMN", "uvwpqr"
NAMES = {
    "mass": "m mass", "weight": "W weight", "buoyancy": "B buoyancy",
    "volume": "V vol volume nabla V_disp displaced_volume",
    "density": "rho density rho_w rho_FW water_density", "gravity": "g g_mu gravity",
    "nMax": "nMax n_max", "length": "L length L_auv",
    "width": "diam D_auv width", "height": "diam D_auv height",
    "center_of_gravity": "r_bg r_bG r_g r_G rg r_cg g_center COG CG",
    "center_of_buoyancy": "r_bb r_bB r_b r_B rb r_cb b_center COB CB",
    "inertia": "I_g Ig Ig_CG I_c I_0 Imat I_b MOI inertia I", "rigid": "MRB M_RB Mrb", "added": "MA M_A Ma added_mass",
    "linear": "D Dl D_l D_lin D_L linear_damping linear_drag",
    "quadratic": "Dn D_n Dq D_q D_nl D_NL D_quad quadratic_damping quadratic_drag",
    "thrust": "T TAM T_alloc T_matrix B B_matrix Thrust_alloc Thurst_alloc thrust_matrix thruster_matrix",
}  # fmt: skip
"""Quantity -> its names. Matrices may be 6 diagonal entries, an inertia 3; centres may also be xg, x_g or xG."""


def one_sign(matrix: Array, what: str, where: str) -> Array:
    """Return added mass or damping with a non-negative diagonal, (6, 6), in the unit of the coefficients.

    Args:
        matrix: Matrix of coefficients such as X_udot [kg], X_u [N s/m] or X_u|u| [N s²/m²], which are
            negative, or of their negated values, (6, 6).
        what: Name of the matrix in messages.
        where: Name of the file in messages.

    Raises:
        VehicleError: Its diagonal contains both signs.
    """
    diagonal = np.diag(matrix)
    if diagonal.min() < 0.0 < diagonal.max():
        parts = ", ".join(f"{f}{v} {x:g}" for f, v, x in zip(FORCES, VELOCITIES, diagonal, strict=True) if x)
        raise VehicleError(
            f"{where}: the {what} has both signs ({parts}), expected one: all negative, as X_u, or all positive"
        )
    return np.asarray(-matrix if diagonal.min() < 0.0 else matrix) + 0.0


def symbol_of(name: str) -> tuple[str, int, int] | None:
    """Return kind (`added`, `linear`, `quadratic`, `product`), row and column of a coefficient; None for other names.

    Args:
        name: Such as Xudot, X_u_dot, Xdu; Xu, X_u, Xu_l; Xuu, Xu_abs_u, Xabs_u, Xu_q; Yuv.
    """
    derived = re.fullmatch(r"([XYZKMN])_?(?:([uvwpqr])_?d(?:ot)?|d(?:ot)?_?([uvwpqr]))", name)
    if derived is not None:
        return "added", FORCES.index(derived[1]), VELOCITIES.index(derived[2] or derived[3])
    for kind, text in ((name.rpartition("_")[2], name.rpartition("_")[0]), ("", name)):
        match = re.fullmatch(r"([XYZKMN])_?((?:[uvwpqr]|abs|_|\|)+)", text)
        letters = "" if match is None else re.sub(r"abs|_|\|", "", match[2])
        if match is not None and kind in ("", "l", "lin", "q", "quad", "nl") and 1 <= len(letters) <= 2:
            square = len(letters) == 2 or letters != match[2].strip("_") or kind in ("q", "quad", "nl")
            found = "product" if len(set(letters)) == 2 else "quadratic" if square else "linear"
            return found, FORCES.index(match[1]), VELOCITIES.index(letters[0])
    return None


def _last(name: str) -> str:
    return name.rpartition(".")[2]


class _Names:
    """Numbers of a file by quantity; used names are recorded."""

    def __init__(self, found: Assignments, label: str) -> None:
        self.found, self.label = found, label
        self.used: set[str] = set()

    def first(self, quantity: str, sizes: tuple[int, ...] = (1,)) -> Any:
        """Return the value of a quantity that has one of the sizes, a number if the size is 1; None if there is none.

        Raises:
            VehicleError: Several of its names have different values.
        """
        names = NAMES.get(quantity, quantity).split()
        fits = {n: np.asarray(x, float) for n, x in self.found.of(*names).items() if np.size(x) in sizes}
        self.used |= fits.keys()
        for name, other in list(fits.items())[1:]:
            one = next(iter(fits))
            if fits[one].size != other.size or not np.allclose(fits[one].ravel(), other.ravel(), rtol=1e-6):
                raise VehicleError(
                    f"{self.label}: {one} is {np.round(fits[one], 6).tolist()} and {name} is "
                    f"{np.round(other, 6).tolist()}, which should be the same: keep one of them, in SI units and with "
                    "its dimension (no prime scaling)"
                )
        value = next(iter(fits.values()), None)
        return value if value is None or sizes != (1,) else float(value.ravel()[0])

    def square(self, quantity: str, side: int) -> Array | None:
        """Return a matrix, (side, side), from its rows or its diagonal."""
        value = self.first(quantity, (side, side * side))
        if value is None:
            return None
        return np.diag(value.ravel()) if value.size == side else value.reshape(side, side)

    def point(self, quantity: str) -> Array | None:
        """Return a centre, x forward, y right, z down [m], (3,)."""
        value, key = self.first(quantity, (3,)), quantity[10]
        parts = [
            self.first(" ".join(f"{x}{s}" for s in (key, f"_{key}", key.upper(), f"_{key.upper()}")))
            for x in "xyz"
        ]
        if value is None and any(x is not None for x in parts):
            return np.array([x or 0.0 for x in parts])
        return None if value is None else np.ravel(value)

    def inertia(self) -> Array | None:
        """Return the inertia about the centre of gravity [kg m²], (3, 3)."""
        moments = [self.first(f"I{a} I{a}{a} I_{a} I_{a}{a} J{a} J{a}{a} i{a}{a}") for a in "xyz"]
        if None in moments:
            return self.square("inertia", 3)
        tensor = np.diag(moments)
        for i, j in ((0, 1), (0, 2), (1, 2)):
            a, b = "xyz"[i], "xyz"[j]
            tensor[i, j] = tensor[j, i] = -(self.first(f"I{a}{b} I_{a}{b}") or 0.0)
        return tensor

    def coefficients(self) -> dict[str, Array]:
        """Return kind -> matrix of coefficients, (6, 6)."""
        out: dict[str, Array] = {}
        symbols = {name: symbol_of(name) for name in map(_last, self.found.values)}
        dotted = any(symbol and "dot" in name for name, symbol in symbols.items())
        for name, symbol in symbols.items():
            value = self.first(name) if symbol else None
            if symbol and value is not None and not (dotted and re.match(r"._?d", name)):
                # In that case Ndr is a rudder coefficient.
                out.setdefault(symbol[0], np.zeros((6, 6)))[symbol[1:]] = value
        return out


def read_coefficients(path: Path) -> Draft:
    """Read the vehicle from a .py or .m file with coefficients.

    Args:
        path: File, which is read as text and never executed.

    Raises:
        VehicleError: The file cannot be read, or lacks required numbers.
    """
    found = read_assignments(path)
    draft = draft_of(found, path, f"{path.stem} ({'MATLAB' if found.matlab else 'Python'})")
    computed = [x for x in found.unread if re.fullmatch(r"(.*\.)?(tau\w*|[XYZKMN]_\w+|D\w*|C[A-Z]*)", x)]
    if computed:
        draft.not_read[f"computed by code that is not read: {', '.join(computed)}"] += len(computed)
    return draft


def draft_of(found: Assignments, path: Path, title: str) -> Draft:
    """Return the draft of a vehicle from numbers with conventional names.

    Args:
        found: The numbers, and the calls of functions of PythonVehicleSimulator.
        path: File that contains them.
        title: Title of the vehicle.

    Raises:
        VehicleError: Required numbers are missing.
    """
    names = _Names(found, str(path))
    draft = Draft(str(path), f"{path.name} (coefficients of Fossen's equations)")
    draft.values |= {"title": title, "description": f"Read by FinsSim from {path.name}."}
    if names.first("G", (36,)) is not None:
        raise VehicleError(
            f"{path}: has a restoring matrix G, as a surface vessel does, expected a submerged vehicle"
        )
    draft.different.append("axes are taken as Fossen's: x forward, y right, z down, turned here to z up")
    try:
        _put_body(names, draft)
        _put_hydrodynamics(names, draft)
    except ArithmeticError as error:
        raise VehicleError(
            f"{path}: its mass, drag or thrust is not finite ({error}): correct its numbers"
        ) from None
    _put_thrusters(names, draft)
    sides = np.array([names.first(key) or 0.0 for key in ("length", "width", "height")])
    put_envelope(draft, [np.stack([-sides / 2.0, sides / 2.0])])
    if not draft.missing:
        put_controlled_axes(draft)
    others = [name for name in found.values if name not in names.used]
    if others:
        draft.not_read[f"numbers of other names: {', '.join(others)}"] += len(others)
    return draft


def _put_body(names: _Names, draft: Draft) -> None:
    """Set water, mass, inertia and the centres."""
    for key, usual in (("gravity", 9.81), ("density", 1026.0)):
        value = names.first(key)
        draft.guess(f"water.{key}", usual, "the file gives none") if value is None else draft.put(
            f"water.{key}", value
        )
    g, rho = (draft.values["water"][key] for key in ("gravity", "density"))
    rigid, weight, mass = names.square("rigid", 6), names.first("weight"), names.first("mass")
    tensor, centres = (
        names.inertia(),
        {key: names.point(f"center_of_{key}") for key in ("gravity", "buoyancy")},
    )
    if mass is not None and weight is not None and abs(weight / (mass * g) - 1.0) > 0.05:
        raise VehicleError(
            f"{names.label}: the weight W is {weight:g} N, and m g is {mass * g:g} N: correct one of them"
        )
    mass = weight / g if mass is None and weight is not None else mass
    if rigid is not None:
        mass, centre = float(rigid[0, 0]), np.array([rigid[1, 5], rigid[2, 3], rigid[0, 4]]) / rigid[0, 0]
        centres["gravity"], tensor = centre, rigid[3:, 3:] + mass * skew(centre) @ skew(centre)
    for value, what in ((mass, "mass is read, expected a name such as m, W or MRB"),
                        (tensor, "inertia is read, expected Ix, Iy and Iz, I_g or MRB")):  # fmt: skip
        if value is None:
            raise VehicleError(f"{names.label}: no {what}: add it as a number")
    draft.put("body.mass", mass)
    draft.put("body.inertia", plain(flu_of_frd(tensor)))
    for key, point in centres.items():
        if point is None:
            draft.guess(f"body.center_of_{key}", [0.0, 0.0, 0.0], "the file gives none: at the body origin")
        else:
            draft.put(f"body.center_of_{key}", plain(flu_of_frd(point)))
    buoyancy, volume = names.first("buoyancy"), names.first("volume")
    if buoyancy is not None and not 0.2 < buoyancy / (mass * g) < 5.0:
        raise VehicleError(
            f"{names.label}: the buoyancy B is {buoyancy:g} N and the weight {mass * g:g} N: correct one"
        )
    if buoyancy is None and volume is None:
        draft.guess("body.displaced_volume", mass / rho, "no B and no volume in the file: neutral buoyancy")
    else:
        draft.put("body.displaced_volume", volume if buoyancy is None else buoyancy / (rho * g), "derived")


def _put_hydrodynamics(names: _Names, draft: Draft) -> None:
    """Set added mass and damping from matrices or coefficients, and from the hull functions of a torpedo."""
    parts, path, found = names.coefficients(), "hydrodynamics.calibrated", names.found
    wholes = {kind: names.square(kind, 6) for kind in ("added", "linear", "quadratic")}
    matrices = {k: parts.get(k, np.zeros((6, 6))) if x is None else np.array(x) for k, x in wholes.items()}
    for name, entries in found.altered.items():
        if _last(name) in NAMES["linear"].split():
            for index in entries:
                matrices["linear"][index] = 0.0
            axes = " and ".join(AXES[index[0]] for index in sorted(entries))
            draft.different.append(
                f"linear damping of {axes}: code that is not read changes it with speed; left out"
            )
    for kind, key in (
        ("added", "added_mass"),
        ("linear", "linear_damping"),
        ("quadratic", "quadratic_damping"),
    ):
        draft.put(
            f"{path}.{key}", plain(flu_of_frd(one_sign(matrices[kind], key.replace("_", " "), names.label)))
        )
    if products := [name for name in map(_last, found.values) if (symbol_of(name) or " ")[0] == "product"]:
        draft.not_read[f"products of two velocities: {', '.join(products)}"] += len(products)
    lift, flow = (
        [x for x in found.calls.get(f, ()) if np.ndim(x) == 0 and x]
        for f in ("forceLiftDrag", "crossFlowDrag")
    )
    if len(lift) in (3, 4):
        torpedo.put_lift_drag(draft, *lift)
    if len(flow) == 3:
        torpedo.put_cross_flow(draft, *flow)
    elif flow:
        draft.different.append(f"cross-flow drag of the model {flow[-1]} is left out: only Hoerner's is read")
    if any({(4, 0), (4, 2), (5, 0), (5, 1)} <= cleared for cleared in found.cleared.values()):
        torpedo.put_munk_relief(draft)
    words = {key: names.first(key) for key in (*torpedo.PROPELLER, "nMax")} | {"L": names.first("length")}
    if None not in words.values():
        torpedo.put_propeller(draft, words | {"T_n": names.first("T_n")})
        further = ("A_r", "A_s", "x_r", "x_s", "deltaMax_r", "deltaMax_s", "T_delta")
        fins = {key: names.first(key) for key in (*torpedo.FINS, *further)}
        if all(fins[key] for key in torpedo.FINS):
            torpedo.put_fins(draft, fins | {"L": words["L"]})
        else:
            draft.not_read["fins, which turn the vehicle"] += 1
    hull = draft.values["hydrodynamics"]["calibrated"]
    if "cross_flow_drag" not in hull and not any(
        np.any(hull[f"{k}_damping"]) for k in ("linear", "quadratic")
    ):
        raise VehicleError(
            f"{names.label}: no damping is read, expected Xu or Xuu and so on, or a matrix D: add them"
        )


def _put_thrusters(names: _Names, draft: Draft) -> None:
    """Set the thrusters from the thrust allocation matrix, or request them."""
    limit = SHARE * draft.values["body"]["mass"] * draft.values["water"]["gravity"]
    wide = {
        n: x for n, x in names.found.of(*NAMES["thrust"].split()).items() if np.ndim(x) == 2 and len(x) == 6
    }
    names.used |= wide.keys()
    for k, column in enumerate(map(flu_of_frd, next(iter(wide.values())).T) if wide else ()):
        push, moment = column[:3], column[3:]
        if np.linalg.norm(push) < 1e-9:
            raise VehicleError(
                f"{names.label}: column {k + 1} of the matrix of thrusters has no force: remove it"
            )
        place = np.cross(push, moment) / (push @ push)
        draft.put(f"thrusters.t{k}.position", plain(place), "derived", "nearest point of its line of action")
        draft.put(f"thrusters.t{k}.axis", plain(push / np.linalg.norm(push)), "derived")
        torpedo.guess_thruster(draft, "thrusters", f"t{k}", limit)
    if "thrusters" not in draft.values:
        torpedo.guess_thruster(draft, "thruster_groups", "thruster", limit)
        line = {"group": "thruster", "position": "[x, y, z]", "axis": "[x, y, z]"}
        draft.missing = {"thrusters": {"NAME": line}}


def _recognises(path: Path, head: bytes) -> bool:
    return path.suffix.lower() in (".py", ".m") and b"agent_type" not in head  # a scenario of HoloOcean


COEFFICIENTS = Importer(
    "vehicle", "coefficients of Fossen's equations (.py, .m)", _recognises, read_coefficients
)
