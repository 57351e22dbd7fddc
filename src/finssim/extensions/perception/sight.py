"""Perception of the site in a task: a world drawn for each episode, pictures of cameras and sonars, and ranges."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.core.rotations import quat_inverse_rotate
from finssim.sim.simulator import Simulator
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.validation import EnvironmentSetupError
from finssim.vehicles.device_files import CameraDevice, RangeDevice, SonarDevice, device_of

if TYPE_CHECKING:
    from finssim.extensions.perception.description import World
    from finssim.extensions.perception.layout import WorldLayout
    from finssim.extensions.perception.model import WorldBatch
    from finssim.tasks.task import Task

DRAWS = 1_000_003
"""Difference between the seeds of a world's draws of consecutive episodes."""
SETTLING = 3
"""Number of pictures that automatic exposure takes before the first one of an episode."""


def first_draw(seed: int) -> int:
    """Return the seed of the draw of the first episode's worlds, from that of the environment."""
    return seed + DRAWS


def put_goal(task: Task, layout: WorldLayout, arrays: TaskArrays) -> None:
    """Set a task's goal to the pose of its landmark, if any, and the reference to the positions of its marks."""
    if not task.landmark:
        return
    pose = layout.poses(task.landmark)
    arrays.goal_position.assign(np.float32(pose[:, :3]))
    arrays.goal_quaternion.assign(np.float32(pose[:, 3:]))
    if task.marks:
        places = [
            quat_inverse_rotate(pose[:, 3:], layout.poses(name)[:, :3] - pose[:, :3]) for name in task.marks
        ]
        arrays.reference.position.assign(np.float32(np.stack(places, axis=1)))


def drawn_for(task: Task, world: World, arrays: TaskArrays, seed: int) -> WorldBatch:
    """Return one copy of a world, drawn as for the first episode of a task, with the task's goal at the landmark."""
    from finssim.extensions.perception.model import WorldBatch

    batch = WorldBatch(world)
    batch.draw(first_draw(seed), held_out=task.held_out)
    put_goal(task, batch, arrays)
    return batch


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
def _copy_rows(mask: wp.array(dtype=int), source: wp.array2d(dtype=float), out: wp.array2d(dtype=float)):
    w, i = wp.tid()
    if mask[w] != 0:
        out[w, i] = source[w, i]


@wp.kernel(enable_backward=False)
def _fill_masked(mask: wp.array(dtype=int), value: wp.vec3, out: wp.array(dtype=wp.vec3)):
    w = wp.tid()
    if mask[w] != 0:
        out[w] = value


