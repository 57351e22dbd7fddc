"""uuv_simulator's equations of a vehicle, in float64 and independent of the importer, and xacro of such vehicles.

The numbers are those of public robots; the files are written here.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from reference import gz_sim
from reference.gz_sim import euler

FLIP = np.diag([1.0, -1.0, -1.0])
"""Rotation from forward, left, up to forward, right, down, and back."""


@dataclass
class Robot:
    """Numbers of a robot; matrices are rows of text as in its file."""

    name: str
    mass: float
    inertia: tuple
    """ixx, ixy, ixz, iyy, iyz, izz [kg m²]."""
    added: list
    linear: list
    quadratic: list
    volume: float
    cob: tuple
    box: tuple
    """Width, length, height [m]."""
    thrusters: list
    """xyz and rpy of each thruster."""
    forward: list = field(default_factory=lambda: [0.0] * 6)
    com: tuple = (0, 0, 0)
    neutral: bool = False
    rotor: float = 0.00031
    density: float = 1028.0
    prop: float = 0.001
    """Mass of a thruster's link [kg]."""
    sensor: tuple = (2.0, (-0.3, 0.1, 0.2))
    """Mass and position of a link that is fixed to the base link."""


def _both(x, y, z, pitch, yaw):
    return [((x, side * y, z), (0.0, pitch, side * yaw)) for side in (1.0, -1.0)]


REXROV = Robot(
    "rexrov", 1862.87, (525.39, 1.44, 33.41, 794.20, 2.6, 691.23),
    [779.79, -6.8773, -103.32, 8.5426, -165.54, -7.8033, -6.8773, 1222, 51.29, 409.44, -5.8488, 62.726, -103.32, 51.29,
     3659.9, 6.1112, -386.42, 10.774, 8.5426, 409.44, 6.1112, 534.9, -10.027, 21.019, -165.54, -5.8488, -386.42,
     -10.027, 842.69, -1.1162, -7.8033, 62.726, 10.774, 21.019, -1.1162, 224.32],
    [-74.82, -69.48, -728.4, -268.8, -309.77, -105], [-748.22, -992.53, -1821.01, -672, -774.44, -523.27], 1.83826,
    (0, 0, 0.3), (1.5, 2.6, 1.6),
    [*_both(-0.890895, 0.334385, 0.528822, -1.3008, -0.9287), *_both(0.890895, 0.334385, 0.528822, -1.8408, 0.9287),
     *_both(-0.412125, 0.505415, 0.129, 0.0, 0.7854), *_both(0.412125, 0.505415, 0.129, 0.0, 2.3562)],
)  # fmt: skip
"""uuvsimulator/uuv_simulator, uuv_descriptions, commit bfb40cb, with a symmetric added mass."""
LAUV = Robot(
    "lauv", 18.0, (0.04, 0, 0, 2.1, 0, 2.1), list(np.diag([1, 16, 16, 0.005, 1.3, 1.3]).ravel()),
    [-2.4, 0, 0, 0, 0, 0, 0, -23, 0, 0, 0, 11.5, 0, 0, -23, 0, -11.5, 0, 0, 0, 0, -0.3, 0, 0, 0, 0, 3.1, 0, -9.7, 0, 0,
     -3.1, 0, 0, 0, -9.7],
    list((np.diag([-2.4, -80, -80, -0.0006, -9.1, -9.1]) + 0.3 * np.eye(6, k=4)).ravel()), 0.017551374956865266,
    (0, 0, 0.01), (0.15, 1.08, 0.15), [((-0.9, 0.0, 0.0), (0.0, 0.0, 0.0))],
    forward=list(np.diag([-8, -16, -10, -1.3, -2, -3]).ravel() + 2.0 * np.eye(6, k=4).ravel()), rotor=0.0002,
    sensor=(0.01, (0.3, 0.0, 0.0)), com=(0.0, 0.0, -0.004),
)  # fmt: skip
"""uuvsimulator/lauv_gazebo, commit 3529e02, with damping by forward speed, which is 0 there, and a lower
centre."""
SAGA = Robot(
    "saga", 10.0, (0.27, 0, 0, 0.56, 0, 0.52), list(np.diag([1.7182, 0, 5.468, 0, 1.2481, 0.4006]).ravel()),
    [-11.7391, -20, -31.8678, -25, -44.9085, -5], [0.0] * 6, 0.011054, (0, 0, 0.155), (0.2384, 0.448, 0.28066),
    [*_both(-0.088, 0.1192, -0.0061828, 0.0, 0.0), ((0.067, 0.0, 0.1258172), (0.0, -1.5707963267948966, 0.0))],
    neutral=True, rotor=0.00001, sensor=(0.015, (0.2, 0.0, 0.05)),
)  # fmt: skip
"""uuvsimulator/desistek_saga, commit 4a1d10f: neutrally buoyant."""


