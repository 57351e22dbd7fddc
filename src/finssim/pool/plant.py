"""The plant: a vehicle in its water that no training model describes, behind its motors and their speed loop."""
# mypy: disable-error-code="valid-type,misc,index,no-any-return,no-untyped-def,untyped-decorator,attr-defined"

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from finssim.engine import Pool, Simulator, Water, Wave
from finssim.engine.plant_arrays import NO_LIMIT
from finssim.physics.hydrostatics import submerged_fraction
from finssim.physics.kinematics import up_in_body
from finssim.physics.terms.composed import layout
from finssim.physics.types import join, mat66, vec6, vec8
from finssim.pool.current import Gyre, circulation_at, gyre
from finssim.pool.losses import PropellerBank, delivered_thrust, propeller_bank
from finssim.pool.motors import MotorBank, motor_bank, turn_motors
from finssim.pool.plant_spec import PlantSpec, PlantSpecError
from finssim.pool.tether import Slack, dragged_line, slack_line, slack_pull
from finssim.vehicles import Vehicle
from finssim.vehicles.hydrodynamics import MeshSet

Array = NDArray[np.float64]

LONGEST_STEP = 0.005
"""Longest physics step [s]."""

MOTOR_STEP = 0.001
"""Longest step of motors and speed loops [s]."""


@wp.struct
class Hidden:
    """What acts on the body besides the engine's own forces."""

    T: mat66  # body twist to the damping's axes
    D1: mat66
    D2: mat66
    r_b: wp.vec3  # centre of buoyancy, body frame [m]
    half_height: float  # of the surface transition [m]
    drifts: int
    drift: wp.array(dtype=float)  # amplitude of each slow change of buoyancy [N]
    drift_rate: wp.array(dtype=float)  # [rad/s]
    drift_phase: wp.array(dtype=float)


@wp.func
def coupled_damping(hidden: Hidden, nu_r: vec6) -> vec6:
    """tau_D = -Tᵀ [D1 x + D2 (|x| x)], x = T nu_r, about the body origin [N, N m]."""
    x = hidden.T * nu_r
    return -wp.transpose(hidden.T) * (hidden.D1 * x + hidden.D2 * wp.cw_mul(wp.abs(x), x))


@wp.func
def buoyancy_change(hidden: Hidden, t: float) -> float:
    """Slow change of the buoyancy at a time [N]."""
    total = float(0.0)
    for i in range(hidden.drifts):
        total += hidden.drift[i] * wp.sin(hidden.drift_rate[i] * t + hidden.drift_phase[i])
    return total


@wp.kernel(enable_backward=False)
def drive(
    position: wp.array2d(dtype=wp.vec3),
    quaternion: wp.array2d(dtype=wp.quat),
    velocity: wp.array2d(dtype=vec6),
    steps: wp.array(dtype=int),
    thrust: wp.array2d(dtype=vec8),
    disturbance: wp.array2d(dtype=vec6),
    current: wp.array(dtype=wp.vec3),
    motors: MotorBank,
    propellers: PropellerBank,
    hidden: Hidden,
    circulation: Gyre,
    line: Slack,
    step: float,
    motor_steps: int,
    seed: int,
    world_offset: int,
):
    """Before a physics step: turn the motors through it, and write thrusts, wrench and current for the engine.

    Args:
        position: Body origin, world frame [m], (worlds, vehicles); as the other arrays, it has one of each.
        quaternion: Body to world, xyzw, (worlds, vehicles).
        velocity: Twist, body frame [m/s, rad/s], (worlds, vehicles).
        steps: Physics steps so far, (worlds,).
        thrust: Written: along the thrusters' axes [N], (worlds, vehicles).
        disturbance: Written: wrench about the body origin, body frame [N, N m], (worlds, vehicles).
        current: Written: velocity of the water at the body origin, world frame [m/s], (worlds,).
        motors: Motors and speed loops.
        propellers: What makes thrust of their speeds.
        hidden: What acts on the body besides.
        circulation: Of the water.
        line: The slack tether.
        step: Physics step [s].
        motor_steps: Steps of the motors in it.
        seed: Of the speed measurements' noise.
        world_offset: First world of this launch; not used.
    """
    count = steps[0]
    t = float(count) * step
    dt = step / float(motor_steps)
    for j in range(motor_steps):
        tick = count * motor_steps + j
        turn_motors(motors, tick, dt, wp.rand_init(seed, tick))
    x = position[0, 0]
    q = quaternion[0, 0]
    nu = velocity[0, 0]
    water = circulation_at(circulation, x, t)
    current[0] = water
    nu_r = nu - join(wp.quat_rotate_inv(q, water), wp.vec3(0.0))
    thrust[0, 0] = delivered_thrust(propellers, motors.speed, nu_r)
    up = up_in_body(q)
    wet = submerged_fraction(x[2] + wp.dot(up, hidden.r_b), hidden.half_height)
    lift = wet * buoyancy_change(hidden, t) * up
    tau = wet * coupled_damping(hidden, nu_r) + join(lift, wp.cross(hidden.r_b, lift))
    disturbance[0, 0] = tau + slack_pull(line, x, q)


