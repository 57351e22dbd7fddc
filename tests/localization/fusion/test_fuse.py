"""`finssim fuse` from logs to a table: with real motion capture and IMU recordings, and with exactly known streams."""

import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest

from finssim.core.optics import project
from finssim.core.rotations import quat_conjugate, quat_rotate, quat_to_euler, quat_to_matrix, wrap_angle
from finssim.localization import LocalizationError
from finssim.localization.detection.detections import Detection, Frame, write_detections
from finssim.localization.detection.families import tag_corners_b
from finssim.localization.fusion.estimator import MODELS
from finssim.localization.fusion.fuse import COLUMNS, FuseSettings, error_figures, fuse, run
from finssim.localization.fusion.fuse_log import StreamTable, load_log
from finssim.localization.fusion.fuse_settings import site_of
from finssim.localization.fusion.streams import refusal
from finssim.localization.localize import write_rows as write_localized
from finssim.localization.overhead_camera import load_pool
from finssim.localization.poses import Constraints
from finssim.localization.poses.methods import METHODS
from finssim.vehicles import load_vehicle
from localization.fusion.hinsdale_log import hinsdale, write_table
from localization.fusion.known_streams import SITE, attitude, position, streams, yaw

POOL = """
camera:
  lens: {width: 1280, height: 720, fx: 400, cx: 640, cy: 360}
  position: [0.0, 0.1, 2.6]
  orientation: [1, 0, 0, 0]
  latency: 0.04
interface: {height: 1.0}
"""
FINSROV = load_vehicle("finsrov")
CONSTANT_VELOCITY = FuseSettings(estimator="constant-velocity")


@pytest.fixture
def pool(tmp_path):
    path = tmp_path / "pool.yaml"
    path.write_text(POOL)
    return path


def samples(duration=6.0, **options):
    """Return streams of a FinsROV in that pool, with the IMU at the body origin."""
    site = replace(SITE, imu=(0.0, 0.0, 0.0))
    return streams(duration, site=site, **options)


def write_log(folder, items, *, camera=0.04, names=("p", "q", "r", "ax", "ay", "az")):
    """Write a folder of tables; pictures are stamped `camera` after their exposure."""
    by = {s: [x for x in items if x.stream == s] for s in ("imu", "depth", "vision")}
    tilt = ("roll", "pitch")
    rows = [(s.time, *s.omega, *s.force, *s.tilt) for s in by["imu"]]
    write_table(folder / "imu.csv", ("t", *names, *tilt), rows)
    write_table(folder / "depth.csv", ("t", "depth"), [(s.time, s.depth) for s in by["depth"]])
    fixes = [(s.time + camera, *s.position, s.yaw, 0.01, 0.01, 0.02) for s in by["vision"]]
    write_table(folder / "vision.csv", ("time", "x", "y", "yaw", "std_x", "std_y", "std_yaw"), fixes)
    t = np.arange(0.0, 6.0, 0.02)
    truth = np.column_stack([t, position(t), wrap_angle(yaw(t))])
    write_table(folder / "truth.csv", ("t", "x", "y", "z", "yaw"), truth.tolist())
    return folder


def read_out(path):
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(r[name] or "nan") for r in rows]) for name in COLUMNS if name != "state"}, [
        r["state"] for r in rows
    ]


@pytest.mark.parametrize("mode", list(MODELS))
def test_a_folder_of_tables_becomes_one_table(tmp_path, pool, mode, capsys):
    """The table has 60 rows a second with states, deviations and counts; errors against the truth are centimetres."""
    log = write_log(tmp_path / "log", samples())
    run(log, pool=pool, vehicle="finsrov", out=tmp_path / "out.csv", settings=FuseSettings(estimator=mode))
    columns, states = read_out(tmp_path / "out.csv")
    assert np.diff(columns["t"]) == pytest.approx(1 / 60)
    assert set(states[60:]) == {"fresh"} and states[0] == "uninitialized"
    late = columns["t"] > 1.0
    assert (
        np.hypot(*(columns[n][late] - position(columns["t"][late])[:, i] for i, n in enumerate("xy"))).max()
        < 0.06
    )
    assert columns["n_imu"][-1] == pytest.approx(600, abs=3)
    assert (columns["std_x"][late] < 0.03).all() and columns["ready"][late].all()
    shown = capsys.readouterr().out
    assert "against the truth, fresh" in shown and "NIS per dimension" in shown and "fresh 9" in shown


