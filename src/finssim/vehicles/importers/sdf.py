"""Importer of SDF for gz-sim: a model with the plugins Hydrodynamics, Thruster and Buoyancy.

Equations of gz-sim as of July 2026, in its own symbols; body axes x forward, y left, z up, as here:

    force = Ma nu_dot + C nu + sum_j (xU_j + sum_k xU_jabsU_k |nu_k|) nu_j          about the origin of the link
    thrust = thrust_coefficient fluid_density propeller_diameter⁴ n |n|             n in rad/s, along the joint's axis
    buoyancy = density g volume of the collision shapes, at the mean of their poses, weighted by their volumes

Ma contains xDotU and so on, which are negative, and C is Fossen's Coriolis matrix of -Ma: gz-sim adds it where Fossen
subtracts it, which FinsSim does not reproduce. Propellers and other jointed links are fixed in the pose of the file.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finssim.core.importer import Importer
from finssim.core.xml_file import read_xml
from finssim.vehicles.importers.draft import (
    GRAVITY,
    LAG,
    SHARE,
    Draft,
    put_controlled_axes,
    put_envelope,
)
from finssim.vehicles.importers.elements import (
    Element,
    flag,
    number,
    numbers,
    refuse_unknown,
)
from finssim.vehicles.importers.model import (
    Model,
    note_rest,
    put_body,
    put_displacement,
    put_hull,
    put_physical_inertia,
    shapes_of,
)
from finssim.vehicles.importers.rigid import LinkPose, plain
from finssim.vehicles.part import VehicleError, did_you_mean

__all__ = [
    "SDF",
    "added_mass",
    "axis_of_joint",
    "damping",
    "kind_of",
    "read_model",
    "read_sdf",
    "thrust_factor",
]

Array = NDArray[np.float64]

FORCES, VELOCITIES = "xyzkmn", "UVWPQR"
COEFFICIENT = re.compile(r"([xyzkmn])(Dot)?([UVWPQR])(?:(abs)?([UVWPQR]))?")
"""Coefficient: force, optional marker of added mass, velocity, and the second velocity of a quadratic coefficient."""

HYDRODYNAMICS = {
    "link_name", "water_density", "disable_coriolis", "disable_added_mass", "default_current", "namespace",
    "lookup_current_x", "lookup_current_y", "lookup_current_z",
}  # fmt: skip
"""Child elements of the plugin Hydrodynamics besides coefficients."""
THRUSTER = {
    "namespace", "topic", "joint_name", "thrust_coefficient", "propeller_diameter", "fluid_density", "use_angvel_cmd",
    "velocity_control", "max_thrust_cmd", "min_thrust_cmd", "deadband", "p_gain", "i_gain", "d_gain", "battery_name",
    "power_load", "wake_fraction", "alpha_1", "alpha_2",
}  # fmt: skip
"""Child elements of the plugin Thruster."""
CONTROL = {
    "jointName", "cmd_topic", "multiplier", "offset", "type", "servo_min", "servo_max", "useForce", "p_gain", "i_gain",
    "d_gain", "i_max", "i_min", "cmd_max", "cmd_min", "controlVelocitySlowdownSim", "frequencyCutoff",
}  # fmt: skip
"""Child elements of a control of the plugin ArduPilotPlugin."""
BUOYANCY = {"uniform_fluid_density", "graded_buoyancy", "enable"}
"""Child elements of the plugin Buoyancy."""
PROPELLER = {"thrust_coefficient": 1.0, "fluid_density": 1000.0, "propeller_diameter": 0.02}
"""Child elements that determine the thrust -> gz-sim's default [-, kg/m³, m]."""
CURVES = {"alpha_1", "alpha_2", "wake_fraction"}
"""Child elements of a thrust coefficient that decreases with the speed."""
LEFT_OUT = "plugin LiftDrag (its forces are left out)"
WRENCHES = ("BuoyancyEngine", "JointPositionController", "AddedMass", "Wind")
"""Plugins that act on a vehicle and are not read; other plugins are listed without a warning."""

