"""The physics kernel: one thread simulates one vehicle through all substeps of a control step."""

import math
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from finssim.physics.contact import PoolWalls, contact_wrench, walls_within
from finssim.physics.damping import twist_at, wrench_from
from finssim.physics.funnel import Funnel, funnel_within, funnel_wrench
from finssim.physics.hydrodynamics import HYDRODYNAMICS
from finssim.physics.hydrodynamics.mesh import HullMesh, drag_slope
from finssim.physics.hydrostatics import BodyMotion
from finssim.physics.inertia import (
    coriolis_wrench,
    rigid_body_momentum,
    solve_spd,
    symmetric_inertia,
    water_acceleration_wrench,
)
from finssim.physics.kinematics import position_rate, quaternion_rate, rotate_by, up_in_body
from finssim.physics.lanes import (
    GROUP,
    LANES,
    LaneLoop,
    NumberArray,
    SharedStruct,
    StructArray,
    Trace,
    UniformStruct,
    Untraced,
    VectorArray,
    group_source,
    lane_function,
)
from finssim.physics.motors import (
    admissible,
    beyond_play,
    first_order,
    speed_of_thrust,
    steps_ago,
    thrust_of_speed,
)
from finssim.physics.plant import VehicleCommand, VehicleParameters, mass_matrix
from finssim.physics.solids import Solids, solids_within, solids_wrench
from finssim.physics.terms.composed import Item, composed, row_length
from finssim.physics.tether import Tether, tether_wrench
from finssim.physics.types import (
    MAX_THRUSTERS,
    angular,
    join,
    linear,
    mat66,
    symmetric_times,
    vec6,
    vec8,
    vec9,
)
from finssim.physics.water import Flow, WaterArrays, flow_at
from finssim.sim.midpoint import (
    DOCK_STEP,
    WALL_STEP,
    ContactLoads,
    StateDerivative,
    lead_of,
    relaxation_of,
    relaxed,
    yielding,
)
from finssim.sim.state import HISTORY, State, VehicleState, is_finite, snapshot, vec13

# Thrusters: target of the lag, delivered thrust, and the delayed command.


@wp.func
def delivered_thrust(plant: wp.array2d(dtype=VehicleParameters), w: int, v: int, actuator: vec8) -> vec8:
    """Return the force of each thruster [N] for the state of its lag."""
    T = actuator
    if plant[w, v].speed_lag != 0:
        c_plus = plant[w, v].c_plus
        c_minus = plant[w, v].c_minus
        for k in range(MAX_THRUSTERS):
            T[k] = wp.where(c_plus[k] > 0.0, thrust_of_speed(actuator[k], c_plus[k], c_minus[k]), actuator[k])
    return wp.cw_mul(plant[w, v].gain, T)


@wp.func
def lag_target(plant: wp.array2d(dtype=VehicleParameters), w: int, v: int, force: vec8) -> vec8:
    """Return the steady state of the lag for a force command: the force, or the propeller speed that produces it.

    Args:
        plant: Parameters.
        w: World.
        v: Vehicle.
        force: Command, along the thrusters' axes [N].

    Returns:
        In lag units: force [N], or propeller speed [rad/s].
    """
    target = force
    if plant[w, v].speed_lag != 0:
        c_plus = plant[w, v].c_plus
        c_minus = plant[w, v].c_minus
        for k in range(MAX_THRUSTERS):
            target[k] = wp.where(c_plus[k] > 0.0, speed_of_thrust(force[k], c_plus[k], c_minus[k]), force[k])
    return target


@wp.func
def delayed_command(
    commands: wp.array3d(dtype=vec8),
    w: int,
    v: int,
    head: int,
    elapsed: float,
    delay: float,
    h: float,
    rate: float,
) -> vec8:
    """Return the mean of the delayed command over the next substep.

    Args:
        commands: The delay line [N], by world, vehicle and slot.
        w: World.
        v: Vehicle.
        head: Slot of the newest command in the delay line.
        elapsed: Time since the newest command was issued [s].
        delay: Delay of the command [s].
        h: Substep [s].
        rate: Commands per second [1/s].

    Returns:
        Command in lag units; the exact mean, also if the delay ends inside the substep.
    """
    age = delay - elapsed
    old = steps_ago(age, rate)
    new = steps_ago(age - h, rate)
    command = commands[w, v, slot_before(head, old, commands.shape[2])]
    newer = commands[w, v, slot_before(head, new, commands.shape[2])]
    part = wp.clamp((age * rate - float(new)) / (h * rate), 0.0, 1.0)
    return newer + wp.where(new == old, 1.0, part) * (command - newer)


@wp.func
def slot_before(head: int, steps: int, slots: int) -> int:
    """Return the slot of a ring buffer that lies `steps` (fewer than `slots`) before its head."""
    slot = head - steps
    return wp.where(slot < 0, slot + slots, slot)


MODULE_OPTIONS = {
    "cpu_compiler_flags": "-march=native -ffp-contract=fast"
    " -mllvm=-inline-threshold=20000 -mllvm=-inline-cold-callsite-threshold=9000"
}
"""Warp's defaults, but with fused multiply-adds and no depth limit of SLP vectorisation: a quarter faster."""


@wp.struct
class SubstepState:
    """State of a vehicle during the substeps of a control step."""

    start: wp.vec3  # body origin at the start of the control step, world frame [m]
    moved: (
        wp.vec3
    )  # displacement since then [m]: a short substep's would be lost in the sum with a large coordinate
    quaternion: wp.quat
    velocity: vec6  # nu, body frame [m/s, rad/s]
    actuator: vec8  # lagged force [N] or propeller speed [rad/s]
    coasting: vec6  # mean acceleration of the last substep without thrust and contacts [m/s², rad/s²]
    x_dot: wp.vec3  # rate of the position, world frame [m/s]
    jerk: vec6  # difference of the last acceleration from its extrapolation [m/s², rad/s²]
    pressed: vec6  # mean acceleration by contacts in the last substep [m/s², rad/s²]
    greatest: float  # greatest force of the dock so far [N]
    impulse: float  # impulse of the dock so far [N s]
    clearing: wp.vec4  # a sphere without solids: centre, world frame, and radius [m]
    struck: float  # greatest force of the world's solids so far [N]


