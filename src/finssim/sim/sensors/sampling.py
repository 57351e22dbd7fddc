"""Timing of sensor samples, their latency, and the arrays that store both."""
# mypy: disable-error-code="no-any-return,valid-type,misc,index,no-untyped-def,untyped-decorator,attr-defined"

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import warp as wp

from finssim.physics.types import vec6
from finssim.vehicles.equipment import Sensor

# Errors common to all sensors: random streams, white noise, random-walk bias, quantisation and saturation.


# Independent random streams of one sample.
WHITE = 0
WHITE_2 = 1
WALK = 2
WALK_2 = 3
TURN_ON = 4
TURN_ON_2 = 5
DROPOUT = 6


@wp.func
def sample_key(seed: int, sensor: int, world: int, vehicle: int, episode: int, step: int) -> wp.uint32:
    """Return the key of all random numbers of one sample.

    It depends on nothing else, so a world's noise is bitwise the same in any batch, slice or thread.

    Args:
        seed: Seed of the suite.
        sensor: Number of the sensor.
        world: Index of the world.
        vehicle: Index of the vehicle in its world.
        episode: Resets of the world so far.
        step: Control steps since the reset.
    """
    key = wp.rand_init(seed, sensor)
    key = wp.rand_init(int(key), world)
    key = wp.rand_init(int(key), vehicle)
    key = wp.rand_init(int(key), episode)
    return wp.rand_init(int(key), step)


@wp.func
def normal(key: wp.uint32, stream: int) -> float:
    """Return one standard normal number of a stream of a sample."""
    return wp.randn(wp.rand_init(int(key), stream))


@wp.func
def normal3(key: wp.uint32, stream: int) -> wp.vec3:
    """Return three independent standard normal numbers of a stream of a sample."""
    state = wp.rand_init(int(key), stream)
    x = wp.randn(state)
    y = wp.randn(state)
    return wp.vec3(x, y, wp.randn(state))


@wp.func
def lost(key: wp.uint32, dropout: float) -> bool:
    """Return whether a sample is lost in transit, with probability `dropout`."""
    return wp.randf(wp.rand_init(int(key), DROPOUT)) < dropout


@wp.func
def digitised(x: float, quantum: float, limit: float) -> float:
    """Return x, of any unit, as quantised and saturated by a converter.

    Args:
        x: Exact value, of any unit.
        quantum: Size of one count, unit of x; 0 for none.
        limit: Largest magnitude that can be reported, unit of x; infinite for none.
    """
    y = x
    if quantum > 0.0:
        y = quantum * wp.round(x / quantum)
    return wp.clamp(y, -limit, limit)


@wp.func
def digitised3(x: wp.vec3, quantum: float, limit: float) -> wp.vec3:
    """Return `digitised` of each component, all in one unit."""
    return wp.vec3(
        digitised(x[0], quantum, limit), digitised(x[1], quantum, limit), digitised(x[2], quantum, limit)
    )


class SensedState(Protocol):
    """The state arrays that sensors read, as provided by `finssim.sim` or by any other object."""

    position: Any
    """Body origin, world frame [m]: vec3 (W, V)."""
    quaternion: Any
    """Attitude, body to world, xyzw: quat (W, V)."""
    velocity: Any
    """nu at the body origin, body frame [m/s, rad/s]: vec6 (W, V)."""
    acceleration: Any
    """nu_dot, rate of the components of nu [m/s², rad/s²]: vec6 (W, V)."""
    steps: Any
    """Control steps since the world's reset: int (W,)."""
    episode: Any
    """Resets of the world so far: int (W,)."""


@wp.struct
class SensedArrays:
    """The arrays of a `SensedState` and of the water at the vehicles, for a kernel."""

    position: wp.array2d(dtype=wp.vec3)  # body origin, world frame [m]
    quaternion: wp.array2d(dtype=wp.quat)  # attitude, body to world, xyzw
    velocity: wp.array2d(dtype=vec6)  # nu at the body origin, body frame [m/s, rad/s]
    acceleration: wp.array2d(dtype=vec6)  # nu_dot, body frame [m/s², rad/s²]
    water_velocity: wp.array2d(dtype=wp.vec3)  # world frame [m/s]; empty if it is not given
    steps: wp.array(dtype=int)  # control steps since the world's reset
    episode: wp.array(dtype=int)  # resets of the world so far


