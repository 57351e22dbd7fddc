"""Page of the view and its loop."""

from __future__ import annotations

import http
import ipaddress
import math
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from itertools import groupby
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
import viser
import websockets.asyncio.server

from finssim.core.palette import BLUE, GREEN, ORANGE, PINK, SKY, VERMILION, rgb
from finssim.extensions.viewer import water
from finssim.extensions.viewer.frame import (
    BodyPose,
    LatestPicture,
    PlotLine,
    Source,
    ViewError,
    ViewFrame,
    ViewStage,
)
from finssim.extensions.viewer.shapes import (
    Mesh,
    box_edges,
    duct_mesh,
    fin_attitude,
    fin_plates,
    force_arrows,
    hull_of,
    line_of,
    propeller_mesh,
    propeller_poses,
    tag_plates,
    wxyz,
)

if TYPE_CHECKING:
    from finssim.localization.overhead_camera import Pool

__all__ = ["LONGEST_TURN", "Playback", "View", "blank", "draw_own", "draw_picture", "legend_of", "plots_of"]

# The three-dimensional part of a view: the stage is built once, and every frame moves its objects.

Colour = tuple[int, int, int]

COLOURS: dict[str, Colour] = {
    "truth": rgb(ORANGE),
    "estimate": rgb(BLUE),
    "goal": rgb(GREEN),
    "force": rgb(VERMILION),
    "trail": rgb(VERMILION),
    "box": (90, 110, 125),
    "part": (52, 58, 66),
    "propeller": (196, 204, 212),
}
"""Object -> colour."""
PICTURE_HEIGHT = 0.16
"""Size of the camera's frustum [m]."""
SPIN = 4.0 * math.pi
"""Drawn speed of a propeller at the largest thrust [rad/s]; at its real speed it would be a blur."""
LANDSCAPE = 0.8
"""Smallest aspect ratio (width / height) of a window in which the first viewpoint shows all the water."""
REGION = 2.796
"""Semi-axes of the ellipsoid that contains a normally distributed position with 95 %, in standard deviations."""


