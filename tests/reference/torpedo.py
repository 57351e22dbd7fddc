"""A torpedo for tests, a section of every kind of actuator, and a kind from outside the package."""
# mypy: disable-error-code="no-untyped-def"

from finssim.core.registry import ACTUATORS
from finssim.vehicles.vehicle import Vehicle
from reference.examples import example

RHO, G = 1025.0, 9.81


BRAKE = example("own/actuator/brake").BRAKE
FIN = {
    "kind": "fin", "position": [-0.6, 0.0, 0.1], "span": [0.0, 0.0, 1.0], "area": 0.02, "lift_slope": 3.0, "stall": 0.3,
    "drag": [0.01, 0.02, 1.1], "minimum": -0.5, "maximum": 0.5,
}  # fmt: skip
SECTIONS = {
    "fin": FIN,
    "buoyancy": {"kind": "buoyancy", "position": [0.4, 0.0, 0.05], "minimum": -1e-3, "maximum": 1e-3},
    "moving_mass": {
        "kind": "moving_mass", "mass": 4.0, "position": [0.1, 0.0, -0.05], "axis": [1.0, 0.0, 0.0], "minimum": -0.2,
        "maximum": 0.2,
    },
    "gimbal": {
        "kind": "gimbal", "thruster": "propeller", "axis": [0.0, 0.0, 1.0], "minimum": -0.4, "maximum": 0.4,
    },
    "brake": {"kind": "brake", "position": [0.0, 0.0, 0.3], "size": 0.1, "minimum": 0.0, "maximum": 1.0},
}  # fmt: skip


def hull(actuators, **changes):
    """Return a torpedo with one propeller, without hydrodynamic couplings, and some actuators."""
    ACTUATORS["brake"] = BRAKE
    text = {
        "title": "test hull", "description": "for tests", "water": {"density": RHO, "gravity": G},
        "body": {
            "mass": 30.0, "inertia": [0.2, 3.5, 3.5], "center_of_gravity": [0.02, 0.0, -0.02],
            "displaced_volume": 30.0 / RHO, "center_of_buoyancy": [0.0, 0.0, 0.0], "size": [1.4, 0.2, 0.2],
            "surface_half_height": 0.1,
        },
        "hydrodynamics": {
            "calibrated": {
                "added_mass": [1.0, 30.0, 30.0, 0.1, 4.0, 4.0],
                "linear_damping": [2.0, 20.0, 20.0, 0.5, 8.0, 8.0],
                "quadratic_damping": [6.0, 100.0, 100.0, 0.2, 9.0, 9.0],
            }
        },
        "thrusters": {
            "propeller": {
                "position": [-0.7, 0.0, 0.0], "axis": [1.0, 0.0, 0.0], "force_min": -40.0, "force_max": 40.0,
                "c_plus": 1.6e-3, "c_minus": 1.4e-3, "rpm_min": -1600.0, "rpm_max": 1600.0, "domain": "speed",
                "time_constant": 0.2, "diameter": 0.14, **changes.pop("propeller", {}),
            }
        },
        "controlled_axes": ["surge"], "actuators": actuators,
    }  # fmt: skip
    return Vehicle(**text, name="hull")
