"""Virtual pool: the vehicle, its motor controller and its pool, behind the same interfaces as a real one."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.pool.camera import PoolCamera, camera_of
    from finssim.pool.drawn_plant import SPREADS, draw_plant
    from finssim.pool.plant_spec import PlantSpec, PlantSpecError, load_plant_spec
    from finssim.pool.virtual_pool import Truth, TruthError, VirtualPool, read_truth

__all__ = [
    "PlantSpec",
    "PlantSpecError",
    "PoolCamera",
    "SPREADS",
    "Truth",
    "TruthError",
    "VirtualPool",
    "camera_of",
    "draw_plant",
    "load_plant_spec",
    "read_truth",
]

__getattr__, __dir__ = exports(__name__)
