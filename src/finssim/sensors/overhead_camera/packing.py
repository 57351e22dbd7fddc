"""A scene as the structs that the ray caster reads, on one device."""
# mypy: disable-error-code="attr-defined,call-overload,no-untyped-call,index"

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.geometry.rotations import quat_to_matrix
from finssim.sensors.overhead_camera.materials import BasinData, BodyData, TagData
from finssim.sensors.overhead_camera.scene import Basin, Body, Light, Pose, Scene, TagInScene
from finssim.sensors.overhead_camera.scene_data import LampData, SceneData
from finssim.sensors.overhead_camera.surface import Wave, Waves, layout_of, pack_waves
from finssim.sensors.overhead_camera.view import SurfaceFrame


def pack_scene(scene: Scene, frame: SurfaceFrame, device: Any) -> SceneData:
    """Everything but tags, bodies and waves, which change from picture to picture."""
    data = SceneData()
    data.camera_height = frame.camera_height
    data.index_near, data.index_far = scene.interface.index_near, scene.interface.index_far
    layers = scene.interface.window
    data.layer_thickness = wp.array([x.thickness for x in layers], dtype=float, device=device)
    data.layer_index = wp.array([x.index for x in layers], dtype=float, device=device)
    data.caustics = 0.0 if scene.ripples is None else scene.ripples.caustics
    data.attenuation, data.veil = wp.vec3(*scene.water.attenuation), wp.vec3(*scene.water.veil)
    data.sky = scene.light.sky
    data.lamps = on_device(_lamps(scene.light, frame), LampData, device)
    data.basin = _basin(scene.basin, frame, device)
    data.shutter, data.spot = scene.sensor.shutter, scene.sensor.spot
    return data


def put_things(
    data: SceneData,
    frame: SurfaceFrame,
    tags: Sequence[TagInScene],
    bodies: Sequence[Body],
    waves: Waves | None,
    time: float,
    device: Any,
) -> None:
    """Put tags, bodies and the waves of a moment into a packed scene.

    Args:
        data: From `pack_scene`.
        frame: The surface frame.
        tags: In the scene.
        bodies: In the scene.
        waves: The surface; None for a flat one.
        time: Middle of the exposure [s].
        device: Warp device.
    """
    data.tags = on_device(_tags(tags, frame), TagData, device)
    cells = [np.asarray(tag.bitmap, np.uint8).ravel() for tag in tags]
    data.cells = on_device(np.concatenate([*cells, np.zeros(0, np.uint8)]), wp.uint8, device)
    data.bodies = on_device(_bodies(bodies, frame), BodyData, device)
    data.waves = on_device(pack_waves(waves, frame.offset, time), Wave, device)


def on_device(table: NDArray[Any], dtype: Any, device: Any) -> wp.array[Any]:
    """A contiguous table as Warp's array: its own memory on the CPU, where Warp would look at it for 0.6 ms first."""
    if not table.size:
        return wp.empty(table.shape, dtype=dtype, device=device)
    if not wp.get_device(device).is_cpu:
        return wp.array(table, dtype=dtype, device=device)
    array = wp.array(ptr=table.ctypes.data, dtype=dtype, shape=table.shape, device=device)
    array.table = table  # lives as long as the array
    return array


def _poses(table: NDArray[Any], i: int, pose: Pose, end: Pose | None, frame: SurfaceFrame) -> None:
    for pose_then, place, axes in ((pose, "start", "q_start"), (end or pose, "end", "q_end")):
        table[place][i] = frame.point(pose_then.position)
        table[axes][i] = frame.quaternion(quat_to_matrix(pose_then.orientation))
    if np.dot(table["q_start"][i], table["q_end"][i]) < 0.0:
        table["q_end"][i] *= -1.0  # the same axes, on the short way from the start
    table["moving"][i] = end is not None


def _tags(tags: Sequence[TagInScene], frame: SurfaceFrame) -> NDArray[Any]:
    table = np.zeros(len(tags), dtype=layout_of(TagData))
    offset = 0
    for i, tag in enumerate(tags):
        _poses(table, i, tag.pose, tag.end, frame)
        table["cell"][i], table["half"][i] = tag.cell, tag.half_size
        table["cells"][i], table["offset"][i] = len(tag.bitmap), offset
        table["white"][i], table["black"][i] = tag.white, tag.black
        offset += tag.bitmap.size
    return table


def _bodies(bodies: Sequence[Body], frame: SurfaceFrame) -> NDArray[Any]:
    table = np.zeros(len(bodies), dtype=layout_of(BodyData))
    for i, body in enumerate(bodies):
        _poses(table, i, body.pose, body.end, frame)
        table["half"][i], table["colour"][i] = 0.5 * np.asarray(body.size), body.colour
    return table


def _lamps(light: Light, frame: SurfaceFrame) -> NDArray[Any]:
    table = np.zeros(len(light.lamps), dtype=layout_of(LampData))
    for i, lamp in enumerate(light.lamps):
        table["centre"][i], table["half"][i] = frame.point(lamp.centre), 0.5 * np.asarray(lamp.size)
        table["radiance"][i] = lamp.radiance
    return table


def _basin(basin: Basin, frame: SurfaceFrame, device: Any) -> BasinData:
    data = BasinData()
    normal_p = frame.R_sp[2]
    data.R_bs = wp.mat33(*frame.R_sp.T.ravel())
    data.origin = wp.vec3(*frame.point(basin.lower))
    data.size = wp.vec3(*np.subtract(basin.upper, basin.lower))
    data.up = int(np.argmax(np.abs(normal_p)))
    data.up_sign = float(np.sign(normal_p[data.up]))
    data.tile, data.joint, data.variation = basin.tile, basin.joint, basin.variation
    data.colour, data.joint_colour = wp.vec3(*basin.colour), wp.vec3(*basin.joint_colour)
    middles = np.asarray(basin.lanes, np.float32) - np.float32(basin.lower[basin.lane_axis])
    data.lanes = wp.array(middles.reshape(-1), dtype=float, device=device)
    data.lane_axis, data.lane_width = basin.lane_axis, basin.lane_width
    data.lane_colour, data.deck_colour = wp.vec3(*basin.lane_colour), wp.vec3(*basin.deck_colour)
    return data
