"""Rate, latency and loss of readings, compared with their definitions."""

import numpy as np
import pytest
import warp as wp

from finssim.extensions.perception import DelayedSensor, RangeBatch, WorldBatch, WorldError, load_world
from finssim.vehicles.device_files import RangeDevice

pytestmark = pytest.mark.slow

STEP = 0.1


@pytest.fixture(scope="module")
def floors(tmp_path_factory):
    """Two worlds with a floor 10 m down."""
    path = tmp_path_factory.mktemp("floors") / "floor.yaml"
    path.write_text(
        "about: A floor.\nwater: {attenuation: [0, 0, 0], veil: [0, 0, 0], daylight_attenuation: [0, 0, 0]}\n"
        "seabed: {depth: 10}\nviewpoint: {position: [0, 0, -5]}\n",
        encoding="utf-8",
    )
    return WorldBatch(load_world(path), worlds=2)


def altimeter(batch, vehicles=1, **options):
    down = {"pitch": 1.5707963}
    device = RangeDevice(about="-", source="-", minimum_range=0.0, range=50.0, rate=1.0, mount=down)
    return DelayedSensor(RangeBatch(batch, device, vehicles=vehicles), control_step=STEP, **options)


def play(delivery, steps, episodes=None):
    """Return ranges and ages by step, (steps, N) each, of vehicles that rise by 1 cm a step from 5 m over the
    floor."""
    count, readings, ages = delivery.sensor.count, [], []
    episodes = np.zeros((len(steps), 2), int) if episodes is None else episodes
    for row, episode in zip(np.asarray(steps), episodes, strict=True):
        height = np.repeat(row, count // 2)
        poses = np.zeros((count, 7), np.float32)
        poses[:, 2], poses[:, 6] = -5.0 + 0.01 * height, 1.0
        delivery.update(
            wp.array(poses, dtype=wp.transform), wp.array(row, dtype=int), wp.array(episode, dtype=int)
        )
        readings.append(delivery.numpy()[:, 0])
        ages.append(delivery.age.numpy().reshape(-1).copy())
    return np.array(readings), np.array(ages)


def both(n):
    return np.repeat(np.arange(n)[:, None], 2, axis=1)


def test_every_reading_is_that_of_its_age(floors):
    """At 2.5 Hz with 0.2 s latency, a reading is the range at t - age; its age repeatedly runs from 0.2 to
    0.5 s."""
    readings, ages = play(altimeter(floors, rate=2.5, latency=0.2), both(40))
    t = STEP * np.arange(40)[:, None]
    np.testing.assert_allclose(readings, 5.0 + 0.1 * (t - ages), atol=1e-5)
    late = ages[6:, 0]
    assert late.min() == pytest.approx(0.2, abs=1e-6) and late.max() == pytest.approx(0.5, abs=1e-6)
    assert np.sum(np.diff(ages[:, 0]) < 0.0) == 9  # samples at 0.4, 0.8, ... 3.6 s
    # The first reading arrives at once and remains the only one until the second arrives.
    np.testing.assert_allclose(ages[:6, 0], STEP * np.arange(6), atol=1e-6)


def test_losses_leave_the_last_reading_on_display(floors):
    """A quarter of 600 readings is lost, to four standard deviations; the first of an episode always arrives."""
    readings, ages = play(altimeter(floors, rate=10.0, loss=0.25, seed=3), both(300))
    np.testing.assert_allclose(readings, 5.0 + 0.1 * (STEP * np.arange(300)[:, None] - ages), atol=1e-4)
    missing = ages[1:] > 0.5 * STEP
    assert abs(missing.mean() - 0.25) < 4.0 * np.sqrt(0.25 * 0.75 / missing.size)
    assert not np.array_equal(missing[:, 0], missing[:, 1])
    assert ages[0].tolist() == [0.0, 0.0]


def test_a_reset_world_forgets_what_was_on_its_way(floors):
    """World 1 is reset after 5 steps: its first new reading arrives at once; world 0 continues."""
    steps, episodes = both(12), np.zeros((12, 2), int)
    steps[5:, 1] -= 5
    episodes[5:, 1] = 1
    readings, ages = play(altimeter(floors, rate=10.0, latency=0.3), steps, episodes)
    assert readings[5, 1] == pytest.approx(5.0, abs=1e-5) and ages[5, 1] == 0.0
    np.testing.assert_allclose(readings[5:, 1], readings[:7, 0], atol=1e-6)
    np.testing.assert_allclose(ages[3:, 0], 0.3, atol=1e-6)


def test_vehicles_of_a_world_lose_other_readings(floors):
    """Each vehicle has its own losses, the same in every run with the seed."""
    runs = [play(altimeter(floors, 2, rate=10.0, loss=0.5, seed=1), both(50))[1] for _ in range(2)]
    np.testing.assert_array_equal(*runs)
    assert len(np.unique(runs[0].T, axis=0)) == 4


def test_numbers_that_cannot_be_are_refused(floors):
    with pytest.raises(WorldError, match="rate 0.0 Hz"):
        altimeter(floors, rate=0.0)
    with pytest.raises(WorldError, match="loss 2.0"):
        altimeter(floors, rate=1.0, loss=2.0)
