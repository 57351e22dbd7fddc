"""Plant: a vehicle in water with effects outside every training model, with its motors and their speed loops."""
# mypy: disable-error-code="valid-type,misc,index,no-any-return,no-untyped-def,untyped-decorator,attr-defined"

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from finssim.physics.hydrostatics import submerged_fraction
from finssim.physics.kinematics import up_in_body
from finssim.physics.motors import thrust_of_speed
from finssim.physics.plant import VehicleCommand
from finssim.physics.terms.composed import layout
from finssim.physics.types import MAX_THRUSTERS, angular, join, linear, mat66, vec6, vec8
from finssim.physics.water import WaterArrays, profile_at
from finssim.pool.plant_spec import (
    HEADROOM,
    Basin,
    Circulation,
    FirmwareSpec,
    PlantSpec,
    PlantSpecError,
    SlackTether,
)
from finssim.sim import Dock, RectangularPool, Simulator, TetherLine, Water, Wave
from finssim.sim.plant_arrays import NO_LIMIT
from finssim.sim.state import State
from finssim.vehicles import Vehicle
from finssim.vehicles.hydrodynamics import MeshSet

# Circulation of the pool: slowly varying eddies in a box, which vanish at the walls.


@wp.struct
class CirculationData:
    """Circulation, by mode."""

    count: int
    length: float  # [m]
    width: float  # [m]
    depth: float  # [m]
    floor_share: float  # ratio of the speed at the floor to that at the surface
    stream: wp.vec3  # uniform current [m/s]
    cells: wp.array(dtype=float)  # number of cells along the pool [-]
    speed: wp.array(dtype=float)  # signed by the sense of rotation [m/s]
    unsteadiness: wp.array(dtype=float)  # relative amplitude of the speed's variation [-]
    rate: wp.array(dtype=float)  # [rad/s]
    phase: wp.array(dtype=float)  # [rad]


@wp.func
def circulation_at(circulation: CirculationData, position: wp.vec3, t: float) -> wp.vec3:
    """Return the velocity of the water, world frame [m/s].

    From the stream function psi = A sin(πX) sin(cπX) sin²(πY), with X and Y from wall to wall and c cells:
    (u, v) = (∂psi/∂y, -∂psi/∂x) has zero divergence, and both components vanish at all four walls. The largest speed
    along y is A π / length for c = 1, that along x A π / width.

    Args:
        circulation: The circulation.
        position: World frame [m].
        t: Time [s].

    Returns:
        The uniform current and, within the walls, the horizontal velocity of the eddies [m/s].
    """
    X = position[0] / circulation.length + 0.5
    Y = position[1] / circulation.width + 0.5
    if X <= 0.0 or X >= 1.0 or Y <= 0.0 or Y >= 1.0:
        return circulation.stream
    sx = wp.sin(wp.pi * X)
    cx = wp.cos(wp.pi * X)
    sy = wp.sin(wp.pi * Y)
    cy = wp.cos(wp.pi * Y)
    height = wp.clamp(1.0 + position[2] / circulation.depth, 0.0, 1.0)
    share = circulation.floor_share + (1.0 - circulation.floor_share) * height
    u = float(0.0)
    v = float(0.0)
    for i in range(circulation.count):
        c = circulation.cells[i]
        sc = wp.sin(c * wp.pi * X)
        cc = wp.cos(c * wp.pi * X)
        now = circulation.speed[i] * (
            1.0 + circulation.unsteadiness[i] * wp.sin(circulation.rate[i] * t + circulation.phase[i])
        )
        # A is chosen so that the larger of the two components has the mode's speed.
        A = now * wp.min(circulation.width, circulation.length / c) / wp.pi
        u += A * sx * sc * (2.0 * wp.pi / circulation.width) * sy * cy
        v -= A * (wp.pi / circulation.length) * (cx * sc + c * sx * cc) * sy * sy
    return circulation.stream + share * wp.vec3(u, v, 0.0)


def circulation_data(circulation: Circulation, basin: Basin, device: Any = "cpu") -> CirculationData:
    """Return the circulation as a struct for kernels."""
    out = CirculationData()
    modes = circulation.eddies
    out.count = len(modes)
    out.length, out.width, out.depth = basin.length, basin.width, basin.depth
    uniform = circulation.water.uniform if circulation.water else (0.0, 0.0, 0.0)
    out.floor_share, out.stream = circulation.floor_share, wp.vec3(*np.add(circulation.stream, uniform))
    return with_arrays(
        out,
        device,
        cells=[m.cells for m in modes],
        speed=[m.sense * m.speed for m in modes],
        unsteadiness=[m.unsteadiness for m in modes],
        rate=[2.0 * math.pi / m.period for m in modes],
        phase=[m.phase for m in modes],
    )


