"""Noise, delay and dropouts of a controller's observations, for every vehicle of every world."""

import warp as wp


@wp.struct
class MeasurementErrors:
    """Errors of the observations of one vehicle; all 0 gives the true state."""

    position_std: float  # noise drawn every control step, per axis [m]
    yaw_std: float  # [rad]
    velocity_std: float  # per axis of the linear velocity [m/s]
    rate_std: float  # per axis of the angular velocity [rad/s]
    position_bias: float  # standard deviation of an offset that lasts an episode, per axis [m]
    yaw_bias: float  # [rad]
    velocity_bias: float  # [m/s]
    rate_bias: float  # [rad/s]
    dropout: float  # probability that a control step has no new sample
    delay: float  # age of the observation [s], rounded to the nearest control step


SENSORS = tuple(MeasurementErrors.cls.__annotations__)
"""Names of the fields of `MeasurementErrors`."""
