"""`finssim localize`, `fuse`, `project` and `backproject`, as a user types them: every option, every refusal."""

import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest

from finssim.core.optics import project
from finssim.core.rotations import (
    matrix_to_quat,
    quat_conjugate,
    quat_multiply,
    quat_rotate,
    quat_to_euler,
    quat_to_matrix,
    wrap_angle,
)
from finssim.localization.detection.detections import Detection, Frame, write_detections
from finssim.localization.detection.families import bitmap, tag_corners_b
from finssim.localization.detection.pictures import write_picture
from finssim.localization.overhead_camera import load_pool, write_pool
from finssim.localization.poses.methods import METHODS, NEEDS_DEPTH
from finssim.sim.overhead_camera import ImageSensor, ObjectPose, OverheadCamera, Scene, TagInScene, TiledBasin
from finssim.vehicles import load_vehicle
from localization.fusion.known_streams import SITE, attitude, position, streams
from reference.commands import finssim, refusal

FINSROV = load_vehicle("finsrov")
POOL = """
camera:
  lens: {width: 1280, height: 720, fx: 800, cx: 640, cy: 360}
  position: [0.0, 0.1, 2.6]
  orientation: [1, 0, 0, 0]
  latency: 0.04
interface: {height: 1.0}
"""
LATENCY, SECONDS = 0.04, 3.0
TIMES = np.arange(0.2, 2.8, 0.2)


def table(path):
    """Return the rows of a table as columns by name."""
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write_csv(path, names, rows):
    """Write a table."""
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([names, *rows])


def seen_at(pool, t, rng=None):
    """Return the camera's view of the vehicle's tags at a time, with 0.2 px of noise if a generator is given."""
    found = []
    for tag, corners in tag_corners_b(FINSROV.tags).items():
        points = corners @ quat_to_matrix(attitude(t)).T + position(t)
        pixels = project(pool.camera, pool.interface, points).pixels
        noise = 0.0 if rng is None else 0.2 * rng.standard_normal((4, 2))
        found.append(Detection(tag, pixels + noise, 60.0, 0, "tag25h9"))
    return tuple(found)


def write_sensors(folder, items, *, turned=None):
    """Write imu.csv and depth.csv of streams; IMU columns are in the axes of a mount, if one is given."""
    q = np.array([0.0, 0.0, 0.0, 1.0]) if turned is None else quat_conjugate(turned)
    rows = []
    for s in (s for s in items if s.stream == "imu"):
        tilt = s.tilt
        if turned is not None:
            tilt = quat_to_euler(quat_multiply(attitude(s.time), turned))[:2]
        rows.append([s.time, *quat_rotate(q, s.omega), *quat_rotate(q, s.force), *tilt])
    write_csv(folder / "imu.csv", ("t", "p", "q", "r", "ax", "ay", "az", "roll", "pitch"), rows)
    depths = [(s.time, s.depth) for s in items if s.stream == "depth"]
    write_csv(folder / "depth.csv", ("t", "depth"), depths)


@pytest.fixture(scope="session")
def files(tmp_path_factory):
    """A pool, recordings of a camera, an IMU and a depth sensor of a FinsROV in it, and the true path."""
    folder = tmp_path_factory.mktemp("localization")
    (folder / "pool.yaml").write_text(POOL)
    pool, rng = load_pool(folder / "pool.yaml"), np.random.default_rng(0)
    log = folder / "log"
    log.mkdir()
    items = streams(SECONDS, site=replace(SITE, imu=(0.0, 0.0, 0.0)))
    write_sensors(log, items)
    fine = [
        Frame(float(t + LATENCY), f"{t:.3f}.png", seen_at(pool, t, rng)) for t in np.arange(0.1, 2.9, 0.1)
    ]
    write_detections(fine, log / "detections.csv")
    t = np.arange(0.0, SECONDS, 0.02)
    yaw = quat_to_euler(attitude(t))[2]
    write_csv(log / "truth.csv", ("t", "x", "y", "z", "yaw"), np.column_stack([t, position(t), yaw]).tolist())
    frames = [Frame(float(t + LATENCY), f"{i:03d}.png", seen_at(pool, t)) for i, t in enumerate(TIMES)]
    write_detections(frames, folder / "tags.csv")
    exact(folder, frames)
    return folder