# Losses of a propeller's thrust by the hull, by its motion and by neighbouring jets.


Array = NDArray[np.float64]


def with_arrays(struct: Any, device: Any = "cpu", **columns: Any) -> Any:
    """Set the arrays of a struct, by name; an empty one becomes a single 0."""
    for name, values in columns.items():
        numbers = np.asarray(values if len(values) else [0.0], dtype=np.float32)
        setattr(struct, name, wp.array(numbers, dtype=float, device=device))
    return struct


SLOWEST = 3.0
"""Propeller speed below which the loss of thrust is computed as at this speed [1/s]: the thrust is small there."""


@wp.struct
class PropellerBank:
    """All propellers, in canonical order."""

    count: int
    axis: wp.array(dtype=wp.vec3)  # unit vector of the thrust, body frame
    place: wp.array(dtype=wp.vec3)  # position, body frame [m]
    c_plus: wp.array(dtype=float)  # true coefficient, reduced by the thrust deduction [N s²/rad²]
    c_minus: wp.array(dtype=float)  # the same for reverse [N s²/rad²]
    own_share: wp.array(dtype=float)  # fraction of the vehicle's speed along the thrust in the inflow
    share: wp.array2d(dtype=float)  # fraction of neighbour j's induced speed that enters propeller k
    stall: float  # J0 D / 2π: inflow at zero thrust, per shaft speed [m]
    disc: float  # 2 ρ times the disc area [kg/m]
    others: wp.array(dtype=float)  # commands of the channels after the propellers [rad, m³ or m]


@wp.func
def delivered_thrust(propellers: PropellerBank, speed: wp.array(dtype=float), nu_r: vec6) -> vec8:
    """Return the delivered thrust, T = T_bollard (1 - V / (J0 n D)), by propeller [N], followed by the other commands.

    The inflow V is a fraction of the vehicle's speed along the thrust, v·a sign T, plus that of the neighbours' jets:
    their induced speed sqrt(|T| / 2 ρ A), from momentum theory, which decreases with distance.

    Args:
        propellers: All propellers.
        speed: Shaft speeds [rad/s], (n,).
        nu_r: Velocity relative to the water, body frame [m/s, rad/s].
    """
    bollard = vec8()
    for k in range(propellers.count):
        bollard[k] = thrust_of_speed(speed[k], propellers.c_plus[k], propellers.c_minus[k])
    T = vec8()
    for k in range(propellers.count):
        V = float(0.0)
        for j in range(propellers.count):
            V += propellers.share[k, j] * wp.sqrt(wp.abs(bollard[j]) / propellers.disc)
        inflow = wp.dot(propellers.axis[k], linear(nu_r) + wp.cross(angular(nu_r), propellers.place[k]))
        V += propellers.own_share[k] * wp.sign(bollard[k]) * inflow
        slowest = wp.static(2.0 * math.pi * SLOWEST)
        loss = V / (propellers.stall * wp.max(wp.abs(speed[k]), slowest))
        T[k] = bollard[k] * (1.0 - wp.clamp(loss, -1.0, 1.0))
    for k in range(propellers.count, MAX_THRUSTERS):
        T[k] = propellers.others[k]
    return T


def induced_shares(vehicle: Vehicle, spec: PlantSpec) -> Array:
    """Return the fraction of neighbour j's induced speed that enters propeller k, (n, n)."""
    p = spec.propellers
    position = np.array([t.position for t in vehicle.thrusters.values()])
    distance = np.linalg.norm(position[:, None] - position, axis=-1)
    return np.asarray(
        p.induced_share * np.exp(-distance / p.induced_reach) * (1.0 - np.eye(len(vehicle.thrusters)))
    )


