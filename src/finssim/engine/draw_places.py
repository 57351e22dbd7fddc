"""Where drawn numbers go: body, thrusters, water, tether and sensors."""

import warp as wp

from finssim.engine.measured import Measurement
from finssim.engine.ranges_table import INDEX
from finssim.physics.plant import VehicleParameters
from finssim.physics.tether import Tether
from finssim.physics.types import MAX_THRUSTERS, mat66, vec6, vec8
from finssim.physics.water import WaterArrays

COLUMN = INDEX
"""Entry -> column of the drawn values."""


@wp.struct
class Nominal:
    """The vehicles as their files have them, by vehicle; and the given water."""

    plant: wp.array2d(dtype=VehicleParameters)  # one world
    M_A: wp.array(dtype=mat66)  # added mass about the point where its coefficients hold
    H: wp.array(dtype=mat66)  # twist at that point from the twist at the body origin
    current: wp.vec3  # of the given water; what is drawn adds to it [m/s]
    waves: int  # waves of the given water stay in the first slots
    extra: wp.array3d(dtype=float)  # parameters of the vehicles' terms, one world
    factor: wp.array(dtype=int)  # entry that multiplies each of them, -1 for none
    added: wp.array(dtype=int)  # entry that is added to it


@wp.func
def scaled_matrix(M: mat66, factor: vec6) -> mat66:
    """S M S with S = diag(sqrt(factor)): scales the diagonal by the factors and keeps symmetry and definiteness."""
    out = mat66()
    for i in range(6):
        for j in range(6):
            out[i, j] = M[i, j] * wp.sqrt(factor[i] * factor[j])
    return out


@wp.func
def factors(x: wp.array3d(dtype=float), w: int, v: int, column: int) -> vec6:
    """The common factor, which stands in `column`, times those of the axes, which follow."""
    out = vec6()
    for i in range(6):
        out[i] = x[w, v, column] * x[w, v, column + 1 + i]
    return out


@wp.func
def offset(x: wp.array3d(dtype=float), w: int, v: int, column: int) -> wp.vec3:
    """Three numbers that follow each other."""
    return wp.vec3(x[w, v, column], x[w, v, column + 1], x[w, v, column + 2])


@wp.func
def drawn_delay(x: wp.array3d(dtype=float), w: int, v: int, nominal: float) -> float:
    """Command delay of the episode, without jitter [s]."""
    return nominal * x[w, v, wp.static(COLUMN["delay"])] + x[w, v, wp.static(COLUMN["added_delay"])]


@wp.func
def write_body(
    plant: wp.array2d(dtype=VehicleParameters), n: Nominal, x: wp.array3d(dtype=float), w: int, v: int
):
    """Mass, centres, inertia, added mass and damping."""
    mass = x[w, v, wp.static(COLUMN["mass"])] * n.plant[0, v].mass
    r_n = n.plant[0, v].r_g
    r_g = r_n + offset(x, w, v, wp.static(COLUMN["center_of_gravity.x"]))
    # The factor is on the inertia about the centre of gravity; Steiner's part follows mass and centre.
    I_n = n.plant[0, v].inertia - n.plant[0, v].mass * (
        wp.dot(r_n, r_n) * wp.identity(3, dtype=float) - wp.outer(r_n, r_n)
    )
    steiner = wp.dot(r_g, r_g) * wp.identity(3, dtype=float) - wp.outer(r_g, r_g)
    plant[w, v].mass = mass
    plant[w, v].volume = (
        x[w, v, wp.static(COLUMN["volume"])] * x[w, v, wp.static(COLUMN["buoyancy"])] * n.plant[0, v].volume
    )
    plant[w, v].r_g = r_g
    plant[w, v].r_b = n.plant[0, v].r_b + offset(x, w, v, wp.static(COLUMN["center_of_buoyancy.x"]))
    plant[w, v].inertia = x[w, v, wp.static(COLUMN["inertia"])] * I_n + mass * steiner
    H = n.H[v]
    M_A = scaled_matrix(n.M_A[v], factors(x, w, v, wp.static(COLUMN["added_mass.all"])))
    plant[w, v].M_A = wp.transpose(H) * M_A * H
    plant[w, v].D1 = scaled_matrix(
        n.plant[0, v].D1, factors(x, w, v, wp.static(COLUMN["linear_damping.all"]))
    )
    plant[w, v].D2 = scaled_matrix(
        n.plant[0, v].D2, factors(x, w, v, wp.static(COLUMN["quadratic_damping.all"]))
    )
    drag = x[w, v, wp.static(COLUMN["mesh_drag"])]
    plant[w, v].form_drag = drag * n.plant[0, v].form_drag
    plant[w, v].skin_drag = drag * n.plant[0, v].skin_drag


@wp.func
def write_terms(extra: wp.array3d(dtype=float), n: Nominal, x: wp.array3d(dtype=float), w: int, v: int):
    """The parameters of the vehicle's terms."""
    for i in range(n.factor.shape[0]):
        y = n.extra[0, v, i]
        if n.factor[i] >= 0:
            y = y * x[w, v, n.factor[i]]
        if n.added[i] >= 0:
            y = y + x[w, v, n.added[i]]
        extra[w, v, i] = y


