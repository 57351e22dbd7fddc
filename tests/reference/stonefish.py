"""Stonefish's equations of a robot, in float64 and independent of the importer, and a scenario of such a robot.

Masses and moments are the textbook's. Surfaces are many small panels, except for the mesh, whose triangles are so
large that their number matters. The drag is quadratic, as documented. The box has its own coefficients and no added
mass (`floating`).
"""

import math

import numpy as np

from reference import gz_sim

FLIP = np.diag([1.0, -1.0, -1.0])
"""Rotation from forward, right, down to forward, left, up."""
RHO, GRAVITY = 1025.0, 9.81
DENSITIES = {"Foam": 610.0, "Aluminium": 2710.0, "Steel": 7800.0, "Neutral": 1000.0}
BOX, RADIUS, LENGTH, THICK, BALL = (0.6, 0.4, 0.3), 0.07, 0.5, 0.004, 0.06
WEIGHT = 22.446
"""Mass of the ballast that makes the robot neutral, within 0.1 N [kg]."""
DRAG, SKIN = (0.9, 1.1, 1.2), (0.05, 0.06, 0.07)
PLACES = {"port": (0.0, -0.25, -0.1), "starboard": (0.0, 0.25, -0.1)}
"""Positions of the cylinders' shells, whose axes lie along x."""
LAMP, KEEL, BALLAST = (0.0, 0.0, -0.2), (0.0, 0.0, 0.22), (0.0, 0.0, 0.12)
KEEL_SIDES = (0.3, 0.04, 0.1)


def thruster(name, xyz, rpy, model, right="true", dynamics='type="first_order"><time_constant value="0.1"/>'):
    return f"""<actuator name="{name}" type="thruster"><link name="base"/><origin xyz="{xyz}" rpy="{rpy}"/>
      <specs max_setpoint="${{100.0*2.0}}" inverted_setpoint="true" normalized_setpoint="true"/>
      <propeller diameter="0.1" right="{right}"><mesh filename="none.obj"/><material name="Neutral"/></propeller>
      <rotor_dynamics {dynamics}</rotor_dynamics>{model}</actuator>"""


FLUID = """<thrust_model type="fluid_dynamics"><thrust_coeff forward="0.4" reverse="0.3"/><torque_coeff value="0.02"/>
  </thrust_model>"""
DEAD = """<thrust_model type="deadband"><thrust_coeff reverse="0.001" forward="0.002"/>
  <deadband lower="-400" upper="100"/></thrust_model>"""
TABLE = """<thrust_model type="linear_interpolation"><input value="-100 0 100"/><output value="-20 0 30"/>
  </thrust_model>"""