def propeller_bank(vehicle: Vehicle, spec: PlantSpec, device: Any = "cpu") -> PropellerBank:
    """Return the propellers of a vehicle with the parameters of a plant."""
    nominal = list(vehicle.thrusters.values())
    true = [spec.thrusters[name] for name in vehicle.thruster_names]
    bank = PropellerBank()
    bank.count = len(nominal)
    bank.axis = wp.array(np.array([t.axis for t in nominal]), dtype=wp.vec3, device=device)
    bank.place = wp.array(np.array([t.position for t in nominal]), dtype=wp.vec3, device=device)
    built = list(zip(nominal, true, strict=True))
    with_arrays(
        bank,
        device,
        c_plus=[t.c_plus * b.gain_plus * (1.0 - b.deduction) for t, b in built],
        c_minus=[t.c_minus * b.gain_minus * (1.0 - b.deduction) for t, b in built],
        share=induced_shares(vehicle, spec),
        own_share=[0.0 if t.inflow else spec.propellers.own_share for t in nominal],
        others=np.zeros(MAX_THRUSTERS),
    )
    bank.stall = spec.propellers.advance_at_zero_thrust * spec.propellers.diameter / (2.0 * math.pi)
    bank.disc = 2.0 * vehicle.water.density * 0.25 * math.pi * spec.propellers.diameter**2
    return bank


# Pull of a slack tether, zero until it is nearly straight. Its drag and weight are those of the engine's `TetherLine`.


@wp.struct
class SlackTetherData:
    """Tether that pulls only near its full length; a stiffness of 0 means no tether."""

    anchor: wp.vec3  # world frame [m]
    attachment: wp.vec3  # body frame [m]
    start: float  # distance at which the pull begins [m]
    stretch: float  # additional distance at which it is straight [m]
    stiffness: float  # when straight [N/m]


@wp.func
def slack_pull(line: SlackTetherData, position: wp.vec3, q: wp.quat) -> vec6:
    """Return the wrench of the tether on the vehicle about its origin, body frame [N, N m].

    With the distance e beyond the start and the distance s from there to straight: F = k e²/(2 s) for e < s, then
    k (e - s/2). The pull is conservative.

    Args:
        line: The tether.
        position: Body origin, world frame [m].
        q: Attitude, body to world.
    """
    if line.stiffness <= 0.0:
        return vec6()
    along = line.anchor - position - wp.quat_rotate(q, line.attachment)
    distance = wp.length(along)
    e = distance - line.start
    if e <= 0.0:
        return vec6()
    pull = line.stiffness * wp.where(e < line.stretch, 0.5 * e * e / line.stretch, e - 0.5 * line.stretch)
    force = wp.quat_rotate_inv(q, along * (pull / distance))
    return join(force, wp.cross(line.attachment, force))


def slack_line(tether: SlackTether | None) -> SlackTetherData:
    """Return the tether as a struct for kernels."""
    line = SlackTetherData()
    if tether is not None:
        line.anchor, line.attachment = wp.vec3(*tether.anchor), wp.vec3(*tether.attachment)
        line.stretch = tether.slack_share * tether.length
        line.start = tether.length - line.stretch
        line.stiffness = tether.stiffness
    return line


def dragged_line(tether: SlackTether | None) -> TetherLine | None:
    """Return drag and weight of the tether, for the engine."""
    if tether is None:
        return None
    return TetherLine(
        anchor=tether.anchor,
        attachment=tether.attachment,
        diameter=tether.diameter,
        drag_coefficient=tether.drag_coefficient,
        wet_weight=tether.wet_weight,
    )


# Motors, battery and the firmware's speed loops: Warp functions over all motors.


RPM = 2.0 * math.pi / 60.0
"""One revolution per minute [rad/s]."""

FILTER = 0.02
"""Filter time constant of the measured speed in the derivative term [s]."""


@wp.struct
class PowerSupply:
    """Battery and wiring that supply all motors."""

    full_voltage: float  # [V]
    fade: float  # fraction of the voltage that is lost after fade_time
    fade_time: float  # [s]
    resistance: float  # [ohm]
    motor_power: float  # of one motor at full speed [W]
    idle_current: float  # [A]
    electric: wp.array(dtype=float)  # present voltage [V] and current [A]


@wp.struct
class SpeedLoop:
    """Speed loop of the firmware: its parameters, and its memory for every motor."""

    on: int  # 0: no speed loop, the target determines the throttle
    steps: int  # motor steps between two runs
    period: float  # [s]
    rated: wp.array(dtype=float)  # speed of a nominal motor at full throttle and full battery [rad/s]
    scale: wp.array(dtype=float)  # speed at full throttle that the firmware assumes [rad/s]
    model_alpha: wp.array(dtype=float)  # step response of the firmware's motor model after one run [-]
    kp: float  # gain of the relative speed error [-]
    ki: float  # [1/s]
    kd: float  # [s]
    noise: float  # of one speed measurement [rad/s]
    quantum: float  # of one speed measurement [rad/s]
    measured: wp.array(dtype=float)  # newest measurement [rad/s]
    smooth: wp.array(dtype=float)  # smoothed measurement for the derivative [rad/s]
    expected: wp.array(dtype=float)  # speed in the firmware's motor model [rad/s]
    integral: wp.array(dtype=float)  # integral part of the throttle [-]


