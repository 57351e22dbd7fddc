"""Hull drag, propeller and fins of the torpedoes of PythonVehicleSimulator and HoloOcean.

Equations, x forward, y right, z down, b span, S area of the hull, alpha angle of attack, x_k positions of 21 strips:

    drag = rho/2 U² S (CD_0 + CL² / (pi e b²/S)),  lift = rho/2 U² S CL,  CL = CL_alpha alpha
    Y = -rho/2 T Cd sum_k |v + x_k r| (v + x_k r) dx,  N = -rho/2 T Cd sum_k x_k |v + x_k r| (v + x_k r) dx
    X = (1 - t) rho D⁴ (KT_0 n|n| + (KT_max - KT_0) / Ja_max (1 - w) U / D |n|)                n in 1/s

The hull is represented by the terms `lift_drag`, `cross_flow_drag` and `munk_relief` of a vehicle file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from finssim.vehicles.importers.draft import LAG, Draft

__all__ = [
    "FINS",
    "PROPELLER",
    "guess_thruster",
    "put_cross_flow",
    "put_fins",
    "put_lift_drag",
    "put_munk_relief",
    "put_propeller",
]

Array = NDArray[np.float64]

SET = "hydrodynamics.calibrated"
"""Path of the hydrodynamic set that importers write."""
PROPELLER = ("D_prop", "t_prop", "KT_0", "KT_max", "Ja_max")
"""Keys of a propeller: diameter [m], thrust deduction, thrust coefficients at J = 0 and at Ja_max, Ja_max [-]."""
FINS = ("CL_delta_r", "CL_delta_s", "S_fin")
"""Keys of fins: lift slopes of rudder and stern plane [1/rad], area of one fin [m²]."""
TRAVEL = math.radians(15.0)
"""Range of the fins of PythonVehicleSimulator [rad]."""
RHO, WAKE, OSWALD = 1026.0, 0.056, 0.7
"""Density in the library's drag [kg/m³], wake fraction and Oswald efficiency of PythonVehicleSimulator [-]."""
RPM = 3000.0
"""Guessed shaft speed at the limit of a thruster [rpm]."""
HOERNER = (
    (0.0109, 0.1766, 0.3530, 0.4519, 0.4728, 0.4929, 0.4933, 0.5585, 0.6464, 0.8336, 0.9880, 1.3081, 1.6392, 1.8600,
     2.3129, 2.6000, 3.0088, 3.4508, 3.7379, 4.0031),
    (1.9661, 1.9657, 1.8976, 1.7872, 1.5837, 1.2786, 1.2108, 1.0836, 0.9986, 0.8796, 0.8284, 0.7599, 0.6914, 0.6571,
     0.6307, 0.5962, 0.5868, 0.5859, 0.5599, 0.5593),
)  # fmt: skip
"""Ratio of beam to twice the draught [-], and cross-flow drag coefficient of Hoerner's curve [-]."""


def spheroid_moments(a: float, b: float, mass: float) -> Array:
    """Return the moments of inertia of a homogeneous spheroid [kg m²], (3,).

    Args:
        a: Half length [m].
        b: Radius [m].
        mass: Mass [kg].
    """
    return mass * np.array([0.4 * b**2, 0.2 * (a**2 + b**2), 0.2 * (a**2 + b**2)])


def spheroid_added_mass(a: float, b: float, mass: float, roll: float) -> Array:
    """Return the diagonal of the added mass of a spheroid by Lamb's k-factors [kg, kg m²], (6,).

    Args:
        a: Half length [m].
        b: Radius [m].
        mass: Mass of the displaced water [kg].
        roll: Added moment in roll, as a fraction of the moment of inertia [-].
    """
    e = math.sqrt(1.0 - (b / a) ** 2)
    log = math.log((1.0 + e) / (1.0 - e))
    alpha, beta = 2.0 * (1.0 - e**2) / e**3 * (0.5 * log - e), 1.0 / e**2 - (1.0 - e**2) / (2.0 * e**3) * log
    k1, k2 = alpha / (2.0 - alpha), beta / (2.0 - beta)
    k = e**4 * (beta - alpha) / ((2.0 - e**2) * (2.0 * e**2 - (2.0 - e**2) * (beta - alpha)))
    return np.array([mass * k1, mass * k2, mass * k2, *(spheroid_moments(a, b, mass) * [roll, k, k])])