def exact(folder, frames):
    """Write depth, tilt and truth without error."""
    t = np.arange(0.0, SECONDS, 0.01)
    port = position(t) + quat_rotate(attitude(t), np.array([0.0, 0.0, -0.115]))
    write_csv(folder / "depth.csv", ("t", "depth"), np.column_stack([t, 1.0 - port[:, 2]]).tolist())
    roll, pitch, _ = quat_to_euler(attitude(t))
    write_csv(folder / "imu.csv", ("t", "roll", "pitch"), np.column_stack([t, roll, pitch]).tolist())
    truth = [
        (f.image, *position(t)[:2], np.degrees(quat_to_euler(attitude(t))[2]))
        for f, t in zip(frames, TIMES, strict=True)
    ]
    write_csv(folder / "truth.csv", ("image", "x", "y", "yaw_deg"), truth)


@pytest.fixture(scope="session")
def seen(files):
    """Two pictures and a video of four, rendered through the water, and the depth of the vehicle in them."""
    cv2 = pytest.importorskip("cv2")
    pytest.importorskip("pupil_apriltags")
    pool = load_pool(files / "pool.yaml")
    basin = TiledBasin(lower=(-2.0, -1.5, -0.02), upper=(2.0, 1.5, 1.1))
    camera = OverheadCamera(
        Scene(camera=pool.camera, interface=pool.interface, basin=basin, sensor=ImageSensor())
    )
    folder = files / "seen"
    (folder / "pictures").mkdir(parents=True)
    way = [np.array([0.1 + 0.04 * i, -0.1, 0.5]) for i in range(4)]
    drawn = [camera.render(tags=tags_at(p), time=0.1 * i, seed=i) for i, p in enumerate(way)]
    for name, image in zip(("left.png", "right.png"), drawn, strict=False):
        write_picture(image, folder / "pictures" / name)
    write_picture(drawn[0][:100], folder / "small.png")
    film = cv2.VideoWriter(
        str(folder / "dive.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (1280, 720), isColor=False
    )
    for image in drawn:
        film.write(image)
    film.release()
    write_csv(folder / "times.csv", ("image", "time"), [("left.png", 4.5), ("right.png", 4.625)])
    write_csv(
        folder / "truth.csv",
        ("image", "x", "y", "yaw"),
        [(name, *p[:2], 0.0) for name, p in zip(("left.png", "right.png"), way, strict=False)],
    )
    return folder


DEPTH_SEEN = 1.0 - 0.5 + 0.115


def tags_at(where):
    """Return the vehicle's tags in the scene, with the vehicle level and heading along x."""
    tags = []
    for tag, mount in FINSROV.tags.mounts.items():
        q = matrix_to_quat(quat_to_matrix(mount.orientation)).tolist()
        x, y, z = (where + np.asarray(mount.position)).tolist()
        cells = bitmap(FINSROV.tags.family, tag).astype(bool)
        tags.append(
            TagInScene(
                bitmap=cells,
                edge=FINSROV.tags.edge,
                margin=0.02,
                pose=ObjectPose(position=(x, y, z), orientation=tuple(q)),
            )
        )
    return tuple(tags)


LOCALIZE = ["--pool", "pool.yaml", "--vehicle", "finsrov"]
KNOWN = ["--depth", "depth.csv", "--imu", "imu.csv"]


def localized(files, tmp_path, *words, inputs=("tags.csv",), known=KNOWN, name="out.csv"):
    """Return the rows of the table that `finssim localize` writes, run in the folder of the files."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(files)
        assert finssim("localize", *inputs, *LOCALIZE, *known, "--out", tmp_path / name, *words) == 0
    return table(tmp_path / name)


def column(rows, name):
    """Return a column of numbers, with NaN for empty cells."""
    return np.array([float(row[name] or "nan") for row in rows])


def test_localize_finds_the_vehicle(files, tmp_path, capsys):
    """Exact corners, depth and tilt locate the vehicle within 0.2 mm and a hundredth of a degree of the truth."""
    rows = localized(files, tmp_path)
    out, err = capsys.readouterr()
    assert err == "" and f"written: {tmp_path / 'out.csv'}" in out
    assert "13 of 13 pictures located with method refractive" in out
    assert {row["status"] for row in rows} == {"ok"} and {row["tags"] for row in rows} == {"15 16"}
    found = np.stack([column(rows, axis) for axis in "xyz"], axis=1)
    assert np.abs(found - position(TIMES)).max() < 2e-4
    assert np.abs(wrap_angle(column(rows, "yaw") - quat_to_euler(attitude(TIMES))[2])).max() < 2e-4
    assert [path.name for path in tmp_path.iterdir()] == ["out.csv"]


DEPTH_ERROR = np.hypot(FINSROV.sensors.depth.noise_std, FINSROV.sensors.depth.bias_initial)
"""Depth error of FinsROV's pressure sensor [m]."""


def test_localize_as_json(files, tmp_path, capsys):
    """`--json` prints one object with its keys, including the settings that were used, and writes no table."""
    words = ["--pixel-std", "0.25", "--shared-pixel-std", "0.125", "--json"]
    localized(files, tmp_path, *words, "--tilt-std-deg", "0.75")
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert err == "" and found["frames"] == found["located"] == 13
    assert found.keys() >= {
        *(
            "method",
            "refused",
            "corners_rejected",
            "median_residual_px",
            "median_std_m",
            "median_std_yaw_deg",
        ),
        *("assumed", "notes", "out", "interrupted", "pool", "vehicle", "settings", "provenance"),
    }
    assert found["settings"] == {
        "depth": "depth.csv",
        "imu": "imu.csv",
        "pixel_std": 0.25,
        "depth_std": pytest.approx(DEPTH_ERROR),
        "tilt_std_deg": pytest.approx(0.75),
        "shared_pixel_std": 0.125,
    }
    assert found["pool"]["sha256"] == load_pool(files / "pool.yaml").sha256
    assert found["vehicle"]["sha256"] == FINSROV.sha256 and found["out"] == str(tmp_path / "out.csv")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "larger"),
    [
        (["--pixel-std", "2"], ("std_x", "std_y", "std_yaw")),
        (["--shared-pixel-std", "2"], ("std_x", "std_y")),
        (["--tilt-std-deg", "5"], ("std_x", "std_y")),
    ],
)
def test_localize_believes_the_errors_that_it_is_told(files, tmp_path, words, larger):
    """The standard deviations that the option affects grow in every row by more than a tenth."""
    plain = localized(files, tmp_path, name="a.csv")
    rows = localized(files, tmp_path, *words, name="b.csv")
    for name in larger:
        assert (column(rows, name) > 1.1 * column(plain, name)).all(), name