def robot(thrusters=None, weight=WEIGHT):
    """Return the robot of a scenario."""
    shells = "".join(
        f"""<external_part name="{name}" type="cylinder" physics="submerged" buoyant="false">
          <dimensions radius="{RADIUS}" height="{LENGTH}" thickness="{THICK}"/><origin xyz="0 0 0" rpy="0 0 0"/>
          <material name="Aluminium"/><look name="x"/>
          <compound_transform xyz="{" ".join(map(str, place))}" rpy="0 {math.pi / 2} 0"/></external_part>"""
        for name, place in PLACES.items()
    )
    thrusters = thrusters or "".join(
        thruster(name, xyz, rpy, FLUID)
        for name, xyz, rpy in (
            ("a", "-0.2 -0.2 0", "0 0 0"), ("b", "-0.2 0.2 0", "0 0 0"), ("c", "0 0 0", "0 0 1.5707963267948966"),
            ("d", "0 0 0.1", "0 -1.5707963267948966 0"),
        )
    )  # fmt: skip
    return f"""<robot name="$(arg name)" fixed="false" self_collisions="false">
      <base_link name="base" type="compound" physics="submerged">
        <external_part name="hull" type="box" physics="floating" buoyant="true">
          <dimensions xyz="{" ".join(map(str, BOX))}"/><origin xyz="0 0 0" rpy="0 0 0"/>
          <material name="Foam"/><look name="x"/>
          <hydrodynamics quadratic_drag="{" ".join(map(str, DRAG))}" viscous_drag="{" ".join(map(str, SKIN))}"/>
          <compound_transform xyz="0 0 0" rpy="0 0 0"/></external_part>
        {shells}
        <external_part name="lamp" type="sphere" physics="submerged" buoyant="true">
          <dimensions radius="{BALL}"/><origin xyz="0 0 0" rpy="0 0 0"/><material name="Neutral"/><look name="x"/>
          <compound_transform xyz="{" ".join(map(str, LAMP))}" rpy="0 0 0"/></external_part>
        <external_part name="keel" type="model" physics="floating">
          <physical><mesh filename="keel.obj" scale="0.1"/><origin xyz="0 0 0" rpy="0 0 0"/></physical>
          <material name="Aluminium"/><look name="x"/>
          <hydrodynamics quadratic_drag="1 1 1" viscous_drag="0.1 0.1 0.1"/>
          <compound_transform xyz="{" ".join(map(str, KEEL))}" rpy="0 0 0"/></external_part>
        <internal_part name="ballast" type="sphere" physics="submerged" buoyant="false">
          <dimensions radius="0.05"/><origin xyz="0 0 0" rpy="0 0 0"/><material name="Steel"/><look name="x"/>
          <mass value="{weight}"/><compound_transform xyz="{" ".join(map(str, BALLAST))}" rpy="0 0 0"/></internal_part>
      </base_link>
      {thrusters}
      <world_transform xyz="0 0 2" rpy="0 0 1.0"/></robot>"""


def write(folder, thrusters=None, weight=WEIGHT):
    """Write the scenario, the file of the robot that it includes, and the mesh of its keel, ten times too
    large."""
    a, b, c = (5.0 * side for side in KEEL_SIDES)
    corners = [(x, y, z) for x in (-a, a) for y in (-b, b) for z in (-c, c)]
    sides = ("1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4")
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {side}" for side in sides]
    (folder / "data").mkdir()
    (folder / "data/keel.obj").write_text("\n".join(lines))
    (folder / "data/robot.scn").write_text(f"<scenario>{robot(thrusters, weight)}</scenario>")
    materials = "".join(
        f'<material name="{k}" density="{v}" restitution="0.5"/>' for k, v in DENSITIES.items()
    )
    (folder / "scenarios").mkdir()
    path = folder / "scenarios/sea.scn"
    path.write_text(f"""<?xml version="1.0"?><scenario>
      <environment><ned latitude="0" longitude="0"/><ocean><water density="{RHO}" jerlov="0.2"/></ocean></environment>
      <materials>{materials}</materials>
      <include file="robot.scn"><arg name="name" value="rov"/></include></scenario>""")
    return path


def _box_panels(sides, n=12):
    out = []
    for axis in range(3):
        i, j = (k for k in range(3) if k != axis)
        u, v = ((np.arange(n) + 0.5) / n - 0.5, (np.arange(n) + 0.5) / n - 0.5)
        for sign in (-1.0, 1.0):
            points = np.zeros((n, n, 3))
            points[..., i], points[..., j] = sides[i] * u[:, None], sides[j] * v
            points[..., axis] = sign * sides[axis] / 2.0
            normal = np.zeros_like(points)
            normal[..., axis] = sign
            out.append((points, normal, np.full((n, n), sides[i] * sides[j] / n**2)))
    return [np.concatenate([part[k].reshape(-1, *part[k].shape[2:]) for part in out]) for k in range(3)]


