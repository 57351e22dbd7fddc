"""Sensors of a vehicle's own motion, with the noise, delays and losses of real instruments."""

from finssim.sim.sensors.batch import SensorError
from finssim.sim.sensors.suite import SensorSuite, add_sensor

__all__ = ["SensorError", "SensorSuite", "add_sensor"]
