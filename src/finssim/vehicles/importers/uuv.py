"""Reader of uuv_simulator's plugins: UnderwaterObject with its hydrodynamic models, Thruster and Fin.

Equations as of commit bfb40cb, about the centre of gravity c of the base link and all links fixed to it, where Gazebo
applies wrenches, although it evaluates the velocity at the link's origin; v is in axes forward, right, down:

    force = (DLin + u DLinForward + diag(DQuad |v|)) v - Ma v_dot - C_A(Ma v) v     D is negative
    buoyancy = density g volume at c + center_of_buoyancy;  mass g where neutrally_buoyant
    thrust = thrust_efficiency f(propeller_efficiency w), w from gain times the command, along the axis of the joint
    lift = lift_constant V² a, drag = drag_constant V² a² (or cla, cda of an area) by the angle of attack a of a fin

The factors and offsets of these (`scaling_damping`, `offset_volume`, ...) are set at run time, not in files.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.core.yaml_file import read_mapping
from finssim.vehicles.importers.draft import GRAVITY, LAG, Draft, put_controlled_axes, put_envelope
from finssim.vehicles.importers.elements import Element, flag, number, numbers, refuse_unknown
from finssim.vehicles.importers.model import (
    Model,
    note_rest,
    put_body,
    put_displacement,
    put_hull,
    put_physical_inertia,
    shapes_of,
)
from finssim.vehicles.importers.rigid import combined, flu_of_frd, plain
from finssim.vehicles.importers.sdf import axis_of_joint
from finssim.vehicles.importers.thrust_curve import (
    ThrustCurve,
    dead_zone,
    interpolated,
    put_curve,
    quadratic,
    scaled,
    steady_speed,
)
from finssim.vehicles.part import VehicleError

__all__ = ["PLUGINS", "coefficients", "conversion", "read_uuv"]

Array = NDArray[np.float64]

OBJECT, THRUSTER, FIN = "underwater_object", "thruster", "fin"
PLUGINS = tuple(
    f"lib{prefix}{name}{ros}_plugin.so"
    for prefix in ("uuv_", "")  # older versions have no prefix
    for name in (OBJECT, THRUSTER)
    for ros in ("_ros", "")
)
"""File names of the supported plugins."""
FACTORS = {
    f"{word}_{what}"
    for word in ("scaling", "offset")
    for what in (
        "volume",
        "added_mass",
        "damping",
        "linear_damping",
        "lin_forward_speed_damping",
        "nonlin_damping",
    )
}
"""Parameters that uuv_simulator receives from its services, not from a file."""
WORDS = {
    "plugin": {"fluid_density", "flow_velocity_topic", "debug", "link", "use_global_current", "robotNamespace"},
    "link": {"neutrally_buoyant", "volume", "box", "center_of_buoyancy", "hydrodynamic_model"},
    "box": {"width", "length", "height"},
    "hydrodynamic_model": {
        "type", "added_mass", "linear_damping", "linear_damping_forward_speed", "quadratic_damping", "radius",
        "length", "axis", *FACTORS,
    },
    "thruster": {
        "linkName", "jointName", "thrusterID", "gain", "clampMin", "clampMax", "thrustMin", "thrustMax",
        "thrust_efficiency", "propeller_efficiency", "dynamics", "conversion", "robotNamespace",
    },
    "fin": {
        "dynamics", "liftdrag", "current_velocity_topic", "fin_id", "link_name", "joint_name", "input_topic",
        "output_topic", "robotNamespace",
    },
}  # fmt: skip
"""Element -> its child elements."""
SURFACE = ("metacentric_width", "metacentric_length", "submerged_height")
"""Child elements of a surface vessel."""
DENSITY = 1028.0
"""Default density of a plugin, and density in the models of a sphere and a cylinder [kg/m³]."""


def coefficients(hydrodynamics: Element, box: Sequence[float] | None, where: str) -> dict[str, Array]:
    """Return added mass, linear, forward-speed and quadratic damping, positive, in axes forward, right, down.

    Args:
        hydrodynamics: The element `hydrodynamic_model`.
        box: Width, length and height of the link [m]; None if they are not given.
        where: Name of the element in messages.

    Returns:
        `added_mass` [kg, kg m, kg m²], `linear_damping` [N s/m, ...], `surge_damping` and `quadratic_damping`
        [N s²/m², ...], (6, 6) each.
    """
    words = {
        "added_mass": 1.0, "linear_damping": -1.0, "linear_damping_forward_speed": -1.0, "quadratic_damping": -1.0
    }  # fmt: skip
    out = {}
    for word, sign in words.items():
        text = hydrodynamics.findtext(word) or "0 0 0 0 0 0"
        full = len(text.split()) == 36 or word == "added_mass" and hydrodynamics.find(word) is not None
        values = numbers(text, 36 if full else 6, f"{where}: {word}")
        matrix = values.reshape(6, 6) if full else np.diag(values)
        out["surge_damping" if word.endswith("speed") else word] = sign * matrix
    out["quadratic_damping"] = np.diag(np.diag(out["quadratic_damping"]))

    def size(word: str, choose: Callable[[Sequence[float]], float]) -> float:
        if hydrodynamics.find(word) is None and box is not None:
            return choose(box)
        return number(hydrodynamics, word, where)

    kind = (hydrodynamics.findtext("type") or "").strip()
    M, D = out["added_mass"], out["quadratic_damping"]
    linear = range(3)
    if kind == "sphere":
        r = size("radius", min)
        M[linear, linear] = 2.0 / 3.0 * DENSITY * math.pi * r**3
        D[linear, linear] = 0.5 * DENSITY * 0.5 * math.pi * r**2
    elif kind == "cylinder":
        r, length = size("radius", min), size("length", max)
        along = (hydrodynamics.findtext("axis") or "").strip()
        if along not in ("i", "j", "k"):
            raise VehicleError(f"{where}: axis is '{along}', expected i, j or k: add it")
        ratio, disc = length / (2.0 * r), math.pi * r**2
        ends = ((1, 0.91), (2, 0.85), (4, 0.87), (math.inf, 0.99))
        sides = ((1, 0.63), (2, 0.68), (5, 0.74), (10, 0.82), (math.inf, 0.98))
        end, side = (next(c for limit, c in pairs if ratio <= limit) for pairs in (ends, sides))
        for i in linear:
            ahead = i == "ijk".index(along)
            M[i, i] = DENSITY * disc * (1.0 if ahead else length)
            D[i, i] = 0.5 * DENSITY * (end * disc if ahead else side * r * length)
            if not ahead:
                M[3 + i, 3 + i] = DENSITY * disc * length**3 / 12.0
    elif kind != "fossen":
        unfinished = ", which uuv_simulator itself leaves unfinished" if kind in ("spheroid", "box") else ""
        raise VehicleError(
            f"{where}: type is '{kind}'{unfinished}, expected one of fossen, sphere, cylinder: change it"
        )
    for word, matrix in out.items():
        if np.diag(matrix).min() < 0.0:
            raise VehicleError(
                f"{where}: {word} has a diagonal number of the wrong sign, expected added mass >= 0 and damping "
                "<= 0: change its sign"
            )
    if not np.allclose(M, M.T, rtol=1e-2, atol=1e-9):
        raise VehicleError(f"{where}: added_mass is not symmetric: give each coupling in both places")
    return out


def conversion(element: Element, where: str) -> ThrustCurve:
    """Return the thrust curve of an element `conversion`; `where` is its name in messages."""
    kind = (element.findtext("type") or "").strip()
    words = {
        "Basic": ("rotorConstant",),
        "Bessa": ("rotorConstantL", "rotorConstantR", "deltaL", "deltaR"),
        "LinearInterp": ("inputValues", "outputValues"),
    }
    if kind not in words:
        raise VehicleError(f"{where}: type is '{kind}', expected one of {', '.join(words)}: correct it")
    refuse_unknown(element, {"type", *words[kind]}, where)
    if kind == "LinearInterp":
        count = len((element.findtext("inputValues") or "").split())
        columns = [numbers(element.findtext(word), count, f"{where}: {word}") for word in words[kind]]
        return interpolated(columns[0], columns[1], where)
    values = [number(element, word, where) for word in words[kind]]
    if kind == "Basic":  # the sign of rotorConstant only states the direction of rotation
        return quadratic(abs(values[0]), abs(values[0]), where)
    return dead_zone(*values, where)


def _response(element: Element, where: str) -> tuple[float | None, Callable[[float], float], str]:
    """Return time constant [s], steady rotor speed [rad/s] of an input, and the source of the time constant."""
    kind = (element.findtext("type") or "").strip()

    def of(word: str) -> float:
        return number(element, word, where)

    if kind == "FirstOrder":
        return of("timeConstant"), lambda u: u, "timeConstant"
    if kind == "ZeroOrder":
        return None, lambda u: u, "thrust of the dynamics ZeroOrder follows at once"
    if kind == "Yoerger":
        return None, steady_speed(of("beta"), 0.0, of("alpha"), where), "the dynamics Yoerger have none"
    if kind == "Bessa":
        steady = steady_speed(of("Kt") / of("Rm"), of("Kv1"), of("Kv2"), where)
        return None, steady, "the dynamics Bessa have none"
    raise VehicleError(
        f"{where}: type is '{kind}', expected one of ZeroOrder, FirstOrder, Yoerger, Bessa: correct it"
    )


def _put_thruster(model: Model, plugin: Element, name: str, managed: float | None, draft: Draft) -> str:
    """Set a thruster, and return the name of its joint."""
    where, path = f"{model.label}: thruster {name}", f"thrusters.{name}"
    refuse_unknown(plugin, WORDS["thruster"], where)
    parts = [plugin.find(word) for word in ("dynamics", "conversion")]
    if None in parts:
        raise VehicleError(f"{where}: dynamics or conversion is missing: add it")
    joint, link = model.text(plugin, "jointName"), model.link_of(model.text(plugin, "linkName"))
    if joint not in model.joints:
        raise VehicleError(f"{where}: no joint '{joint}': correct it")
    lag, steady, how = _response(parts[0], f"{where}: dynamics")
    push, turn = (number(plugin, f"{word}_efficiency", where, 1.0) for word in ("thrust", "propeller"))
    gain = number(plugin, "gain", where, 1.0)
    if not (0.0 < push <= 1.0 and 0.0 < turn <= 1.0) or gain == 0.0:
        raise VehicleError(f"{where}: expected a gain other than 0 and efficiencies above 0 and up to 1")
    curve = scaled(conversion(parts[1], f"{where}: conversion"), push, turn)

    inertial = model.links[link].find("inertial")
    place = (model.pose(link) if inertial is None else model.pose_in(link, inertial, where)).place
    axis = numbers(model.joints[joint].findtext("axis/xyz"), 3, f"{where}: axis of '{joint}'")
    if np.linalg.norm(axis) < 1e-6:
        raise VehicleError(f"{where}: axis of '{joint}' is {axis.tolist()}, expected a direction")
    draft.put(f"{path}.position", plain(place), "derived", "centre of gravity of the thruster's link")
    draft.put(f"{path}.axis", plain(axis_of_joint(model.pose(joint), axis)), "derived", "axis of the joint")

    none = (-math.inf, math.inf)
    ends = {}
    for kind in ("clamp", "thrust"):
        pair = tuple(
            number(plugin, f"{kind}{end}", where, x) for end, x in zip(("Min", "Max"), none, strict=True)
        )
        ends[kind] = pair if pair[0] < pair[1] else none  # uuv_simulator ignores reversed limits
    low, high = sorted(
        curve.thrust(steady(gain * u)) if math.isfinite(u) else gain * u for u in ends["clamp"]
    )
    greatest = math.inf if managed is None else managed
    low, high = max(low, ends["thrust"][0], -greatest), min(high, ends["thrust"][1], greatest)
    origin = "thruster" if managed is None else "thruster and of the thruster manager"
    put_curve(draft, name, curve, low, high, f"limits of the {origin}")
    if lag is not None:
        draft.put(f"{path}.time_constant", lag, "published", how)
    else:
        draft.guess(f"{path}.time_constant", LAG, how)
    return joint


SLOPE = 3.0
"""Guessed lift slope of a fin whose area is not in the file [1/rad]; only their product matters."""
ENDLESS = 1.5
"""Stall angle of a fin whose lift increases with the angle up to 90° [rad]."""


def _put_fin(model: Model, plugin: Element, draft: Draft) -> str:
    """Set a fin, whose span and chord are the z and x axes of its link, and return the name of its joint."""
    name = f"fin_{(plugin.findtext('fin_id') or '').strip()}"
    where, path = f"{model.label}: {name.replace('_', ' ')}", f"actuators.{name}"
    if not re.fullmatch(r"fin_\d{1,9}", name) or name in draft.values.get("actuators", {}):
        raise VehicleError(f"{where}: expected fins of different integers as fin_id: correct it")
    refuse_unknown(plugin, WORDS["fin"], where)
    dynamics, law = plugin.find("dynamics"), plugin.find("liftdrag")
    if dynamics is None or law is None:
        raise VehicleError(f"{where}: dynamics or liftdrag is missing: add it")
    joint, link = model.text(plugin, "joint_name"), model.link_of(model.text(plugin, "link_name"))
    if joint not in model.joints:
        raise VehicleError(f"{where}: no joint '{joint}': correct it")
    lag, _, _ = _response(dynamics, f"{where}: dynamics")
    draft.put(f"{path}.kind", "fin")
    pose, inertial = model.pose(link), model.links[link].find("inertial")
    place = pose if inertial is None else model.pose_in(link, inertial, where)
    draft.put(f"{path}.position", plain(place.place), "derived", "centre of gravity of the fin's link")
    for key, column in (("span", 2), ("chord", 0)):
        draft.put(f"{path}.{key}", plain(pose.turn[:, column]), "derived", "axes of the fin's link")
    low, high = (float(model.joints[joint].get(end, "0")) for end in ("lower", "upper"))
    if low <= 0.0 <= high and low < high:
        draft.put(f"{path}.minimum", low)
        draft.put(f"{path}.maximum", high)
    else:
        for key, sign in (("minimum", -1.0), ("maximum", 1.0)):
            draft.guess(f"{path}.{key}", sign * 0.5, "the joint has no travel around 0 in the file")
    draft.put(f"{path}.time_constant", 0.0 if lag is None else lag)
    for key, value, guessed in _lift(law, f"{where}: liftdrag", draft):
        if guessed:
            draft.guess(f"{path}.{key}", value, guessed)
        else:
            draft.put(f"{path}.{key}", value, "derived", "lift and drag of the fin")
    return joint


def _lift(law: Element, where: str, draft: Draft) -> list[tuple[str, Any, str]]:
    """Return key of a fin, its value, and how it was guessed (empty if it was not), from an element `liftdrag`."""
    kind, density = (law.findtext("type") or "").strip(), draft.values["water"]["density"]

    def of(word: str) -> float:
        return number(law, word, where)

    if kind == "Quadratic":
        refuse_unknown(law, {"type", "lift_constant", "drag_constant"}, where)
        lift, drag, area = of("lift_constant"), of("drag_constant"), 0.0
        area = 2.0 * lift / (density * SLOPE)
        if lift <= 0.0 or drag < 0.0:
            raise VehicleError(f"{where}: expected a lift_constant above 0 and a drag_constant of 0 or more")
        how = f"the file has their product alone: a slope of {SLOPE:g}"
        return [("area", area, how), ("lift_slope", SLOPE, how), ("stall", ENDLESS, ""),
                ("drag", [0.0, 0.0, 2.0 * drag / (density * area)], "")]  # fmt: skip
    if kind != "TwoLines":
        raise VehicleError(f"{where}: type is '{kind}', expected Quadratic or TwoLines: correct it")
    words = ("area", "fluid_density", "a0", "alpha_stall", "cla", "cla_stall", "cda", "cda_stall")
    refuse_unknown(law, {"type", *words}, where)
    ratio, stall = of("fluid_density") / density, of("alpha_stall")
    if of("area") <= 0.0 or of("cla") * ratio <= 0.0 or stall <= 0.0:
        raise VehicleError(f"{where}: expected area, fluid_density, alpha_stall and cla above 0")
    if of("a0"):
        draft.different.append("a0: a fin has no lift at deflection 0 straight ahead")
    sentence = "beyond the stall the lift of a fin falls to 0 at 90°, by no cla_stall of the file"
    if sentence not in draft.different:
        draft.different.append(sentence)
    return [("area", of("area"), ""), ("lift_slope", of("cla") * ratio, ""), ("stall", min(stall, ENDLESS), ""),
            ("drag", [0.0, abs(of("cda")) * ratio, 0.0], "")]  # fmt: skip


def _managed(model: Model, base: str) -> float | None:
    """Return the greatest thrust in the thruster manager's file of this robot, near it [N]; None if there is none."""
    robot = base.rpartition("/")[0] or model.element.get("name", "")
    for folder in model.packages.values():
        for pattern in ("config/thruster_manager.yaml", "config/*/thruster_manager.yaml"):
            for file in sorted(folder.glob(pattern)) if folder.name else ():
                try:
                    manager = read_mapping(file, VehicleError, such_as="max_thrust: 20").get(
                        "thruster_manager", {}
                    )
                except VehicleError:
                    continue
                if isinstance(manager, dict) and manager.get("tf_prefix") == robot:
                    greatest = manager.get("max_thrust")
                    if isinstance(greatest, int | float) and greatest > 0.0:
                        return float(greatest)
    return None