def slow_damping(mass: Array, times: Array, ratios: Array, stiffness: float) -> Array:
    """Return the diagonal of the linear damping of a torpedo at low speed [N s/m, N m s], (6,).

    Args:
        mass: Diagonal of its mass matrix [kg, kg m²], (6,).
        times: Time constants in surge, in sway and heave, and in yaw [s], (3,).
        ratios: Damping ratios in roll and pitch [-], (2,).
        stiffness: W (z_g - z_b) [N m].
    """
    swing = 2.0 * ratios * np.sqrt(max(stiffness, 0.0) * mass[3:5])
    return np.array([mass[0] / times[0], *(mass[1:3] / times[1]), *swing, mass[5] / times[2]])


def put_lift_drag(draft: Draft, span: float, area: float, drag: float, efficiency: float = OSWALD) -> None:
    """Set lift and drag of a hull as a function of its angle of attack.

    Args:
        draft: Draft with hydrodynamics.
        span: Span of the hull as a wing [m].
        area: Area of the hull as a wing [m²].
        drag: CD_0 [-].
        efficiency: Oswald efficiency [-].
    """
    ratio, q = span**2 / area, 0.5 * RHO * area
    slope = math.pi * ratio / (1.0 + math.sqrt(1.0 + (ratio / 2.0) ** 2))
    induced = q * slope**2 / (math.pi * efficiency * ratio)
    found = {"drag": q * drag, "lift": q * slope, "induced": induced}
    for key, value in found.items():
        draft.put(f"{SET}.lift_drag.{key}", value, "derived", "lift and drag of the hull as a wing")
    draft.different.append(
        "lift and induced drag of the hull go with the sine of the angle of attack, in the file with the angle"
    )


def put_cross_flow(draft: Draft, length: float, beam: float, draught: float) -> None:
    """Set cross-flow drag in sway and yaw: 21 strips, each a twentieth of the length, extend beyond the hull's ends.

    Args:
        draft: Draft with hydrodynamics.
        length: Length of the hull [m].
        beam: Beam of the hull [m].
        draught: Height of the hull [m].
    """
    across = 0.5 * RHO * draught * float(np.interp(beam / (2.0 * draught), *HOERNER))
    for key, value in (("length", 1.05 * length), ("center", 0.0), ("sway", across)):
        draft.put(f"{SET}.cross_flow_drag.{key}", value, "derived", "cross flow past 21 strips of the hull")


def put_munk_relief(draft: Draft) -> None:
    """Cancel the velocity products in C_A that these programs set to 0."""
    A = np.diag(np.array(draft.values["hydrodynamics"]["calibrated"]["added_mass"]))
    draft.put(f"{SET}.munk_relief", A[:3].tolist(), "derived", "the file sets these terms of C_A to 0")
    draft.different.append(
        "the Munk moment, which the file sets to 0, is cancelled; a real hull has it, and needs fins"
    )


