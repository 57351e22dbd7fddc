"""The three-dimensional part of a view: the stage is built once, and every frame moves what moves."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import viser

from finssim.localization.pool import Pool
from finssim.viewer.frame import Frame, Pose, Stage
from finssim.viewer.shapes import box_edges, force_arrows, hull_of, line_of, tag_plates, wall_mesh, wxyz

__all__ = ["COLOURS", "Scene"]

Array = npt.NDArray[np.float64]
Colour = tuple[int, int, int]

COLOURS: dict[str, Colour] = {
    "truth": (240, 140, 20),
    "estimate": (40, 110, 235),
    "goal": (20, 160, 80),
    "force": (215, 30, 60),
    "trail": (200, 110, 10),
    "wall": (214, 228, 236),
    "water": (70, 150, 205),
    "box": (90, 110, 125),
}
"""What is drawn in which colour."""
PICTURE_HEIGHT = 0.16
"""Of the frustum that stands for the camera [m]."""


class Scene:
    """Draws frames of one stage."""

    def __init__(self, server: viser.ViserServer, stage: Stage) -> None:
        """
        Args:
            server: Of the page.
            stage: What stands still.
        """
        self._scene, self.stage = server.scene, stage
        self._scene.set_up_direction("+z")
        self._scene.configure_default_lights(True, cast_shadow=False)
        self._water()
        self._bodies = {name: self._vehicle(name) for name in ("truth", "estimate")}
        size = float(np.max(stage.vehicle.body.size))
        self._goal = self._scene.add_frame(
            "/goal",
            axes_length=0.6 * size,
            axes_radius=0.02 * size,
            origin_radius=0.05 * size,
            origin_color=COLOURS["goal"],
            visible=False,
        )
        self._arrows = self._scene.add_arrows(
            "/forces",
            np.zeros((1, 2, 3)),
            COLOURS["force"],
            shaft_radius=0.02 * size,
            head_radius=0.05 * size,
            head_length=0.1 * size,
            visible=False,
        )
        self._trail = self._line("/trail", np.zeros((1, 2, 3)), "trail", 2.5)
        self._trail.visible = False
        path = line_of(stage.path)
        if len(path):
            self._line("/path", path, "goal", 2.0)
        if stage.site is not None:
            self._camera(stage.site)
        self._look(server)

    def draw(self, frame: Frame) -> None:
        """Move everything to where it is in a frame."""
        self._place("truth", frame.truth, ghost=False)
        self._place("estimate", frame.estimate, ghost=frame.truth is not None)
        self._show(self._goal, frame.goal)
        shown = frame.truth or frame.estimate
        arrows = force_arrows(self.stage.vehicle, frame.force, shown) if shown else np.zeros((0, 2, 3))
        _set_points(self._arrows, arrows)
        _set_points(self._trail, line_of(frame.trail))

    def _place(self, name: str, pose: Pose | None, *, ghost: bool) -> None:
        """Put a body where it is; a ghost is a net of lines, which hides nothing of the body that it lies upon."""
        body, hull = self._bodies[name]
        self._show(body, pose)
        if hull.wireframe != ghost:
            hull.wireframe = ghost

    def _show(self, node: Any, pose: Pose | None) -> None:
        known = pose is not None and bool(np.isfinite(pose.position).all())
        if known and pose is not None:
            node.position, node.wxyz = tuple(pose.position), wxyz(pose.quaternion)
        node.visible = known

    def _vehicle(self, name: str) -> tuple[Any, Any]:
        """The body's node and its hull."""
        vehicle = self.stage.vehicle
        body = self._scene.add_frame(f"/{name}", show_axes=False, visible=False)
        mesh = hull_of(vehicle)
        hull = self._scene.add_mesh_simple(
            f"/{name}/hull", mesh.vertices, mesh.faces, color=COLOURS[name], flat_shading=True, side="double"
        )
        plates = tag_plates(vehicle)
        for part, plate, colour in zip(
            ("plates", "tags"), plates or (), ((250,) * 3, (25,) * 3), strict=False
        ):
            self._scene.add_mesh_simple(
                f"/{name}/{part}", plate.vertices, plate.faces, color=colour, side="double"
            )
        nose = np.array([[[0.0, 0.0, 0.0], [0.75 * float(vehicle.body.size[0]), 0.0, 0.0]]])
        self._line(f"/{name}/nose", nose, name, 3.0)
        return body, hull

    def _water(self) -> None:
        """Walls and floor, or the edges of a box, and the surface."""
        lower, upper = self.stage.lower, self.stage.upper
        if self.stage.walls:
            walls = wall_mesh(lower, upper)
            self._scene.add_mesh_simple(
                "/pool/walls", walls.vertices, walls.faces, color=COLOURS["wall"], flat_shading=True
            )
            width, length = float(upper[0] - lower[0]), float(upper[1] - lower[1])
            middle = (*(0.5 * (lower + upper)[:2]).tolist(), float(lower[2]) + 0.003)
            self._scene.add_grid(
                "/pool/floor", width, length, cell_size=0.25, section_size=1.0, position=middle
            )
        self._line("/pool/edges", box_edges(lower, upper), "box", 1.5)
        x0, y0, x1, y1 = *lower[:2], *upper[:2]
        surface = np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])
        self._scene.add_mesh_simple(
            "/pool/surface",
            surface,
            np.array([[0, 1, 2], [0, 2, 3]]),
            color=COLOURS["water"],
            opacity=0.16,
            side="double",
            cast_shadow=False,
        )

    def _camera(self, site: Pool) -> None:
        """The overhead camera where its calibration has it."""
        lens, T = site.camera.lens, site.T_wp
        T_pc = np.eye(4)
        T_pc[:3, 3] = site.camera.position
        rotation = viser.transforms.SO3.from_quaternion_xyzw(np.asarray(site.camera.orientation, float))
        T_pc[:3, :3] = rotation.as_matrix()
        pose = viser.transforms.SE3.from_matrix(T @ T_pc)
        self._scene.add_camera_frustum(
            "/camera",
            fov=2.0 * math.atan(0.5 * lens.height / lens.fy),
            aspect=lens.width / lens.height,
            scale=PICTURE_HEIGHT,
            thickness=0.008,
            color=COLOURS["box"],
            position=pose.translation(),
            wxyz=pose.rotation().wxyz,
        )

    def _line(self, name: str, points: Array, colour: str, width: float) -> Any:
        return self._scene.add_line_segments(
            name, points, COLOURS[colour], thickness=width, thickness_units="screen"
        )

    def _look(self, server: viser.ViserServer) -> None:
        """Where the eye is at first: beside and above the water."""
        lower, upper = self.stage.lower, self.stage.upper
        middle, reach = 0.5 * (lower + upper), float(np.linalg.norm(upper - lower))
        server.initial_camera.look_at = tuple(middle)
        server.initial_camera.position = tuple(middle + reach * np.array([-0.31, -0.56, 0.52]))
        server.initial_camera.up = (0.0, 0.0, 1.0)


def _set_points(node: Any, points: Array) -> None:
    if len(points):
        node.points = points.astype(np.float32)
    node.visible = bool(len(points))
