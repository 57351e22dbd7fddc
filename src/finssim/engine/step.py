"""The physics kernel: one thread takes one vehicle through all substeps of a control step."""

from functools import cache

import warp as wp

from finssim.engine.actuation import delayed_command, delivered_thrust, lag_target
from finssim.engine.state import HISTORY, State, VehicleState, is_finite, snapshot, vec13
from finssim.physics.contact import PoolWalls, contact_wrench
from finssim.physics.damping import surge_coupled_wrench, twist_at, wrench_from
from finssim.physics.funnel import Funnel, funnel_wrench
from finssim.physics.hydrodynamics import HYDRODYNAMICS
from finssim.physics.hydrodynamics.mesh import HullMesh
from finssim.physics.inertia import coriolis_wrench, rigid_body_momentum, water_acceleration_wrench
from finssim.physics.kinematics import position_rate, quaternion_rate, rotate_by, up_in_body
from finssim.physics.motors import admissible, first_order
from finssim.physics.plant import VehicleCommand, VehicleParameters
from finssim.physics.tether import Tether, tether_wrench
from finssim.physics.types import angular, join, linear, symmetric_times, vec6, vec8
from finssim.physics.water import Flow, WaterArrays, flow_at

MODULE_OPTIONS = {
    "cpu_compiler_flags": "-march=native -ffp-contract=fast"
    " -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000"
}
"""Warp's defaults, but with fused multiply-adds and no limit on the depth of SLP vectorisation: a quarter faster."""