@wp.struct
class MotorBank:
    """Parameters and memory of all motors, in canonical order; speeds are canonical too (positive for forward
    thrust)."""

    count: int
    alpha: wp.array(dtype=float)  # fraction 1 - exp(-motor step / time constant) of the response in one step
    delay: wp.array(dtype=int)  # delay from throttle to shaft in motor steps
    full: wp.array(dtype=float)  # steady speed at full throttle and full battery [rad/s]
    dead_plus: wp.array(dtype=float)  # slowest speed of the shaft [rad/s]
    dead_minus: wp.array(dtype=float)  # the same in reverse, as a magnitude [rad/s]
    target: wp.array(dtype=float)  # [rad/s]
    speed: wp.array(dtype=float)  # true shaft speed [rad/s]
    throttle: wp.array(dtype=float)  # newest [-1, 1]
    line: wp.array2d(dtype=float)  # delayed throttles [-1, 1]
    supply: PowerSupply
    loop: SpeedLoop


@wp.func
def throttle_of(motors: MotorBank, k: int, noise: float) -> float:
    """Run the speed loop of motor k once: feed-forward plus PID on the deviation from the motor model.

    Without a speed loop, the throttle is the target divided by the full-throttle speed of a nominal motor, so the
    actual speed depends on the true motor and the battery voltage.

    Args:
        motors: All motors; memory of motor k is written.
        k: Index of the motor.
        noise: A standard normal number.

    Returns:
        Throttle [-1, 1].
    """
    measured = motors.speed[k] + motors.loop.noise * noise
    if motors.speed[k] == 0.0:
        measured = 0.0  # a stopped shaft produces no pulses to count
    if motors.loop.quantum > 0.0:
        measured = motors.loop.quantum * wp.round(measured / motors.loop.quantum)
    motors.loop.measured[k] = measured
    before = motors.loop.smooth[k]
    motors.loop.smooth[k] = before + (motors.loop.period / wp.static(FILTER)) * (measured - before)
    target = motors.target[k]
    if motors.loop.on == 0:
        return wp.clamp(target / motors.loop.rated[k], -1.0, 1.0)
    if target == 0.0:
        motors.loop.integral[k] = 0.0
        motors.loop.expected[k] = measured
        return 0.0
    scale = motors.loop.scale[k]
    expected = motors.loop.expected[k] + motors.loop.model_alpha[k] * (target - motors.loop.expected[k])
    motors.loop.expected[k] = expected
    error = (expected - measured) / scale
    rate = (motors.loop.smooth[k] - before) / (motors.loop.period * scale)
    u = target / scale + motors.loop.kp * error + motors.loop.integral[k] - motors.loop.kd * rate
    # Integrate only while the throttle is not saturated.
    if wp.abs(u) < 1.0 or u * error < 0.0:
        motors.loop.integral[k] = motors.loop.integral[k] + motors.loop.ki * motors.loop.period * error
    # The throttle never has the opposite sign of the target: only the target can reverse the motor.
    return wp.clamp(u, wp.where(target > 0.0, 0.0, -1.0), wp.where(target > 0.0, 1.0, 0.0))


@wp.func
def steady_speed(motors: MotorBank, k: int, throttle: float, voltage: float) -> float:
    """Return the steady speed of motor k [rad/s]: throttle times voltage, and 0 below its slowest speed."""
    speed = throttle * motors.full[k] * voltage / motors.supply.full_voltage
    if speed < motors.dead_plus[k] and speed > -motors.dead_minus[k]:
        return 0.0
    return speed


@wp.func
def turn_motors(motors: MotorBank, tick: int, dt: float, noise: wp.uint32):
    """Advance every motor by one motor step: speed loop when due, delay line, first-order lag.

    Args:
        motors: All motors; their memory is written.
        tick: Motor steps since the start.
        dt: Motor step [s], for the battery's fade.
        noise: Random state of this step.
    """
    power = float(0.0)
    slots = motors.line.shape[1]
    age = wp.min(float(tick) * dt / motors.supply.fade_time, 1.0)
    rest = motors.supply.full_voltage * (1.0 - motors.supply.fade * age)
    voltage = rest - motors.supply.resistance * motors.supply.electric[1]
    for k in range(motors.count):
        if tick % motors.loop.steps == 0:
            motors.throttle[k] = throttle_of(motors, k, wp.randn(noise))
        motors.line[k, tick % slots] = motors.throttle[k]
        late = motors.line[k, (tick + slots - motors.delay[k]) % slots]
        goal = steady_speed(motors, k, late, voltage)
        speed = motors.speed[k] + motors.alpha[k] * (goal - motors.speed[k])
        if goal == 0.0 and wp.abs(speed) < 1.0:
            speed = 0.0  # friction stops a slow shaft completely
        motors.speed[k] = speed
        part = wp.abs(speed) / motors.full[k]
        power += motors.supply.motor_power * part * part * part
    motors.supply.electric[0] = voltage
    motors.supply.electric[1] = motors.supply.idle_current + power / voltage