class Plant:
    """One vehicle in one pool. Told shaft speeds, it moves; the firmware is its only commander."""

    def __init__(
        self,
        vehicle: Vehicle,
        spec: PlantSpec,
        *,
        seed: int = 0,
        period: float = 0.01,
        position: ArrayLike = (0.0, 0.0, -0.5),
        quaternion: ArrayLike = (0.0, 0.0, 0.0, 1.0),
    ) -> None:
        """Put the vehicle into the water, at rest.

        Args:
            vehicle: Its file.
            spec: What is hidden.
            seed: Of the speed measurements' noise.
            period: Time that the physics step must divide [s], such as the sensors' period.
            position: Start, world frame [m].
            quaternion: Start, body to world, xyzw.

        Raises:
            PlantSpecError: The plant is not of this vehicle.
        """
        if set(spec.thrusters) != set(vehicle.thruster_names):
            raise PlantSpecError(
                f"plant '{spec.title}' has the thrusters {', '.join(spec.thrusters)}, but {vehicle.name} "
                f"has {', '.join(vehicle.thruster_names)}: draw a plant around this vehicle"
            )
        self.vehicle, self.spec = vehicle, spec
        self.steps_per_period = math.ceil(period / LONGEST_STEP - 1e-9)
        self.step = period / self.steps_per_period
        """Physics step [s]."""
        motor_steps = math.ceil(self.step / MOTOR_STEP - 1e-9)
        self.simulator = self._simulator(position, quaternion)
        self.motors = motor_bank(vehicle, spec, self.step / motor_steps)
        self._views()
        s = self.simulator
        pipeline = s.pipeline()
        banks = [self.motors, propeller_bank(vehicle, spec), _hidden(vehicle, spec)]
        banks += [gyre(spec.circulation, spec.basin), slack_line(spec.tether)]
        self._banks = banks  # a recorded launch does not keep the arrays inside structs alive
        state = [s.state.position, s.state.quaternion, s.state.velocity, s.state.steps]
        written = [s.command.thrust, s.command.disturbance, s.water.current]
        # One slice of the generator's 32 bits per plant: seeds that differ by one must not share numbers.
        key = int(np.random.SeedSequence([seed, 71]).generate_state(1)[0] >> 1)
        pipeline.add(drive, [*state, *written, *banks, self.step, motor_steps, key])
        s.add_step(pipeline)
        self._step = captured(pipeline.run)
        self.steps = 0

    def _simulator(self, position: ArrayLike, quaternion: ArrayLike) -> Simulator:
        spec, hull = self.spec, self.spec.hull
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
            water=Water(
                depth=spec.basin.depth,
                waves=[Wave(**wave.model_dump()) for wave in spec.circulation.waves],
            ),
            pool=Pool(length=spec.basin.length, width=spec.basin.width, depth=spec.basin.depth),
            tether=dragged_line(spec.tether),
            threads=1,
            water_moves=bool(spec.circulation.eddies or any(spec.circulation.stream)),
        )
        none = {slot.path: 0.0 for slot in layout(simulator.plant.terms)}
        for name, value in (_engine_fields(vehicle, spec) | none).items():
            view = simulator.plant.fields[name].numpy()
            view[...] = value
        simulator.place(position=position, quaternion=quaternion)
        simulator.refresh()
        return simulator

    def _views(self) -> None:
        n, s = len(self.vehicle.thrusters), self.simulator
        self.position = s.numpy("position")[0, 0]
        """Body origin, world frame [m]; a view, (3,)."""
        self.quaternion = s.numpy("quaternion")[0, 0]
        """Body to world, xyzw; a view, (4,)."""
        self.nu = s.numpy("velocity")[0, 0]
        """Body frame [m/s, rad/s]; a view, (6,)."""
        self.thrust = s.numpy("thrust")[0, 0, :n]
        """Delivered, canonical order [N]; a view, (n,)."""
        self.water_velocity = s.water.current.numpy()[0]
        """At the body, world frame [m/s]; a view, (3,)."""
        self.target = self.motors.target.numpy()
        """Shaft speeds that the firmware asks for, canonical [rad/s]; written by it, a view, (n,)."""
        self.shaft_speed = self.motors.speed.numpy()
        """True, canonical [rad/s]; a view, (n,)."""
        self.measured_speed = self.motors.measured.numpy()
        """As the firmware measures it, canonical [rad/s]; a view, (n,)."""
        self.throttle = self.motors.throttle.numpy()
        """-1 to 1; a view, (n,)."""
        self.electric = self.motors.electric.numpy()
        """Battery voltage [V] and current [A]; a view, (2,)."""

    @property
    def time(self) -> float:
        """Since the start [s]."""
        return self.steps * self.step

    def advance(self, steps: int = 1) -> None:
        """Move on by some physics steps, with the shaft speeds of `target`."""
        for _ in range(steps):
            self._step()
        self.steps += steps