def test_localize_takes_one_depth_for_all(files, tmp_path, capsys):
    """A number replaces the depth table: each row has that depth of the port, without time."""
    rows = localized(files, tmp_path, known=["--depth", "0.6", "--imu", "imu.csv"])
    port = column(rows, "z") - 0.115 * np.cos(column(rows, "roll")) * np.cos(column(rows, "pitch"))
    np.testing.assert_allclose(1.0 - port, 0.6, atol=2e-3)


def test_localize_reads_the_tilt(files, tmp_path, capsys):
    """Without --imu the command reports that it assumes a level vehicle, and its tags' positions are off by
    centimetres."""
    with_it = localized(files, tmp_path, name="a.csv")
    without = localized(files, tmp_path, known=["--depth", "depth.csv"], name="b.csv")
    assert "assumed level, within 2.0 degrees" in capsys.readouterr().out
    np.testing.assert_allclose(column(with_it, "roll"), quat_to_euler(attitude(TIMES))[0], atol=1e-3)
    assert (column(without, "roll") == 0.0).all()
    assert np.abs(column(without, "x") - position(TIMES)[:, 0]).max() > 2e-3
    assert (column(without, "std_x") > 1.2 * column(with_it, "std_x")).all()


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_localize_takes_the_method(files, tmp_path, capsys, method):
    """Each method is reported by its name; those that need no depth work without it."""
    known = KNOWN if method in NEEDS_DEPTH else []
    rows = localized(files, tmp_path, "--method", method, "--json", known=known)
    found = json.loads(capsys.readouterr().out)
    assert found["method"] == method and found["located"] > 8
    ok = np.array([row["status"] == "ok" for row in rows])
    assert all(fine == bool(row["x"]) == (not row["reason"]) for fine, row in zip(ok, rows, strict=True))
    far = np.hypot(*(np.stack([column(rows, a) for a in "xy"]) - position(TIMES)[:, :2].T))[ok]
    refractive = method.startswith("refractive")
    assert far.max() < 1e-3 if refractive else far.max() > 1e-3