@wp.struct
class Vehicles:
    """Commands and parameters of all vehicles."""

    command: wp.array2d(dtype=VehicleCommand)
    plant: wp.array2d(dtype=VehicleParameters)
    extra: wp.array3d(dtype=float)  # parameters of terms and actuators, each in its unit [-]
    shared: wp.array(dtype=int)  # 1: all worlds have equal parameters
    branch_bits: wp.array2d(dtype=int)  # branches taken in the last step, a bit each; -1: not in a block


@wp.struct
class Obstacles:
    """Everything that a vehicle can collide with."""

    walls: PoolWalls
    funnel: Funnel
    solids: Solids


@wp.struct
class SimSurroundings:
    """Everything around the vehicles."""

    hull: HullMesh
    water: WaterArrays
    tether: wp.array2d(dtype=Tether)
    obstacles: Obstacles


@wp.struct
class Instant:
    """A state of a vehicle and its loads, at which the equation of motion is evaluated."""

    position: wp.vec3  # body origin, world frame [m]
    quaternion: wp.quat  # body to world
    velocity: vec6  # nu, body frame [m/s, rad/s]
    before: vec6  # nu at the start of the substep [m/s, rad/s]
    thrust: vec8  # thrust of each thruster [N]; value of other actuators
    pushed: vec6  # acceleration by that thrust, submerged [m/s², rad/s²]
    other: vec6  # wrench of all other external loads, body frame [N, N m]
    t: float  # time since the reset [s]
    t_step: float  # time since the start of the control step [s]
    h: float  # substep [s]


@wp.struct
class Rates:
    """Rates of a state."""

    x_dot: wp.vec3  # world frame [m/s]
    q_dot: wp.quat
    nu_dot: vec6  # body frame [m/s², rad/s²]


@wp.struct
class ControlStep:
    """The current control step."""

    step: int  # number since the reset
    head: int  # slot of its command in the delay line
    control_step: float  # [s]
    h: float  # substep [s]


@wp.struct
class Lagged:
    """Actuators during a substep."""

    after: vec8  # lagged force [N] or propeller speed [rad/s] at the end of the substep
    thrust: vec8  # mean thrust of each thruster [N]; value of other actuators
    pushed: vec6  # acceleration by that thrust, submerged [m/s², rad/s²]


@dataclass(frozen=True)
class Features:
    """Features of a simulation for which its kernel is compiled; code for absent features is omitted."""

    model: str
    """A key of `HYDRODYNAMICS`."""
    integrator: str = "midpoint"
    """`midpoint` (see `finssim.sim.midpoint`) or `rk4`."""
    water_moving: bool = True
    """True with currents or waves."""
    walls: bool = True
    """True with the walls of a pool."""
    tether: bool = True
    speed_lag: bool = True
    """True if the lag of any vehicle's motors is in speed rather than in force."""
    terms: tuple[Item, ...] = ()
    """Terms and actuators of any vehicle, in the order of the rows of their parameters."""
    funnel: bool = False
    """True with a dock."""
    solids: bool = False
    """True with a world that has solids."""
    play: bool = False
    """True if any actuator has play."""
    lanes: bool = False
    """True if worlds are processed in blocks of `LANES`, on a CPU; see `finssim.physics.lanes`."""

    parts: int = 1
    """Number of contact steps in a substep, of blocks of worlds near walls."""

    @property
    def runge_kutta(self) -> bool:
        """Return whether the integrator is `rk4`."""
        return self.integrator == "rk4"

    @property
    def contacts(self) -> bool:
        """Return whether there is anything to collide with."""
        return self.walls or self.funnel or self.solids


@cache
def relaxation_function(model: str, terms: tuple[Item, ...] = ()) -> Any:
    """Return the Warp function of θ of the midpoint rule, which makes damping implicit.

    Args:
        model: A key of `HYDRODYNAMICS`.
        terms: As for `motion_function`.
    """
    term_slope, actuator_slope = composed(terms, "slope"), composed(terms, "yield")

    @wp.func
    def relaxed_by(
        vehicles: Vehicles, hull: HullMesh, water: WaterArrays, w: int, v: int, body: BodyMotion, thrust: vec8,
        share: vec6,
    ) -> vec6:  # fmt: skip
        """Return θ [-] of each axis by all of the damping, scaled by the fraction `share` [-] at the surface."""
        plant = vehicles.plant
        extra = vehicles.extra
        relaxation = vec6()
        if wp.static(model == "mesh"):
            slope = drag_slope(
                hull, plant[w, v].hull, body.nu_r, water.density, plant[w, v].form_drag, plant[w, v].skin_drag
            )
            relaxation = wp.cw_mul(share, wp.cw_mul(plant[w, v].relax, slope))
        else:
            relaxation = wp.cw_mul(share, relaxation_of(plant, w, v, body.nu_r))
            if wp.static(term_slope is not None):
                nu_m = twist_at(body.nu_r, plant[w, v].r_m)
                falls = term_slope(extra, w, v, nu_m, body.up, -body.position[2], water.density, thrust)
                relaxation += wp.cw_mul(share, wp.cw_mul(plant[w, v].relax, wp.max(falls, vec6())))
            if wp.static(actuator_slope is not None):
                falls = actuator_slope(
                    extra, w, v, body.nu_r, body.up, -body.position[2], water.density, thrust
                )
                relaxation += wp.cw_mul(share, wp.cw_mul(plant[w, v].relax, wp.max(falls, vec6())))
        return relaxation

    return relaxed_by


