"""Synthetic trials of catalogue vehicles, simulated once, and the expected results of a fit."""

from functools import cache

from finssim.identification.plant_terms import matrices
from finssim.identification.programme import programmes
from finssim.identification.synthetic import NoiseProfile, record, trials_of
from finssim.vehicles import AXES, load_vehicle

NOISE = NoiseProfile(velocity_std=0.01, gyro_std=0.005, attitude_std=0.004)


@cache
def recorded(name, axes, kind="published", levels=()):
    """Return vehicle, programmes and true motion, cached: measuring it again with another seed is cheap."""
    vehicle = load_vehicle(name)
    chosen = programmes(list(axes), vehicle, kind=kind, levels=dict(levels))
    return vehicle, chosen, record(chosen, vehicle, seed=0)


def trials(name, *axes, noise=NOISE, seed=0, rate=50.0, kind="published", levels=(), **columns):
    """Return a vehicle and synthetic trials of it; `levels` are pairs of an axis and its magnitudes."""
    vehicle, chosen, recording = recorded(name, axes, kind, levels)
    return vehicle, trials_of(recording, chosen, vehicle, noise=noise, seed=seed, rate=rate, **columns)


def truth(vehicle):
    """Return the vehicle file's value of each estimate, about the reference point of its coefficients."""
    plant = matrices(vehicle)
    out = {"buoyancy_excess": plant.excess}
    for i, axis in enumerate(AXES):
        out |= {
            f"{axis}.m_eff": plant.M_RB[i, i] + plant.M_A[i, i],
            f"{axis}.added_mass": plant.M_A[i, i],
            f"{axis}.d1": plant.D1[i, i],
            f"{axis}.d2": plant.D2[i, i],
            f"{axis}.k": plant.arm[2],
        }
    return out
