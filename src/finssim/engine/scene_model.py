"""The MuJoCo model of a scene: vehicles, pool, cameras and light around the objects that a user brings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from finssim.engine.packed import Packed
from finssim.engine.plant_arrays import SimulatorError
from finssim.engine.solids import solid_shapes
from finssim.engine.surroundings import Pool
from finssim.geometry.frames import wxyz_from_xyzw
from finssim.geometry.rotations import skew

if TYPE_CHECKING:
    from finssim.vehicles import Vehicle
    from finssim.worlds import WorldLayout

COLLISION = ("envelope", "hull")
"""Shapes that a vehicle may collide with."""

COLOURS = ((0.95, 0.75, 0.1, 1.0), (0.85, 0.25, 0.2, 1.0), (0.3, 0.65, 0.3, 1.0), (0.45, 0.35, 0.75, 1.0))

SHELL = 1.0e-3
"""Half the thickness of a world's meshes [m]."""

_UNSEEN = 4  # a geom group that MuJoCo leaves out of pictures


def load_mujoco() -> ModuleType:
    """The MuJoCo library.

    Raises:
        SimulatorError: it is not installed.
    """
    try:
        import mujoco
    except ImportError:
        raise SimulatorError("a scene needs MuJoCo: pip install 'finssim[mujoco]'") from None
    return mujoco


def total_inertia(plant: Packed) -> NDArray[np.float64]:
    """M_RB + M_A of each vehicle of the only world, about its origin, (V, 6, 6)."""
    names = ("mass", "r_g", "inertia", "M_A")
    mass, r_g, inertia, M_A = (plant.fields[name].numpy()[0].astype(float) for name in names)
    m, S = mass[:, None, None], skew(r_g)
    return np.asarray(M_A + np.block([[m * np.eye(3), -m * S], [m * S, inertia]]))


def side_by_side(vehicles: Sequence[Vehicle], depth: float) -> NDArray[np.float64]:
    """Positions (V, 3) at a depth [m] where no vehicle touches another, the first to the left."""
    widths = np.array([1.5 * v.body.size[1] for v in vehicles])
    y = 0.5 * (widths.sum() + widths) - np.cumsum(widths)
    return np.stack([np.zeros_like(y), y, np.full_like(y, -depth)], axis=-1)


def build_model(
    vehicles: Sequence[Vehicle],
    inertias: NDArray[np.float64],
    *,
    pool: Pool | None,
    objects: str | Path | None,
    collision: str,
    timestep: float,
    layout: WorldLayout | None = None,
) -> Any:
    """Compile the scene.

    Bodies are `vehicle0`, `vehicle1`, ...; cameras `overhead` and `corner`, and `vehicle0_bow`, ... on the vehicles.

    Args:
        vehicles: In the order of their bodies.
        inertias: M_RB + M_A of each, about its origin, (V, 6, 6).
        pool: Floor and walls; open water if None.
        objects: MJCF: elements of a worldbody, a whole `<mujoco>` document, or the path of one.
        collision: `envelope`, the box of the vehicle file's size about the body origin, or `hull`, the convex hull
            of its mesh.
        timestep: Physics step [s].
        layout: Of the described world whose solids stand there, `solidK` with the index of the shape K; none if None.

    Returns:
        The `mujoco.MjModel`.

    Raises:
        SimulatorError: MuJoCo refuses the objects.
    """
    mj = load_mujoco()
    try:
        spec = _read(mj, objects)
        _set_options(mj, spec, timestep, vehicles[0].water.gravity)
        _paint_surroundings(mj, spec)
        if pool is not None:
            _add_pool(mj, spec, pool)
        if layout is not None:
            _add_solids(mj, spec, layout)
        bodies = [
            _add_vehicle(mj, spec, i, vehicle, M, collision)
            for i, (vehicle, M) in enumerate(zip(vehicles, inertias, strict=True))
        ]
        _add_cameras(mj, spec, bodies[0], max(vehicles[0].body.size), pool)
        return spec.compile()
    except ValueError as error:
        if isinstance(error, SimulatorError) or objects is None:
            raise
        sentence = " ".join(str(error).split())
        raise SimulatorError(f"objects of the scene: {sentence}") from None


