"""What the vehicle of a task sees: a world drawn anew for each episode, and the pictures of its cameras."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.engine.simulator import Simulator
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.given import EnvironmentSetupError
from finssim.vehicles import Vehicle

if TYPE_CHECKING:
    from finssim.tasks.task import Task

DRAWS = 1_000_003
"""Between the seeds of a world's draws from episode to episode."""
SETTLING = 3
"""Pictures that automatic exposure has taken before the first of an episode."""


def first_draw(seed: int) -> int:
    """Seed of the draw of the first episode's worlds, from that of the environment."""
    return seed + DRAWS


@dataclass(frozen=True)
class Picture:
    """A picture that a task observes."""

    name: str
    """Of the entry in the vehicle's `perception`, such as `front_camera`."""
    width: int | None = None
    """Columns [px], in place of the entry's; the height follows."""


@wp.kernel(enable_backward=False)
def _copy_masked(
    mask: wp.array(dtype=int), source: wp.array4d(dtype=wp.uint8), out: wp.array4d(dtype=wp.uint8)
):
    w, i = wp.tid()
    if mask[w] != 0:
        for j in range(source.shape[2]):
            for k in range(source.shape[3]):
                out[w, i, j, k] = source[w, i, j, k]


@wp.kernel(enable_backward=False)
def _fill_masked(mask: wp.array(dtype=int), value: wp.vec3, out: wp.array(dtype=wp.vec3)):
    w = wp.tid()
    if mask[w] != 0:
        out[w] = value


class Sight:
    """The world around the vehicle of a task, in as many copies as there are, and the pictures it takes.

    Attributes:
        batch: The world's copies.
        pictures: What has arrived by now, by name; uint8 (worlds, height, width, 3), on the device.
        final_pictures: The last of the episodes that ended last, the same shapes.
    """

    def __init__(self, task: Task, simulator: Simulator, arrays: TaskArrays, seed: int) -> None:
        """Build the world and the cameras; `begin` takes the first pictures.

        Raises:
            EnvironmentSetupError: Newton is not installed, or the task has several vehicles.
            WorldError: The site or the vehicle's camera is refused.
        """
        if len(simulator.vehicles) > 1:
            raise EnvironmentSetupError(f"task '{task.name}' has several vehicles: only one can see")
        from finssim.worlds import WorldBatch, poses_of

        self._task, self._state, self._arrays, self.seed = task, simulator.state, arrays, seed
        self._poses_of, self._vehicle = poses_of, simulator.vehicles[0]
        try:
            self.batch = WorldBatch(task.world, simulator.worlds, str(simulator.device))
        except ModuleNotFoundError as error:
            raise EnvironmentSetupError(
                f"task '{task.name}' sees, which needs {error.name}: pip install 'finssim[perception]'"
            ) from error
        self._poses = wp.zeros(simulator.worlds, dtype=wp.transform, device=simulator.device)
        self._mask = wp.zeros(simulator.worlds, dtype=int, device=simulator.device)
        self._cameras = {one.name: self._camera(one, self._vehicle) for one in task.pictures}
        self.pictures = {name: camera.reading for name, camera in self._cameras.items()}
        self.final_pictures = {name: wp.zeros_like(picture) for name, picture in self.pictures.items()}
        self._episodes = np.zeros(simulator.worlds, np.int64)

    def _camera(self, picture: Picture, vehicle: Vehicle) -> Any:
        from finssim.worlds import CameraBatch, Delivery, device_of
        from finssim.worlds.description import CameraDevice

        device = device_of(vehicle, picture.name)
        if not isinstance(device, CameraDevice):
            raise EnvironmentSetupError(
                f"{vehicle.name}: perception.{picture.name} is no camera, which task '{self._task.name}' expects"
            )
        entry = vehicle.perception[picture.name]
        return Delivery(
            CameraBatch(self.batch, device, width=picture.width), control_step=self._task.control_step,
            rate=entry.rate, latency=entry.latency, loss=entry.dropout, seed=self.seed,
        )  # fmt: skip

    def restart(self, seed: int, mask: NDArray[np.bool_] | None = None) -> None:
        """Start the draws of some worlds over with a seed, of all if mask is None, and noise with them."""
        self.seed = seed
        self._episodes[slice(None) if mask is None else mask] = 0
        if mask is None:
            for camera in self._cameras.values():
                camera.restart(seed)

    def draw(self, mask: NDArray[np.bool_]) -> None:
        """Draw worlds for the episodes that begin where mask is true, (worlds,); the goal is the task's `landmark`."""
        self._episodes[mask] += 1
        seeds = first_draw(self.seed) + DRAWS * (self._episodes - 1)
        self.batch.draw(seeds, mask, held_out=self._task.held_out)
        pose = self.batch.poses(self._task.landmark).astype(np.float32)
        self._arrays.goal_position.assign(np.ascontiguousarray(pose[:, :3]))
        self._arrays.goal_quaternion.assign(np.ascontiguousarray(pose[:, 3:]))

    def begin(self, mask: NDArray[np.bool_]) -> None:
        """Take the first pictures of the episodes that have begun where mask is true, (worlds,)."""
        self._mask.assign(mask.astype(np.int32))
        poses = self._poses_of(self._state, self._poses)
        for camera in self._cameras.values():
            sensor = camera.sensor
            gain = wp.vec3(sensor.camera.sensor.gain)
            wp.launch(_fill_masked, len(mask), [self._mask, gain, sensor.gain], device=sensor.device)
            for _ in range(SETTLING):
                sensor.update(poses, mask=self._mask)
        self.take()

    def take(self) -> None:
        """Take the pictures that are due after a control step, and let arrive what has come."""
        poses = self._poses_of(self._state, self._poses)
        for camera in self._cameras.values():
            camera.update(poses, self._state.steps, self._state.episode)

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Keep the last pictures of the episodes that end where mask is true, (worlds,)."""
        self._mask.assign(mask.astype(np.int32))
        for name, picture in self.pictures.items():
            inputs = [self._mask, picture, self.final_pictures[name]]
            wp.launch(_copy_masked, picture.shape[:2], inputs, device=picture.device)

    def arrays(self) -> Iterator[tuple[str, wp.array]]:
        """The arrays on the device that decide what is seen next, by name."""
        for name, camera in self._cameras.items():
            yield f"sight.{name}.gain", camera.sensor.gain
            yield from ((f"sight.{name}.{key}", array) for key, array in camera.arrays())

    def counters(self) -> dict[str, NDArray[Any]]:
        """What else does, as copies."""
        updates = np.array([camera.updates for camera in self._cameras.values()])
        return {"drawn": self.batch.drawn, "episodes": self._episodes.copy(), "updates": updates}

    def load_counters(self, saved: dict[str, NDArray[Any]]) -> None:
        """Take what `counters` gave."""
        self.batch.drawn, self._episodes[:] = saved["drawn"], saved["episodes"]
        for camera, updates in zip(self._cameras.values(), saved["updates"], strict=True):
            camera.updates = int(updates)

    def describe(self) -> dict[str, dict[str, Any]]:
        """The pictures as a policy directory has them: device, shape (height, width, 3), rate [Hz], latency [s]."""
        entries = {name: self._vehicle.perception[name] for name in self._cameras}
        return {
            name: {
                "device": entry.device,
                "shape": list(self.pictures[name].shape[1:]),
                "rate": entry.rate,
                "latency": entry.latency,
            }
            for name, entry in entries.items()
        }
