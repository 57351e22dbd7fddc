"""The physics kernel: one thread takes one vehicle through all substeps of a control step."""

from functools import cache

import warp as wp
from finssim.physics.hydrodynamics.mesh import HullMesh

from finssim.engine.state import HISTORY, State, is_finite, vec13
from finssim.physics.contact import PoolWalls, contact_wrench
from finssim.physics.hydrodynamics import HYDRODYNAMICS
from finssim.physics.inertia import coriolis_wrench, rigid_body_momentum
from finssim.physics.kinematics import position_rate, quaternion_rate, rotate_by
from finssim.physics.motors import admissible, first_order, speed_of_thrust, steps_ago, thrust_of_speed
from finssim.physics.plant import Command, Plant
from finssim.physics.tether import Tether, tether_wrench
from finssim.physics.types import MAX_THRUSTERS, vec6, vec8
from finssim.physics.water import WaterArrays, flow_at


MODULE_OPTIONS = {
    "cpu_compiler_flags": "-march=native -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000"
}
"""Warp's defaults but for its limit on the depth of SLP vectorisation, which costs this kernel a fifth of its speed."""


@wp.func
def delivered_thrust(plant: Plant, w: int, v: int, actuator: vec8) -> vec8:
    """Force of each thruster [N] for the state of its lag."""
    T = actuator
    if plant.speed_lag[w, v] != 0:
        c_plus = plant.c_plus[w, v]
        c_minus = plant.c_minus[w, v]
        for k in range(MAX_THRUSTERS):
            T[k] = thrust_of_speed(actuator[k], c_plus[k], c_minus[k])
    return wp.cw_mul(plant.gain[w, v], T)


@wp.func
def lag_target(plant: Plant, w: int, v: int, force: vec8) -> vec8:
    """What the lag tends to for a force command: the force itself, or the propeller speed that gives it."""
    target = force
    if plant.speed_lag[w, v] != 0:
        c_plus = plant.c_plus[w, v]
        c_minus = plant.c_minus[w, v]
        for k in range(MAX_THRUSTERS):
            target[k] = speed_of_thrust(force[k], c_plus[k], c_minus[k])
    return target


@wp.func
def delayed_command(
    state: State, w: int, v: int, head: int, elapsed: float, delay: float, control_step: float, h: float
) -> vec8:
    """Mean of the delayed command over the coming substep.

    Args:
        state: Holds the delay line.
        w: World.
        v: Vehicle.
        head: Slot of the delay line that holds the newest command.
        elapsed: Time since the newest command was issued [s].
        delay: Of the command [s].
        control_step: Time between commands [s].
        h: Substep [s].

    Returns:
        Command in lag units; the exact mean, also when the delay ends inside the substep.
    """
    age = delay - elapsed
    old = steps_ago(age, control_step)
    new = steps_ago(age - h, control_step)
    command = state.commands[w, v, slot_before(head, old, state.commands.shape[2])]
    if new != old:
        part = wp.clamp((age - float(new) * control_step) / h, 0.0, 1.0)
        newer = state.commands[w, v, slot_before(head, new, state.commands.shape[2])]
        command = part * command + (1.0 - part) * newer
    return command


@wp.func
def slot_before(head: int, steps: int, slots: int) -> int:
    """Slot of a ring that lies `steps` (fewer than `slots`) before its head."""
    slot = head - steps
    return wp.where(slot < 0, slot + slots, slot)