def _read(mj: ModuleType, objects: str | Path | None) -> Any:
    if isinstance(objects, Path):
        return mj.MjSpec.from_file(str(objects))
    text = (objects or "").strip()
    if not text.startswith("<mujoco"):
        text = f"<mujoco><compiler angle='radian'/><worldbody>{text}</worldbody></mujoco>"
    return mj.MjSpec.from_string(text)


def _set_options(mj: ModuleType, spec: Any, timestep: float, gravity: float) -> None:
    """What the coupling rests on, whatever a document says."""
    o = spec.option
    o.timestep, o.gravity = timestep, [0.0, 0.0, -gravity]
    o.density, o.viscosity, o.wind = 0.0, 0.0, [0.0, 0.0, 0.0]
    o.integrator = mj.mjtIntegrator.mjINT_EULER
    # Newton works on the mass matrix itself; the others on quantities computed before it is replaced.
    o.solver, o.noslip_iterations = mj.mjtSolver.mjSOL_NEWTON, 0
    o.cone = mj.mjtCone.mjCONE_ELLIPTIC
    off = mj.mjtDisableBit
    # Solving islands apart makes copies of the mass matrix before it is replaced, in some versions. A number that is
    # not finite is for `Scene.step` to refuse, not for MuJoCo to put the scene quietly back to its start.
    o.disableflags = int(o.disableflags) | int(off.mjDSBL_ISLAND) | int(off.mjDSBL_AUTORESET)


def _paint_surroundings(mj: ModuleType, spec: Any) -> None:
    world = spec.worldbody
    spec.add_texture(
        name="scene_sky", type=mj.mjtTexture.mjTEXTURE_SKYBOX, builtin=mj.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.75, 0.85, 0.92], rgb2=[0.25, 0.4, 0.5], width=64, height=384,
    )  # fmt: skip
    spec.add_texture(
        name="scene_tiles", type=mj.mjtTexture.mjTEXTURE_2D, builtin=mj.mjtBuiltin.mjBUILTIN_FLAT,
        mark=mj.mjtMark.mjMARK_EDGE, markrgb=[0.45, 0.65, 0.72], rgb1=[0.68, 0.84, 0.88],
        width=256, height=256,
    )  # fmt: skip
    tiles = spec.add_material(name="scene_tiles", texuniform=True, texrepeat=[4.0, 4.0], specular=0.1)
    tiles.textures[mj.mjtTextureRole.mjTEXROLE_RGB] = "scene_tiles"
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.35] * 3, [0.25] * 3
    # The sun stands straight above, so that the walls throw no shadow on the floor.
    lights = {"sun": [0.0, 0.0, -1.0], "left": [0.6, 0.9, -0.6], "right": [-0.6, -0.9, -0.6]}
    for name, direction in lights.items():
        light = world.add_light(name=f"scene_{name}", pos=[0.0, 0.0, 8.0], dir=direction)
        light.type = mj.mjtLightType.mjLIGHT_DIRECTIONAL
        light.diffuse, light.castshadow = [0.4 if name == "sun" else 0.2] * 3, name == "sun"
    spec.visual.quality.shadowsize = 2048


