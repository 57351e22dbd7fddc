"""Imaging, profiling and side-scan sonars of many vehicles: echoes of rays, accumulated by beam and range cell."""
# mypy: ignore-errors

from __future__ import annotations

import math

import numpy as np
import warp as wp

from finssim.extensions.perception.model import RayScene, WorldBatch
from finssim.extensions.perception.ray_batch import MISS, SKIPPED, RayBatch, Traced
from finssim.extensions.perception.rays import fan, ray_elevations
from finssim.sim.overhead_camera.photometry import noise_key
from finssim.vehicles.device_files import SonarDevice

wp.set_module_options({"enable_backward": False})


@wp.struct
class Echoes:
    """Echoes of the rays of many sonars, and the signals of the receivers."""

    weight: wp.array(dtype=float)  # b² dW/pi, by elevation [-]
    absorption: float  # [dB/m]
    steps: wp.vec2  # angles between rays along elevation and azimuth [rad]
    bins_per_metre: float  # range cells per metre [1/m]
    noise: float  # power in a range cell before gain [-]
    display: wp.vec2  # levels shown as 0 and 255 [dB]
    taps: wp.array(dtype=float)  # pattern of a receiving beam [-]
    gain: wp.array(dtype=float)  # by range cell [-]
    quantiles: wp.array(dtype=float)  # of the exponential distribution [-]
    energy: wp.array3d(dtype=float)  # energy in one range cell, by view, elevation and azimuth [-]
    spread: wp.array3d(dtype=wp.vec2)  # first and last range cell [-]
    intensity: wp.array3d(dtype=float)  # power, by view, beam and range cell [-]
    picture: wp.array3d(dtype=wp.uint8)


@wp.kernel(enable_backward=False)
def _echo_rays(traced: Traced, scene: RayScene, echoes: Echoes, span: int):
    """Compute the echo of every ray and its interval of ranges.

    A ray of solid angle dW that strikes a Lambertian surface of parameter mu at range r under cosine k returns

        e = b² dW mu k 10^(-2 alpha r/10)/r²,   from the sonar equation with A = dW r²/k and S_b = mu k²

    relative to the source's level at 1 m. (Lambert's law: 10 log mu + 10 log k²; b² dW is `weight`.) Its
    ranges are those of its footprint: half-way to the rays above and below if they strike the same shape,
    else as the normal implies, so that no gaps open between rays on a sloping floor. `energy` is that of one
    range cell. Surfaces above the water give no echo.
    """
    v, i, block = wp.tid()
    if traced.worlds[v] == SKIPPED:
        return
    view = traced.views[v]
    rotation = wp.transform_get_rotation(view)
    decay = 0.2 * wp.log(10.0) * echoes.absorption
    for j in range(block * span, wp.min(block * span + span, traced.depth.shape[2])):
        r = traced.depth[v, i, j]
        index = traced.shape_index[v, i, j]
        d = traced.rays[i, j, 0, 1]
        echoes.energy[v, i, j] = 0.0
        if index != MISS and r > 0.0 and wp.transform_point(view, r * d)[2] < 0.0:
            n = wp.quat_rotate_inv(rotation, traced.normal[v, i, j])
            k = wp.max(wp.abs(wp.dot(n, d)), 1.0e-3)
            flat = wp.max(d[0] * d[0] + d[1] * d[1], 1.0e-9)
            ahead = (n[0] * d[0] + n[1] * d[1]) / flat
            beside = (n[1] * d[0] - n[0] * d[1]) / k
            # Half the footprint along elevation and azimuth, by dr/dangle = r (n · e)/(n · d).
            flat = wp.sqrt(flat)
            half = 0.5 * r * echoes.steps[0] * wp.min(wp.abs(n[2] - d[2] * ahead) * flat / k, 20.0)
            across = 0.5 * r * echoes.steps[1] * wp.min(wp.abs(beside), 5.0)
            low = r
            high = r
            count = int(0)
            for side in range(2):
                other = i + 2 * side - 1
                if other >= 0 and other < traced.depth.shape[1]:
                    if traced.shape_index[v, other, j] == index:
                        way = wp.clamp(
                            0.5 * (traced.depth[v, other, j] - r), -2.0 * half - 1.0e-3, 2.0 * half + 1.0e-3
                        )
                        low = wp.min(low, r + way)
                        high = wp.max(high, r + way)
                        count += 1
            if count < 2:
                # At an edge: extend to the other side as far as the footprint allows, but not farther than to
                # this side.
                low = wp.min(low, r - wp.min(half, wp.where(count == 0, half, high - r)))
                high = wp.max(high, r + wp.min(half, wp.where(count == 0, half, r - low)))
            first = (low - across) * echoes.bins_per_metre
            last = wp.max((high + across) * echoes.bins_per_metre, first + 1.0e-3)
            echo = (
                echoes.weight[i] * scene.surfaces[int(index)].backscatter * k * wp.exp(-decay * r) / (r * r)
            )
            echoes.spread[v, i, j] = wp.vec2(first, last)
            echoes.energy[v, i, j] = echo / (last - first)