def test_json_holds_the_summary(tmp_path, pool, capsys):
    """The summary is one object, without NaN, with states, refusals by reason, NIS, errors and the final health."""
    log = write_log(tmp_path / "log", samples(3.0))
    run(log, pool=pool, vehicle="finsrov", out=tmp_path / "out.csv", as_json=True)
    summary = json.loads(capsys.readouterr().out)
    assert sum(summary["states"].values()) == pytest.approx(1.0)
    assert 0.5 < summary["nis_per_dimension"]["vision"] < 1.5
    assert summary["errors"]["fresh"]["rms_x"] < 0.02
    assert summary["health"]["vision_mode"] == "fresh"


def test_one_table_of_all_columns_is_the_same_log(tmp_path, pool):
    """A trial table with empty cells where a stream has no sample gives the same path as the folder."""
    items = samples(3.0)
    folder = write_log(tmp_path / "log", items)
    names = ("t", "p", "q", "r", "ax", "ay", "az", "roll", "pitch", "depth", "x", "y", "yaw")
    rows = []
    for s in items:
        row = dict.fromkeys(names, "")
        row["t"] = s.time + (0.04 if s.stream == "vision" else 0.0)
        if s.stream == "imu":
            row |= dict(zip(names[1:9], (*s.omega, *s.force, *s.tilt), strict=True))
        elif s.stream == "depth":
            row["depth"] = s.depth
        else:
            row |= {"x": s.position[0], "y": s.position[1], "yaw": s.yaw}
        rows.append([row[n] for n in names])
    table = write_table(tmp_path / "all.csv", names, rows)
    site = load_pool(pool)
    logs = [load_log(path, FINSROV, latency=site.latency) for path in (folder, table)]
    counts = [
        {n: sum(s.stream == n for s in log.samples) for n in ("imu", "depth", "vision")} for log in logs
    ]
    assert counts[0] == counts[1]
    a, b = (np.array([row[1:4] for row in fuse(log, site, FINSROV, CONSTANT_VELOCITY).rows]) for log in logs)
    assert np.nanmax(np.abs(a - b)) < 0.05  # the table has no deviations, and the settings' are used


def test_columns_in_the_sensors_axes_are_turned(tmp_path, pool):
    """gyro_x and accel_x of FinsROV's IMU, mounted with x backwards, give the samples of the body's p and ax."""
    q = FINSROV.sensors.imu.orientation
    items = samples(1.0)
    turned = [
        replace(
            s,
            omega=tuple(quat_rotate(quat_conjugate(q), s.omega)),
            force=tuple(quat_rotate(quat_conjugate(q), s.force)),
        )
        if s.stream == "imu"
        else s
        for s in items
    ]
    names = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
    body = load_log(write_log(tmp_path / "body", items), FINSROV)
    folder = write_log(tmp_path / "sensor", turned, names=names)
    # Roll and pitch are in the sensor's axes too: half a turn about z negates both.
    text = [row.split(",") for row in (folder / "imu.csv").read_text().split()]
    flipped = [[*r[:7], str(-float(r[7])), str(-float(r[8]))] for r in text[1:]]
    write_table(folder / "imu.csv", text[0], flipped)
    sensor = load_log(folder, FINSROV)
    for a, b in zip(
        [s for s in body.samples if s.stream == "imu"],
        [s for s in sensor.samples if s.stream == "imu"],
        strict=True,
    ):
        np.testing.assert_allclose(b.omega, a.omega, atol=1e-12)
        np.testing.assert_allclose(b.force, a.force, atol=1e-12)
        np.testing.assert_allclose(b.tilt, a.tilt, atol=1e-9)


def test_rows_rest_on_what_had_arrived(tmp_path, pool):
    """Rows up to a time do not change when all later samples are removed."""
    site = load_pool(pool)
    log = load_log(write_log(tmp_path / "log", samples(4.0)), FINSROV, latency=site.latency)
    whole = fuse(log, site, FINSROV, CONSTANT_VELOCITY).rows
    log.samples = [s for s in log.samples if s.arrival <= 2.5]
    cut = fuse(log, site, FINSROV, CONSTANT_VELOCITY).rows
    for a, b in zip(whole, cut, strict=False):
        np.testing.assert_array_equal(np.array(a[:11], float), np.array(b[:11], float))
    assert len(cut) > 140


