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
from finssim.vehicles.equipment import RaySensor

if TYPE_CHECKING:
    from finssim.tasks.task import Task

SETTLING = 3
"""Pictures of automatic exposure before an episode begins."""


@dataclass(frozen=True)
class Picture:
    """A picture that a task observes."""

    name: str
    """Of the entry in the vehicle's `perception`, such as `front_camera`."""
    width: int | None = None
    """Columns [px], in place of the entry's; the height follows."""


@wp.kernel(enable_backward=False)
def _due(steps: wp.array(dtype=int), every: int, loss: float, key: int, due: wp.array(dtype=int)):
    """Which worlds' cameras take a picture after this control step: every so many, but for those that are lost."""
    w = wp.tid()
    lost = wp.randf(wp.rand_init(key, w)) < loss
    due[w] = wp.where(steps[w] % every == 0 and not lost, 1, 0)


@wp.kernel(enable_backward=False)
def _fill(
    mask: wp.array(dtype=int), source: wp.array4d(dtype=wp.uint8), slots: wp.array4d(dtype=wp.uint8), count: int
):
    """Copy pictures of worlds where mask is not 0 into all slots, which lie one after the other."""
    w, i = wp.tid()
    if mask[w] != 0:
        for slot in range(count):
            for j in range(source.shape[2]):
                for k in range(source.shape[3]):
                    slots[slot * source.shape[0] + w, i, j, k] = source[w, i, j, k]


class _Eye:
    """One camera of all worlds with its rate, latency and loss."""

    def __init__(self, camera: Any, control_step: float, entry: RaySensor) -> None:
        self.camera, self.entry = camera, entry
        self.every = max(1, round(1.0 / (entry.rate * control_step)))
        self.slots = 1 + round(entry.latency / control_step)
        worlds, *shape = camera.picture.shape
        self._line = wp.zeros((self.slots * worlds, *shape), dtype=wp.uint8, device=camera.device)
        """Pictures of the last control steps, in turn."""
        self.shown = wp.zeros_like(camera.picture)
        self.final = wp.zeros_like(camera.picture)
        self._due = wp.zeros(worlds, dtype=int, device=camera.device)

    def take(self, poses: wp.array, steps: wp.array, seed: int, tick: int, time: float) -> None:
        """A picture of each world where one is due, and what has arrived by now."""
        device, worlds = self.camera.device, len(poses)
        key = (seed + 7919 * tick) % (2**31)
        wp.launch(_due, worlds, [steps, self.every, self.entry.dropout, key, self._due], device=device)
        self.camera.update(poses, seed=seed, time=time, mask=self._due)
        slot, oldest = tick % self.slots, (tick + 1) % self.slots
        wp.copy(self._line[slot * worlds : (slot + 1) * worlds], self.camera.picture)
        wp.copy(self.shown, self._line[oldest * worlds : (oldest + 1) * worlds])

    def begin(self, poses: wp.array, mask: wp.array, seed: int, time: float) -> None:
        """First pictures of episodes, where mask is not 0."""
        camera, rows = self.camera, self.camera.picture.shape[:2]
        gain = wp.vec3(camera.camera.sensor.gain)
        wp.launch(_restart_gain, rows[0], [mask, gain, camera.gain], device=camera.device)
        for i in range(SETTLING):
            camera.update(poses, seed=seed + i, time=time, mask=mask)
        for slots, count in ((self._line, self.slots), (self.shown, 1)):
            wp.launch(_fill, rows, [mask, camera.picture, slots, count], device=camera.device)

    def keep(self, mask: wp.array) -> None:
        """Keep the last pictures of episodes that end, where mask is not 0."""
        wp.launch(_fill, self.shown.shape[:2], [mask, self.shown, self.final, 1], device=self.camera.device)

    def arrays(self) -> Iterator[tuple[str, wp.array]]:
        """What a later picture depends on, by name."""
        camera = self.camera
        yield from (("line", self._line), ("shown", self.shown), ("last", camera.picture), ("gain", camera.gain))


