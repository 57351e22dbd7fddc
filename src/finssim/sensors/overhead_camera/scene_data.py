"""A scene as the ray caster reads it."""
# mypy: ignore-errors

import warp as wp

from finssim.sensors.overhead_camera.materials import BasinData, BodyData, TagData
from finssim.sensors.overhead_camera.surface import Wave


@wp.struct
class LampData:
    """A bright rectangle parallel to the surface."""

    centre: wp.vec3  # [m]
    half: wp.vec2  # half lengths [m]
    radiance: float


@wp.struct
class SceneData:
    """All that rays can meet, surface frame."""

    camera_height: float  # above the still surface [m]
    index_near: float
    index_far: float
    layer_thickness: wp.array(dtype=float)  # of the window, from the camera [m]
    layer_index: wp.array(dtype=float)
    waves: wp.array(dtype=Wave)
    caustics: float
    attenuation: wp.vec3  # [1/m]
    veil: wp.vec3
    sky: float
    lamps: wp.array(dtype=LampData)
    basin: BasinData
    tags: wp.array(dtype=TagData)
    cells: wp.array(dtype=wp.uint8)
    bodies: wp.array(dtype=BodyData)
    shutter: float  # [s]
    spot: float  # [px]
