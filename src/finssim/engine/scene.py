"""One world with real contacts, objects and pictures: our hydrodynamics on MuJoCo's bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.engine.plant_arrays import SimulatorError
from finssim.engine.scene_model import COLLISION, build_model, load_mujoco, side_by_side, total_inertia
from finssim.engine.scene_picture import Painter
from finssim.engine.simulator import Simulator
from finssim.engine.solids import layout_of, pool_of, solid_shapes
from finssim.engine.surroundings import Pool, TetherLine, Water
from finssim.geometry.frames import (
    acceleration_from_mujoco,
    mujoco_acceleration,
    mujoco_inertia,
    mujoco_velocity,
    velocity_from_mujoco,
    wrench_from_mujoco,
    wxyz_from_xyzw,
    xyzw_from_wxyz,
)
from finssim.vehicles import Vehicle

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Contact:
    """Two bodies touching at a point during the last physics step."""

    bodies: tuple[str, str]
    """Names; `world` for pool and fixed objects."""
    position: Array
    """World frame [m]."""
    force: Array
    """Of the first body on the second, world frame [N]."""


class Scene:
    """A single world on MuJoCo, used like a `Simulator` with one world.

    Each physics step runs the batched simulator's own kernel once for nu_dot and the thrusters' lag, and gives MuJoCo
    the generalised force that yields exactly this nu_dot where nothing touches. MuJoCo's mass matrix of a vehicle is
    replaced by M_RB + M_A, so a contact meets the inertia of hull and water together.

    Attributes:
        vehicles: In order; their MuJoCo bodies are `vehicle0`, `vehicle1`, ...
        command: Thruster force commands [N] and disturbance wrenches; write them before `step`.
        plant: Parameters by (1, vehicle); after writing any of them call `refresh`.
        water: Water, as in `Simulator`.
        world: `finssim.worlds.WorldLayout` of the described world, whose `draw` moves its solids; None without one.
        state: Warp arrays by (1, vehicle). MuJoCo holds the pose: set it by `place`.
        model: The `mujoco.MjModel`.
        data: The `mujoco.MjData`; both also serve MuJoCo's viewer.
    """

    worlds = 1

    def __init__(
        self,
        vehicles: Vehicle | str | Sequence[Vehicle | str],
        *,
        pool: Pool | None = None,
        objects: str | Path | None = None,
        hydrodynamics: str = "calibrated",
        control_step: float = 0.1,
        substeps: int = 10,
        water: Water | None = None,
        tether: TetherLine | None = None,
        collision: str = "envelope",
        world: Any = None,
        seed: int = 0,
        max_delay: float | None = None,
    ) -> None:
        """Set up the world, with the vehicles side by side.

        Args:
            vehicles: One vehicle or several, each a `Vehicle`, a catalogue name or a file.
            pool: Walls and floor, rigid, with the pool's friction; open water if None.
            objects: What else there is, as MJCF: elements of a worldbody (angles in radians), a whole `<mujoco>`
                document, or the path of one. Its integrator, time step, gravity and fluid are the scene's.
            hydrodynamics: Key of `HYDRODYNAMICS`: calibrated, mesh or simplified.
            control_step: Time between commands [s].
            substeps: Physics steps in a control step.
            water: Currents and waves; still water if None. They act on vehicles only. A drifting current is drawn in
                every physics step: a drift of the same kind as a `Simulator`'s, but not the same one.
            tether: On every vehicle; none if None.
            collision: What touches: `envelope`, the box of the vehicle's size, or `hull`, the convex hull of its mesh.
            world: Described world whose solids are rigid here, with its friction: a name, a path, or a `World`,
                `WorldLayout` or `WorldBatch` of one copy, whose draws `step` follows. Its basin is the pool.
            seed: Of everything random in the world.
            max_delay: Longest thruster delay that will be written to `plant` [s]; twice the vehicles' own if None.

        Raises:
            SimulatorError: MuJoCo is missing, it refuses the objects, or a name or number is out of its range.
            WorldError: There is no such world, or its file is wrong.
        """
        self._mujoco = load_mujoco()
        if collision not in COLLISION:
            raise SimulatorError(f"unknown collision shape '{collision}'; available: {', '.join(COLLISION)}")
        if substeps < 1:
            raise SimulatorError(f"substeps={substeps}: expected at least one")
        if world is not None and pool is not None:
            raise SimulatorError("pool and world are given: leave pool out, the world's basin is the pool")
        h = control_step / substeps
        # One substep of this simulator is one physics step of the scene; its pose is overwritten after each.
        self._simulator = Simulator(
            vehicles, hydrodynamics=hydrodynamics, control_step=h, substeps=1, water=water, tether=tether,
            threads=1, seed=seed, max_delay=max_delay,
        )  # fmt: skip
        self.vehicles = self._simulator.vehicles
        self.hydrodynamics, self.seed = hydrodynamics, seed
        self.control_step, self.substeps = control_step, substeps
        self.world = None if world is None else layout_of(world, 1, self._simulator.device)
        pool = pool if self.world is None else pool_of(self.world.world)
        self.surroundings = (self._simulator.surroundings[0], pool, tether)
        self.state, self.plant = self._simulator.state, self._simulator.plant
        self.water, self.command = self._simulator.water, self._simulator.command
        self.refresh()
        self.model = build_model(
            self.vehicles, self._inertia, pool=pool, objects=objects, collision=collision, timestep=h, layout=self.world
        )  # fmt: skip
        self.data = self._mujoco.MjData(self.model)
        shapes = {} if self.world is None else {f"solid{k}": k for k in solid_shapes(self.world)}
        bodies = [self.model.body(i) for i in range(self.model.nbody)]
        drawn = [b for b in bodies if b.name in shapes and b.mocapid[0] >= 0]
        self._drawn_solids = [b.mocapid[0] for b in drawn], [shapes[b.name] for b in drawn]
        self._scales = None if self.world is None else self.world.scales.numpy().copy()
        self._find_vehicles()
        self._painter: Painter | None = None
        names = ("position", "quaternion", "velocity", "acceleration", "pressed")
        self._views = {name: self._simulator.numpy(name)[0] for name in names}
        start = side_by_side(self.vehicles, depth=0.5 * pool.depth if pool else 1.0)
        if self.world is not None:
            start += self.world.world.viewpoint.position - [0.0, 0.0, start[0, 2]]
        self.place(start)

    def _find_vehicles(self) -> None:
        """Where MuJoCo keeps each vehicle: pose, velocity, and the lower triangle of its block of the mass matrix."""
        joints = [self.model.joint(f"vehicle{i}") for i in range(len(self.vehicles))]
        self._qpos = np.stack([j.qposadr[0] + np.arange(7) for j in joints])
        self._dofs = np.stack([j.dofadr[0] + np.arange(6) for j in joints])
        self._tril = np.tril_indices(6)
        rows, columns = self._tril
        self._M_index = self.model.M_rowadr[self._dofs[:, rows]] + columns

    def refresh(self) -> None:
        """Recompute what depends on `plant` after writing to it.

        Raises:
            SimulatorError: a delay is longer than the delay line.
        """
        self._simulator.refresh()
        self._inertia = total_inertia(self.plant)

    def place(
        self,
        position: ArrayLike = (0.0, 0.0, 0.0),
        quaternion: ArrayLike = (0.0, 0.0, 0.0, 1.0),
        velocity: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    ) -> None:
        """Put every vehicle somewhere, every object where it began, and start anew: motors at rest, clock at zero.

        Args:
            position: Of the body origin, world frame [m], shape broadcastable to (1, vehicles, 3).
            quaternion: Body to world, xyzw, broadcastable to (..., 4).
            velocity: nu, body frame [m/s, rad/s], broadcastable to (..., 6).

        Raises:
            SimulatorError: a number is not finite, or a quaternion has no length.
        """
        self._simulator.place(position, quaternion, velocity)
        mj, d, v = self._mujoco, self.data, self._views
        mj.mj_resetData(self.model, d)
        d.qpos[self._qpos[:, :3]] = v["position"]
        d.qpos[self._qpos[:, 3:]] = wxyz_from_xyzw(v["quaternion"])
        d.qvel[self._dofs] = mujoco_velocity(v["velocity"], v["quaternion"])
        self._touch = np.zeros((1, len(self.vehicles), 6))
        self._broken = False
        self._move_solids()
        mj.mj_kinematics(self.model, d)

    def step(self) -> None:
        """Advance by one control step under `command`.

        Raises:
            SimulatorError: a number stopped being finite; the scene stands still until it is placed anew.
        """
        self._touch[:] = 0.0
        self._move_solids()
        for _ in range(self.substeps):
            self._substep()
        self._mujoco.mj_kinematics(self.model, self.data)

    def _move_solids(self) -> None:
        """Put the solids that the world's draws move where they are now."""
        bodies, shapes = self._drawn_solids
        if self.world is not None and bodies:
            if not np.array_equal(self.world.scales.numpy(), self._scales):
                raise SimulatorError(
                    "a draw has changed the size of solids, which MuJoCo keeps: draw first, then make the scene"
                )
            pose = self.world.transforms.numpy()[0, shapes].astype(float)
            self.data.mocap_pos[bodies], self.data.mocap_quat[bodies] = (
                pose[:, :3],
                wxyz_from_xyzw(pose[:, 3:]),
            )

    def _substep(self) -> None:
        mj, m, d, dofs = self._mujoco, self.model, self.data, self._dofs
        if self._broken:
            self._refuse()
        mj.mj_step1(m, d)
        q, nu = self._attitude_and_twist()
        before = self._views["velocity"].astype(float)
        self._simulator.step()
        nu_dot = (self._views["velocity"] - before) / m.opt.timestep
        M = mujoco_inertia(self._inertia, q)
        d.M[self._M_index] = M[:, self._tril[0], self._tril[1]]
        mj.mj_factorM(m, d)
        qacc = mujoco_acceleration(nu_dot, nu, q)
        # Bias and passive forces hold MuJoCo's own weight and Coriolis force of its stand-in body: ours are in nu_dot.
        of_stand_in = d.qfrc_bias[dofs] - d.qfrc_passive[dofs]
        d.qfrc_applied[dofs] = (M @ qacc[..., None])[..., 0] + of_stand_in
        mj.mj_step2(m, d)
        self._touch[0] += wrench_from_mujoco(d.qfrc_constraint[dofs], q) / self.substeps
        self._views["acceleration"][:] += acceleration_from_mujoco(d.qacc[dofs], nu, q) - nu_dot
        # Contacts may stop what the simulator sees falling: its next forces are those at the twist that MuJoCo gives.
        self._views["pressed"][:] = -nu_dot
        self._views["position"][:] = d.qpos[self._qpos[:, :3]]
        self._views["quaternion"][:], self._views["velocity"][:] = self._attitude_and_twist()
        finite = np.isfinite(d.qpos).all() and np.isfinite(d.qvel).all()
        if not finite or self.state.frozen.numpy()[0]:
            self._refuse()

    def _attitude_and_twist(self) -> tuple[Array, Array]:
        """Quaternions xyzw (V, 4) and nu (V, 6) of the vehicles, as MuJoCo holds them."""
        q = xyzw_from_wxyz(self.data.qpos[self._qpos[:, 3:]])
        return q, velocity_from_mujoco(self.data.qvel[self._dofs], q)

    def _refuse(self) -> None:
        self._broken = True
        raise SimulatorError(
            f"a number stopped being finite {self.data.time:.3f} s into the scene: check commands "
            "and parameters, or use more substeps, and place the vehicles again"
        )

    @property
    def time(self) -> float:
        """Since the vehicles were placed [s]."""
        return float(self.data.time)

    def numpy(self, name: str) -> NDArray[Any]:
        """A field of `state` as NumPy, (1, vehicles, ...): a view; see `Simulator.numpy`.

        `acceleration` is nu_dot, with the mean of the last physics step where contacts act.
        """
        return self._simulator.numpy(name)

    def set_thrust(self, force: ArrayLike) -> None:
        """Command thruster forces.

        Args:
            force: Along the thrusters' axes [N], shape broadcastable to (1, vehicles, n); see
                `Simulator.set_thrust`.
        """
        self._simulator.set_thrust(force)

    def contact_wrench(self) -> Array:
        """What contacts (and ties that `objects` made) did to each vehicle, as the mean of the last control step.

        Returns:
            Wrench about the body origin, body frame [N, N m], shape (1, vehicles, 6).
        """
        return self._touch.copy()

    def contacts(self) -> list[Contact]:
        """Every point of contact of the last physics step."""
        mj, m, d = self._mujoco, self.model, self.data
        result = []
        for i in range(d.ncon):
            c = d.contact[i]
            f = np.zeros(6)
            mj.mj_contactForce(m, d, i, f)
            first, second = (m.body(m.geom_bodyid[g]).name for g in c.geom)
            force = c.frame.reshape(3, 3).T @ f[:3]
            result.append(Contact((first, second), c.pos.copy(), force))
        return result

    def pose(self, body: str) -> tuple[Array, Array]:
        """Pose of a body by its name, an object's or a vehicle's.

        Returns:
            Position of its origin, world frame [m], and quaternion xyzw, body to world.

        Raises:
            SimulatorError: there is no such body.
        """
        try:
            body_data = self.data.body(body)
        except KeyError:
            have = ", ".join(self.model.body(i).name for i in range(self.model.nbody))
            raise SimulatorError(f"unknown body '{body}'; available: {have}") from None
        return body_data.xpos.copy(), xyzw_from_wxyz(body_data.xquat)

    def render(self, camera: str = "overhead", width: int = 640, height: int = 480) -> NDArray[np.uint8]:
        """A picture of the present state.

        Args:
            camera: `overhead`, `corner`, `vehicle0_bow` (and of the other vehicles), or one that `objects` has.
            width: [pixels].
            height: [pixels].

        Returns:
            RGB, shape (height, width, 3).

        Raises:
            PictureError: there is no OpenGL here, or no such camera.
        """
        if self._painter is None:
            self._painter = Painter(self.model)
        self._mujoco.mj_comPos(self.model, self.data)
        self._mujoco.mj_camlight(self.model, self.data)
        return self._painter.draw(self.data, camera, width, height)

    def close(self) -> None:
        """Free what pictures took of the graphics driver; the scene goes on."""
        if self._painter is not None:
            self._painter.close()
            self._painter = None