@wp.kernel(enable_backward=False)
def _gather_echoes(worlds: wp.array(dtype=int), echoes: Echoes):
    """Accumulate echoes by beam and range cell, from the beam's own and neighbouring directions, weighted by
    its pattern."""
    v, b = wp.tid()
    if worlds[v] == SKIPPED:
        return
    bins = echoes.intensity.shape[2]
    reach = echoes.taps.shape[0] / 2
    for k in range(bins):
        echoes.intensity[v, b, k] = 0.0
    for j in range(wp.max(b - reach, 0), wp.min(b + reach + 1, echoes.energy.shape[2])):
        tap = echoes.taps[j - b + reach]
        for i in range(echoes.energy.shape[1]):
            e = echoes.energy[v, i, j]
            if e > 0.0:
                low = echoes.spread[v, i, j][0]
                high = echoes.spread[v, i, j][1]
                for k in range(wp.max(int(wp.floor(low)), 0), wp.min(int(wp.floor(high)) + 1, bins)):
                    overlap = wp.max(wp.min(high, float(k + 1)) - wp.max(low, float(k)), 0.0)
                    echoes.intensity[v, b, k] += tap * e * overlap


@wp.kernel(enable_backward=False)
def _receive(worlds: wp.array(dtype=int), echoes: Echoes, key: int, span: int):
    """Add noise and speckle, apply gain, and encode the level in 8 bits; a thread processes `span` range
    cells of a beam.

    Echoes of many scatterers and noise add as complex normal numbers: power is (I + N) times a draw of the
    exponential distribution, amplitude Rayleigh. Without a seed (key < 0) it is I + N itself.
    """
    v, b, block = wp.tid()
    if worlds[v] == SKIPPED:
        return
    bins = echoes.intensity.shape[2]
    first = (v * echoes.intensity.shape[1] + b) * bins
    low = echoes.display[0]
    scale = 255.0 / (echoes.display[1] - low)
    for k in range(block * span, wp.min(block * span + span, bins)):
        power = (echoes.intensity[v, b, k] + echoes.noise) * echoes.gain[k]
        if key >= 0:
            power = power * echoes.quantiles[int(wp.rand_init(key, first + k) & wp.uint32(4095))]
        echoes.intensity[v, b, k] = power
        level = scale * (4.3429448 * wp.log(wp.max(power, 1.0e-30)) - low)
        echoes.picture[v, b, k] = wp.uint8(wp.clamp(level, 0.0, 255.0) + 0.5)


@wp.kernel(enable_backward=False)
def _detect(
    worlds: wp.array(dtype=int),
    intensity: wp.array3d(dtype=float),
    threshold: float,
    bin_length: float,
    ranges: wp.array2d(dtype=float),
):
    """Find the first range cell of each beam above the threshold and within 6 dB of the beam's strongest;
    return its middle."""
    v, b = wp.tid()
    if worlds[v] == SKIPPED:
        return
    ranges[v, b] = float(wp.inf)
    enough = float(threshold)
    for k in range(intensity.shape[2]):
        enough = wp.max(enough, 0.25 * intensity[v, b, k])
    for k in range(intensity.shape[2]):
        if intensity[v, b, k] >= enough:
            ranges[v, b] = (float(k) + 0.5) * bin_length
            return


