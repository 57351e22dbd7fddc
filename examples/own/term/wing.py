"""A hydrodynamic term of your own: a wing whose lift grows with the forward speed, and which damps pitch."""

import numpy as np
import warp as wp

from finssim.physics import Term, add_term, vec6
from finssim.sim import Simulator
from finssim.vehicles import NonNegative, Number, Part, load_vehicle


class Wing(Part):
    """Section of a vehicle file under the key `wing` of a hydrodynamic set."""

    lift: NonNegative
    """[N s²/m²]"""
    moment: Number = 0.0
    """[N s²]"""


@wp.func
def wing_wrench(nu_r: vec6, lift: float, moment: float) -> vec6:
    """Z = -lift |u| w, M = -moment |u| q, about the reference point of the set, body frame [N, N m]."""
    speed = wp.abs(nu_r[0])
    return vec6(0.0, 0.0, -lift * speed * nu_r[2], 0.0, -moment * speed * nu_r[4], 0.0)


@wp.func
def wing_slope(nu_r: vec6, lift: float, moment: float) -> vec6:
    """Return -dZ/dw and -dM/dq: the damping part of the term, which the integrator takes implicitly."""
    speed = wp.abs(nu_r[0])
    return vec6(0.0, 0.0, lift * speed, 0.0, wp.max(moment, 0.0) * speed, 0.0)


def check_wing(wing: Wing) -> tuple[bool, str]:
    """Return whether the section passes, and the text of the check that `finssim vehicles show` prints."""
    return (
        wing.lift < 500.0,
        f"lift {wing.lift:g} N s²/m², expected < 500: the wing would be larger than the vehicle",
    )


WING = Term(
    name="wing",
    schema=Wing,
    units={"lift": "N s²/m²", "moment": "N s²"},
    wrench=wing_wrench,
    slope=wing_slope,
    check=check_wing,
)

if __name__ == "__main__":
    add_term(WING)  # an installed package registers it by an entry point instead
    plain = load_vehicle("bluerov2")
    winged = plain.replace({"hydrodynamics.calibrated.wing": {"lift": 40.0}})
    for vehicle in (plain, winged):
        sim = Simulator(vehicle, control_step=0.1)
        sim.place(position=(0.0, 0.0, -5.0), velocity=(1.0, 0.0, 0.2, 0.0, 0.0, 0.0))
        for _ in range(5):
            sim.step()
        print("heave after 0.5 s:", np.round(sim.numpy("velocity")[0, 0, 2], 4), "m/s")
