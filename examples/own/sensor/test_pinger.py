"""Laws of the pinger: the true range without noise, equal readings for equal seeds, and the configured noise."""

import numpy as np
from pinger import PingerBatch

import finssim as fs
from finssim.core import SENSORS
from finssim.sim import SensorSuite, add_sensor

if "pinger" not in SENSORS:  # not installed yet
    add_sensor(PingerBatch)


def readings(noise_std, seed=1):
    """Return the readings of 1000 vehicles at (3, 0, -4) m [m], (1000,)."""
    pinger = {"rate": 5.0, "position": [0.0, 0.0, 0.0], "noise_std": noise_std}
    vehicle = fs.load_vehicle("bluerov2").replace({"sensors.pinger": pinger})
    sim = fs.Simulator(vehicle, worlds=1000, control_step=0.1)
    sensors = SensorSuite(sim.vehicles, worlds=1000, control_step=0.1, seed=seed)
    sim.place(position=(3.0, 0.0, -4.0))
    sensors.reset(sim.state)
    return sensors.by_name["pinger"].numpy()["range"][:, 0].copy()


def test_without_noise_it_reads_the_truth():
    np.testing.assert_allclose(readings(0.0), 5.0, rtol=1e-6)


def test_its_noise_is_that_of_its_section_and_of_its_seed():
    """The mean and the deviation of 1000 readings lie within four standard errors."""
    x = readings(0.1)
    assert abs(x.mean() - 5.0) < 4.0 * 0.1 / np.sqrt(1000)
    assert abs(x.std() / 0.1 - 1.0) < 4.0 / np.sqrt(2000)
    np.testing.assert_array_equal(readings(0.1), x)
    assert (readings(0.1, seed=2) != x).any()