def test_localize_does_not_interpolate_over_a_long_gap(files, tmp_path, capsys):
    """With depth only at 0.05 and 2.9 s, the rows between are refused with a reason."""
    write_csv(tmp_path / "depth.csv", ("t", "depth"), [(0.05, 0.6), (2.9, 0.6)])
    known = ["--depth", tmp_path / "depth.csv", "--imu", "imu.csv"]
    rows = localized(files, tmp_path, known=known)
    assert {row["status"] for row in rows} == {"refused"} and "apart" in rows[0]["reason"]
    assert "refused    13: no depth at the exposure" in capsys.readouterr().out


def test_localize_uses_pool_and_vehicle(files, tmp_path):
    """A water level 10 cm higher changes the vehicle's position, and so does a tag mounted elsewhere."""
    from finssim.identification.vehicle_file import write_vehicle
    from finssim.vehicles import Provenance

    higher = tmp_path / "higher.yaml"
    higher.write_text(POOL.replace("height: 1.0", "height: 1.1"))
    moved = FINSROV.replace({"tags.mounts.15.position.0": 0.17}, Provenance("measured"))
    write_vehicle(moved, tmp_path / "moved.yaml")
    plain = localized(files, tmp_path, name="a.csv")
    for words in (["--pool", higher], ["--vehicle", tmp_path / "moved.yaml"]):
        rows = localized(files, tmp_path, *words, name="b.csv")
        off = np.hypot(column(rows, "x") - column(plain, "x"), column(rows, "y") - column(plain, "y"))
        assert (off[np.isfinite(off)] > 1e-3).all()


SEEN = {"inputs": ("seen/pictures",), "known": ["--depth", str(DEPTH_SEEN)]}


@pytest.mark.slow
def test_localize_looks_at_pictures(files, seen, tmp_path, capsys):
    """Pictures rendered through the water locate the vehicle to 1 cm; times come from the table, or are absent."""
    rows = localized(files, tmp_path, **SEEN)
    for row, true in zip(rows, table(files / "seen" / "truth.csv"), strict=True):
        assert row["image"] == true["image"]
        assert np.hypot(*(float(row[a]) - float(true[a]) for a in "xy")) < 0.014
    assert [row["image"] for row in rows] == ["left.png", "right.png"]
    assert [row["time"] for row in rows] == ["", ""]
    rows = localized(files, tmp_path, "--times", "seen/times.csv", **SEEN)
    assert [float(row["time"]) for row in rows] == [4.5, 4.625]


@pytest.mark.slow
@pytest.mark.parametrize("words", [["--refine", "edges"], ["--gamma", "2.2"]])
def test_localize_places_corners_as_it_is_told(files, seen, tmp_path, words):
    """Another refinement or encoding gives other corners of the same tags, within 3 cm."""
    plain = localized(files, tmp_path, name="a.csv", **SEEN)
    rows = localized(files, tmp_path, *words, name="b.csv", **SEEN)
    off = np.hypot(column(rows, "x") - column(plain, "x"), column(rows, "y") - column(plain, "y"))
    assert (off > 1e-6).all() and (off < 0.03).all()


def test_localize_looks_at_a_video(files, seen, tmp_path):
    """Every frame has a name, a time and a position."""
    rows = localized(files, tmp_path, inputs=("seen/dive.avi",), known=["--depth", str(DEPTH_SEEN)])
    assert [row["image"] for row in rows] == [f"dive.avi#{i}" for i in range(4)]
    np.testing.assert_allclose(np.diff(column(rows, "time")), 0.1, atol=1e-3)
    np.testing.assert_allclose(column(rows, "x"), [0.1, 0.14, 0.18, 0.22], atol=0.015)