DENSITY = 1000.0
"""Density of water if the plugins define none [kg/m³]."""


# Conversions from gz-sim's parameters to those of a vehicle file.


def added_mass(coefficients: Mapping[str, float], where: str) -> Array:
    """Return M_A [kg, kg m, kg m²], (6, 6), the negative of Ma.

    Args:
        coefficients: Name, such as `xDotU`, -> number; other coefficients are ignored.
        where: Name of the coefficients in messages.

    Raises:
        VehicleError: A diagonal coefficient is positive, or the matrix is not symmetric.
    """
    Ma = np.zeros((6, 6))
    for name, value in coefficients.items():
        match = COEFFICIENT.fullmatch(name)
        if match and match[2]:
            Ma[FORCES.index(match[1]), VELOCITIES.index(match[3])] = value
    _refuse_positive(np.diag(Ma), "Dot", where)
    if not np.allclose(Ma, Ma.T, rtol=1e-3, atol=1e-9):
        raise VehicleError(f"{where}: the added mass is not symmetric: give each coupling in both places")
    return 0.0 - Ma


def damping(coefficients: Mapping[str, float], where: str) -> tuple[Array, Array]:
    """Return D1 [N s/m, N s, N m s] and D2 [N s²/m², N s², N m s²], (6, 6) each, the negatives of the coefficients.

    Args:
        coefficients: Name, such as `xU` or `yRabsR`, -> number; those of added mass are ignored.
        where: Name of the coefficients in messages.

    Raises:
        VehicleError: A diagonal coefficient is positive, or a product of two velocities is not of the form v|v|.
    """
    linear, quadratic = np.zeros((6, 6)), np.zeros((6, 6))
    for name, value in coefficients.items():
        match = COEFFICIENT.fullmatch(name)
        if match is None or match[2]:
            continue
        force, velocity = FORCES.index(match[1]), VELOCITIES.index(match[3])
        if match[5] is None:
            linear[force, velocity] = -value
        elif match[4] and match[5] == match[3]:
            quadratic[force, velocity] = -value
        elif value and match[4]:
            raise VehicleError(
                f"{where}: {name} couples two velocities, which a vehicle file cannot represent: set it to 0 or omit it"
            )
        elif value:
            abs_name = f"{match[1]}{match[3]}abs{match[5]}"
            raise VehicleError(
                f"{where}: {name} drives the vehicle in one direction, since its velocities have a sign: "
                f"use {abs_name} if it is drag"
            )
    _refuse_positive(-np.diag(linear), "", where)
    _refuse_positive(-np.diag(quadratic), "abs", where)
    return linear + 0.0, quadratic + 0.0


def _refuse_positive(diagonal: Array, kind: str, where: str) -> None:
    for k in np.flatnonzero(diagonal > 0.0):
        force, velocity = FORCES[k], VELOCITIES[k]
        name = {"Dot": f"{force}Dot{velocity}", "": f"{force}{velocity}"}.get(
            kind, f"{force}{velocity}abs{velocity}"
        )
        raise VehicleError(
            f"{where}: {name} is {diagonal[k]:g}, expected 0 or less: gz-sim gives added mass and damping as negative "
            "numbers, older files as positive ones; change its sign"
        )


def fluid_added_mass(element: Element, where: str) -> Array:
    """Return M_A [kg, kg m, kg m²], (6, 6), of an element `fluid_added_mass`, whose numbers are positive."""
    letters, matrix = "xyzpqr", np.zeros((6, 6))
    for child in element:
        i, j = (letters.find(letter) for letter in child.tag) if len(child.tag) == 2 else (-1, -1)
        if not 0 <= i <= j:
            raise VehicleError(
                f"{where}: fluid_added_mass: unknown element '{child.tag}', expected xx, xy ... rr"
            )
        matrix[i, j] = matrix[j, i] = numbers(child.text, 1, f"{where}: fluid_added_mass: {child.tag}")[0]
    return matrix


