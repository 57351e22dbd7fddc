"""`finssim calibrate camera`, `pool` and `mounts`, as a user types them: every option, every refusal."""

import json
import re
from html import unescape

import numpy as np
import pytest
import yaml

from finssim.core.optics import Interface, Layer
from finssim.core.rotations import quat_from_euler, quat_to_matrix
from finssim.identification.vehicle_file import write_vehicle
from finssim.localization.camera_file import load_camera, write_camera
from finssim.localization.detection.families import bitmap
from finssim.localization.detection.pictures import read_picture, write_picture
from finssim.localization.overhead_camera import load_pool, write_pool
from finssim.sim.overhead_camera import ImageSensor, ObjectPose, OverheadCamera, Scene, TagInScene, TiledBasin
from finssim.vehicles import Provenance, load_vehicle
from reference.commands import finssim, refusal
from survey.board_views import PHOTOGRAPHS
from survey.moving_vehicle import MOUNTS, POOL, PORT, motion, write_log
from survey.surveyed_pools import FLOOR, PLUMB_BOB, SOLID, overhead, survey

PARAMETER = {"estimate", "ci95", "unit", "identifiable", "note"}


def found_by(capsys, *words):
    """Return the one JSON object that a command prints."""
    capsys.readouterr()
    assert finssim(*words, "--json") == 0
    return json.loads(capsys.readouterr().out)


def refused(capsys, folder, words, sentence):
    """Check that a command is refused with a sentence and writes nothing."""
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    assert sentence in refusal(capsys, *words, notes=True)
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


def width(found, name):
    """Return the width of a parameter's interval."""
    low, high = found["parameters"][name]["ci95"]
    return high - low


# ---- calibrate camera

SOME = [PHOTOGRAPHS / f"left{i:02d}.jpg" for i in (1, 3, 5, 6, 8)]
CAMERA = ["calibrate", "camera", *SOME, "--out", "camera.yaml"]