@wp.struct
class Timing:
    """Sampling times of one sensor of one vehicle."""

    samples_per_step: wp.float64  # samples in a control step [-]
    latency: int  # control steps between a sample and its arrival


@wp.struct
class Sampling:
    """State of the samples of one kind of sensor, by (world, vehicle)."""

    number: int  # number of the sensor in the key of its random numbers
    timing: wp.array(dtype=Timing)  # by vehicle
    control_step: float  # [s]
    seen: wp.array2d(dtype=int)  # step of the last update
    last: wp.array2d(dtype=int)  # step of the last sample
    sent: wp.array3d(dtype=wp.bool)  # True if the slot contains a sample in transit
    stamp: wp.array2d(dtype=float)  # time since reset of the current reading's sample [s]; -1: none yet
    fresh: wp.array2d(dtype=wp.bool)  # True if that reading arrived in this step


@wp.func
def samples_until(samples_per_step: wp.float64, step: int) -> int:
    """Return the number of samples due after a number of control steps, floor(rate * time)."""
    # In float64, and with a margin far below a step, so that 10 Hz on a 0.1 s step is one sample in every step.
    return int(wp.floor(wp.float64(step) * samples_per_step + wp.float64(1.0e-6)))


@wp.func
def sample_due(sampling: Sampling, w: int, v: int, step: int) -> bool:
    """Return whether at least one sample has become due since the last one."""
    n = sampling.timing[v].samples_per_step
    return samples_until(n, step) > samples_until(n, sampling.last[w, v])


@wp.func
def root_of_wait(sampling: Sampling, w: int, v: int, step: int) -> float:
    """Return the square root of the time since the last sample, the growth factor of a random walk [√s]."""
    return wp.sqrt(float(step - sampling.last[w, v]) * sampling.control_step)


@wp.func
def slot_of(sampling: Sampling, step: int) -> int:
    """Return the slot of the ring buffer for the sample of a step."""
    return step % sampling.sent.shape[2]


@wp.func
def begin_update(sampling: Sampling, w: int, v: int, step: int) -> bool:
    """Mark the old sample as no longer fresh, and return True if the sensor must be updated in this step."""
    sampling.fresh[w, v] = False
    if sampling.timing[v].samples_per_step == wp.float64(0.0) or step == sampling.seen[w, v]:
        return False
    sampling.seen[w, v] = step
    sampling.sent[w, v, slot_of(sampling, step)] = False
    return True


@wp.func
def restart(sampling: Sampling, w: int, v: int, step: int):
    """Discard all samples."""
    sampling.seen[w, v] = step - 1
    sampling.last[w, v] = step
    sampling.stamp[w, v] = -1.0


@wp.func
def arrival(sampling: Sampling, w: int, v: int, step: int, restarting: bool) -> int:
    """Return the slot of the sample that arrives in this step, or -1, and publish its stamp.

    Args:
        sampling: State of this kind of sensor.
        w: World.
        v: Vehicle.
        step: Control steps since the reset.
        restarting: True at a reset: the sample arrives at once, as if the sensor had been running before.
    """
    sampled = step
    if not restarting:
        sampled = step - sampling.timing[v].latency
    if sampled < 0:
        return -1
    slot = slot_of(sampling, sampled)
    if not sampling.sent[w, v, slot]:
        return -1
    sampling.sent[w, v, slot] = False
    sampling.stamp[w, v] = float(sampled) * sampling.control_step
    sampling.fresh[w, v] = True
    return slot


def new_sampling(
    rates: Sequence[float], latencies: Sequence[float], worlds: int, control_step: float, device: Any
) -> Sampling:
    """Return the state of one kind of sensor before its first sample.

    Args:
        rates: Sampling rates by vehicle [Hz]; 0 for a vehicle without such a sensor.
        latencies: Latencies by vehicle [s], rounded to the nearest control step, since readings change only then.
        worlds: Number of worlds.
        control_step: [s].
        device: Warp device.
    """
    timing: Any = np.zeros(len(rates), dtype=Timing.numpy_dtype())
    timing["samples_per_step"] = np.asarray(rates) * control_step
    timing["latency"] = np.floor(np.asarray(latencies) / control_step + 0.5 + 1e-6)
    sampling = Sampling()
    shape = (worlds, len(rates))
    sampling.timing = wp.array(timing, dtype=Timing, device=device)
    sampling.control_step = control_step
    sampling.seen = wp.full(shape, -1, dtype=int, device=device)
    sampling.last = wp.zeros(shape, dtype=int, device=device)
    sampling.sent = wp.zeros((*shape, int(timing["latency"].max()) + 1), dtype=wp.bool, device=device)
    sampling.stamp = wp.full(shape, -1.0, dtype=float, device=device)
    sampling.fresh = wp.zeros(shape, dtype=wp.bool, device=device)
    return sampling