def text(robot, **changes):
    """Return the xacro of a robot; `changes` replace its numbers."""
    m = replace(robot, **changes)
    row = lambda values: " ".join(repr(float(x)) for x in values)  # noqa: E731
    ixx, ixy, ixz, iyy, iyz, izz = m.inertia
    thrusters = "".join(
        f'<xacro:thruster id="{i}"><origin xyz="{row(xyz)}" rpy="{row(rpy)}"/></xacro:thruster>'
        for i, (xyz, rpy) in enumerate(m.thrusters)
    )
    width, length, height = m.box
    return f"""<?xml version="1.0"?>
<robot name="{m.name}" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:arg name="ns" default="{m.name}"/>
  <xacro:property name="half" value="0.5"/>
  <xacro:property name="rotor" value="{m.rotor!r}"/>
  <xacro:macro name="thruster" params="id *origin">
    <link name="$(arg ns)/thruster_${{id}}">
      <inertial><mass value="{m.prop!r}"/><origin xyz="0 0 0" rpy="0 0 0"/>
        <inertia ixx="1e-8" ixy="0" ixz="0" iyy="1e-8" iyz="0" izz="1e-8"/></inertial>
    </link>
    <joint name="$(arg ns)/thruster_${{id}}_joint" type="continuous">
      <xacro:insert_block name="origin"/><axis xyz="1 0 0"/>
      <parent link="$(arg ns)/base_link"/><child link="$(arg ns)/thruster_${{id}}"/>
    </joint>
    <gazebo>
      <plugin name="t${{id}}" filename="libuuv_thruster_ros_plugin.so">
        <linkName>$(arg ns)/thruster_${{id}}</linkName>
        <jointName>$(arg ns)/thruster_${{id}}_joint</jointName>
        <thrusterID>${{id}}</thrusterID>
        <dynamics><type>FirstOrder</type><timeConstant>${{half / 10}}</timeConstant></dynamics>
        <conversion><type>Basic</type><rotorConstant>${{2 * half * rotor}}</rotorConstant></conversion>
      </plugin>
    </gazebo>
  </xacro:macro>
  <link name="$(arg ns)/base_link">
    <inertial><mass value="{m.mass!r}"/><origin xyz="{row(m.com)}"/>
      <inertia ixx="{ixx}" ixy="{ixy}" ixz="{ixz}" iyy="{iyy}" iyz="{iyz}" izz="{izz}"/></inertial>
    <visual/>
    <collision><origin xyz="0 0 0.1" rpy="0 0 0"/><geometry><box size="1 0.5 0.2"/></geometry></collision>
  </link>
  <link name="sensor"><inertial><mass value="{m.sensor[0]!r}"/></inertial></link>
  <joint name="sensor_joint" type="fixed">
    <origin xyz="{row(m.sensor[1])}"/><parent link="$(arg ns)/base_link"/><child link="sensor"/>
  </joint>
  <gazebo>
    <plugin name="uuv" filename="libuuv_underwater_object_ros_plugin.so">
      <fluid_density>{m.density!r}</fluid_density>
      <flow_velocity_topic>current</flow_velocity_topic>
      <debug>0</debug>
      <link name="$(arg ns)/base_link">
        <neutrally_buoyant>{int(m.neutral)}</neutrally_buoyant>
        <volume>{m.volume!r}</volume>
        <box><width>{width}</width><length>{length}</length><height>{height}</height></box>
        <center_of_buoyancy>{row(m.cob)}</center_of_buoyancy>
        <hydrodynamic_model>
          <type>fossen</type>
          <added_mass>{row(m.added)}</added_mass>
          <linear_damping>{row(m.linear)}</linear_damping>
          <linear_damping_forward_speed>{row(m.forward)}</linear_damping_forward_speed>
          <quadratic_damping>{row(m.quadratic)}</quadratic_damping>
        </hydrodynamic_model>
      </link>
    </plugin>
  </gazebo>
  {thrusters}
</robot>
"""


