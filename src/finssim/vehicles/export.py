"""Export of vehicles: SDF and URDF with the plugins Hydrodynamics, Thruster, Buoyancy and, in SDF, LiftDrag of gz-sim.

The frame of the body link is at the reference point of the hydrodynamic coefficients, x forward, y left, z up. Its
only collision shape is a box of the displaced volume at the centre of buoyancy. SDF contains the added mass in
`fluid_added_mass`, for which gz-sim's Coriolis wrench has the correct sign, and is a complete world.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal
from xml.etree.ElementTree import Element, ElementTree, indent

import numpy as np
from numpy.typing import NDArray

from finssim.core.files import atomic_write
from finssim.core.rotations import matrix_to_quat, quat_to_euler
from finssim.vehicles.hydrodynamics import HydrodynamicSet
from finssim.vehicles.importers.rigid import combined
from finssim.vehicles.part import VehicleError
from finssim.vehicles.vehicle import Vehicle

__all__ = ["export_vehicle"]

DIAMETER = 0.1
"""Diameter of every propeller [m]; only its product with the thrust coefficient matters."""
PROPELLER = 1e-4
"""Mass of a propeller or fin as a fraction of the vehicle's, subtracted from the body."""
EFFORT, FASTEST = 100.0, 10.0
"""Torque of a fin's joint [N m], and its rate [rad/s] if the file sets no limit."""
SECTIONS = ("sensors", "perception", "tags", "mcu", "autopilot", "safety", "calibrations")
"""Sections of a vehicle file that these formats cannot represent."""


def export_vehicle(
    vehicle: Vehicle, out: Path, kind: Literal["sdf", "urdf"], hydrodynamics: str = "calibrated"
) -> list[str]:
    """Write a vehicle for gz-sim and return what the format cannot represent, one sentence per item.

    Args:
        vehicle: The vehicle.
        out: File to write.
        kind: Format.
        hydrodynamics: Name of a set with coefficients.

    Raises:
        VehicleError: There is no such set with coefficients.
    """
    chosen = vehicle.hydrodynamic_set(hydrodynamics)
    if not isinstance(chosen, HydrodynamicSet):
        raise VehicleError(
            f"{vehicle.name}: the set '{hydrodynamics}' is based on a mesh: name one with coefficients"
        )
    lost = [f"section {name}" for name in SECTIONS if name in vehicle.model_fields_set]
    lost += [f"hydrodynamic set {name}" for name in vehicle.hydrodynamics if name != hydrodynamics]
    lost += [f"hydrodynamic term {name}" for name in chosen.terms]
    part = (
        "force"
        if kind == "urdf"
        else "drag apart from that in proportion to the angle, wake, lag, rate and play"
    )
    lost += [f"{part} of fin {name}, which is a joint with a plate" for name in fins_of(vehicle)]
    lost += [f"{a.kind} {name}" for name, a in vehicle.actuators.items() if a.kind != "fin"]
    lost += [f"inflow of {name}" for name, thruster in vehicle.thrusters.items() if thruster.inflow]
    lost += ["lag, delay and rate limit of thrusters: the thrust of gz-sim follows at once"]
    lost += [
        "shape of the hull, which is a box of the displaced volume, and the layer in which buoyancy fades"
    ]
    if any(t.torque_constant for t in vehicle.thrusters.values()):
        lost.append("reaction torque of propellers")
    if any(t.inflow is not None for t in vehicle.thrusters.values()):
        lost.append("thrust that propellers lose in a flow")
    if any(t.c_plus != t.c_minus for t in vehicle.thrusters.values()):
        lost += ["thrust coefficient of reverse rotation (c_minus): gz-sim has one for both directions"]
    if np.any(chosen.reference_point):
        lost += [f"body origin: the link's frame is at the reference point {chosen.reference_point.tolist()}"]
    if kind == "urdf":
        lost += ["gravity and the plugin Buoyancy, which are a world's"]
        lost += [
            "sign of the Coriolis wrench of the added mass, which gz-sim inverts for a plugin's coefficients"
        ]
    root = _sdf(vehicle, chosen) if kind == "sdf" else _urdf(vehicle, chosen)
    indent(root)
    with atomic_write(out) as temporary:
        ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)
    return lost


def fins_of(vehicle: Vehicle) -> dict[str, Any]:
    """Return the fins of a vehicle by name."""
    return {name: part for name, part in vehicle.actuators.items() if part.kind == "fin"}


def fin_joint(name: str, fin: Any, origin: NDArray[np.float64]) -> Element:
    """Return the joint of a fin in URDF, whose angle is the deflection; its link is NAME_fin.

    Args:
        name: Name of the fin.
        fin: Section of the fin.
        origin: Origin of the body link, body frame [m], (3,).
    """
    fastest = fin.rate_limit if np.isfinite(fin.rate_limit) else FASTEST
    limit = _x("limit", lower=fin.minimum, upper=fin.maximum, effort=EFFORT, velocity=fastest)
    ends = _x("parent", link="base_link"), _x("child", link=f"{name}_fin")
    place = _x("origin", xyz=fin.position - origin, rpy="0 0 0")
    return _x("joint", *ends, place, _x("axis", xyz=fin.span), limit, name=name, type="revolute")


