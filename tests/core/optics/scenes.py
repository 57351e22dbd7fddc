"""Lenses, interfaces and points shared by the tests of optics: each test runs over every member."""

import numpy as np

from finssim.core.optics import Camera, Interface, Layer, Lens
from finssim.core.rotations import matrix_to_quat, quat_from_rotvec, quat_multiply

SIZE = {"width": 1280, "height": 720, "fx": 540.9, "fy": 538.2, "cx": 652.2, "cy": 348.6}

LENSES = {
    "pinhole": Lens(**SIZE),
    "plumb_bob": Lens(**SIZE, distortion=(0.02944176, -0.05975546, 0.00088098, 0.00179148, 0.01256862)),
    "barrel": Lens(**SIZE, distortion=(-0.31, 0.12, -0.002, 0.0015)),
    "rational": Lens(**SIZE, model="rational", distortion=(0.5, 0.1, 1e-3, -8e-4, 0.01, 0.8, 0.2, 0.02)),
    "fisheye": Lens(**SIZE, model="fisheye", distortion=(-0.02, 0.005, -0.003, 0.0005)),
    "wide": Lens(1280, 720, 300.0, 300.0, 640.0, 360.0, "fisheye", (0.03, -0.004, 0.0, 0.0)),
}
"""Lenses by name; the second is FinsROV's overhead camera, the last sees 120 degrees to each side."""

SMALL_TURN = quat_from_rotvec([0.08, -0.05, 0.3])


def camera(lens: Lens, interface: Interface, height: float = 1.2) -> Camera:
    """Return a camera at a distance [m] from an interface that it faces, except for a small rotation."""
    e1, e2 = interface.tangents()
    R_pc = np.stack([e1, -e2, -interface.normal], axis=-1)
    position = interface.normal * (height - interface.offset) + 0.03 * e1 - 0.17 * e2
    return Camera(lens, position, quat_multiply(matrix_to_quat(R_pc), SMALL_TURN))


def points(interface: Interface, count: int = 200, spread: float = 0.8, seed: int = 0) -> np.ndarray:
    """Return points on the far side, up to `spread` m sideways and 2 m behind the far face."""
    rng = np.random.default_rng(seed)
    e1, e2 = interface.tangents()
    x, y = rng.uniform(-spread, spread, (2, count, 1))
    depth = rng.uniform(0.0, 2.0, (count, 1)) + interface.thickness
    return -interface.normal * (interface.offset + depth) + x * e1 + y * e2


GLASS = Layer(0.010, 1.49)

INTERFACES = {
    "surface": Interface.water(0.96),
    "tilted 20 degrees": Interface.water(0.96, tilt_x=np.radians(20.0), tilt_y=0.05),
    "wall": Interface.through((0.4, 0.1, 0.0), (1.0, 0.0, 0.0)),
    "wall, y up": Interface.through((0.0, 0.1, -0.4), (0.0, 0.1, 1.0)),
    "window": Interface.through((0.4, 0.1, 0.0), (0.0, 1.0, 0.0), window=(GLASS,)),
    "two layers": Interface.through((0.0, 0.0, 0.5), (0.1, 0.0, 1.0), window=(GLASS, Layer(0.02, 1.6))),
    "z down": Interface.through((0.0, 0.0, 0.96), (0.0, 0.0, -1.0)),
    "air gap": Interface.through(
        (0.0, 0.0, 0.5), (0.0, 0.0, 1.0), index_near=1.333, window=(Layer(0.05, 1.0),)
    ),
    "from the water": Interface.through(
        (0.0, 0.0, 0.0), (0.0, 0.0, -1.0), index_near=1.333, index_far=1.0003
    ),
    "equal": Interface.through((0.0, 0.0, 0.3), (0.0, 0.2, 1.0), index_near=1.333, index_far=1.333),
}