class StageScene:
    """Draws frames of one stage."""

    def __init__(self, server: viser.ViserServer, stage: ViewStage) -> None:
        """
        Args:
            server: Server of the page.
            stage: Part of the view that does not change.
        """
        self._scene, self.stage = server.scene, stage
        self._scene.set_up_direction("+z")
        self._floors, self._images = list[Any](), iter(list[Any]())
        self._light()
        self._water()
        self._fins: list[tuple[int, Any]] = []
        self._propellers = list[Any]()
        self._angles, self._time = np.zeros(len(stage.vehicle.thrusters)), math.nan
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
            _unlit(COLOURS["force"]),
            shaft_radius=0.02 * size,
            head_radius=0.05 * size,
            head_length=0.1 * size,
            visible=False,
        )
        self._trail = self._line("/trail", np.zeros((1, 2, 3)), "trail", 3.0)
        self._trail.visible = False
        self._region = self._scene.add_icosphere(
            "/region", 1.0, COLOURS["estimate"], opacity=0.3, cast_shadow=False, visible=False
        )
        self._notice = self._scene.add_label("/notice", "", visible=False)
        path = line_of(stage.path)
        if len(path):
            self._line("/path", path, "goal", 2.0)
        if stage.site is not None:
            self._camera(stage.site)
        for thing in stage.bodies:
            if thing.name == "seabed":
                self._ground(Mesh(thing.vertices, thing.faces), thing.colour, "sand")
                continue
            self._scene.add_mesh_simple(
                f"/world/{thing.name}", thing.vertices, thing.faces, color=thing.colour, flat_shading=True,
                side="double",
            )  # fmt: skip
        server.initial_camera.up = (0.0, 0.0, 1.0)
        if not server.get_clients():  # open pages are moved one by one
            self.look(server.initial_camera)

    def draw(self, frame: ViewFrame) -> None:
        """Move everything to its pose in a frame."""
        self._place("truth", frame.truth, ghost=False)
        self._place("estimate", frame.estimate, ghost=frame.truth is not None)
        self._show(self._goal, frame.goal)
        fins = list(self.stage.vehicle.actuators.values())
        for k, plate in self._fins if len(frame.values) else ():
            plate.wxyz = wxyz(fin_attitude(fins[k], float(frame.values[k])))
        self._turn(frame)
        self._shimmer(frame.time)
        self._doubt(frame)
        self._notice.visible = bool(frame.notice)
        pose = frame.truth or frame.estimate
        if frame.notice and pose is not None:
            self._notice.text, self._notice.position = frame.notice, tuple(pose.position)
        arrows = force_arrows(self.stage.vehicle, frame.force, pose) if pose else np.zeros((0, 2, 3))
        _set_points(self._arrows, arrows)
        trail = line_of(frame.trail)
        if len(trail):  # its colour approaches that of the water with age
            age = np.linspace(0.85, 0.0, len(trail) + 1)[:, None]
            colour = (1.0 - age) * COLOURS["trail"] + age * np.array(self._fog)
            self._trail.colors = _unlit(line_of(colour))
        _set_points(self._trail, trail)

    def _turn(self, frame: ViewFrame) -> None:
        """Turn the propellers by the time since the previous frame; their speed is proportional to the root
        of the force."""
        elapsed = frame.time - self._time
        self._time = frame.time
        if len(frame.force) != len(self._angles) or not abs(elapsed) < 1.0 or not self._propellers:
            return
        part = np.nan_to_num(np.asarray(frame.force, float) / np.max(np.abs(self.stage.vehicle.force_limits)))
        self._angles += SPIN * elapsed * np.sign(part) * np.sqrt(np.abs(part))
        for node in self._propellers:
            node.batched_wxyzs = propeller_poses(self.stage.vehicle, self._angles)[0].astype(np.float32)

    def _shimmer(self, time: float) -> None:
        """Show the caustics of a time [s], of the pictures computed so far."""
        image = next(self._images, None)
        if image is not None:
            self._add_floor(image)
        now = int(time * water.FRAMES / water.PERIOD) % max(len(self._floors), 1)
        for k, floor in enumerate(self._floors):
            if floor.visible != (k == now):
                floor.visible = k == now

    def _doubt(self, frame: ViewFrame) -> None:
        """Draw the ellipsoid that contains the position with a probability of 95 %, if the source has a covariance."""
        self._region.visible = frame.estimate is not None and frame.covariance is not None
        if frame.estimate is not None and frame.covariance is not None:
            variance, axes = np.linalg.eigh(frame.covariance)
            axes[:, 0] *= np.sign(np.linalg.det(axes))
            self._region.position = tuple(frame.estimate.position)
            self._region.wxyz = viser.transforms.SO3.from_matrix(axes).wxyz
            self._region.scale = tuple((REGION * np.sqrt(np.maximum(variance, 1e-8))).tolist())

    def _place(self, name: str, pose: BodyPose | None, *, ghost: bool) -> None:
        """Move a body to its pose; a ghost is drawn as a wireframe, so that it hides nothing of a body at the
        same place."""
        body, hull, thrusters = self._bodies[name]
        self._show(body, pose)
        if hull.wireframe != ghost:
            hull.wireframe, thrusters.visible = ghost, not ghost

    def _show(self, node: Any, pose: BodyPose | None) -> None:
        visible = pose is not None and bool(np.isfinite(pose.position).all())
        if visible and pose is not None:
            node.position, node.wxyz = tuple(pose.position), wxyz(pose.quaternion)
        node.visible = visible

    def _vehicle(self, name: str) -> tuple[Any, Any, Any]:
        """Return the body's node, its hull and its thrusters."""
        vehicle = self.stage.vehicle
        body = self._scene.add_frame(f"/{name}", show_axes=False, visible=False)
        mesh = hull_of(vehicle)
        hull = self._scene.add_mesh_simple(
            f"/{name}/hull", mesh.vertices, mesh.faces, color=COLOURS[name], flat_shading=True, side="double"
        )
        thrusters = self._thrusters(f"/{name}/thrusters")
        plates = tag_plates(vehicle)
        for part, plate, colour in zip(
            ("plates", "tags"), plates or (), ((250,) * 3, (25,) * 3), strict=False
        ):
            self._scene.add_mesh_simple(
                f"/{name}/{part}", plate.vertices, plate.faces, color=colour, side="double"
            )
        fins = list(vehicle.actuators.values())
        for k, plate in fin_plates(vehicle).items():
            node = self._scene.add_mesh_simple(
                f"/{name}/fins/{k}", plate.vertices, plate.faces, color=COLOURS[name], flat_shading=True,
                side="double", position=tuple(fins[k].position),
            )  # fmt: skip
            self._fins.append((k, node))
        nose = np.array([[[0.0, 0.0, 0.0], [0.75 * float(vehicle.body.size[0]), 0.0, 0.0]]])
        self._line(f"/{name}/nose", nose, name, 3.0)
        return body, hull, thrusters

    def _thrusters(self, name: str) -> Any:
        """Add ducts and propellers of a body."""
        node = self._scene.add_frame(name, show_axes=False)
        vehicle, ducts, blades = self.stage.vehicle, duct_mesh(self.stage.vehicle), propeller_mesh()
        if ducts is not None:
            self._scene.add_mesh_simple(
                f"{name}/ducts", ducts.vertices, ducts.faces, color=COLOURS["part"], side="double"
            )
        if vehicle.thrusters:
            attitudes, positions, radii = propeller_poses(vehicle, self._angles)
            self._propellers.append(
                self._scene.add_batched_meshes_simple(
                    f"{name}/propellers", blades.vertices, blades.faces, attitudes, positions, batched_scales=radii,
                    batched_colors=COLOURS["propeller"], flat_shading=True, side="double",
                )
            )  # fmt: skip
        return node

    def _light(self) -> None:
        """Add daylight from above, and water with fog at a distance and a bluer colour at depth."""
        lower, upper = self.stage.lower, self.stage.upper
        depth, reach = float(-lower[2]), float(np.linalg.norm(upper - lower))
        self._fog = water.water_colour(depth)
        self._scene.set_background_image(water.backdrop(depth))
        self._scene.configure_fog(0.7 * reach, 3.0 * reach, color=self._fog)
        self._scene.configure_default_lights(False)
        self._scene.configure_environment_map(None)
        self._scene.add_light_hemisphere(
            "/light/sky", sky_color=(232, 246, 255), ground_color=(150, 190, 205), intensity=1.7
        )
        self._scene.add_light_directional(
            "/light/sun",
            color=(255, 250, 235),
            intensity=2.0,
            cast_shadow=True,
            position=(-0.3, -0.2, 1.0),
        )

    def _water(self) -> None:
        """Add the pool's walls and floor, or the edges of a box, and the surface."""
        lower, upper = self.stage.lower, self.stage.upper
        if self.stage.walls:
            self._ground(water.floor(lower, upper), water.TILES, "tiles")
            self._scene.add_mesh_trimesh("/pool/walls", water.walls(lower, upper), cast_shadow=False)
        self._line("/pool/edges", box_edges(lower, upper), "box", 1.5)
        top = np.array([*upper[:2], 0.0])
        self._scene.add_mesh_trimesh("/pool/surface", water.surface(lower, top), cast_shadow=False)

    def _ground(self, mesh: Mesh, colour: Colour, pattern: Literal["tiles", "sand"]) -> None:
        """Add the floor with caustics: one picture now, the others while frames are drawn."""
        self._floor = mesh
        self._images = water.floor_images(colour, pattern, float(-mesh.vertices[:, 2].mean()))
        self._add_floor(next(self._images))

    def _add_floor(self, image: Image) -> None:
        mesh = water.draped(self._floor.vertices, self._floor.faces, image)
        name, first = f"/floor/{len(self._floors)}", not self._floors
        self._floors.append(self._scene.add_mesh_trimesh(name, mesh, cast_shadow=False, visible=first))

    def _camera(self, site: Pool) -> None:
        """Add the overhead camera at its calibrated pose."""
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
        colours = np.broadcast_to(_unlit(COLOURS[colour]), points.shape)
        return self._scene.add_line_segments(name, points, colours, thickness=width, thickness_units="screen")

    def look(self, camera: Any, aspect: float = LANDSCAPE) -> None:
        """Place a camera beside and above the water; on a phone farther away, with the water above the panel.

        Args:
            camera: Camera of a page, or the initial one.
            aspect: Aspect ratio of the window, width / height [-].
        """
        lower, upper = self.stage.lower, self.stage.upper
        middle, reach = 0.5 * (lower + upper), float(np.linalg.norm(upper - lower))
        if aspect < LANDSCAPE:
            reach *= LANDSCAPE / max(aspect, 0.1)
            middle[2] -= 0.12 * reach
        camera.position = tuple(middle + reach * np.array([-0.31, -0.56, 0.52]))
        camera.look_at = tuple(middle)


