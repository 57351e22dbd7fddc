"""Images of a fixed camera above a pool: tags and tiles through a flat or rippling surface."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.sim.overhead_camera.render import OverheadCamera, Rectangle
    from finssim.sim.overhead_camera.scene import (
        ImageSensor,
        ObjectPose,
        Ripples,
        Scene,
        TagInScene,
        TiledBasin,
        WaterOptics,
    )

__all__ = [
    "TiledBasin",
    "OverheadCamera",
    "ObjectPose",
    "Rectangle",
    "Ripples",
    "Scene",
    "ImageSensor",
    "TagInScene",
    "WaterOptics",
]

__getattr__, __dir__ = exports(__name__)