class SonarBatch(RayBatch):
    """Imaging, profiling or side-scan sonar on each of N vehicles.

    Args:
        batch: The worlds; their water's temperature and salinity determine the absorption of sound.
        sonar: The device.
        beams: Number of beams over the sector, instead of the device's own.
        bins: Number of range cells over the range, instead of the device's own.
        vehicles: Number of vehicles in each world.
    """

    intensity: wp.array
    """Power after gain [-], relative to the source's level at 1 m; float (N, beams, bins), beam 0 at the left."""
    picture: wp.array
    """Picture: power level, scaled between the device's `display` levels; uint8 (N, beams, bins)."""
    ranges: wp.array
    """Ranges of a profiling sonar: first range with a level of `detection_db` and within 6 dB of the beam's
    strongest [m], infinite if there is none; float (N, beams)."""

    def __init__(
        self,
        batch: WorldBatch,
        sonar: SonarDevice,
        *,
        beams: int | None = None,
        bins: int | None = None,
        vehicles: int = 1,
    ) -> None:
        rays = fan(sonar, beams)
        super().__init__(batch, rays, sonar.mount, vehicles)
        self.sonar, self.bins = sonar, bins or sonar.bins
        self.absorption = batch.world.water.sound_absorption(sonar.frequency)
        """Absorption of sound [dB/m]."""
        count = rays.shape[1]
        elevation, spacing = ray_elevations(sonar), sonar.sector / count
        if sonar.mode == "side_scan":
            spacing = sonar.beam_width / 0.8859  # the integral of its pattern sinc²
        steps = wp.vec2(float(elevation[1] - elevation[0]) if len(elevation) > 1 else 0.0, spacing)
        two_way = np.exp(
            -8.0 * math.log(2.0) * ((elevation + sonar.depression) / sonar.vertical_beam_width) ** 2
        )
        solid = max(steps[0], 1e-6) * spacing * np.cos(elevation) / math.pi
        ranges = (np.arange(self.bins) + 0.5) * self.bin_length
        loss = sonar.gain_spreading * np.log10(ranges) + 2.0 * self.absorption * ranges
        gain = np.where(ranges >= sonar.minimum_range, 10.0 ** (0.1 * loss), 0.0)
        shape = (self.count, len(elevation), count)
        echoes = self._echoes = Echoes()
        echoes.absorption, echoes.steps, echoes.bins_per_metre = self.absorption, steps, 1.0 / self.bin_length
        echoes.noise, echoes.display = 10.0 ** (0.1 * sonar.noise_level_db), wp.vec2(*sonar.display)
        taps = np.ones(1) if sonar.mode == "side_scan" else beam_pattern(sonar.beam_width, spacing, count)
        with wp.ScopedDevice(self.device):
            echoes.weight = wp.array(np.float32(two_way * solid), dtype=float)
            echoes.taps, echoes.gain = (wp.array(np.float32(x), dtype=float) for x in (taps, gain))
            echoes.quantiles = wp.array(np.float32(-np.log1p(-(np.arange(4096) + 0.5) / 4096)), dtype=float)
            echoes.energy, echoes.spread = wp.zeros(shape, dtype=float), wp.zeros(shape, dtype=wp.vec2)
            self.intensity = wp.zeros((self.count, count, self.bins), dtype=float)
            self.reading = self.picture = wp.zeros(self.intensity.shape, dtype=wp.uint8)
            self.ranges = wp.zeros(self.intensity.shape[:2], dtype=float)
        echoes.intensity, echoes.picture = self.intensity, self.picture

    @property
    def bin_length(self) -> float:
        """Length of a range cell [m]."""
        return self.sonar.range / self.bins

    def update(
        self, poses: wp.array, *, seed: int | None = None, time: float = 0.0, mask: wp.array | None = None
    ) -> wp.array:
        """Simulate one ping of each vehicle.

        Args:
            poses: Body to world of each vehicle, xyzw; transform (N,) on the batch's device [m].
            seed: Seed of speckle and noise; None for the mean power.
            time: Time of the ping [s]; it changes the speckle.
            mask: Vehicles that measure; the others keep their last picture. int (N,); all if None.

        Returns:
            `picture`, which the next update overwrites.
        """
        self.cast(poses, mask)
        sonar, echoes, key = self.sonar, self._echoes, -1 if seed is None else noise_key(seed, time)
        inputs = [self.traced, self.batch.scene, echoes, self._span(self.depth.shape[2])]
        wp.launch(_echo_rays, self._blocks(self.depth), inputs, device=self.device)
        wp.launch(_gather_echoes, self.intensity.shape[:2], [self.worlds, echoes], device=self.device)
        inputs = [self.worlds, echoes, key, self._span(self.bins)]
        wp.launch(_receive, self._blocks(self.intensity), inputs, device=self.device)
        if sonar.mode == "profiling":
            threshold = 10.0 ** (0.1 * sonar.detection_db)
            inputs = [self.worlds, self.intensity, threshold, self.bin_length, self.ranges]
            wp.launch(_detect, self.ranges.shape, inputs, device=self.device)
        return self.picture


def beam_pattern(width: float, spacing: float, beams: int) -> np.ndarray:
    """Return the weights of a receiving beam in the directions of its neighbours: sinc² of an even line array, sum 1,
    (odd,).

    Args:
        width: Width between half-power points [rad]: sinc²(0.443) = 1/2.
        spacing: Angle between the beams [rad].
        beams: Number of beams; the pattern ends after its first side lobes, at 2.5 widths.
    """
    reach = min(int(2.5 * width / spacing), beams - 1)
    taps = np.sinc(0.8859 * np.arange(-reach, reach + 1) * spacing / width) ** 2
    return taps / taps.sum()
