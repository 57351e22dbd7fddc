"""Pictures of one world of an environment for human viewers: from behind and above its first vehicle, in its water."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.core.rotations import quat_from_euler, quat_from_yaw, quat_rotate, quat_yaw
from finssim.extensions.perception.description import Object, Variation, World
from finssim.tasks.environment import Environment
from finssim.tasks.validation import EnvironmentSetupError
from finssim.vehicles.device_files import CameraDevice

COLOURS = ((0.95, 0.45, 0.04), (0.10, 0.45, 0.90), (0.85, 0.10, 0.15), (0.55, 0.75, 0.15))
"""Colours of the vehicles' floats, in turn."""
PARTS: dict[str, tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...] | None]] = {
    "float": ((0.0, 0.0, 0.28), (1.0, 1.0, 0.44), None),
    "frame": ((0.0, 0.0, -0.22), (0.86, 0.86, 0.5), (0.12, 0.13, 0.15)),
    "dome": ((0.46, 0.0, -0.1), (0.1, 0.3, 0.3), (0.7, 0.9, 0.95)),
}
"""Boxes of a vehicle: middle and size relative to its envelope, and colour."""
BEHIND, ABOVE = 3.2, 1.1
"""Distance of the camera behind and above the vehicle [vehicle lengths]."""


class ChaseCamera:
    """Renderer of one world, with its vehicles as boxes, and a ball at the goal unless the world contains a
    landmark.

    A task without a world is drawn in a tiled basin of its arena's size.
    """

    def __init__(self, environment: Environment, site: World, world: int = 0, width: int = 640) -> None:
        """Build a copy of the world that also contains the vehicles.

        Args:
            environment: Environment that is shown.
            site: World that is drawn around a task without one.
            world: Index of the world.
            width: Width of the pictures [px]; their height is 9/16 of it.

        Raises:
            EnvironmentSetupError: Newton is not installed.
        """
        from finssim.extensions.perception.cameras import CameraBatch
        from finssim.extensions.perception.model import WorldBatch

        self._environment, self._index = environment, world
        sight, task = environment.sight, environment.task
        site = site if sight is None else sight.batch.world
        self._landmark = task.landmark
        objects = dict(site.objects) if sight is not None else {}
        free = Variation()
        for v, vehicle in enumerate(environment.simulator.vehicles):
            name, size = f"vehicle_{v}", np.array(vehicle.body.size, float)
            objects[name] = Object(shape="group", position=[0.0, 0.0, 0.0], vary=free)
            for part, (position, share, colour) in PARTS.items():
                objects[f"{name}_{part}"] = Object(
                    shape="box", frame=name, position=(size * position).tolist(), size=(size * share).tolist(),
                    colour=list(colour or COLOURS[v % len(COLOURS)]),
                )  # fmt: skip
        self._length = float(environment.simulator.vehicles[0].body.size[0])
        if not task.landmark:
            objects["goal"] = Object(
                shape="sphere", position=[0.0, 0.0, 0.0], radius=0.12 * self._length, vary=free,
                colour=[0.2, 0.9, 0.2], glow=[0.05, 0.4, 0.05],
            )  # fmt: skip
        changes: dict[str, Any] = {"objects": objects}
        arena = task.arena()
        self._room = None if sight is not None or arena is None else (arena.length, arena.width, arena.depth)
        if sight is None:
            basin = site.basin.model_copy(update={"size": np.array(self._room)}) if self._room else None
            changes["basin"] = basin
        try:
            self._batch = WorldBatch(site.model_copy(update=changes), 1, str(environment.device))
        except ModuleNotFoundError as error:
            raise EnvironmentSetupError(
                f"pictures need {error.name}: pip install 'finssim[perception]'"
            ) from error
        device = CameraDevice(
            about="a chase camera", source="-", width=width, height=9 * width // 16, focal_length=0.62 * width,
            white_balance=0.6, rate=10.0,
        )  # fmt: skip
        self._camera = CameraBatch(self._batch, device)
        self._poses = wp.zeros(1, dtype=wp.transform, device=environment.device)
        self._settled = False

    def picture(self) -> NDArray[np.uint8]:
        """Return a picture of the present state of the world; uint8 (height, width, 3), row 0 at the top."""
        environment, w, batch = self._environment, self._index, self._batch
        state = environment.simulator.state
        x, q = state.position.numpy()[w].astype(float), state.quaternion.numpy()[w].astype(float)
        if environment.sight is not None:
            batch.copy_draw(environment.sight.batch, w)
        for v in range(len(x)):
            batch.move(f"vehicle_{v}", np.concatenate([x[v], q[v]]))
        if not self._landmark:
            goal = environment.arrays.goal_position.numpy()[w]
            batch.move("goal", np.concatenate([goal, [0.0, 0.0, 0.0, 1.0]]))
        yaw = float(quat_yaw(q[0]))
        offset = self._length * np.array([-BEHIND, 0.0, ABOVE])
        eye = x[0] + quat_rotate(quat_from_yaw(yaw), offset)
        eye[2] = min(eye[2], -0.06)
        if self._room is not None:  # keep the camera inside the basin, looking towards the vehicle
            half = 0.5 * np.array(self._room[:2]) - 0.05
            eye[:2] = np.clip(eye[:2], -half, half)
            eye[2] = max(eye[2], 0.05 - self._room[2])
        ahead = x[0] + quat_rotate(quat_from_yaw(yaw), [0.5 * self._length, 0.0, 0.0]) - eye
        pitch = np.arctan2(-ahead[2], np.hypot(ahead[0], ahead[1]))
        attitude = quat_from_euler(0.0, pitch, np.arctan2(ahead[1], ahead[0]))
        self._poses.assign(np.float32([[*eye, *attitude]]))
        for _ in range(1 if self._settled else 8):  # automatic exposure
            self._camera.update(self._poses)
        self._settled = True
        picture: NDArray[np.uint8] = self._camera.picture.numpy()[0].copy()
        return picture