@cache
def physics_kernel(
    model: str, integrator: str, walls_present: bool = True, tether_present: bool = True, speed_lag: bool = True
) -> wp.Kernel:
    """The kernel for one hydrodynamic model and one integrator, without the code that a simulation does not need.

    Args:
        model: A key of `HYDRODYNAMICS`.
        integrator: `euler` (semi-implicit: velocity first, then pose with the new velocity) or `rk4`.
        walls_present: Whether there is a pool to bump into.
        tether_present: Whether there is a tether.
        speed_lag: Whether some vehicle's motors lag in speed rather than in force.

    Returns:
        A kernel over (worlds of the slice, vehicles).
    """
    hydrodynamic_wrench = HYDRODYNAMICS[model]
    runge_kutta = integrator == "rk4"

    @wp.func
    def thrust_of(plant: Plant, w: int, v: int, actuator: vec8) -> vec8:
        if wp.static(speed_lag):
            return delivered_thrust(plant, w, v, actuator)
        return wp.cw_mul(plant.gain[w, v], actuator)

    @wp.func
    def nu_dot_of(
        plant: Plant,
        hull: HullMesh,
        water: WaterArrays,
        walls: PoolWalls,
        tether: Tether,
        w: int,
        v: int,
        position: wp.vec3,
        q: wp.quat,
        nu: vec6,
        tau_applied: vec6,
        t: float,
        t_step: float,
    ) -> vec6:
        """(M_RB + M_A) nu_dot = tau_hydro + tau_applied + tau_walls + tau_tether - C_RB(nu) nu."""
        flow = flow_at(water, w, position, t, t_step)
        tau = tau_applied + hydrodynamic_wrench(plant, hull, water, w, v, position, q, nu, flow)
        if wp.static(walls_present):
            tau += contact_wrench(walls, position, q, nu, plant.half_size[w, v])
        if wp.static(tether_present):
            tau += tether_wrench(tether, water.density, position, q, nu, flow.velocity)
        # Solve with M_RB + M_A together: as an applied force, added mass diverges once M_A exceeds M_RB.
        momentum = rigid_body_momentum(plant.mass[w, v], plant.r_g[w, v], plant.inertia[w, v], nu)
        return plant.M_inv[w, v] * (tau - coriolis_wrench(momentum, nu))

    @wp.kernel(enable_backward=False, module="unique", module_options=MODULE_OPTIONS)
    def physics_step(
        state: State,
        command: Command,
        plant: Plant,
        hull: HullMesh,
        water: WaterArrays,
        walls: PoolWalls,
        tether: Tether,
        control_step: float,
        substeps: int,
        world_offset: int,
    ):
        i, v = wp.tid()
        w = world_offset + i
        if state.frozen[w] != 0:
            return
        step = state.steps[w]
        h = control_step / float(substeps)
        position = state.position[w, v]
        q = state.quaternion[w, v]
        nu = state.velocity[w, v]
        actuator = state.actuator[w, v]
        nu_dot = vec6()
        thrust = vec8()
        newest = admissible(
            command.thrust[w, v],
            plant.force_min[w, v],
            plant.force_max[w, v],
            plant.dead_minus[w, v],
            plant.dead_plus[w, v],
        )
        if wp.static(speed_lag):
            newest = lag_target(plant, w, v, newest)
        head = step % state.commands.shape[2]
        state.commands[w, v, head] = newest
        max_change = h * plant.slew[w, v]
        for k in range(substeps):
            elapsed = float(k) * h
            t = float(step) * control_step + elapsed
            target = delayed_command(state, w, v, head, elapsed, plant.delay[w, v], control_step, h)
            before = thrust_of(plant, w, v, actuator)
            actuator = first_order(actuator, target, plant.alpha[w, v], max_change)
            thrust = thrust_of(plant, w, v, actuator)
            if wp.static(runge_kutta):
                tau = plant.B[w, v] * (0.5 * (before + thrust)) + command.disturbance[w, v]
                x1 = position_rate(q, nu)
                q1 = quaternion_rate(q, wp.vec3(nu[3], nu[4], nu[5]))
                n1 = nu_dot_of(plant, hull, water, walls, tether, w, v, position, q, nu, tau, t, elapsed)
                nu2 = nu + 0.5 * h * n1
                qm = wp.normalize(q + 0.5 * h * q1)
                x2 = position_rate(qm, nu2)
                q2 = quaternion_rate(qm, wp.vec3(nu2[3], nu2[4], nu2[5]))
                n2 = nu_dot_of(
                    plant, hull, water, walls, tether, w, v, position + 0.5 * h * x1, qm, nu2, tau,
                    t + 0.5 * h, elapsed + 0.5 * h,
                )  # fmt: skip
                nu3 = nu + 0.5 * h * n2
                qn = wp.normalize(q + 0.5 * h * q2)
                x3 = position_rate(qn, nu3)
                q3 = quaternion_rate(qn, wp.vec3(nu3[3], nu3[4], nu3[5]))
                n3 = nu_dot_of(
                    plant, hull, water, walls, tether, w, v, position + 0.5 * h * x2, qn, nu3, tau,
                    t + 0.5 * h, elapsed + 0.5 * h,
                )  # fmt: skip
                nu4 = nu + h * n3
                qe = wp.normalize(q + h * q3)
                x4 = position_rate(qe, nu4)
                q4 = quaternion_rate(qe, wp.vec3(nu4[3], nu4[4], nu4[5]))
                n4 = nu_dot_of(
                    plant, hull, water, walls, tether, w, v, position + h * x3, qe, nu4, tau, t + h, elapsed + h
                )  # fmt: skip
                nu_dot = (n1 + 2.0 * n2 + 2.0 * n3 + n4) / 6.0
                position = position + (h / 6.0) * (x1 + 2.0 * x2 + 2.0 * x3 + x4)
                q = wp.normalize(q + (h / 6.0) * (q1 + 2.0 * q2 + 2.0 * q3 + q4))
                nu = nu + h * nu_dot
            else:
                tau = plant.B[w, v] * thrust + command.disturbance[w, v]
                nu_dot = nu_dot_of(plant, hull, water, walls, tether, w, v, position, q, nu, tau, t, elapsed)
                nu = nu + h * nu_dot
                position = position + h * position_rate(q, nu)
                q = rotate_by(q, wp.vec3(nu[3], nu[4], nu[5]), h)
        p = position
        state.history[step % wp.static(HISTORY), w, v] = vec13(
            p[0], p[1], p[2], q[0], q[1], q[2], q[3], nu[0], nu[1], nu[2], nu[3], nu[4], nu[5]
        )
        if not is_finite(position, q, nu):
            state.broken[w] = 1
            return
        state.position[w, v] = position
        state.quaternion[w, v] = q
        state.velocity[w, v] = nu
        state.acceleration[w, v] = nu_dot
        state.actuator[w, v] = actuator
        state.thrust[w, v] = thrust

    return physics_step


@wp.kernel(enable_backward=False)
def tick(state: State, world_offset: int):
    """Close the control step: count it, and freeze the worlds in which a number stopped being finite."""
    w = world_offset + wp.tid()
    if state.frozen[w] != 0:
        return
    state.steps[w] = state.steps[w] + 1
    state.frozen[w] = state.broken[w]
