"""Vehicles: one file each, read, checked and frozen."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.vehicles.actuators import Actuator, ActuatorKind
    from finssim.vehicles.check import CheckResult, check_vehicle
    from finssim.vehicles.device_files import device_of, devices, load_device
    from finssim.vehicles.equipment import DepthSensor, Dvl, Imu, Mcu, Mount, Safety, Sensor, Sensors, Tags
    from finssim.vehicles.hydrodynamics import HydrodynamicSet, MeshSet
    from finssim.vehicles.loader import catalogue, catalogue_vehicle, load_vehicle
    from finssim.vehicles.part import (
        NonNegative,
        Number,
        Part,
        Positive,
        Vector3,
        VehicleError,
        VehicleWarning,
    )
    from finssim.vehicles.thruster import Esc, Thruster
    from finssim.vehicles.vehicle import (
        AXES,
        Body,
        CalibrationRecord,
        Hull,
        Payload,
        Provenance,
        ReferenceWater,
        Vehicle,
    )

__all__ = [
    "AXES",
    "Actuator",
    "ActuatorKind",
    "Body",
    "CalibrationRecord",
    "DepthSensor",
    "Dvl",
    "Esc",
    "CheckResult",
    "Hull",
    "HydrodynamicSet",
    "Imu",
    "Mcu",
    "MeshSet",
    "Mount",
    "NonNegative",
    "Number",
    "Part",
    "Payload",
    "Positive",
    "Provenance",
    "Safety",
    "Sensor",
    "Sensors",
    "Tags",
    "Thruster",
    "Vector3",
    "Vehicle",
    "VehicleError",
    "VehicleWarning",
    "ReferenceWater",
    "catalogue",
    "catalogue_vehicle",
    "check_vehicle",
    "device_of",
    "devices",
    "load_device",
    "load_vehicle",
]

__getattr__, __dir__ = exports(__name__)