def _unlit(colour: npt.ArrayLike) -> Image:
    """Return colours for lines and arrows, 0 to 255, (..., 3), encoded because viser shows these without sRGB
    decoding."""
    return np.asarray(255.0 * (np.asarray(colour) / 255.0) ** 2.2).astype(np.uint8)


def _set_points(node: Any, points: Array) -> None:
    if len(points):
        node.points = points.astype(np.float32)
    node.visible = bool(len(points))


# Curves for the browser's plots.

LINES = (VERMILION, BLUE, GREEN, PINK)
"""Colours, in the order of the curves."""


class Plot:
    """Curves of one title, with the same times."""

    def __init__(self, title: str, curves: Sequence[PlotLine]) -> None:
        self.title, self.curves = title, list(curves)

    def data(self, now: float) -> tuple[Array, ...]:
        """Return the time, and for every curve all its values and those up to a time [s], from the first time
        with all values.

        The browser's plot scales to the first values, and draws nothing if one of these is NaN.
        """
        finite = np.all([np.isfinite(curve.value) for curve in self.curves], axis=0)
        begin = int(np.argmax(finite))
        time = self.curves[0].time[begin:]
        past = time <= max(now, float(time[0])) + 1e-9
        columns = [time]
        for curve in self.curves:
            columns += [curve.value[begin:], np.where(past, curve.value[begin:], np.nan)]
        return tuple(np.ascontiguousarray(column, float) for column in columns)

    def series(self) -> tuple[Any, ...]:
        """Return the lines: for each curve a faint one of all values and a solid one of its past."""
        drawn: list[Any] = [{"label": "t [s]"}]
        for curve, colour in zip(self.curves, LINES, strict=False):
            drawn += [{"label": "", "stroke": f"{colour}40", "width": 1}]
            drawn += [{"label": curve.label, "stroke": colour, "width": 2}]
        return tuple(drawn)


