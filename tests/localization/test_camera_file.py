"""Camera files say the same lens in every dialect, and what is missing in one sentence."""

import json

import numpy as np
import pytest

from finssim.geometry.optics import Lens
from finssim.localization import LocalizationError
from finssim.localization.camera_file import load_camera, write_camera

NUMBERS = {"width": 640, "height": 480, "fx": 535.9, "fy": 536.2, "cx": 342.3, "cy": 235.6}
FIVE = (-0.266, -0.0386, 0.00178, -0.00028, 0.238)
FOUR = (0.01, -0.02, 0.003, -0.004)
K = [[535.9, 0.0, 342.3], [0.0, 536.2, 235.6], [0.0, 0.0, 1.0]]
FLAT = [x for row in K for x in row]

OPENCV = f"""%YAML:1.0
---
calibration_time: "Fri 20 Nov 2026"
image_width: 640
image_height: 480
flags: 2
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.359e+02, 0., 3.423e+02, 0.,
       5.362e+02, 2.356e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: {list(FIVE)}
"""


def ros(model, coefficients):
    """A ROS camera_info file."""
    return f"""image_width: 640
image_height: 480
camera_name: pool
camera_matrix: {{rows: 3, cols: 3, data: {FLAT}}}
distortion_model: {model}
distortion_coefficients: {{rows: 1, cols: {len(coefficients)}, data: {list(coefficients)}}}
rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
"""