def thrust_factor(coefficient: float, density: float, diameter: float) -> float:
    """Return the magnitude of c in thrust = c n|n| [N s²/rad²]; its sign only states the direction of rotation.

    Args:
        coefficient: Thrust coefficient for n in rad/s, not in revolutions per second [-].
        density: Density of the water [kg/m³].
        diameter: Diameter of the propeller [m].
    """
    return abs(coefficient) * density * diameter**4


def axis_of_joint(joint: LinkPose, axis: Array) -> Array:
    """Return the direction of positive thrust in the body frame, unit length, (3,).

    Args:
        joint: Pose of the joint in the body frame.
        axis: Axis in the frame of the joint, of any length [-], (3,).
    """
    turned = joint.turn @ axis
    return np.asarray(turned / np.linalg.norm(turned))


def _put_hydrodynamics(model: Model, plugin: Element, base: str, draft: Draft) -> None:
    """Set added mass and damping from the plugin, or added mass from the link."""
    where = f"{model.label}: plugin Hydrodynamics"
    coefficients = {}
    for child in plugin:
        if COEFFICIENT.fullmatch(child.tag):
            coefficients[child.tag] = float(numbers(child.text, 1, f"{where}: {child.tag}")[0])
        elif child.tag not in HYDRODYNAMICS:
            raise VehicleError(
                f"{where}: unknown element '{child.tag}'{did_you_mean(child.tag, sorted(HYDRODYNAMICS))} expected "
                "coefficients such as xDotU, xU and xUabsU: correct or remove it"
            )
    for tag in ("default_current", "lookup_current_x", "lookup_current_y", "lookup_current_z"):
        if plugin.find(tag) is not None:
            draft.not_read[f"Hydrodynamics: {tag} (a current is of the water, not of the vehicle)"] += 1
    linear, quadratic = damping(coefficients, where)
    explicit = added_mass(coefficients, where)
    inner = {name: link.find("inertial/fluid_added_mass") for name, link in model.links.items()}
    implicit = {
        name: fluid_added_mass(e, f"{model.label}: link '{name}'")
        for name, e in inner.items()
        if e is not None
    }
    for name, matrix in implicit.items():
        if name != base and np.any(matrix):
            raise VehicleError(
                f"{model.label}: link '{name}' has fluid_added_mass, expected it at '{base}' only: move it"
            )
    chosen = implicit.get(base, np.zeros((6, 6)))
    if np.any(explicit) and flag(plugin, "disable_added_mass", where):
        draft.different.append(
            "disable_added_mass: the coefficients of added mass in Hydrodynamics are left out"
        )
    elif np.any(explicit) and np.any(chosen):
        raise VehicleError(
            f"{where}: the link has fluid_added_mass too, which counts twice: remove one of them"
        )
    elif np.any(explicit):
        chosen = explicit
        if np.any(explicit - np.diag(np.diag(explicit))):
            draft.different.append(
                "couplings of added mass are in FinsSim's Coriolis wrench, and not in gz-sim's"
            )
        theirs = "gives it the other sign where the plugin has the added mass (seen in July 2026)"
        if flag(plugin, "disable_coriolis", where):
            theirs = "leaves it out here (disable_coriolis)"
        draft.different.append(
            f"Coriolis wrench of the added mass: FinsSim computes it as Fossen; gz-sim {theirs}"
        )
    if not np.any(chosen):
        draft.different.append("the added mass is 0 on every axis: a real vehicle accelerates more slowly")
    for path, matrix in (
        ("added_mass", chosen),
        ("linear_damping", linear),
        ("quadratic_damping", quadratic),
    ):
        draft.put(f"hydrodynamics.calibrated.{path}", plain(matrix))