def captured(run: Callable[[], None]) -> Callable[[], None]:
    """Launches on the CPU as one call into native code: for a single vehicle, one by one they cost six times that.

    Args:
        run: Launches kernels, the same ones every time.

    Returns:
        What does the same; `run` itself where this version of Warp captures nothing on a CPU.
    """
    try:
        with wp.ScopedCapture(device="cpu") as capture:
            run()
    except RuntimeError:
        return run
    return lambda: wp.capture_launch(capture.graph)


def _engine_fields(vehicle: Vehicle, spec: PlantSpec) -> dict[str, Any]:
    """The engine's parameters: the true body, no damping of its own, and an actuator that passes everything on."""
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
        "force_min": -1.0e6,
        "force_max": 1.0e6,
        "dead_minus": 0.0,
        "dead_plus": 0.0,
        "time_constant": 0.0,
        "slew": NO_LIMIT,
        "delay": 0.0,
        "speed_lag": 0,
    }


def _hidden(vehicle: Vehicle, spec: PlantSpec) -> Hidden:
    hidden = Hidden()
    hidden.T = mat66(*spec.damping.to_axes().ravel())
    hidden.D1 = mat66(*np.ravel(spec.damping.linear))
    hidden.D2 = mat66(*np.ravel(spec.damping.quadratic))
    hidden.r_b = wp.vec3(*spec.body.center_of_buoyancy)
    hidden.half_height = vehicle.body.surface_half_height
    drift = spec.buoyancy
    hidden.drifts = len(drift.grams)
    columns = {
        "drift": [0.001 * g * vehicle.water.gravity for g in drift.grams],
        "drift_rate": [2.0 * math.pi / period for period in drift.periods],
        "drift_phase": list(drift.phases),
    }
    for name, values in columns.items():
        setattr(hidden, name, wp.array(values or [0.0], dtype=float, device="cpu"))
    return hidden
