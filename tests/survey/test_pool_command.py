"""The command writes a pool file that reproduces the points, reports findings, and refuses without writing."""

import json
from dataclasses import replace

import numpy as np
import pytest

from finssim.core.optics import Interface, back_project
from finssim.localization.camera_file import write_camera
from finssim.localization.overhead_camera import load_pool
from finssim.survey.pool import run
from finssim.trials.findings import CalibrationError

from .surveyed_pools import FLOOR, GLASS, PLUMB_BOB, TANK, TANK_LENS, before_tank, overhead, survey, window

WATER = Interface.water(1.0)
SURE = "surface: {{height: 1.0}}\ncamera: {{{}}}"


@pytest.fixture
def pool(tmp_path):
    """Folder with a camera file and a table of a floor."""
    write_camera(tmp_path / "camera.yaml", PLUMB_BOB, {})
    table(tmp_path / "points.csv", survey(overhead(), WATER, FLOOR, 40))
    return tmp_path


def table(path, seen):
    rows = [f"{n},{u},{v},{x},{y},{z}" for n, (u, v), (x, y, z) in zip(seen.names, seen.pixels, seen.points)]  # noqa: B905
    path.write_text("\n".join(["id,u,v,x,y,z", *rows]) + "\n", encoding="utf-8")


def calibrated(folder, text="surface: {height: 1.0}", points="points.csv", out="pool.yaml", **options):
    """Run the command on the files of a folder, with a survey file of this text."""
    (folder / "survey.yaml").write_text(text, encoding="utf-8")
    files = {"survey": folder / "survey.yaml", "camera": folder / "camera.yaml", "out": folder / out}
    return run([folder / points], **{**files, **options})


def test_a_pool_file_gives_held_out_points_back(pool):
    """Error-free points not used in the calibration, back-projected to the floor, agree to 3 mm rms."""
    calibrated(pool)
    found, fresh = (
        load_pool(pool / "pool.yaml"),
        survey(overhead(), WATER, FLOOR, 200, seed=9, pixel=0.0, error=0.0),
    )
    points, _ = back_project(found.camera, found.interface, fresh.pixels).at_z(0.0)
    assert np.sqrt(np.mean(np.sum((points - fresh.points) ** 2, axis=1))) < 0.003
    assert found.record["inputs"].keys() == {
        str(pool / f"{x}") for x in ("points.csv", "survey.yaml", "camera.yaml")
    }
    assert found.record["parameters"]["camera_height"]["ci95"][0] < 1.2


@pytest.mark.slow
def test_the_lens_is_as_sure_as_its_file_remembers(pool):
    """Intervals of `calibrate camera` become standard errors of focal length and centre; the survey file
    overrides them."""
    fx, cx = PLUMB_BOB.fx, PLUMB_BOB.cx
    ends = {"fx": [fx - 1.96, fx + 1.96], "cx": [cx - 3.92, cx + 3.92], "cy": [0.0, 0.0]}
    record = {
        "estimates": {
            name: {"estimate": sum(ci) / 2.0, "ci95": ci, "unit": "px"} for name, ci in ends.items()
        }
    }
    write_camera(pool / "camera.yaml", PLUMB_BOB, record)
    told = calibrated(pool).settings
    assert told.focal_sigma == pytest.approx(1.0 / fx) and told.center_sigma == pytest.approx(2.0)
    said = calibrated(pool, SURE.format("focal_sigma: 0.01, center_sigma_px: 5.0")).settings
    assert (said.focal_sigma, said.center_sigma) == (0.01, 5.0)


@pytest.mark.slow
def test_a_tank_with_its_window_surveyed(tmp_path, capsys):
    camera, plane = before_tank(30.0), window()
    write_camera(tmp_path / "camera.yaml", TANK_LENS, {})
    table(tmp_path / "points.csv", survey(camera, plane, TANK, 50, error=0.0005))
    text = "window: {thickness: 0.010, index: 1.52, plane: [0, 1, 0, 0]}\nsigma: 0.0005"
    calibrated(tmp_path, text)
    found = load_pool(tmp_path / "pool.yaml")
    assert found.interface.window == (GLASS,)
    assert found.interface.normal[1] < -0.999
    assert np.linalg.norm(found.camera.position - camera.position) < 0.01
    assert "camera_distance" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"text": "surface: {height: -1.0}"}, "other side"),
        (
            {"text": "surface: {height: 100.0}"},
            "surface: height 100 puts the plane 100 m from the points.*unit",
        ),
        ({"text": "surface: {}\npoints: nowhere.csv"}, "nowhere.csv"),
    ],
)
def test_refusals_write_nothing(pool, options, words):
    with pytest.raises(CalibrationError, match=words):
        calibrated(pool, **options)
    assert not (pool / "pool.yaml").exists()


def test_pixels_of_another_resolution_are_refused(pool):
    write_camera(pool / "half.yaml", type(PLUMB_BOB)(640, 360, 270.0, 270.0, 341.0, 174.0), {})
    with pytest.raises(CalibrationError, match="another resolution"):
        calibrated(pool, camera=pool / "half.yaml")


def test_parts_of_the_picture_are_no_pixels(pool):
    seen = survey(overhead(), WATER, FLOOR, 40)
    table(pool / "parts.csv", replace(seen, pixels=seen.pixels / [PLUMB_BOB.width, PLUMB_BOB.height]))
    with pytest.raises(CalibrationError, match="spread over 0.* px in all.*multiply"):
        calibrated(pool, points="parts.csv")
    assert not (pool / "pool.yaml").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    "lens",
    ["", "camera: {focal_sigma: 0.003}", "camera: {focal_sigma: 0.0}", "fit: [pose, height, focal]"],
)
def test_a_lens_taken_as_exact_is_said(pool, capsys, lens):
    """A note in the table and a finding in JSON say so, unless the survey file gives its errors or fits it."""
    text = f"surface: {{height: 1.0}}\n{lens}"
    calibrated(pool, text)
    assert ("· the lens is assumed exact" in capsys.readouterr().out) == (not lens)
    calibrated(pool, text, as_json=True)
    said = json.loads(capsys.readouterr().out)
    assert ("lens_exact" in {one["code"] for one in said["findings"]}) == (not lens)


def test_the_surveys_part_of_the_held_out_error_is_said(pool, capsys):
    """2 mm for each of two coordinates give 2.8 mm, times the ratio of apparent to stated survey error."""
    fit = calibrated(pool)
    told = 0.2 * np.sqrt(2.0) * fit.noise.scale
    assert load_pool(pool / "pool.yaml").record["held_out"]["survey_cm"] == pytest.approx(told)
    assert f"survey's own error {told:.2f} cm" in " ".join(capsys.readouterr().out.split())
