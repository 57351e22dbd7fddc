"""Vehicles under their autopilots in open water, step by step."""

from typing import NamedTuple

import numpy as np

from finssim.control.course import CoursePilot
from finssim.control.guidance import Known
from finssim.core.rotations import quat_from_yaw, quat_rotate, quat_to_euler
from finssim.sim import Simulator
from finssim.sim.free_motion import linear_model
from finssim.vehicles.capability import coefficients_of

PERIOD = 0.1


class Sailed(NamedTuple):
    """Motion of n vehicles by time, (steps, n, ...)."""

    time: np.ndarray
    position: np.ndarray
    course: np.ndarray
    euler: np.ndarray
    nu: np.ndarray
    channels: np.ndarray


def sailed(vehicle, orders, seconds, *, depth=10.0, speed=1.5, water=None, pilot=None):
    """Return the motion of one vehicle per row of orders, from level motion along x at a speed through the water [m/s].

    Args:
        vehicle: The vehicle.
        orders: Arguments of `CoursePilot.command`, arrays with one number per vehicle.
        seconds: Duration [s].
        depth: Depth at the start [m].
        speed: Speed at the start [m/s].
        water: Water of the `Simulator`.
        pilot: The autopilot; that of the vehicle if None.
    """
    pilot = pilot or CoursePilot(linear_model(vehicle), vehicle.name, PERIOD)
    n = max(np.size(x) for x in orders.values())
    sim = Simulator(
        vehicle,
        worlds=n,
        control_step=PERIOD,
        substeps=4,
        water=water,
        hydrodynamics=coefficients_of(vehicle),
    )
    sim.place(position=(0.0, 0.0, -depth), quaternion=quat_from_yaw(0.0))
    start = np.zeros((n, 1, 6), np.float32)
    start[..., 0] = speed
    if water is not None:
        start[..., :3] += np.asarray(water.current)
    sim.state.velocity.assign(start)
    memory, rows = pilot.reset(n), []
    for _ in range(round(seconds / PERIOD)):
        x, q, nu = (
            np.asarray(a.numpy()[:, 0], float)
            for a in (sim.state.position, sim.state.quaternion, sim.state.velocity)
        )
        channels, memory = pilot.command(memory, Known(None, x, q, nu), **orders)
        ground = quat_rotate(q, nu[:, :3])
        rows.append(
            (x, np.arctan2(ground[:, 1], ground[:, 0]), np.stack(quat_to_euler(q), axis=1), nu, channels)
        )
        sim.set_actuators(channels[:, None])
        sim.step()
    return Sailed(PERIOD * np.arange(len(rows)), *(np.array(column) for column in zip(*rows, strict=True)))