@cache
def motion_function(
    model: str,
    runge_kutta: bool,
    water_moving: bool = False,
    tethered: bool = False,
    terms: tuple[Item, ...] = (),
) -> Any:
    """Return the Warp function of the equation of motion, without the terms that a simulation does not need.

    Args:
        model: A key of `HYDRODYNAMICS`.
        runge_kutta: True if the integrator is `rk4`, which needs no relaxation.
        water_moving: True if there are currents or waves.
        tethered: True if there is a tether.
        terms: Terms and actuators of any vehicle, in the order of the rows of their parameters.
    """
    hydrodynamic_wrench, relaxed_by = HYDRODYNAMICS[model], relaxation_function(model, terms)
    term_wrench, actuator_wrench, mass_shift = (composed(terms, kind) for kind in ("wrench", "push", "shift"))
    added_mass = model != "simplified"

    @wp.func
    def motion_at(
        vehicles: Vehicles, hull: HullMesh, water: WaterArrays, tether: wp.array2d(dtype=Tether), w: int, v: int,
        moment: Instant,
    ) -> StateDerivative:  # fmt: skip
        """Return the acceleration by the equation of motion, with nu_r = nu - [v_c; 0] and v_c the current in body
        axes.

        (M_RB + s M_A) nu_dot = tau_model + s tau_thrust + tau_other - C_RB(nu) nu - s C_A(nu_r) nu_r
                                + s M_A d(nu_c)/dt + tau_FK - [s_dot]_+ M_A nu_r

        It is solved for M_RB + s M_A together: as an applied force, added mass diverges once M_A exceeds M_RB. Both
        Coriolis terms share ω, so C_RB(nu) nu + s C_A(nu_r) nu_r is that of the summed momentum less [0; v_c × p_A].

        Thrust and added mass are proportional to the wet fraction s of the vehicle. When s increases, momentum is
        shared with more water (von Kármán 1929); when it decreases, the detached water keeps its momentum: neither adds
        energy. That term is evaluated implicitly at the middle of a substep h that starts with nu_start, so M_A does
        not limit h.
        """
        out = StateDerivative()
        plant = vehicles.plant
        extra = vehicles.extra
        position = moment.position
        q = moment.quaternion
        nu = moment.velocity
        thrust = moment.thrust
        up = up_in_body(q)
        r_g = plant[w, v].r_g
        inertia = plant[w, v].inertia
        tau = moment.other
        if wp.static(mass_shift is not None):
            shift = mass_shift(extra, w, v, nu, up, -position[2], water.density, thrust)
            first = wp.vec3(shift[0], shift[1], shift[2])
            r_g = r_g + first / plant[w, v].mass
            inertia = inertia + symmetric_inertia(shift)
            tau = tau + join(wp.vec3(0.0), wp.cross(first, -water.gravity * up))
        momentum = rigid_body_momentum(plant[w, v].mass, r_g, inertia, nu)
        flow = Flow()
        nu_r = nu
        water_b = wp.vec3(0.0)
        flow.normal = wp.vec3(0.0, 0.0, 1.0)
        if wp.static(water_moving):
            if water.moving != 0:
                flow = flow_at(water, w, position, moment.t, moment.t_step)
                water_b = wp.quat_rotate_inv(q, flow.velocity)
                if wp.static(added_mass):
                    nu_r = nu - join(water_b, wp.vec3(0.0))
        body = BodyMotion()
        body.position = position
        body.q = q
        body.up = up
        body.nu = nu
        body.nu_r = nu_r
        wet = hydrodynamic_wrench(plant, hull, water, w, v, body, flow)
        tau = tau + wet.tau
        if wp.static(added_mass):
            momentum_A = wet.wet * symmetric_times(plant[w, v].M_A, nu_r)
            momentum += momentum_A
            if wp.static(water_moving):
                if water.moving != 0:
                    tau += join(wp.vec3(0.0), wp.cross(water_b, linear(momentum_A)))
                    rate_at_body = flow.acceleration + flow.gradient * position_rate(q, nu)
                    material_acceleration = flow.acceleration + flow.gradient * flow.velocity
                    tau += water_acceleration_wrench(
                        wet.wet * plant[w, v].M_A, plant[w, v].r_b, water_b, wp.quat_rotate_inv(q, rate_at_body),
                        wp.quat_rotate_inv(q, material_acceleration), angular(nu), wet.displaced,
                    )  # fmt: skip
        if wp.static(term_wrench is not None):
            r_h = plant[w, v].r_h
            nu_h = twist_at(nu_r, r_h)
            tau_h = term_wrench(extra, w, v, nu_h, up, -position[2], water.density, thrust)
            tau += wet.wet * wrench_from(tau_h, r_h)
        if wp.static(actuator_wrench is not None):
            tau += wet.wet * actuator_wrench(extra, w, v, nu_r, up, -position[2], water.density, thrust)
        if wp.static(tethered):
            tau += tether_wrench(tether[w, v], water.density, position, q, nu, flow.velocity)
        tau -= coriolis_wrench(momentum, nu)
        # The drag of the wet faces of a mesh acts fully before much of its volume is wet.
        damped = wet.wet
        if wp.static(model == "mesh"):
            damped = wp.where(wet.wet > 0.0, 1.0, 0.0)
        share = vec6(damped, damped, damped, damped, damped, damped)
        if wp.static(added_mass or mass_shift is not None):
            if wp.static(mass_shift is None) and wp.max(1.0 - wet.wet, wet.wet_rate) <= 0.0:
                out.nu_dot = symmetric_times(plant[w, v].M_inv, tau) + moment.pushed
            else:
                s_dot = wp.max(wet.wet_rate, 0.0)
                tau += wet.wet * (plant[w, v].B * thrust)
                tau -= s_dot * symmetric_times(plant[w, v].M_A, moment.before - join(water_b, wp.vec3(0.0)))
                s = wet.wet + 0.5 * moment.h * s_dot
                M = mass_matrix(plant[w, v].mass, r_g, inertia, s * plant[w, v].M_A)
                out.nu_dot = solve_spd(M, tau)
                dry = wp.cw_div(wp.get_diag(plant[w, v].M_A), wp.get_diag(M))
                share = damped * (vec6(1.0, 1.0, 1.0, 1.0, 1.0, 1.0) + (1.0 - s) * dry)
        else:
            out.nu_dot = symmetric_times(plant[w, v].M_inv, tau) + wet.wet * moment.pushed
        out.wet = wet.wet
        if wp.static(not runge_kutta):
            out.relaxation = relaxed_by(vehicles, hull, water, w, v, body, thrust, share)
        return out

    return motion_at