def _box_triangles(sides):
    """Return two triangles of each side, cut from its first corner as in the file."""
    out = []
    half = np.array(sides) / 2.0
    for axis, sign, corner in (
        (0, -1, (-1, -1, -1)), (0, 1, (1, -1, -1)), (1, -1, (-1, -1, -1)), (1, 1, (-1, 1, -1)), (2, -1, (-1, -1, -1)),
        (2, 1, (-1, -1, 1)),
    ):  # fmt: skip
        i, j = (k for k in range(3) if k != axis)
        start = np.array(corner, float)
        for one, two in ((i, j), (j, i)):
            middle, end = start.copy(), start.copy()
            middle[one] *= -1
            end[[one, two]] *= -1
            normal = np.zeros(3)
            normal[axis] = sign
            out.append((half * (start + middle + end) / 3, normal, 2.0 * half[i] * half[j]))
    return [np.array([panel[k] for panel in out]) * (1.0 if k else FLIP.diagonal()) for k in range(3)]


def _cylinder_panels(radius, length, n=48, m=8):
    angle = 2.0 * math.pi * (np.arange(n) + 0.5) / n
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    z = length * ((np.arange(m) + 0.5) / m - 0.5)
    side = np.concatenate([np.c_[radius * around, np.full(n, h)] for h in z])
    normal = np.tile(np.c_[around, np.zeros(n)], (m, 1))
    area = np.full(n * m, 2.0 * math.pi * radius * length / (n * m))
    r = radius * np.sqrt((np.arange(m) + 0.5) / m)  # rings of equal area
    disc = np.concatenate([a * around for a in r])
    for sign in (-1.0, 1.0):
        side = np.vstack([side, np.c_[disc, np.full(n * m, sign * length / 2.0)]])
        normal = np.vstack([normal, np.tile([0.0, 0.0, sign], (n * m, 1))])
        area = np.concatenate([area, np.full(n * m, math.pi * radius**2 / (n * m))])
    return [side, normal, area]


def _sphere_panels(radius, n=24):
    z = (np.arange(n) + 0.5) / n * 2.0 - 1.0  # bands of equal area
    angle = 2.0 * math.pi * (np.arange(2 * n) + 0.5) / (2 * n)
    ring = np.sqrt(1.0 - z**2)
    normal = np.stack(
        [ring[:, None] * np.cos(angle), ring[:, None] * np.sin(angle), np.repeat(z[:, None], 2 * n, axis=1)],
        axis=-1,
    ).reshape(-1, 3)
    return [radius * normal, normal, np.full(len(normal), 4.0 * math.pi * radius**2 / len(normal))]


