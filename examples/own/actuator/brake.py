"""An actuator of your own: a drogue on a winch, whose drag along the hull grows with the length of line paid
out."""

# mypy: disable-error-code="valid-type,misc,index,no-any-return,no-untyped-def,untyped-decorator"

import numpy as np
import warp as wp

import finssim as fs
from finssim.core import ACTUATORS
from finssim.physics import join, vec6
from finssim.vehicles import Actuator, ActuatorKind, Positive, Vector3, load_vehicle


class Brake(Actuator):
    """Section of a vehicle file under `actuators:`; lag, rate, travel and play are keys of every kind."""

    position: Vector3
    """Point of action of the force, from the body origin, body frame [m], (3,)."""
    size: Positive
    """Drag area of the open drogue [m²]."""


@wp.func
def brake_wrench(value: float, nu_r: vec6, density: float, position: wp.vec3, size: float) -> vec6:
    """X = -ρ/2 A v |u| u at `position`, v from 0 (closed) to 1 (open), body frame [N, N m]."""
    force = wp.vec3(-0.5 * density * size * value * wp.abs(nu_r[0]) * nu_r[0], 0.0, 0.0)
    return join(force, wp.cross(position, force))


BRAKE = ActuatorKind(
    name="brake", schema=Brake, unit="1", units={"position": "m", "size": "m²"}, wrench=brake_wrench
)

if __name__ == "__main__":
    ACTUATORS["brake"] = BRAKE  # an installed package registers it by an entry point instead
    brake = {"kind": "brake", "position": [-0.3, 0.0, 0.0], "size": 0.05, "minimum": 0.0, "maximum": 1.0}
    vehicle = load_vehicle("bluerov2").replace({"actuators": {"brake": brake}})
    for value in (0.0, 1.0):
        values = np.zeros(len(vehicle.channel_names))
        values[-1] = value
        gained = fs.acceleration(
            vehicle, [0.0, 0.0, -5.0, 0.0, 0.0, 0.0], [1.0, 0, 0, 0, 0, 0], actuators=values
        )
        print(f"surge acceleration at 1 m/s, brake at {value:g}: {gained[0]:.2f} m/s²")