@cache
def thrust_function(speed_lag: bool) -> Any:
    """Return the Warp function of the thrusts of lagged actuators, without speeds if no motor's lag is in speed."""

    @wp.func
    def thrust_of(plant: wp.array2d(dtype=VehicleParameters), w: int, v: int, actuator: vec8) -> vec8:
        if wp.static(speed_lag):
            return delivered_thrust(plant, w, v, actuator)
        return wp.cw_mul(plant[w, v].gain, actuator)

    return thrust_of


@cache
def contact_function(walls: bool, funnel: bool, solids: bool) -> Any:
    """Return the Warp function of the contact wrench of a vehicle."""

    @wp.func
    def contact_at(
        plant: wp.array2d(dtype=VehicleParameters), obstacles: Obstacles, clearing: wp.vec4, w: int, v: int,
        position: wp.vec3, q: wp.quat, nu: vec6,
    ) -> ContactLoads:  # fmt: skip
        """Return the wrench of walls, dock and solids, and the magnitudes of the forces of the latter two."""
        out = ContactLoads()
        if wp.static(walls):
            out.tau = contact_wrench(obstacles.walls, position, q, nu, plant[w, v].half_size)
        if wp.static(funnel):
            tau = funnel_wrench(obstacles.funnel, w, position, q, nu, plant[w, v].half_size)
            out.push = wp.length(linear(tau))
            out.tau += tau
        if wp.static(solids):
            tau = solids_wrench(obstacles.solids, clearing, w, v, position, q, nu, plant[w, v].half_size)
            out.strike = wp.length(linear(tau))
            out.tau += tau
        return out

    return contact_at


@cache
def lag_function(speed_lag: bool, play: bool) -> Any:
    """Return the Warp function of the actuators' lag."""
    thrust_of = thrust_function(speed_lag)

    @wp.func
    def lag_at(
        commands: wp.array3d(dtype=vec8), plant: wp.array2d(dtype=VehicleParameters), w: int, v: int,
        timing: ControlStep, k: int, actuator: vec8,
    ) -> Lagged:  # fmt: skip
        """Return the actuators in substep k: their values at its end, and the thrusts of their mean values."""
        out = Lagged()
        max_change = timing.h * plant[w, v].slew
        elapsed = float(wp.max(k, 0)) * timing.h
        rate = 1.0 / timing.control_step
        target = delayed_command(commands, w, v, timing.head, elapsed, plant[w, v].delay, timing.h, rate)
        if wp.static(play):
            target = beyond_play(target, actuator, plant[w, v].play)
        mean = first_order(actuator, target, plant[w, v].beta, 0.5 * max_change)
        out.after = first_order(actuator, target, plant[w, v].alpha, max_change)
        out.thrust = thrust_of(plant, w, v, mean)
        out.pushed = plant[w, v].G * out.thrust
        return out

    return lag_at


@cache
def recoil_function(speed_lag: bool, terms: tuple[Item, ...]) -> Any:
    """Return the Warp function of the recoil of masses that move within a vehicle; None without such masses."""
    carried, mass_shift = composed(terms, "carry"), composed(terms, "shift")
    if carried is None or mass_shift is None:
        return None
    thrust_of = thrust_function(speed_lag)

    @wp.func
    def carrying(plant: VehicleParameters, shift: vec9) -> mat66:
        """Return the mass matrix of the submerged vehicle, from the change of its first moment and inertia [kg m,
        kg m²]."""
        r_g = plant.r_g + wp.vec3(shift[0], shift[1], shift[2]) / plant.mass
        return mass_matrix(plant.mass, r_g, plant.inertia + symmetric_inertia(shift), plant.M_A)

    @wp.func
    def recoiled(
        vehicles: Vehicles, density: float, w: int, v: int, before: vec8, motion: SubstepState
    ) -> SubstepState:
        """Return the state after the masses have moved from their positions `before`, with conserved momentum.

        d = -M⁻¹ (c - c_before),   π = M_before nu,   nu' = M⁻¹ (π - C(d) π)

        The body is displaced by d, where the rate of c is the masses' momentum relative to the body. nu is the body's
        velocity when the masses are at rest: M nu is the total momentum.
        """
        out = motion
        q, nu, plant = motion.quaternion, motion.velocity, vehicles.plant[w, v]
        up = up_in_body(q)
        depth = -(motion.start[2] + motion.moved[2])
        last = thrust_of(vehicles.plant, w, v, before)
        now = thrust_of(vehicles.plant, w, v, motion.actuator)
        change = carried(vehicles.extra, w, v, nu, up, depth, density, now)
        change -= carried(vehicles.extra, w, v, nu, up, depth, density, last)
        momentum = carrying(plant, mass_shift(vehicles.extra, w, v, nu, up, depth, density, last)) * nu
        M = carrying(plant, mass_shift(vehicles.extra, w, v, nu, up, depth, density, now))
        d = solve_spd(M, -change)
        out.velocity = solve_spd(M, momentum - coriolis_wrench(momentum, d))
        out.moved = motion.moved + wp.quat_rotate(q, linear(d))
        out.quaternion = rotate_by(q, angular(d), 1.0)
        out.x_dot = position_rate(out.quaternion, out.velocity)
        return out

    return recoiled