class Origin(gz_sim.Origin):
    """Motion of a robot by uuv_simulator's equations in Gazebo, about the origin of its base link."""

    def __init__(self, m, gravity=9.8):
        def S(r):
            return np.array([[0, -r[2], r[1]], [r[2], 0, -r[0]], [-r[1], r[0], 0]])

        ixx, ixy, ixz, iyy, iyz, izz = m.inertia
        tensor = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
        fixed = [
            (m.mass, tensor, np.array(m.com, float)),
            (m.sensor[0], np.zeros((3, 3)), np.array(m.sensor[1])),
        ]
        parts = fixed + [(m.prop, 1e-8 * np.eye(3), np.array(xyz, float)) for xyz, _ in m.thrusters]
        self.rigid = np.zeros((6, 6))
        for mass, inertia, r in parts:
            self.rigid += np.block(
                [[mass * np.eye(3), -mass * S(r)], [mass * S(r), inertia - mass * S(r) @ S(r)]]
            )
        self.weights = [(mass * gravity, r) for mass, _, r in parts]
        held = sum(mass for mass, _, _ in fixed)
        self.centre = sum(mass * r for mass, _, r in fixed) / held
        lift = held * gravity if m.neutral else m.density * gravity * m.volume
        self.lift = lift, self.centre + m.cob
        square = lambda values: np.diag(values) if len(values) == 6 else np.reshape(values, (6, 6))  # noqa: E731
        self.Ma, self.linear, self.forward = square(m.added), square(m.linear), square(m.forward)
        self.quadratic = np.diag(square(m.quadratic))
        turn = np.block([[FLIP, np.zeros((3, 3))], [np.zeros((3, 3)), FLIP]])
        at_centre = np.block([[np.eye(3), np.zeros((3, 3))], [S(self.centre), np.eye(3)]])
        self.inverse = np.linalg.inv(self.rigid + at_centre @ turn @ self.Ma @ turn)

    def rate(self, R, nu, tau):
        """Return the acceleration of many states: rotation body to world (n, 3, 3), velocity (n, 6), wrench
        (n, 6)."""
        up = R[:, 2, :]
        momentum = nu @ self.rigid.T
        wrench = tau + np.hstack(
            [
                np.cross(momentum[:, :3], nu[:, 3:]),
                np.cross(momentum[:, :3], nu[:, :3]) + np.cross(momentum[:, 3:], nu[:, 3:]),
            ]
        )
        for force, r in [(-w, r) for w, r in self.weights] + [self.lift]:
            wrench += np.hstack([force * up, np.cross(r, force * up)])
        v = np.hstack([nu[:, :3] @ FLIP, nu[:, 3:] @ FLIP])  # forward, right, down
        D = self.linear + v[:, :1, None] * self.forward
        water = np.einsum("nij,nj->ni", D, v) + self.quadratic * np.abs(v) * v
        a = v @ self.Ma.T
        water[:, :3] += np.cross(a[:, :3], v[:, 3:])
        water[:, 3:] += np.cross(a[:, :3], v[:, :3]) + np.cross(a[:, 3:], v[:, 3:])
        force, torque = water[:, :3] @ FLIP, water[:, 3:] @ FLIP
        wrench += np.hstack([force, torque + np.cross(self.centre, force)])
        return wrench @ self.inverse.T


__all__ = ["LAUV", "REXROV", "SAGA", "Origin", "Robot", "euler", "text"]