def fin_plate(fin: Any) -> tuple[NDArray[np.float64], Element]:
    """Return roll, pitch and yaw of a fin's plate in its link [rad], (3,), and its visual box, in URDF."""
    axes = np.column_stack([fin.chord, fin.span, np.cross(fin.chord, fin.span)])
    box = _x("geometry", _x("box", size=[*fin.sides, 0.1 * fin.sides[0]]))
    return np.asarray(quat_to_euler(matrix_to_quat(axes))), box


def _numbers(values: Any) -> str:
    return " ".join(repr(float(x)) for x in np.ravel(values))


def _x(tag: str, *content: Any, **attributes: Any) -> Element:
    """Return an element with children, a text, or numbers; attributes are texts or numbers."""
    made = Element(tag, {k: x if isinstance(x, str) else _numbers(x) for k, x in attributes.items()})
    for part in content:
        if isinstance(part, Element):
            made.append(part)
        else:
            made.text = part if isinstance(part, str) else _numbers(part)
    return made


def _links(
    vehicle: Vehicle, origin: NDArray[np.float64]
) -> dict[str, tuple[float, Any, Any, dict[str, float]]]:
    """Return link -> mass [kg], position in the body [m], centre of gravity in the link [m], inertia by name [kg m²].

    The masses of propellers and fins are subtracted from the body's, so that the total mass is that of the vehicle.
    """
    body, mass = vehicle.body, vehicle.body.mass * PROPELLER
    places = {f"{name}_propeller": thruster.position - origin for name, thruster in vehicle.thrusters.items()}
    places |= {f"{name}_fin": fin.position - origin for name, fin in fins_of(vehicle).items()}
    tensor, count = mass * 1e-4 * np.eye(3), len(places)
    centres = [body.center_of_gravity - origin, *places.values()]
    base = combined([body.mass, *[-mass] * count], centres, [body.inertia, *[-tensor] * count])

    def words(matrix: NDArray[np.float64]) -> dict[str, float]:
        return {f"i{'xyz'[i]}{'xyz'[j]}": float(matrix[i, j]) for i in range(3) for j in range(i, 3)}

    links = {"base_link": (base[0], np.zeros(3), base[1], words(base[2]))}
    return links | {name: (mass, place, np.zeros(3), words(tensor)) for name, place in places.items()}


def _plugin(kind: str, **words: Any) -> Element:
    file = "".join(f"-{letter.lower()}" if letter.isupper() else letter for letter in kind)
    children = (_x(word, value) for word, value in words.items())
    return _x("plugin", *children, filename=f"gz-sim{file}-system", name=f"gz::sim::systems::{kind}")


def _plugins(vehicle: Vehicle, chosen: HydrodynamicSet, *, added: bool) -> list[Element]:
    """Return the plugin Hydrodynamics, with or without added mass, and a plugin Thruster for each propeller."""
    density, words = vehicle.water.density, {}
    matrices = {"Dot": chosen.added_mass} if added else {}
    for infix, matrix in (matrices | {"": chosen.linear_damping, "abs": chosen.quadratic_damping}).items():
        for i, j in zip(*np.nonzero(matrix), strict=True):
            velocity = "UVWPQR"[j]
            word = f"{velocity}abs{velocity}" if infix == "abs" else f"{infix}{velocity}"
            words["xyzkmn"[i] + word] = -matrix[i, j]
    plugins = [_plugin("Hydrodynamics", link_name="base_link", water_density=density, **words)]
    for name, thruster in vehicle.thrusters.items():
        dead = thruster.thrust(thruster.dead_rpm_plus * np.pi / 30.0)
        plugins.append(_plugin(
            "Thruster", joint_name=name, thrust_coefficient=thruster.c_plus / (density * DIAMETER**4),
            fluid_density=density, propeller_diameter=DIAMETER, velocity_control="true",
            max_thrust_cmd=thruster.force_max, min_thrust_cmd=thruster.force_min,
            **({"deadband": dead} if dead > 0.0 else {}),
        ))  # fmt: skip
    return plugins


def _lift(vehicle: Vehicle, origin: NDArray[np.float64]) -> list[Element]:
    """Return a plugin LiftDrag for each fin, on its link, and on the body's link if its incidence counts only
    partially.

    Args:
        vehicle: The vehicle.
        origin: Origin of the body link, body frame [m], (3,).
    """
    plugins = []
    for name, fin in fins_of(vehicle).items():
        words: dict[str, Any] = {"link_name": f"{name}_fin"}
        if fin.incidence < 1.0:
            words = {"link_name": "base_link", "cp": fin.position - origin, "control_joint_name": name,
                     "control_joint_rad_to_cl": fin.lift_slope}  # fmt: skip
        words |= {"forward": fin.chord, "upward": np.cross(fin.span, fin.chord), "area": fin.area, "a0": 0.0}
        words |= {"air_density": vehicle.water.density, "cla": fin.incidence * fin.lift_slope}
        plugins.append(_plugin("LiftDrag", **words, cda=fin.drag[1], alpha_stall=fin.stall))
    return plugins


