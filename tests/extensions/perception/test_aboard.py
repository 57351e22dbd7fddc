"""Sensors of a vehicle file in virtual worlds: devices with the mounts, rates and sizes of the file's
entries."""

import numpy as np
import pytest

from finssim.core.rotations import quat_rotate
from finssim.extensions.perception import CameraBatch, RangeBatch, SonarBatch, sensor_of
from finssim.vehicles import catalogue, load_vehicle
from finssim.vehicles.device_files import DeviceError, device_of, load_device


@pytest.mark.parametrize("name", catalogue())
def test_every_vehicle_has_an_altimeter_that_looks_down(name):
    """Every altimeter looks down from below the hull, turned by the mount in the device's file."""
    vehicle = load_vehicle(name)
    device = device_of(vehicle, "altimeter")
    np.testing.assert_allclose(
        quat_rotate(device.mount.quaternion, np.array([1.0, 0, 0])), [0, 0, -1], atol=1e-6
    )
    np.testing.assert_array_equal(device.mount.position, vehicle.perception["altimeter"].position)
    assert device.rate == vehicle.perception["altimeter"].rate


def test_an_entry_scales_its_camera_and_its_sonar():
    """An entry scales the width and everything that follows from it; the field of view remains that of the
    device."""
    vehicle, full = load_vehicle("finsrov"), load_device("low_light_camera")
    camera = device_of(vehicle, "front_camera")
    assert (camera.width, camera.height) == (48, 27) and camera.lens().width == 48
    assert camera.focal_length / camera.width == pytest.approx(full.focal_length / full.width)
    sonar = device_of(vehicle, "sonar")
    assert (sonar.beams, sonar.bins, sonar.sector) == (128, 128, load_device("gemini_720is").sector)


@pytest.mark.parametrize(
    ("changes", "name", "message"),
    [
        ({}, "front_cam", "no sensor 'front_cam', did you mean 'front_camera'?"),
        ({"perception.sonar.device": "gemini"}, "sonar", "perception.sonar: device: unknown sensor 'gemini'"),
        ({"perception.altimeter.width": 3}, "altimeter", "ping has no width: remove it"),
        ({"perception.front_camera.bins": 3}, "front_camera", "low_light_camera has no bins: remove it"),
    ],
)
def test_what_is_no_sensor_is_refused(changes, name, message):
    """An entry that is not a sensor is refused in one sentence that names it."""
    vehicle = load_vehicle("finsrov").replace(changes)
    with pytest.raises(DeviceError, match=message.replace("?", r"\?")) as refused:
        device_of(vehicle, name)
    assert "\n" not in str(refused.value)


def test_sensors_stand_where_the_vehicle_carries_them(scenes, poses):
    """At 5 m over a floor 10 m down, the altimeter measures its range from below the hull; all sensors have
    their kind."""
    vehicle, batch = load_vehicle("finsrov"), scenes("floor")
    here = poses(((0.0, 0.0, -5.0), (0.0, 0.0, 0.0, 1.0)))
    altimeter = sensor_of(batch, vehicle, "altimeter")
    assert isinstance(altimeter, RangeBatch)
    expected = 5.0 + vehicle.perception["altimeter"].position[2]
    assert altimeter.update(here).numpy()[0, 0] == pytest.approx(expected, rel=0.01)
    assert isinstance(sensor_of(batch, vehicle, "sonar"), SonarBatch)
    camera = sensor_of(batch, vehicle, "front_camera")
    assert isinstance(camera, CameraBatch) and camera.update(here).shape == (1, 27, 48, 3)
