"""Images of a fixed camera above a pool: tags and tiles through a flat or rippling surface."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.sim.overhead_camera.render import OverheadCamera, Rectangle
    from finssim.sim.overhead_camera.scene import Basin, Pose, Ripples, Scene, Sensor, TagInScene, Water

__all__ = [
    "Basin",
    "OverheadCamera",
    "Pose",
    "Rectangle",
    "Ripples",
    "Scene",
    "Sensor",
    "TagInScene",
    "Water",
]

__getattr__, __dir__ = exports(__name__)