@cache
def rates_function(features: Features) -> Any:
    """Return the Warp function of the rates of a state, for the Runge-Kutta method."""
    motion_at = motion_function(features.model, True, features.water_moving, features.tether, features.terms)
    contact_at = contact_function(features.walls, features.funnel, features.solids)
    contacts = features.contacts

    @wp.func
    def rates_at(
        vehicles: Vehicles, around: SimSurroundings, clearing: wp.vec4, w: int, v: int, start: Instant, h: float,
        rates: Rates,
    ) -> Rates:  # fmt: skip
        """Return the rates of the state that is a time h [s] after the start, at the given rates."""
        out = Rates()
        on = Instant()
        on.position = start.position + h * rates.x_dot
        on.quaternion = wp.normalize(start.quaternion + h * rates.q_dot)
        on.velocity = start.velocity + h * rates.nu_dot
        on.before = on.velocity
        on.thrust = start.thrust
        on.pushed = start.pushed
        on.other = start.other
        on.t = start.t + h
        on.t_step = start.t_step + h
        if wp.static(contacts):
            loads = contact_at(
                vehicles.plant, around.obstacles, clearing, w, v, on.position, on.quaternion, on.velocity
            )
            on.other += loads.tau
        out.x_dot = position_rate(on.quaternion, on.velocity)
        out.q_dot = quaternion_rate(on.quaternion, angular(on.velocity))
        out.nu_dot = motion_at(vehicles, around.hull, around.water, around.tether, w, v, on).nu_dot
        return out

    return rates_at


@cache
def runge_kutta_function(features: Features) -> Any:
    """Return the Warp function of one substep of the Runge-Kutta method."""
    rates_at = rates_function(features)
    contact_at = contact_function(features.walls, features.funnel, features.solids)
    lag_at, contacts = lag_function(features.speed_lag, features.play), features.contacts

    @wp.func
    def substep(
        commands: wp.array3d(dtype=vec8), vehicles: Vehicles, around: SimSurroundings, w: int, v: int,
        timing: ControlStep, k: int, motion: SubstepState,
    ) -> SubstepState:  # fmt: skip
        """Return the state after substep k."""
        out = SubstepState()
        h = timing.h
        q = motion.quaternion
        clearing = motion.clearing
        lagged = lag_at(commands, vehicles.plant, w, v, timing, k, motion.actuator)
        start = Instant()
        start.position = motion.start + motion.moved
        start.quaternion = q
        start.velocity = motion.velocity
        start.thrust = lagged.thrust
        start.pushed = lagged.pushed
        start.other = vehicles.command[w, v].disturbance
        start.t_step = float(k) * h
        start.t = float(timing.step) * timing.control_step + start.t_step
        out.greatest = motion.greatest
        out.impulse = motion.impulse
        out.struck = motion.struck
        if wp.static(contacts):
            loads = contact_at(
                vehicles.plant, around.obstacles, clearing, w, v, start.position, q, start.velocity
            )
            out.greatest = wp.max(motion.greatest, loads.push)
            out.impulse = motion.impulse + h * loads.push
            out.struck = wp.max(motion.struck, loads.strike)
        rates, mean = Rates(), Rates()
        # Warp unrolls loops over constants: four copies of the equation of motion would be slower to compile and run.
        stages = int(4)
        for stage in range(stages):
            outer = stage == 0 or stage == 3
            ahead = wp.where(stage == 0, 0.0, wp.where(stage == 3, h, 0.5 * h))
            share = wp.where(outer, 1.0, 2.0) / 6.0
            rates = rates_at(vehicles, around, clearing, w, v, start, ahead, rates)
            mean.x_dot += share * rates.x_dot
            mean.q_dot += share * rates.q_dot
            mean.nu_dot += share * rates.nu_dot
        out.start = motion.start
        out.moved = motion.moved + h * mean.x_dot
        out.quaternion = wp.normalize(q + h * mean.q_dot)
        out.velocity = motion.velocity + h * mean.nu_dot
        out.actuator = lagged.after
        out.coasting = rates.nu_dot - lagged.pushed
        out.x_dot = position_rate(out.quaternion, out.velocity)
        out.jerk = motion.jerk
        out.pressed = motion.pressed
        out.clearing = clearing
        return out

    return substep