NO_DEPTH = ["localize", "tags.csv", *LOCALIZE, "--out", "OUT"]
PLAIN = [*NO_DEPTH, "--depth", "0.5"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (NO_DEPTH, "method refractive needs --depth FILE"),
        ([*NO_DEPTH, "--method", "pinhole-depth"], "method pinhole-depth needs --depth"),
        ([*PLAIN, "--method", "snell"], "unknown method 'snell'; available: refractive"),
        ([*PLAIN, "--vehicle", "finrov"], "did you mean 'finsrov'"),
        ([*PLAIN, "--vehicle", "bluerov2"], "has no tags: add a section tags"),
        ([*PLAIN, "--pool", "nowhere.yaml"], "nowhere.yaml"),
        ([*PLAIN, "--pool", "tags.csv"], "tags.csv"),
        ([*PLAIN, "--imu", "nowhere.csv"], "nowhere.csv: cannot be read"),
        ([*PLAIN, "--imu", "depth.csv"], "depth.csv: no attitude"),
        ([*PLAIN, "--pixel-std", "0"], "pixel_std is 0.0"),
        ([*PLAIN, "--pixel-std", "much"], "Invalid value for '--pixel-std'"),
        ([*PLAIN, "--shared-pixel-std", "-1"], "shared_pixel_std is -1"),
        ([*PLAIN, "--tilt-std-deg", "-1"], "tilt_std is"),
        ([*NO_DEPTH, "--depth", "nowhere.csv"], "nowhere.csv: cannot be read"),
        ([*NO_DEPTH, "--depth", "imu.csv"], "imu.csv: no column 'depth'"),
        ([*NO_DEPTH, "--depth", "nan"], "depth is nan"),
        ([*PLAIN, "--out", "/proc/x/out.csv"], "write elsewhere"),
        (["localize", "nowhere.csv", *PLAIN[2:]], "nowhere.csv: cannot be read"),
        (["localize", "nowhere.png", *PLAIN[2:]], "nowhere.png: there is no such file or folder"),
        (["localize", "depth.csv", *PLAIN[2:]], "depth.csv: no column 'tag'"),
        (["localize", "pool.yaml", *PLAIN[2:]], "pool.yaml: expected a picture"),
        (["localize", "tags.csv", "seen/dive.avi", *PLAIN[2:]], "mixed"),
        (["localize", "seen/small.png", *PLAIN[2:]], "1280 x 100 pixels, expected 1280 x 720"),
        (["localize", "seen/dive.avi", *PLAIN[2:], "--refine", "guess"], "unknown refinement 'guess'"),
        (["localize", "seen/dive.avi", *PLAIN[2:], "--gamma", "50"], "gamma is 50"),
        (["localize", "seen/pictures", *PLAIN[2:], "--times", "nowhere.csv"], "nowhere.csv: cannot be read"),
        (["localize", "seen/pictures", *PLAIN[2:], "--times", "depth.csv"], "expected a first line 'image,time'"),
        (["localize"], "Missing argument 'INPUT'"),
        (["localize", "tags.csv"], "Missing option '--pool'"),
        (["localize", "tags.csv", "--pool", "pool.yaml", "--out", "OUT"], "Missing option '--vehicle'"),
        (["localize", "tags.csv", *LOCALIZE], "Missing option '--out'"),
    ],
)  # fmt: skip
def test_localize_refuses_in_a_sentence(files, seen, tmp_path, capsys, monkeypatch, words, sentence):
    """Each request is refused in a sentence, and nothing is written."""
    monkeypatch.chdir(files)
    given = [tmp_path / "out.csv" if word == "OUT" else word for word in words]
    assert sentence in refusal(capsys, *given)
    assert list(tmp_path.iterdir()) == []


