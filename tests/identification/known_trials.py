"""Synthetic trials of catalogue vehicles, simulated once, and what a fit of them should find."""

from functools import cache

from finssim.identification.plant_terms import matrices
from finssim.identification.programme import programmes
from finssim.identification.synthetic import NoiseProfile, record, trials_of
from finssim.vehicles import AXES, load_vehicle

NOISE = NoiseProfile(velocity_std=0.01, gyro_std=0.005, attitude_std=0.004)


@cache
def recorded(name, axes, kind="published", levels=()):
    """Vehicle, programmes and true motion; measuring it again with another seed costs little."""
    vehicle = load_vehicle(name)
    chosen = programmes(list(axes), vehicle, kind=kind, levels=dict(levels))
    return vehicle, chosen, record(chosen, vehicle, seed=0)


def trials(name, *axes, noise=NOISE, seed=0, rate=50.0, kind="published", levels=(), **columns):
    """Vehicle and synthetic trials of it; `levels` are pairs of an axis and its magnitudes."""
    vehicle, chosen, recording = recorded(name, axes, kind, levels)
    return vehicle, trials_of(recording, chosen, vehicle, noise=noise, seed=seed, rate=rate, **columns)


def truth(vehicle):
    """Name of an estimate -> the number of the vehicle file, about the reference point of its coefficients."""
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