@cache
def bump_function(walls: bool, funnel: bool, solids: bool) -> Any:
    """Return the Warp function of a substep of the midpoint rule near something that a vehicle can collide with."""
    contact_at = contact_function(walls, funnel, solids)
    contact_step = DOCK_STEP if funnel else WALL_STEP

    @wp.func
    def bump(
        vehicles: Vehicles,
        obstacles: Obstacles,
        w: int,
        v: int,
        h: float,
        wet: float,
        nu_dot: vec6,
        motion: SubstepState,
    ) -> SubstepState:
        """Return the state after a substep [s] of a vehicle that may be in contact, in shorter steps."""
        out = SubstepState()
        out.start = motion.start
        out.clearing = motion.clearing
        out.actuator = motion.actuator
        out.coasting = motion.coasting
        out.jerk = motion.jerk
        moved = motion.moved
        q = motion.quaternion
        nu = motion.velocity
        x_dot = motion.x_dot
        pressed = vec6()
        greatest = motion.greatest
        impulse = motion.impulse
        struck = motion.struck
        parts = int(wp.ceil(h / wp.static(contact_step) - 1.0e-4))
        if wp.static(solids):
            parts = wp.max(parts, int(wp.ceil(h / obstacles.solids.step - 1.0e-4)))
        d = h / float(parts)
        for _ in range(parts):
            moved = moved + 0.5 * d * x_dot
            q = rotate_by(q, angular(nu), 0.5 * d)
            loads = contact_at(vehicles.plant, obstacles, motion.clearing, w, v, motion.start + moved, q, nu)
            greatest = wp.max(greatest, loads.push)
            impulse += d * loads.push
            struck = wp.max(struck, loads.strike)
            push = yielding(vehicles.plant, w, v, wet, loads.tau)
            pressed += push / float(parts)
            nu = nu + d * (nu_dot + push)
            q = rotate_by(q, angular(nu), 0.5 * d)
            x_dot = position_rate(q, nu)
            moved = moved + 0.5 * d * x_dot
        out.moved = moved
        out.quaternion = q
        out.velocity = nu
        out.x_dot = x_dot
        out.pressed = pressed
        out.greatest = greatest
        out.impulse = impulse
        out.struck = struck
        return out

    return bump


@cache
def nearness_function(walls: bool, funnel: bool, solids: bool) -> Any:
    """Return the Warp function that checks whether a vehicle may come into contact within a substep."""

    @wp.func
    def is_near(
        obstacles: Obstacles,
        w: int,
        position: wp.vec3,
        h: float,
        half_size: wp.vec3,
        guess: vec6,
        motion: SubstepState,
    ) -> bool:
        """Return True if a vehicle could touch something within a substep h [s], at an estimate of its
        acceleration."""
        near = bool(False)  # a variable, because Warp only lets branches change variables
        nu = motion.velocity
        turn = wp.length(angular(nu)) + h * wp.length(angular(guess))
        slack = wp.length(linear(nu)) + h * wp.length(linear(guess)) + turn * wp.length(half_size)
        if wp.static(walls):
            near = walls_within(obstacles.walls, position, motion.quaternion, half_size, h * slack)
        if wp.static(funnel):
            near = near or funnel_within(obstacles.funnel, w, position, half_size, h * slack)
        if wp.static(solids):
            near = near or solids_within(motion.clearing, position, half_size, h * slack)
        return near

    return is_near


@cache
def midpoint_function(features: Features) -> Any:
    """Return the Warp function of one substep by the midpoint rule; see `finssim.sim.midpoint`."""
    motion_at = motion_function(features.model, False, features.water_moving, features.tether, features.terms)
    lag_at, contacts = lag_function(features.speed_lag, features.play), features.contacts
    touchable = (features.walls, features.funnel, features.solids)
    bump, is_near, funnel = bump_function(*touchable), nearness_function(*touchable), features.funnel

    @wp.func
    def substep(
        commands: wp.array3d(dtype=vec8), vehicles: Vehicles, around: SimSurroundings, w: int, v: int,
        timing: ControlStep, k: int, motion: SubstepState,
    ) -> SubstepState:  # fmt: skip
        """Return the state after substep k; -1 only computes the extrapolation."""
        out = SubstepState()
        h = timing.h
        q = motion.quaternion
        nu = motion.velocity
        position = motion.start + motion.moved
        step_h = wp.where(k < 0, 0.0, 1.0) * h
        lagged = lag_at(commands, vehicles.plant, w, v, timing, k, motion.actuator)
        guess = motion.coasting + lagged.pushed
        near = bool(False)
        if wp.static(contacts):
            half_size = vehicles.plant[w, v].half_size
            near = is_near(around.obstacles, w, position, h, half_size, guess, motion)
        # A vehicle that leans on a wall does not fall through it, so the water's forces must not include such a fall.
        # The predicted push of a wall stops a vehicle at most: a predicted rebound would amplify itself. A dock's push
        # is short.
        lead = h * lead_of(nu, h)
        nu_middle = nu + lead * guess
        push_ahead = lead * motion.pressed
        if wp.static(not funnel):
            push_ahead = wp.min(wp.max(push_ahead, wp.min(-nu_middle, vec6())), wp.max(-nu_middle, vec6()))
        middle = Instant()
        middle.position = position + 0.5 * h * motion.x_dot
        middle.quaternion = q + 0.5 * h * quaternion_rate(q, angular(nu))
        middle.velocity = nu_middle + push_ahead
        middle.before = nu
        middle.thrust = lagged.thrust
        middle.pushed = lagged.pushed
        middle.other = vehicles.command[w, v].disturbance
        middle.t_step = float(wp.max(k, 0)) * h + 0.5 * h
        middle.t = float(timing.step) * timing.control_step + middle.t_step
        middle.h = h
        derivative = motion_at(vehicles, around.hull, around.water, around.tether, w, v, middle)
        nu_dot = relaxed(derivative.nu_dot, guess, derivative.relaxation, vehicles.plant[w, v].r_m)
        out.start = motion.start
        out.clearing = motion.clearing
        out.moved = motion.moved
        out.quaternion = q
        out.velocity = nu
        out.x_dot = motion.x_dot
        out.greatest = motion.greatest
        out.impulse = motion.impulse
        out.struck = motion.struck
        out.actuator = motion.actuator
        out.pressed = motion.pressed
        out.jerk = nu_dot - guess
        out.coasting = nu_dot - lagged.pushed
        if k >= 0:
            out.actuator = lagged.after
            out.pressed = vec6()
        if k < 0 or not near:
            nu_new = nu + step_h * nu_dot
            out.quaternion = rotate_by(q, 0.5 * (angular(nu) + angular(nu_new)), step_h)
            out.velocity = nu_new
            out.x_dot = position_rate(out.quaternion, nu_new)
            out.moved = motion.moved + 0.5 * step_h * motion.x_dot + 0.5 * step_h * out.x_dot
        else:
            if wp.static(contacts):
                out = bump(vehicles, around.obstacles, w, v, h, derivative.wet, nu_dot, out)
        return out

    return substep


