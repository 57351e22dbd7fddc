"""Rest pose of a rigid box on the solids of a described world, by MuJoCo: an independent reference of contacts.

MuJoCo's contacts are hard and its shapes are its own; only the geometry of the world and the vehicle's file are shared.
"""

import mujoco as mj
import numpy as np

from finssim.core.frames import wxyz_from_xyzw
from finssim.sim.solids import solid_shapes

SHELL = 1.0e-3
"""Half the thickness of a mesh [m]."""


def rest_pose(vehicle, layout, start, seconds=8.0):
    """Return position [m] and rotation matrix (body to world) of the vehicle's envelope box, released level at `start`.

    The body has the weight, the buoyancy and the centres of the vehicle's file, and linear drag [N s/m, N m s/rad].
    """
    spec = mj.MjSpec()
    spec.option.timestep, spec.option.gravity = 0.01, [0.0, 0.0, -vehicle.water.gravity]
    spec.option.cone = mj.mjtCone.mjCONE_ELLIPTIC
    for k in solid_shapes(layout):
        _add_solid(spec, layout, k)
    body = spec.worldbody.add_body(name="vehicle", pos=start)
    body.add_freejoint()
    file = vehicle.body
    body.explicitinertial, body.mass, body.ipos = True, file.mass, np.asarray(file.center_of_gravity, float)
    body.inertia = [1.0, 1.0, 1.0]
    body.add_geom(type=mj.mjtGeom.mjGEOM_BOX, size=0.5 * np.asarray(file.size, float))
    model = spec.compile()
    data = mj.MjData(model)
    buoyancy = np.array([0.0, 0.0, vehicle.water.density * vehicle.water.gravity * file.displaced_volume])
    above = np.asarray(file.center_of_buoyancy, float) - np.asarray(file.center_of_gravity, float)
    index = model.body("vehicle").id
    for _ in range(round(seconds / model.opt.timestep)):
        R = data.xmat[index].reshape(3, 3)
        drag, turn_drag = -60.0 * data.qvel[:3], -2.0 * R @ data.qvel[3:]
        data.xfrc_applied[index] = [*(buoyancy + drag), *(np.cross(R @ above, buoyancy) + turn_drag)]
        mj.mj_step(model, data)
    mj.mj_kinematics(model, data)
    return data.xpos[index].copy(), data.xmat[index].reshape(3, 3).copy()


def _add_solid(spec, layout, k):
    """Add one shape of the layout's first world; a mesh as a flex of triangles, since a geom is its convex hull."""
    shape, pose = layout.shapes[k], layout.transforms.numpy()[0, k].astype(float)
    scale, name = float(layout.scales.numpy()[0, k]), f"solid{k}"
    position, attitude = pose[:3], wxyz_from_xyzw(pose[3:])
    common = {"priority": 1, "friction": [layout.world.contact.friction, 0.005, 0.0001]}
    if shape.kind == "mesh":
        spec.worldbody.add_body(name=name, pos=position, quat=attitude)
        flex = spec.add_flex(name=name, dim=2, radius=SHELL, **common)
        flex.vert = (scale * np.asarray(shape.vertices)).ravel().tolist()
        flex.elem = np.asarray(shape.faces).ravel().tolist()
        flex.vertbody, flex.selfcollide = [name] * len(shape.vertices), mj.mjtFlexSelf.mjFLEXSELF_NONE
        return
    kind, size = shape.kind, [scale * length for length in shape.size]
    if shape.heights is not None:
        kind, low, high = "hfield", float(shape.heights.min()), float(shape.heights.max())
        rows, columns = shape.heights.shape
        spec.add_hfield(
            name=name, nrow=rows, ncol=columns, size=[shape.size[0], shape.size[1], high - low, 1.0],
            userdata=((shape.heights - low) / (high - low)).ravel().tolist(),
        )  # fmt: skip
        common["hfieldname"], position = name, position + [0.0, 0.0, low]
    elif kind == "plane":
        size = [0.0, 0.0, 0.05]  # without end
    spec.worldbody.add_geom(
        type=getattr(mj.mjtGeom, f"mjGEOM_{kind.upper()}"),
        size=size,
        pos=position,
        quat=attitude,
        **common,
    )