@pytest.fixture
def place(tmp_path, monkeypatch):
    """An empty folder to work in."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def charuco(tmp_path_factory):
    """Pictures of a ChArUco board of 7x5 squares, markers of DICT_4X4_50, through a lens with 600 px of focal
    length."""
    cv2 = pytest.importorskip("cv2")
    folder, rng = tmp_path_factory.mktemp("charuco"), np.random.default_rng(1)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((7, 5), 0.03, 0.02, dictionary).generateImage((1400, 1000))
    K = np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]])
    to_metres = np.array([[0.00015, 0.0, 0.000075], [0.0, 0.00015, 0.000075], [0.0, 0.0, 1.0]])
    for i in range(6):
        R = quat_to_matrix(quat_from_euler(*rng.uniform(-0.5, 0.5, 2), rng.uniform(-0.3, 0.3)))
        t = np.array([*rng.uniform(-0.03, 0.03, 2), 0.32]) - R @ [0.105, 0.075, 0.0]
        H = K @ np.column_stack([R[:, 0], R[:, 1], t]) @ to_metres
        image = cv2.warpPerspective(board, H, (640, 480), flags=cv2.INTER_AREA, borderValue=170)
        write_picture(cv2.GaussianBlur(image, (0, 0), 0.7), folder / f"{i}.png")
    return folder


@pytest.mark.slow
def test_camera_as_json_and_as_a_file(place, capsys):
    """`--json` prints one object with the keys of the contract; the only file written contains the same lens."""
    found = found_by(capsys, *CAMERA, "--board", "9x6", "--report", "report")
    assert found.keys() >= {
        *("kind", "parameters", "per_view", "rms_px", "held_out_rms_px", "views", "left_out", "findings"),
        *("error95_px", "empty_edges", "correlation", "settings", "out", "provenance"),
    }
    assert found["kind"] == "camera" and found["out"] == "camera.yaml"
    assert all(parameter.keys() == PARAMETER for parameter in found["parameters"].values())
    lens = load_camera("camera.yaml").lens
    assert lens.fx == pytest.approx(found["parameters"]["fx"]["estimate"], rel=1e-6)
    assert lens.fx == pytest.approx(536.0, rel=0.02) and lens.model == "plumb_bob"
    low, high = found["parameters"]["fx"]["ci95"]
    assert low < lens.fx < high
    assert {view["name"] for view in found["per_view"]} == {path.name for path in SOME}
    assert {path.name for path in place.iterdir()} == {"camera.yaml", "report"}
    names = {path.name for path in (place / "report").iterdir()}
    assert names == {"report.html", "fit.json", "coverage.png", "residuals.png"}
    assert "finssim calibrate camera" in (place / "report" / "report.html").read_text("utf-8")


@pytest.mark.slow
def test_camera_as_a_table(place, capsys):
    for path in SOME[:4]:
        write_picture(np.ascontiguousarray(read_picture(path)[::2, ::2]), place / f"{path.stem}.png")
    assert finssim("calibrate", "camera", place, "--board", "9x6", "--out", "camera.yaml") == 0
    out = capsys.readouterr().out
    assert "written: camera.yaml" in out and "fx" in out and "95 % interval" in out
    assert "4 of 4 views" in out and "views are few" in out


@pytest.mark.slow
@pytest.mark.parametrize("model", ["plumb_bob", "rational", "fisheye"])
def test_camera_fits_the_lens_that_it_is_told(place, capsys, model):
    found = found_by(capsys, *CAMERA, "--board", "9x6", "--model", model)
    assert load_camera("camera.yaml").lens.model == found["settings"]["model"] == model


@pytest.mark.slow
def test_camera_takes_square_and_seed(place, capsys):
    """The square is recorded; the seed decides only which pictures are held out together. The report gives the command
    that repeats the calibration."""
    words = ["calibrate", "camera", *sorted(PHOTOGRAPHS.glob("*.jpg"))]
    words += ["--board", "9x6", "--out", "camera.yaml"]
    plain = found_by(capsys, *words)
    other = found_by(capsys, *words, "--square", "0.05", "--seed", "3", "--report", "report")
    assert (plain["settings"]["square"], other["settings"]["square"]) == (0.025, 0.05)
    assert "squares of 50 mm" in other["settings"]["board"]
    assert other["held_out_rms_px"] != plain["held_out_rms_px"]
    assert other["parameters"]["fx"]["estimate"] == pytest.approx(
        plain["parameters"]["fx"]["estimate"], rel=1e-6
    )
    page = (place / "report" / "report.html").read_text("utf-8")
    assert "--square 0.05" in page and "--board 9x6" in page and "--seed 3" in page


@pytest.mark.slow
def test_camera_reads_a_charuco_board(place, charuco, capsys):
    """The options set the board's size, squares, markers and dictionary."""
    words = ["calibrate", "camera", charuco, "--out", "camera.yaml", "--charuco", "7x5", "--square", "0.03"]
    found = found_by(capsys, *words, "--dictionary", "DICT_4X4_50", "--marker", "0.02")
    assert found["views"] == 6
    assert load_camera("camera.yaml").lens.fx == pytest.approx(600.0, rel=0.02)
    assert "7x5 squares, markers of 20 mm" in found["settings"]["board"]
    found = found_by(capsys, *words, "--dictionary", "dict_4x4_50")
    assert "markers of 22.5 mm" in found["settings"]["board"]
    (place / "camera.yaml").unlink()
    refused(capsys, place, words, "none of 6 pictures shows")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (CAMERA, "neither --board nor --charuco is given"),
        ([*CAMERA, "--board", "nine"], "--board is 'nine', expected columns x rows such as 9x6"),
        ([*CAMERA, "--board", "5x4"], "check the count of the board's corners"),
        ([*CAMERA, "--board", "2x2"], "the board has 2x2 corners, expected at least 3"),
        ([*CAMERA, "--board", "9x6", "--charuco", "7x5"], "--board and --charuco are both given"),
        ([*CAMERA, "--charuco", "seven"], "--charuco is 'seven'"),
        ([*CAMERA, "--charuco", "7x5", "--marker", "0.05"], "the marker is 0.05 m"),
        ([*CAMERA, "--charuco", "7x5", "--dictionary", "DICT_9"], "unknown dictionary 'DICT_9'"),
        ([*CAMERA, "--board", "9x6", "--square", "0"], "the square is 0 m"),
        ([*CAMERA, "--board", "9x6", "--square", "wide"], "Invalid value for '--square'"),
        ([*CAMERA, "--model", "pinhole"], "unknown lens model 'pinhole'; available: plumb_bob, rational, fisheye"),
        ([*CAMERA, "--seed", "-1"], "Invalid value for '--seed'"),
        ([*CAMERA[:-1], "camera.txt"], "camera.txt ends in '.txt', expected .yaml"),
        ([*CAMERA[:-1], "/proc/x/camera.yaml"], "write elsewhere"),
        ([*CAMERA, "--report", "/proc/x/report"], "write elsewhere"),
        ([*CAMERA, "--report", PHOTOGRAPHS], "already holds files"),
        (["calibrate", "camera", "nowhere.png", "--board", "9x6", "--out", "c.yaml"], "there is no such file"),
        (["calibrate", "camera", ".", "--board", "9x6", "--out", "c.yaml"], "the folder holds no pictures"),
        (["calibrate", "camera", "--out", "c.yaml"], "Missing argument 'IMAGE"),
        (["calibrate", "camera", *SOME], "Missing option '--out'"),
    ],
)  # fmt: skip
def test_camera_refuses_in_a_sentence(place, capsys, words, sentence):
    """Each request is refused in a sentence, and nothing is written."""
    refused(capsys, place, words, sentence)