def _geometry(vehicle: Vehicle) -> Any:
    """Return the sides of a box of the displaced volume, with the aspect ratios of the size [m], (3,)."""
    return vehicle.body.size * (vehicle.body.displaced_volume / np.prod(vehicle.body.size)) ** (1.0 / 3.0)


def _sdf(vehicle: Vehicle, chosen: HydrodynamicSet) -> Element:
    origin, parts = chosen.reference_point, []
    level, buoyant = [0.0, 0.0, 0.0], vehicle.body.center_of_buoyancy - origin
    box = _x("geometry", _x("box", _x("size", _geometry(vehicle))))
    pairs = zip(*np.triu_indices(6), strict=True)
    added = _x(
        "fluid_added_mass", *(_x("xyzpqr"[i] + "xyzpqr"[j], chosen.added_mass[i, j]) for i, j in pairs)
    )
    hull = [_x(kind, _x("pose", [*buoyant, *level]), box, name="hull") for kind in ("collision", "visual")]
    plates = {}
    for name, fin in fins_of(vehicle).items():
        size = _x("size", [*fin.sides, 0.1 * fin.sides[0]])
        pose = _x("pose", [0.0, 0.0, 0.0, *fin_plate(fin)[0]])
        plates[f"{name}_fin"] = [_x("visual", pose, _x("geometry", _x("box", size)), name="plate")]
    for name, (mass, place, centre, words) in _links(vehicle, origin).items():
        inertia = _x("inertia", *(_x(word, x) for word, x in words.items()))
        fluid, shapes = ([added], hull) if name == "base_link" else ([], plates.get(name, []))
        inertial = _x("inertial", _x("pose", [*centre, *level]), _x("mass", mass), inertia, *fluid)
        parts.append(_x("link", _x("pose", [*place, *level]), inertial, *shapes, name=name))
    for name, thruster in vehicle.thrusters.items():
        ends = _x("parent", "base_link"), _x("child", f"{name}_propeller")
        parts.append(_x("joint", *ends, _x("axis", _x("xyz", thruster.axis)), name=name, type="revolute"))
    for name, fin in fins_of(vehicle).items():
        ends = _x("parent", "base_link"), _x("child", f"{name}_fin")
        limit = _x("limit", _x("lower", fin.minimum), _x("upper", fin.maximum))
        parts.append(_x("joint", *ends, _x("axis", _x("xyz", fin.span), limit), name=name, type="revolute"))
    plugins = [*_plugins(vehicle, chosen, added=False), *_lift(vehicle, origin)]
    model = _x("model", *parts, *plugins, name=vehicle.name)
    gravity = _x("gravity", [0.0, 0.0, -vehicle.water.gravity])
    engine = [_plugin(kind) for kind in ("Physics", "UserCommands", "SceneBroadcaster")]
    buoyancy = _plugin("Buoyancy", uniform_fluid_density=vehicle.water.density)
    return _x("sdf", _x("world", gravity, *engine, buoyancy, model, name="water"), version="1.10")


def _urdf(vehicle: Vehicle, chosen: HydrodynamicSet) -> Element:
    origin, parts = chosen.reference_point, []
    box = _x("geometry", _x("box", size=_geometry(vehicle)))
    buoyant = _x("origin", xyz=vehicle.body.center_of_buoyancy - origin, rpy="0 0 0")
    links, fins = _links(vehicle, origin), {f"{name}_fin": fin for name, fin in fins_of(vehicle).items()}
    for name, (mass, _, centre, words) in links.items():
        inertial = _x(
            "inertial", _x("origin", xyz=centre, rpy="0 0 0"), _x("mass", value=mass), _x("inertia", **words)
        )
        shapes = [_x(kind, buoyant, box) for kind in ("collision", "visual")] if name == "base_link" else []
        if name in fins:
            turned, plate = fin_plate(fins[name])
            shapes = [_x("visual", _x("origin", xyz="0 0 0", rpy=turned), plate)]
        parts.append(_x("link", inertial, *shapes, name=name))
    for name, thruster in vehicle.thrusters.items():
        ends = _x("parent", link="base_link"), _x("child", link=f"{name}_propeller")
        place = _x("origin", xyz=links[f"{name}_propeller"][1], rpy="0 0 0")
        parts.append(_x("joint", *ends, place, _x("axis", xyz=thruster.axis), name=name, type="continuous"))
    parts += [fin_joint(name, fin, origin) for name, fin in fins_of(vehicle).items()]
    return _x("robot", *parts, _x("gazebo", *_plugins(vehicle, chosen, added=True)), name=vehicle.name)