def _put_buoyancy(
    model: Model, links: Mapping[str, Element], base: str, draft: Draft
) -> dict[str, list[float]]:
    """Set the displacement of the links, and return the size of each link's box: width, length and height [m].

    Args:
        model: Robot.
        links: Name -> element of each link of the underwater object.
        base: Name of the link that has the hydrodynamics.
        draft: Vehicle with a known density of water.

    Raises:
        VehicleError: A link is a surface vessel, is not in the robot, or cannot be read.
    """
    density = draft.values["water"]["density"]
    lifts, boxes = [], {}
    for link, words in links.items():
        where = f"{draft.label}: underwater object, link '{link}'"
        if any(words.find(word) is not None for word in SURFACE):
            raise VehicleError(f"{where}: is a surface vessel ({SURFACE[0]}), expected a submerged vehicle")
        refuse_unknown(words, WORDS["link"], where)
        if link not in model.links:
            raise VehicleError(f"{where}: the robot has no such link: correct it")
        mass, centre = _fixed(model, link)
        neutral = flag(words, "neutrally_buoyant", where)
        share = mass / density if neutral else number(words, "volume", where, 0.0)
        offset = numbers(words.findtext("center_of_buoyancy") or "0 0 0", 3, f"{where}: center_of_buoyancy")
        lifts.append((share, centre + model.pose(link).turn @ offset))
        box = words.find("box")
        if box is not None:
            refuse_unknown(box, WORDS["box"], where)
            boxes[link] = [number(box, side, where) for side in ("width", "length", "height")]
        if link != base:
            draft.not_read[f"hydrodynamics of link {link} (its buoyancy is read)"] += 1
    put_displacement(
        lifts, density, "volume, or mass where neutrally_buoyant; from the centre of gravity", draft
    )
    return boxes


