"""Hull faces per second of the mesh drag, completely submerged: `python benchmarks/mesh_faces.py [device]`."""

import argparse
import json
import time

import warp as wp

from finssim.core.mesh import parametric_hull
from finssim.physics.hydrodynamics.mesh import HullMesh, hull_mesh, mesh_displacement, mesh_drag
from finssim.physics.types import vec6

wp.set_module_options({"enable_backward": False})


@wp.kernel
def drag_of_many(hull: HullMesh, nu: wp.array(dtype=vec6), height: float, tau: wp.array(dtype=vec6)):
    i = wp.tid()
    up = wp.vec3(0.0, 0.0, 1.0)
    no_shear = wp.matrix_from_rows(wp.vec3(0.0), wp.vec3(0.0), wp.vec3(0.0))
    tau[i] = mesh_drag(hull, 0, nu[i], wp.vec3(0.1, 0.0, 0.0), no_shear, 1027.0, 1.0, 0.02, up, height)


@wp.kernel
def displacement_of_many(hull: HullMesh, height: float, buoyancy: wp.array(dtype=wp.vec4)):
    i = wp.tid()
    buoyancy[i] = mesh_displacement(hull, 0, wp.vec3(0.0, 0.0, 1.0), height + 0.0001 * float(i % 100))


def faces_per_second(
    device: str = "cpu", worlds: int = 1024, height: float = -1.0, seconds: float = 1.0
) -> float:
    """Faces per second of `mesh_drag` on a hull of 320 triangles, on one core if the device is the CPU.

    Args:
        device: Warp device.
        worlds: Vehicles in one launch.
        height: Height of the body origin above the surface [m]; the hull is 0.3 m high.
        seconds: How long to measure; the best launch counts.

    Returns:
        Faces per second.
    """
    hull = hull_mesh([parametric_hull((0.5, 0.4, 0.3), 0.035)], device)
    nu = wp.full(worlds, vec6(0.4, -0.2, 0.1, 0.3, 0.2, -0.5), dtype=vec6, device=device)
    tau = wp.empty(worlds, dtype=vec6, device=device)
    command = wp.launch(drag_of_many, worlds, [hull, nu, height], [tau], device=device, record_cmd=True)
    return worlds * len(hull.face) / _best(command.launch, seconds, device)


def displacement_faces_per_second(device: str = "cpu", worlds: int = 1024, seconds: float = 1.0) -> float:
    """Return faces per second of `mesh_displacement` with the hull partly out of the water."""
    hull = hull_mesh([parametric_hull((0.5, 0.4, 0.3), 0.035)], device)
    buoyancy = wp.empty(worlds, dtype=wp.vec4, device=device)
    command = wp.launch(
        displacement_of_many, worlds, [hull, 0.03], [buoyancy], device=device, record_cmd=True
    )
    return worlds * len(hull.face) / _best(command.launch, seconds, device)


def _best(launch, seconds: float, device: str) -> float:
    """Return the shortest time of one launch [s]."""
    launch()
    best, end = float("inf"), time.perf_counter() + seconds
    while time.perf_counter() < end:
        begin = time.perf_counter()
        launch()
        wp.synchronize_device(device)
        best = min(best, time.perf_counter() - begin)
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("device", nargs="?", default="cpu", help="Warp device")
    device = parser.parse_args().device
    wp.config.quiet = True
    result = {
        "device": wp.get_device(device).name,
        "drag_submerged_faces_per_second": faces_per_second(device),
        "drag_at_surface_faces_per_second": faces_per_second(device, height=0.03),
        "displacement_at_surface_faces_per_second": displacement_faces_per_second(device),
    }
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