def _add_pool(mj: ModuleType, spec: Any, pool: Pool) -> None:
    """Floor and walls as planes: half spaces that nothing passes, and that a camera behind them looks through."""
    x, y, depth = 0.5 * pool.length, 0.5 * pool.width, pool.depth
    planes = {
        "floor": ([0.0, 0.0, -depth], [0.0, 0.0, 1.0], [x, y]),
        "wall_x_plus": ([x, 0.0, -0.5 * depth], [-1.0, 0.0, 0.0], [0.5 * depth, y]),
        "wall_x_minus": ([-x, 0.0, -0.5 * depth], [1.0, 0.0, 0.0], [0.5 * depth, y]),
        "wall_y_plus": ([0.0, y, -0.5 * depth], [0.0, -1.0, 0.0], [x, 0.5 * depth]),
        "wall_y_minus": ([0.0, -y, -0.5 * depth], [0.0, 1.0, 0.0], [x, 0.5 * depth]),
    }
    for name, (position, normal, half) in planes.items():
        wall = spec.worldbody.add_geom(
            name=name, type=mj.mjtGeom.mjGEOM_PLANE, pos=position, size=[*half, 0.05], material="scene_tiles"
        )
        wall.alt.type, wall.alt.zaxis = mj.mjtOrientation.mjORIENTATION_ZAXIS, normal
        # With priority over what touches it, the wall's friction is the pool's, as in the batched simulator.
        wall.priority, wall.friction = 1, [pool.friction, 0.005, 0.0001]
    spec.worldbody.add_geom(
        name="water_surface", type=mj.mjtGeom.mjGEOM_PLANE, size=[x, y, 0.05], contype=0, conaffinity=0,
        rgba=[0.3, 0.6, 0.75, 0.2],
    )  # fmt: skip


def _add_solids(mj: ModuleType, spec: Any, layout: WorldLayout) -> None:
    """The solids of a world, rigid; those that its draws move are mocap bodies.

    Meshes are flexes of triangles that do not move: as a geom MuJoCo would take the convex hull of one.
    """
    for k in solid_shapes(layout):
        shape, pose = layout.shapes[k], layout.transforms.numpy()[0, k].astype(float)
        scale = float(layout.scales.numpy()[0, k])
        position, attitude = pose[:3], wxyz_from_xyzw(pose[3:])
        name, body = f"solid{k}", spec.worldbody
        common = {"rgba": [*map(float, shape.finish.colour), 1.0], "priority": 1}
        common["friction"] = [layout.world.contact.friction, 0.005, 0.0001]
        if shape.anchor >= 0 or shape.kind == "mesh":
            body = spec.worldbody.add_body(name=name, mocap=shape.anchor >= 0, pos=position, quat=attitude)
            position, attitude = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]
        if shape.kind == "mesh":
            flex = spec.add_flex(name=name, dim=2, radius=SHELL, **common)
            flex.vert, flex.elem = (
                (scale * np.asarray(shape.vertices)).ravel().tolist(),
                np.asarray(shape.faces).ravel().tolist(),
            )
            flex.vertbody, flex.selfcollide = [name] * len(shape.vertices), mj.mjtFlexSelf.mjFLEXSELF_NONE
            continue
        size = [scale * length for length in shape.size]
        if shape.heights is not None:
            low, high = float(shape.heights.min()), float(shape.heights.max())
            rows, columns = shape.heights.shape
            rise = max(high - low, 1e-3)
            spec.add_hfield(
                name=name, nrow=rows, ncol=columns, size=[shape.size[0], shape.size[1], rise, 1.0],
                userdata=((shape.heights - low) / rise).ravel().tolist(),
            )  # fmt: skip
            common["hfieldname"], position = name, [position[0], position[1], position[2] + low]
        elif shape.kind == "plane":
            size = [0.0, 0.0, 0.05]  # without end
        kind = getattr(mj.mjtGeom, f"mjGEOM_{'HFIELD' if shape.heights is not None else shape.kind.upper()}")
        body.add_geom(name=name, type=kind, size=size, pos=position, quat=attitude, **common)


