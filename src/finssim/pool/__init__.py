"""The virtual pool: the vehicle, its motor controller and its room, behind the wires that a real one has."""

from finssim.pool.draw_plant import SPREADS, draw_plant
from finssim.pool.plant_spec import PlantSpec, PlantSpecError, load_plant_spec
from finssim.pool.virtual_pool import Truth, TruthError, VirtualPool, read_truth

__all__ = [
    "SPREADS",
    "PlantSpec",
    "PlantSpecError",
    "Truth",
    "TruthError",
    "VirtualPool",
    "draw_plant",
    "load_plant_spec",
    "read_truth",
]