def put_propeller(draft: Draft, words: Mapping[str, float]) -> None:
    """Set the propeller at the stern: its thrust at rest, and its loss of thrust in a flow.

    Args:
        draft: Draft with water.
        words: Values of `PROPELLER`, `nMax` [rpm], `L` [m] and, where given, `T_n` [s] and `w` [-].
    """
    omega, D, path = words["nMax"] * math.pi / 30.0, words["D_prop"], "thrusters.propeller"
    scale = (1.0 - words["t_prop"]) * draft.values["water"]["density"] * D**4
    factor = scale * words["KT_0"] / (2.0 * math.pi) ** 2
    for end, sign, side in (("max", 1.0, "plus"), ("min", -1.0, "minus")):
        draft.put(f"{path}.force_{end}", sign * factor * omega**2, "derived", "at rest")
        draft.put(f"{path}.rpm_{end}", sign * words["nMax"])
        draft.put(f"{path}.c_{side}", factor, "derived", "KT_0")
    loss = scale * (words["KT_0"] - words["KT_max"]) / words["Ja_max"] / (2.0 * math.pi * D)
    draft.put(f"{path}.inflow.thrust_loss", loss, "derived", "KT_0 and KT_max")
    draft.put(f"{path}.inflow.wake_fraction", words.get("w", WAKE))
    draft.put(f"{path}.diameter", D)
    if words.get("T_n") is None:
        draft.guess(f"{path}.time_constant", LAG, "not in the file")
    else:
        draft.put(f"{path}.time_constant", words["T_n"])
    draft.put(f"{path}.axis", [1.0, 0.0, 0.0])
    draft.guess(f"{path}.position", [-words["L"] / 2.0, 0.0, 0.0], "at the stern, on the axis")
    draft.values["thrusters"]["propeller"]["domain"] = "speed"
    draft.not_read["torque of the propeller, which rolls the vehicle"] += 1


def put_fins(draft: Draft, words: Mapping[str, float | None]) -> None:
    """Set a rudder and a stern plane, of two fins each, whose lift depends on the deflection alone.

    Args:
        draft: Draft with a propeller.
        words: `CL_delta_r` and `CL_delta_s` [1/rad], `S_fin` of one fin [m²], `L` [m] and, where given,
            `A_r`, `A_s` of a pair [m²], in which case the pair has drag, `x_r`, `x_s` [m], `deltaMax_r`,
            `deltaMax_s` [rad] and `T_delta` [s].
    """
    for name, side, span in (("rudder", "r", [0.0, 0.0, 1.0]), ("stern_plane", "s", [0.0, -1.0, 0.0])):
        path, slope, area = f"actuators.{name}", words[f"CL_delta_{side}"], words.get(f"A_{side}")
        x, travel, lag = (words.get(key) for key in (f"x_{side}", f"deltaMax_{side}", "T_delta"))
        draft.put(f"{path}.kind", "fin")
        place = [-words["L"] / 2.0 if x is None else x, 0.0, 0.0]  # type: ignore[operator]
        draft.put(f"{path}.position", place, "derived", "both fins together, on the axis")
        draft.put(f"{path}.span", span, "derived", "a positive angle turns the bow to starboard or down")
        draft.put(f"{path}.area", area or 2.0 * (words["S_fin"] or 0.0), "derived", "both fins")
        draft.put(f"{path}.lift_slope", slope)
        draft.put(f"{path}.drag", [0.0, 0.0, slope if area else 0.0], "derived", "lift times angle")
        draft.put(f"{path}.incidence", 0.0, "derived", "lift by the deflection alone")
        draft.guess(f"{path}.stall", 0.7, "lift of the file has no end")
        for end, sign in (("minimum", -1.0), ("maximum", 1.0)):
            if travel is None:
                draft.guess(f"{path}.{end}", sign * TRAVEL, "not in the file: that of PythonVehicleSimulator")
            else:
                draft.put(f"{path}.{end}", sign * travel)
        if lag is None:
            draft.guess(f"{path}.time_constant", 0.1, "not in the file: that of PythonVehicleSimulator")
        else:
            draft.put(f"{path}.time_constant", lag)


def guess_thruster(draft: Draft, section: str, name: str, limit: float) -> None:
    """Guess the thrust curve and lag of a thruster from its known or guessed limit [N]."""
    factor = limit / (RPM * math.pi / 30.0) ** 2
    for key, value in (("force_min", -limit), ("force_max", limit), ("rpm_min", -RPM), ("rpm_max", RPM),
                       ("c_plus", factor), ("c_minus", factor), ("time_constant", LAG)):  # fmt: skip
        draft.guess(f"{section}.{name}.{key}", value, f"not in the file: {limit:.4g} N at {RPM:g} rpm")
    draft.values[section][name]["domain"] = "force"
