"""From files to poses: times are kept separate, missing data are reported, and nothing is invented."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from finssim.core.rotations import quat_from_euler, wrap_angle
from finssim.localization import LocalizationError, localize
from finssim.localization.detection.detections import Frame, read_detections, write_detections
from finssim.localization.localize import prior_sources
from finssim.localization.overhead_camera import write_pool
from finssim.vehicles import load_vehicle
from localization.poses.seen_vehicle import POOLS, rotation, seen

LATENCY = 0.05
POOL = replace(POOLS["tilted water"], latency=LATENCY)
PORT = np.array([0.0, 0.0, -0.115])  # finsrov.yaml


def state(t):
    """Return position above the water's plane, and roll, pitch, yaw about its normal, of a manoeuvring vehicle."""
    position = np.array([0.3 * np.sin(0.5 * t), -0.2 + 0.2 * np.cos(0.4 * t), 0.45 + 0.1 * np.sin(0.9 * t)])
    return position, np.array([0.1 * np.sin(2.0 * t), 0.1 * np.cos(1.7 * t), 3.0 + 0.2 * t])


def depth_of(t):
    """Return the reading of its pressure port [m]."""
    position, angles = state(t)
    port = position + rotation(angles, tuple(POOL.interface.normal)) @ PORT
    return -float(POOL.interface.distance(port))


@pytest.fixture
def files(tmp_path):
    """A pool, detections at 5 Hz with stamps delayed by the latency, depth at 20 Hz and IMU at 100 Hz."""
    write_pool(POOL, tmp_path / "pool.yaml")
    up = tuple(POOL.interface.normal)
    frames = [
        Frame(float(t + LATENCY), f"{i:03d}.png", tuple(seen(POOL, *state(t), up=up)))
        for i, t in enumerate(np.arange(0.0, 10.0, 0.2))
    ]
    write_detections(frames, tmp_path / "tags.csv")
    with (tmp_path / "depth.csv").open("w") as file:
        file.write("t,depth\n" + "".join(f"{t:.3f},{depth_of(t):.9f}\n" for t in np.arange(0.0, 9.0, 0.05)))
    with (tmp_path / "imu.csv").open("w") as file:
        file.write("t,qx,qy,qz,qw\n")
        for t in np.arange(-0.5, 10.5, 0.01):
            file.write(f"{t:.3f}," + ",".join(f"{x:.9f}" for x in quat_from_euler(*state(t)[1])) + "\n")
    return tmp_path


def given(files, **options):
    """Return arguments of `run`."""
    tables = {
        name: options.pop(name) for name in ("depth", "imu", "times", "tilt_std_deg") if name in options
    }
    named = {name: options.pop(name) for name in ("pool", "vehicle", "as_json") if name in options}
    return {
        "pool": files / "pool.yaml",
        "vehicle": "finsrov",
        "out": files / "out.csv",
        "tables": localize.ImageTables(**tables),
        "settings": localize.LocalizeSettings(**options),
        **named,
    }


def located(files, **options):
    """Return the rows that `run` wrote, and its JSON."""
    found = localize.run(files / "tags.csv", **given(files, **options))
    with (files / "out.csv").open() as file:
        return found, list(csv.DictReader(file))


def errors(rows):
    """Return the rms distance [m] and rotation [rad] of located pictures from the true pose."""
    off = []
    for row in (row for row in rows if row["status"] == "ok"):
        (x, y, _), angles = state(float(row["time"]) - LATENCY)
        R = rotation(angles, tuple(POOL.interface.normal))
        turn = wrap_angle(float(row["yaw"]) - np.arctan2(R[1, 0], R[0, 0]))
        off.append((np.hypot(float(row["x"]) - x, float(row["y"]) - y), turn))
    return np.sqrt(np.mean(np.square(off), axis=0))


