"""ArduSub logs as streams: pulses, attitude, inertial measurements, depth, velocity, battery, arming."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from finssim.calibration.errors import CalibrationError
from finssim.calibration.importers.ardupilot_log import Log, read_log
from finssim.calibration.importers.ardusub_outputs import NEUTRAL, outputs_of
from finssim.calibration.importers.ardusub_velocity import VELOCITY_KINDS, velocity_stream
from finssim.calibration.importers.assemble import in_our_axes
from finssim.calibration.importers.column_map import ArduSubMap
from finssim.calibration.importers.source_map import Frame
from finssim.calibration.importers.streams import Stream
from finssim.calibration.importers.units import GRAVITY
from finssim.geometry.rotations import wrap_angle
from finssim.vehicles import Vehicle

__all__ = ["read_ardusub"]

FRD = Frame(body="FRD", world="NED")

INERTIAL = ("RAW_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3")
PRESSURES = ("SCALED_PRESSURE", "SCALED_PRESSURE2", "SCALED_PRESSURE3")
KINDS = (
    frozenset(
        ("ATT", "IMU", "IMU2", "IMU3", "BARO", "BAR2", "BAR3", "RCOU", "RCO2", "BAT", "CURR", "ARM", "EV")
    )
    | frozenset(
        ("SERVO_OUTPUT_RAW", "ATTITUDE", "SYS_STATUS", "BATTERY_STATUS", "HEARTBEAT", *INERTIAL, *PRESSURES)
    )
    | VELOCITY_KINDS
)

ARMED_EVENT, DISARMED_EVENT = 10, 11
ARMED_FLAG = 128
"""MAV_MODE_FLAG_SAFETY_ARMED"""


def read_ardusub(
    path: Path, asked: ArduSubMap, vehicle: Vehicle | None, *, pulses: bool = True
) -> list[Stream]:
    """What an ArduSub log says, one stream for each kind of message.

    Args:
        path: `.BIN` or `.tlog`.
        asked: What is taken.
        vehicle: Whose thrusters the outputs drive; without it the pulses keep the numbers of the outputs.
        pulses: Whether the outputs are wanted; they are not of a passive trial.

    Raises:
        CalibrationError: Not a log, or outputs that cannot be told apart.
        ModuleNotFoundError: pymavlink is not installed.
    """
    log = read_log(path, KINDS, received=asked.stamps == "received")
    streams = [
        _attitude(log),
        _inertial(log, asked),
        _depth(log, asked),
        _voltage(log),
        _arming(log),
        velocity_stream(log, asked.velocity),
        *(_pulses(log, asked, vehicle) if pulses else ()),
    ]
    found = [stream for stream in streams if stream is not None and len(stream.t) >= 2]
    if not any(stream.channels for stream in found):
        raise CalibrationError(f"{path.name}: holds no attitude, rates, depth, velocity or outputs")
    return found


def _attitude(log: Log) -> Stream | None:
    """Roll, pitch, yaw; in telemetry the rates too, which come without the bias that the autopilot found."""
    if log.has("ATT"):
        angles = [np.radians(log.numbers("ATT", name)) for name in ("Roll", "Pitch", "Yaw")]
        channels, kind = {}, "ATT"
    elif log.has("ATTITUDE"):
        angles = [log.numbers("ATTITUDE", name) for name in ("roll", "pitch", "yaw")]
        channels = {
            c: log.numbers("ATTITUDE", n)
            for c, n in zip("pqr", ("rollspeed", "pitchspeed", "yawspeed"), strict=True)
        }
        kind = "ATTITUDE"
    else:
        return None
    channels |= dict(zip(("roll", "pitch", "yaw"), angles, strict=True))
    stream = in_our_axes(Stream(source=f"{log.shown} {kind}", t=log.times[kind], channels=channels), FRD)
    wrapped = {name: wrap_angle(stream.channels[name]) for name in ("roll", "yaw")}
    return replace(stream, channels={**stream.channels, **wrapped})


def _inertial(log: Log, asked: ArduSubMap) -> Stream | None:
    """Specific force, and in DataFlash logs the rates."""
    if not log.telemetry:
        kind = "IMU" if asked.imu == 0 or not log.has(f"IMU{asked.imu + 1}") else f"IMU{asked.imu + 1}"
        if not log.has(kind):
            return None
        one = log.some(kind, "I", asked.imu)
        if not one.has(kind):
            raise CalibrationError(f"{log.shown}: holds no IMU {asked.imu}: give 'ardusub: {{imu: 0}}'")
        channels = {f"a{axis.lower()}": one.numbers(kind, f"Acc{axis}") for axis in "XYZ"}
        channels |= {name: one.numbers(kind, f"Gyr{axis}") for name, axis in zip("pqr", "XYZ", strict=True)}
        return in_our_axes(Stream(source=f"{log.shown} {kind}", t=one.times[kind], channels=channels), FRD)
    for kind in INERTIAL:
        if log.has(kind) and np.any(log.numbers(kind, "zacc")):
            # [milli-g], and zero in every field of a chip that has no such sensor
            channels = {f"a{axis}": 1e-3 * GRAVITY * log.numbers(kind, f"{axis}acc") for axis in "xyz"}
            return in_our_axes(
                Stream(source=f"{log.shown} {kind}", t=log.times[kind], channels=channels), FRD
            )
    return None


def _depth(log: Log, asked: ArduSubMap) -> Stream | None:
    """Depth of the pressure sensor that the autopilot takes for outside."""
    primary = int(log.parameters.get("BARO_PRIMARY", log.parameters.get("GND_PRIMARY", 1)))
    chosen = primary if asked.barometer is None else asked.barometer
    if log.telemetry:
        return _depth_from_pressure(log, chosen)
    kind = "BARO" if chosen == 0 or not log.has(f"BAR{chosen + 1}") else f"BAR{chosen + 1}"
    if not log.has(kind):
        return None
    one = log.some(kind, "I", chosen)
    if not one.has(kind):
        return None
    note = f"depth from barometer {chosen}, zero where the autopilot calibrated it"
    depth = -one.numbers(kind, "Alt")
    return Stream(source=f"{log.shown} {kind}", t=one.times[kind], channels={"depth": depth}, notes=(note,))


def _depth_from_pressure(log: Log, chosen: int) -> Stream | None:
    kind = PRESSURES[chosen] if chosen < len(PRESSURES) else ""
    if not log.has(kind):
        return None
    pressure = 100.0 * log.numbers(kind, "press_abs")  # [hPa]
    ground = log.parameters.get(f"BARO{chosen + 1}_GND_PRESS", 0.0)
    if ground <= 0.0:
        # The trial's maker knows the surface pressure and the density.
        return Stream(source=f"{log.shown} {kind}", t=log.times[kind], channels={"pressure": pressure})
    # 9800 Pa for a metre of fresh water, as the autopilot reckons.
    depth = (pressure - ground) / (9800.0 * log.parameters.get("BARO_SPEC_GRAV", 1.0))
    note = f"depth from {kind}, zero at the autopilot's {ground:.0f} Pa"
    return Stream(source=f"{log.shown} {kind}", t=log.times[kind], channels={"depth": depth}, notes=(note,))


def _voltage(log: Log) -> Stream | None:
    for kind, name, unit in (
        ("BAT", "Volt", 1.0),
        ("CURR", "Volt", 1.0),
        ("SYS_STATUS", "voltage_battery", 1e-3),
    ):
        if not log.has(kind):
            continue
        one = log.some(kind, "Instance", 0)
        volts = unit * one.numbers(kind, name)
        measured = (volts > 1.0) & (volts < 65.0)  # 0 and 65.535 V stand for "not measured"
        if measured.sum() >= 2:
            t, volts = one.times[kind][measured], volts[measured]
            return Stream(source=f"{log.shown} {kind}", t=t, channels={"voltage": volts})
    return None


def _arming(log: Log) -> Stream | None:
    """Words `armed` and `disarmed`; what was before the first event is its opposite."""
    if log.has("HEARTBEAT"):
        armed = [bool(int(mode) & ARMED_FLAG) for mode in log.numbers("HEARTBEAT", "base_mode")]
        return _words(log, "HEARTBEAT", list(log.times["HEARTBEAT"]), armed)
    times, armed = [], []
    if "ARM" in log.messages:
        times, armed = list(log.times["ARM"]), [bool(x) for x in log.numbers("ARM", "ArmState")]
    else:
        for t, event in zip(log.times.get("EV", ()), log.messages.get("EV", ()), strict=True):
            if event.get("Id") in (ARMED_EVENT, DISARMED_EVENT):
                times.append(float(t))
                armed.append(event["Id"] == ARMED_EVENT)
    if not times:
        return None
    begin = min(float(t[0]) for t in log.times.values() if len(t))
    return _words(log, "ARM", [min(begin, times[0] - 1e-3), *times], [not armed[0], *armed])


def _words(log: Log, kind: str, times: list[float], armed: list[bool]) -> Stream:
    said = np.array(["armed" if on else "disarmed" for on in armed], dtype=np.str_)
    return Stream(source=f"{log.shown} {kind}", t=np.array(times), words={"arming": said})


def _pulses(log: Log, asked: ArduSubMap, vehicle: Vehicle | None) -> list[Stream]:
    """pwm_NAME of each thruster, turned about the neutral pulse where needed: longer pulses push along its axis."""
    kind, field = ("SERVO_OUTPUT_RAW", "servo{}_raw") if log.telemetry else ("RCOU", "C{}")
    one = log.some(kind, "port", 0)
    if not one.has(kind):
        return []
    if vehicle is not None:
        try:
            outputs, note = outputs_of(vehicle, log.parameters, asked.outputs)
        except CalibrationError as error:
            raise CalibrationError(f"{log.shown}: {error}") from None
    else:
        outputs = {n: (f"C{n}", 1) for n in range(1, 17) if np.any(one.numbers(kind, field.format(n)) > 0.0)}
        note = "no vehicle is named, so the pulses keep the numbers of the outputs: give --vehicle"
    channels = {}
    for output, (name, sign) in outputs.items():
        pulse = one.numbers(kind, field.format(output))
        channels[f"pwm_{name}"] = np.where(pulse > 0.0, NEUTRAL + sign * (pulse - NEUTRAL), np.nan)
    return [Stream(source=f"{log.shown} {kind}", t=one.times[kind], channels=channels, notes=(note,))]
