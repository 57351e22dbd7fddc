"""The whole experiment at a small size: its folder, the steps a user can repeat, and interruptions."""

import json
import re
from functools import partial

import numpy as np
import pytest

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.core.files import OutputError
from finssim.evaluation import statistics
from finssim.localization.camera_file import load_camera
from finssim.localization.detection.detections import read_detections
from finssim.localization.overhead_camera import load_pool
from finssim.studies import localization as module
from finssim.studies.localization import (
    CONDITIONS,
    METHOD_TITLES,
    PAPER_TABLE_2,
    CampaignPicture,
    localization_experiment,
)
from reference.commands import finssim

pytestmark = pytest.mark.slow

TINY = {"locations": (4, 3), "images": 12}
FILES = {
    *("localization.json", "localization.html", "error_map.png", "camera.yaml", "pool.yaml"),
    *("pool_pinhole.yaml", "detections.csv", "survey.csv", "survey.yaml"),
}


@pytest.fixture(scope="module", autouse=True)
def quick():
    """Intervals from fewer resamples."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(statistics, "RESAMPLES", 200)
        yield


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """Result and progress of one seed with 20 places and 40 pictures of our renderer."""
    out, said = tmp_path_factory.mktemp("experiment") / "localization", []
    result = localization_experiment(
        out=out, seeds=1, seed=1, locations=(5, 4), images=40, progress=lambda *what: said.append(what)
    )
    return out, result, said


def test_the_folder_holds_what_is_returned(done):
    """The JSON file equals the result; every other file exists, and none is incomplete."""
    out, result, _ = done
    assert json.loads((out / "localization.json").read_text()) == json.loads(json.dumps(result))
    assert {path.name for path in out.iterdir()} == FILES
    assert [path.name for path in out.parent.iterdir()] == [out.name]
    assert (out / "error_map.png").read_bytes().startswith(b"\x89PNG")


def test_the_result_has_its_documented_parts(done):
    """Every method has figures with intervals under every condition; the paper's figures are as published."""
    _, result, _ = done
    assert result["experiment"] == "localization" and result["renderer"] == "own"
    assert result["seeds"] == [1]
    assert (result["places"], result["pictures_per_seed"]) == (20, 40)
    assert set(result["results"]) == {*CONDITIONS, "lifted"}
    for methods in result["results"].values():
        assert set(methods) == set(METHOD_TITLES)
        for figures in methods.values():
            assert figures["located"] + sum(figures["reasons"].values()) == figures["pictures"]
            low, high = figures["rmse_ci95_cm"]
            assert low <= figures["rmse_cm"] <= high
    assert {m: list(p.values()) for m, p in result["paper"].items()} == PAPER_TABLE_2
    assert result["provenance"]["finssim"]


def test_refraction_wins_where_it_should(done):
    """Refraction is below 1 cm under every condition and at another depth, where straight lines with depth fail."""
    _, result, _ = done
    for name, methods in result["results"].items():
        assert methods["refractive"]["rmse_cm"] < 1.0, name
        assert 3.0 * methods["refractive"]["rmse_cm"] < methods["pinhole-depth"]["rmse_cm"], name
    lifted, published = result["results"]["lifted"], result["results"]["published"]
    assert lifted["pinhole-depth"]["rmse_cm"] > 2.0 * published["pinhole-depth"]["rmse_cm"]
    (calibration,) = result["calibration"]
    assert abs(calibration["camera_over_water_mm"]) < 10.0 and calibration["tilt_deg"] < 0.5


def test_the_page_shows_the_same_figures(done):
    """The page contains every RMSE of the result beside the paper's, with the seed and the map of errors."""
    out, result, _ = done
    page = (out / "localization.html").read_text(encoding="utf-8")
    for methods in [*result["results"].values(), result["paper"]]:
        for figures in methods.values():
            assert re.search(rf">{figures['rmse_cm']:.2f}[ <]", page)
    assert (
        (out / "error_map.png").is_file() and page.count('src="data:image/png') == 1 and "seeds [1]" in page
    )
    assert "not on the same places" not in page and "different experiments" in " ".join(page.split())