def test_poses_are_those_of_the_exposure(files, capsys):
    """With depth and IMU read at the exposure, not at the stamp, each picture gives the pose to 0.1 mm."""
    found, rows = located(files, depth=files / "depth.csv", imu=files / "imu.csv", as_json=True)
    document = json.loads(capsys.readouterr().out)
    assert document["frames"] == 50
    assert document["located"] == 45  # the depth file ends at 8.95 s
    assert document["refused"] == {"no depth at the exposure": 5}
    distance, turn = errors(rows)
    assert distance < 2e-4 and np.degrees(turn) < 0.02
    assert document["pool"]["sha256"] == POOL.sha256
    assert document["vehicle"]["sha256"] == load_vehicle("finsrov").sha256
    position, angles = state(4.0)
    row = rows[20]
    assert row["status"] == "ok"
    assert row["tags"] == "15 16"
    assert [float(row[k]) for k in "xyz"] == pytest.approx(position, abs=3e-4)
    R = rotation(angles, tuple(POOL.interface.normal))
    assert float(row["yaw"]) == pytest.approx(np.arctan2(R[1, 0], R[0, 0]), abs=1e-3)
    assert rows[-1]["status"] == "refused"
    assert rows[-1]["x"] == ""
    assert "outside the file" in rows[-1]["reason"]
    assert not found.interrupted


def test_reading_at_the_stamp_would_miss(files):
    """Without the latency, depth and tilt belong to another time, and the error grows fourfold."""
    write_pool(replace(POOL, latency=0.0), files / "pool.yaml")
    _, rows = located(files, depth=files / "depth.csv", imu=files / "imu.csv")
    assert errors(rows)[0] > 8e-4


def test_a_constant_depth_needs_no_time(files, capsys):
    """Pictures without time stamps are located with one depth; without IMU a level vehicle is assumed and reported."""
    position, angles = np.array([0.3, -0.2, 0.4]), np.array([0.0, 0.0, 0.5])
    up = tuple(POOL.interface.normal)
    detections = tuple(seen(POOL, position, angles, up=up))
    write_detections([Frame(np.nan, "a.png", detections), Frame(np.nan, "b.png", ())], files / "tags.csv")
    depth = -float(POOL.interface.distance(position + rotation(angles, up) @ PORT))
    _, rows = located(files, depth=str(depth))
    printed = capsys.readouterr().out
    assert "assumed level, within 2.0 degrees" in printed
    assert [float(rows[0][k]) for k in "xyz"] == pytest.approx(position, abs=1e-6)
    assert rows[1]["reason"] == "no tag seen"
    assert float(rows[0]["std_x"]) > 3e-3  # 2 degrees of tilt, and a centimetre of depth error
    _, rows = located(files, depth=files / "depth.csv")
    assert "no time stamp" in rows[0]["reason"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t,temperature\n0,20\n", "no attitude"),
        ("t,roll,pitch\n0,45,90\n", "exceeds a turn"),
        ("t,qx,qy,qz,qw\n0,1,1,1,1\n", "unit length"),
    ],
)
def test_a_wrong_imu_file_is_refused(files, text, words):
    """Degrees, foreign columns and invalid quaternions are each recognised."""
    (files / "imu.csv").write_text(text)
    with pytest.raises(LocalizationError, match=words):
        located(files, depth=0.5, imu=files / "imu.csv")


def test_corners_in_another_order_give_the_same_poses(files):
    """Corners in the order of AprilTag's own library (bottom left first, counter-clockwise) give the same poses."""
    options = {"depth": files / "depth.csv", "imu": files / "imu.csv"}
    _, expected = located(files, **options)
    frames = [
        replace(frame, detections=tuple(replace(d, corners=d.corners[::-1]) for d in frame.detections))
        for frame in read_detections(files / "tags.csv")
    ]
    write_detections(frames, files / "tags.csv")
    found, rows = located(files, **options)
    assert rows == expected and errors(rows)[0] < 0.01
    assert any("corners are read as bottom-left, bottom-right" in note for note in found.summary["notes"])


def test_tags_of_another_family_are_not_ours(files):
    """The same id of another family is refused by name."""
    detections = tuple(replace(d, family="tag36h11") for d in seen(POOL, *state(0.0)))
    write_detections([Frame(0.0, "a.png", detections)], files / "tags.csv")
    _, rows = located(files, depth=0.5)
    assert rows[0]["reason"] == "no tag of family tag25h9 seen: tag36h11"


def test_height_follows_from_pressure_behind_a_wall(tmp_path):
    """Where the plane is a wall, the surface contains the world frame's origin."""
    pool = replace(POOLS["window wall"], world_position=(0.0, 0.0, 1.2))
    known = prior_sources(pool, load_vehicle("finsrov"), depth=0.5, imu=None)
    found = known.at(0.0, needs_height=True)
    assert found.z_b == pytest.approx(1.2 - 0.5 + 0.115)
    assert found.up == (0.0, 0.0, 1.0)