def _put_thrusters(
    model: Model, plugins: list[Element], ranges: Mapping[str, tuple[float, float]], draft: Draft
) -> None:
    """Set the thrusters: each at the origin of the propeller's link, along the axis of its joint."""
    weight = draft.values["body"]["mass"] * GRAVITY
    for plugin in plugins:
        name = model.text(plugin, "joint_name")
        where, path = f"{model.label}: Thruster of '{name}'", f"thrusters.{name}"
        refuse_unknown(plugin, THRUSTER, where)
        if not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", name) or name in draft.values.get("thrusters", {}):
            raise VehicleError(
                f"{where}: the name is there twice, or not of letters, digits, _ and -: rename the joint"
            )
        if name not in model.joints:
            raise VehicleError(
                f"{where}: there is no such joint{did_you_mean(name, list(model.joints))} correct it"
            )
        joint = model.joints[name]
        axis = joint.find("axis/xyz")
        if axis is not None and axis.get("expressed_in"):
            raise VehicleError(
                f"{where}: the axis is in another frame, which Thruster leaves out: give it in the joint's"
            )
        vector = np.array([0.0, 0.0, 1.0]) if axis is None else numbers(axis.text, 3, f"{where}: xyz")
        if np.linalg.norm(vector) < 1e-6:
            raise VehicleError(f"{where}: the axis is {vector.tolist()}, expected a direction")
        place = model.pose(model.link_of(model.text(joint, "child"))).place
        draft.put(f"{path}.position", plain(place), "derived", "origin of the propeller's link")
        direction = axis_of_joint(model.pose(name), vector)
        draft.put(f"{path}.axis", plain(direction), "derived", "axis of the joint")

        absent = [tag for tag in PROPELLER if plugin.find(tag) is None]
        for tag in CURVES & {child.tag for child in plugin}:
            draft.not_read[f"Thruster: {tag} (thrust that falls with the speed)"] += 1
        k, density, diameter = (number(plugin, tag, where, usual) for tag, usual in PROPELLER.items())
        if "thrust_coefficient" in absent:
            k = number(plugin, "alpha_1", where, k)
        factor = thrust_factor(k, density, diameter)
        if factor <= 0.0:
            raise VehicleError(
                f"{where}: the thrust coefficient, the diameter or the density is 0, expected another"
            )
        for key in ("c_plus", "c_minus"):
            if absent:
                draft.guess(f"{path}.{key}", factor, f"no {', '.join(absent)} in the file: as in gz-sim")
            else:
                draft.put(f"{path}.{key}", factor, "derived", ", ".join(PROPELLER))
        _put_limits(plugin, where, path, ranges.get(name), np.copysign(factor, k), weight, draft)
        draft.values["thrusters"][name] |= {"domain": "speed", "group": "propeller"}
        draft.guess(f"{path}.time_constant", LAG, "gz-sim's thrust follows at once")
        if plugin.find("deadband") is not None:
            dead = _rpm(number(plugin, "deadband", where), factor)
            draft.put(f"{path}.dead_rpm_plus", dead, "derived", "deadband")
            draft.put(f"{path}.dead_rpm_minus", -dead, "derived", "deadband")


LIFT_DRAG = {
    "link_name", "area", "air_density", "a0", "cla", "cda", "cma", "alpha_stall", "cla_stall", "cda_stall", "cma_stall",
    "cp", "forward", "upward", "radial_symmetry", "control_joint_name", "control_joint_rad_to_cl",
}  # fmt: skip
"""Child elements of LiftDrag."""
STEEPEST_STALL = 1.5
"""Stall angle of a surface without stall below 90° [rad]."""


