"""Every catalogue vehicle with every hydrodynamic model that its file has, and random states."""

from functools import cache

import numpy as np
import pytest

from finssim.core.registry import TERMS
from finssim.vehicles import catalogue, load_vehicle
from finssim.vehicles.loader import checked

load = cache(load_vehicle)
THRUSTED = [name for name in catalogue() if load(name).thrusters]
"""Vehicles with thrusters: all but gliders."""
PAIRS = [(name, model) for name in catalogue() for model in sorted(load(name).hydrodynamics)]
PAIRS.remove(("finsrov_sim7", "mesh"))  # body, mesh and thrusters are those of FinsROV


def for_each(pairs):
    """Parametrise a test by (name, model)."""
    return pytest.mark.parametrize(("name", "model"), pairs, ids=[f"{n}-{m}" for n, m in pairs])


EVERY_VEHICLE_AND_MODEL = for_each(PAIRS)
ONE_VEHICLE_PER_MODEL = pytest.mark.parametrize("model", ["calibrated", "mesh", "simplified"])
"""For claims about the engine rather than the numbers of a vehicle: FinsROV has all three."""


def random_attitudes(rng, n):
    """Return uniform unit quaternions (n, 4), rounded to float32 as in a simulator."""
    q = rng.normal(size=(n, 4))
    return (q / np.linalg.norm(q, axis=1, keepdims=True)).astype(np.float32)


def random_states(rng, n, *, depth=(-3.0, -2.0), speed=1.0, turn=1.0):
    """Positions (n, 3) [m], attitudes (n, 4) and twists (n, 6) [m/s, rad/s] in float32."""
    position = rng.uniform([-2.0, -2.0, depth[0]], [2.0, 2.0, depth[1]], (n, 3)).astype(np.float32)
    nu = rng.normal(size=(n, 6)) * ([speed] * 3 + [turn] * 3)
    return position, random_attitudes(rng, n), nu.astype(np.float32)


def disturb(simulator, tau):
    """Apply wrenches about the body origin, body frame, broadcastable to (worlds, vehicles, 6) [N, N m]."""
    shape = (simulator.worlds, len(simulator.vehicles), 6)
    tau = np.broadcast_to(np.asarray(tau, np.float32), shape)
    simulator.command.disturbance.assign(np.ascontiguousarray(tau))


def plain(vehicle, keep=("surge_damping",)):
    """The hull by its matrices and the terms to keep, whose kernel many share: no inflow, and no actuators.

    Where no thruster would be left, it has that of REMUS 100.
    """
    values = vehicle.values()
    further = [key for chosen in values["hydrodynamics"].values() for key in chosen if key in TERMS]
    if "actuators" not in values and set(further) <= set(keep):
        return vehicle
    values.pop("actuators", None)
    if not values["thrusters"]:
        values |= {key: load("remus100").values()[key] for key in ("thrusters", "controlled_axes")}
    for thruster in values["thrusters"].values():
        thruster.pop("inflow", None)
    for chosen in values["hydrodynamics"].values():
        for key in set(TERMS) & set(chosen) - set(keep):
            del chosen[key]
    return checked(values, dict(vehicle.provenance), vehicle.name, vehicle.path, vehicle.name)


def damped(vehicle, model):
    """Return whether the matrices of linear and quadratic damping resist motion along every axis."""
    chosen = vehicle.hydrodynamics[model]
    return bool((np.diag(chosen.linear_damping) + np.diag(chosen.quadratic_damping) > 0.0).all())


def undamped(vehicle, model):
    """The vehicle without any damping, and without fins."""
    vehicle = plain(vehicle, keep=())
    chosen = vehicle.hydrodynamics[model]
    names = [x for x in ("linear_damping", "quadratic_damping") if hasattr(chosen, x)]
    changes = {f"hydrodynamics.{model}.{x}": np.zeros((6, 6)).tolist() for x in names}
    changes |= {f"hydrodynamics.{model}.{x}": 0.0 for x in ("form_drag", "skin_drag") if hasattr(chosen, x)}
    return vehicle.replace(changes)


def neutral(vehicle, buoyancy_above_gravity=0.0):
    """The vehicle with as much buoyancy as weight, its centre a distance straight above the centre of gravity [m]."""
    volume = vehicle.body.mass / vehicle.water.density
    r_b = np.array(vehicle.body.center_of_gravity) + [0.0, 0.0, buoyancy_above_gravity]
    return vehicle.replace({"body.displaced_volume": volume, "body.center_of_buoyancy": r_b.tolist()})


def weightless(vehicle, model):
    """Return the vehicle neutrally buoyant and undamped, with inertia only."""
    return neutral(undamped(vehicle, model))