def test_a_wrong_row_is_named_by_file_and_line(files, tmp_path, capsys, monkeypatch):
    """A wrong row is named by file and line, and an earlier output table is kept."""
    monkeypatch.chdir(files)
    lines = (files / "tags.csv").read_text().splitlines()
    lines[3] = lines[3].replace(lines[3].split(",")[3], "left", 1)
    (tmp_path / "wrong.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "out.csv").write_text("before")
    words = ["localize", tmp_path / "wrong.csv", *LOCALIZE, *KNOWN, "--out", tmp_path / "out.csv"]
    assert "wrong.csv: line 4: u0 is 'left', expected a finite number" in refusal(capsys, *words)
    assert (tmp_path / "out.csv").read_text() == "before"


FUSE = ["--pool", "pool.yaml", "--vehicle", "finsrov"]


def fused(files, tmp_path, *words, log="log", name="fused.csv"):
    """Return the rows of the table that `finssim fuse` writes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(files)
        assert finssim("fuse", log, *FUSE, "--out", tmp_path / name, *words) == 0
    return table(tmp_path / name)


def test_fuse_follows_the_vehicle(files, tmp_path, capsys):
    """60 rows a second lie within 5 cm after half a second; the inputs and the errors are reported."""
    rows = fused(files, tmp_path)
    out, err = capsys.readouterr()
    assert err == "" and f"wrote {tmp_path / 'fused.csv'}" in out
    assert "against the truth, fresh" in out and "vision  accepted 2" in out
    t = column(rows, "t")
    np.testing.assert_allclose(np.diff(t), 1 / 60, atol=1e-6)
    late = t > 1.0
    off = np.stack([column(rows, a) for a in "xyz"], axis=1)[late] - position(t[late])
    assert np.linalg.norm(off, axis=1).max() < 0.05
    assert {row["state"] for row in np.array(rows)[late]} == {"fresh"}


def test_fuse_as_json(files, tmp_path, capsys):
    """`--json` prints one object with its keys, without NaN."""
    fused(files, tmp_path, "--json")
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert err == "" and found.keys() >= {
        *("out", "notes", "rows", "states", "ready", "accepted", "reacquired", "refused"),
        *("nis_per_dimension", "health", "errors"),
    }
    assert found["rows"] == len(table(tmp_path / "fused.csv"))
    assert found["out"] == str(tmp_path / "fused.csv")
    assert found["accepted"]["vision"] > 20 and found["errors"]["fresh"]["rms_x"] < 0.02
    assert sum(found["states"].values()) == pytest.approx(1.0)
    # The corners are better than their nominal 0.5 px.
    assert 0.1 < found["nis_per_dimension"]["vision"] < 1.5
    assert found["health"]["vision_mode"] == "fresh"


@pytest.mark.parametrize("rate", [10, 250])
def test_fuse_writes_at_the_rate(files, tmp_path, rate):
    rows = fused(files, tmp_path, "--rate", rate)
    np.testing.assert_allclose(np.diff(column(rows, "t")), 1.0 / rate, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ["--estimator", "constant-velocity"],
        ["--method", "refractive-6dof"],
        ["--method", "pinhole"],
        ["--pixel-std", "8"],
    ],
)
def test_fuse_options_change_the_path(files, tmp_path, capsys, words):
    """Each option gives another path from the same samples; without options the path is the same."""
    plain = fused(files, tmp_path, name="a.csv")
    rows = fused(files, tmp_path, *words, "--json", name="b.csv")
    t = column(plain, "t")
    off = np.abs(column(rows, "x") - column(plain, "x"))[t > 1.0]
    assert off.max() > 1e-4
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["accepted"]["vision"] > 5


def test_fuse_doubts_corners_that_are_said_to_be_poor(files, tmp_path):
    """A pixel error that is sixteen times larger makes the position more uncertain."""
    plain, rows = (
        fused(files, tmp_path, name="a.csv"),
        fused(files, tmp_path, "--pixel-std", "8", name="b.csv"),
    )
    assert column(rows, "std_x")[-1] > 1.2 * column(plain, "std_x")[-1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["fuse", "nowhere", *FUSE, "--out", "OUT"], "nowhere"),
        (
            ["fuse", "seen/pictures", *FUSE, "--out", "OUT"],
            "holds no imu.csv, depth.csv, vision.csv or detections.csv",
        ),
        (
            ["fuse", "truth.csv", *FUSE, "--out", "OUT"],
            "truth.csv: expected a line of different column names",
        ),
        (["fuse", "log", *FUSE, "--out", "OUT", "--rate", "0"], "rate is 0 Hz"),
        (["fuse", "log", *FUSE, "--out", "OUT", "--rate", "5000"], "rate is 5000 Hz"),
        (["fuse", "log", *FUSE, "--out", "OUT", "--estimator", "guess"], "unknown estimator 'guess'"),
        (["fuse", "log", *FUSE, "--out", "OUT", "--method", "snell"], "unknown method 'snell'; available"),
        (["fuse", "log", *FUSE, "--out", "OUT", "--pixel-std", "-1"], "pixel_std is -1"),
        (["fuse", "log", *FUSE, "--out", "OUT", "--vehicle", "bluerov2"], "no tags"),
        (["fuse", "log", *FUSE, "--out", "OUT", "--pool", "nowhere.yaml"], "nowhere.yaml"),
        (["fuse", "log", *FUSE, "--out", "/proc/x/y.csv"], "write elsewhere"),
        (["fuse", *FUSE, "--out", "OUT"], "Missing argument 'LOG'"),
        (["fuse", "log", *FUSE], "Missing option '--out'"),
    ],
)
def test_fuse_refuses_in_a_sentence(files, seen, tmp_path, capsys, monkeypatch, words, sentence):
    """Each request is refused in a sentence, and nothing is written."""
    monkeypatch.chdir(files)
    given = [tmp_path / "out.csv" if word == "OUT" else word for word in words]
    assert sentence in refusal(capsys, *given)
    assert list(tmp_path.iterdir()) == []


POINTS = "name,x,y,z\na,0.1,0.2,0.3\nb,-0.7,0.4,0.0\nhigh,0,0,1.5\n"


@pytest.fixture
def points(files, tmp_path, monkeypatch):
    """A table of points in the water and one above it, in a separate folder with the pool."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pool.yaml").write_text(POOL)
    (tmp_path / "points.csv").write_text(POINTS)
    return tmp_path