def _put_hydrodynamics(model: Model, link: Element, base: str, box: list[float] | None, draft: Draft) -> None:
    """Set added mass and damping.

    Args:
        model: Robot.
        link: Element of the link in the underwater object.
        base: Name of the link.
        box: Width, length and height of its box [m], if it has one.
        draft: Vehicle.

    Raises:
        VehicleError: They are missing or cannot be read.
    """
    _, centre = _fixed(model, base)
    where = f"{draft.label}: hydrodynamic_model of '{base}'"
    hydrodynamics = link.find("hydrodynamic_model")
    if hydrodynamics is None:
        raise VehicleError(f"{where} is missing: add it")
    refuse_unknown(hydrodynamics, WORDS["hydrodynamic_model"], where)
    for word, matrix in coefficients(hydrodynamics, box, where).items():
        turned = (matrix + matrix.T) / 2.0 if word == "added_mass" else matrix
        if word != "surge_damping" or np.any(matrix):
            draft.put(f"hydrodynamics.calibrated.{word}", plain(flu_of_frd(turned)))
    draft.put(
        "hydrodynamics.calibrated.reference_point", plain(centre), "derived", "centre of gravity of base_link"
    )
    _note_differences(hydrodynamics, centre, draft)


def read_uuv(element: Element, path: Path, packages: Mapping[str, Path]) -> Draft:
    """Read a model with the plugins of uuv_simulator.

    Args:
        element: The element `model`.
        path: File of the model.
        packages: Name -> folder of packages that may contain its meshes.

    Raises:
        VehicleError: The model cannot be read.
    """
    name = element.get("name", "")
    draft = Draft(str(path), f"{path.name}, robot {name} (uuv_simulator)")
    model = Model(element, str(path), draft, packages)
    plugins: dict[str, list[Element]] = {}
    for plugin in element.findall("plugin"):
        kind = plugin.get("filename", "").removeprefix("lib").removesuffix(".so").removesuffix("_plugin")
        plugins.setdefault(kind.removesuffix("_ros").removeprefix("uuv_"), []).append(plugin)
    objects, thrusters = plugins.get(OBJECT, []), plugins.get(THRUSTER, [])
    if len(objects) != 1 or not thrusters:
        raise VehicleError(
            f"{path}: {len(objects)} plugins of underwater objects and {len(thrusters)} thrusters, expected 1 and more"
        )
    refuse_unknown(objects[0], WORDS["plugin"], f"{path}: underwater object")
    links = {link.get("name", ""): link for link in objects[0].findall("link")}
    base = next((link for link in links if "base_link" in link), next(iter(links), ""))
    model.set_body(base, "underwater object")
    draft.values |= {
        "title": f"{name} (uuv_simulator)",
        "description": f"Read by FinsSim from {path.name}, a robot of uuv_simulator.",
    }
    draft.guess("water.gravity", GRAVITY, "it is in the file of a world: that of Gazebo")
    if objects[0].find("fluid_density") is None:
        draft.guess("water.density", DENSITY, "the file gives none: that of uuv_simulator")
    else:
        draft.put("water.density", number(objects[0], "fluid_density", f"{path}: underwater object"))
    put_body(model, draft)
    boxes = _put_buoyancy(model, links, base, draft)
    _put_hydrodynamics(model, links[base], base, boxes.get(base), draft)
    managed = _managed(model, base)
    names = [f"thruster_{(plugin.findtext('thrusterID') or '').strip()}" for plugin in thrusters]
    if len(set(names)) < len(names) or not all(n[9:].isdigit() and len(n) < 20 for n in names):
        raise VehicleError(
            f"{path}: thrusterID are {', '.join(n[9:] for n in names)}, expected different integers"
        )
    turning = {_put_thruster(model, p, n, managed, draft) for p, n in zip(thrusters, names, strict=True)}
    turning |= {_put_fin(model, plugin, draft) for plugin in plugins.get(FIN, [])}
    try:
        shapes = shapes_of(model)
    except VehicleError as error:
        shapes = []
        draft.not_read[f"collision shapes ({str(error).removeprefix(f'{path}: ')})"] += 1
    put_hull([shape for shape in shapes if shape.link == base], draft)
    put_physical_inertia(draft)
    if base in boxes:
        width, length, height = boxes[base]
        draft.put("body.size", [length, width, height], "published", "box")
        draft.put("body.surface_half_height", height / 2.0, "published", "box")
    else:
        put_envelope(draft, [shape.corners for shape in shapes])
    put_controlled_axes(draft)
    note_rest(model, plugins, {OBJECT, THRUSTER, FIN}, {}, turning)
    return draft


