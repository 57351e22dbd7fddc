"""`finssim calibrate camera`: from photographs to a camera file that reads back."""

import json
from pathlib import Path

import pytest

from finssim.localization.camera_file import load_camera
from finssim.survey.camera import BoardChoice, run
from finssim.trials.findings import CalibrationError
from survey.board_views import PHOTOGRAPHS

CHESSBOARD = BoardChoice(board="9x6", square=0.025)
SOME = [PHOTOGRAPHS / f"left{i:02d}.jpg" for i in (1, 2, 3, 5, 6, 8)]


@pytest.mark.slow
def test_photographs_become_a_camera_file(tmp_path, capsys):
    """The file holds the lens with its intervals; the report its pictures."""
    fit = run(SOME, out=tmp_path / "camera.yaml", board=CHESSBOARD, report=tmp_path / "report")
    read = load_camera(tmp_path / "camera.yaml")
    assert read.lens == fit.lens
    low, high = read.record["estimates"]["fx"]["ci95"]
    assert low < read.lens.fx < high
    names = {file.name for file in (tmp_path / "report").iterdir()}
    assert names == {"report.html", "fit.json", "coverage.png", "residuals.png"}
    printed = capsys.readouterr().out
    assert "6 of 6 views" in printed and "views are few" in printed


def test_json_is_one_object(tmp_path, capsys):
    run(SOME, out=tmp_path / "camera.yaml", board=CHESSBOARD, as_json=True)
    document = json.loads(capsys.readouterr().out)
    assert document["kind"] == "camera"
    assert {view["name"] for view in document["per_view"]} == {path.name for path in SOME}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"board": BoardChoice(board="9x6", charuco="7x5")}, "both given"),
        ({"model": "pinhole"}, "unknown lens model"),
        ({"board": BoardChoice(board="nine")}, "such as 9x6"),
        ({"board": BoardChoice(board="5x4")}, "check the count of the board's corners"),
        ({"board": BoardChoice(charuco="7x5")}, "none of 6 pictures shows"),
        ({"out": Path("camera.txt")}, "expected .yaml"),
    ],
)
def test_what_cannot_be_done_is_refused_and_nothing_is_written(tmp_path, options, words):
    arguments = {"out": tmp_path / "camera.yaml", "board": BoardChoice(), **options}
    with pytest.raises(CalibrationError, match=words):
        run(SOME, **arguments)
    assert not (tmp_path / "camera.yaml").exists()