class Sight:
    """World around the vehicle of a task, one copy per simulated world, with the sensors' measurements.

    Attributes:
        batch: Copies of the world.
        pictures: Latest pictures that arrived, by name; uint8 (worlds, height, width, 3), of a sonar (worlds,
            beams, range cells, 1), on the device.
        final_pictures: Last pictures of the episodes that ended most recently, in the same shapes.
    """

    def __init__(self, task: Task, world: World, simulator: Simulator, arrays: TaskArrays, seed: int) -> None:
        """Build the world and the sensors; `begin` takes the first pictures.

        Raises:
            EnvironmentSetupError: Newton is not installed, the task has several vehicles, or a sensor is of another
                kind than the task expects.
            WorldError: The site or the vehicle's sensor is refused.
        """
        if len(simulator.vehicles) > 1:
            raise EnvironmentSetupError(
                f"task '{task.name}' has several vehicles: only tasks with one can have sensors of a world"
            )
        from finssim.extensions.perception import CameraBatch, RangeBatch, SonarBatch, WorldBatch, poses_of

        self._task, self._state, self._arrays, self.seed = task, simulator.state, arrays, seed
        self._poses_of, self._vehicle = poses_of, simulator.vehicles[0]
        try:
            self.batch = WorldBatch(world, simulator.worlds, str(simulator.device))
        except ModuleNotFoundError as error:
            raise EnvironmentSetupError(
                f"task '{task.name}' sees, which needs {error.name}: pip install 'finssim[perception]'"
            ) from error
        self._poses = wp.zeros(simulator.worlds, dtype=wp.transform, device=simulator.device)
        self._mask = wp.zeros(simulator.worlds, dtype=int, device=simulator.device)
        sensors: dict[str, Any] = {}
        for picture_spec in task.pictures:
            device = picture_spec.device(self._vehicle)
            sensors[picture_spec.name] = (
                CameraBatch(self.batch, device, width=picture_spec.width)
                if isinstance(device, CameraDevice)
                else SonarBatch(self.batch, device)
            )
        self._metered = {name: sensor for name, sensor in sensors.items() if isinstance(sensor, CameraBatch)}
        for name in task.ranges:
            ranger = device_of(self._vehicle, name)
            if not isinstance(ranger, RangeDevice) or ranger.beams > 1:
                raise EnvironmentSetupError(
                    f"{self._vehicle.name}: perception.{name} has no single beam, which task '{task.name}' expects"
                )
            sensors[name] = RangeBatch(self.batch, ranger)
        self._sensors = {name: self._delivered(name, sensor) for name, sensor in sensors.items()}
        self.pictures = {}
        for picture_spec in task.pictures:
            reading = self._sensors[picture_spec.name].reading
            self.pictures[picture_spec.name] = reading.reshape(
                (simulator.worlds, *picture_spec.shape(self._vehicle))
            )
        self.final_pictures = {name: wp.zeros_like(picture) for name, picture in self.pictures.items()}
        self._episodes = np.zeros(simulator.worlds, np.int64)

    def _delivered(self, name: str, sensor: Any) -> Any:
        from finssim.extensions.perception import DelayedSensor

        entry = self._vehicle.perception[name]
        return DelayedSensor(
            sensor, control_step=self._task.control_step, rate=entry.rate, latency=entry.latency, loss=entry.dropout,
            seed=self.seed,
        )  # fmt: skip

    def restart(self, seed: int, mask: NDArray[np.bool_] | None = None) -> None:
        """Restart the draws of some worlds with a seed; if mask is None, of all worlds, and the noise too."""
        self.seed = seed
        self._episodes[slice(None) if mask is None else mask] = 0
        if mask is None:
            for sensor in self._sensors.values():
                sensor.restart(seed)

    def draw(self, mask: NDArray[np.bool_]) -> None:
        """Draw worlds for the episodes that begin where mask is true, (worlds,); the goal is set to the
        task's `landmark`."""
        self._episodes[mask] += 1
        seeds = first_draw(self.seed) + DRAWS * (self._episodes - 1)
        self.batch.draw(seeds, mask, held_out=self._task.held_out)
        put_goal(self._task, self.batch, self._arrays)

    def begin(self, mask: NDArray[np.bool_]) -> None:
        """Take the first pictures of the episodes that have started where mask is true, (worlds,)."""
        self._mask.assign(mask.astype(np.int32))
        poses = self._poses_of(self._state, self._poses)
        for camera in self._metered.values():
            gain = wp.vec3(camera.camera.gain)
            wp.launch(_fill_masked, len(mask), [self._mask, gain, camera.gain], device=camera.device)
            for _ in range(SETTLING):
                camera.update(poses, mask=self._mask)
        self.take()

    def take(self) -> None:
        """Measure with the sensors that are due after a control step, deliver readings, and copy ranges to
        the task's arrays."""
        poses = self._poses_of(self._state, self._poses)
        for sensor in self._sensors.values():
            sensor.update(poses, self._state.steps, self._state.episode)
        for i, name in enumerate(self._task.ranges):
            wp.copy(self._arrays.ranges[:, i], self._sensors[name].reading[:, 0])

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Store the last observation of the episodes that end where mask is true, (worlds,)."""
        self._mask.assign(mask.astype(np.int32))
        for name, picture in self.pictures.items():
            inputs = [self._mask, picture, self.final_pictures[name]]
            wp.launch(_copy_masked, picture.shape[:2], inputs, device=picture.device)
        rows = self._arrays.observation
        inputs = [self._mask, rows, self._arrays.final_observation]
        wp.launch(_copy_rows, rows.shape, inputs, device=rows.device)

    def shown(self, world: int) -> dict[str, NDArray[np.uint8]]:
        """Return displayable pictures of one world, (height, width, 3): those of cameras, and a sonar's as a
        gray fan."""
        from finssim.core.sonar_fan import fan_picture

        out = {}
        for name, pictures in self.pictures.items():
            picture, device = pictures.numpy()[world], device_of(self._vehicle, name)
            if isinstance(device, SonarDevice):
                fan = np.nan_to_num(fan_picture(picture[..., 0], device.sector, 2 * picture.shape[1]))
                picture = np.repeat(fan.astype(np.uint8)[..., None], 3, axis=2)
            out[name] = picture
        return out

    def arrays(self) -> Iterator[tuple[str, wp.array]]:
        """Yield the arrays on the device that determine the next pictures, by name. Each has the unit of its
        attribute."""
        yield from ((f"sight.{name}.gain", camera.gain) for name, camera in self._metered.items())
        for name, sensor in self._sensors.items():
            yield from ((f"sight.{name}.{key}", array) for key, array in sensor.arrays())

    def counters(self) -> dict[str, NDArray[Any]]:
        """Return the remaining counts on the host, as copies."""
        updates = np.array([sensor.updates for sensor in self._sensors.values()])
        return {"drawn": self.batch.drawn, "episodes": self._episodes.copy(), "updates": updates}

    def load_counters(self, saved: dict[str, NDArray[Any]]) -> None:
        """Restore the counts that `counters` returned."""
        self.batch.drawn, self._episodes[:] = saved["drawn"], saved["episodes"]
        for sensor, updates in zip(self._sensors.values(), saved["updates"], strict=True):
            sensor.updates = int(updates)

    def describe(self) -> dict[str, dict[str, Any]]:
        """Return the description of the pictures for a policy directory: device, shape, rate [Hz], latency [s]."""
        entries = {name: self._vehicle.perception[name] for name in self.pictures}
        return {
            name: {
                "device": entry.device,
                "shape": list(self.pictures[name].shape[1:]),
                "rate": entry.rate,
                "latency": entry.latency,
            }
            for name, entry in entries.items()
        }