def _put_fins(model: Model, plugins: list[Element], draft: Draft) -> set[str]:
    """Set the surfaces that a joint rotates, or whose lift depends on the angle of a joint; return the joints.

    Lift is area rho/2 V² cla alpha along `upward` for flow along `forward`, in the frame of the link.
    """
    joints = set()
    for plugin in plugins:
        where = f"{model.label}: LiftDrag"
        refuse_unknown(plugin, LIFT_DRAG, where)
        link = (plugin.findtext("link_name") or "").strip()
        other = (plugin.findtext("control_joint_name") or "").strip()
        turning = [
            name
            for name, joint in model.joints.items()
            if joint.get("type") == "revolute"
            and (name == other if other else model.link_of(model.text(joint, "child")) == link)
        ]
        if link not in model.links or not turning or flag(plugin, "radial_symmetry", where):
            draft.not_read[LEFT_OUT] += 1
            continue
        name, pose = turning[0], model.pose(link)
        path = f"actuators.{name}"
        if name in joints or name in draft.values["thrusters"]:
            raise VehicleError(f"{where}: joint '{name}' turns two surfaces, expected one: give each its own")
        forward, upward, cp = (
            numbers(plugin.findtext(word) or usual, 3, f"{where}: {word}")
            for word, usual in (("forward", "1 0 0"), ("upward", "0 0 1"), ("cp", "0 0 0"))
        )
        across = np.cross(forward, upward)
        if np.linalg.norm(across) < 1e-6 or abs(forward @ upward) > 1e-3 * np.linalg.norm(across):
            raise VehicleError(f"{where}: forward and upward of '{link}' are not perpendicular: correct them")
        axis = numbers(model.joints[name].findtext("axis/xyz") or "0 0 1", 3, f"{where}: axis of '{name}'")
        span = pose.turn @ (across / np.linalg.norm(across))
        if not other:
            turned = axis_of_joint(model.pose(name), axis)
            if abs(turned @ span) < 1.0 - 1e-6:
                draft.not_read[LEFT_OUT] += 1
                continue
            span = np.sign(turned @ span) * span
        ratio = number(plugin, "air_density", where, 1.2041) / draft.values["water"]["density"]
        slope = incident = number(plugin, "cla", where, 1.0)
        if other:
            slope = number(plugin, "control_joint_rad_to_cl", where, 4.0)
            draft.different.append(
                f"drag of '{name}' goes with its angle too, in gz-sim with the flow's alone"
            )
        if not 0.0 <= incident <= slope or slope <= 0.0 or number(plugin, "area", where, 1.0) <= 0.0:
            raise VehicleError(
                f"{where}: cla of '{link}' is {incident:g}, expected above 0 and up to control_joint_rad_to_cl, with "
                "an area above 0"
            )
        draft.put(f"{path}.kind", "fin")
        draft.put(f"{path}.position", plain(pose.place + pose.turn @ cp), "derived", "cp in the link")
        draft.put(f"{path}.span", plain(span), "derived", "axis of the joint")
        chord = pose.turn @ (forward / np.linalg.norm(forward))
        draft.put(f"{path}.chord", plain(chord), "derived", "forward")
        draft.put(f"{path}.area", number(plugin, "area", where, 1.0))
        draft.put(f"{path}.lift_slope", slope * ratio, "derived", "cla by the water's density")
        draft.put(f"{path}.incidence", incident / slope, "derived", "cla")
        stall = min(number(plugin, "alpha_stall", where, math.pi / 2.0), STEEPEST_STALL)
        draft.put(f"{path}.stall", stall, "derived", "alpha_stall")
        drag = abs(number(plugin, "cda", where, 0.01)) * ratio
        draft.put(f"{path}.drag", [0.0, drag, 0.0], "derived", "cda by the water's density")
        for key, end, usual in (("minimum", "lower", -0.5), ("maximum", "upper", 0.5)):
            limit = model.joints[name].findtext(f"axis/limit/{end}")
            if limit is None or abs(float(numbers(limit, 1, where)[0])) > math.pi:
                draft.guess(f"{path}.{key}", usual, "the joint has no limit in the file")
            else:
                draft.put(f"{path}.{key}", float(numbers(limit, 1, where)[0]))
        draft.guess(f"{path}.time_constant", LAG, "its controller is not read")
        sentence = "beyond alpha_stall the lift falls to 0 at 90°, and sweep reduces no lift"
        if sentence not in draft.different:
            draft.different.append(sentence)
        if number(plugin, "a0", where, 0.0):
            draft.different.append(f"a0 of '{name}' is left out: no lift at angle 0 straight ahead")
        joints.add(name)
    return joints


