"""Imaging sonars, altimeters and DVL beams compared with closed forms of the sonar equation and of geometry."""

import math

import numpy as np
import pytest
import warp as wp
from scipy.integrate import quad

from finssim.core.rotations import quat_from_euler, quat_rotate
from finssim.extensions.perception import DopplerBatch, RangeBatch, SonarBatch, WorldError
from finssim.physics.types import vec6
from finssim.vehicles.device_files import DeviceMount, RangeDevice, SonarDevice, load_device

pytestmark = pytest.mark.slow

WIDTH = math.radians(20.0)
MU = 0.1


def sonar(**changes):
    """Return a sonar without noise, with a gain that compensates absorption only."""
    values = {"about": "-", "source": "-", "frequency": 720e3, "beams": 121, "sector": math.radians(60.0)}
    values |= {"beam_width": math.radians(1.0), "vertical_beam_width": WIDTH, "range": 10.0, "bins": 500}
    values |= {"elevations": 48, "noise_level_db": -200.0, "gain_spreading": 0.0, "rate": 10.0}
    return SonarDevice(**{**values, **changes})


def echo(batch, device, pose, **options):
    sensor = SonarBatch(batch, device)
    sensor.update(pose, **options)
    return sensor, sensor.intensity.numpy()[0].astype(float)


def pattern(elevation):
    """Return the two-way pattern of a beam that has half its one-way strength at half its width."""
    return 0.5 ** (2.0 * (2.0 * elevation / WIDTH) ** 2)


@pytest.mark.parametrize("distance", [2.0, 4.0, 8.0])
def test_a_ball_echoes_with_two_thirds_of_mu_a_squared(distance, scenes, level):
    """Lambert's law over the near side of a ball: 2/3 mu a²/r⁴, 40 log r, within 1 dB; at r - a within one cell."""
    sensor, intensity = echo(scenes("ball"), sonar(), level(-distance, 0, -5))
    expected = 2.0 / 3.0 * MU * 0.25**2 / distance**4
    assert abs(10.0 * math.log10(intensity.sum() / expected)) < 1.0
    strongest = intensity.sum(axis=0)
    first = np.flatnonzero(strongest > 0.01 * strongest.max())[0]
    assert abs(first * sensor.bin_length - (distance - 0.25)) <= sensor.bin_length
    extent = np.flatnonzero(intensity.sum(axis=1) > 0.2 * intensity.sum(axis=1).max())
    angle = 2.0 * math.asin(0.25 / distance)
    assert abs(np.ptp(extent) * math.radians(60.0) / 121 - angle) < math.radians(2.0) + 0.15 * angle


@pytest.mark.parametrize("distance", [2.0, 4.0, 8.0])
def test_a_post_echoes_with_the_cube_of_range(distance, scenes, poses):
    """An endless upright cylinder: mu a/(2 r³) times the integral of b² cos⁴ over elevation, 30 log r, within 1 dB."""
    sensor, intensity = echo(scenes("ball"), sonar(), poses(((-distance, 500, -5), (0, 0, 0, 1))))
    expected = MU * 0.1 / (2.0 * distance**3) * quad(lambda a: pattern(a) * math.cos(a) ** 4, -0.26, 0.26)[0]
    assert abs(10.0 * math.log10(intensity.sum() / expected)) < 1.0
    total = intensity.sum(axis=0)
    first = np.flatnonzero(total > 0.05 * total.max())[0]
    assert abs(first * sensor.bin_length - (distance - 0.1)) <= 1.001 * sensor.bin_length