# ---- calibrate pool


def combined(path, seen, names="id,u,v,x,y,z", scale=1.0):
    """Write a table of pixels with points."""
    lines = [names]
    for name, (u, v), point in zip(seen.names, seen.pixels, scale * seen.points, strict=True):
        cells = dict(zip("xyz", point, strict=True)) | {"id": name, "u": u, "v": v}
        lines.append(",".join(str(cells[column]) for column in names.split(",")))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.fixture(scope="session")
def pool_files(tmp_path_factory):
    """A survey of 24 points in space, one of a floor, and a picture of tags on that floor, all below 1 m of water."""
    folder = tmp_path_factory.mktemp("surveyed")
    write_camera(folder / "camera.yaml", PLUMB_BOB, {})
    water = Interface.water(1.0)
    solid, floor = (survey(overhead(), water, box, 24, seed=2) for box in (SOLID, FLOOR))
    combined(folder / "points.csv", solid)
    combined(folder / "millimetres.csv", solid, scale=1000.0)
    combined(folder / "floor.csv", floor, "id,u,v,x,y")
    combined(folder / "pixels.csv", solid, "id,u,v")
    combined(folder / "survey.csv", solid, "id,x,y,z")
    (folder / "bad.csv").write_text("id,u,v,x,y,z\na,600,300,0,0,0\nb,600,low,0,0,0\n")
    (folder / "thesis").mkdir()
    (folder / "thesis" / "thesis.tex").touch()
    return folder


TAG_EDGE = 0.16


@pytest.fixture(scope="session")
def tag_files(pool_files):
    """The floor's tags, surveyed with 4 mm of error, in one picture rendered through the water."""
    pytest.importorskip("pupil_apriltags")
    rng, tags, rows = np.random.default_rng(5), [], ["tag,x,y,z,yaw_deg"]
    for i, (x, y) in enumerate((x, y) for x in (-1.2, -0.4, 0.5, 1.3) for y in (-0.7, 0.0, 0.6)):
        yaw = rng.uniform(-np.pi, np.pi)
        q = tuple(quat_from_euler(0.0, 0.0, yaw).tolist())
        tags.append(
            TagInScene(
                bitmap=bitmap("tag36h11", i).astype(bool),
                edge=TAG_EDGE,
                margin=0.03,
                pose=ObjectPose(position=(x, y, 0.0), orientation=q),
            )
        )
        off = 0.004 * rng.standard_normal(2)
        rows.append(f"{i},{x + off[0]},{y + off[1]},0,{np.degrees(yaw) + rng.normal()}")
    basin = TiledBasin(lower=(-2.0, -1.0, -0.02), upper=(2.0, 1.0, 1.1))
    scene = Scene(
        camera=overhead(), interface=Interface.water(1.0), basin=basin, tags=tuple(tags), sensor=ImageSensor()
    )
    write_picture(OverheadCamera(scene).render(seed=1), pool_files / "tags.png")
    (pool_files / "tags.csv").write_text("\n".join(rows) + "\n")
    return pool_files