@cache
def ends_of(speed_lag: bool, funnel: bool, solids: bool) -> tuple[Any, Any]:
    """Return the Warp functions that begin a control step and that write its final state."""
    thrust_of = thrust_function(speed_lag)

    @wp.func
    def begin_step(state: State, vehicles: Vehicles, w: int, v: int, head: int) -> SubstepState:
        """Return the state at the start of a control step, with the newest command in the delay line."""
        out = SubstepState()
        plant = vehicles.plant
        newest = admissible(
            vehicles.command[w, v].thrust, plant[w, v].force_min, plant[w, v].force_max, plant[w, v].dead_minus,
            plant[w, v].dead_plus,
        )  # fmt: skip
        if wp.static(speed_lag):
            newest = lag_target(plant, w, v, newest)
        state.commands[w, v, head] = newest
        now = state.vehicle
        out.start = now[w, v].position
        out.quaternion = now[w, v].quaternion
        out.velocity = now[w, v].velocity
        out.actuator = now[w, v].actuator
        out.coasting = now[w, v].coasting
        out.pressed = now[w, v].pressed
        out.x_dot = position_rate(out.quaternion, out.velocity)
        if wp.static(solids):
            out.clearing = now[w, v].clearing
        return out

    @wp.func
    def end_step(
        state: State,
        vehicles: Vehicles,
        around: SimSurroundings,
        w: int,
        v: int,
        slot: int,
        motion: SubstepState,
    ):
        """Write the final state of the vehicle, unless a number stopped being finite."""
        position = motion.start + motion.moved
        q = wp.normalize(motion.quaternion)
        state.history[slot, w, v] = snapshot(position, q, motion.velocity)
        if not is_finite(position, q, motion.velocity):
            state.broken[w] = 1
            return
        now = state.vehicle
        now[w, v].position = position
        now[w, v].quaternion = q
        now[w, v].velocity = motion.velocity
        delivered = thrust_of(vehicles.plant, w, v, motion.actuator)
        now[w, v].acceleration = (
            motion.coasting + 0.5 * motion.jerk + motion.pressed + vehicles.plant[w, v].G * delivered
        )
        now[w, v].coasting = motion.coasting
        now[w, v].pressed = motion.pressed
        now[w, v].actuator = motion.actuator
        now[w, v].thrust = delivered
        if wp.static(funnel):
            around.obstacles.funnel.force[w, v] = motion.greatest
            around.obstacles.funnel.impulse[w, v] = motion.impulse

    return begin_step, end_step


@cache
def physics_kernel(features: Features) -> wp.Kernel:
    """Return the kernel of one control step.

    It is launched over (worlds of the slice, vehicles); with lanes over (blocks of the slice, vehicles), with the
    number of the slice's worlds as the argument before its offset.

    Args:
        features: Features of the simulation.
    """
    runge_kutta, solids = features.runge_kutta, features.solids
    substep = (runge_kutta_function if runge_kutta else midpoint_function)(features)
    begin_step, end_step = ends_of(features.speed_lag, features.funnel, solids)
    recoiled = recoil_function(features.speed_lag, features.terms)

    @wp.func
    def step_vehicle(
        state: State,
        vehicles: Vehicles,
        around: SimSurroundings,
        control_step: float,
        substeps: int,
        w: int,
        v: int,
    ):
        """Simulate one control step of one vehicle."""
        timing = ControlStep()
        timing.step = state.steps[w]
        timing.control_step = control_step
        timing.h = control_step / float(substeps)
        slot = timing.step % wp.static(HISTORY)
        thrust = vehicles.command[w, v].thrust
        disturbance = vehicles.command[w, v].disturbance
        if not is_finite(wp.vec3(0.0), wp.quat_identity(), disturbance) or not wp.isfinite(
            wp.dot(thrust, thrust)
        ):
            now = state.vehicle
            state.history[slot, w, v] = snapshot(now[w, v].position, now[w, v].quaternion, now[w, v].velocity)
            state.broken[w] = 1
            return
        timing.head = timing.step % state.commands.shape[2]
        motion = begin_step(state, vehicles, w, v, timing.head)
        first = int(0)
        if wp.static(not runge_kutta):
            # The first substep of an episode has nothing to extrapolate: it is computed twice, at first without motion.
            first = wp.where(timing.step == 0, -1, 0)
        for k in range(first, substeps):
            after = substep(state.commands, vehicles, around, w, v, timing, k, motion)
            if wp.static(recoiled is not None):
                after = recoiled(vehicles, around.water.density, w, v, motion.actuator, after)
            motion = after
        end_step(state, vehicles, around, w, v, slot, motion)
        if wp.static(solids):
            around.obstacles.solids.force[w, v] = motion.struck

    @wp.kernel(enable_backward=False, module="unique", module_options=MODULE_OPTIONS)
    def physics_step(
        state: State,
        vehicles: Vehicles,
        around: SimSurroundings,
        control_step: float,
        substeps: int,
        world_offset: int,
    ):
        i, v = wp.tid()
        w = world_offset + i
        if state.frozen[w] != 0:
            return
        step_vehicle(state, vehicles, around, control_step, substeps, w, v)

    if not features.lanes:
        return physics_step

    blocks = lane_blocks(begin_step, substep, end_step, row_length(features.terms), features.parts)

    @wp.kernel(enable_backward=False, module="unique", module_options=MODULE_OPTIONS)
    def physics_blocks(
        state: State, vehicles: Vehicles, around: SimSurroundings, control_step: float, substeps: int, worlds: int,
        world_offset: int,
    ):  # fmt: skip
        i, v = wp.tid()
        w = world_offset + wp.static(GROUP) * i
        count = wp.min(wp.static(GROUP), worlds - wp.static(GROUP) * i)
        blocks(state, vehicles, around, control_step, substeps, w, v, count)
        for k in range(count):
            if vehicles.branch_bits[w + k, v] < 0 and state.frozen[w + k] == 0:
                step_vehicle(state, vehicles, around, control_step, substeps, w + k, v)

    return physics_blocks


