"""Rate, latency and loss of ray sensors, by the clocks of the worlds."""
# mypy: ignore-errors

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import warp as wp

from finssim.extensions.perception.description import WorldError
from finssim.extensions.perception.ray_batch import RayBatch
from finssim.sim.sensors.sampling import (
    Sampling,
    arrival,
    begin_update,
    lost,
    new_sampling,
    restart,
    sample_due,
    sample_key,
    slot_of,
)

wp.set_module_options({"enable_backward": False})

STREAM = wp.constant(1000)
"""Stream of the keys of lost readings, separate from those of the sensors of `finssim.sim.sensors`."""


@wp.struct
class DeliverySchedule:
    """Schedule of the sensors in a step, by view, with state carried between steps."""

    begun: wp.array2d(dtype=int)  # episode in which the sensor of (world, vehicle) was last restarted
    due: wp.array(dtype=int)  # 1: measures in this step
    stored: wp.array(dtype=int)  # ring slot that stores the new reading; -1: none
    arrived: wp.array(dtype=int)  # ring slot of the arriving reading; -1: none
    age: wp.array2d(dtype=float)  # age of the current reading [s], by (world, vehicle)


@wp.kernel(enable_backward=False)
def _schedule(
    steps: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    sampling: Sampling,
    loss: float,
    seed: int,
    schedule: DeliverySchedule,
):
    """Determine which sensors measure in this step, the ring slot that stores each reading, and the slot
    whose reading arrives; -1: none."""
    w, v = wp.tid()
    step = steps[w]
    view = w * schedule.age.shape[1] + v
    schedule.due[view] = 0
    schedule.stored[view] = -1
    schedule.arrived[view] = -1
    restarting = bool(episode[w] != schedule.begun[w, v])
    if restarting:
        schedule.begun[w, v] = episode[w]
        restart(sampling, w, v, step)
    if begin_update(sampling, w, v, step):
        if restarting or sample_due(sampling, w, v, step):
            key = sample_key(seed, STREAM, w, v, episode[w], step)
            slot = slot_of(sampling, step)
            schedule.due[view] = 1
            schedule.stored[view] = slot
            sampling.sent[w, v, slot] = restarting or not lost(key, loss)
            sampling.last[w, v] = step
        schedule.arrived[view] = arrival(sampling, w, v, step, restarting)
    stamp = sampling.stamp[w, v]
    schedule.age[w, v] = wp.where(stamp < 0.0, float(wp.inf), float(step) * sampling.control_step - stamp)


@wp.kernel(enable_backward=False)
def _pass_on(
    measured: wp.array2d(dtype=wp.uint8),
    schedule: DeliverySchedule,
    span: int,
    ring: wp.array3d(dtype=wp.uint8),
    reading: wp.array2d(dtype=wp.uint8),
):
    """Store new readings in the ring, and copy arriving ones to the output; a thread moves `span` bytes."""
    view, block = wp.tid()
    last = wp.min(block * span + span, measured.shape[1])
    slot = schedule.stored[view]
    if slot >= 0:
        for k in range(block * span, last):
            ring[view, slot, k] = measured[view, k]
    slot = schedule.arrived[view]
    if slot >= 0:
        for k in range(block * span, last):
            reading[view, k] = ring[view, slot, k]


