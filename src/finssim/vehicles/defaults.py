"""Defaults of the sections `sensors`, `perception`, `tags`, `mcu` and `safety` that a vehicle file omits.

They allow every vehicle to be used in the simulated world. They are not measured on the real vehicle: `finssim
vehicles show` marks them as defaults, and readers of records of real water refuse tags that the file does not define.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from finssim.core.rotations import quat_from_euler
from finssim.vehicles.equipment import (
    Compass,
    DepthSensor,
    Dvl,
    Imu,
    Mcu,
    RaySensor,
    Safety,
    Sensors,
    TagMount,
    Tags,
)
from finssim.vehicles.part import VehicleError

if TYPE_CHECKING:
    from finssim.vehicles.vehicle import Vehicle

__all__ = [
    "DEFAULTS",
    "SITES",
    "default_mcu",
    "default_perception",
    "default_safety",
    "default_sensors",
    "default_tags",
    "numbered",
    "room",
    "vehicle_at",
    "with_navigation",
]

LENGTH = 0.6
"""Vehicles up to this length use the published pool, which is sized for FinsROV (0.56 m) [m]; it is scaled
for longer vehicles."""
POOL = (4.0, 2.0, 1.0)
"""Published pool: length, width and depth [m]."""
SITES: Mapping[str, tuple[float, float, float] | None] = {
    "pool": None,
    "tank": (10.0, 6.0, 5.0),
    "open-water": (2000.0, 2000.0, 20.0),
}
"""Size of the water of each site: length, width and depth [m]; None: the workspace in the vehicle file."""
EDGE = (0.2, 0.4)
"""Largest edge of a tag, as a fraction of the vehicle's length and of its width: two tags with margins fit on
the top."""
APART = 0.15
"""Offset of a tag from the centre of the top, as a fraction of the vehicle's length."""
QUARTER_TURN = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))

DEFAULTS: Mapping[str, str] = {
    "sensors": "IMU and pressure gauge of a small MEMS unit, at the body origin",
    "perception": "altimeter under the hull and imaging sonar at the nose (128 beams, 5 Hz), and a camera (48 px wide, "
    "10 Hz) on a vehicle that hovers, on others an altimeter 30° ahead of straight down: devices of small "
    "ROVs, delays and losses guessed",
    "tags": "two tag25h9 (15 ahead, 16 astern) on the top, as large as fits, as on FinsROV",
    "mcu": "an output for each thruster in the order of the file, positive forward; full scale is the fastest shaft",
    "safety": "silences of 0.5 s; 45 degrees of tilt, 60 for a vehicle that does not control its heave; the published "
    "pool, scaled to the vehicle's length",
}
"""Section -> description of its default."""


def room(size: Any) -> float:
    """Return the scale factor of the published pool, goals and trajectories for a vehicle of this envelope
    [m], (3,)."""
    return max(1.0, float(max(size)) / LENGTH)


def default_sensors() -> Sensors:
    """Return the catalogue's estimate of a MEMS unit, as in `finsrov.yaml`."""
    origin = np.zeros(3)
    return Sensors(
        imu=Imu(
            rate=100.0,
            position=origin,
            gyro_noise_density=2.5e-4,
            gyro_bias_walk=2.0e-5,
            gyro_bias_initial=5.0e-3,
            accel_noise_density=1.7e-3,
            accel_bias_walk=1.0e-4,
            accel_bias_initial=0.05,
        ),
        depth=DepthSensor(rate=20.0, position=origin, noise_std=0.005, bias_initial=0.01, quantisation=0.002),
    )


def default_perception(values: Mapping[str, Any]) -> dict[str, RaySensor]:
    """Return camera, sonar and altimeter on the envelope, as on a small ROV; a vehicle that does not hover
    has a second altimeter, pointing 30° ahead of straight down, instead of the camera.

    The devices are those of the catalogue; the resolution suits policies, delays and losses are estimates.
    """
    middle = np.asarray(values["body"].center_of_buoyancy)
    length, _, height = values["body"].size
    nose, under = middle + [0.5 * length, 0.0, 0.0], middle - [0.0, 0.0, 0.5 * height]
    camera = RaySensor(
        device="low_light_camera", position=nose, width=48, rate=10.0, latency=0.1, dropout=0.01
    )
    sonar = RaySensor(
        device="gemini_720is",
        position=nose + [0.0, 0.0, 0.25 * height],
        width=128,
        bins=128,
        rate=5.0,
        latency=0.1,
    )
    altimeter = RaySensor(device="ping", position=under, rate=10.0, latency=0.05)
    if "heave" in values["controlled_axes"]:
        return {"front_camera": camera, "sonar": sonar, "altimeter": altimeter}
    ahead = altimeter.model_copy(update={"orientation": quat_from_euler(0.0, math.radians(60.0), 0.0)})
    return {"sonar": sonar, "altimeter": altimeter, "altimeter_ahead": ahead}


