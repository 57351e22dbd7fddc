"""A sensor from outside the package: range to a beacon at the world's origin."""
# mypy: disable-error-code="valid-type,misc,index,no-any-return,no-untyped-def,untyped-decorator"

import warp as wp

from finssim.sim.sensors.batch import SensorBatch
from finssim.sim.sensors.sampling import WHITE, Truth, normal, parameters_of, sampling_kernel
from finssim.vehicles.equipment import Sensor
from finssim.vehicles.part import NonNegative


class Pinger(Sensor):
    """Range to a beacon at the world's origin."""

    noise_std: NonNegative
    """[m]"""


PingerParameters = parameters_of(Pinger)


@wp.struct
class PingerArrays:
    range: wp.array2d(dtype=float)
    ring: wp.array3d(dtype=float)


@wp.func
def measure_range(
    truth: Truth, p: PingerParameters, key: wp.uint32, root: float, restarting: bool, pinger: PingerArrays, w: int,
    v: int, slot: int,
) -> bool:  # fmt: skip
    pinger.ring[w, v, slot] = wp.length(truth.position) + p.noise_std * normal(key, WHITE)
    return True


@wp.func
def display_range(p: PingerParameters, pinger: PingerArrays, w: int, v: int, slot: int):
    pinger.range[w, v] = pinger.ring[w, v, slot]


class PingerBatch(SensorBatch):
    """The pingers of all vehicles of all worlds."""

    kind = "pinger"
    schema = Pinger
    parameter_struct = PingerParameters
    array_struct = PingerArrays
    kernel = sampling_kernel(77, PingerParameters, PingerArrays, measure_range, display_range)
    readings = ("range",)