def plots_of(curves: Sequence[PlotLine]) -> list[Plot]:
    """Return curves grouped by title, in the order in which titles first appear."""
    order = list(dict.fromkeys(curve.plot for curve in curves))
    sorted_curves = sorted(curves, key=lambda curve: order.index(curve.plot))
    return [Plot(title, list(same)) for title, same in groupby(sorted_curves, key=lambda curve: curve.plot)]


def legend_of(plots: Sequence[Plot]) -> str:
    """Return the colours of the curves as markup; curves of the same index in their plots share label and colour."""
    labels = dict.fromkeys(
        (colour, curve.label) for plot in plots for colour, curve in zip(LINES, plot.curves, strict=False)
    )
    return " · ".join(f'<span style="color:{colour}">■</span> {label}' for colour, label in labels)


# The clock of a view: it runs at a speed, pauses, and can be set.

SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Speeds to choose from, relative to real time."""
LONGEST_TURN = 0.1
"""Largest advance per turn of the loop at single speed [s]; a source slower than real time slows the clock down."""

NEARLY = 0.05
"""Distance from its end at which a recording is over [s], because a slider need not reach it exactly."""


class Playback:
    """Present time of the view in a source."""

    def __init__(self, duration: float, *, speed: float = 1.0, playing: bool = True) -> None:
        """
        Args:
            duration: Duration of the source [s]; infinite for a live one.
            speed: Speed factor relative to real time.
            playing: Whether it runs from the start.
        """
        self.duration, self.speed, self.playing = duration, speed, playing
        self.time = 0.0
        """Time of the view [s]."""

    @property
    def live(self) -> bool:
        """Return whether the source is live: without an end, and without going back in time."""
        return math.isinf(self.duration)

    def advance(self, elapsed: float) -> float:
        """Advance by a real time [s] and return the new time [s]. A recording stops at its end."""
        if self.playing:
            self.time += min(elapsed, LONGEST_TURN) * self.speed
            if self.time >= self.duration:
                self.time, self.playing = self.duration, False
        return self.time

    def play(self, playing: bool) -> None:
        """Run or pause; at the end, run from the beginning."""
        if playing and self.time >= self.duration - NEARLY:
            self.time = 0.0
        self.playing = playing

    def seek(self, time: float) -> None:
        """Set the time [s], within that of the source; without effect for a live one."""
        if not self.live:
            self.time = min(max(time, 0.0), self.duration)


# The camera's picture with outlines of the tags, in the panel's size, and the tags enlarged in a corner.

Image = npt.NDArray[np.uint8]
Array = npt.NDArray[np.float64]

WIDTH = 480
"""Smallest width of the drawn picture, if the camera has as many pixels [px]."""
DARK, LINE, FIRST = (30, 45, 58), (40, 230, 90), (255, 70, 60)
"""Background without a picture, outline of a tag, and its first edge."""
COPPER = np.array([1.25, 0.78, 0.5])
"""Colour of a sonar's picture: red, green, blue."""
INSET = 70
"""Half the edge of the enlarged part [px of the camera]."""
ENLARGED = 1.5
"""Magnification of that part of the camera's picture."""