def read(text):
    """Return the rows of a table given as text."""
    return list(csv.DictReader(io.StringIO(text)))


def test_points_to_pixels_and_back(points, capsys):
    """Pixels of `project`, back-projected onto their own planes, give the points to a micrometre; names are kept."""
    assert finssim("project", "points.csv", "--pool", "pool.yaml", "--out", "pixels.csv") == 0
    assert "2 of 3 points have a pixel" in capsys.readouterr().err
    rows = table(points / "pixels.csv")
    assert [row["name"] for row in rows] == ["a", "b", "high"]
    assert [row["status"] for row in rows] == ["ok", "ok", "wrong_side"]
    keep = [row for row in rows if row["status"] == "ok"]
    write_csv(points / "uv.csv", ("u", "v", "z"), [[row["u"], row["v"], row["z"]] for row in keep])
    assert finssim("backproject", "uv.csv", "--pool", "pool.yaml") == 0
    out, err = capsys.readouterr()
    assert "2 of 2 pixels have a point" in err
    for row, true in zip(read(out), keep, strict=True):
        assert [float(row[a]) for a in "xyz"] == pytest.approx([float(true[a]) for a in "xyz"], abs=1e-6)


def test_project_reads_standard_input_and_the_pool(points, capsys, monkeypatch):
    """`project` reads standard input and writes to standard output; another pool gives other pixels."""
    (points / "other.yaml").write_text(POOL.replace("height: 1.0", "height: 0.8"))
    found = []
    for pool in ("pool.yaml", "other.yaml"):
        monkeypatch.setattr("sys.stdin", io.StringIO(POINTS))
        assert finssim("project", "-", "--pool", pool) == 0
        found.append(read(capsys.readouterr().out))
    assert float(found[0][1]["u"]) != pytest.approx(float(found[1][1]["u"]), abs=1.0)


@pytest.mark.parametrize("out", [True, False])
@pytest.mark.parametrize("command", ["project", "backproject"])
def test_points_as_json(points, capsys, command, out):
    """`--json` prints one object, which contains the rows if there is no output file for them."""
    (points / "uv.csv").write_text("u,v\n600,300\n10,10\n")
    words = ["points.csv"] if command == "project" else ["uv.csv", "--z", "0"]
    words += ["--pool", "pool.yaml", "--json", *(["--out", "out.csv"] if out else [])]
    assert finssim(command, *words) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["command"] == command and found["rows"] == (3 if command == "project" else 2)
    assert found["ok"] == 2 and found["rejected"] == ({"wrong_side": 1} if command == "project" else {})
    assert ("table" in found) != out and ("out" in found) == out == (points / "out.csv").exists()


def test_backproject_on_planes(points, capsys):
    """--z sets the height, --plane any plane: z = 0.2 gives the same in both notations, a wall does not."""
    (points / "uv.csv").write_text("u,v\n600,300\n900,500\n")
    found = {}
    for name, words in {
        "z": ["--z", "0.2"],
        "plane": ["--plane", "0,0,2,-0.4"],
        "floor": ["--z", "0"],
        "wall": ["--plane", "1,0,0,-0.6"],
    }.items():
        assert finssim("backproject", "uv.csv", "--pool", "pool.yaml", *words) == 0
        found[name] = read(capsys.readouterr().out)
    for a, b in zip(found["z"], found["plane"], strict=True):
        assert [float(a[k]) for k in "xyz"] == pytest.approx([float(b[k]) for k in "xyz"], abs=1e-8)
        assert float(a["z"]) == pytest.approx(0.2)
    assert float(found["floor"][1]["x"]) > float(found["z"][1]["x"]) + 1e-3
    assert [float(row["x"]) for row in found["wall"] if row["x"]] == [pytest.approx(0.6)]