def write_pictures(folder, items, site):
    """Write the vehicle's tags as seen by the camera through the water, 15 times a second, instead of fixes."""
    tags, frames = tag_corners_b(FINSROV.tags), []
    rng = np.random.default_rng(0)
    for s in [s for s in items if s.stream == "vision"][::2]:
        found = []
        for tag, corners in tags.items():
            seen = project(
                site.camera, site.interface, corners @ quat_to_matrix(attitude(s.time)).T + position(s.time)
            )
            if (seen.status == 0).all():
                found.append(Detection(tag, seen.pixels + 0.2 * rng.standard_normal((4, 2))))
        frames.append(Frame(s.time + site.latency, f"{len(frames)}.png", tuple(found)))
    (folder / "vision.csv").unlink()
    write_detections(frames, folder / "detections.csv")
    return frames


@pytest.mark.parametrize("mode", list(MODELS))
def test_detections_become_fixes_with_depth_and_tilt_of_their_exposure(tmp_path, pool, mode):
    """Corners through refracting water give the path to 2 cm, each fix with a correct uncertainty."""
    site, items = load_pool(pool), samples(6.0)
    folder = write_log(tmp_path / "log", items)
    frames = write_pictures(folder, items, site)
    settings = FuseSettings(pixel_std=0.2, estimator=mode)
    found = fuse(load_log(folder, FINSROV, latency=site.latency), site, FINSROV, settings)
    summary = found.summary
    assert summary["accepted"]["vision"] > 0.9 * len(frames)
    assert summary["errors"]["fresh"]["p95_horizontal"] < 0.03
    assert summary["errors"]["fresh"]["rms_yaw"] < math.radians(1.0)


def test_the_table_of_localize_is_read_with_its_covariances_and_refusals(tmp_path, pool):
    """`finssim localize` writes a full covariance for each fix, and refused pictures are counted by reason."""
    site, items = load_pool(pool), samples(3.0)
    folder = write_log(tmp_path / "log", items)
    pictures, constraints = write_pictures(folder, items, site), Constraints(z_b=0.0)
    found = []
    for k, frame in enumerate(pictures):
        s = next(s for s in items if s.stream == "vision" and abs(s.time + site.latency - frame.time) < 1e-9)
        roll, pitch, _ = quat_to_euler(attitude(s.time))
        known = replace(constraints, z_b=float(position(s.time)[2]), roll=float(roll), pitch=float(pitch))
        tags = frame.detections if k % 5 else ()
        found.append((frame, METHODS["refractive"](tags, site, tag_corners_b(FINSROV.tags), known, 0.2)))
    (folder / "detections.csv").unlink()
    write_localized(found, folder / "vision.csv")
    log = load_log(folder, FINSROV, latency=site.latency)
    fixes = [s for s in log.samples if s.stream == "vision"]
    located = [m for _, m in found if m.ok]
    for fix, m in zip(fixes, located, strict=True):
        np.testing.assert_allclose(fix.covariance, m.covariance, rtol=1e-6, atol=1e-15)
    summary = fuse(log, site, FINSROV, CONSTANT_VELOCITY).summary
    assert sum(summary["refused"]["vision"].values()) >= len(found) - len(located) >= len(found) // 5
    assert summary["errors"]["fresh"]["p95_horizontal"] < 0.03


