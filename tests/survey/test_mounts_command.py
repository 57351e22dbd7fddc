"""`finssim calibrate mounts` turns a log folder into a vehicle file with the identifiable mounts."""

import json

import numpy as np
import pytest

from finssim.core.rotations import (
    matrix_to_quat,
    quat_conjugate,
    quat_multiply,
    quat_to_matrix,
    quat_to_rotvec,
)
from finssim.identification.vehicle_file import write_vehicle
from finssim.localization.overhead_camera import write_pool
from finssim.survey.mounts import read_mount_log, run
from finssim.trials.findings import CalibrationError
from finssim.vehicles import Provenance, load_vehicle
from survey.moving_vehicle import MOUNTS, POOL, PORT, motion, write_log

FLIP = (0.0, 0.0, 1.0, 0.0)


def degrees_between(a, b):
    return np.degrees(np.linalg.norm(quat_to_rotvec(quat_multiply(a, quat_conjugate(np.asarray(b))))))


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Pool, and FinsROV with the port of the moving vehicle."""
    folder = tmp_path_factory.mktemp("mounts")
    write_pool(POOL, folder / "pool.yaml")
    vehicle = load_vehicle("finsrov").replace(
        {"sensors.depth.position": PORT.tolist()}, Provenance("measured")
    )
    write_vehicle(vehicle, folder / "vehicle.yaml")
    return folder


@pytest.mark.slow
def test_tags_are_written_where_they_are(place, capsys):
    """The file's IMU and port are right; the tags move to their true mounts, with intervals as notes."""
    write_log(place / "rocked", motion(), np.random.default_rng(1))
    after = run(
        place / "rocked",
        pool=place / "pool.yaml",
        vehicle=str(place / "vehicle.yaml"),
        out=place / "tags.yaml",
        report=place / "report",
    )
    for tag, truth in MOUNTS.items():
        mount = after.tags.mounts[tag]
        assert np.linalg.norm(np.asarray(mount.position) - truth.t) < 0.012
        assert degrees_between(np.asarray(mount.orientation), matrix_to_quat(truth.R)) < 1.2
    assert after.origin_of("tags.mounts.15.position.0").note.startswith("95 % interval")
    assert load_vehicle(place / "tags.yaml").sha256 == after.sha256
    assert after.calibrations[-1].kind == "mounts"
    np.testing.assert_array_equal(after.sensors.imu.orientation, FLIP)
    assert (place / "report" / "report.html").is_file()
    assert "tags.16.x" in capsys.readouterr().out


@pytest.mark.slow
def test_the_clock_of_the_imu_is_estimated(place, capsys):
    """50 ms are within the interval, and the tag positions are still right."""
    write_log(place / "late", motion(seconds=30.0), np.random.default_rng(2), clock=0.05)
    after = run(
        place / "late",
        pool=place / "pool.yaml",
        vehicle=str(place / "vehicle.yaml"),
        out=place / "late.yaml",
        as_json=True,
    )
    low, high = json.loads(capsys.readouterr().out)["parameters"]["imu.time_offset"]["ci95"]
    assert low < 0.05 < high
    assert degrees_between(np.asarray(after.tags.mounts[15].orientation), matrix_to_quat(MOUNTS[15].R)) < 1.2


@pytest.mark.slow
def test_a_log_without_sensors_places_tags_to_one_another_alone(place, capsys):
    """With pictures alone the reference tag keeps the file's mount, and the missing data are named."""
    folder = write_log(place / "alone", motion(seconds=30.0), np.random.default_rng(3))
    (folder / "imu.csv").unlink()
    (folder / "depth.csv").unlink()
    after = run(
        folder, pool=place / "pool.yaml", vehicle=str(place / "vehicle.yaml"), out=place / "alone.yaml"
    )
    np.testing.assert_allclose(after.tags.mounts[15].position, [0.07, 0.0, 0.1], atol=1e-9)
    one, two = (quat_to_matrix(after.tags.mounts[tag].orientation) for tag in (15, 16))
    apart = one.T @ (np.asarray(after.tags.mounts[16].position) - np.asarray(after.tags.mounts[15].position))
    np.testing.assert_allclose(apart, MOUNTS[15].inverse.then(MOUNTS[16]).t, atol=2e-3)
    np.testing.assert_allclose(one.T @ two, MOUNTS[15].R.T @ MOUNTS[16].R, atol=0.02)
    printed = " ".join(capsys.readouterr().out.split())
    assert "no imu.csv" in printed and "no depth.csv" in printed


def test_the_tilt_is_made_where_no_attitude_is_logged(place):
    """Computed from gyro and accelerometer, it is within half a degree of the truth once settled."""
    moved = motion()
    folder = write_log(place / "raw", moved, np.random.default_rng(4), attitude=False)
    log = read_mount_log(folder, POOL, load_vehicle(place / "vehicle.yaml"))
    off = [
        np.degrees(np.arccos(np.clip(m.up @ up, -1.0, 1.0)))
        for m, up in zip(log.moments(), moved.up, strict=True)
        if m.up is not None
    ]
    assert len(off) > 200 and np.sqrt(np.mean(np.square(off))) < 0.5
    assert "attitude_made" in {one.code for one in log.findings}


def test_a_log_without_depths_in_its_depth_table_is_refused_and_nothing_is_written(place, tmp_path):
    folder = write_log(tmp_path / "log", motion(seconds=5.0), np.random.default_rng(0))
    (folder / "depth.csv").write_text("t,level\n0,1\n")
    with pytest.raises(CalibrationError, match="no column 'depth'"):
        run(folder, pool=place / "pool.yaml", vehicle="finsrov", out=tmp_path / "out.yaml")
    assert not (tmp_path / "out.yaml").exists()
