"""Bundle of rays on each of many vehicles: the common part of cameras, imaging sonars, altimeters and DVL beams.

Each sensor reads the poses of N vehicles, and leaves its results in arrays on the device:

    batch = WorldBatch("dock", worlds=256)
    camera = CameraBatch(batch, load_device("low_light_camera"), width=64)
    picture = camera.update(poses, seed=step)      # uint8 (256, 48, 64, 3)

Newton's ray caster computes depth, shape and normal of every ray; the sensors' modules compute light and sound from
these. All sensors request the same three outputs, so that the ray caster's kernel is compiled only once.
"""
# mypy: ignore-errors

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from finssim.extensions.perception.description import WorldError
from finssim.extensions.perception.model import Optics, WorldBatch
from finssim.vehicles.device_files import DeviceMount

wp.set_module_options({"enable_backward": False})

MISS = wp.constant(wp.uint32(0xFFFFFFFF))
SKIPPED = wp.constant(-101)
"""World index of a view whose outputs Newton leaves unchanged (`WorldRenderFlag.DISABLE_PRESERVE`)."""


@wp.struct
class Traced:
    """Bundle of rays of many views, and the hit of each ray."""

    rays: wp.array4d(dtype=wp.vec3)  # (rows, columns, 2): origin [m] and unit direction, sensor axes
    views: wp.array(dtype=wp.transform)  # sensor to world [m, quaternion]
    worlds: wp.array(dtype=int)  # world of each view, or SKIPPED
    dimming: wp.array(dtype=wp.vec3)  # daylight at the view's depth as a fraction of that at the surface [-]
    depth: wp.array3d(dtype=float)  # along the ray [m]
    shape_index: wp.array3d(dtype=wp.uint32)  # index of the shape, or MISS
    normal: wp.array3d(dtype=wp.vec3)  # world axes, unit


@wp.kernel(enable_backward=False)
def _place_views(
    poses: wp.array(dtype=wp.transform),
    mount: wp.transform,
    world_of_view: wp.array(dtype=int),
    mask: wp.array(dtype=int),
    optics: Optics,
    traced: Traced,
):
    """Compute the sensor poses of the views, their worlds or SKIPPED, and daylight at their depths."""
    v = wp.tid()
    traced.worlds[v] = SKIPPED
    if mask.shape[0] > 0:
        if mask[v] == 0:
            return
    traced.worlds[v] = world_of_view[v]
    traced.views[v] = wp.transform_multiply(poses[v], mount)
    depth = wp.max(-wp.transform_get_translation(traced.views[v])[2], 0.0)
    K = optics.daylight_attenuation[world_of_view[v]]
    traced.dimming[v] = wp.vec3(wp.exp(-K[0] * depth), wp.exp(-K[1] * depth), wp.exp(-K[2] * depth))


@wp.kernel(enable_backward=False)
def _join_poses(
    position: wp.array2d(dtype=wp.vec3), quaternion: wp.array2d(dtype=wp.quat), poses: wp.array(dtype=wp.transform)
):  # fmt: skip
    w, v = wp.tid()
    poses[w * position.shape[1] + v] = wp.transform(position[w, v], quaternion[w, v])


def poses_of(state: Any, poses: wp.array | None = None) -> wp.array:
    """Return the poses of all vehicles of a simulator, in the form that sensors expect.

    Args:
        state: The simulator's `state`: `position` and `quaternion` by (world, vehicle).
        poses: Array to fill with the poses [m, quaternion]; None: a new one.

    Returns:
        Body to world of each vehicle [m, quaternion], in order of world; transform (worlds · vehicles,).
    """
    if poses is None:
        poses = wp.zeros(state.position.size, dtype=wp.transform, device=state.position.device)
    inputs = [state.position, state.quaternion, poses]
    wp.launch(_join_poses, state.position.shape, inputs, device=poses.device)
    return poses


class RayBatch:
    """Bundle of rays for each of N vehicles, the base of all ray sensors.

    Args:
        batch: The worlds. Vehicles are ordered by world, with an equal number in each.
        rays: The bundle of unit vectors, sensor axes, (rows, columns, 2, 3).
        mount: Pose of the sensor on its vehicle.
        vehicles: Number of vehicles in each world.
    """

    reading: wp.array
    """Result of `update`, in the unit of the sensor; one row for each vehicle."""

    def __init__(self, batch: WorldBatch, rays: np.ndarray, mount: DeviceMount, vehicles: int = 1) -> None:
        self.batch, self.device, self.count = batch, batch.device, batch.worlds * vehicles
        shape = (self.count, *rays.shape[:2])
        with wp.ScopedDevice(self.device):
            self.rays = wp.array(np.float32(rays[:, :, None]), dtype=wp.vec3)
            self.depth, self.normal = wp.zeros(shape, dtype=float), wp.zeros(shape, dtype=wp.vec3)
            self.shape_index = wp.zeros(shape, dtype=wp.uint32)
            self.world_of_view = wp.array(np.arange(self.count) // vehicles, dtype=int)
            self.views = wp.zeros(self.count, dtype=wp.transform)
            self.dimming = wp.zeros(self.count, dtype=wp.vec3)
            self.worlds = wp.zeros(self.count, dtype=int)
            self._all = wp.zeros(0, dtype=int)
        self.traced = Traced()
        for name in Traced.vars:
            setattr(self.traced, name, getattr(self, name))
        self._mount = wp.transform(wp.vec3(*mount.position), wp.quat(*map(float, mount.quaternion)))

    def _span(self, columns: int) -> int:
        """Return the number of row elements per thread: one on a GPU, so that neighbours coalesce; the full
        row on a CPU."""
        return 1 if self.device.is_cuda else columns

    def _blocks(self, array: wp.array) -> tuple[int, int, int]:
        """Return the numbers of threads over an array of (views, rows, columns)."""
        views, rows, columns = array.shape[:3]
        return views, rows, columns // self._span(columns)

    def cast(self, poses: wp.array, mask: wp.array | None = None) -> None:
        """Trace the rays: depth from the point where each enters the water [m], index of the shape, normal.

        Args:
            poses: Body to world of each vehicle, xyzw; transform (N,) on the batch's device [m].
            mask: Vehicles whose sensors measure; the outputs of the others stay unchanged. int (N,); all if None.

        Raises:
            WorldError: The number of poses differs from that of the vehicles.
        """
        if len(poses) != self.count:
            raise WorldError(
                f"{len(poses)} poses for {self.count} vehicles: give one for each, in order of world"
            )
        inputs = [poses, self._mount, self.world_of_view, self._all if mask is None else mask]
        inputs += [self.batch.optics, self.traced]
        wp.launch(_place_views, self.count, inputs, device=self.device)
        self.batch.caster.update(
            self.batch.state,
            self.views,
            self.rays,
            depth_image=self.depth,
            normal_image=self.normal,
            shape_index_image=self.shape_index,
            world_indices=self.worlds,
            sync_deformables=False,
        )
