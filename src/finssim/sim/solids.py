"""Solids of a described world in the layout of the kernels, and the free water around vehicles."""
# mypy: disable-error-code="index,no-untyped-def,untyped-decorator,valid-type"

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from finssim.core.mesh import MeshError, check_closed
from finssim.physics.plant import VehicleParameters
from finssim.physics.solids import NEIGHBOURS, Solids, free_water
from finssim.physics.types import linear
from finssim.sim.midpoint import WALL_STEP
from finssim.sim.plant_arrays import SimulatorError
from finssim.sim.site import RectangularPool, described_world
from finssim.sim.state import State

KINDS = ("box", "sphere", "capsule", "cylinder", "plane", "mesh", "heightfield")
"""Shapes in the order of the constants of `finssim.physics.solids`."""


def layout_of(world: Any, worlds: int, device: wp.Device) -> Any:
    """Return the layout of a world in the given number of copies; create it if only a world or its name is given.

    Raises:
        SimulatorError: The layout has another number of worlds, or is on another device.
    """
    if isinstance(world, str | Path):
        world = described_world(world)
    world = world.layout(worlds, str(device))
    if world.worlds != worlds or world.device != device:
        raise SimulatorError(
            f"the world has {world.worlds} copies on {world.device}, expected {worlds} on {device}: make it so"
        )
    return world


def pool_of(world: Any) -> RectangularPool | None:
    """Return the basin of a world as walls and a floor; None if the world has no basin."""
    if world.basin is None:
        return None
    length, width, depth = map(float, world.basin.size)
    c = world.contact
    return RectangularPool(
        length=length, width=width, depth=depth, stiffness=c.stiffness, damping=c.damping, friction=c.friction
    )


def solid_shapes(layout: Any) -> list[int]:
    """Return the indices of the shapes of a layout, other than the basin, that vehicles collide with."""
    return [
        k
        for k, shape in enumerate(layout.shapes)
        if shape.owner != "basin" and getattr(shape.finish, "solid", True)
    ]


class WorldSolids:
    """Shapes that a vehicle can collide with, other than the basin: the struct for the kernels, and its arrays."""

    def __init__(self, layout: Any, vehicles: int, lightest: float) -> None:
        """Collect the solid shapes of a layout.

        Args:
            layout: Layout of the world.
            vehicles: Number of vehicles in each world.
            lightest: Least mass of any vehicle along an axis, added mass included [kg].
        """
        device = layout.device
        chosen = solid_shapes(layout)
        shapes = [layout.shapes[k] for k in chosen]
        self.count = len(shapes)
        contact, solids = layout.world.contact, Solids()
        self.meshes: dict[int, wp.Mesh] = {}
        """Meshes by the id of their vertices; kept alive for the kernels."""
        size, bound = np.array([shape.size for shape in shapes], np.float32).reshape(-1, 3), []
        for row, shape in zip(size, shapes, strict=True):
            a, b, c = map(float, shape.size)
            reach = {"box": math.hypot(a, b, c), "sphere": a, "capsule": a + b, "cylinder": math.hypot(a, b)}
            if shape.kind == "mesh":
                points, faces = np.asarray(shape.vertices), np.asarray(shape.faces)
                row[0] = _is_closed(points, faces)
                bound.append(np.linalg.norm(points, axis=1).max())
                if id(shape.vertices) not in self.meshes:
                    self.meshes[id(shape.vertices)] = wp.Mesh(
                        wp.array(np.float32(points), dtype=wp.vec3, device=device),
                        wp.array(np.int32(faces).ravel(), dtype=int, device=device),
                    )
            else:
                bound.append(reach.get(shape.kind, 1e9))
        heights = next((s.heights for s in shapes if s.heights is not None), np.zeros((2, 2)))
        field = next((s.size for s in shapes if s.kind == "heightfield"), (1.0, 1.0, 0.0))
        steps = np.diff(heights, axis=1) / (2.0 * field[0] / (heights.shape[1] - 1))
        rises = np.diff(heights, axis=0) / (2.0 * field[1] / (heights.shape[0] - 1))
        solids.gentle = 1.0 / math.sqrt(1.0 + np.abs(steps).max() ** 2 + np.abs(rises).max() ** 2)
        with wp.ScopedDevice(device):
            solids.kind = wp.array([KINDS.index(shape.kind) for shape in shapes], dtype=int)
            solids.size, solids.bound = (
                wp.array(size, dtype=wp.vec3),
                wp.array(np.float32(bound), dtype=float),
            )
            ids = [self.meshes[id(s.vertices)].id if s.kind == "mesh" else 0 for s in shapes]
            solids.shape = wp.array(np.array(chosen, np.int32), dtype=int)
            solids.mesh = wp.array(np.array(ids, np.uint64), dtype=wp.uint64)
            solids.heights = wp.array(np.float32(heights), dtype=float)
            by_vehicle = (layout.worlds, vehicles)
            solids.drawn, solids.count = wp.full(by_vehicle, -1, dtype=int), wp.zeros(by_vehicle, dtype=int)
            solids.near = wp.zeros((*by_vehicle, NEIGHBOURS), dtype=int)
            solids.force, solids.reach = wp.zeros(by_vehicle, dtype=float), wp.zeros(by_vehicle, dtype=float)
        solids.pose, solids.scale, solids.draws = layout.transforms, layout.scales, layout.draws
        solids.stiffness, solids.damping, solids.friction = (
            contact.stiffness,
            contact.damping,
            contact.friction,
        )
        # With an eighth of the mass on each contact point: half a radian of its oscillation, one time constant.
        quick = min(
            0.5 * math.sqrt(lightest / 8.0 / contact.stiffness), lightest / 8.0 / max(contact.damping, 1e-9)
        )
        solids.step = min(WALL_STEP, quick)
        self.struct = solids


def _is_closed(points: Any, faces: Any) -> bool:
    try:
        check_closed(points, faces)
    except MeshError:
        return False
    return True


@wp.kernel(enable_backward=False)
def refresh_clearing(
    state: State,
    solids: Solids,
    plant: wp.array2d(dtype=VehicleParameters),
    control_step: float,
    world_offset: int,
):
    """Update the nearest solids of vehicles that may leave their sphere of free water in this control step of
    `control_step` [s].
    """
    i, v = wp.tid()
    w = world_offset + i
    solids.force[w, v] = 0.0
    position = state.position[w, v]
    clearing = state.clearing[w, v]
    around = wp.length(plant[w, v].half_size)
    way = 2.0 * control_step * wp.length(linear(state.velocity[w, v])) + 0.02
    end = wp.length(position - wp.vec3(clearing[0], clearing[1], clearing[2])) + way
    if solids.drawn[w, v] != solids.draws[w] or not (end + around < clearing[3] or end < solids.reach[w, v]):
        solids.drawn[w, v] = solids.draws[w]
        solids.reach[w, v] = way + 0.1
        free = free_water(solids, w, v, position, around + way + 0.1)
        state.clearing[w, v] = wp.vec4(position[0], position[1], position[2], free)