@pytest.fixture
def surveyed(pool_files, tmp_path, monkeypatch):
    """The folder of the surveys as working directory; outputs go to another."""
    monkeypatch.chdir(pool_files)
    return tmp_path


WITH = ["--camera", "camera.yaml"]
TAPE = "surface: {height: 1.0}"


def surveyed_as(folder, tape=TAPE, **values):
    """Write a survey file, with a tape-measured surface and two folds unless given otherwise, and return its path."""
    tree = {"fit": ["pose", "height", "tilt", "index"], "folds": 2, **yaml.safe_load(tape), **values}
    (folder / "survey.yaml").write_text(yaml.safe_dump(tree), encoding="utf-8")
    return folder / "survey.yaml"


def pool_by(capsys, out, *words, tape=TAPE, inputs=("points.csv",), **values):
    """Return the result of `finssim calibrate pool` and the pool that it writes."""
    survey = ["--survey", surveyed_as(out, tape, **values)]
    found = found_by(capsys, "calibrate", "pool", *inputs, *survey, *WITH, "--out", out / "p.yaml", *words)
    return found, load_pool(out / "p.yaml")


@pytest.fixture(scope="session")
def plain(pool_files, tmp_path_factory):
    """The result with a tape alone, for comparison."""
    import contextlib
    import io

    text, out = io.StringIO(), tmp_path_factory.mktemp("plain")
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(text):
        patch.chdir(pool_files)
        survey = ["--survey", surveyed_as(out)]
        words = ["calibrate", "pool", "points.csv", *survey, *WITH, "--out", "plain.yaml", "--json"]
        assert finssim(*words) == 0
    return json.loads(text.getvalue()), load_pool(pool_files / "plain.yaml")


@pytest.mark.slow
def test_pool_as_json_and_as_a_file(surveyed, plain):
    """The result has the keys of the contract and is near the truth; the file's record contains the prior knowledge."""
    found, pool = plain
    assert found.keys() >= {
        *("kind", "interface", "parameters", "residual", "held_out", "pinhole", "lens_fitted", "outliers"),
        *("correlation", "findings", "settings", "inputs", "out", "provenance"),
    }
    assert found["kind"] == "pool" and found["interface"] == "surface" and found["out"] == "plain.yaml"
    assert all(parameter.keys() == PARAMETER for parameter in found["parameters"].values())
    assert np.linalg.norm(pool.camera.position - overhead().position) < 0.02
    assert pool.interface.height(0.0, 0.0) == pytest.approx(1.0, abs=0.01)
    assert pool.record["settings"]["water_height"] == 1.0 and pool.latency == 0.0
    assert found["held_out"]["rms_cm"] < found["pinhole"]["held_out"]["rms_cm"]


@pytest.mark.slow
def test_pool_as_a_table_with_a_report(surveyed, capsys):
    """The shortest survey file gives a table of results, the output path, and a command that repeats it byte
    for byte."""
    import shlex

    (surveyed / "s.yaml").write_text("surface: {}\ncamera: {latency: 0.05}\n")
    words = ["calibrate", "pool", "points.csv", "--survey", surveyed / "s.yaml", *WITH]
    words += ["--out", surveyed / "p.yaml", "--seed", "4", "--report", surveyed / "report"]
    assert finssim(*words) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "camera before a water surface, from 24 surveyed places" in out and "camera_height" in out
    assert "held out (5 parts)" in out and f"written: {surveyed / 'report'}" in out
    names = {path.name for path in (surveyed / "report").iterdir()}
    assert names >= {"report.html", "fit.json", "map.png", "picture.png"}
    page = (surveyed / "report" / "report.html").read_text(encoding="utf-8")
    assert "http" not in page
    again = unescape(re.search(r"<pre>(finssim [^<\n]*)", page)[1])
    first = (surveyed / "p.yaml").read_bytes()
    (surveyed / "p.yaml").unlink()
    assert finssim(*shlex.split(again)[1:]) == 0
    assert (surveyed / "p.yaml").read_bytes() == first
    assert load_pool(surveyed / "p.yaml").latency == 0.05


@pytest.mark.slow
def test_pool_matches_a_survey_with_pixels(surveyed, pool_files, plain, capsys):
    """Two tables give the same result as one; `points` is relative to the survey file."""
    points = str(pool_files / "survey.csv")
    _, pool = pool_by(capsys, surveyed, points=points, inputs=("pixels.csv",))
    assert pool.sha256 == plain[1].sha256