def motor_bank(
    vehicle: Vehicle, spec: PlantSpec, dt: float, device: Any = "cpu", *, speed_loop: bool = True
) -> MotorBank:
    """Return motors at rest.

    Args:
        vehicle: Nominal vehicle of the file, which the firmware assumes.
        spec: True parameters.
        dt: Motor step [s].
        device: Warp device.
        speed_loop: Whether the firmware controls speeds; if not, targets determine throttles, as at full voltage.
    """
    true = [spec.thrusters[name] for name in vehicle.thruster_names]
    bank = MotorBank()
    n = bank.count = len(true)
    delay = [round(t.delay / dt) for t in true]
    arrays = {
        "alpha": 1.0 - np.exp(-dt / np.array([t.time_constant for t in true])),
        "full": [t.full_rpm * RPM for t in true],
        "dead_plus": [t.dead_rpm_plus * RPM for t in true],
        "dead_minus": [t.dead_rpm_minus * RPM for t in true],
        **{name: np.zeros(n) for name in ("target", "speed", "throttle")},
    }
    with_arrays(bank, device, **arrays)
    bank.delay = wp.array(delay, dtype=int, device=device)
    bank.line = wp.zeros((n, max(delay) + 1), dtype=float, device=device)
    supply = PowerSupply()
    for name in ("full_voltage", "fade", "fade_time", "resistance", "motor_power", "idle_current"):
        setattr(supply, name, getattr(spec.battery, name))
    with_arrays(supply, device, electric=[spec.battery.full_voltage, spec.battery.idle_current])
    bank.supply = supply  # a copy, which shares its arrays
    bank.loop = _speed_loop(vehicle, spec.firmware, dt, device, speed_loop)
    return bank


def _speed_loop(vehicle: Vehicle, firmware: FirmwareSpec, dt: float, device: Any, on: bool) -> SpeedLoop:
    """Return the speed loop of a firmware that assumes the vehicle file; arguments as for `motor_bank`."""
    nominal, loop = list(vehicle.thrusters.values()), SpeedLoop()
    fastest = np.array([max(t.rpm_max, -t.rpm_min) for t in nominal])
    lag = np.array([t.time_constant + t.delay for t in nominal])
    loop.on, loop.steps = int(on), max(1, round(firmware.loop_period / dt))
    loop.period = loop.steps * dt
    loop.kp, loop.ki, loop.kd = firmware.gain, firmware.integral_gain, firmware.derivative_gain
    loop.noise, loop.quantum = firmware.rpm_noise * RPM, firmware.rpm_quantum * RPM
    arrays = {
        "rated": HEADROOM * fastest * RPM,
        "scale": fastest * RPM / firmware.feed_forward,
        "model_alpha": 1.0 - np.exp(-loop.period / lag),
        **{name: np.zeros(len(nominal)) for name in ("measured", "smooth", "expected", "integral")},
    }
    return with_arrays(loop, device, **arrays)  # type: ignore[no-any-return]


LONGEST_STEP = 0.005
"""Longest physics step [s]."""

MOTOR_STEP = 0.001
"""Longest step of motors and speed loops [s]."""


@wp.struct
class HiddenForces:
    """Forces on the body in addition to the engine's own."""

    T: mat66  # body twist to the axes of the damping [-, m]
    D1: mat66  # linear damping [N s/m, N m s]
    D2: mat66  # quadratic damping [N s²/m², N m s²]
    r_b: wp.vec3  # centre of buoyancy, body frame [m]
    half_height: float  # half height of the surface transition [m]
    drifts: int
    drift: wp.array(dtype=float)  # amplitude of each slow change of buoyancy [N]
    drift_rate: wp.array(dtype=float)  # [rad/s]
    drift_phase: wp.array(dtype=float)  # [rad]


