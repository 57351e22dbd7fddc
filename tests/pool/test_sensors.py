"""The onboard instruments read as the vehicle file specifies."""

import numpy as np
import pytest

from finssim.pool import draw_plant
from finssim.pool.firmware import PoolSensors
from finssim.pool.plant import Plant
from finssim.pool.plant_spec import Circulation, Instruments
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
IMU, GAUGE = FINSROV.sensors.imu, FINSROV.sensors.depth


def readings(instruments, seed=0, duration=20.0):
    """Return gyro, accelerometer, depth and pressure of a vehicle at rest."""
    spec = draw_plant(FINSROV, 0, "nominal").model_copy(
        update={"instruments": instruments, "circulation": Circulation()}
    )
    body = spec.body.model_copy(update={"displaced_volume": spec.body.mass / FINSROV.water.density})
    plant = Plant(FINSROV, spec.model_copy(update={"body": body}))
    sensors = PoolSensors(plant, seed)
    samples = []
    for _ in range(round(duration / sensors.period)):
        plant.advance(plant.steps_per_period)
        samples.append(sensors.sample())
    return [np.array(column) for column in zip(*samples, strict=True)]


def test_noise_has_the_density_of_the_file():
    """White noise of density σ sampled at 100 Hz has the standard deviation 10 σ; the quantisation adds q/√12."""
    gyro, accel, *_ = readings(Instruments())
    for data, density, quantum in (
        (gyro, IMU.gyro_noise_density, IMU.gyro_quantisation),
        (accel, IMU.accel_noise_density, IMU.accel_quantisation),
    ):
        assert np.std(data, axis=0) == pytest.approx(
            np.hypot(density * np.sqrt(IMU.rate), quantum / np.sqrt(12.0)), rel=0.1
        )


def test_perfect_instruments_are_exact():
    """With a noise factor of 0 they read zero rates, gravity and the port's depth, to their quantisation."""
    gyro, accel, depth, pressure = readings(Instruments(noise=0.0), duration=1.0)
    assert np.abs(gyro).max() < IMU.gyro_quantisation
    np.testing.assert_allclose(accel[-1], (0.0, 0.0, 9.81), atol=2 * IMU.accel_quantisation)
    assert depth[-1] == pytest.approx(0.5 + 0.115, abs=GAUGE.quantisation)
    assert pressure[-1] == pytest.approx(101325.0 + 1027.0 * 9.81 * depth[-1], rel=1e-6)


def test_the_noise_factor_scales_biases_and_noise():
    """Doubling the factor doubles the errors, sample by sample."""
    one, two = readings(Instruments(noise=1.0), duration=0.5), readings(Instruments(noise=2.0), duration=0.5)
    np.testing.assert_allclose(two[0], 2.0 * one[0], atol=2.0 * IMU.gyro_quantisation)


def test_pressure_drifts_as_the_plant_says():
    """A random walk of 5 mm/√s drifts by decimetres in minutes; without one the depth is constant."""
    drifting = readings(Instruments(noise=0.0, pressure_drift=0.05), duration=60.0)[2]
    still = readings(Instruments(noise=0.0), duration=60.0)[2]
    assert np.ptp(drifting) > 0.1 and np.ptp(still) <= GAUGE.quantisation + 1e-6


def test_the_gauge_is_slower_than_the_imu():
    """At 20 Hz in frames of 100 Hz, each reading repeats in about five frames."""
    depth = readings(Instruments(noise=20.0), duration=5.0)[2]
    assert 80 <= np.count_nonzero(np.diff(depth)) <= 100


def test_seeds_draw_other_errors():
    """Equal seeds repeat their errors."""
    a, b, c = (readings(Instruments(), seed, 0.3)[0] for seed in (1, 1, 2))
    assert np.array_equal(a, b) and not np.array_equal(a, c)