def test_backproject_tells_the_error_of_points(points, capsys):
    """The error of points is proportional to the pixel error, and is written only on request."""
    (points / "uv.csv").write_text("u,v\n600,300\n")
    sigma = {}
    for std in ("0.5", "1"):
        words = ["backproject", "uv.csv", "--pool", "pool.yaml", "--z", "0", "--pixel-std", std]
        assert finssim(*words) == 0
        (row,) = read(capsys.readouterr().out)
        sigma[std] = [float(row[f"sigma_{a}"]) for a in "xyz"]
    # A pixel is about (1.6 + 1.0 / 1.333) m / 800 wide on the floor.
    assert sigma["1"][:2] == pytest.approx([2.35 / 800] * 2, rel=0.1)
    assert sigma["1"] == pytest.approx([2.0 * s for s in sigma["0.5"]], rel=1e-5, abs=1e-8)
    assert finssim(*words[:-2]) == 0
    assert "sigma_x" not in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["project", "nowhere.csv", "--pool", "pool.yaml"], "nowhere.csv: cannot be read"),
        (["project", "points.csv", "--pool", "nowhere.yaml"], "nowhere.yaml"),
        (["project", "uv.csv", "--pool", "pool.yaml"], "uv.csv: column x is missing among u, v"),
        (["project", "points.csv", "--pool", "pool.yaml", "--out", "/proc/x/y.csv"], "write elsewhere"),
        (["project", "points.csv"], "Missing option '--pool'"),
        (["project", "--pool", "pool.yaml"], "Missing argument 'POINTS'"),
        (["backproject", "uv.csv", "--pool", "pool.yaml"], "give a height z, a plane, or a column z"),
        (["backproject", "uv.csv", "--pool", "pool.yaml", "--z", "0", "--plane", "0,0,1,0"], "give one of them"),
        (["backproject", "uv.csv", "--pool", "pool.yaml", "--plane", "0,0,1"], "expected four numbers a,b,c,d"),
        (["backproject", "uv.csv", "--pool", "pool.yaml", "--plane", "0,0,0,1"], "not all zero"),
        (["backproject", "uv.csv", "--pool", "pool.yaml", "--z", "floor"], "Invalid value for '--z'"),
        (["backproject", "uv.csv", "--pool", "pool.yaml", "--z", "nan"], "'--z': nan is not a number"),
        (["backproject", "uv.csv", "--pool", "pool.yaml", "--z", "0", "--pixel-std", "0"], "positive number"),
        (["backproject", "points.csv", "--pool", "pool.yaml", "--z", "0"], "column u is missing"),
        (["backproject", "bad.csv", "--pool", "pool.yaml", "--z", "0"], "bad.csv: line 3: v is 'low'"),
        (["backproject", "uv.csv", "--pool", "pool.yaml", "--z", "0", "--out", "."], "it is a directory"),
        (["backproject", "--pool", "pool.yaml", "--z", "0"], "Missing argument 'PIXELS'"),
    ],
)  # fmt: skip
def test_points_that_cannot_be_used_are_refused_in_a_sentence(points, capsys, words, sentence):
    """Each request is refused in a sentence, and nothing is written, not even to standard output."""
    (points / "uv.csv").write_text("u,v\n600,300\n")
    (points / "bad.csv").write_text("u,v\n600,300\n600,low\n")
    before = sorted(points.iterdir())
    assert sentence in refusal(capsys, *words)
    assert sorted(points.iterdir()) == before


@pytest.mark.parametrize("command", ["localize", "fuse"])
def test_an_interruption_keeps_the_rows_so_far(files, tmp_path, capsys, monkeypatch, command):
    """Control-C ends with 130 and a sentence; the table contains the rows finished so far."""
    from finssim.localization.fusion.estimator import Estimator
    from finssim.localization.localize import Locator

    calls = []

    def at_the_fifth(first):
        def counted(*arguments, **options):
            calls.append(1)
            if len(calls) == 5:
                raise KeyboardInterrupt
            return first(*arguments, **options)

        return counted

    monkeypatch.setattr(Locator, "locate", at_the_fifth(Locator.locate))
    if command == "fuse":
        monkeypatch.setattr(Estimator, "health", at_the_fifth(Estimator.health))
    monkeypatch.chdir(files)
    given = [*LOCALIZE, *KNOWN] if command == "localize" else FUSE
    status = finssim(
        command, "tags.csv" if command == "localize" else "log", *given, "--out", tmp_path / "o.csv"
    )
    assert status == 130 and "finssim: interrupted" in capsys.readouterr().err
    assert len(table(tmp_path / "o.csv")) == 4


def test_a_pool_file_that_was_written_reads_back(files, tmp_path):
    """The fixture's pool, written by hand and written by FinsSim, is the same pool."""
    pool = load_pool(files / "pool.yaml")
    write_pool(pool, tmp_path / "pool.yaml")
    assert load_pool(tmp_path / "pool.yaml").sha256 == pool.sha256