@wp.func
def coupled_damping(hidden: HiddenForces, nu_r: vec6) -> vec6:
    """Return tau_D = -Tᵀ [D1 x + D2 (|x| x)], x = T nu_r, about the body origin [N, N m]."""
    x = hidden.T * nu_r
    return -wp.transpose(hidden.T) * (hidden.D1 * x + hidden.D2 * wp.cw_mul(wp.abs(x), x))


@wp.func
def buoyancy_change(hidden: HiddenForces, t: float) -> float:
    """Return the slow change of buoyancy at a time [N]."""
    total = float(0.0)
    for i in range(hidden.drifts):
        total += hidden.drift[i] * wp.sin(hidden.drift_rate[i] * t + hidden.drift_phase[i])
    return total


@wp.struct
class PlantModel:
    """Parts of a plant in addition to the engine."""

    motors: MotorBank
    propellers: PropellerBank
    hidden: HiddenForces
    circulation: CirculationData
    line: SlackTetherData


@wp.kernel(enable_backward=False)
def drive(
    state: State,
    command: wp.array2d(dtype=VehicleCommand),
    surroundings: WaterArrays,
    plant_model: PlantModel,
    step: float,
    motor_steps: int,
    seed: int,
    world_offset: int,
):
    """Advance the motors before a physics step, and write thrusts, wrench and current for the engine.

    Args:
        state: State of one world with one vehicle.
        command: Output: thrusts along the thrusters' axes [N], commands of other actuators, and the wrench about the
            body origin, body frame [N, N m], (worlds, vehicles).
        surroundings: Water of the engine; its current is written, to which the engine adds the profile.
        machinery: Motors, propellers and additional forces on the body.
        step: Physics step [s].
        motor_steps: Number of motor steps in it.
        seed: Seed of the noise of speed measurements.
        world_offset: First world of this launch; not used.
    """
    hidden = plant_model.hidden
    count = state.steps[0]
    t = float(count) * step
    dt = step / float(motor_steps)
    for j in range(motor_steps):
        tick = count * motor_steps + j
        turn_motors(plant_model.motors, tick, dt, wp.rand_init(seed, tick))
    x = state.position[0, 0]
    q = state.quaternion[0, 0]
    nu = state.velocity[0, 0]
    water = circulation_at(plant_model.circulation, x, t)
    surroundings.current[0] = water
    if surroundings.profile_depth.shape[0] > 0:
        profile = profile_at(surroundings, 0, -wp.min(x[2], 0.0), t)
        water += profile.velocity
    nu_r = nu - join(wp.quat_rotate_inv(q, water), wp.vec3(0.0))
    command[0, 0].thrust = delivered_thrust(plant_model.propellers, plant_model.motors.speed, nu_r)
    up = up_in_body(q)
    wet = submerged_fraction(x[2] + wp.dot(up, hidden.r_b), hidden.half_height)
    lift = wet * buoyancy_change(hidden, t) * up
    tau = wet * coupled_damping(hidden, nu_r) + join(lift, wp.cross(hidden.r_b, lift))
    command[0, 0].disturbance = tau + slack_pull(plant_model.line, x, q)


