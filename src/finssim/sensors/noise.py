"""Imperfections shared by all sensors: random streams, white noise, wandering bias, quantisation and saturation."""
# mypy: disable-error-code="no-any-return"

import warp as wp

# The independent random streams of one sample.
WHITE = 0
WHITE_2 = 1
WALK = 2
WALK_2 = 3
TURN_ON = 4
TURN_ON_2 = 5
DROPOUT = 6


@wp.func
def sample_key(seed: int, sensor: int, world: int, vehicle: int, episode: int, step: int) -> wp.uint32:
    """Key of everything random in one sample.

    It depends on nothing else, so a world's noise is bitwise the same in any batch, slice or thread.

    Args:
        seed: Of the suite.
        sensor: Which kind of sensor.
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
    """One standard normal number of a stream of a sample."""
    return wp.randn(wp.rand_init(int(key), stream))


@wp.func
def normal3(key: wp.uint32, stream: int) -> wp.vec3:
    """Three independent standard normal numbers of a stream of a sample."""
    state = wp.rand_init(int(key), stream)
    x = wp.randn(state)
    y = wp.randn(state)
    return wp.vec3(x, y, wp.randn(state))


@wp.func
def lost(key: wp.uint32, dropout: float) -> bool:
    """Whether a sample is lost on its way, which happens with probability `dropout`."""
    return wp.randf(wp.rand_init(int(key), DROPOUT)) < dropout


@wp.func
def digitised(x: float, quantum: float, limit: float) -> float:
    """The number a converter gives for x: the nearest multiple of its quantum, within its range.

    Args:
        x: Exact value.
        quantum: Size of one count, unit of x; 0 for none.
        limit: Largest magnitude that can be reported, unit of x; infinite for none.
    """
    y = x
    if quantum > 0.0:
        y = quantum * wp.round(x / quantum)
    return wp.clamp(y, -limit, limit)


@wp.func
def digitised3(x: wp.vec3, quantum: float, limit: float) -> wp.vec3:
    """`digitised` of each component."""
    return wp.vec3(
        digitised(x[0], quantum, limit), digitised(x[1], quantum, limit), digitised(x[2], quantum, limit)
    )