def test_progress_rises(done):
    """Progress rises from zero, by seed and by condition."""
    _, _, said = done
    parts = [part for part, _ in said]
    assert parts == sorted(parts) and parts[0] == 0.0 and parts[-1] < 1.0
    assert {f"seed 1, {name} conditions" for name in CONDITIONS} <= {words for _, words in said}


def test_a_user_can_calibrate_the_same_pool_again(done, tmp_path, capsys):
    """`finssim calibrate pool` on the written detections, survey and camera writes a pool with the same hash."""
    out, _, _ = done
    pool = load_pool(out / "pool.yaml")
    words = ["calibrate", "pool", out / "detections.csv", "--survey", out / "survey.yaml"]
    words += ["--camera", out / "camera.yaml", "--out", tmp_path / "again.yaml", "--seed", "1"]
    assert boundary.run(app, [str(word) for word in words]) == 0
    assert load_pool(tmp_path / "again.yaml").sha256 == pool.sha256
    assert "camera_height" in capsys.readouterr().out


def test_a_user_can_locate_the_tag_again(done):
    """Written detections, back-projected through the written pool, lie on the surveyed places to a centimetre."""
    from finssim.core.optics import back_project

    out, _, _ = done
    pool = load_pool(out / "pool.yaml")
    assert load_camera(out / "camera.yaml").lens.model == pool.camera.lens.model
    places = {}
    lines = (out / "survey.csv").read_text().splitlines()
    for line in lines[1:]:
        row = dict(zip(lines[0].split(","), line.split(","), strict=True))
        places[row["image"]] = [float(row["x"]), float(row["y"])]
    frames = read_detections(out / "detections.csv")
    assert len(frames) == 20
    for frame in frames:
        points, _ = back_project(pool.camera, pool.interface, frame.detections[0].corners).at_z(0.0)
        assert np.hypot(*(points.mean(axis=0)[:2] - places[frame.image])) < 0.015


@pytest.fixture
def published_alone(monkeypatch):
    """The published conditions instead of all three."""
    monkeypatch.setattr(module, "CONDITIONS", {"published": CONDITIONS["published"]})


def interrupting(words):
    """Return a progress function that raises Ctrl-C at its first mention of some words."""

    def progress(part, what):
        if what == words:
            raise KeyboardInterrupt

    return progress


def test_an_interruption_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        localization_experiment(
            out=tmp_path / "out", progress=interrupting("seed 1, published conditions"), seeds=1, **TINY
        )
    assert list(tmp_path.iterdir()) == []


def test_a_method_that_locates_nothing_is_no_error(published_alone, tmp_path, monkeypatch):
    """If no tag is found at the other depth, there is no figure, the count is zero, and the folder is written."""
    draw = module.pictures

    def blind(campaign, renderer):
        for picture in draw(campaign, renderer):
            gone = not campaign.calibrates.any()
            yield CampaignPicture(picture.visit, picture.name, None if gone else picture.detection)

    monkeypatch.setattr(module, "pictures", blind)
    result = localization_experiment(out=tmp_path / "out", renderer="geometry", seeds=1, **TINY)
    figures = result["results"]["lifted"]["refractive"]
    assert figures["rmse_cm"] is None and figures["located"] == 0
    assert figures["reasons"] == {"tag not detected": figures["pictures"]}
    assert ">–<" in (tmp_path / "out" / "localization.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"renderer": "blender"}, "unknown renderer 'blender'; available: own, geometry"),
        ({"seeds": 0}, "seeds is 0, expected at least 1"),
    ],
)
def test_what_cannot_be_run_is_refused(tmp_path, options, words):
    with pytest.raises(ValueError, match=words):
        localization_experiment(out=tmp_path / "out", **options)
    assert list(tmp_path.iterdir()) == []


