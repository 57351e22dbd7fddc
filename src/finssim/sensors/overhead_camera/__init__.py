"""What a fixed camera above a pool sees: tags, tiles and bodies through a flat or rippling surface."""

from finssim.sensors.overhead_camera.render import OverheadCamera, Rectangle, render
from finssim.sensors.overhead_camera.scene import (
    Basin,
    Body,
    Lamp,
    Light,
    Pose,
    Ripples,
    Scene,
    Sensor,
    TagInScene,
    Water,
)

__all__ = [
    "Basin",
    "Body",
    "Lamp",
    "Light",
    "OverheadCamera",
    "Pose",
    "Rectangle",
    "Ripples",
    "Scene",
    "Sensor",
    "TagInScene",
    "Water",
    "render",
]