class DelayedSensor:
    """Sensor that measures at its own rate and whose readings arrive late or are lost.

        camera = DelayedSensor(CameraBatch(batch, device), control_step=0.1, rate=5.0, latency=0.2, loss=0.02)
        picture = camera.update(poses, simulator.state.steps, simulator.state.episode)

    As with the sensors of `finssim.sim.sensors`, the first reading of an episode arrives at once, and a sensor
    measures only at the ends of control steps. Call `update` after every control step.

    Args:
        sensor: A `CameraBatch`, `SonarBatch` or `RangeBatch`.
        control_step: Time between updates [s].
        rate: Rate of measurements [Hz]; at most one per control step.
        latency: Time from measurement to arrival, rounded to control steps [s].
        loss: Probability that a reading is lost.
        seed: Seed of the sensor's noise and of the losses.

    Raises:
        WorldError: A number is out of range.
    """

    reading: wp.array
    """Latest reading that arrived; zero before the first. Its type, shape and unit are the sensor's."""
    age: wp.array
    """Time since `reading` was measured [s], infinite before the first; float (worlds, vehicles)."""

    def __init__(
        self,
        sensor: RayBatch,
        *,
        control_step: float,
        rate: float,
        latency: float = 0.0,
        loss: float = 0.0,
        seed: int = 0,
    ) -> None:
        good = 0.0 < control_step < math.inf and 0.0 < rate < math.inf
        if not (good and 0.0 <= latency < math.inf and 0.0 <= loss <= 1.0):
            raise WorldError(
                f"control_step {control_step} s, rate {rate} Hz, latency {latency} s, loss {loss}: expected finite "
                "numbers, the first two above 0, the latency 0 or more, the loss from 0 to 1"
            )
        self.sensor, self.loss, self.seed = sensor, loss, seed
        self.device = sensor.device
        worlds = sensor.batch.worlds
        vehicles = sensor.count // worlds
        self.sampling = new_sampling(
            [rate] * vehicles, [latency] * vehicles, worlds, control_step, self.device
        )
        self.updates = 0
        """Number of updates so far, which changes the noise."""
        source, slots = sensor.reading, self.sampling.sent.shape[2]
        width = source.size * source.strides[-1] // sensor.count
        self.reading = wp.zeros_like(source)
        with wp.ScopedDevice(self.device):
            self.age = wp.full((worlds, vehicles), math.inf, dtype=float)
            self._schedule = DeliverySchedule()
            self._schedule.age = self.age
            self._schedule.begun = wp.full((worlds, vehicles), -1, dtype=int)
            for name in ("due", "stored", "arrived"):
                setattr(self._schedule, name, wp.zeros(sensor.count, dtype=int))
            self._ring = wp.zeros((sensor.count, slots, width), dtype=wp.uint8)
        self._bytes = [
            wp.array(ptr=array.ptr, dtype=wp.uint8, shape=(sensor.count, width), device=self.device)
            for array in (source, self.reading)
        ]

    def update(self, poses: wp.array, steps: wp.array, episode: wp.array) -> wp.array:
        """Measure with the sensors that are due, and deliver the readings that arrive.

        Args:
            poses: Body to world of each vehicle, xyzw; transform (N,) on the batch's device [m].
            steps: Control steps since each world's reset, as a simulator's `state.steps`; int (worlds,).
            episode: Resets of each world so far, as its `state.episode`; int (worlds,).

        Returns:
            `reading` in the unit of the sensor, which the next update overwrites.
        """
        inputs = [steps, episode, self.sampling, self.loss, self.seed, self._schedule]
        wp.launch(_schedule, self.age.shape, inputs, device=self.device)
        self.updates += 1
        self.sensor.update(poses, seed=self.seed, time=float(self.updates), mask=self._schedule.due)
        source, reading = self._bytes
        span = 16 if self.device.is_cuda else source.shape[1]
        inputs = [source, self._schedule, span, self._ring, reading]
        wp.launch(_pass_on, (len(source), -(-source.shape[1] // span)), inputs, device=self.device)
        return self.reading

    def restart(self, seed: int) -> None:
        """Restart noise and losses with a seed; the next update is the first of an episode in every world."""
        self.seed, self.updates = seed, 0
        self._schedule.begun.fill_(-1)

    def arrays(self) -> Iterator[tuple[str, wp.array]]:
        """Yield the arrays that determine the next readings, by name; with `updates` and the sensor's own,
        they are the full state.

        Each has the unit of its attribute.
        """
        yield from (("measured", self.sensor.reading), ("reading", self.reading), ("age", self.age))
        yield from (("begun", self._schedule.begun), ("ring", self._ring))
        fields = ((name, getattr(self.sampling, name)) for name in self.sampling._cls.vars)
        yield from ((name, x) for name, x in fields if isinstance(x, wp.array) and name != "timing")

    def numpy(self) -> np.ndarray:
        """Return a copy of `reading`, in the unit of the sensor."""
        return self.reading.numpy().copy()