class Plant:
    """One vehicle in one pool, driven by shaft speeds that only the firmware commands."""

    def __init__(
        self,
        vehicle: Vehicle,
        spec: PlantSpec,
        *,
        seed: int = 0,
        period: float = 0.01,
        start: tuple[ArrayLike, ArrayLike] = ((0.0, 0.0, -0.5), (0.0, 0.0, 0.0, 1.0)),
        speed_loop: bool = True,
        world: Any | None = None,
        dock: Dock | None = None,
    ) -> None:
        """Put the vehicle into the water, at rest.

        Args:
            vehicle: Its file.
            spec: Hidden true parameters.
            seed: Seed of the noise of speed measurements.
            period: Time that must be a multiple of the physics step [s], such as the sensors' period.
            start: Position of the body origin, world frame [m], (3,), and attitude, body to world, xyzw, (4,).
            speed_loop: Whether the firmware controls shaft speeds; if not, `target` determines throttles, as at full
                voltage.
            world: Single instance of a world whose objects the hull can touch; its basin replaces that of `spec`.
            dock: Funnel in the water, at `simulator.funnel`.

        Raises:
            PlantSpecError: The plant is for another vehicle.
        """
        terms = getattr(vehicle.hydrodynamics["calibrated"], "terms", {})
        for kind, have, wanted in (
            ("thrusters", spec.thrusters, vehicle.thrusters),
            ("actuators", spec.actuators, vehicle.actuators),
            ("terms", spec.terms, terms),
        ):
            if set(have) != set(wanted):
                raise PlantSpecError(
                    f"plant '{spec.title}' has the {kind} {', '.join(have) or 'none'}, but {vehicle.name} "
                    f"has {', '.join(wanted) or 'none'}: draw a plant around this vehicle"
                )
        if terms and (spec.hull.form_drag or spec.hull.skin_drag):
            raise PlantSpecError(
                f"plant '{spec.title}' has drag of the hull's panels beside {', '.join(terms)}: set `hull` to 0"
            )
        self.vehicle, self.spec = vehicle, spec
        self.steps_per_period = math.ceil(period / LONGEST_STEP - 1e-9)
        self.step = period / self.steps_per_period
        """Physics step [s]."""
        motor_steps = math.ceil(self.step / MOTOR_STEP - 1e-9)
        self.simulator = self._simulator(start, world, dock)
        self.motors = motor_bank(vehicle, spec, self.step / motor_steps, speed_loop=speed_loop)
        self._views()
        s = self.simulator
        pipeline = s.pipeline()
        propellers = propeller_bank(vehicle, spec)
        # Kept: a captured launch does not keep arrays inside structs alive.
        plant_model = self._plant_model = PlantModel()
        plant_model.motors, plant_model.propellers, plant_model.hidden = (
            self.motors,
            propellers,
            _hidden(vehicle, spec),
        )
        plant_model.circulation, plant_model.line = (
            circulation_data(spec.circulation, spec.basin),
            slack_line(spec.tether),
        )
        # Different random numbers for every plant: consecutive seeds must not share any.
        key = int(np.random.SeedSequence([seed, 71]).generate_state(1)[0] >> 1)
        inputs = [s.state, s.command.array, s.water, plant_model, self.step, motor_steps, key]
        pipeline.add(drive, inputs)
        s.add_step(pipeline)
        self._step = captured(pipeline.run)
        self.steps = 0
        self._others = propellers.others.numpy()[len(vehicle.thrusters) : len(vehicle.channel_names)]
        built = [spec.actuators[name] for name in vehicle.actuators]
        self._gain = np.array([a.gain for a in built])
        self._offset = np.array([a.offset for a in built])

    def _simulator(
        self, start: tuple[ArrayLike, ArrayLike], world: Any | None, dock: Dock | None
    ) -> Simulator:
        spec, hull = self.spec, self.spec.hull
        water = replace(spec.circulation.water or Water(), depth=spec.basin.depth)
        basin = RectangularPool(length=spec.basin.length, width=spec.basin.width, depth=spec.basin.depth)
        meshed = hull.form_drag > 0.0 or hull.skin_drag > 0.0
        vehicle = self.vehicle
        if meshed:
            drag = MeshSet(form_drag=hull.form_drag, skin_drag=hull.skin_drag)
            vehicle = vehicle.model_copy(update={"hydrodynamics": {**vehicle.hydrodynamics, "mesh": drag}})
        simulator = Simulator(
            vehicle,
            hydrodynamics="mesh" if meshed else "calibrated",
            control_step=self.step,
            substeps=1,
            water=replace(
                water,
                depth=spec.basin.depth,
                waves=[*water.components, *(Wave(**wave.model_dump()) for wave in spec.circulation.waves)],
            ),
            pool=basin if world is None else None,
            world=world,
            dock=dock,
            tether=dragged_line(spec.tether),
            threads=1,
            water_moves=bool(spec.circulation.eddies or any(spec.circulation.stream) or water.moving),
        )
        fields = simulator.plant.fields
        for name, value in _engine_fields(vehicle, spec).items():
            view = fields[name].numpy()
            view[...] = value
        for slot in layout(simulator.plant.terms):
            if slot.term.name in spec.terms and slot.term.units[slot.name].startswith("N"):
                view = fields[slot.path].numpy()
                view *= spec.terms[slot.term.name]
        n = len(vehicle.thrusters)
        for name, value in _motors_fields().items():
            fields[name].numpy()[..., :n] = value
        for k, actuator in enumerate((spec.actuators[name] for name in vehicle.actuators), start=n):
            fields["time_constant"].numpy()[..., k] = actuator.time_constant
            fields["gain"].numpy()[..., k] = actuator.gain
        simulator.place(*start)
        simulator.refresh()
        return simulator

    def _views(self) -> None:
        n, s = len(self.vehicle.thrusters), self.simulator
        self.position = s.numpy("position")[0, 0]
        """Body origin, world frame [m]; a view, (3,)."""
        self.quaternion = s.numpy("quaternion")[0, 0]
        """Body to world, xyzw; a view, (4,)."""
        self.nu = s.numpy("velocity")[0, 0]
        """Twist, body frame [m/s, rad/s]; a view, (6,)."""
        self.thrust = s.numpy("thrust")[0, 0, :n]
        """Delivered thrust, canonical order [N]; a view, (n,)."""
        self.values = s.numpy("thrust")[0, 0, n : len(self.vehicle.channel_names)]
        """Values of the other actuators [rad, m³ or m]; a view, (m,)."""
        self.water_velocity = s.water.current.numpy()[0]
        """Velocity of the water at the body, world frame [m/s]; a view, (3,)."""
        self.target = self.motors.target.numpy()
        """Target shaft speeds of the firmware, which it writes, canonical [rad/s]; a view, (n,)."""
        self.shaft_speed = self.motors.speed.numpy()
        """True shaft speeds, canonical [rad/s]; a view, (n,)."""
        self.measured_speed = self.motors.loop.measured.numpy()
        """Shaft speeds as measured by the firmware, canonical [rad/s]; a view, (n,)."""
        self.throttle = self.motors.throttle.numpy()
        """Throttles, -1 to 1; a view, (n,)."""
        self.electric = self.motors.supply.electric.numpy()
        """Battery voltage [V] and current [A]; a view, (2,)."""

    def set_points(self, values: ArrayLike) -> None:
        """Set the firmware's target values of the other actuators [rad, m³ or m], (m,)."""
        self._others[:] = np.asarray(values, float) + self._offset

    @property
    def measured_values(self) -> Array:
        """Return the values of the other actuators as measured by their sensors [rad, m³ or m], (m,)."""
        return np.asarray(self.values / self._gain - self._offset)

    @property
    def time(self) -> float:
        """Return the time since the start [s]."""
        return self.steps * self.step

    def advance(self, steps: int = 1) -> None:
        """Advance by some physics steps, with the shaft speeds of `target`."""
        for _ in range(steps):
            self._step()
        self.steps += steps


