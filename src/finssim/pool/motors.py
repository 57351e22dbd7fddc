"""Motors, their battery, and the speed loop that the firmware runs for each: Warp functions over all motors at once."""
# mypy: disable-error-code="valid-type,misc,index,no-any-return,no-untyped-def,untyped-decorator,attr-defined"

import math
from typing import Any

import numpy as np
import warp as wp

from finssim.pool.plant_spec import PlantSpec
from finssim.vehicles import Vehicle

RPM = 2.0 * math.pi / 60.0
"""One turn a minute [rad/s]."""

FILTER = 0.02
"""Time constant of the measured speed in the derivative term [s]."""


@wp.struct
class MotorBank:
    """Parameters and memory of all motors, in canonical order; speeds are canonical too (positive pushes forward)."""

    count: int
    alpha: wp.array(dtype=float)  # 1 - exp(-motor step / time constant)
    delay: wp.array(dtype=int)  # motor steps from throttle to shaft
    full: wp.array(dtype=float)  # steady speed at full throttle on a full battery [rad/s]
    dead_plus: wp.array(dtype=float)  # slowest speed that turns the shaft [rad/s]
    dead_minus: wp.array(dtype=float)  # as a magnitude

    full_voltage: float  # [V]
    fade: float
    fade_time: float  # [s]
    resistance: float  # [ohm]
    motor_power: float  # at full speed [W]
    idle_current: float  # [A]

    loop_steps: int  # motor steps between runs of the loop
    loop_period: float  # [s]
    scale: wp.array(dtype=float)  # speed that the firmware believes full throttle gives [rad/s]
    model_alpha: wp.array(dtype=float)  # of the response that the firmware expects, per run of the loop
    kp: float
    ki: float  # [1/s]
    kd: float  # [s]
    noise: float  # of one speed measurement [rad/s]
    quantum: float  # [rad/s]

    target: wp.array(dtype=float)  # [rad/s]
    speed: wp.array(dtype=float)  # true shaft speed [rad/s]
    measured: wp.array(dtype=float)  # newest measurement [rad/s]
    smooth: wp.array(dtype=float)  # for the derivative
    expected: wp.array(dtype=float)  # response that the firmware expects [rad/s]
    integral: wp.array(dtype=float)
    throttle: wp.array(dtype=float)  # newest, -1 to 1
    line: wp.array2d(dtype=float)  # throttles on their way
    electric: wp.array(dtype=float)  # battery voltage [V], current [A]


@wp.func
def throttle_of(motors: MotorBank, k: int, noise: float) -> float:
    """One run of the speed loop of motor k: feed-forward plus PID on the deviation from the expected response.

    Args:
        motors: All motors; memory of motor k is written.
        k: Which motor.
        noise: A standard normal number.

    Returns:
        Throttle, -1 to 1.
    """
    measured = motors.speed[k] + motors.noise * noise
    if motors.speed[k] == 0.0:
        measured = 0.0  # a shaft that stands gives no pulses to count
    if motors.quantum > 0.0:
        measured = motors.quantum * wp.round(measured / motors.quantum)
    motors.measured[k] = measured
    before = motors.smooth[k]
    motors.smooth[k] = before + (motors.loop_period / wp.static(FILTER)) * (measured - before)
    target = motors.target[k]
    if target == 0.0:
        motors.integral[k] = 0.0
        motors.expected[k] = measured
        return 0.0
    scale = motors.scale[k]
    expected = motors.expected[k] + motors.model_alpha[k] * (target - motors.expected[k])
    motors.expected[k] = expected
    error = (expected - measured) / scale
    rate = (motors.smooth[k] - before) / (motors.loop_period * scale)
    u = target / scale + motors.kp * error + motors.integral[k] - motors.kd * rate
    # Integrate only while the throttle is free to follow.
    if wp.abs(u) < 1.0 or u * error < 0.0:
        motors.integral[k] = motors.integral[k] + motors.ki * motors.loop_period * error
    # A motor that is told to turn one way is never driven the other way: reversing is for the target to say.
    return wp.clamp(u, wp.where(target > 0.0, 0.0, -1.0), wp.where(target > 0.0, 1.0, 0.0))