def _rpm(force: float, factor: float) -> float:
    return math.sqrt(abs(force) / factor) * 30.0 / math.pi


def _put_limits(
    plugin: Element,
    where: str,
    path: str,
    commands: tuple[float, float] | None,
    factor: float,
    weight: float,
    draft: Draft,
) -> None:
    """Set the limits of force and shaft speed.

    Args:
        plugin: Element of the Thruster.
        where: Name of the plugin in messages.
        path: Path of the thruster in the vehicle file.
        commands: Least and greatest command of the autopilot, N or rad/s; None if no autopilot commands it.
        factor: Factor of thrust = factor n|n|, with its sign [N s²/rad²].
        weight: Weight of the vehicle [N].
        draft: Draft to which the values are written.
    """
    low = number(plugin, "min_thrust_cmd", where, -math.inf)
    high = number(plugin, "max_thrust_cmd", where, math.inf)
    if high < low:
        raise VehicleError(f"{where}: max_thrust_cmd is {high:g}, expected at least min_thrust_cmd, {low:g}")
    if commands is not None:
        low, high = max(low, commands[0]), min(high, commands[1])
    if flag(plugin, "use_angvel_cmd", where):
        low, high = sorted((factor * low * abs(low), factor * high * abs(high)))
    if low >= 0.0 or high <= 0.0:
        raise VehicleError(
            f"{where}: its thrust is {low:g} to {high:g} N, expected one that reverses: change its limits"
        )
    note = "range of the autopilot's control" if commands is not None else "max_thrust_cmd, min_thrust_cmd"
    for key, force, sign in (("min", low, -1.0), ("max", high, 1.0)):
        if math.isfinite(force):
            draft.put(f"{path}.force_{key}", force, "published" if commands is None else "derived", note)
            how = "shaft speed of the force limit"
            draft.put(f"{path}.rpm_{key}", sign * _rpm(force, abs(factor)), "derived", how)
        else:
            force, how = sign * SHARE * weight, f"no limit in the file: {SHARE:g} of the vehicle's weight"
            draft.guess(f"{path}.force_{key}", force, how)
            draft.guess(f"{path}.rpm_{key}", sign * _rpm(force, abs(factor)), f"{how}, as shaft speed")


# The file: its world or its model, its plugins, and contents that are not read.


def kind_of(plugin: Element) -> str:
    """Return the last component of a plugin's name: `Thruster` of gz::sim::systems::Thruster."""
    return plugin.get("name", "").rpartition("::")[2]


def _model_of(root: Element, path: Path) -> tuple[Element, Element | None]:
    """Return the only model with hydrodynamics, and its world if the file has one."""
    if root.tag != "sdf":
        raise VehicleError(f"{path}: its root is '{root.tag}', expected sdf")
    worlds = root.findall("world")
    around = worlds[0] if len(worlds) == 1 else root
    models = around.findall("model")
    wet = [m for m in models if any(kind_of(p) == "Hydrodynamics" for p in m.findall("plugin"))]
    if len(worlds) > 1 or len(wet) != 1:
        names = ", ".join(m.get("name", "") for m in wet) or "none"
        hint = (
            " (the models that it includes have their own files)"
            if around.find("include") is not None
            else ""
        )
        raise VehicleError(
            f"{path}: the models with a plugin Hydrodynamics are {names}, expected one: give a file with one{hint}"
        )
    return wet[0], worlds[0] if worlds else None


