"""A sensor of your own: the range to a beacon at the world's origin, with white noise."""

import numpy as np
import warp as wp

from finssim.sim import (
    WHITE,
    SampledState,
    SensorBatch,
    SensorSuite,
    Simulator,
    add_sensor,
    normal,
    parameters_of,
    sampling_kernel,
)
from finssim.vehicles import NonNegative, Sensor, load_vehicle


class Pinger(Sensor):
    """Section of a vehicle file. Rate, latency, dropout, position and orientation are keys of every sensor."""

    noise_std: NonNegative
    """Standard deviation of the white noise [m]."""


PingerParameters = parameters_of(Pinger)


@wp.struct
class PingerArrays:
    """Readings by (world, vehicle), and the ring of samples in transit, which has one more index."""

    range: wp.array2d(dtype=float)  # [m]
    ring: wp.array3d(dtype=float)


@wp.func
def measure_range(
    truth: SampledState, p: PingerParameters, pinger: PingerArrays, w: int, v: int, slot: int
) -> bool:
    """Write one sample to its slot; return False if there is none."""
    point = truth.position + wp.quat_rotate(truth.quaternion, p.position)
    pinger.ring[w, v, slot] = wp.length(point) + p.noise_std * normal(truth.key, WHITE)
    return True


@wp.func
def display_range(p: PingerParameters, pinger: PingerArrays, w: int, v: int, slot: int):
    """Copy an arriving sample to the readings."""
    pinger.range[w, v] = pinger.ring[w, v, slot]


class PingerBatch(SensorBatch):
    """The pingers of all vehicles of all worlds."""

    kind = "pinger"
    schema = Pinger
    kernel = sampling_kernel(PingerParameters, PingerArrays, measure_range, display_range)
    readings = ("range",)


if __name__ == "__main__":
    add_sensor(PingerBatch)  # an installed package registers it by an entry point instead
    mount = {"rate": 5.0, "noise_std": 0.1}
    vehicle = load_vehicle("bluerov2").replace(
        {
            "sensors.pinger": {**mount, "position": [0.2, 0.0, 0.0]},
            "sensors.stern_pinger": {**mount, "kind": "pinger", "position": [-0.2, 0.0, 0.0]},
        }
    )
    sim = Simulator(vehicle, worlds=1000, control_step=0.1)
    sensors = SensorSuite(sim.vehicles, worlds=1000, control_step=0.1, seed=1)
    sim.place(position=(3.0, 0.0, -4.0))
    sensors.reset(sim.state)
    for name in ("pinger", "stern_pinger"):
        ranges = sensors.by_name[name].numpy()["range"][:, 0]
        print(f"{name}: {ranges.mean():.2f} m, standard deviation {np.std(ranges):.1f} m")