@pytest.mark.slow
def test_pool_reads_lengths_in_the_unit(surveyed, plain, capsys):
    """Millimetres without `unit` span kilometres and are refused; with `unit` they give the same survey."""
    survey = ["--survey", surveyed_as(surveyed)]
    words = ["calibrate", "pool", "millimetres.csv", *survey, *WITH, "--out", surveyed / "p.yaml"]
    refused(capsys, surveyed, words, "unit: mm into the survey file")
    _, pool = pool_by(capsys, surveyed, unit="mm", inputs=("millimetres.csv",))
    np.testing.assert_allclose(pool.camera.position, plain[1].camera.position, atol=1e-6)


def test_pool_takes_the_height_of_a_floor(surveyed, capsys):
    """A table without z is refused without `z`; another height of the floor moves the camera with it."""
    survey = ["--survey", surveyed_as(surveyed, "surface: {}")]
    words = ["calibrate", "pool", "floor.csv", *survey, *WITH, "--out", surveyed / "p.yaml"]
    refused(capsys, surveyed, words, "no column 'z'")
    heights = []
    for z in (0.0, 0.5):
        _, pool = pool_by(
            capsys, surveyed, tape=f"surface: {{height: {1.0 + z}}}", z=z, inputs=("floor.csv",)
        )
        heights.append(pool.camera.position[2])
    assert heights[1] - heights[0] == pytest.approx(0.5, abs=1e-4)


KEYS = {
    "window": (
        {"tape": "window: {thickness: 0.02, index: 1.49}"},
        lambda a, b, p: a["interface"] == "window" and p.interface.window == (Layer(0.02, 1.49),),
    ),
    "plane": (
        {"tape": "window: {thickness: 0.02, index: 1.49, plane: [0, 0, 1, -1.02], sigma: 0.0005}"},
        lambda a, b, p: abs(p.interface.height(0, 0) - 1.02) < 0.01,
    ),
    "height": (
        {"tape": "surface: {height: 1.03, sigma: 0.0005}"},
        lambda a, b, p: abs(a["parameters"]["water_height"]["estimate"] - 1.03) < 0.005,
    ),
    "depth": (
        {"tape": "surface: {depth: 0.5, sigma: 0.0005}"},
        lambda a, b, p: a["settings"]["water_depth"] == 0.5
        and abs(a["parameters"]["water_height"]["estimate"] - b["parameters"]["water_height"]["estimate"]) > 0.1,
    ),
    "sigma of the height": (
        {"tape": "surface: {height: 1.0, sigma: 0.0005}"},
        lambda a, b, p: 3.0 * width(a, "water_height") < width(b, "water_height"),
    ),
    "index": (
        {"water": {"index": 1.34}, "fit": ["pose", "height", "tilt"]},
        lambda a, b, p: p.interface.index_far == 1.34,
    ),
    "index_sigma": ({"water": {"index_sigma": 0.03}}, lambda a, b, p: width(a, "index") > 1.5 * width(b, "index")),
    "tilt_sigma_deg": (
        {"tape": "surface: {height: 1.0, tilt_sigma_deg: 0.01}"},
        lambda a, b, p: width(a, "tilt_x") < 0.5 * width(b, "tilt_x"),
    ),
    "fit": ({"fit": ["pose", "height"]}, lambda a, b, p: a["parameters"]["tilt_x"]["note"] == "as given"),
    "focal_sigma": ({"camera": {"focal_sigma": 0.01}}, lambda a, b, p: width(a, "focal") > width(b, "focal") == 0.0),
    "center_sigma_px": (
        {"camera": {"center_sigma_px": 5}},
        lambda a, b, p: width(a, "center_x") > width(b, "center_x") == 0.0,
    ),
    "pixel_sigma_px": ({"camera": {"pixel_sigma_px": 1.5}}, lambda a, b, p: a["residual"]["pixel_sigma"] == 1.5),
    "sigma": ({"sigma": 0.0002}, lambda a, b, p: a["residual"]["survey_sigma_mm"] < 0.5),
    "latency": ({"camera": {"latency": 0.04}}, lambda a, b, p: p.latency == 0.04),
    "folds": ({"folds": 4}, lambda a, b, p: a["held_out"]["folds"] == 4 != b["held_out"]["folds"]),
}  # fmt: skip
"""Key of the survey file -> values given, and the expected difference: JSON with, JSON without, pool with."""