@cache
def physics_kernel(
    model: str,
    integrator: str,
    water_moving: bool = True,
    walls_present: bool = True,
    tether_present: bool = True,
    speed_lag: bool = True,
    surge_coupled: bool = True,
    funnel_present: bool = False,
) -> wp.Kernel:
    """The kernel for one hydrodynamic model and one integrator, without the code that a simulation does not need.

    Args:
        model: A key of `HYDRODYNAMICS`.
        integrator: `euler` (semi-implicit: velocity first, then pose with the new velocity) or `rk4`.
        water_moving: Whether there are currents or waves.
        walls_present: Whether there is a pool to bump into.
        tether_present: Whether there is a tether.
        speed_lag: Whether some vehicle's motors lag in speed rather than in force.
        surge_coupled: Whether some vehicle's damping is coupled to surge (Du is not zero).
        funnel_present: Whether there is a dock to enter.

    Returns:
        A kernel over (worlds of the slice, vehicles).
    """
    hydrodynamic_wrench = HYDRODYNAMICS[model]
    runge_kutta = integrator == "rk4"
    added_mass = model != "simplified"

    @wp.func
    def thrust_of(plant: wp.array2d(dtype=VehicleParameters), w: int, v: int, actuator: vec8) -> vec8:
        if wp.static(speed_lag):
            return delivered_thrust(plant, w, v, actuator)
        return wp.cw_mul(plant[w, v].gain, actuator)

    @wp.func
    def nu_dot_of(
        plant: wp.array2d(dtype=VehicleParameters),
        hull: HullMesh,
        water: WaterArrays,
        walls: PoolWalls,
        tether: wp.array2d(dtype=Tether),
        funnel: Funnel,
        w: int,
        v: int,
        position: wp.vec3,
        q: wp.quat,
        nu: vec6,
        tau_thrust: vec6,
        tau_other: vec6,
        t: float,
        t_step: float,
    ) -> vec6:
        """Acceleration from the equation of motion, with nu_r = nu - [v_c; 0] and the water's v_c in the body frame.

        (M_RB + M_A) nu_dot = tau_model + wet tau_thrust + tau_other - C_RB(nu) nu - C_A(nu_r) nu_r
                              + M_A d(nu_c)/dt + tau_FK

        Solved with M_RB + M_A together: as an applied force, added mass diverges once M_A exceeds M_RB. Both Coriolis
        terms share ω, so C_RB(nu) nu + C_A(nu_r) nu_r is that of the summed momentum less [0; v_c × p_A]. Propellers
        push in proportion to the part of the vehicle that is wet: in the air they have nothing to push against.
        """
        up = up_in_body(q)
        momentum = rigid_body_momentum(plant[w, v].mass, plant[w, v].r_g, plant[w, v].inertia, nu)
        tau = tau_other
        flow = Flow()
        nu_r = nu
        if wp.static(water_moving):
            flow = flow_at(water, w, position, t, t_step)
            water_b = wp.quat_rotate_inv(q, flow.velocity)
            if wp.static(added_mass):
                nu_r = nu - join(water_b, wp.vec3(0.0))
            momentum_A = symmetric_times(plant[w, v].M_A, nu_r)
            wet = hydrodynamic_wrench(plant, hull, water, w, v, position, q, up, nu, nu_r, flow)
            a_b = wp.quat_rotate_inv(q, flow.acceleration)
            tau += wet.tau + wet.wet * tau_thrust + join(wp.vec3(0.0), wp.cross(water_b, linear(momentum_A)))
            tau += water_acceleration_wrench(
                plant[w, v].M_A, plant[w, v].r_b, water_b, a_b, angular(nu), wet.displaced
            )
            momentum += momentum_A
        else:
            flow.normal = wp.vec3(0.0, 0.0, 1.0)
            wet = hydrodynamic_wrench(plant, hull, water, w, v, position, q, up, nu, nu, flow)
            tau += wet.tau + wet.wet * tau_thrust
            if wp.static(added_mass):
                momentum += symmetric_times(plant[w, v].M_A, nu)
        if wp.static(surge_coupled):
            r_h = plant[w, v].r_h
            nu_h = twist_at(nu_r, r_h)
            tau += wet.wet * wrench_from(surge_coupled_wrench(nu_h, plant[w, v].Du), r_h)
        if wp.static(walls_present):
            tau += contact_wrench(walls, position, q, nu, plant[w, v].half_size)
        if wp.static(funnel_present and runge_kutta):
            tau += funnel_wrench(funnel, w, position, q, nu, plant[w, v].half_size)
        if wp.static(tether_present):
            tau += tether_wrench(tether[w, v], water.density, position, q, nu, flow.velocity)
        return symmetric_times(plant[w, v].M_inv, tau - coriolis_wrench(momentum, nu))

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
        hull: HullMesh,
        water: WaterArrays,
        walls: PoolWalls,
        tether: wp.array2d(dtype=Tether),
        funnel: Funnel,
        control_step: float,
        substeps: int,
        world_offset: int,
    ):
        i, v = wp.tid()
        w = world_offset + i
        if frozen[w] != 0:
            return
        step = steps[w]
        h = control_step / float(substeps)
        rate = 1.0 / control_step
        position = state[w, v].position
        q = state[w, v].quaternion
        nu = state[w, v].velocity
        actuator = state[w, v].actuator
        other = command[w, v].disturbance
        nu_dot = vec6()
        thrust = vec8()
        if not is_finite(wp.vec3(0.0), wp.quat_identity(), command[w, v].disturbance) or not wp.isfinite(
            wp.dot(command[w, v].thrust, command[w, v].thrust)
        ):
            history[step % wp.static(HISTORY), w, v] = snapshot(position, q, nu)
            broken[w] = 1
            return
        newest = admissible(
            command[w, v].thrust,
            plant[w, v].force_min,
            plant[w, v].force_max,
            plant[w, v].dead_minus,
            plant[w, v].dead_plus,
        )
        if wp.static(speed_lag):
            newest = lag_target(plant, w, v, newest)
        head = step % commands.shape[2]
        commands[w, v, head] = newest
        max_change = h * plant[w, v].slew
        greatest = float(0.0)
        impulse = float(0.0)
        for k in range(substeps):
            elapsed = float(k) * h
            t = float(step) * control_step + elapsed
            target = delayed_command(commands, w, v, head, elapsed, plant[w, v].delay, h, rate)
            before = thrust_of(plant, w, v, actuator)
            actuator = first_order(actuator, target, plant[w, v].alpha, max_change)
            thrust = thrust_of(plant, w, v, actuator)
            outer = other
            if wp.static(funnel_present):
                contact = funnel_wrench(funnel, w, position, q, nu, plant[w, v].half_size)
                push = wp.length(linear(contact))
                greatest = wp.max(greatest, push)
                impulse += h * push
                if wp.static(not runge_kutta):
                    outer = other + contact
            if wp.static(runge_kutta):
                tau = plant[w, v].B * (0.5 * (before + thrust))
                x1 = position_rate(q, nu)
                q1 = quaternion_rate(q, wp.vec3(nu[3], nu[4], nu[5]))
                n1 = nu_dot_of(
                    plant, hull, water, walls, tether, funnel, w, v, position, q, nu, tau, other, t, elapsed
                )
                nu2 = nu + 0.5 * h * n1
                qm = wp.normalize(q + 0.5 * h * q1)
                x2 = position_rate(qm, nu2)
                q2 = quaternion_rate(qm, wp.vec3(nu2[3], nu2[4], nu2[5]))
                n2 = nu_dot_of(
                    plant, hull, water, walls, tether, funnel, w, v, position + 0.5 * h * x1, qm, nu2, tau, other,
                    t + 0.5 * h, elapsed + 0.5 * h,
                )  # fmt: skip
                nu3 = nu + 0.5 * h * n2
                qn = wp.normalize(q + 0.5 * h * q2)
                x3 = position_rate(qn, nu3)
                q3 = quaternion_rate(qn, wp.vec3(nu3[3], nu3[4], nu3[5]))
                n3 = nu_dot_of(
                    plant, hull, water, walls, tether, funnel, w, v, position + 0.5 * h * x2, qn, nu3, tau, other,
                    t + 0.5 * h, elapsed + 0.5 * h,
                )  # fmt: skip
                nu4 = nu + h * n3
                qe = wp.normalize(q + h * q3)
                x4 = position_rate(qe, nu4)
                q4 = quaternion_rate(qe, wp.vec3(nu4[3], nu4[4], nu4[5]))
                n4 = nu_dot_of(
                    plant, hull, water, walls, tether, funnel, w, v, position + h * x3, qe, nu4, tau, other, t + h,
                    elapsed + h,
                )  # fmt: skip
                nu_dot = (n1 + 2.0 * n2 + 2.0 * n3 + n4) / 6.0
                position = position + (h / 6.0) * (x1 + 2.0 * x2 + 2.0 * x3 + x4)
                q = wp.normalize(q + (h / 6.0) * (q1 + 2.0 * q2 + 2.0 * q3 + q4))
                nu = nu + h * nu_dot
            else:
                tau = plant[w, v].B * thrust
                nu_dot = nu_dot_of(
                    plant, hull, water, walls, tether, funnel, w, v, position, q, nu, tau, outer, t, elapsed
                )
                nu = nu + h * nu_dot
                position = position + h * position_rate(q, nu)
                q = rotate_by(q, wp.vec3(nu[3], nu[4], nu[5]), h)
        q = wp.normalize(q)
        history[step % wp.static(HISTORY), w, v] = snapshot(position, q, nu)
        if not is_finite(position, q, nu):
            broken[w] = 1
            return
        state[w, v].position = position
        state[w, v].quaternion = q
        state[w, v].velocity = nu
        state[w, v].acceleration = nu_dot
        state[w, v].actuator = actuator
        state[w, v].thrust = thrust
        if wp.static(funnel_present):
            funnel.force[w, v] = greatest
            funnel.impulse[w, v] = impulse

    return physics_step


@wp.kernel(enable_backward=False)
def tick(state: State, world_offset: int):
    """Close the control step: count it, and freeze the worlds in which a number stopped being finite."""
    w = world_offset + wp.tid()
    if state.frozen[w] != 0:
        return
    state.steps[w] = state.steps[w] + 1
    state.frozen[w] = state.broken[w]