@pytest.mark.parametrize("distance", [2.0, 4.0, 8.0])
def test_a_wall_echoes_with_the_square_of_range(distance, scenes, level):
    """Head-on, in the middle beam: mu/pi dazimuth/R² times the integral of b² cos⁴, 20 log R, within 1 dB; at R."""
    sensor, intensity = echo(scenes("wall"), sonar(), level(8.0 - distance, 0, -15))
    step = math.radians(60.0) / 121
    mu = 10.0**-2.7
    expected = mu / math.pi * step / distance**2
    expected *= quad(lambda a: pattern(a) * math.cos(a) ** 4, -0.26, 0.26)[0]
    assert abs(10.0 * math.log10(intensity[60].sum() / expected)) < 1.0
    first = np.flatnonzero(intensity[60] > 0.05 * intensity[60].max())[0]
    assert abs(first * sensor.bin_length - distance) <= sensor.bin_length


def test_no_gaps_open_on_a_slanting_floor(scenes, level):
    """Between first and last echo no cell is empty: sixteen rays of 20°, a floor 1.5 m below, cells of 1 cm."""
    device = sonar(elevations=16, range=12.0, bins=1200, mount=DeviceMount(pitch=math.radians(15.0)))
    _, intensity = echo(scenes("floor"), device, level(0, 0, -8.5))
    filled = intensity[60] > 0.0
    first, last = np.flatnonzero(filled)[[0, -1]]
    assert last - first > 500 and filled[first : last + 1].all()


def test_speckle_is_rayleigh(scenes, level):
    """The power of noise alone is exponential, with standard deviation equal to its mean; for amplitude it is
    0.52."""
    device = sonar(noise_level_db=-60.0, mount=DeviceMount(pitch=-0.6))
    _, intensity = echo(scenes("floor"), device, level(0, 0, -5), seed=3)
    power = intensity[:, 10:200]
    relative = power / power.mean(axis=0)
    assert relative.std() == pytest.approx(1.0, abs=0.03)
    amplitude = np.sqrt(relative)
    assert amplitude.std() / amplitude.mean() == pytest.approx(math.sqrt(4.0 / math.pi - 1.0), abs=0.01)


def test_equal_seeds_give_equal_pings(dock, poses):
    """Equal seeds are bit-identical; another time has other speckle; the mean power does not depend on the
    seed."""
    place = ((0.2, -0.7, -3.3), (0, 0, 0, 1))
    sensor = SonarBatch(dock, sonar(beams=32, bins=64, elevations=16, noise_level_db=-110.0))
    at = poses(place, place, place)
    first = sensor.update(at, seed=4).numpy().copy()
    np.testing.assert_array_equal(first, sensor.update(at, seed=4).numpy())
    assert not np.array_equal(first, sensor.update(at, seed=4, time=0.1).numpy())
    mean = sensor.update(at).numpy().copy()
    np.testing.assert_array_equal(mean, sensor.update(at).numpy())


def ranger(**changes):
    values = {"about": "-", "source": "-", "minimum_range": 0.1, "range": 50.0, "rate": 10.0}
    values["mount"] = DeviceMount(pitch=math.pi / 2)
    return RangeDevice(**{**values, **changes})


ATTITUDES = [(0.0, 0.0, 0.0), (0.1, 0.0, 1.0), (0.0, -0.2, 0.3), (-0.15, 0.1, -2.0)]