@pytest.mark.slow
@pytest.mark.parametrize("name", KEYS)
def test_pool_does_what_each_key_says(surveyed, plain, capsys, name):
    """The key changes the result as its name implies."""
    values, told = KEYS[name]
    found, pool = pool_by(capsys, surveyed, **values)
    assert told(found, plain[0], pool)
    assert not told(plain[0], plain[0], plain[1])


@pytest.mark.slow
def test_pool_draws_by_its_seed(surveyed, plain, capsys):
    found, _ = pool_by(capsys, surveyed, "--seed", "7")
    assert found["held_out"]["rms_px"] != plain[0]["held_out"]["rms_px"]


@pytest.mark.slow
def test_pool_finds_the_tags_of_a_picture(surveyed, tag_files, capsys):
    """Tags of the given family and edge determine camera and water within 1.5 cm."""
    given = {"inputs": ("tags.png",), "points": str(tag_files / "tags.csv")}
    tags = {"family": "tag36h11", "edge": TAG_EDGE}
    found, pool = pool_by(capsys, surveyed, tags=tags, **given)
    assert found["residual"]["points"] == 48 and found["residual"]["locations"] == 12
    assert np.linalg.norm(pool.camera.position - overhead().position) < 0.02
    other, _ = pool_by(capsys, surveyed, tags={**tags, "yaw_sigma_deg": 4}, **given)
    assert other["parameters"]["camera_x"] != found["parameters"]["camera_x"]
    assert other["settings"]["survey_yaw_sigma"] == pytest.approx(np.radians(4.0))
    for changes, sentence in (
        ({"family": "tag36h11"}, "a tag without its edge"),
        ({"family": "16h5", "edge": TAG_EDGE}, "tags.png"),
        ({"edge": TAG_EDGE}, "give tags: {family: tag25h9}"),
    ):
        survey = ["--survey", surveyed_as(surveyed, tags=changes, points=given["points"])]
        command = ["calibrate", "pool", "tags.png", *survey, *WITH, "--out", surveyed / "q.yaml"]
        refused(capsys, surveyed, command, sentence)


POOL_WORDS = ["calibrate", "pool", "points.csv", "--survey", "SURVEY", *WITH, "--out", "OUT"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([*POOL_WORDS, "--seed", "-1"], "Invalid value for '--seed'"),
        ([*POOL_WORDS, "--survey", "nowhere.yaml"], "nowhere.yaml"),
        ([*POOL_WORDS, "--survey", "camera.yaml"], "camera.yaml: neither surface nor window is given"),
        ([*POOL_WORDS, "--camera", "nowhere.yaml"], "nowhere.yaml"),
        ([*POOL_WORDS, "--camera", "points.csv"], "points.csv"),
        ([*POOL_WORDS[:-1], "p.txt"], "p.txt ends in '.txt', expected .yaml"),
        ([*POOL_WORDS[:-1], "/proc/x/p.yaml"], "write elsewhere"),
        ([*POOL_WORDS, "--report", "/proc/x/r"], "write elsewhere"),
        ([*POOL_WORDS, "--report", "thesis"], "already holds files"),
        (["calibrate", "pool", "nowhere.csv", *POOL_WORDS[3:]], "nowhere.csv: no such file"),
        (["calibrate", "pool", "pixels.csv", *POOL_WORDS[3:]], "no column 'x'"),
        (["calibrate", "pool", "bad.csv", *POOL_WORDS[3:]], "bad.csv"),
        (["calibrate", "pool", "points.csv", "--survey", "SURVEY", "--out", "OUT"], "Missing option '--camera'"),
        (["calibrate", "pool", "points.csv", *WITH, "--out", "OUT"], "Missing option '--survey'"),
        (["calibrate", "pool", "points.csv", "--survey", "SURVEY", *WITH], "Missing option '--out'"),
        (["calibrate", "pool", *POOL_WORDS[3:]], "Missing argument 'INPUT"),
        ([*POOL_WORDS, "--water-height", "1"], "--water-height"),
    ],
)  # fmt: skip
def test_pool_refuses_in_a_sentence(surveyed, pool_files, capsys, words, sentence):
    """Each request is refused in a sentence, and nothing is written, nor beside the inputs."""
    files = {"OUT": surveyed / "p.yaml", "SURVEY": surveyed_as(surveyed)}
    given = [files.get(word, word) for word in words]
    before = sorted(pool_files.rglob("*"))
    refused(capsys, surveyed, given, sentence)
    assert sorted(pool_files.rglob("*")) == before