@wp.func
def steady_speed(motors: MotorBank, k: int, throttle: float, voltage: float) -> float:
    """Speed at which motor k settles [rad/s]: throttle times voltage, and none below the slowest that turns."""
    speed = throttle * motors.full[k] * voltage / motors.full_voltage
    if speed < motors.dead_plus[k] and speed > -motors.dead_minus[k]:
        return 0.0
    return speed


@wp.func
def turn_motors(motors: MotorBank, tick: int, dt: float, noise: wp.uint32):
    """One motor step of every motor: speed loop when due, delay line, first-order lag.

    Args:
        motors: All motors; their memory is written.
        tick: Motor steps since the start.
        dt: Motor step [s], for the battery's fade.
        noise: Random state of this step.
    """
    power = float(0.0)
    slots = motors.line.shape[1]
    age = wp.min(float(tick) * dt / motors.fade_time, 1.0)
    rest = motors.full_voltage * (1.0 - motors.fade * age)
    voltage = rest - motors.resistance * motors.electric[1]
    for k in range(motors.count):
        if tick % motors.loop_steps == 0:
            motors.throttle[k] = throttle_of(motors, k, wp.randn(noise))
        motors.line[k, tick % slots] = motors.throttle[k]
        late = motors.line[k, (tick + slots - motors.delay[k]) % slots]
        goal = steady_speed(motors, k, late, voltage)
        speed = motors.speed[k] + motors.alpha[k] * (goal - motors.speed[k])
        if goal == 0.0 and wp.abs(speed) < 1.0:
            speed = 0.0  # friction stops a shaft for good
        motors.speed[k] = speed
        part = wp.abs(speed) / motors.full[k]
        power += motors.motor_power * part * part * part
    motors.electric[0] = voltage
    motors.electric[1] = motors.idle_current + power / voltage


def motor_bank(vehicle: Vehicle, spec: PlantSpec, dt: float, device: Any = "cpu") -> MotorBank:
    """Motors at rest.

    Args:
        vehicle: As its file has it: what the firmware believes.
        spec: As it is.
        dt: Motor step [s].
        device: Warp device.
    """
    true = [spec.thrusters[name] for name in vehicle.thruster_names]
    told = list(vehicle.thrusters.values())
    firmware = spec.firmware
    bank = MotorBank()
    n = bank.count = len(true)
    bank.loop_steps = max(1, round(firmware.loop_period / dt))
    bank.loop_period = bank.loop_steps * dt
    delay = [round(t.delay / dt) for t in true]
    lag = np.array([t.time_constant + t.delay for t in told])
    arrays = {
        "alpha": 1.0 - np.exp(-dt / np.array([t.time_constant for t in true])),
        "full": [t.full_rpm * RPM for t in true],
        "dead_plus": [t.dead_rpm_plus * RPM for t in true],
        "dead_minus": [t.dead_rpm_minus * RPM for t in true],
        "scale": [max(t.rpm_max, -t.rpm_min) * RPM / firmware.feed_forward for t in told],
        "model_alpha": 1.0 - np.exp(-bank.loop_period / lag),
        **{name: np.zeros(n) for name in ("target", "speed", "measured", "smooth", "expected")},
        **{name: np.zeros(n) for name in ("integral", "throttle")},
        "electric": [spec.battery.full_voltage, spec.battery.idle_current],
    }
    for name, values in arrays.items():
        setattr(bank, name, wp.array(np.asarray(values, dtype=np.float32), dtype=float, device=device))
    bank.delay = wp.array(delay, dtype=int, device=device)
    bank.line = wp.zeros((n, max(delay) + 1), dtype=float, device=device)
    for name in ("full_voltage", "fade", "fade_time", "resistance", "motor_power", "idle_current"):
        setattr(bank, name, getattr(spec.battery, name))
    bank.kp, bank.ki, bank.kd = firmware.gain, firmware.integral_gain, firmware.derivative_gain
    bank.noise, bank.quantum = firmware.rpm_noise * RPM, firmware.rpm_quantum * RPM
    return bank
