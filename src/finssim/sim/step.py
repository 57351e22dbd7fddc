"""The physics kernel: one thread takes one vehicle through all substeps of a control step."""

import math
from functools import cache
from typing import Any

import warp as wp

from finssim.physics.contact import PoolWalls, contact_wrench, walls_within
from finssim.physics.damping import twist_at, wrench_from
from finssim.physics.funnel import Funnel, funnel_within, funnel_wrench
from finssim.physics.hydrodynamics import HYDRODYNAMICS
from finssim.physics.hydrodynamics.mesh import HullMesh, drag_slope
from finssim.physics.inertia import (
    coriolis_wrench,
    rigid_body_momentum,
    solve_spd,
    symmetric_inertia,
    water_acceleration_wrench,
)
from finssim.physics.kinematics import position_rate, quaternion_rate, rotate_by, up_in_body
from finssim.physics.lanes import (
    LANES,
    LaneLoop,
    NumberArray,
    StructArray,
    Trace,
    UniformStruct,
    VectorArray,
    block_source,
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
from finssim.physics.types import MAX_THRUSTERS, angular, join, linear, symmetric_times, vec6, vec8
from finssim.physics.water import Flow, WaterArrays, flow_at
from finssim.sim.midpoint import (
    DOCK_STEP,
    WALL_STEP,
    StateDerivative,
    Touch,
    lead_of,
    relaxation_of,
    relaxed,
    yielding,
)
from finssim.sim.state import HISTORY, State, VehicleState, is_finite, snapshot, vec13

# Thrusters: what the lag tends to, what it delivers, and the delay line's command.


@wp.func
def delivered_thrust(plant: wp.array2d(dtype=VehicleParameters), w: int, v: int, actuator: vec8) -> vec8:
    """Force of each thruster [N] for the state of its lag."""
    T = actuator
    if plant[w, v].speed_lag != 0:
        c_plus = plant[w, v].c_plus
        c_minus = plant[w, v].c_minus
        for k in range(MAX_THRUSTERS):
            T[k] = wp.where(c_plus[k] > 0.0, thrust_of_speed(actuator[k], c_plus[k], c_minus[k]), actuator[k])
    return wp.cw_mul(plant[w, v].gain, T)


@wp.func
def lag_target(plant: wp.array2d(dtype=VehicleParameters), w: int, v: int, force: vec8) -> vec8:
    """Return the value that the lag approaches for a force command: the force, or the propeller speed that gives it.

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
    """Mean of the delayed command over the coming substep.

    Args:
        commands: The delay line [N], by world, vehicle and slot.
        w: World.
        v: Vehicle.
        head: Slot of the delay line that holds the newest command.
        elapsed: Time since the newest command was issued [s].
        delay: Of the command [s].
        h: Substep [s].
        rate: Commands a second [1/s].

    Returns:
        Command in lag units; the exact mean, also when the delay ends inside the substep.
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
    """Slot of a ring that lies `steps` (fewer than `slots`) before its head."""
    slot = head - steps
    return wp.where(slot < 0, slot + slots, slot)


MODULE_OPTIONS = {
    "cpu_compiler_flags": "-march=native -ffp-contract=fast"
    " -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000"
}
"""Warp's defaults, but with fused multiply-adds and no limit on the depth of SLP vectorisation: a quarter faster."""


@wp.struct
class Course:
    """A vehicle on its way through the substeps of a control step."""

    start: wp.vec3  # body origin at the start of the control step, world frame [m]
    moved: (
        wp.vec3
    )  # way since then [m]: apart, for a float far from 0 does not hold the way of a short, slow substep
    quaternion: wp.quat
    velocity: vec6  # nu, body frame [m/s, rad/s]
    actuator: vec8  # lagged force [N] or propeller speed [rad/s]
    coasting: vec6  # mean acceleration of the last substep without thrust and contacts [m/s², rad/s²]
    x_dot: wp.vec3  # rate of the position, world frame [m/s]
    jerk: vec6  # by how much the last acceleration was another than expected [m/s², rad/s²]
    pressed: vec6  # mean acceleration by contacts in the last substep [m/s², rad/s²]
    greatest: float  # force of the dock so far [N]
    impulse: float  # of the dock so far [N s]
    clearing: wp.vec4  # a ball without solids: centre, world frame, and radius [m]
    struck: float  # greatest force of the world's solids so far [N]


@cache
def motion_function(
    model: str,
    runge_kutta: bool,
    water_moving: bool = False,
    tether_present: bool = False,
    terms: tuple[Item, ...] = (),
) -> Any:
    """Return the Warp function of the equation of motion, without the terms that a simulation does not need.

    Args:
        model: A key of `HYDRODYNAMICS`.
        runge_kutta: Whether the integrator is `rk4`, which needs no relaxation.
        water_moving: Whether there are currents or waves.
        tether_present: Whether there is a tether.
        terms: Terms and actuators that some vehicle has, in the order of the rows of their parameters.
    """
    hydrodynamic_wrench = HYDRODYNAMICS[model]
    term_wrench, term_slope = composed(terms, "wrench"), composed(terms, "slope")
    actuator_wrench, mass_shift = composed(terms, "push"), composed(terms, "shift")
    actuator_slope = composed(terms, "yield")
    added_mass = model != "simplified"

    @wp.func
    def motion_at(
        plant: wp.array2d(dtype=VehicleParameters),
        extra: wp.array3d(dtype=float),
        hull: HullMesh,
        water: WaterArrays,
        tether: wp.array2d(dtype=Tether),
        w: int,
        v: int,
        position: wp.vec3,
        q: wp.quat,
        nu: vec6,
        nu_start: vec6,
        thrust: vec8,
        pushed: vec6,
        tau_other: vec6,
        t: float,
        t_step: float,
        h: float,
    ) -> StateDerivative:
        """Acceleration from the equation of motion, with nu_r = nu - [v_c; 0] and the water's v_c in the body frame.

        (M_RB + s M_A) nu_dot = tau_model + s tau_thrust + tau_other - C_RB(nu) nu - s C_A(nu_r) nu_r
                                + s M_A d(nu_c)/dt + tau_FK - [s_dot]_+ M_A nu_r

        Solved with M_RB + s M_A together: as an applied force, added mass diverges once M_A exceeds M_RB. Both Coriolis
        terms share ω, so C_RB(nu) nu + s C_A(nu_r) nu_r is that of the summed momentum less [0; v_c × p_A].

        Propellers push, and water moves along, in proportion to the wet part s of the vehicle. Where s grows, momentum
        is shared with more water (von Kármán 1929); where it falls, the water keeps what it has: neither adds energy.
        That term is taken at the middle of a substep h that starts with nu_start, implicitly: M_A sets no limit to h.
        """
        out = StateDerivative()
        up = up_in_body(q)
        r_g = plant[w, v].r_g
        inertia = plant[w, v].inertia
        tau = tau_other
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
        if wp.static(water_moving):
            flow = flow_at(water, w, position, t, t_step)
            water_b = wp.quat_rotate_inv(q, flow.velocity)
            if wp.static(added_mass):
                nu_r = nu - join(water_b, wp.vec3(0.0))
        else:
            flow.normal = wp.vec3(0.0, 0.0, 1.0)
        wet = hydrodynamic_wrench(plant, hull, water, w, v, position, q, up, nu, nu_r, flow)
        tau = tau + wet.tau
        if wp.static(added_mass):
            momentum_A = wet.wet * symmetric_times(plant[w, v].M_A, nu_r)
            momentum += momentum_A
            if wp.static(water_moving):
                tau += join(wp.vec3(0.0), wp.cross(water_b, linear(momentum_A)))
                passing = flow.acceleration + flow.gradient * position_rate(q, nu)
                flowing = flow.acceleration + flow.gradient * flow.velocity
                tau += water_acceleration_wrench(
                    wet.wet * plant[w, v].M_A, plant[w, v].r_b, water_b, wp.quat_rotate_inv(q, passing),
                    wp.quat_rotate_inv(q, flowing), angular(nu), wet.displaced,
                )  # fmt: skip
        if wp.static(term_wrench is not None):
            r_h = plant[w, v].r_h
            nu_h = twist_at(nu_r, r_h)
            tau_h = term_wrench(extra, w, v, nu_h, up, -position[2], water.density, thrust)
            tau += wet.wet * wrench_from(tau_h, r_h)
        if wp.static(actuator_wrench is not None):
            tau += wet.wet * actuator_wrench(extra, w, v, nu_r, up, -position[2], water.density, thrust)
        if wp.static(tether_present):
            tau += tether_wrench(tether[w, v], water.density, position, q, nu, flow.velocity)
        tau -= coriolis_wrench(momentum, nu)
        # The drag of the wet faces of a mesh is all there before much of its volume is wet.
        damped = wet.wet
        if wp.static(model == "mesh"):
            damped = wp.where(wet.wet > 0.0, 1.0, 0.0)
        share = vec6(damped, damped, damped, damped, damped, damped)
        if wp.static(added_mass or mass_shift is not None):
            if wp.static(mass_shift is None) and wet.wet == 1.0 and wet.wet_rate <= 0.0:
                out.nu_dot = symmetric_times(plant[w, v].M_inv, tau) + pushed
            else:
                s_dot = wp.max(wet.wet_rate, 0.0)
                tau += wet.wet * (plant[w, v].B * thrust)
                tau -= s_dot * symmetric_times(plant[w, v].M_A, nu_start - join(water_b, wp.vec3(0.0)))
                s = wet.wet + 0.5 * h * s_dot
                M = mass_matrix(plant[w, v].mass, r_g, inertia, s * plant[w, v].M_A)
                out.nu_dot = solve_spd(M, tau)
                dry = wp.cw_div(wp.get_diag(plant[w, v].M_A), wp.get_diag(M))
                share = damped * (vec6(1.0, 1.0, 1.0, 1.0, 1.0, 1.0) + (1.0 - s) * dry)
        else:
            out.nu_dot = symmetric_times(plant[w, v].M_inv, tau) + wet.wet * pushed
        out.wet = wet.wet
        if wp.static(not runge_kutta):
            if wp.static(model == "mesh"):
                slope = drag_slope(
                    hull, plant[w, v].hull, nu_r, water.density, plant[w, v].form_drag, plant[w, v].skin_drag
                )
                out.relaxation = wp.cw_mul(share, wp.cw_mul(plant[w, v].relax, slope))
            else:
                out.relaxation = wp.cw_mul(share, relaxation_of(plant, w, v, nu_r))
                if wp.static(term_slope is not None):
                    nu_m = twist_at(nu_r, plant[w, v].r_m)
                    falls = term_slope(extra, w, v, nu_m, up, -position[2], water.density, thrust)
                    out.relaxation += wp.cw_mul(share, wp.cw_mul(plant[w, v].relax, wp.max(falls, vec6())))
                if wp.static(actuator_slope is not None):
                    falls = actuator_slope(extra, w, v, nu_r, up, -position[2], water.density, thrust)
                    out.relaxation += wp.cw_mul(share, wp.cw_mul(plant[w, v].relax, wp.max(falls, vec6())))
        return out

    return motion_at


@cache
def physics_kernel(
    model: str,
    integrator: str,
    water_moving: bool = True,
    walls_present: bool = True,
    tether_present: bool = True,
    speed_lag: bool = True,
    terms: tuple[Item, ...] = (),
    funnel_present: bool = False,
    solids_present: bool = False,
    play_present: bool = False,
    lanes: bool = False,
) -> wp.Kernel:
    """The kernel for one hydrodynamic model and one integrator, without the code that a simulation does not need.

    Args:
        model: A key of `HYDRODYNAMICS`.
        integrator: `midpoint` (see `finssim.sim.midpoint`) or `rk4`.
        water_moving: Whether there are currents or waves.
        walls_present: Whether there is a pool to bump into.
        tether_present: Whether there is a tether.
        speed_lag: Whether some vehicle's motors lag in speed rather than in force.
        terms: Terms and actuators that some vehicle has, in the order of the rows of their parameters.
        funnel_present: Whether there is a dock to enter.
        solids_present: Whether there is a world with solids to bump into.
        play_present: Whether some actuator has play.
        lanes: Whether worlds go in blocks of `LANES`, on a processor; see `finssim.physics.lanes`.

    Returns:
        A kernel over (worlds of the slice, vehicles); with lanes over (blocks of the slice, vehicles), which takes the
        number of the slice's worlds before its offset.
    """
    runge_kutta = integrator == "rk4"
    motion_at = motion_function(model, runge_kutta, water_moving, tether_present, terms)
    contacts = walls_present or funnel_present or solids_present
    contact_step = DOCK_STEP if funnel_present else WALL_STEP

    @wp.func
    def thrust_of(plant: wp.array2d(dtype=VehicleParameters), w: int, v: int, actuator: vec8) -> vec8:
        if wp.static(speed_lag):
            return delivered_thrust(plant, w, v, actuator)
        return wp.cw_mul(plant[w, v].gain, actuator)

    @wp.func
    def contact_at(
        plant: wp.array2d(dtype=VehicleParameters),
        walls: PoolWalls,
        funnel: Funnel,
        solids: Solids,
        clearing: wp.vec4,
        w: int,
        v: int,
        position: wp.vec3,
        q: wp.quat,
        nu: vec6,
    ) -> Touch:
        """Wrench of walls, dock and solids, and the sizes of the forces of the latter two."""
        out = Touch()
        if wp.static(walls_present):
            out.tau = contact_wrench(walls, position, q, nu, plant[w, v].half_size)
        if wp.static(funnel_present):
            tau = funnel_wrench(funnel, w, position, q, nu, plant[w, v].half_size)
            out.push = wp.length(linear(tau))
            out.tau += tau
        if wp.static(solids_present):
            tau = solids_wrench(solids, clearing, w, v, position, q, nu, plant[w, v].half_size)
            out.strike = wp.length(linear(tau))
            out.tau += tau
        return out

    @wp.func
    def set_out(
        state: wp.array2d(dtype=VehicleState),
        command: wp.array2d(dtype=VehicleCommand),
        commands: wp.array3d(dtype=vec8),
        plant: wp.array2d(dtype=VehicleParameters),
        w: int,
        v: int,
        head: int,
    ) -> Course:
        """Start the course of a control step, with the newest command in the delay line."""
        out = Course()
        newest = admissible(
            command[w, v].thrust,
            plant[w, v].force_min,
            plant[w, v].force_max,
            plant[w, v].dead_minus,
            plant[w, v].dead_plus,
        )
        if wp.static(speed_lag):
            newest = lag_target(plant, w, v, newest)
        commands[w, v, head] = newest
        out.start = state[w, v].position
        out.quaternion = state[w, v].quaternion
        out.velocity = state[w, v].velocity
        out.actuator = state[w, v].actuator
        out.coasting = state[w, v].coasting
        out.pressed = state[w, v].pressed
        out.x_dot = position_rate(out.quaternion, out.velocity)
        if wp.static(solids_present):
            out.clearing = state[w, v].clearing
        return out

    @wp.func
    def substep(
        command: wp.array2d(dtype=VehicleCommand),
        commands: wp.array3d(dtype=vec8),
        plant: wp.array2d(dtype=VehicleParameters),
        extra: wp.array3d(dtype=float),
        hull: HullMesh,
        water: WaterArrays,
        walls: PoolWalls,
        tether: wp.array2d(dtype=Tether),
        funnel: Funnel,
        solids: Solids,
        w: int,
        v: int,
        head: int,
        step: int,
        k: int,
        h: float,
        control_step: float,
        course: Course,
    ) -> Course:
        """The course after substep k; -1 only looks ahead."""
        out = Course()
        moved = course.moved
        position = course.start + moved
        q = course.quaternion
        nu = course.velocity
        actuator = course.actuator
        coasting = course.coasting
        x_dot = course.x_dot
        jerk = course.jerk
        pressed = course.pressed
        greatest = course.greatest
        impulse = course.impulse
        struck = course.struck
        other = command[w, v].disturbance
        max_change = h * plant[w, v].slew
        rate = 1.0 / control_step
        committed = wp.where(k < 0, 0.0, 1.0)
        step_h = committed * h
        elapsed = float(wp.max(k, 0)) * h
        t = float(step) * control_step + elapsed
        target = delayed_command(commands, w, v, head, elapsed, plant[w, v].delay, h, rate)
        if wp.static(play_present):
            target = beyond_play(target, actuator, plant[w, v].play)
        mean = first_order(actuator, target, plant[w, v].beta, 0.5 * max_change)
        after = first_order(actuator, target, plant[w, v].alpha, max_change)
        thrust = thrust_of(plant, w, v, mean)
        pushed = plant[w, v].G * thrust
        if wp.static(runge_kutta):
            outer = other
            actuator = after
            if wp.static(contacts):
                touch = contact_at(plant, walls, funnel, solids, course.clearing, w, v, position, q, nu)
                greatest = wp.max(greatest, touch.push)
                impulse += h * touch.push
                struck = wp.max(struck, touch.strike)
                outer = other + touch.tau
            q1 = quaternion_rate(q, angular(nu))
            n1 = motion_at(
                plant,
                extra,
                hull,
                water,
                tether,
                w,
                v,
                position,
                q,
                nu,
                nu,
                thrust,
                pushed,
                outer,
                t,
                elapsed,
                0.0,
            ).nu_dot
            nu2 = nu + 0.5 * h * n1
            qm = wp.normalize(q + 0.5 * h * q1)
            xm = position + 0.5 * h * x_dot
            x2 = position_rate(qm, nu2)
            q2 = quaternion_rate(qm, angular(nu2))
            if wp.static(contacts):
                outer = (
                    other + contact_at(plant, walls, funnel, solids, course.clearing, w, v, xm, qm, nu2).tau
                )
            n2 = motion_at(
                plant, extra, hull, water, tether, w, v, xm, qm, nu2, nu2, thrust, pushed, outer, t + 0.5 * h,
                elapsed + 0.5 * h, 0.0,
            ).nu_dot  # fmt: skip
            nu3 = nu + 0.5 * h * n2
            qn = wp.normalize(q + 0.5 * h * q2)
            xn = position + 0.5 * h * x2
            x3 = position_rate(qn, nu3)
            q3 = quaternion_rate(qn, angular(nu3))
            if wp.static(contacts):
                outer = (
                    other + contact_at(plant, walls, funnel, solids, course.clearing, w, v, xn, qn, nu3).tau
                )
            n3 = motion_at(
                plant, extra, hull, water, tether, w, v, xn, qn, nu3, nu3, thrust, pushed, outer, t + 0.5 * h,
                elapsed + 0.5 * h, 0.0,
            ).nu_dot  # fmt: skip
            nu4 = nu + h * n3
            qe = wp.normalize(q + h * q3)
            xe = position + h * x3
            x4 = position_rate(qe, nu4)
            q4 = quaternion_rate(qe, angular(nu4))
            if wp.static(contacts):
                outer = (
                    other + contact_at(plant, walls, funnel, solids, course.clearing, w, v, xe, qe, nu4).tau
                )
            n4 = motion_at(
                plant,
                extra,
                hull,
                water,
                tether,
                w,
                v,
                xe,
                qe,
                nu4,
                nu4,
                thrust,
                pushed,
                outer,
                t + h,
                elapsed + h,
                0.0,
            ).nu_dot
            moved = moved + (h / 6.0) * (x_dot + 2.0 * x2 + 2.0 * x3 + x4)
            q = wp.normalize(q + (h / 6.0) * (q1 + 2.0 * q2 + 2.0 * q3 + q4))
            nu = nu + (h / 6.0) * (n1 + 2.0 * n2 + 2.0 * n3 + n4)
            x_dot = position_rate(q, nu)
            coasting = n4 - pushed
        else:
            guess = coasting + pushed
            near = bool(False)
            if wp.static(contacts):
                half_size = plant[w, v].half_size
                turn = wp.length(angular(nu)) + h * wp.length(angular(guess))
                slack = wp.length(linear(nu)) + h * wp.length(linear(guess)) + turn * wp.length(half_size)
                if wp.static(walls_present):
                    near = walls_within(walls, position, q, half_size, h * slack)
                if wp.static(funnel_present):
                    near = near or funnel_within(funnel, w, position, half_size, h * slack)
                if wp.static(solids_present):
                    near = near or solids_within(course.clearing, position, half_size, h * slack)
            # What leans on a wall does not fall through it, and the water must not feel that it did. A wall's push is
            # expected to stop a vehicle at most: expected to throw it back, it would feed on itself. A dock's is short.
            lead = h * lead_of(nu, h)
            nu_middle = nu + lead * guess
            push_ahead = lead * pressed
            if wp.static(not funnel_present):
                push_ahead = wp.min(
                    wp.max(push_ahead, wp.min(-nu_middle, vec6())), wp.max(-nu_middle, vec6())
                )
            nu_middle = nu_middle + push_ahead
            x_middle = position + 0.5 * h * x_dot
            q_middle = q + 0.5 * h * quaternion_rate(q, angular(nu))
            motion = motion_at(
                plant, extra, hull, water, tether, w, v, x_middle, q_middle, nu_middle, nu, thrust, pushed, other,
                t + 0.5 * h, elapsed + 0.5 * h, h,
            )  # fmt: skip
            nu_dot = relaxed(motion.nu_dot, guess, motion.relaxation, plant[w, v].r_m)
            jerk = nu_dot - guess
            coasting = nu_dot - pushed
            if k >= 0:
                actuator = after
                pressed = vec6()
            if k < 0 or not near:
                nu_new = nu + step_h * nu_dot
                q = rotate_by(q, 0.5 * (angular(nu) + angular(nu_new)), step_h)
                nu = nu_new
                moved = moved + 0.5 * step_h * x_dot
                x_dot = position_rate(q, nu)
                moved = moved + 0.5 * step_h * x_dot
            else:
                if wp.static(contacts):
                    parts = int(wp.ceil(h / wp.static(contact_step) - 1.0e-4))
                    if wp.static(solids_present):
                        parts = wp.max(parts, int(wp.ceil(h / solids.step - 1.0e-4)))
                    d = h / float(parts)
                    for _ in range(parts):
                        moved = moved + 0.5 * d * x_dot
                        position = course.start + moved
                        q = rotate_by(q, angular(nu), 0.5 * d)
                        touch = contact_at(
                            plant, walls, funnel, solids, course.clearing, w, v, position, q, nu
                        )
                        greatest = wp.max(greatest, touch.push)
                        impulse += d * touch.push
                        struck = wp.max(struck, touch.strike)
                        push = yielding(plant, w, v, motion.wet, touch.tau)
                        pressed += push / float(parts)
                        nu = nu + d * (nu_dot + push)
                        q = rotate_by(q, angular(nu), 0.5 * d)
                        x_dot = position_rate(q, nu)
                        moved = moved + 0.5 * d * x_dot
        out.start = course.start
        out.moved = moved
        out.quaternion = q
        out.velocity = nu
        out.actuator = actuator
        out.coasting = coasting
        out.x_dot = x_dot
        out.jerk = jerk
        out.pressed = pressed
        out.greatest = greatest
        out.impulse = impulse
        out.clearing = course.clearing
        out.struck = struck
        return out

    @wp.func
    def arrive(
        state: wp.array2d(dtype=VehicleState),
        history: wp.array3d(dtype=vec13),
        broken: wp.array(dtype=int),
        plant: wp.array2d(dtype=VehicleParameters),
        funnel: Funnel,
        w: int,
        v: int,
        slot: int,
        course: Course,
    ):
        """Write down where the vehicle has come to, unless a number stopped being finite."""
        position = course.start + course.moved
        q = wp.normalize(course.quaternion)
        history[slot, w, v] = snapshot(position, q, course.velocity)
        if not is_finite(position, q, course.velocity):
            broken[w] = 1
            return
        state[w, v].position = position
        state[w, v].quaternion = q
        state[w, v].velocity = course.velocity
        delivered = thrust_of(plant, w, v, course.actuator)
        state[w, v].acceleration = (
            course.coasting + 0.5 * course.jerk + course.pressed + plant[w, v].G * delivered
        )
        state[w, v].coasting = course.coasting
        state[w, v].pressed = course.pressed
        state[w, v].actuator = course.actuator
        state[w, v].thrust = delivered
        if wp.static(funnel_present):
            funnel.force[w, v] = course.greatest
            funnel.impulse[w, v] = course.impulse

    @wp.func
    def step_vehicle(
        state: wp.array2d(dtype=VehicleState),
        command: wp.array2d(dtype=VehicleCommand),
        commands: wp.array3d(dtype=vec8),
        history: wp.array3d(dtype=vec13),
        steps: wp.array(dtype=int),
        broken: wp.array(dtype=int),
        plant: wp.array2d(dtype=VehicleParameters),
        extra: wp.array3d(dtype=float),
        hull: HullMesh,
        water: WaterArrays,
        walls: PoolWalls,
        tether: wp.array2d(dtype=Tether),
        funnel: Funnel,
        solids: Solids,
        control_step: float,
        substeps: int,
        w: int,
        v: int,
    ):
        """One control step of one vehicle."""
        step = steps[w]
        h = control_step / float(substeps)
        if not is_finite(wp.vec3(0.0), wp.quat_identity(), command[w, v].disturbance) or not wp.isfinite(
            wp.dot(command[w, v].thrust, command[w, v].thrust)
        ):
            history[step % wp.static(HISTORY), w, v] = snapshot(
                state[w, v].position, state[w, v].quaternion, state[w, v].velocity
            )
            broken[w] = 1
            return
        head = step % commands.shape[2]
        course = set_out(state, command, commands, plant, w, v, head)
        first = int(0)
        if wp.static(not runge_kutta):
            # The first substep of an episode has nothing to extrapolate: it is taken twice, and -1 only looks ahead.
            first = wp.where(step == 0, -1, 0)
        for k in range(first, substeps):
            course = substep(
                command,
                commands,
                plant,
                extra,
                hull,
                water,
                walls,
                tether,
                funnel,
                solids,
                w,
                v,
                head,
                step,
                k,
                h,
                control_step,
                course,
            )
        arrive(state, history, broken, plant, funnel, w, v, step % wp.static(HISTORY), course)
        if wp.static(solids_present):
            solids.force[w, v] = course.struck

    @wp.kernel(enable_backward=False, module="unique", module_options=MODULE_OPTIONS)
    def physics_step(
        state: wp.array2d(dtype=VehicleState),
        command: wp.array2d(dtype=VehicleCommand),
        commands: wp.array3d(dtype=vec8),
        history: wp.array3d(dtype=vec13),
        steps: wp.array(dtype=int),
        broken: wp.array(dtype=int),
        frozen: wp.array(dtype=int),
        plant: wp.array2d(dtype=VehicleParameters),
        extra: wp.array3d(dtype=float),
        hull: HullMesh,
        water: WaterArrays,
        walls: PoolWalls,
        tether: wp.array2d(dtype=Tether),
        funnel: Funnel,
        solids: Solids,
        control_step: float,
        substeps: int,
        world_offset: int,
    ):
        i, v = wp.tid()
        w = world_offset + i
        if frozen[w] != 0:
            return
        step_vehicle(
            state, command, commands, history, steps, broken, plant, extra, hull, water, walls, tether, funnel,
            solids, control_step, substeps, w, v,
        )  # fmt: skip

    if not lanes:
        return physics_step

    block = lane_block(set_out, substep, arrive, row_length(terms))

    @wp.kernel(enable_backward=False, module="unique", module_options=MODULE_OPTIONS)
    def physics_blocks(
        state: wp.array2d(dtype=VehicleState),
        command: wp.array2d(dtype=VehicleCommand),
        commands: wp.array3d(dtype=vec8),
        history: wp.array3d(dtype=vec13),
        steps: wp.array(dtype=int),
        broken: wp.array(dtype=int),
        frozen: wp.array(dtype=int),
        plant: wp.array2d(dtype=VehicleParameters),
        extra: wp.array3d(dtype=float),
        hull: HullMesh,
        water: WaterArrays,
        walls: PoolWalls,
        tether: wp.array2d(dtype=Tether),
        funnel: Funnel,
        solids: Solids,
        control_step: float,
        substeps: int,
        shared: wp.array(dtype=int),
        worlds: int,
        world_offset: int,
    ):
        i, v = wp.tid()
        w = world_offset + wp.static(LANES) * i
        count = wp.min(wp.static(LANES), worlds - wp.static(LANES) * i)
        done = block(
            state, command, commands, history, steps, frozen, plant, extra, shared, water, walls, tether, control_step,
            substeps, w, v, count,
        )  # fmt: skip
        for k in range(count):
            if ((done >> k) & 1) == 0 and frozen[w + k] == 0:
                step_vehicle(
                    state, command, commands, history, steps, broken, plant, extra, hull, water, walls, tether, funnel,
                    solids, control_step, substeps, w + k, v,
                )  # fmt: skip

    return physics_blocks


SUBMERGED = {
    "position": (0.0, 0.0, -5.0),
    "quaternion": (0.0, 0.0, 0.0, 1.0),
    "clearing": (0.0, 0.0, -5.0, 1e3),
}
"""Example of a state, in which the vehicle is under water, far from everything."""
WIDE = {"half_length": 1e3, "half_width": 1e3, "depth": 1e3}
"""Example of a pool, whose walls are far away."""


def lane_block(set_out: Any, substep: Any, arrive: Any, term_numbers: int) -> Any:
    """A native function that takes a block of worlds through a control step, traced from the functions for one.

    Worlds are left out whose episode has just begun, that are frozen, whose command is not finite, that are not wholly
    under water in still water, or that are near a wall.
    """
    trace = Trace()
    state = StructArray(trace, "state", VehicleState, SUBMERGED)
    command = StructArray(trace, "command", VehicleCommand, {})
    plant = StructArray(trace, "plant", VehicleParameters, {})
    extra = NumberArray(trace, "extra", term_numbers)
    tether = StructArray(trace, "tether", Tether, {})
    commands, history = VectorArray(trace, "commands", vec8, 2), VectorArray(trace, "history", vec13, 0)
    commands.shape = (0, 0, trace.symbol("I", "slots", 4))
    water, walls = (
        UniformStruct(trace, "water", WaterArrays, {}),
        UniformStruct(trace, "walls", PoolWalls, WIDE),
    )
    step, head, slot = (trace.symbol("I", name, 2) for name in ("step", "head", "place"))
    h, control_step = (trace.symbol("F", name, 0.1) for name in ("h", "control"))
    numbers = command[0, 0].thrust.numbers + command[0, 0].disturbance.numbers
    for number in numbers:
        trace.require(trace.apply("M", "finite({})", math.isfinite, number))
    loop = LaneLoop(trace, "course", lane_function(set_out)(state, command, commands, plant, 0, 0, head))
    trace.level = 1
    trace.sections[1].append("const I k = all_i(pass);")
    k = trace.symbol("I", "k", 1)
    loop.carry(
        lane_function(substep)(
            command,
            commands,
            plant,
            extra,
            None,
            water,
            walls,
            tether,
            None,
            None,
            0,
            0,
            head,
            step,
            k,
            h,
            control_step,
            loop.value(),
        )
    )
    trace.level = 2
    lane_function(arrive)(state, history, None, plant, None, 0, 0, slot, loop.value())
    source = block_source(
        trace,
        [state, commands, history],
        f"""
const long row = shared.data[0] ? 0 : plant.strides[0];
const At state_at = {{(char*)state.data + w * state.strides[0] + v * state.strides[1], state.strides[0], 0}};
const At command_at = {{(char*)command.data + w * command.strides[0] + v * command.strides[1], command.strides[0], 0}};
const At plant_at = {{(char*)plant.data + w * row + v * plant.strides[1], row, 0}};
const long term_row = shared.data[0] ? 0 : extra.strides[0];
const At extra_at = {{(char*)extra.data + w * term_row + v * extra.strides[1], term_row, 0}};
const At tether_at = {{(char*)tether.data + w * tether.strides[0] + v * tether.strides[1], tether.strides[0], 0}};
const At commands_at = {{
    (char*)commands.data + w * commands.strides[0] + v * commands.strides[1], commands.strides[0], commands.strides[2]
}};
const At history_at = {{
    (char*)history.data + w * history.strides[1] + v * history.strides[2], history.strides[1], history.strides[0]
}};
I step; for (int l = 0; l < {LANES}; ++l) step[l] = l < count && frozen.data[w + l] == 0 ? steps.data[w + l] : 0;
ok &= step != 0;
const I slots = all_i(commands.shape[2]), head = step % slots, place = step % all_i({HISTORY});
const F control = all(control_step), h = all(control_step / (float)substeps);
""",
        "for (int pass = 0; pass < substeps; ++pass)",
    )

    @wp.func_native(source)
    def block(
        state: wp.array2d(dtype=VehicleState),
        command: wp.array2d(dtype=VehicleCommand),
        commands: wp.array3d(dtype=vec8),
        history: wp.array3d(dtype=vec13),
        steps: wp.array(dtype=int),
        frozen: wp.array(dtype=int),
        plant: wp.array2d(dtype=VehicleParameters),
        extra: wp.array3d(dtype=float),
        shared: wp.array(dtype=int),
        water: WaterArrays,
        walls: PoolWalls,
        tether: wp.array2d(dtype=Tether),
        control_step: float,
        substeps: int,
        w: int,
        v: int,
        count: int,
    ) -> int: ...

    return block


@wp.kernel(enable_backward=False)
def tick(state: State, world_offset: int):
    """Close the control step: count it, and freeze the worlds in which a number stopped being finite."""
    w = world_offset + wp.tid()
    if state.frozen[w] != 0:
        return
    state.steps[w] = state.steps[w] + 1
    state.frozen[w] = state.broken[w]