# ---- calibrate mounts


@pytest.fixture(scope="session")
def mount_files(tmp_path_factory):
    """A pool, a FinsROV with its port at the true position, and a log."""
    folder = tmp_path_factory.mktemp("mounts")
    write_pool(POOL, folder / "pool.yaml")
    vehicle = load_vehicle("finsrov").replace(
        {"sensors.depth.position": PORT.tolist()}, Provenance("measured")
    )
    write_vehicle(vehicle, folder / "vehicle.yaml")
    write_log(folder / "log", motion(seconds=16.0, rate=3.0), np.random.default_rng(1))
    (folder / "empty").mkdir()
    (folder / "thesis").mkdir()
    (folder / "thesis" / "thesis.tex").touch()
    return folder


@pytest.fixture
def mounting(mount_files, tmp_path, monkeypatch):
    """The folder of the logs as working directory; outputs go to another."""
    monkeypatch.chdir(mount_files)
    return tmp_path


MOUNT = ["calibrate", "mounts", "log", "--pool", "pool.yaml", "--vehicle", "vehicle.yaml", "--out"]


@pytest.mark.slow
def test_mounts_as_json_and_as_a_vehicle(mounting, capsys):
    """The result has the keys of the contract; the vehicle file contains the tags' true heights and distance."""
    found = found_by(capsys, *MOUNT, mounting / "v.yaml", "--seed", "9", "--report", mounting / "report")
    assert found.keys() >= {
        *("kind", "method", "vehicle", "parameters", "quality", "correlation", "findings", "trials"),
        *("settings", "out", "provenance"),
    }
    assert found["kind"] == "mounts" and found["settings"]["seed"] == 9
    assert all(parameter.keys() == PARAMETER for parameter in found["parameters"].values())
    tags = load_vehicle(mounting / "v.yaml").tags.mounts
    apart = np.linalg.norm(np.asarray(tags[15].position) - np.asarray(tags[16].position))
    assert apart == pytest.approx(np.linalg.norm(MOUNTS[15].t - MOUNTS[16].t), abs=0.005)
    assert "finssim calibrate mounts log" in (mounting / "report" / "report.html").read_text("utf-8")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([*MOUNT, "OUT", "--vehicle", "bluerov2"], "has no tags"),
        ([*MOUNT, "OUT", "--vehicle", "finrov"], "did you mean 'finsrov'"),
        ([*MOUNT, "OUT", "--pool", "nowhere.yaml"], "nowhere.yaml"),
        ([*MOUNT, "OUT", "--report", "thesis"], "already holds files"),
        ([*MOUNT, "OUT", "--report", "/proc/x/r"], "write elsewhere"),
        ([*MOUNT, "OUT", "--seed", "-1"], "Invalid value for '--seed'"),
        ([*MOUNT, "v.json"], "v.json ends in '.json', expected .yaml"),
        ([*MOUNT, "/proc/x/v.yaml"], "write elsewhere"),
        (["calibrate", "mounts", "empty", *MOUNT[3:], "OUT"], "empty: no detections.csv in it"),
        (["calibrate", "mounts", "nowhere", *MOUNT[3:], "OUT"], "nowhere: no detections.csv in it"),
        (["calibrate", "mounts", *MOUNT[3:], "OUT"], "Missing argument 'LOG'"),
        (MOUNT[:-1], "Missing option '--out'"),
    ],
)  # fmt: skip
def test_mounts_refuses_in_a_sentence(mounting, mount_files, capsys, words, sentence):
    """Each request is refused in a sentence, and nothing is written, nor beside the log."""
    given = [mounting / "v.yaml" if word == "OUT" else word for word in words]
    before = sorted(mount_files.rglob("*"))
    refused(capsys, mounting, given, sentence)
    assert sorted(mount_files.rglob("*")) == before
