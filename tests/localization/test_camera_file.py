"""Camera files of every format give the same lens, and what is missing is refused in one sentence."""

import json

import numpy as np
import pytest

from finssim.core.optics import Lens
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
MESSAGE = f"width: 640\nheight: 480\ndistortion_model: plumb_bob\nD: {list(FIVE)}\nK: {FLAT}\nP: {[*FLAT, 0, 0, 0]}\n"
"""A ROS message, as `rostopic echo` prints it."""


def matlab(matrix=None, **changes):
    """Return what `jsonencode(toStruct(cameraParams))` writes: the first pixel is 1, the older matrix is transposed."""
    older = [[535.9, 0.0, 0.0], [0.0, 536.2, 0.0], [343.3, 236.6, 1.0]]
    tree = {
        "RadialDistortion": [FIVE[0], FIVE[1], FIVE[4]],
        "TangentialDistortion": FIVE[2:4],
        "ImageSize": [480, 640],
        "EstimateSkew": False,
        "NumRadialDistortionCoefficients": 3,
        "WorldPoints": [[0, 0], [25, 0]],
        "WorldUnits": "mm",
        "Version": {"major": 1},
        **(matrix or {"IntrinsicMatrix": older}),
        **changes,
    }
    return json.dumps(tree)


DIALECTS = {
    "opencv": (OPENCV, Lens(**NUMBERS, distortion=FIVE)),
    "opencv's fisheye": (
        OPENCV.replace("flags: 2", "fisheye_model: 1").replace(str(list(FIVE)), str(list(FOUR))),
        Lens(**NUMBERS, model="fisheye", distortion=FOUR),
    ),
    "ros": (ros("plumb_bob", FIVE), Lens(**NUMBERS, distortion=FIVE)),
    "ros rational": (ros("rational_polynomial", EIGHT), Lens(**NUMBERS, model="rational", distortion=EIGHT)),
    "ros fisheye": (ros("equidistant", FOUR), Lens(**NUMBERS, model="fisheye", distortion=FOUR)),
    "ros message": (MESSAGE, Lens(**NUMBERS, distortion=FIVE)),
    "kalibr": (KALIBR, Lens(**NUMBERS, model="fisheye", distortion=FOUR)),
    "kalibr radtan": (KALIBR.replace("equidistant", "radtan"), Lens(**NUMBERS, distortion=FOUR)),
    "matlab": (matlab(), Lens(**NUMBERS, distortion=FIVE)),
    "matlab of 2022": (
        matlab({"K": [[535.9, 0.0, 343.3], [0.0, 536.2, 236.6], [0.0, 0.0, 1.0]]}),
        Lens(**NUMBERS, distortion=FIVE),
    ),
    "matlab, two radial coefficients": (
        matlab(RadialDistortion=FIVE[:2]),
        Lens(**NUMBERS, distortion=(*FIVE[:4], 0.0)),
    ),
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
    "no size": (
        ros("plumb_bob", FIVE).replace("image_height: 480\n", ""),
        "add image_width and image_height",
    ),
    "one size": (KALIBR.replace("[640, 480]", "[640]"), "size of the image is missing: add resolution"),
    "no distortion": (MESSAGE.replace(f"D: {list(FIVE)}\n", ""), "D is missing; zeros mean no distortion"),
    "skew": (MESSAGE.replace(str(FLAT), str([535.9, 3.0, *FLAT[2:]])), "skew"),
    "not a number": ("lens: {width: 640, height: 480, fx: wide, cx: 1, cy: 1}\n", "fx holds 'wide'"),
    "negative focal length": (
        "lens: {width: 640, height: 480, fx: -5, cx: 1, cy: 1}\n",
        "camera.yaml: lens: ",
    ),
    "unknown key": ("lens: {width: 640, height: 480, fx: 5, cx: 1, cy: 1, k1: 0.1}\n", "unknown key 'k1'"),
    "empty": ("", "found nothing"),
    "unknown model": (ros("eucm", FOUR), "unknown lens model 'eucm'"),
    "unknown projection": (KALIBR.replace("pinhole", "omni"), "unknown camera_model 'omni'"),
    "unknown model of ours": (
        "lens: {width: 640, height: 480, fx: 5, cx: 1, cy: 1, model: eucm}\n",
        "unknown lens model 'eucm'",
    ),
    "unknown key with numbers": (ros("plumb_bob", FIVE) + "xi: 1.2\n", "unknown key 'xi' holds numbers"),
    "two cameras": (KALIBR + KALIBR.replace("cam0", "cam1"), "holds cam0, cam1, expected one camera"),
    "binned": (ros("plumb_bob", FIVE) + "binning_x: 2\n", "binning_x is 2"),
    "part of the picture": (ros("plumb_bob", FIVE) + "roi: {x_offset: 8, width: 9}\n", "roi is {"),
    "transposed": (
        MESSAGE.replace(str(FLAT), str([x for row in zip(*K, strict=True) for x in row])),
        "expected rows [fx, 0, cx]",
    ),
    "no camera matrix": (
        MESSAGE.replace(str(FLAT), str([1.0, *FLAT[1:8], 2.0])),
        "expected rows [fx, 0, cx]",
    ),
    "eight numbers": (MESSAGE.replace(str(FLAT), str(FLAT[:8])), "K holds 8 numbers, expected 9"),
    "key beside our lens": (
        "lens: {width: 640, height: 480, fx: 5, cx: 1, cy: 1}\nlense: {fx: 6}\n",
        "unknown key 'lense'",
    ),
    "radial coefficients of MATLAB": (matlab(RadialDistortion=[0.1]), "RadialDistortion of 2 or 3 numbers"),
    "tangential coefficients of MATLAB": (matlab(TangentialDistortion=[0.1]), "TangentialDistortion of 2"),
    "width and height, or rows and columns": (
        json.dumps({"mtx": K, "dist": FIVE, "image_size": [640, 480]}),
        "give image_width and image_height",
    ),
    **{
        name: (
            text,
            "no camera in a known format; expected FinsSim (lens), ROS (camera_info, ost.txt), Kalibr",
        )
        for name, text in {
            "plain numbers": "width: 640\nheight: 480\nfx: 535.9\nfy: 536.2\ncx: 342.3\ncy: 235.6\nk1: 0.1\n",
            "no camera at all": "image_width: 640\nimage_height: 480\n",
        }.items()
    },
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