class Origin(gz_sim.Origin):
    """Motion of the robot by Stonefish's equations, about its origin, in axes forward, left, up."""

    def __init__(self, weight=WEIGHT):
        def S(r):
            return np.array([[0, -r[2], r[1]], [r[2], 0, -r[0]], [-r[1], r[0], 0]])

        a, b, c = BOX
        box = DENSITIES["Foam"] * a * b * c
        parts = [
            (
                box,
                np.diag([b * b + c * c, a * a + c * c, a * a + b * b]) * box / 12.0,
                np.zeros(3),
                0.0,
                np.zeros((3, 3)),
            )
        ]
        R1, R2, L1, L2 = RADIUS - THICK / 2, RADIUS + THICK / 2, LENGTH - THICK, LENGTH + THICK
        rho = DENSITIES["Aluminium"]
        inner, outer = rho * math.pi * R1**2 * L1, rho * math.pi * R2**2 * L2
        along = (outer * R2**2 - inner * R1**2) / 2.0
        across = (outer * (3 * R2**2 + L2**2) - inner * (3 * R1**2 + L1**2)) / 12.0
        n = max(math.ceil(2.0 * math.pi * RADIUS / 0.1), 32)  # its mesh has the volume of the cylinder
        r = RADIUS * math.sqrt(2.0 * math.pi / n / math.sin(2.0 * math.pi / n))
        disc = RHO * math.pi * r**2
        more, turn = disc * (2.0 * LENGTH + 1.0) / 3.0, math.pi * RHO * LENGTH**2 * r**3 / 12.0
        for place in PLACES.values():
            parts.append(
                (
                    outer - inner,
                    np.diag([along, across, across]),
                    FLIP @ place,
                    more,
                    np.diag([0.0, turn, turn]),
                )
            )
        ball = DENSITIES["Neutral"] * 4.0 / 3.0 * math.pi * BALL**3
        parts.append(
            (
                ball,
                0.4 * ball * BALL**2 * np.eye(3),
                FLIP @ LAMP,
                2.0 / 3.0 * math.pi * RHO * BALL**3,
                np.zeros((3, 3)),
            )
        )
        x, y, z = KEEL_SIDES
        keel = rho * x * y * z
        parts.append(
            (
                keel,
                np.diag([y * y + z * z, x * x + z * z, x * x + y * y]) * keel / 12.0,
                FLIP @ KEEL,
                0.0,
                np.zeros((3, 3)),
            )
        )
        parts.append((weight, 0.4 * weight * 0.05**2 * np.eye(3), FLIP @ BALLAST, 0.0, np.zeros((3, 3))))
        self.mass = sum(part[0] for part in parts)
        self.centre = sum(part[0] * part[2] for part in parts) / self.mass
        total, inertia = self.mass + sum(part[3] for part in parts), np.zeros((3, 3))
        for mass, tensor, place, more, turning in parts:
            d = place - self.centre
            inertia += tensor + turning - (mass + more) * S(d) @ S(d)
        arm = total * S(self.centre)
        self.rigid = np.block([[total * np.eye(3), -arm], [arm, inertia - arm @ S(self.centre)]])
        self.inverse = np.linalg.inv(self.rigid)
        self.lifts = [
            (RHO * GRAVITY * volume, FLIP @ np.array(place))
            for volume, place in (
                (a * b * c, (0, 0, 0)),
                (4.0 / 3.0 * math.pi * BALL**3, LAMP),
                (x * y * z, KEEL),
            )
        ]
        self.surfaces = [(*_box_panels(BOX), np.zeros(3), np.array(DRAG), np.array(SKIN))]
        for place in PLACES.values():
            points, normal, area = _cylinder_panels(r, LENGTH)
            turned = [np.stack([p[:, 2], p[:, 1], -p[:, 0]], axis=1) for p in (points, normal)]
            self.surfaces.append(
                (*turned, area, FLIP @ place, np.array([1.0, 0.5, 0.5]), 0.1 * np.array([1.0, 0.5, 0.5]))
            )
        self.surfaces.append((*_sphere_panels(BALL), FLIP @ LAMP, np.ones(3), np.full(3, 0.1)))
        self.surfaces.append((*_box_triangles(KEEL_SIDES), FLIP @ KEEL, np.ones(3), np.full(3, 0.1)))

    def water(self, nu):
        """Return the wrench of drag and friction of one state about the origin."""
        out = np.zeros(6)
        for points, normal, area, place, drag, skin in self.surfaces:
            r = points + place
            flow = -(nu[:3] + np.cross(nu[3:], r))
            along = (flow * normal).sum(axis=1, keepdims=True)
            form = flow * np.maximum(-along, 0.0) * area[:, None]
            rub = (flow - along * normal) * area[:, None]
            for field, factor, share in ((form, RHO / 2.0, drag), (rub, RHO, skin)):
                force, moment = field.sum(axis=0), np.cross(r - self.centre, field).sum(axis=0)
                force, moment = (
                    factor * (np.abs(x) @ share) / max(np.linalg.norm(x), 1e-12) * x for x in (force, moment)
                )
                out += np.concatenate([force, moment + np.cross(self.centre, force)])
        return out

    def rate(self, R, nu, tau):
        """Return the acceleration of many states: rotation body to world (n, 3, 3), velocity (n, 6), wrench
        (n, 6)."""
        up, momentum = R[:, 2, :], nu @ self.rigid.T
        spun = np.cross(momentum[:, :3], nu[:, :3]) + np.cross(momentum[:, 3:], nu[:, 3:])
        wrench = (
            tau
            + np.hstack([np.cross(momentum[:, :3], nu[:, 3:]), spun])
            + np.array([self.water(x) for x in nu])
        )
        for force, r in [(-self.mass * GRAVITY, self.centre), *self.lifts]:
            wrench += np.hstack([force * up, np.cross(r, force * up)])
        return wrench @ self.inverse.T