def still_pool(pool):
    """The pool without latency: stamps of the motion capture are used unchanged."""
    return replace(load_pool(pool), latency=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("trial", ["traj005-1", "traj026-0", "traj_alt_009-0"])
def test_a_real_gyro_carries_a_heading_seen_once_a_second(trial, tmp_path, pool):
    """A BlueROV2's gyro at 20 Hz with mocap heading at 1 Hz is within 1.0 degree rms of the full rate.

    These trials are clean: the markers are never lost for more than 0.13 s and the heading never jumps by 2.5 degrees.
    No stream is shifted in time; by their rates of roll and pitch the clocks agree to 0.02 s.
    """
    folder, t, heading = hinsdale(tmp_path / trial, trial)
    assert np.diff(t).max() < 0.13
    assert np.abs(wrap_angle(np.diff(heading))).max() < math.radians(2.5)
    found = fuse(
        load_log(folder, FINSROV),
        still_pool(pool),
        FINSROV,
        FuseSettings(rate=100.0, estimator="constant-velocity"),
    )
    assert found.summary["errors"]["all"]["rms_yaw"] < math.radians(1.0)
    assert found.summary["refused"].get("yaw") is None
    assert found.summary["nis_per_dimension"]["yaw"] < 1.5


@pytest.mark.slow
def test_a_real_flip_is_refused(tmp_path, pool):
    """In `baseline2`, around 33.6 s the mocap is flipped for some frames, by 160 degrees. All of them are refused."""
    folder, t, heading = hinsdale(tmp_path / "b", "baseline2", every=None)
    log = load_log(folder, FINSROV)
    log.samples = [s for s in log.samples if s.time < 35.5]
    found = fuse(log, still_pool(pool), FINSROV, FuseSettings(rate=100.0, estimator="constant-velocity"))
    here = (t > 32.0) & (t < 35.5)
    flipped = np.abs(wrap_angle(heading - np.median(heading[here]))) > 0.5
    assert 1 <= np.sum(flipped & here) < 10
    refused = found.summary["refused"]["yaw"]["gate"]
    assert refused >= np.sum(flipped & here)
    assert "yaw" not in found.summary["reacquired"]
    rows = np.array([[row[0], row[9]] for row in found.rows], float)
    near = (rows[:, 0] > 32.9) & (rows[:, 0] < 34.5)
    steady = (t > 32.0) & (t < 35.5) & ~flipped
    expected = np.interp(rows[near, 0], t[steady], np.unwrap(heading[steady]))
    assert np.abs(wrap_angle(rows[near, 1] - expected)).max() < math.radians(1.5)


def test_missing_stretches_of_the_imu_cost_doubt_not_the_heading(tmp_path, pool):
    """In a gap of 1.5 s in the gyro, the deviation of yaw grows, and the next fix reduces it again."""
    items = [s for s in samples(6.0) if not (s.stream == "imu" and 3.0 < s.time < 4.5)]
    items = [s for s in items if not (s.stream == "vision" and 3.0 < s.time < 4.6)]
    site = load_pool(pool)
    log = load_log(write_log(tmp_path / "log", items), FINSROV, latency=site.latency)
    rows = np.array(
        [[row[0], row[9], row[17]] for row in fuse(log, site, FINSROV, CONSTANT_VELOCITY).rows], float
    )
    std = {t: rows[np.argmin(np.abs(rows[:, 0] - t)), 2] for t in (2.9, 4.4, 5.0)}
    assert std[4.4] > 10 * std[2.9] and std[5.0] < 0.5 * std[4.4]
    late = rows[:, 0] > 5.0
    assert np.abs(wrap_angle(rows[late, 1] - yaw(rows[late, 0]))).max() < math.radians(3.0)


def test_a_slow_stream_written_into_every_row_is_thinned(tmp_path, pool):
    """Depth repeated in a fast table counts once, which is reported."""
    rows = [(0.01 * k, 0.0, 0.0, 0.0, 0.5 + 0.001 * (k // 10)) for k in range(100)]
    log = load_log(write_table(tmp_path / "all.csv", ("t", "p", "q", "r", "depth"), rows), FINSROV)
    assert sum(s.stream == "depth" for s in log.samples) == 10
    assert "90 of 100 rows repeat" in log.notes[0]


@pytest.mark.parametrize(
    ("write", "sentence"),
    [
        (
            lambda d: write_table(d / "depth.csv", ("t", "pressure"), [(0, 1)]),
            "expected the columns t, depth",
        ),
        (
            lambda d: write_table(d / "depth.csv", ("a", "b"), [(0, 1)]),
            "expected a line of different column names",
        ),
        (lambda d: write_table(d / "depth.csv", ("t", "depth"), []), "holds no rows"),
        (
            lambda d: write_table(d / "imu.csv", ("t", "p", "q"), [(0, 1, 1)]),
            "expected the columns t, p, q, r",
        ),
        (lambda d: write_table(d / "depth.csv", ("t", "depth"), [(0, 1), (1e9, 1)]), "is a stamp wrong"),
        (
            lambda d: write_table(d / "imu.csv", ("t", "p", "q", "r"), [(20 * k, 0, 0, 1) for k in range(9)]),
            "rates of turn come every 20 s, expected at most 2 s: are its times in seconds",
        ),
    ],
    ids=["wrong column", "no time", "no rows", "no rate", "two clocks", "milliseconds"],
)
def test_logs_that_cannot_be_used_are_refused_in_a_sentence(tmp_path, pool, write, sentence):
    """The sentence states the problem, its position, and the expected form."""
    write(tmp_path / "log")
    with pytest.raises(LocalizationError, match=sentence):
        run(tmp_path / "log", pool=pool, vehicle="finsrov", out=tmp_path / "out.csv")
    assert not (tmp_path / "out.csv").exists()


def test_a_log_of_the_camera_alone_gives_place_and_heading(tmp_path, pool):
    """Without IMU and depth nothing is refused, the missing streams are reported, and the state is never ready."""
    folder = write_log(tmp_path / "log", samples(4.0))
    (folder / "imu.csv").unlink()
    (folder / "depth.csv").unlink()
    site = load_pool(pool)
    log = load_log(folder, FINSROV, latency=site.latency)
    assert [note.split(":")[0] for note in log.notes] == ["no IMU samples", "no depth samples"]
    summary = fuse(log, site, FINSROV, CONSTANT_VELOCITY).summary
    assert summary["errors"]["fresh"]["p95_horizontal"] < 0.04
    assert summary["errors"]["fresh"]["rms_yaw"] < math.radians(2.0)
    assert summary["ready"] == 0.0


@pytest.mark.parametrize("std", [0.0, -0.01])
def test_a_fix_that_is_exact_or_better_is_refused(tmp_path, std):
    """A fix with a deviation of zero or below is refused."""
    names = ("t", "x", "y", "yaw", "std_x", "std_y", "std_yaw")
    path = write_table(tmp_path / "log" / "vision.csv", names, [(0, 1, 1, 0, std, 0.1, 0.1)])
    (fix,) = load_log(path.parent, FINSROV).samples
    assert refusal(fix) == "covariance not positive"


def test_acceleration_without_gravity_is_no_specific_force(tmp_path, pool):
    """Such columns are ignored, which is reported, and the error-state mode then names the data it needs."""
    items = [replace(s, force=(0.1, 0.0, 0.2)) if s.stream == "imu" else s for s in samples(0.5)]
    log = load_log(write_log(tmp_path / "log", items), FINSROV)
    assert any("hold no gravity" in note for note in log.notes)
    with pytest.raises(LocalizationError, match="needs accelerations with gravity"):
        fuse(log, load_pool(pool), FINSROV, FuseSettings(estimator="error-state"))


def test_a_pool_with_z_down_is_refused(tmp_path, pool):
    """A pool with z down is refused, since heading and depth are fused about a z that points up."""
    pool.write_text(POOL.replace("{height: 1.0}", "{normal: [0, 0, -1], point: [0, 0, 0.2]}"))
    with pytest.raises(LocalizationError, match="survey the pool with z up"):
        site_of(replace(load_pool(pool), world_orientation=(1.0, 0.0, 0.0, 0.0)), FINSROV)


def test_errors_against_the_truth_are_those_of_each_column():
    """Rows are off by 1, 2 and 3 cm and 0.04 rad, with velocities that must not be mistaken for positions."""
    t = np.arange(0.0, 2.0, 0.1)
    rows = []
    for time in t:
        row = [0.0] * len(COLUMNS)
        row[0], row[1:4], row[4:7], row[9] = time, [0.01, 0.02, -0.97], [5.0, 6.0, 7.0], 0.04
        row[COLUMNS.index("state")] = "fresh"
        rows.append(row)
    numbers = {"x": 0.0 * t, "y": 0.0 * t, "z": 0.0 * t - 1.0, "yaw": 0.0 * t}
    figures = error_figures(rows, StreamTable("truth", t, numbers, {}))["fresh"]
    found = [figures[f"rms_{name}"] for name in ("x", "y", "z", "yaw")]
    assert found == pytest.approx([0.01, 0.02, 0.03, 0.04])
    assert figures["p95_horizontal"] == pytest.approx(math.hypot(0.01, 0.02))