def _fixed(model: Model, link: str) -> tuple[float, Array]:
    """Return mass [kg] and centre of gravity in the body frame [m], (3,), of a link and all links fixed to it."""
    joined = [
        {model.text(joint, "parent"), model.text(joint, "child")}
        for joint in model.joints.values()
        if joint.get("type") == "fixed"
    ]
    held, before = {link}, 0
    while len(held) > before:
        before = len(held)
        held |= {name for pair in joined if held & pair for name in pair}
    masses, centres = [], []
    for name in held:
        inertial = model.links[name].find("inertial")
        if inertial is not None:
            masses.append(number(inertial, "mass", f"{model.label}: link '{name}'"))
            centres.append(model.pose_in(name, inertial, f"{model.label}: link '{name}'").place)
    if sum(masses) <= 0.0:
        raise VehicleError(f"{model.label}: link '{link}' has no mass: add it")
    mass, centre, _ = combined(masses, centres, [np.zeros((3, 3))] * len(masses))
    return mass, centre


def _note_differences(hydrodynamics: Element, centre: Array, draft: Draft) -> None:
    """Note differences between uuv_simulator's computation and FinsSim's."""
    for word in FACTORS & {child.tag for child in hydrodynamics}:
        draft.not_read[f"{word} (uuv_simulator does not read it from a file either)"] += 1
    if len((hydrodynamics.findtext("quadratic_damping") or "").split()) == 36:
        draft.different.append("of quadratic_damping only the diagonal acts, as in uuv_simulator")
    if hydrodynamics.find("linear_damping_forward_speed") is not None:
        draft.different.append(
            "linear_damping_forward_speed: astern uuv_simulator changes its sign, which drives the vehicle"
        )
    if np.abs(centre).max() > 1e-3:
        draft.different.append(
            "the velocity in the water is that of the centre of gravity, in uuv_simulator that of the link's origin"
        )
    if not np.any(draft.values["hydrodynamics"]["calibrated"]["added_mass"]):
        draft.different.append("the added mass is 0 on every axis: a real vehicle accelerates more slowly")