def captured(run: Callable[[], None]) -> Callable[[], None]:
    """Return launches on the CPU as one native call, six times as fast for a single vehicle as single launches.

    Args:
        run: Function that launches kernels, the same ones every time.

    Returns:
        An equivalent function; `run` itself if this version of Warp cannot capture launches on a CPU.
    """
    try:
        with wp.ScopedCapture(device="cpu") as capture:
            run()
    except RuntimeError:
        return run
    return lambda: wp.capture_launch(capture.graph)


def _engine_fields(vehicle: Vehicle, spec: PlantSpec) -> dict[str, Any]:
    """Return the engine's parameters: the true body, no damping of its own, and thrusters without dynamics."""
    body = spec.body
    r_g = np.array(body.center_of_gravity)
    to_origin = body.mass * (r_g @ r_g * np.eye(3) - np.outer(r_g, r_g))
    return {
        "mass": body.mass,
        "r_g": r_g,
        "inertia": np.array(body.inertia) + to_origin,
        "volume": body.displaced_volume,
        "r_b": np.array(body.center_of_buoyancy),
        "M_A": spec.added_mass.about_origin(),
        "D1": 0.0,
        "D2": 0.0,
        "dead_minus": 0.0,
        "dead_plus": 0.0,
        "delay": 0.0,
        "speed_lag": 0,
    }


def _motors_fields() -> dict[str, float]:
    """Return the engine's parameters of the thrusters' channels, since the plant computes motors and thrust itself."""
    return {"force_min": -1.0e6, "force_max": 1.0e6, "time_constant": 0.0, "slew": NO_LIMIT}


def _hidden(vehicle: Vehicle, spec: PlantSpec) -> HiddenForces:
    hidden = HiddenForces()
    hidden.T = mat66(*spec.damping.to_axes().ravel())
    hidden.D1 = mat66(*np.ravel(spec.damping.linear))
    hidden.D2 = mat66(*np.ravel(spec.damping.quadratic))
    hidden.r_b = wp.vec3(*spec.body.center_of_buoyancy)
    hidden.half_height = vehicle.body.surface_half_height
    drift = spec.buoyancy
    hidden.drifts = len(drift.grams)
    return with_arrays(
        hidden,
        drift=[0.001 * g * vehicle.water.gravity for g in drift.grams],
        drift_rate=[2.0 * math.pi / period for period in drift.periods],
        drift_phase=drift.phases,
    )