def _put_water(
    model: Model, world: Element | None, plugins: Mapping[str, list[Element]], draft: Draft
) -> Collection[str]:
    """Set density and gravity, and return the links on which Buoyancy acts."""
    gravity = None if world is None else world.findtext("gravity")
    if gravity is None:
        draft.guess("water.gravity", GRAVITY, "the file gives none: that of SDF")
    else:
        vector = numbers(gravity, 3, f"{model.label}: gravity")
        if np.any(vector[:2]) or vector[2] >= 0.0:
            raise VehicleError(f"{model.label}: gravity is {vector.tolist()}, expected it along -z")
        draft.put("water.gravity", -float(vector[2]))
    given = {}
    links: Collection[str] = model.links
    for plugin in [] if world is None else [p for p in world.findall("plugin") if kind_of(p) == "Buoyancy"]:
        where = f"{model.label}: plugin Buoyancy"
        refuse_unknown(plugin, BUOYANCY, where)
        given["Buoyancy"] = _density(plugin, where)
        names = {(element.text or "").strip() for element in plugin.findall("enable")}
        own = model.element.get("name", "")
        if names and own not in names:
            links = [link for link in model.links if f"{own}::{link}" in names]
    if world is not None and not given:
        draft.different.append(
            "the world has no plugin Buoyancy: there the vehicle sinks, here its shapes carry it"
        )
    for kind, tag in (("Hydrodynamics", "water_density"), ("Thruster", "fluid_density")):
        for plugin in plugins.get(kind, []):
            if plugin.find(tag) is not None:
                given.setdefault(f"{tag} of {kind}", number(plugin, tag, f"{model.label}: plugin {kind}"))
    if not given:
        draft.guess("water.density", DENSITY, "the file gives none: that of the plugin Buoyancy")
        return links
    first = next(iter(given))
    draft.put("water.density", given[first], "published", "" if first == "Buoyancy" else first)
    if len(set(given.values())) > 1:
        named = ", ".join(f"{value:g} ({what})" for what, value in given.items())
        draft.different.append(f"the densities differ: {named}; the buoyancy has the first")
    if first != "Buoyancy":
        draft.different.append("the density of Buoyancy is in a world's file, which is not read: compare it")
    return links


def _density(plugin: Element, where: str) -> float:
    """Return the density under water of the plugin Buoyancy [kg/m³]."""
    graded = plugin.find("graded_buoyancy")
    if graded is None or plugin.find("uniform_fluid_density") is not None:
        return number(plugin, "uniform_fluid_density", where, DENSITY)
    refuse_unknown(graded, {"default_density", "density_change"}, where)
    changes = graded.findall("density_change")
    if any(number(change, "above_depth", where, 0.0) != 0.0 for change in changes):
        raise VehicleError(
            f"{where}: the density changes under water, which a vehicle file cannot represent: give one density"
        )
    return number(graded, "default_density", where, DENSITY)


def _ranges(plugins: list[Element], label: str) -> dict[str, tuple[float, float]]:
    """Return joint -> least and greatest command to its Thruster, from the controls of ArduPilotPlugin."""
    ranges = {}
    for control in (control for plugin in plugins for control in plugin.findall("control")):
        joint = (control.findtext("jointName") or "").strip()
        topic = (control.findtext("cmd_topic") or "").strip()
        if topic.endswith((f"/{joint}/cmd_thrust", f"/{joint}/cmd_vel")):
            where = f"{label}: control of '{joint}'"
            refuse_unknown(control, CONTROL, where)
            factor, offset = number(control, "multiplier", where, 1.0), number(control, "offset", where, 0.0)
            low, high = sorted((factor * offset, factor * (1.0 + offset)))
            ranges[joint] = (low, high)
    return ranges