KALIBR = f"""cam0:
  camera_model: pinhole
  distortion_coeffs: {list(FOUR)}
  distortion_model: equidistant
  intrinsics: [535.9, 536.2, 342.3, 235.6]
  resolution: [640, 480]
"""
EIGHT = (*FIVE, 0.01, 0.02, 0.03)
DIALECTS = {
    "opencv": (OPENCV, Lens(**NUMBERS, distortion=FIVE)),
    "ros": (ros("plumb_bob", FIVE), Lens(**NUMBERS, distortion=FIVE)),
    "ros rational": (ros("rational_polynomial", EIGHT), Lens(**NUMBERS, model="rational", distortion=EIGHT)),
    "ros fisheye": (ros("equidistant", FOUR), Lens(**NUMBERS, model="fisheye", distortion=FOUR)),
    "kalibr": (KALIBR, Lens(**NUMBERS, model="fisheye", distortion=FOUR)),
    "nested json": (
        json.dumps({"camera_matrix": K, "dist_coeffs": [list(FIVE)], "image_size": [640, 480]}),
        Lens(**NUMBERS, distortion=FIVE),
    ),
    "plain numbers": (
        "width: 640\nheight: 480\nfx: 535.9\nfy: 536.2\ncx: 342.3\ncy: 235.6\nk1: 0.1\nk2: -0.2\n",
        Lens(**NUMBERS, distortion=(0.1, -0.2, 0.0, 0.0, 0.0)),
    ),
    "named coefficients of a fisheye": (
        "width: 640\nheight: 480\nfx: 535.9\nfy: 536.2\ncx: 342.3\ncy: 235.6\nmodel: fisheye\nk1: 0.1\nk3: 0.02\n",
        Lens(**NUMBERS, model="fisheye", distortion=(0.1, 0.0, 0.02, 0.0)),
    ),
    "named coefficients with k3": (
        "width: 640\nheight: 480\nfx: 535.9\nfy: 536.2\ncx: 342.3\ncy: 235.6\nk1: 0.1\nk3: 0.02\n",
        Lens(**NUMBERS, distortion=(0.1, 0.0, 0.0, 0.0, 0.02)),
    ),
    "opencv's fisheye": (
        OPENCV.replace("flags: 2", "fisheye_model: 1").replace(str(list(FIVE)), str(list(FOUR))),
        Lens(**NUMBERS, model="fisheye", distortion=FOUR),
    ),
    **{
        word: (ros(word, FOUR), Lens(**NUMBERS, model="fisheye", distortion=FOUR))
        for word in ("kannala_brandt", "KannalaBrandt8", "opencv_fisheye", "OPENCV_FISHEYE", "kb4", "fisheye")
    },
    "colmap": (ros("FULL_OPENCV", EIGHT), Lens(**NUMBERS, model="rational", distortion=EIGHT)),
    "ours with another's word": (
        "lens: {model: kannala_brandt, width: 640, height: 480, fx: 535.9, fy: 536.2, cx: 342.3, cy: 235.6, "
        "distortion: [0.01, -0.02, 0.003, -0.004]}\n",
        Lens(**NUMBERS, model="fisheye", distortion=FOUR),
    ),
    "no distortion": ("image_width: 640\nimage_height: 480\nK: " + str(FLAT) + "\n", Lens(**NUMBERS)),
    "ours": (
        "lens: {model: fisheye, width: 640, height: 480, fx: 535.9, fy: 536.2, cx: 342.3, cy: 235.6, "
        "distortion: [0.01, -0.02, 0.003, -0.004]}\n",
        Lens(**NUMBERS, model="fisheye", distortion=FOUR),
    ),
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_every_dialect_tells_the_same_lens(dialect, tmp_path):
    """A lens in a foreign file is the lens with the same numbers in ours."""
    text, expected = DIALECTS[dialect]
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    found = load_camera(path).lens
    assert found.model == expected.model
    points = np.array([[0.1, 0.2, 1.0], [-0.3, 0.1, 0.9], [0.0, 0.0, 2.0]])
    np.testing.assert_allclose(found.project(points)[0], expected.project(points)[0], rtol=0, atol=1e-12)
    assert (found.width, found.height) == (640, 480)


@pytest.mark.parametrize("model, coefficients", [("plumb_bob", FIVE), ("rational", EIGHT), ("fisheye", FOUR)])
def test_a_written_camera_reads_back(model, coefficients, tmp_path):
    """Writing keeps every digit of the lens, and the record."""
    lens = Lens(**NUMBERS, model=model, distortion=coefficients)
    write_camera(tmp_path / "camera.yaml", lens, {"views": 13, "rms_px": 1 / 3})
    read = load_camera(tmp_path / "camera.yaml")
    assert read.lens == lens
    assert read.record == {"views": 13, "rms_px": 1 / 3}


REFUSED = {
    "no size": (f"K: {FLAT}\n", "image_width"),
    "no matrix": ("image_width: 640\nimage_height: 480\n", "camera matrix"),
    "skew": (f"image_width: 9\nimage_height: 9\nK: {[500.0, 3.0, *FLAT[2:]]}\n", "skew"),
    "not a number": ("lens: {width: 640, height: 480, fx: wide, cx: 1, cy: 1}\n", "fx holds 'wide'"),
    "negative focal length": (
        "lens: {width: 640, height: 480, fx: -5, cx: 1, cy: 1}\n",
        "camera.yaml: lens: ",
    ),
    "unknown key": ("lens: {width: 640, height: 480, fx: 5, cx: 1, cy: 1, k1: 0.1}\n", "unknown key 'k1'"),
    "empty": ("", "found nothing"),
    "unknown model": (ros("eucm", FOUR), "unknown lens model 'eucm'"),
    "unknown projection": (KALIBR.replace("pinhole", "omni"), "unknown lens model 'omni'"),
    "two models": (ros("plumb_bob", FOUR) + "fisheye: true\n", "two lens models, fisheye and plumb_bob"),
    "unknown model of ours": (
        "lens: {width: 640, height: 480, fx: 5, cx: 1, cy: 1, model: eucm}\n",
        "unknown lens model 'eucm'",
    ),
    "unknown key with numbers": (ros("plumb_bob", FIVE) + "xi: 1.2\n", "unknown key 'xi' holds numbers"),
    "distortion under another name": (
        f"width: 640\nheight: 480\nK: {FLAT}\nRadialDistortion: [0.1, 0.2]\n",
        "unknown key 'RadialDistortion' holds numbers",
    ),
    "two cameras": (KALIBR + KALIBR.replace("cam0", "cam1"), "unknown key 'cam1' holds numbers"),
    "binned": (ros("plumb_bob", FIVE) + "binning_x: 2\n", "binning_x is 2"),
    "part of the picture": (ros("plumb_bob", FIVE) + "roi: {x_offset: 8, width: 9}\n", "roi is {"),
    "transposed": (
        f"width: 640\nheight: 480\nK: {[list(row) for row in zip(*K, strict=True)]}\n",
        "the camera matrix is transposed",
    ),
    "no camera matrix": (
        f"width: 640\nheight: 480\nK: {[1.0, *FLAT[1:8], 2.0]}\n",
        "expected rows [fx, 0, cx]",
    ),
    "k4 of plumb_bob": (
        f"width: 640\nheight: 480\nK: {FLAT}\nmodel: plumb_bob\nk1: 0.1\nk4: 0.1\n",
        "a plumb_bob lens has no k4",
    ),
    "one size": (f"image_size: [640]\nK: {FLAT}\n", "size of the image is missing"),
    "key beside our lens": (
        "lens: {width: 640, height: 480, fx: 5, cx: 1, cy: 1}\nlense: {fx: 6}\n",
        "unknown key 'lense'",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_file_that_tells_no_lens_is_refused(case, tmp_path):
    """The sentence names the file and what is wrong."""
    text, expected = REFUSED[case]
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(LocalizationError, match="camera.yaml") as refusal:
        load_camera(path)
    assert expected in str(refusal.value)


def test_a_missing_file_is_named(tmp_path):
    """A path that is not there is refused by name."""
    with pytest.raises(LocalizationError, match="nowhere.yaml: cannot be read"):
        load_camera(tmp_path / "nowhere.yaml")
