"""gz-sim's equations of an underwater vehicle, in float64 and independent of the importer, and SDF of such vehicles.

The numbers are those of public models; the files are written here.
"""

from dataclasses import dataclass, field, replace
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np

FORCES, VELOCITIES = "xyzkmn", "UVWPQR"


@dataclass
class Model:
    """Numbers of a model: a body with one box that displaces water, and further links."""

    name: str
    mass: float
    inertia: tuple
    """ixx, iyy, izz of the base link [kg m²]."""
    com: tuple
    box: tuple
    box_at: tuple
    coefficients: dict
    """Word of the plugin Hydrodynamics -> number."""
    thrusters: list
    """Pose (6,), axis (3,) and thrust coefficient of each thruster."""
    prop: tuple = (0.002, (0.001, 0.001, 0.001))
    """Mass and inertia of a propeller's link."""
    diameter: float = 0.1
    density: float = 1000.0
    gravity: float = 9.8
    extras: list = field(default_factory=list)
    """Further links: position, mass, inertia, box."""
    fluid: dict = field(default_factory=dict)
    """Added mass of the base link: word of `fluid_added_mass` -> number."""


def _vectored(x, y, yaw, spin):
    return ((x, y, 0.0, -1.571, 1.571, yaw), (0, 0, -1), spin * 0.02)


def _vertical(x, y, z, spin):
    return ((x, y, z, 0.0, 0.0, 0.0), (0, 0, -1), spin * 0.02)


def _drag(*values):
    words = [f"{f}{v}abs{v}" for f, v in zip(FORCES, VELOCITIES, strict=True)]
    return dict(zip(words, values, strict=True))


VECTORED = [
    _vectored(0.14, -0.092, -0.785, 1),
    _vectored(0.14, 0.092, -2.356, 1),
    _vectored(-0.15, -0.092, 0.785, -1),
    _vectored(-0.15, 0.092, 2.356, -1),
]
HEAVY = Model(
    "heavy", 13.0, (0.26, 0.23, 0.37), (0, 0, 0.011), (0.457, 0.575, 0.05), (0, 0, 0.06),
    _drag(-58.42, -55.137, -124.818, -4.0, -4.0, -4.0),
    VECTORED + [_vertical(x, y, 0.064, s) for x, y, s in
                ((0.118, -0.215, 1), (0.118, 0.215, -1), (-0.118, -0.215, -1), (-0.118, 0.215, 1))],
)  # fmt: skip
"""clydemcqueen/bluerov2_gz, models/bluerov2_heavy, commit e21e884."""
BASE = Model(
    "base", 10.0, (0.099, 0.178, 0.269), (0, 0, 0.011), (0.457, 0.338, 0.065), (0, 0, 0.06),
    _drag(-33.732, -54.16, -73.225, -3.992, -3.992, -3.992),
    VECTORED + [_vertical(0.0, y, 0.077, s) for y, s in ((-0.109, 1), (0.109, -1))],
    density=998.0,
)  # fmt: skip
"""clydemcqueen/bluerov2_gz, models/bluerov2, commit e21e884."""
TETHYS = Model(
    "tethys", 147.8671, (3.0, 41.980233, 41.980233), (0, 0, -0.01), (2.0, 0.3, 0.246445166667), (0, 0, 0),
    _drag(-6.2282, -601.27, -601.27, -0.1916, -632.698957, -632.698957),
    [((-1.05, 0.0, 0.0, 0.0, 1.5707963267948966, 0.0), (0, 0, 1), 0.004422)], diameter=0.2,
    extras=[((1.05, 0.0, 0.0), 0.2, (0.0008, 0.001, 0.0003), (0.1, 0.1, 0.02))] * 2,
    fluid={"xx": 4.876161, "yy": 126.324739, "zz": 126.324739, "qq": 33.46, "rr": 33.46},
)  # fmt: skip
"""gazebosim/gz-sim, test/worlds/hydrodynamics_flags.sdf and examples/worlds/auv_controls.sdf, commit 93bbf3e; its
centre of gravity is 1 cm lower, so that it is stable, and its added mass is that of the link, as the plugin advises."""
EXPLICIT = replace(
    TETHYS, name="explicit", fluid={},
    coefficients=TETHYS.coefficients | {"xDotU": -4.876161, "yDotV": -126.324739, "zDotW": -126.324739, "kDotP": 0.0,
                                        "mDotQ": -33.46, "nDotR": -33.46},
)  # fmt: skip
"""The same vehicle with the added mass in the plugin, as in the files."""