@wp.func
def write_thrusters(
    plant: wp.array2d(dtype=VehicleParameters), n: Nominal, x: wp.array3d(dtype=float), w: int, v: int
):
    """Gain, lag, delay, slew and dead zone."""
    gain = vec8()
    lag = vec8()
    added = vec8()
    nominal_lag = n.plant[0, v].time_constant
    for k in range(MAX_THRUSTERS):
        gain[k] = (
            x[w, v, wp.static(COLUMN["thrust.all"])]
            * x[w, v, wp.static(COLUMN["thrust.each.0"]) + k]
            * x[w, v, wp.static(COLUMN["thrust.failure.0"]) + k]
        )
        each = (
            x[w, v, wp.static(COLUMN["time_constant.all"])]
            * x[w, v, wp.static(COLUMN["time_constant.each.0"]) + k]
        )
        lag[k] = nominal_lag[k] * each + x[w, v, wp.static(COLUMN["added_time_constant"])]
        added[k] = x[w, v, wp.static(COLUMN["added_dead_zone"])]
    plant[w, v].gain = gain
    plant[w, v].time_constant = lag
    plant[w, v].delay = drawn_delay(x, w, v, n.plant[0, v].delay)
    plant[w, v].slew = x[w, v, wp.static(COLUMN["slew"])] * n.plant[0, v].slew
    wider = x[w, v, wp.static(COLUMN["dead_zone"])]
    plant[w, v].dead_minus = wider * n.plant[0, v].dead_minus - added
    plant[w, v].dead_plus = wider * n.plant[0, v].dead_plus + added


@wp.func
def write_water(water: WaterArrays, n: Nominal, x: wp.array3d(dtype=float), w: int, drift: int):
    """Current, drift and waves of a world."""
    water.current[w] = n.current + wp.vec3(
        x[w, 0, wp.static(COLUMN["current.x"])],
        x[w, 0, wp.static(COLUMN["current.y"])],
        x[w, 0, wp.static(COLUMN["vertical_current"])],
    )
    if drift != 0:
        deviation = x[w, 0, wp.static(COLUMN["current_drift.deviation"])]
        water.drift_std[w] = wp.vec3(deviation, deviation, 0.0)
        water.drift_time[w] = x[w, 0, wp.static(COLUMN["current_drift.time"])]
        water.drift[w] = wp.vec3()
        water.drift_rate[w] = wp.vec3()
    for i in range(n.waves, water.n_waves):
        column = wp.static(COLUMN["waves.0.amplitude"]) + 4 * (i - n.waves)
        k = 6.2831853 / wp.max(x[w, 0, column + 1], 0.1)
        water.wave_amplitude[w, i] = x[w, 0, column]
        water.wave_number[w, i] = k
        water.wave_frequency[w, i] = wp.sqrt(water.gravity * k * wp.tanh(k * water.depth))
        water.wave_heading[w, i] = x[w, 0, column + 2]
        water.wave_phase[w, i] = x[w, 0, column + 3]


@wp.func
def write_tether(tether: wp.array2d(dtype=Tether), x: wp.array3d(dtype=float), w: int, v: int):
    """The line to a vehicle."""
    tether[w, v].diameter = x[w, v, wp.static(COLUMN["tether.diameter"])]
    tether[w, v].drag_coefficient = x[w, v, wp.static(COLUMN["tether.drag_coefficient"])]
    tether[w, v].wet_weight = x[w, v, wp.static(COLUMN["tether.wet_weight"])]


@wp.func
def write_sensors(measurement: wp.array2d(dtype=Measurement), x: wp.array3d(dtype=float), w: int, v: int):
    """What a controller sees of a vehicle."""
    measurement[w, v].position_std = x[w, v, wp.static(COLUMN["sensors.position_std"])]
    measurement[w, v].yaw_std = x[w, v, wp.static(COLUMN["sensors.yaw_std"])]
    measurement[w, v].velocity_std = x[w, v, wp.static(COLUMN["sensors.velocity_std"])]
    measurement[w, v].rate_std = x[w, v, wp.static(COLUMN["sensors.rate_std"])]
    measurement[w, v].position_bias = x[w, v, wp.static(COLUMN["sensors.position_bias"])]
    measurement[w, v].yaw_bias = x[w, v, wp.static(COLUMN["sensors.yaw_bias"])]
    measurement[w, v].velocity_bias = x[w, v, wp.static(COLUMN["sensors.velocity_bias"])]
    measurement[w, v].rate_bias = x[w, v, wp.static(COLUMN["sensors.rate_bias"])]
    measurement[w, v].dropout = x[w, v, wp.static(COLUMN["sensors.dropout"])]
    measurement[w, v].delay = x[w, v, wp.static(COLUMN["sensors.delay"])]
