"""Altimeters, rangefinders and the beams of a DVL on many vehicles."""
# mypy: ignore-errors

from __future__ import annotations

import numpy as np
import warp as wp

from finssim.extensions.perception.description import WorldError
from finssim.extensions.perception.model import RayScene, WorldBatch
from finssim.extensions.perception.ray_batch import MISS, SKIPPED, RayBatch, Traced
from finssim.extensions.perception.rays import cones
from finssim.physics.types import vec6
from finssim.sim.overhead_camera.photometry import noise_key
from finssim.sim.sensors.dvl import sensed_velocity
from finssim.vehicles.device_files import RangeDevice

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def _take_ranges(
    traced: Traced, scene: RayScene, weight: wp.array(dtype=float), quantile: float, reach: wp.vec2, noise: float,
    key: int, ranges: wp.array2d(dtype=float),
):  # fmt: skip
    """Compute the range of each beam, at which a given fraction of its echo has arrived; infinite beyond the
    device's reach."""
    v, b = wp.tid()
    if traced.worlds[v] == SKIPPED:
        return
    rotation = wp.transform_get_rotation(traced.views[v])
    total = float(0.0)
    for j in range(traced.depth.shape[2]):
        total += _ray_echo(traced, scene, rotation, weight, v, b, j)
    best = float(wp.inf)
    for j in range(traced.depth.shape[2]):
        r = traced.depth[v, b, j]
        if traced.shape_index[v, b, j] != MISS and r < best:
            nearer = float(0.0)
            for i in range(traced.depth.shape[2]):
                if traced.depth[v, b, i] <= r:
                    nearer += _ray_echo(traced, scene, rotation, weight, v, b, i)
            if nearer >= quantile * total:
                best = r
    if key >= 0:
        state = wp.rand_init(key, v * traced.depth.shape[1] + b)
        best = best * (1.0 + noise * wp.randn(state))
    if best < reach[0] or best > reach[1]:
        best = float(wp.inf)
    ranges[v, b] = best


@wp.func
def _ray_echo(
    traced: Traced, scene: RayScene, rotation: wp.quat, weight: wp.array(dtype=float), v: int, b: int, j: int
) -> float:
    """Return the echo of one ray as in `_echo_rays`, without absorption; 0 for a miss."""
    index = traced.shape_index[v, b, j]
    r = traced.depth[v, b, j]
    if index == MISS or r <= 0.0:
        return 0.0
    ray = wp.quat_rotate(rotation, traced.rays[b, j, 0, 1])
    return (
        weight[j]
        * scene.surfaces[int(index)].backscatter
        * wp.abs(wp.dot(traced.normal[v, b, j], ray))
        / (r * r)
    )


class RangeBatch(RayBatch):
    """Altimeter, rangefinder or DVL beams on each of N vehicles.

    Args:
        batch: The worlds.
        ranger: The device.
        vehicles: Number of vehicles in each world.
    """

    ranges: wp.array
    """Ranges along each beam [m], infinite if nothing is within reach; float (N, beams)."""

    def __init__(self, batch: WorldBatch, ranger: RangeDevice, *, vehicles: int = 1) -> None:
        rays, weight = cones(ranger)
        super().__init__(batch, rays, ranger.mount, vehicles)
        self.ranger = ranger
        self._weight = wp.array(np.float32(weight), dtype=float, device=self.device)
        self.reading = self.ranges = wp.zeros((self.count, ranger.beams), dtype=float, device=self.device)

    def update(
        self, poses: wp.array, *, seed: int | None = None, time: float = 0.0, mask: wp.array | None = None
    ) -> wp.array:
        """Measure the ranges.

        Args:
            poses: Body to world of each vehicle, xyzw; transform (N,) on the batch's device [m].
            seed: Seed of the noise; None for no noise.
            time: Time of the measurement [s]; it changes the noise.
            mask: Vehicles that measure; the others keep their last reading. int (N,); all if None.

        Returns:
            `ranges` [m], which the next update overwrites.
        """
        self.cast(poses, mask)
        ranger, key = self.ranger, -1 if seed is None else noise_key(seed, time)
        reach = wp.vec2(ranger.minimum_range, ranger.range)
        inputs = [self.traced, self.batch.scene, self._weight, ranger.quantile, reach, ranger.noise, key]
        wp.launch(_take_ranges, self.ranges.shape, [*inputs, self.ranges], device=self.device)
        return self.ranges