def read_sdf(path: Path) -> Draft:
    """Read the model of an SDF file.

    Args:
        path: File of a model, or of a world with exactly one model with hydrodynamics. Meshes are in its
            folder or below.

    Raises:
        VehicleError: The file cannot be read; the message states location, expected content and remedy.
    """
    element, world = _model_of(read_xml(path, VehicleError), path)
    return read_model(element, world, path, "SDF of gz-sim")


def read_model(
    element: Element, world: Element | None, path: Path, form: str, packages: Mapping[str, Path] | None = None
) -> Draft:
    """Read a model with the plugin Hydrodynamics of gz-sim.

    Args:
        element: The element `model`.
        world: The world that contains it; None if there is none.
        path: File of the model.
        form: Name of the file's format.
        packages: Name -> folder of packages that may contain its meshes.

    Raises:
        VehicleError: The model cannot be read.
    """
    name = element.get("name", "")
    draft = Draft(str(path), f"{path.name}, model {name} ({form})")
    model = Model(element, str(path), draft, packages)
    plugins: dict[str, list[Element]] = {}
    for plugin in element.findall("plugin"):
        plugins.setdefault(kind_of(plugin), []).append(plugin)
    hydrodynamics = plugins["Hydrodynamics"]
    if len(hydrodynamics) > 1:
        raise VehicleError(
            f"{path}: {len(hydrodynamics)} plugins Hydrodynamics, expected one: a vehicle is one body"
        )
    base = model.text(hydrodynamics[0], "link_name")
    model.set_body(base, "plugin Hydrodynamics")
    thrusters = plugins.get("Thruster", [])
    if not thrusters:
        raise VehicleError(f"{path}: has no plugin Thruster, expected one or more: add them")

    draft.values |= {
        "title": f"{name} (gz-sim)",
        "description": f"Read by FinsSim from {path.name}, a model of gz-sim.",
    }
    links = _put_water(model, world, plugins, draft)
    put_body(model, draft)
    shapes = shapes_of(model)
    for mesh in element.findall("link/collision/geometry/mesh"):
        if (mesh.findtext("scale") or "1 1 1").split() != ["1", "1", "1"]:
            file = (mesh.findtext("uri") or "").rpartition("/")[2]
            draft.different.append(f"{file}: its volume is taken with its scale, which Buoyancy leaves out")
    wet = [shape for shape in shapes if shape.link in links]
    note = f"{len(wet)} collision shape{'s' if len(wet) > 1 else ''}, as the plugin Buoyancy takes them"
    lifts = [(shape.volume, shape.pose.place) for shape in wet]
    put_displacement(lifts, draft.values["water"]["density"], note, draft)
    if lifts and draft.values["body"]["displaced_volume"] > 0.0:
        put_hull(wet, draft)
    _put_hydrodynamics(model, hydrodynamics[0], base, draft)
    put_physical_inertia(draft)
    _put_thrusters(model, thrusters, _ranges(plugins.get("ArduPilotPlugin", []), str(path)), draft)
    put_envelope(draft, [shape.corners for shape in shapes])
    put_controlled_axes(draft)
    turned = {model.text(plugin, "joint_name") for plugin in thrusters}
    turned |= _put_fins(model, plugins.get("LiftDrag", []), draft)
    acting = dict.fromkeys(WRENCHES, " (its forces are left out)")
    acting["ArduPilotPlugin"] = " but for the ranges of its commands"
    note_rest(model, plugins, {"Hydrodynamics", "Thruster", "LiftDrag"}, acting, turned)
    for child in () if world is None else world:
        kind = f" {kind_of(child)}" if child.tag == "plugin" else ""
        if child is not element and child.tag != "gravity" and kind != " Buoyancy":
            draft.not_read[f"world: {child.tag}{kind}"] += 1
    return draft


def _recognises(path: Path, head: bytes) -> bool:
    return b"<sdf" in head or path.suffix.lower() == ".sdf"


SDF = Importer("vehicle", "SDF of gz-sim (.sdf, .world)", _recognises, read_sdf)