@wp.kernel(enable_backward=False)
def _restart_gain(mask: wp.array(dtype=int), first: wp.vec3, gain: wp.array(dtype=wp.vec3)):
    w = wp.tid()
    if mask[w] != 0:
        gain[w] = first


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
        self._poses_of = poses_of
        try:
            self.batch = WorldBatch(task.world, simulator.worlds, str(simulator.device))
        except ModuleNotFoundError as error:
            raise EnvironmentSetupError(
                f"task '{task.name}' sees, which needs {error.name}: pip install 'finssim[perception]'"
            ) from error
        self._poses = wp.zeros(simulator.worlds, dtype=wp.transform, device=simulator.device)
        self._mask = wp.zeros(simulator.worlds, dtype=int, device=simulator.device)
        self._eyes = {one.name: self._eye(one, simulator.vehicles[0]) for one in task.pictures}
        self.pictures = {name: eye.shown for name, eye in self._eyes.items()}
        self.final_pictures = {name: eye.final for name, eye in self._eyes.items()}
        self._episodes = np.zeros(simulator.worlds, np.int64)
        self._tick = 0

    def _eye(self, picture: Picture, vehicle: Any) -> _Eye:
        from finssim.worlds import CameraBatch, device_of
        from finssim.worlds.description import CameraDevice

        device = device_of(vehicle, picture.name)
        if not isinstance(device, CameraDevice):
            raise EnvironmentSetupError(f"{vehicle.name}: perception.{picture.name} is no camera: name one")
        entry = vehicle.perception[picture.name]
        camera = CameraBatch(self.batch, device, width=picture.width)
        return _Eye(camera, self._task.control_step, entry)

    def restart(self, mask: NDArray[np.bool_] | None = None) -> None:
        """Start the draws of some worlds over, of all if mask is None."""
        self._episodes[slice(None) if mask is None else mask] = 0
        if mask is None:
            self._tick = 0

    def draw(self, mask: NDArray[np.bool_]) -> None:
        """Draw worlds for the episodes that begin where mask is true, (worlds,); the goal is the task's `landmark`."""
        self._episodes[mask] += 1
        self.batch.draw(self.seed + 1_000_003 * self._episodes, mask, held_out=self._task.held_out)
        pose = self.batch.poses(self._task.landmark).astype(np.float32)
        self._arrays.goal_position.assign(np.ascontiguousarray(pose[:, :3]))
        self._arrays.goal_quaternion.assign(np.ascontiguousarray(pose[:, 3:]))

    def begin(self, mask: NDArray[np.bool_]) -> None:
        """Take the first pictures of the episodes that have begun where mask is true, (worlds,)."""
        self._mask.assign(mask.astype(np.int32))
        poses = self._poses_of(self._state, self._poses)
        for eye in self._eyes.values():
            eye.begin(poses, self._mask, self.seed, self._time)

    def take(self) -> None:
        """Take the pictures that are due after a control step."""
        self._tick += 1
        poses = self._poses_of(self._state, self._poses)
        for eye in self._eyes.values():
            eye.take(poses, self._state.steps, self.seed, self._tick, self._time)

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Keep the last pictures of the episodes that end where mask is true, (worlds,)."""
        self._mask.assign(mask.astype(np.int32))
        for eye in self._eyes.values():
            eye.keep(self._mask)

    def describe(self) -> dict[str, dict[str, Any]]:
        """The pictures as a policy directory has them: shape (height, width, 3), rate [Hz], latency [s], by name."""
        return {
            name: {
                "device": eye.entry.device,
                "shape": list(eye.shown.shape[1:]),
                "rate": eye.entry.rate,
                "latency": eye.entry.latency,
            }
            for name, eye in self._eyes.items()
        }

    @property
    def _time(self) -> float:
        """By which noise differs from picture to picture [s]."""
        return self._tick * self._task.control_step

    def arrays(self) -> Iterator[tuple[str, wp.array]]:
        """The arrays on the device that decide what is seen next, by name."""
        for name, eye in self._eyes.items():
            yield from ((f"sight.{name}.{key}", array) for key, array in eye.arrays())

    def counters(self) -> dict[str, NDArray[Any]]:
        """What else does, as copies."""
        return {"drawn": self.batch.drawn, "episodes": self._episodes.copy(), "tick": np.array(self._tick)}

    def load_counters(self, saved: dict[str, NDArray[Any]]) -> None:
        """Take what `counters` gave."""
        self.batch.drawn = saved["drawn"]
        self._episodes[:], self._tick = saved["episodes"], int(saved["tick"])