MOST_PARTS = 4
"""Greatest number of contact steps in a substep that are traced one after the other."""
SUBMERGED = {
    "position": (0.0, 0.0, -5.0),
    "quaternion": (0.0, 0.0, 0.0, 1.0),
    "clearing": (0.0, 0.0, -5.0, 1e3),
}
"""Example of a state: the vehicle is submerged, far from all obstacles."""
WIDE = {"half_length": 1e3, "half_width": 1e3, "depth": 1e3}
"""Example of a pool with distant walls."""


def lane_blocks(begin_step: Any, substep: Any, end_step: Any, term_numbers: int, parts: int) -> Any:
    """Return a native function that simulates a group of worlds for a control step, traced from the functions for one.

    It excludes worlds whose episode has just begun, that are frozen, whose command is not finite, or that are near a
    solid.
    """
    trace = Trace()
    row, command = (
        StructArray(trace, "state", VehicleState, SUBMERGED),
        StructArray(trace, "command", VehicleCommand, {}),
    )
    commands, history = VectorArray(trace, "commands", vec8, 2), VectorArray(trace, "history", vec13, 0)
    commands.shape = (0, 0, trace.symbol("I", "slots", 4))
    state = SimpleNamespace(vehicle=row, commands=commands, history=history)
    plant, extra = (
        StructArray(trace, "plant", VehicleParameters, {}, shared=True),
        NumberArray(trace, "extra", term_numbers),
    )
    vehicles = SimpleNamespace(command=command, plant=plant, extra=extra)
    around = SimpleNamespace(
        hull=SharedStruct(trace, "around.hull", HullMesh),
        water=UniformStruct(trace, "around.water", WaterArrays, {}, moving=0),
        obstacles=SimpleNamespace(
            walls=UniformStruct(trace, "around.obstacles.walls", PoolWalls, WIDE), solids=Untraced("solids")
        ),
        tether=StructArray(trace, "tether", Tether, {}),
    )
    step, head, slot = (trace.symbol("I", name, 2) for name in ("step", "head", "place"))
    # Substep length for which a contact takes this many parts.
    h = trace.symbol("F", "h", (parts - 0.5) * WALL_STEP)
    control_step = trace.symbol("F", "control", 0.1)
    for number in command[0, 0].thrust.numbers + command[0, 0].disturbance.numbers:
        trace.require(trace.apply("M", "finite({})", math.isfinite, number))
    loop = LaneLoop(trace, "motion", lane_function(begin_step)(state, vehicles, 0, 0, head))
    trace.level = 1
    trace.sections[1].append("const I k = all_i(pass);")
    k = trace.symbol("I", "k", 1)
    trace.set_known(k < 0, False)
    trace.set_known(k >= 0, True)
    timing = SimpleNamespace(step=step, head=head, control_step=control_step, h=h)
    with trace.exploration():
        loop.carry(lane_function(substep)(commands, vehicles, around, 0, 0, timing, k, loop.value()))
    trace.level = 2
    lane_function(end_step)(state, vehicles, around, 0, 0, slot, loop.value())
    source = group_source(
        trace,
        [row, commands, history],
        f"""
const long row = vehicles.shared.data[0] ? 0 : vehicles.plant.strides[0];
const long term_row = vehicles.shared.data[0] ? 0 : vehicles.extra.strides[0];
const auto place_of = [&](const auto& a, long world) {{
    return At{{(char*)a.data + w * world + v * a.strides[1], world, 0}};
}};
const At state_at = place_of(state.vehicle, state.vehicle.strides[0]), plant_at = place_of(vehicles.plant, row);
const At command_at = place_of(vehicles.command, vehicles.command.strides[0]);
const At extra_at = place_of(vehicles.extra, term_row);
const At tether_at = place_of(around.tether, around.tether.strides[0]);
const auto& c = state.commands;
const At commands_at = {{(char*)c.data + w * c.strides[0] + v * c.strides[1], c.strides[0], c.strides[2]}};
const auto& y = state.history;
const At history_at = {{(char*)y.data + w * y.strides[1] + v * y.strides[2], y.strides[1], y.strides[0]}};
I step; for (int l = 0; l < {LANES}; ++l)
    step[l] = l <= last && state.frozen.data[w + at[l]] == 0 ? state.steps.data[w + at[l]] : 0;
ok &= step != 0;
const I slots = all_i(c.shape[2]), head = step % slots, place = step % all_i({HISTORY});
const F control = all(control_step), h = all(control_step / (float)substeps);
""",
        "for (int pass = 0; pass < substeps; ++pass)",
        "((int*)((char*)vehicles.branch_bits.data + (w + world) * vehicles.branch_bits.strides[0]))[v]",
    )

    @wp.func_native(source)
    def blocks(
        state: State, vehicles: Vehicles, around: SimSurroundings, control_step: float, substeps: int, w: int, v: int,
        count: int,
    ): ...  # fmt: skip

    return blocks


@wp.kernel(enable_backward=False)
def tick(state: State, world_offset: int):
    """Finish the control step: count it, and freeze the worlds in which a number stopped being finite."""
    w = world_offset + wp.tid()
    if state.frozen[w] != 0:
        return
    state.steps[w] = state.steps[w] + 1
    state.frozen[w] = state.broken[w]
