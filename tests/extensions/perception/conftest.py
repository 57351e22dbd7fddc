"""Worlds of a few shapes, built once per session, because Newton's ray kernels are compiled for the first
world."""

import numpy as np
import pytest

pytest.importorskip("newton", reason="finssim[perception] is not installed")

import warp as wp

from finssim.extensions.perception import WorldBatch, load_world

CLEAR = "water: {attenuation: [0, 0, 0], veil: [0, 0, 0], daylight_attenuation: [0, 0, 0]}"
SCENES = {
    # Shapes far apart, so that each sensor sees one of them: direction from the origin at 5 m depth.
    "targets": f"""
about: Small balls before a camera that looks along x.
{CLEAR}
objects:
  balls_level: {{shape: sphere, radius: 0.06, position: [4, -2, -5], repeat: {{count: 3, step: [0, 2, 0]}}}}
  balls_high: {{shape: sphere, radius: 0.06, position: [4, -2, -3.5], repeat: {{count: 3, step: [0, 2, 0]}}}}
  balls_low: {{shape: sphere, radius: 0.06, position: [4, -2, -6.5], repeat: {{count: 3, step: [0, 2, 0]}}}}
viewpoint: {{position: [0, 0, -5]}}
""",
    "wall": """
about: A wall 3 m before the origin, 60 m wide and high, in murky water.
water: {attenuation: [0.5, 0.2, 0.3], veil: [0.1, 0.3, 0.2], daylight_attenuation: [0.4, 0.1, 0.15]}
light: {diffuse: 1.0, sky: [0.8, 0.9, 1.0]}
objects:
  wall: {shape: box, position: [8.5, 0, -20], size: [1, 60, 60], colour: [0.6, 0.5, 0.4]}
viewpoint: {position: [0, 0, -5]}
""",
    "floor": f"""
about: A floor 10 m down.
{CLEAR}
seabed: {{depth: 10, backscatter_strength_db: -20}}
viewpoint: {{position: [0, 0, -5]}}
""",
    "ball": f"""
about: A ball, and a post to the left.
{CLEAR}
objects:
  ball: {{shape: sphere, radius: 0.25, position: [0, 0, -5], backscatter_strength_db: -10}}
  post: {{shape: cylinder, radius: 0.1, length: 40, position: [0, 500, -5], backscatter_strength_db: -10}}
viewpoint: {{position: [-4, 0, -5]}}
""",
}


@pytest.fixture(scope="session")
def scenes(tmp_path_factory):
    """One world of each scene, by name."""
    folder, built = tmp_path_factory.mktemp("scenes"), {}

    def scene(name: str) -> WorldBatch:
        if name not in built:
            path = folder / f"{name}.yaml"
            path.write_text(SCENES[name], encoding="utf-8")
            built[name] = WorldBatch(load_world(path))
        return built[name]

    return scene


@pytest.fixture(scope="session")
def dock():
    """Three docks, drawn with seed 1."""
    batch = WorldBatch("dock", worlds=3)
    batch.draw(1)
    return batch


@pytest.fixture
def poses():
    """Function that turns positions and attitudes (xyzw) into the poses that sensors take."""

    def transforms(*rows):
        table = np.array([(*position, *attitude) for position, attitude in rows], np.float32)
        return wp.array(table, dtype=wp.transform)

    return transforms


LEVEL = (0.0, 0.0, 0.0, 1.0)
"""Attitude along the world's axes."""


@pytest.fixture
def level(poses):
    """Function that returns the pose of one level vehicle at a position, looking along x."""
    return lambda *position: poses((position, LEVEL))