def test_somebodys_folder_is_refused_before_the_work(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(OutputError, match="already holds files"):
        localization_experiment(out=tmp_path, progress=interrupting("seed 1, published conditions"))


@pytest.fixture
def tiny(monkeypatch):
    """The command, limited to a few places."""
    monkeypatch.setattr(module, "localization_experiment", partial(localization_experiment, **TINY))


COMMAND = ["experiment", "localization", "--renderer", "geometry"]


def test_the_command_runs_the_seeds_and_the_renderer_that_it_is_given(tiny, published_alone, tmp_path, capfd):
    """The command prints a table and the output path, or a JSON object with --json; standard error has only progress.

    Equal seeds give the function's results, number by number, and its pool; other seeds give others.
    """
    same = localization_experiment(out=tmp_path / "c", renderer="geometry", seeds=1, seed=1, **TINY)
    capfd.readouterr()
    assert finssim(*COMMAND, "--seeds", "1", "--out", tmp_path / "a") == 0
    out, err = capfd.readouterr()
    assert "renderer geometry" in out and "refractive" in out and f"written: {tmp_path / 'a'}" in out
    assert all(line.startswith("experiment localization: ") for line in err.splitlines())
    one = json.loads((tmp_path / "a" / "localization.json").read_text())
    assert one["seeds"] == [1] and one["calibration"] == same["calibration"]
    assert one["results"] == json.loads(json.dumps(same["results"]))
    assert load_pool(tmp_path / "a" / "pool.yaml").sha256 == load_pool(tmp_path / "c" / "pool.yaml").sha256
    assert finssim(*COMMAND, "--seeds", "1", "--seed", "5", "--out", tmp_path / "b", "--json") == 0
    result = json.loads(capfd.readouterr().out)
    assert result["seeds"] == [5] and result["renderer"] == "geometry"
    assert result["results"]["published"]["refractive"]["visits"] == 6
    assert result["calibration"] != one["calibration"]
    assert json.loads((tmp_path / "b" / "localization.json").read_text()) == result


def test_the_command_draws_three_times_with_our_renderer_unless_told_otherwise(monkeypatch, tmp_path):
    """By default the command draws three campaigns with our renderer, as stated in the help."""
    given = {}

    def asked(**options):
        given.update(options)
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "localization_experiment", asked)
    assert finssim("experiment", "localization", "--out", tmp_path / "x") == 130
    assert (given["renderer"], given["seeds"], given["seed"]) == ("own", 3, 1)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--renderer", "blender", "--out", "x"], "unknown renderer 'blender'; available: own"),
        (["--seeds", "0", "--out", "x"], "Invalid value for '--seeds'"),
        (["--seeds", "1001", "--out", "x"], "Invalid value for '--seeds'"),
        (["--seed", "-1", "--out", "x"], "Invalid value for '--seed'"),
        (["--out", "/proc/x/y"], "write elsewhere"),
        ([], "Missing option '--out'"),
    ],
)
def test_the_command_refuses_in_a_sentence(capsys, tmp_path, monkeypatch, words, sentence):
    """Each request is refused before any work begins, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    assert finssim("experiment", "localization", *words) == 2
    (line,) = filter(None, capsys.readouterr().err.splitlines())
    assert line.startswith("finssim: ") and sentence in line
    assert list(tmp_path.iterdir()) == []


def test_methods_are_told_the_noise_that_the_calibration_found(monkeypatch):
    """Every method gets the standard deviation of a corner from the residuals of the same conditions."""
    from finssim.studies import localization as experiment

    told = []
    locate = experiment.locate
    monkeypatch.setattr(
        experiment,
        "locate",
        lambda *words, **named: told.append(named["pixel_std"]) or locate(*words, **named),
    )
    one = experiment._play_seed("published", 1, "geometry", {"locations": (5, 4), "images": 40})
    assert len(told) == len(experiment.METHOD_TITLES)
    assert set(told) == {one.calibration.refractive.pixel_std} and one.calibration.refractive.pixel_std > 0.1