def default_tags(values: Mapping[str, Any]) -> Tags:
    """Return two tags on top of the envelope, placed about the centre of buoyancy, which is the centre of the
    hull."""
    length, width, height = values["body"].size
    x, y, z = values["body"].center_of_buoyancy
    top = float(z + 0.5 * height)
    mounts = {
        tag: TagMount(
            position=np.array([x + side * APART * length, y, top]), orientation=np.array(QUARTER_TURN)
        )
        for tag, side in ((15, 1.0), (16, -1.0))
    }
    return Tags(family="tag25h9", edge=float(min(EDGE[0] * length, EDGE[1] * width)), mounts=mounts)


def with_navigation(vehicle: Vehicle) -> Vehicle:
    """Return the vehicle for open water, with a small Doppler log and a compass if its file defines none.

    The log has the specification of the better hand-sized models (0.1 % of speed, 8 Hz, range 50 m), the
    compass is a magnetic one that was calibrated on site (0.3°).
    """
    dvl = Dvl(
        rate=8.0, position=np.zeros(3), latency=0.06, dropout=0.01, noise_std=0.008, bias_initial=0.0005,
        scale_error=0.001, quantisation=1e-4, velocity_range=3.75, max_tilt=math.radians(35.0), altitude_min=0.05,
        altitude_max=50.0,
    )  # fmt: skip
    compass = Compass(
        rate=20.0,
        position=np.zeros(3),
        latency=0.02,
        noise_std=math.radians(0.4),
        bias_initial=math.radians(0.3),
    )
    sensors = vehicle.sensors
    fitted = sensors.model_copy(update={"dvl": sensors.dvl or dvl, "compass": sensors.compass or compass})
    return vehicle.model_copy(update={"sensors": fitted})


def vehicle_at(site: str, vehicle: Vehicle, *, navigation: bool = False) -> Vehicle:
    """Return the vehicle as equipped for a site: with a workspace of the same size, and in open water with
    Doppler log and compass.

    Args:
        site: A name of `SITES`.
        vehicle: Vehicle as defined by its file.
        navigation: True to add Doppler log and compass at every site, as for a vehicle with an autopilot.

    Raises:
        VehicleError: There is no such site.
    """
    if site not in SITES:
        raise VehicleError(f"unknown site '{site}'; available: {', '.join(SITES)}")
    size = SITES[site]
    if navigation or site == "open-water":
        vehicle = with_navigation(vehicle)
    if size is None:
        return vehicle
    length, width, depth = size
    box = {
        "workspace_lower": np.array([-0.5 * length, -0.5 * width, -depth]),
        "workspace_upper": np.array([0.5 * length, 0.5 * width, 0.0]),
    }
    return vehicle.model_copy(update={"safety": vehicle.safety.model_copy(update=box)})


def numbered(vehicle: Vehicle, number: int) -> Vehicle:
    """Return the vehicle as number `number`, from 0, of several under one camera: its tag ids follow those of
    the previous one."""
    tags = vehicle.tags
    if number == 0 or tags is None:
        return vehicle
    step = max(tags.mounts) - min(tags.mounts) + 1
    mounts = {tag + number * step: mount for tag, mount in tags.mounts.items()}
    return vehicle.model_copy(update={"tags": tags.model_copy(update={"mounts": mounts})})


def default_mcu(values: Mapping[str, Any]) -> Mcu:
    """Return a controller with enough outputs for the motors that the thrusters name, or one per thruster."""
    thrusters = values["thrusters"].values()
    named = [t.motor_index + 1 for t in thrusters if t.motor_index is not None]
    fastest = max((max(t.rpm_max, -t.rpm_min) for t in thrusters), default=1.0)
    return Mcu(rpm_full_scale=fastest, command_timeout=0.5, outputs=max(len(thrusters), *named, 1))


def default_safety(values: Mapping[str, Any]) -> Safety:
    """Return limits by class: for a vehicle that hovers, or one that must move ahead to dive and may
    therefore pitch more."""
    hovers = "heave" in values["controlled_axes"]
    length, width, depth = (room(values["body"].size) * side for side in POOL)
    return Safety(
        command_timeout=0.5,
        telemetry_timeout=0.5,
        state_timeout=0.5,
        command_rate=20.0,
        max_tilt=math.radians(45.0 if hovers else 60.0),
        max_tilt_duration=1.0,
        workspace_lower=np.array([-0.5 * length, -0.5 * width, -depth]),
        workspace_upper=np.array([0.5 * length, 0.5 * width, 0.0]),
    )
