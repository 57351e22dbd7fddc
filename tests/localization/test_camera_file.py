"""A written camera file gives the same lens, and missing or unknown entries are refused in one sentence."""

import pytest

from finssim.core.optics import Lens
from finssim.localization import LocalizationError
from finssim.localization.camera_file import load_camera, write_camera

NUMBERS = {"width": 640, "height": 480, "fx": 535.9, "fy": 536.2, "cx": 342.3, "cy": 235.6}
COEFFICIENTS = {
    "plumb_bob": (-0.266, -0.0386, 0.00178, -0.00028, 0.238),
    "rational": (-0.266, -0.0386, 0.00178, -0.00028, 0.238, 0.01, 0.02, 0.03),
    "fisheye": (0.01, -0.02, 0.003, -0.004),
}
OURS = "lens: {width: 640, height: 480, fx: 5, cx: 320, cy: 240}\n"


@pytest.mark.parametrize("model", COEFFICIENTS)
def test_a_written_camera_reads_back(model, tmp_path):
    """Writing keeps every digit of the lens, and the record."""
    lens = Lens(**NUMBERS, model=model, distortion=COEFFICIENTS[model])
    write_camera(tmp_path / "camera.yaml", lens, {"views": 13, "rms_px": 1 / 3})
    read = load_camera(tmp_path / "camera.yaml")
    assert read.lens == lens
    assert read.record == {"views": 13, "rms_px": 1 / 3}


def test_a_file_by_hand_needs_one_focal_length_and_no_distortion(tmp_path):
    (tmp_path / "camera.yaml").write_text(OURS)
    assert load_camera(tmp_path / "camera.yaml").lens == Lens(640, 480, 5.0, 5.0, 320.0, 240.0)


UNKNOWN_FORMAT = "no camera in a known format; expected FinsSim (lens), ROS (camera_info, ost.txt), Kalibr"
REFUSED = {
    "not a number": (OURS.replace("fx: 5", "fx: wide"), "fx holds 'wide'"),
    "negative focal length": (OURS.replace("fx: 5", "fx: -5"), "camera.yaml: lens: "),
    "unknown key": (OURS.replace("cy: 240", "cy: 240, k1: 0.1"), "unknown key 'k1'"),
    "unknown model": (OURS.replace("cy: 240", "cy: 240, model: eucm"), "unknown lens model 'eucm'"),
    "key beside our lens": (OURS + "lense: {fx: 6}\n", "unknown key 'lense'"),
    "empty": ("", "found nothing"),
    "plain numbers": ("width: 640\nheight: 480\nfx: 535.9\ncx: 342.3\ncy: 235.6\nk1: 0.1\n", UNKNOWN_FORMAT),
    "no camera at all": ("image_width: 640\nimage_height: 480\n", UNKNOWN_FORMAT),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_file_that_tells_no_lens_is_refused(case, tmp_path):
    """The sentence names the file and the problem."""
    text, expected = REFUSED[case]
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(LocalizationError, match="camera.yaml") as refusal:
        load_camera(path)
    assert expected in str(refusal.value)


def test_a_missing_file_is_named(tmp_path):
    """A path that does not exist is refused by name."""
    with pytest.raises(LocalizationError, match="nowhere.yaml: cannot be read"):
        load_camera(tmp_path / "nowhere.yaml")