def _add_vehicle(
    mj: ModuleType, spec: Any, index: int, vehicle: Vehicle, M: NDArray[np.float64], collision: str
) -> Any:
    name = f"vehicle{index}"
    colour = COLOURS[index % len(COLOURS)]
    half = 0.5 * np.asarray(vehicle.body.size, dtype=float)
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    _set_inertia(body, M)
    solid: dict[str, Any] = {"contype": 1, "conaffinity": 1, "mass": 0.0}
    visual: dict[str, Any] = {"contype": 0, "conaffinity": 0, "mass": 0.0}
    meshed = vehicle.hull is not None or collision == "hull"
    if meshed:
        vertices, faces = vehicle.hull_mesh()
        mesh = spec.add_mesh(name=name)
        mesh.uservert, mesh.userface = vertices.ravel().tolist(), faces.ravel().tolist()
        mesh.inertia = mj.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        collision_options = solid if collision == "hull" else visual
        body.add_geom(
            name=f"{name}_hull", type=mj.mjtGeom.mjGEOM_MESH, meshname=name, rgba=colour, **collision_options
        )
    if collision == "envelope":
        group = _UNSEEN if meshed else 0
        body.add_geom(
            name=f"{name}_envelope", type=mj.mjtGeom.mjGEOM_BOX, size=half, group=group, rgba=colour, **solid
        )
    for key, thruster in vehicle.thrusters.items():
        middle, along = np.asarray(thruster.position), np.asarray(thruster.axis) * 0.08 * half.max()
        body.add_geom(
            name=f"{name}_{key}", type=mj.mjtGeom.mjGEOM_CYLINDER, size=[0.12 * half.max(), 0.0, 0.0],
            fromto=[*(middle - along), *(middle + along)], rgba=[0.15, 0.15, 0.17, 1.0], **visual,
        )  # fmt: skip
    # MuJoCo's cameras look along their -z with y up: x to the right is the body's -y, y its z.
    bow = body.add_camera(name=f"{name}_bow", pos=[half[0], 0.0, 0.0], fovy=60.0)
    bow.alt.type = mj.mjtOrientation.mjORIENTATION_XYAXES
    bow.alt.xyaxes = [0.0, -1.0, 0.0, 0.0, 0.0, 1.0]
    return body


def _set_inertia(body: Any, M: NDArray[np.float64]) -> None:
    """An isotropic stand-in for M, from which MuJoCo takes the scale of its contacts' softness.

    `Scene` replaces the mass matrix by the true one in every step. The turned inertia frame keeps MuJoCo from storing a
    diagonal only, which it does for bodies that it finds simple.
    """
    A = np.linalg.inv(M)
    body.explicitinertial = True
    body.mass = 3.0 / np.trace(A[:3, :3])
    body.inertia = [3.0 / np.trace(A[3:, 3:])] * 3
    body.ipos, body.iquat = [0.0, 0.0, 0.0], [0.8, 0.6, 0.0, 0.0]


def _add_cameras(mj: ModuleType, spec: Any, body: Any, size: float, pool: Pool | None) -> None:
    """`overhead` and `corner`: of the pool, or in open water of vehicle 0, which they follow without turning."""
    if pool is None:
        parent, mode, span, middle = body, mj.mjtCamLight.mjCAMLIGHT_TRACK, 6.0 * size, np.zeros(3)
        wide, high = span, span
    else:
        parent, mode, span = spec.worldbody, mj.mjtCamLight.mjCAMLIGHT_FIXED, max(pool.length, pool.width)
        middle, wide, high = np.array([0.0, 0.0, -0.5 * pool.depth]), pool.length, pool.width
        spec.stat.extent, spec.stat.center = span, middle
    half = 0.55 * max(high, 0.75 * wide)  # fits a picture of 4:3 with a margin
    overhead = parent.add_camera(name="overhead", mode=mode, pos=[0.0, 0.0, span])
    overhead.fovy = float(np.degrees(2.0 * np.arctan(half / span)))
    corner = parent.add_camera(name="corner", mode=mode, fovy=42.0)
    corner.pos = middle + span * np.array([-0.7, -0.85, 0.9])
    back = (corner.pos - middle) / np.linalg.norm(corner.pos - middle)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    corner.alt.type = mj.mjtOrientation.mjORIENTATION_XYAXES
    corner.alt.xyaxes = [*right, *np.cross(back, right)]