# A kind of sensor defines its measurement and the readings of an arrived sample; all else is common to all kinds.


@wp.struct
class SampledState:
    """True state of one vehicle at the end of a control step, when a sensor samples."""

    position: wp.vec3  # body origin, world frame [m]
    quaternion: wp.quat  # attitude, body to world, xyzw
    velocity: vec6  # nu at the body origin, body frame [m/s, rad/s]
    acceleration: vec6  # nu_dot, rate of the components of nu, body frame [m/s², rad/s²]
    water: wp.vec3  # velocity of the water, world frame [m/s]
    water_known: wp.bool  # True if that velocity was given
    key: wp.uint32  # key of all random numbers of the sample
    root: float  # square root of the time since the last sample [√s]
    restarting: wp.bool  # True if the world was just reset


def parameters_of(schema: type[Sensor], **derived: Any) -> Any:
    """Return the Warp struct of a sensor's parameters that its kernel reads.

    It has the numbers of the vehicle file under the same names, without rate and latency, which determine the memory
    layout.

    Args:
        schema: Schema of the sensor's section in a vehicle file.
        derived: Further fields, which `SensorBatch.derived` fills, and their Warp types.
    """
    types = {"position": wp.vec3, "orientation": wp.quat}
    types |= {name: float for name, field in schema.model_fields.items() if field.annotation is float}
    fields = {name: kind for name, kind in types.items() if name not in ("rate", "latency")} | derived
    space = {"__annotations__": fields, "__module__": schema.__module__, "__doc__": schema.__doc__}
    return wp.struct(type(f"{schema.__name__}Parameters", (), space))


def sampling_kernel(parameters: Any, arrays: Any, measure: Any, display: Any) -> Any:
    """Return the kernel that updates all sensors of one kind after a control step, or at a reset.

    Args:
        parameters: Warp struct of one sensor, from `parameters_of`.
        arrays: Warp struct of readings and internal state.
        measure: Warp function (truth, parameters, arrays, world, vehicle, slot) -> whether there is a sample; it writes
            the sample into the slot of its ring buffers, and at a reset draws the errors that last an episode.
        display: Warp function (parameters, arrays, world, vehicle, slot) that copies an arrived sample from the slot to
            the readings.
    """

    @wp.kernel(enable_backward=False, module="unique")
    def sample(
        state: SensedArrays,
        errors: wp.array2d(dtype=parameters),
        sensor: arrays,
        sampling: Sampling,
        mask: wp.array(dtype=int),
        restarting: bool,
        seed: int,
        world_offset: int,
    ):
        i, v = wp.tid()
        w = world_offset + i
        if mask[w] == 0:
            return
        p = errors[w, v]
        step = state.steps[w]
        if restarting:
            restart(sampling, w, v, step)
        if not begin_update(sampling, w, v, step):
            return
        if restarting or sample_due(sampling, w, v, step):
            key = sample_key(seed, sampling.number, w, v, state.episode[w], step)
            truth = SampledState()
            truth.position = state.position[w, v]
            truth.quaternion = state.quaternion[w, v]
            truth.velocity = state.velocity[w, v]
            truth.acceleration = state.acceleration[w, v]
            if state.water_velocity.shape[0] > 0:
                truth.water = state.water_velocity[w, v]
                truth.water_known = True
            truth.key = key
            truth.root = root_of_wait(sampling, w, v, step)
            truth.restarting = restarting
            slot = slot_of(sampling, step)
            measured = measure(truth, p, sensor, w, v, slot)
            sampling.sent[w, v, slot] = measured and (restarting or not lost(key, p.dropout))
            sampling.last[w, v] = step
        arrived = arrival(sampling, w, v, step, restarting)
        if arrived >= 0:
            display(p, sensor, w, v, arrived)

    return sample