def element(parent, tag, value=None, **attributes):
    child = SubElement(parent, tag, attributes)
    if value is not None:
        child.text = (
            value if isinstance(value, str) else " ".join(repr(float(x)) for x in np.atleast_1d(value))
        )
    return child


def _link(model, name, mass, inertia, com, pose=None):
    link = element(model, "link", name=name)
    if pose is not None:
        element(link, "pose", pose)
    inertial = element(link, "inertial")
    element(inertial, "pose", (*com, 0, 0, 0))
    element(inertial, "mass", mass)
    tensor = element(inertial, "inertia")
    for tag, value in zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), (inertia[0], 0, 0, inertia[1], 0, inertia[2]),
                          strict=True):  # fmt: skip
        element(tensor, tag, value)
    return link


def _collision(link, size, pose):
    collision = element(link, "collision", name="box")
    element(collision, "pose", (*pose, 0, 0, 0))
    element(element(element(collision, "geometry"), "box"), "size", size)


def _joint(model, name, child, kind, axis=None, parent="base_link"):
    joint = element(model, "joint", name=name, type=kind)
    element(joint, "parent", parent)
    element(joint, "child", child)
    if axis is not None:
        element(element(joint, "axis"), "xyz", axis)


def plugin(model, kind, **words):
    made = element(
        model, "plugin", name=f"gz::sim::systems::{kind}", filename=f"gz-sim-{kind.lower()}-system"
    )
    for word, value in words.items():
        element(made, word, value)
    return made


def tree(m):
    """Return the `sdf` element of a model, and its `model`."""
    root = Element("sdf", version="1.9")
    world = element(root, "world", name="water")
    element(world, "gravity", (0, 0, -m.gravity))
    plugin(world, "Buoyancy", uniform_fluid_density=m.density)
    model = element(world, "model", name=m.name)
    base = _link(model, "base_link", m.mass, m.inertia, m.com)
    if m.fluid:
        fluid = element(base.find("inertial"), "fluid_added_mass")
        for word, value in m.fluid.items():
            element(fluid, word, value)
    _collision(base, m.box, m.box_at)
    for i, (place, mass, inertia, box) in enumerate(m.extras):
        link = _link(model, f"part{i}", mass, inertia, (0, 0, 0), (*place, 0, 0, 0))
        _collision(link, box, (0, 0, 0))
        _joint(model, f"part{i}_joint", f"part{i}", "fixed")
    plugin(model, "Hydrodynamics", link_name="base_link", **m.coefficients)
    for i, (pose, axis, coefficient) in enumerate(m.thrusters):
        _link(model, f"prop{i}", m.prop[0], m.prop[1], (0, 0, 0), pose)
        _joint(model, f"t{i}", f"prop{i}", "revolute", axis)
        plugin(model, "Thruster", joint_name=f"t{i}", thrust_coefficient=coefficient, fluid_density=m.density,
               propeller_diameter=m.diameter, velocity_control="true", max_thrust_cmd=50.0,
               min_thrust_cmd=-50.0)  # fmt: skip
    return root, model


def write(path, m):
    """Write the SDF of a model."""
    path.write_bytes(tostring(tree(m)[0]))
    return path