@pytest.mark.parametrize(("roll", "pitch", "yaw"), ATTITUDES)
def test_dvl_beams_measure_the_floor_along_their_directions(roll, pitch, yaw, scenes, poses):
    """A beam measures h / cos of its angle from the vertical, at any attitude, to single precision."""
    device = ranger(beams=4, beam_angle=math.radians(22.5))
    sensor = RangeBatch(scenes("floor"), device)
    attitude = quat_from_euler(roll, pitch, yaw)
    measured = sensor.update(poses(((0, 0, -4), attitude))).numpy()[0]
    c, s, d = math.cos(math.radians(22.5)), math.sin(math.radians(22.5)), math.sqrt(0.5)
    # Beam k is turned by 45° + 90° k from the left towards the sensor's z axis: forward, as the sensor faces down.
    beams = [(forward * s * d, left * s * d, -c) for left, forward in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    down = -quat_rotate(np.broadcast_to(attitude, (4, 4)), np.array(beams))[:, 2]
    np.testing.assert_allclose(measured, 6.0 / down, rtol=2e-5)


@pytest.mark.parametrize("tilt", [0.0, 0.1, 0.3, 0.6])
def test_an_altimeter_over_a_floor_at_a_tilt(tilt, scenes, poses):
    """A ray measures h / cos(tilt); the first echo of a cone of half angle a comes from h / cos(max(tilt - a, 0))."""
    batch, at = scenes("floor"), poses(((0, 0, -4), quat_from_euler(0.0, tilt, 0.0)))
    single = RangeBatch(batch, ranger()).update(at).numpy()[0, 0]
    assert single == pytest.approx(6.0 / math.cos(tilt), rel=1e-5)
    half = 0.4
    first = RangeBatch(batch, ranger(beam_width=half, rays=400, quantile=0.0)).update(at).numpy()[0, 0]
    expected = 6.0 / math.cos(max(tilt - half, 0.0))
    assert expected * 0.9999 <= first <= expected * 1.006  # rays are some 0.035 rad apart: tan(0.2) of it


def test_out_of_reach_is_infinite(scenes, poses):
    """Range is infinite without an object above, and for a floor beyond the device's range."""
    batch, up = scenes("floor"), quat_from_euler(0.0, math.pi, 0.0)
    assert RangeBatch(batch, ranger()).update(poses(((0, 0, -4), up))).numpy()[0, 0] == np.inf
    near = RangeBatch(batch, ranger(range=5.0)).update(poses(((0, 0, -4), (0, 0, 0, 1))))
    assert near.numpy()[0, 0] == np.inf


def test_a_side_scan_hears_a_ball_abeam(scenes, poses):
    """A ball of 0.25 m, 4 m to the left, echoes in the left beam only, from its near side, within 1 dB of its
    strength."""
    turned = (0.0, 0.0, -math.sqrt(0.5), math.sqrt(0.5))  # the vehicle's left is world x
    device = sonar(mode="side_scan", beams=2, elevations=96, vertical_beam_width=math.radians(50.0))
    sensor, intensity = echo(scenes("ball"), device, poses(((-4.0, 0, -5), turned)))
    assert intensity[1].sum() < 1e-9 * intensity[0].sum()  # the noise
    first = np.flatnonzero(intensity[0] > 0.01 * intensity[0].max())[0]
    assert abs(first * sensor.bin_length - 3.75) <= sensor.bin_length
    # The beam is narrower than the ball: mu times its width times the integral over elevation.
    width = math.radians(1.0) / 0.8859
    angle = math.asin(0.25 / 4.0)

    def slice_of(e):
        r = 4.0 * math.cos(e) - math.sqrt(0.25**2 - (4.0 * math.sin(e)) ** 2)
        k = math.sqrt(1.0 - (4.0 * math.sin(e) / 0.25) ** 2)
        return MU / math.pi * k * math.cos(e) / r**2

    expected = width * quad(slice_of, -angle, angle)[0]
    assert abs(10.0 * math.log10(intensity[0].sum() / expected)) < 1.0


def test_a_side_scan_looks_down_to_both_sides(scenes, level):
    """At 30° below the horizon over a floor 5 m below, the first echo comes from 5 m / sin 67.5°."""
    device = load_device("side_scan").model_copy(update={"noise_level_db": -200.0})
    sensor, intensity = echo(scenes("floor"), device, level(0, 0, -5))
    np.testing.assert_allclose(intensity[0], intensity[1], rtol=1e-3, atol=1e-12)
    first = np.flatnonzero(intensity[0] > 1e-3 * intensity[0].max())[0] * sensor.bin_length
    assert 5.0 < first < 5.6  # angle of the lowest ray


@pytest.mark.parametrize("roll", [0.0, 0.3])
def test_a_profiler_draws_the_floor(roll, scenes, poses):
    """Ranges of a flat floor are h / cos(angle), to a cell and most of a beam's footprint."""
    device = load_device("profiler")
    sensor = SonarBatch(scenes("floor"), device)
    sensor.update(poses(((0, 0, -4), quat_from_euler(roll, 0.0, 0.0))))
    angle = device.sector * (0.5 - (np.arange(device.beams) + 0.5) / device.beams)
    expected = 6.0 / np.cos(angle + roll)
    ranges = sensor.ranges.numpy()[0]
    near = np.abs(angle + roll) < math.radians(60.0)
    # The first cell within 6 dB of the beam's loudest lies before the middle of its footprint.
    footprint = expected * np.tan(np.abs(angle + roll)) * math.radians(1.0)
    early = (expected - ranges)[near]
    assert np.all(early > -sensor.bin_length) and np.all(early < sensor.bin_length + 0.8 * footprint[near])


def dvl(**changes):
    values = {"about": "-", "source": "-", "beams": 4, "beam_angle": math.radians(22.5), "minimum_range": 0.1}
    values |= {
        "range": 8.0,
        "rate": 1.0,
        "mount": DeviceMount(position=np.array([0.3, 0.0, -0.1]), pitch=0.5 * math.pi),
    }
    return RangeDevice(**{**values, **changes})


def test_a_dvl_has_the_velocity_of_its_point_from_its_beams(scenes, poses):
    """Beams measure d . v and together v + omega x r in sensor axes; noise spreads it as the fit of the beams
    predicts."""
    attitude = quat_from_euler(0.05, -0.1, 0.4)
    nu = np.array([0.6, -0.2, 0.1, 0.05, 0.1, -0.2], np.float32)
    twists = wp.array(nu[None, None], dtype=vec6)
    sensor = DopplerBatch(scenes("floor"), dvl(velocity_noise=0.01), twists)
    pose = poses(((0, 0, -5), attitude))
    sensor.update(pose)
    point = nu[:3] + np.cross(nu[3:], [0.3, 0.0, -0.1])
    expected = np.array([-point[2], point[1], point[0]])  # its x axis points down, its z axis forward
    np.testing.assert_allclose(sensor.velocity.numpy()[0], expected, atol=1e-6)
    along = sensor.rays.numpy()[:, 0, 0, 1]
    np.testing.assert_allclose(sensor.speeds.numpy()[0], along @ expected, atol=1e-6)
    np.testing.assert_allclose(sensor.reading.numpy()[0, -4:], sensor.ranges.numpy()[0])
    assert sensor.lock.numpy().tolist() == [[1]]
    noisy = np.array([sensor.update(pose, seed=1, time=float(k)).numpy()[0, :3].copy() for k in range(400)])
    spread = 0.01 * np.sqrt(np.diag(np.linalg.inv(along.T @ along)))
    np.testing.assert_allclose(noisy.std(axis=0), spread, rtol=0.15)
    np.testing.assert_allclose(noisy.mean(axis=0), expected, atol=4.0 * spread.max() / 20.0)


def test_a_dvl_locks_on_the_bottom_while_three_beams_reach_it(scenes, level):
    """9 m over the floor no beam reaches it; the lock can be shared with another DVL, and a mask leaves it
    unchanged."""
    twists = wp.array(np.float32([[[0.5, 0, 0, 0, 0, 0]]]), dtype=vec6)
    lock = wp.full((1, 1), 1, dtype=int)
    sensor = DopplerBatch(scenes("floor"), dvl(), twists, lock=lock)
    sensor.update(level(0, 0, -1.0))
    assert lock.numpy()[0, 0] == 0 and np.isnan(sensor.reading.numpy()[0, :7]).all()
    sensor.update(level(0, 0, -5.0))
    assert lock.numpy()[0, 0] == 1 and np.isfinite(sensor.reading.numpy()).all()
    sensor.update(level(0, 0, -1.0), mask=wp.zeros(1, dtype=int))
    assert lock.numpy()[0, 0] == 1
    with pytest.raises(WorldError, match="a DVL of 2 beams"):
        DopplerBatch(scenes("floor"), dvl(beams=2), twists)