def blank() -> Image:
    """Return the picture that is shown before the first one, (h, w, 3)."""
    return np.full((WIDTH * 9 // 16, WIDTH, 3), DARK, np.uint8)


def draw_picture(picture: LatestPicture) -> Image:
    """Return a picture in colours, reduced by an integer factor, (h, w, 3)."""
    rows, columns = picture.size if picture.image is None else picture.image.shape[:2]
    every = max(1, columns // WIDTH)
    if picture.image is None:
        full = np.full((rows, columns, 3), DARK, np.uint8)
    else:
        full = np.repeat(picture.image[:, :, None], 3, axis=2)
    canvas = np.ascontiguousarray(full[::every, ::every])
    outlines = [np.asarray(tag.corners, float) for tag in picture.tags]
    for corners in outlines:
        _outline(canvas, corners / every, reach=0)
    if outlines:
        _inset(canvas, full, outlines)
    return canvas


def draw_own(image: Image) -> Image:
    """Return the picture of an own camera, or of a sonar in copper colours, enlarged by an integer factor,
    (h, w, 3)."""
    if image.ndim == 2:
        image = np.clip(image[..., None] * COPPER, 0, 255).astype(np.uint8)
    times = max(1, -(-WIDTH // image.shape[1]))
    return np.ascontiguousarray(image.repeat(times, axis=0).repeat(times, axis=1))


def _inset(canvas: Image, full: Image, outlines: list[Array]) -> None:
    """Draw the surroundings of the tags, enlarged, in the lower left corner."""
    middle = np.concatenate(outlines).mean(axis=0)
    size = min(round(2 * INSET * ENLARGED), canvas.shape[0], canvas.shape[1])
    first = middle - 0.5 * size / ENLARGED
    x, y = ((first[:, None] + (np.arange(size) + 0.5) / ENLARGED).round().astype(int)).clip(0)
    part = full[np.minimum(y, full.shape[0] - 1)][:, np.minimum(x, full.shape[1] - 1)].copy()
    for corners in outlines:
        _outline(part, (corners - first) * ENLARGED, reach=1)
    part[:2], part[:, -2:] = 255, 255
    canvas[-size:, :size] = part


def _outline(image: Image, corners: Array, reach: int) -> None:
    """Draw a tag's edges as lines with `reach` pixels to either side, clipped to the picture."""
    for i in range(4):
        a, b = corners[i], corners[(i + 1) % 4]
        if not np.isfinite([a, b]).all():
            continue
        steps = int(np.ceil(np.abs(b - a).max())) + 1
        x, y = np.linspace(a, b, min(steps, 4000)).round().astype(int).T
        for dx in range(-reach, reach + 1):
            for dy in range(-reach, reach + 1):
                u, v = x + dx, y + dy
                inside = (u >= 0) & (v >= 0) & (u < image.shape[1]) & (v < image.shape[0])
                image[v[inside], u[inside]] = FIRST if i == 0 else LINE


# The side panel of a view: clock, health, the camera's picture, events and plots.

SLIDER_STEP = 0.02
"""Step of the time slider [s]."""
LABEL = 0.25
"""Space for an event's name, as a share of the slider."""


class Panel:
    """Controls and values of a stage."""

    def __init__(self, server: viser.ViserServer, stage: ViewStage, playback: Playback) -> None:
        """
        Args:
            server: Server of the page.
            stage: Part of the view that does not change.
            playback: Clock that the controls set.
        """
        self._server, self._gui, self._playback = server, server.gui, playback
        self._gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self._gui.set_panel_label("FinsSim")
        self._gui.main_panel.dock_right()
        self._gui.add_markdown(f"**{stage.title}**  \n{_legend()}")
        self._slider: Any = None
        self._button: Any = None
        self._speed: Any = None
        self._shown = 0.0
        self._controls(playback, stage.events)
        self._status = self._gui.add_markdown("")
        self._image: Any = None
        if stage.site is not None:
            with self._gui.add_folder("camera"):
                self._image = self._gui.add_image(blank(), jpeg_quality=70)
        self._seen: LatestPicture | None = None
        self._eyes = {}
        for name in stage.eyes:
            with self._gui.add_folder(name):
                self._eyes[name] = self._gui.add_image(blank(), jpeg_quality=80)
        self._own: dict[str, Image] = {}
        with self._gui.add_folder("errors") as self._figures:
            self._named = self._gui.add_markdown("")
        self._plots: dict[tuple[str, ...], Any] = {}
        with self._gui.add_folder("events"):
            self._events = self._gui.add_markdown("none yet")
        self._last_events: tuple[str, ...] = ()

    def read(self) -> None:
        """Apply the settings of the controls."""
        playback = self._playback
        playback.speed = float(self._speed.value.removesuffix("x"))
        label = "pause" if playback.playing else "play"
        if self._button.label != label:
            self._button.label = label
        if self._slider is not None and abs(self._slider.value - self._shown) > 0.5 * SLIDER_STEP:
            playback.seek(float(self._slider.value))
            self._shown = float(self._slider.value)

    def show(self, frame: ViewFrame) -> None:
        """Show a frame's values on the panel."""
        playback = self._playback
        if self._slider is None:
            self._clock.content = f"{frame.time:.1f} s"
        elif self._shown != playback.time:
            self._slider.value = self._shown = min(round(playback.time, 2), self._slider.max)
        rows = "".join(f"| {name} | {text} |\n" for name, text in frame.status.items())
        content = f"| | |\n|---|---|\n{rows}" if rows else ""
        if content != self._status.content:
            self._status.content = content
        if self._image is not None and frame.picture is not self._seen:
            self._seen = frame.picture
            self._image.image = blank() if frame.picture is None else draw_picture(frame.picture)
        for name, eye in self._eyes.items():
            image = frame.pictures.get(name)
            if image is not None and image is not self._own.get(name):
                self._own[name] = image
                eye.image = draw_own(image)
        events = tuple(frame.events)
        if events != self._last_events:
            self._last_events = events
            self._events.content = "  \n".join(_plain(line) for line in reversed(events)) or "none yet"

    def plot(self, curves: Any, now: float) -> None:
        """Draw curves; their part up to a time [s] is solid."""
        plots = plots_of(curves)
        named = legend_of(plots)
        if named != self._named.content:
            self._named.content = named
        for plot in plots:
            key = (plot.title, *(curve.label for curve in plot.curves))
            if key not in self._plots:
                for old in [k for k in self._plots if k[0] == plot.title]:
                    self._plots.pop(old).remove()
                with self._figures:
                    self._plots[key] = self._gui.add_uplot(
                        plot.data(now),
                        plot.series(),
                        title=plot.title,
                        scales={"x": {"time": False}},
                        legend={"show": False},
                        aspect=2.0,
                    )
            else:
                self._plots[key].data = plot.data(now)

    def _controls(self, playback: Playback, events: Sequence[tuple[float, str]]) -> None:
        gui = self._gui
        if playback.live:
            self._clock = gui.add_markdown("0.0 s")
        else:
            steps = max(1, math.floor(playback.duration / SLIDER_STEP))
            end = round(steps * SLIDER_STEP, 2)
            marks = event_marks(events, end)
            self._slider = gui.add_slider("time [s]", 0.0, end, SLIDER_STEP, 0.0, marks=marks or None)
        self._button = gui.add_button("pause" if playback.playing else "play")
        speeds = tuple(f"{speed:g}x" for speed in SPEEDS)
        first = f"{playback.speed:g}x"
        options = speeds if first in speeds else (first, *speeds)
        self._speed = gui.add_dropdown("speed", options, initial_value=first)
        self._button.on_click(lambda _: playback.play(not playback.playing))


def event_marks(events: Sequence[tuple[float, str]], end: float) -> tuple[float | tuple[float, str], ...]:
    """Return marks of a slider from 0 to `end` [s]: each event's time, and its kind if there is space for it."""
    marks: list[float | tuple[float, str]] = []
    free = 0.0
    for moment, text in events:
        at = min(max(round(moment, 2), 0.0), end)
        kind = text.removeprefix("vision: ").partition(":")[0]
        marks.append((at, kind) if at >= free else at)
        free = at + LABEL * end if at >= free else free
    return tuple(marks)


def _legend() -> str:
    names = ("truth", "estimate", "goal", "force")
    return " · ".join(
        f'<span style="color:rgb{COLOURS[name]}">■</span> {name}'.replace(", ", ",") for name in names
    )


def _plain(text: str) -> str:
    """Return a line with all markup escaped."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]<>#|" else c for c in text)


TITLE = "FinsSim view"
ICON = (
    "data:image/svg+xml,<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 32 32'>"
    f"<rect width='32' height='32' rx='7' fill='{BLUE}'/><path fill='#fff' d='M7 20C13 18 16 12 17 4c4 5 7 10 8 16z'/>"
    f"<path fill='none' stroke='{SKY}' stroke-width='3' d='M3 26q4.3-4 8.6 0t8.7 0t8.7 0'/></svg>"
)
"""Name of the page, and its icon: a fin above water."""
PHONE = (
    "<style>@media (max-width: 36em) {"
    ".mantine-Paper-root[style*='fixed'] { width: 100% !important; max-height: 45% !important; }"
    ".mantine-Paper-root[style*='fixed'] [style*='20em'] { width: 100% !important; } }</style>"
)
"""Style for phones: viser's panel is a sheet at the bottom, as wide as the page and low enough not to hide
the scene."""
RATE = 20.0
"""Frame rate [Hz]."""
PLOT_PERIOD = 0.5
"""Time between two updates of the plots [s]."""


def _check_address(bind: str) -> None:
    """Raise for an address that is not this machine's, for which viser would wait without limit."""
    try:
        family, *_, address = socket.getaddrinfo(bind, 0, type=socket.SOCK_STREAM)[0]
        socket.create_server(address[:2], family=family).close()
    except (OSError, UnicodeError) as error:
        reason = (getattr(error, "strerror", None) or str(error)).partition(" (")[0]
        raise ViewError(f"--bind {bind}: {reason}: give an address of this machine") from None


def _own_guests(bind: str) -> Callable[[Any, Any], Any]:
    """Return a function that answers requests of other pages with 403.

    A page of another site can open a WebSocket to any address, and its host name can resolve to this machine.
    Therefore the host that a browser requests must be an address, `localhost` or this machine's name, and the
    origin of a WebSocket must be this page.

    Args:
        bind: Address at which the page is served.
    """
    own = socket.gethostname().lower()
    names = {"localhost", own, f"{own}.local", bind.lower()}

    def check(connection: Any, request: Any) -> Any:
        host, upgrade = request.headers.get("Host", ""), request.headers.get("Upgrade", "")
        name = re.sub(r":\d*$", "", host).strip("[]").lower()
        if name not in names and not _is_address(name):
            return connection.respond(http.HTTPStatus.FORBIDDEN, f"{host[:80]} is no name of this page\n")
        if upgrade and request.headers.get("Origin", "").lower() != f"http://{host}".lower():
            return connection.respond(http.HTTPStatus.FORBIDDEN, "only the page itself may connect\n")
        return None

    return check


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _titled(page: Any) -> Any:
    """Set the title and icon of the page in the response to its request."""
    if page is not None and page.headers.get("Content-Type", "").startswith("text/html"):
        page.body = page.body.replace(b"<title>Viser</title>", f"<title>{TITLE}</title>{PHONE}".encode(), 1)
        page.body = re.sub(
            rb"data:image/svg\+xml,[^\"]*", ICON.replace("#", "%23").encode(), page.body, count=1
        )
        del page.headers["Content-Length"]
        page.headers["Content-Length"] = str(len(page.body))
    return page


@contextmanager
def _only_own_pages(bind: str) -> Iterator[None]:
    """Let a server that viser starts in this context check who connects, and set the page's title; viser
    offers neither."""
    serve, check = websockets.asyncio.server.serve, _own_guests(bind)

    def checked(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            refusal = check(connection, request)
            if refusal is not None or process_request is None:
                return refusal
            if "Accept-Encoding" in request.headers:
                del request.headers["Accept-Encoding"]  # so that the page is sent uncompressed
            return _titled(process_request(connection, request))

        return serve(*arguments, process_request=answer, **options)

    with _STARTING:
        websockets.asyncio.server.serve = checked  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            websockets.asyncio.server.serve = serve  # type: ignore[misc]


_STARTING = threading.Lock()


class View:
    """Page that shows a source. `run` is its loop, `turn` one iteration of it."""

    def __init__(
        self,
        source: Source | None = None,
        *,
        bind: str = "127.0.0.1",
        port: int = 8080,
        speed: float = 1.0,
        playing: bool = True,
    ) -> None:
        """Serve the page.

        Args:
            source: Source to show, which the view closes; None shows nothing before `show`.
            bind: Address to serve at; by default only this machine.
            port: Port to serve at; if it is in use, the next free one.
            speed: Speed factor relative to real time.
            playing: Whether it runs from the start.
        """
        _check_address(bind)
        with (
            redirect_stdout(StringIO()),
            _only_own_pages(bind),
        ):  # viser prints messages at start and end even if verbosity is off
            self.server = viser.ViserServer(host=bind, port=port, label="FinsSim", verbose=False)
        self.server.on_client_connect(self._opened)
        self._speed, self._playing = speed, playing
        self.source: Source | None = None
        if source is not None:
            self.show(source)
        host = "localhost" if bind in ("0.0.0.0", "::") else bind
        self.url = f"http://{host}:{self.server.get_port()}"
        """URL of the page."""

    def show(self, source: Source) -> None:
        """Show a source from its beginning, instead of the previous one, which is closed."""
        if self.source is not None:
            self.source.close()
        with self.server.atomic():
            self.server.scene.reset()
            self.server.gui.reset()
            self.playback = Playback(source.duration, speed=self._speed, playing=self._playing)
            self.scene = StageScene(self.server, source.stage)
            self.panel = Panel(self.server, source.stage, self.playback)
            self.source = source
        self._drawn, self._plotted, self._since_plot = math.nan, math.nan, math.inf
        for page in self.server.get_clients().values():
            self.scene.look(page.camera, page.camera.aspect)

    def _opened(self, page: viser.ClientHandle) -> None:
        if self.source is not None:
            self.scene.look(page.camera, page.camera.aspect)

    def turn(self, elapsed: float) -> None:
        """Advance by a real time [s], and draw the changes."""
        if self.source is None:
            return
        self.panel.read()
        now = self.playback.advance(elapsed)
        self._since_plot += elapsed
        if now != self._drawn:
            frame = self.source.frame(now)
            with self.server.atomic():
                self.scene.draw(frame)
                self.panel.show(frame)
            self._drawn = now
        if now != self._plotted and self._since_plot >= PLOT_PERIOD:
            self.panel.plot(self.source.curves(), now)
            self._plotted, self._since_plot = now, 0.0

    def run(self, until: Callable[[], bool], *, clock: Callable[[], float] = time.monotonic) -> None:
        """Show the source until `until` returns true."""
        before = clock()
        while not until():
            now = clock()
            self.turn(now - before)
            before = now
            time.sleep(max(0.0, 1.0 / RATE - (clock() - now)))

    def close(self) -> None:
        """Stop the server and close the source."""
        with redirect_stdout(StringIO()):
            self.server.stop()
        if self.source is not None:
            self.source.close()
