"""Draw rays from an overhead camera into a pool, and where straight lines would end.

Run `python examples/refracted_rays.py [picture.png]`. Needs matplotlib: `pip install "finssim[view]"`.
"""

import sys

import numpy as np

from finssim.core import Camera, Interface, Lens, back_project, project

CAMERA = Camera(
    Lens(1280, 720, 540.9, 540.9, 639.5, 359.5), (0.0, 0.0, 2.17), (1.0, 0.0, 0.0, 0.0)
)  # looks down
WATER = Interface.water(0.96)
FLOOR = 0.0


def draw(path: str) -> None:
    """Draw a side view (y = 0): refracted rays, straight lines beside them, and the resulting error on the
    floor."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    pixels = np.stack([np.linspace(40.0, 1239.0, 9), np.full(9, 359.5)], axis=-1)
    rays = back_project(CAMERA, WATER, pixels)
    floor, _ = rays.at_z(FLOOR)
    air = Interface.water(0.96, n_water=1.0003)
    straight, _ = back_project(CAMERA, air, pixels).at_z(FLOOR)

    figure, axes = plt.subplots(figsize=(8.0, 4.3), layout="constrained")
    axes.axhspan(FLOOR, 0.96, color="#d6e8f2", zorder=0)
    axes.axhline(FLOOR, color="#6b5d4d", linewidth=3)
    eye = CAMERA.position
    for origin, end, line in zip(rays.origin, floor, straight, strict=True):
        axes.plot([origin[0], line[0]], [origin[2], line[2]], "--", color="#b5482a", linewidth=1.2)
        axes.plot([eye[0], origin[0], end[0]], [eye[2], origin[2], end[2]], color="#1f5673")
    shift = 100.0 * (straight[-1, 0] - floor[-1, 0])
    axes.annotate(
        f"{shift:.0f} cm", ((straight[-1, 0] + floor[-1, 0]) / 2, FLOOR), xytext=(0, -14),
        textcoords="offset points", ha="center",
    )  # fmt: skip
    axes.plot(eye[0], eye[2], "s", color="black", markersize=8)
    axes.annotate("camera", eye[[0, 2]], xytext=(10, 2), textcoords="offset points")
    axes.set(xlabel="x [m]", ylabel="z [m]", aspect="equal", ylim=(-0.25, 2.4))
    water, dashed = axes.lines[2], axes.lines[1]
    axes.legend([water, dashed], ["through the water", "straight line"], loc="upper left", frameon=False)
    figure.savefig(path, dpi=110)
    again = np.abs(project(CAMERA, WATER, floor).pixels - pixels).max()
    print(f"wrote {path}; projected again, the points on the floor miss their pixels by {again:.1e} px")


if __name__ == "__main__":
    draw(sys.argv[1] if len(sys.argv) > 1 else "refracted_rays.png")