@wp.kernel(enable_backward=False)
def _take_velocities(
    traced: Traced, twists: wp.array2d(dtype=vec6), mount: wp.transform, noise: float, key: int,
    reading: wp.array2d(dtype=float), lock: wp.array2d(dtype=int),
):  # fmt: skip
    """Measure the speed along each beam with a bottom echo, and fit the velocity by least squares.

    s_b = d_b . v + noise;  v = (sum d d^T)^-1 sum d s  over the beams with an echo, of which there must be at
    least three

    Ranges are read from the last columns of `reading`: velocity, speeds, ranges.
    """
    i = wp.tid()
    if traced.worlds[i] == SKIPPED:
        return
    w = i // twists.shape[1]
    v = i % twists.shape[1]
    turn = wp.transform_get_rotation(mount)
    nu = twists[w, v]
    exact = sensed_velocity(nu, wp.quat_identity(), wp.vec3(0.0), wp.transform_get_translation(mount), turn)
    state = wp.rand_init(wp.max(key, 0), i)
    normal = wp.mat33(0.0)
    right = wp.vec3(0.0)
    count = int(0)
    beams = traced.depth.shape[1]
    for b in range(beams):
        d = traced.rays[b, 0, 0, 1]
        reading[i, 3 + b] = float(wp.nan)
        drawn = wp.randn(state)
        if wp.isfinite(reading[i, 3 + beams + b]):
            s = wp.dot(d, exact)
            if key >= 0:
                s += noise * drawn
            reading[i, 3 + b] = s
            normal += wp.outer(d, d)
            right += s * d
            count += 1
    lock[w, v] = wp.where(count >= 3, 1, 0)
    solution = wp.vec3(float(wp.nan))
    if count >= 3:
        solution = wp.inverse(normal) * right
    for k in range(3):
        reading[i, k] = solution[k]


class DopplerBatch(RangeBatch):
    """DVL on each of N vehicles: bottom track by the ranges and speeds of its beams.

    Args:
        batch: The worlds.
        device: Device with at least three beams; the speeds are those along the beam axes.
        twists: nu of the vehicles, body frame [m/s, rad/s], read in each update, such as a simulator's
            `state.velocity`; vec6 (worlds, vehicles).
        lock: Array of flags [0, 1] to fill instead of a new one; with that of a
            `finssim.sim.sensors.DvlBatch`, that sensor loses bottom lock too.

    Raises:
        WorldError: The device has fewer than three beams.
    """

    speeds: wp.array
    """Velocity of the sensor along each beam, positive in the beam's direction [m/s], NaN without an echo;
    float (N, beams)."""
    velocity: wp.array
    """Velocity of the sensor, in its own axes [m/s], NaN without lock; float (N, 3)."""
    lock: wp.array
    """Flag of bottom lock, that is, at least three beams have an echo [-]; int (worlds, vehicles)."""

    def __init__(
        self, batch: WorldBatch, device: RangeDevice, twists: wp.array, *, lock: wp.array | None = None
    ) -> None:
        if device.beams < 3:
            raise WorldError(f"a DVL of {device.beams} beams: give at least 3 for a velocity")
        super().__init__(batch, device, vehicles=twists.shape[1])
        beams, self.twists = device.beams, twists
        # One row for each vehicle, so that all of its values arrive together: velocity, speeds, ranges.
        self.reading = wp.zeros((self.count, 3 + 2 * beams), dtype=float, device=self.device)
        self.velocity, self.speeds = self.reading[:, :3], self.reading[:, 3 : 3 + beams]
        self.ranges = self.reading[:, 3 + beams :]
        self.lock = wp.zeros(twists.shape, dtype=int, device=self.device) if lock is None else lock

    def update(
        self, poses: wp.array, *, seed: int | None = None, time: float = 0.0, mask: wp.array | None = None
    ) -> wp.array:
        """Measure velocity, speeds and ranges.

        Args:
            poses: Body to world of each vehicle, xyzw; transform (N,) on the batch's device [m].
            seed: Seed of the noise; None for no noise.
            time: Time of the measurement [s]; it changes the noise.
            mask: Vehicles that measure; the others keep their last reading. int (N,); all if None.

        Returns:
            `reading`: velocity [m/s], speeds [m/s] and ranges [m] in a row; float (N, 3 + 2 beams).
        """
        super().update(poses, seed=seed, time=time, mask=mask)
        key = -1 if seed is None else noise_key(seed + 1, time)
        inputs = [
            self.traced,
            self.twists,
            self._mount,
            self.ranger.velocity_noise,
            key,
            self.reading,
            self.lock,
        ]
        wp.launch(_take_velocities, self.count, inputs, device=self.device)
        return self.reading