def euler(roll, pitch, yaw):
    """Return Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    return z @ y @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])


class Origin:
    """Motion of a model by gz-sim's equations, about the origin of its base link, in body axes."""

    def __init__(self, m):
        def S(r):
            return np.array([[0, -r[2], r[1]], [r[2], 0, -r[0]], [-r[1], r[0], 0]])

        parts = [(m.mass, np.diag(m.inertia), np.array(m.com, float))]
        parts += [(mass, np.diag(inertia), np.array(place, float)) for place, mass, inertia, _ in m.extras]
        for pose, _, _ in m.thrusters:
            R = euler(*pose[3:])
            parts.append((m.prop[0], R @ np.diag(m.prop[1]) @ R.T, np.array(pose[:3], float)))
        self.rigid = np.zeros((6, 6))
        for mass, tensor, r in parts:
            self.rigid += np.block(
                [[mass * np.eye(3), -mass * S(r)], [mass * S(r), tensor - mass * S(r) @ S(r)]]
            )
        self.weights = [(mass * m.gravity, r) for mass, _, r in parts]
        boxes = [(np.prod(m.box), m.box_at)] + [(np.prod(box), place) for place, _, _, box in m.extras]
        self.lifts = [(m.density * m.gravity * volume, np.array(r, float)) for volume, r in boxes]
        self.Ma, self.implicit = np.zeros((6, 6)), np.zeros((6, 6))
        for word, value in m.fluid.items():
            i, j = ("xyzpqr".index(letter) for letter in word)
            self.implicit[i, j] = self.implicit[j, i] = value
        self.linear, self.absolute = np.zeros((6, 6)), np.zeros((6, 6, 6))
        for i, force in enumerate(FORCES):
            for j, first in enumerate(VELOCITIES):
                self.Ma[i, j] = m.coefficients.get(f"{force}Dot{first}", 0.0)
                self.linear[i, j] = m.coefficients.get(f"{force}{first}", 0.0)
                for k, second in enumerate(VELOCITIES):
                    self.absolute[i, j, k] = m.coefficients.get(f"{force}{first}abs{second}", 0.0)

    def rate(self, R, nu, tau):
        """Return the acceleration of many states: rotation body to world (n, 3, 3), velocity (n, 6), wrench
        (n, 6)."""

        def momentum_wrench(a):
            lin = np.cross(a[:, :3], nu[:, 3:])
            return np.hstack([lin, np.cross(a[:, :3], nu[:, :3]) + np.cross(a[:, 3:], nu[:, 3:])])

        up = R[:, 2, :]  # the world's z in body axes
        # The engine's own added mass follows Fossen; the plugin applies C(Ma, nu) nu with the opposite sign.
        wrench = (
            tau
            + momentum_wrench(nu @ (self.rigid + self.implicit).T)
            + momentum_wrench(nu * np.diag(self.Ma))
        )
        forces = [(-w, r) for w, r in self.weights] + self.lifts
        arm = np.sum([force * r for force, r in forces], axis=0)
        wrench += np.hstack([sum(force for force, _ in forces) * up, np.cross(arm, up)])
        D = self.linear + np.einsum("ijk,nk->nij", self.absolute, np.abs(nu))
        wrench += np.einsum("nij,nj->ni", D, nu)
        return wrench @ np.linalg.inv(self.rigid + self.implicit - self.Ma).T

    def run(self, R, nu, tau, duration, step=0.01):
        """Return rotations (t, n, 3, 3) and velocities (t, n, 6) at every step, by the classical Runge-Kutta
        method."""

        def slope(R, nu):
            spin = np.zeros_like(R)
            p, q, r = nu[:, 3], nu[:, 4], nu[:, 5]
            spin[:, 0, 1], spin[:, 0, 2], spin[:, 1, 0] = -r, q, r
            spin[:, 1, 2], spin[:, 2, 0], spin[:, 2, 1] = -p, -q, p
            return R @ spin, self.rate(R, nu, tau)

        out = [(R, nu)]
        for _ in range(round(duration / step)):
            a, b = slope(R, nu)
            c, d = slope(R + step / 2 * a, nu + step / 2 * b)
            e, f = slope(R + step / 2 * c, nu + step / 2 * d)
            g, h = slope(R + step * e, nu + step * f)
            R, nu = R + step / 6 * (a + 2 * c + 2 * e + g), nu + step / 6 * (b + 2 * d + 2 * f + h)
            out.append((R, nu))
        return np.array([x for x, _ in out]), np.array([x for _, x in out])
