"""Each lens importer reproduces the pixels of its program's own equations, and refuses unreadable files."""

import json
import struct
import warnings

import numpy as np
import pytest
from scipy.io import savemat

from finssim.core.importer import check_registered
from finssim.core.registry import IMPORTERS, RegistryError
from finssim.localization import LocalizationError
from finssim.localization.camera_file import LensWarning, load_camera

W, H, FX, FY, CX, CY = 1280, 720, 541.0, 541.2, 639.5, 359.5
K1, K2, P1, P2, K3 = FIVE = -0.21, 0.041, 0.0012, -0.0007, -0.003
T1, T2, T3, T4 = 0.11, -0.03, 0.02, -0.005
STRAIGHT = (0.0,) * 5
POINTS = np.array([[0.0, 0.0, 1.0], [0.3, -0.2, 1.0], [-0.5, 0.25, 0.9], [0.1, 0.4, 1.5]])
MATRIX = [FX, 0.0, CX, 0.0, FY, CY, 0.0, 0.0, 1.0]


def brown(k=(K1, K2, K3), p=(P1, P2), below=(0.0, 0.0, 0.0)):
    """Return pixels by Brown's equations, from pixel centres: a ratio of radial polynomials and tangential terms."""
    x, y = (POINTS[:, :2] / POINTS[:, 2:]).T
    r2 = x * x + y * y
    radial = 1 + sum(c * r2 ** (i + 1) for i, c in enumerate(k))
    radial /= 1 + sum(c * r2 ** (i + 1) for i, c in enumerate(below))
    u = x * radial + 2 * p[0] * x * y + p[1] * (r2 + 2 * x * x)
    v = y * radial + p[0] * (r2 + 2 * y * y) + 2 * p[1] * x * y
    return np.stack([FX * u + CX, FY * v + CY], -1)


def kannala(t=(T1, T2, T3, T4)):
    """Return pixels by Kannala and Brandt's equations: a polynomial of the angle to the axis."""
    x, y = (POINTS[:, :2] / POINTS[:, 2:]).T
    r = np.hypot(x, y)
    angle = np.arctan(r)
    bent = angle * (1 + sum(c * angle ** (2 * i + 2) for i, c in enumerate(t)))
    scale = np.divide(bent, r, out=np.ones_like(r), where=r > 0)
    return np.stack([FX * x * scale + CX, FY * y * scale + CY], -1)


def text(content):
    return lambda path: path.write_text(content)


def xml(**more):
    """Return the XML of OpenCV's FileStorage, with the names of its older sample."""
    values = "".join(f"<{key}>{value}</{key}>" for key, value in more.items())
    k = " ".join(map(repr, MATRIX))
    return (
        f'<?xml version="1.0"?>\n<opencv_storage>\n<calibration_Time>"Fri Nov 27 12:00:00 2026"</calibration_Time>'
        f"<image_Width>{W}</image_Width><image_Height>{H}</image_Height>"
        f'<Camera_Matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt><data>\n  {k}</data>'
        "</Camera_Matrix>"
        f"{values}</opencv_storage>\n"
    )


def xml_matrix(numbers):
    return f"<rows>{len(numbers)}</rows><cols>1</cols><dt>d</dt><data>{' '.join(map(str, numbers))}</data>"


OST = f"""# oST version 5.0 parameters


[image]

width
{W}

height
{H}

[narrow_stereo]

camera matrix
{FX} 0.000000 {CX}
0.000000 {FY} {CY}
0.000000 0.000000 1.000000

distortion
{K1} {K2} {P1} {P2} {K3}

rectification
1.0 0.0 0.0
0.0 1.0 0.0
0.0 0.0 1.0

projection
{FX} 0.0 {CX} 0.0
0.0 {FY} {CY} 0.0
0.0 0.0 1.0 0.0
"""


def ros(model, coefficients):
    return (
        f"image_width: {W}\nimage_height: {H}\ncamera_name: low_light\n"
        f"camera_matrix: {{rows: 3, cols: 3, data: {MATRIX}}}\ndistortion_model: {model}\n"
        f"distortion_coefficients: {{rows: 1, cols: {len(coefficients)}, data: {list(coefficients)}}}\n"
    )


MESSAGE = f"width: {W}\nheight: {H}\ndistortion_model: plumb_bob\nD: {list(FIVE)}\nK: {MATRIX}\nP: {MATRIX}\n"
"""A message of ROS 1, as `rostopic echo` prints it."""

MESSAGE_2 = f"""header:
  stamp: {{sec: 17, nanosec: 5}}
  frame_id: camera
height: {H}
width: {W}
distortion_model: plumb_bob
d: {list(FIVE)}
k: {MATRIX}
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [541.0, 0.0, 639.5, 0.0, 0.0, 541.2, 359.5, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi: {{x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}}
"""
"""A message of ROS 2, as `ros2 topic echo` prints it."""


KALIBR = f"""cam0:
  camera_model: pinhole
  distortion_coeffs: {[T1, T2, T3, T4]}
  distortion_model: equidistant
  intrinsics: {[FX, FY, CX, CY]}
  resolution: {[W, H]}
"""


def opencv(coefficients, more=""):
    """Return the YAML of OpenCV's FileStorage, with the names of its sample."""

    def matrix(numbers):
        return f"!!opencv-matrix\n   rows: {len(numbers)}\n   cols: 1\n   dt: d\n   data: {list(numbers)}\n"

    return (
        f'%YAML:1.0\n---\ncalibration_time: "Fri 20 Nov 2026"\nimage_width: {W}\nimage_height: {H}\nflags: 2\n{more}'
        f"camera_matrix: {matrix(MATRIX)}distortion_coefficients: {matrix(coefficients)}"
    )


def colmap(model, *parameters):
    return text(
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"# Number of cameras: 1\n7 {model} {W} {H} {' '.join(map(repr, parameters))}\n"
    )


def colmap_binary(kind, *parameters):
    head = struct.pack("<QiiQQ", 1, 7, kind, W, H)
    return lambda path: path.write_bytes(head + struct.pack(f"<{len(parameters)}d", *parameters))


FOCAL = (FX, FY, CX + 0.5, CY + 0.5)
"""Focal lengths and centre as written by programs that count pixels from the corner of the first one."""


def nerfstudio(frame=None, **more):
    lens = {"w": W, "h": H, "fl_x": FX, "fl_y": FY, "cx": CX + 0.5, "cy": CY + 0.5}
    of_frame = {"file_path": "images/1.png", "transform_matrix": np.eye(4).tolist()}
    frames = [of_frame | (frame or {}), of_frame]
    return text(json.dumps({**lens, **more, "frames": frames, "applied_transform": np.eye(4)[:3].tolist()}))


def orb(kind, prefix="Camera", **lens):
    """Return the settings of ORB-SLAM2, or of ORB-SLAM3, where the camera is named Camera1."""
    lines = [f"{prefix}.{key}: {value}" for key, value in lens.items()]
    focal = [f"{prefix}.{name}: {x}" for name, x in (("fx", FX), ("fy", FY), ("cx", CX), ("cy", CY))]
    return text(
        "\n".join(
            [
                "%YAML:1.0", "", f'Camera.type: "{kind}"', *focal, *lines, f"Camera.width: {W}", f"Camera.height: {H}",
                "Camera.fps: 20", "Camera.RGB: 1", "ORBextractor.nFeatures: 1000", "ThDepth: 40.0",
                "IMU.T_b_c1: !!opencv-matrix", "   rows: 2", "   cols: 2", "   dt: f", "   data: [1.0, 0, 0, 1]", "",
            ]
        )
    )  # fmt: skip


def matlab(**matrix):
    """Return a file with the struct of cameraParameters or cameraIntrinsics, .mat or .json; the first pixel is 1."""
    struct_ = {
        "RadialDistortion": [K1, K2, K3], "TangentialDistortion": [P1, P2], "ImageSize": [H, W],
        "WorldUnits": "mm", "NumRadialDistortionCoefficients": 3, **matrix,
    }  # fmt: skip

    def write(path):
        if path.suffix == ".mat":
            savemat(path, {"s": struct_}, do_compression=True)
        else:
            path.write_text(json.dumps({**struct_, "Version": {"major": 1}}))

    return write


ONE = np.array([[FX, 0, CX + 1], [0, FY, CY + 1], [0, 0, 1]])

EIGHT = (*FIVE, 0.01, 0.002, -0.001)
RATIONAL = {"below": EIGHT[5:]}
OLDER = ONE.T.tolist()
"""Camera matrix of older versions of MATLAB, which is transposed."""

READ = {
    "ROS": ("c.yaml", text(ros("plumb_bob", FIVE)), brown()),
    "ROS rational_polynomial": ("c.yaml", text(ros("rational_polynomial", EIGHT)), brown(**RATIONAL)),
    "ROS 1 message": ("c.yaml", text(MESSAGE), brown()),
    "Kalibr": ("c.yaml", text(KALIBR), kannala()),
    "Kalibr radtan": (
        "c.yaml",
        text(KALIBR.replace("equidistant", "radtan").replace(str([T1, T2, T3, T4]), str([K1, K2, P1, P2]))),
        brown((K1, K2)),
    ),
    "OpenCV YAML": ("c.yaml", text(opencv(FIVE)), brown()),
    "OpenCV YAML fisheye": ("c.yaml", text(opencv((T1, T2, T3, T4), "fisheye_model: 1\n")), kannala()),
    "MATLAB as JSON": ("p.json", matlab(IntrinsicMatrix=OLDER, WorldPoints=[[0, 0], [25, 0]]), brown()),
    "MATLAB of 2022 as JSON": ("p.json", matlab(K=ONE.tolist()), brown()),
    "MATLAB with two radial coefficients": (
        "p.json", matlab(K=ONE.tolist(), RadialDistortion=[K1, K2]), brown((K1, K2)),
    ),
    "ROS equidistant": ("c.yaml", text(ros("equidistant", (T1, T2, T3, T4))), kannala()),
    "ROS kannala_brandt": ("c.yaml", text(ros("kannala_brandt", (T1, T2, T3, T4))), kannala()),
    "ROS opencv_fisheye": ("c.yaml", text(ros("opencv_fisheye", (T1, T2, T3, T4))), kannala()),
    "ROS ost.txt": ("ost.txt", text(OST), brown()),
    "ROS 2 message": ("c.yaml", text(MESSAGE_2), brown()),
    "OpenCV XML": (
        "out.xml", text(xml(Distortion_Coefficients=xml_matrix(list(FIVE)), fisheye_model="0")), brown(),
    ),
    "OpenCV XML fisheye": (
        "out.xml", text(xml(distortion_coefficients=xml_matrix([T1, T2, T3, T4]), fisheye_model="1")), kannala(),
    ),
    "OpenCV JSON": (
        "c.json",
        text(json.dumps({"image_width": W, "image_height": H, "mtx": np.reshape(MATRIX, (3, 3)).tolist(),
                         "dist": [list(FIVE)]})),
        brown(),
    ),
    "OpenCV with the word of a model": (
        "c.yaml", text(ros("equidistant", (T1, T2, T3, T4)).replace("distortion_model", "camera_model")), kannala(),
    ),
    "COLMAP OPENCV": ("cameras.txt", colmap("OPENCV", *FOCAL, K1, K2, P1, P2), brown((K1, K2))),
    "COLMAP OPENCV_FISHEYE": ("cameras.txt", colmap("OPENCV_FISHEYE", *FOCAL, T1, T2, T3, T4), kannala()),
    "COLMAP FULL_OPENCV": (
        "cameras.txt", colmap("FULL_OPENCV", *FOCAL, *EIGHT), brown(**RATIONAL),
    ),
    "COLMAP binary": ("cameras.bin", colmap_binary(4, *FOCAL, K1, K2, P1, P2), brown((K1, K2))),
    "nerfstudio OPENCV": (
        "transforms.json", nerfstudio(camera_model="OPENCV", k1=K1, k2=K2, p1=P1, p2=P2, k3=K3, k4=0.0), brown(),
    ),
    "nerfstudio OPENCV_FISHEYE": (
        "transforms.json", nerfstudio({"k1": T1}, camera_model="OPENCV_FISHEYE", k2=T2, k3=T3, k4=T4), kannala(),
    ),
    "instant-ngp fisheye": ("transforms.json", nerfstudio(is_fisheye=True, k1=T1, k2=T2, k3=T3, k4=T4), kannala()),
    "ORB-SLAM2": ("Cam.yaml", orb("PinHole", k1=K1, k2=K2, p1=P1, p2=P2, k3=K3), brown()),
    "ORB-SLAM3": ("Cam.yaml", orb("KannalaBrandt8", "Camera1", k1=T1, k2=T2, k3=T3, k4=T4), kannala()),
    "MATLAB cameraParameters": ("p.mat", matlab(IntrinsicMatrix=ONE.T, EstimateSkew=0), brown()),
    "MATLAB cameraParameters of 2022": ("p.mat", matlab(K=ONE, WorldPoints=np.ones((4, 2))), brown()),
    "MATLAB cameraIntrinsics": (
        "p.mat", matlab(FocalLength=[FX, FY], PrincipalPoint=[CX + 1, CY + 1], Skew=0.0), brown(),
    ),
}  # fmt: skip
"""Name -> file, function that writes it, and the pixels of POINTS."""


@pytest.mark.parametrize("name", READ)
def test_a_foreign_lens_gives_the_pixels_of_its_own_equations(name, tmp_path):
    """Pixels agree to a millionth, which reveals the order of coefficients and the pixel origin."""
    file, write, pixels = READ[name]
    write(tmp_path / file)
    lens = load_camera(tmp_path / file).lens
    assert (lens.width, lens.height) == (W, H)
    np.testing.assert_allclose(lens.project(POINTS)[0], pixels, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize(("model", "numbers", "words"), [
    ("SIMPLE_PINHOLE", (FX, CX, CY), "fx cx cy"), ("PINHOLE", FOCAL, ""), ("SIMPLE_RADIAL", (FX, CX, CY, K1), ""),
    ("RADIAL", (FX, CX, CY, K1, K2), ""), ("SIMPLE_RADIAL_FISHEYE", (FX, CX, CY, T1), ""),
    ("RADIAL_FISHEYE", (FX, CX, CY, T1, T2), ""),
])  # fmt: skip
def test_small_models_of_colmap_have_no_further_coefficients(model, numbers, words, tmp_path):
    colmap(model, *numbers)(tmp_path / "cameras.txt")
    lens = load_camera(tmp_path / "cameras.txt").lens
    rest = [x for x in numbers if x in (K1, K2, T1, T2)]
    assert [x for x in lens.distortion if x] == rest and lens.fx == FX
    assert lens.model == ("fisheye" if "FISHEYE" in model else "plumb_bob")
    assert lens.fy == (FX if model.startswith(("SIMPLE", "RADIAL")) else FY)


REFUSED = {
    "ost.txt without a model": ("ost.txt", text(OST.replace(f" {K3}\n", "\n")), "give ost.yaml, which names it"),
    "OpenCV with 4 coefficients": (
        "c.yaml", text(ros("x", (T1,) * 4).replace("distortion_model: x\n", "")), "add distortion_model: plumb_bob",
    ),
    "OpenCV with an unknown model": (
        "c.yaml", text(ros("mei", (T1,) * 4).replace("distortion_model", "lens_model")), "unknown lens model 'mei'",
    ),
    "COLMAP with two cameras": (
        "cameras.txt", text("1 PINHOLE 9 9 5 5 6 6\n2 PINHOLE 9 9 5 5 6 6\n"), "its cameras are 1, 2, expected one",
    ),
    "COLMAP FOV": ("cameras.txt", colmap("FOV", *FOCAL, 0.9), "its model is FOV, expected one of"),
    "COLMAP cut": ("cameras.bin", lambda path: path.write_bytes(struct.pack("<Qii", 1, 7, 4)), "is cut short"),
    "COLMAP of an unknown model": ("cameras.bin", colmap_binary(99, 1.0), "unknown model 99"),
    "COLMAP with too few numbers": ("cameras.txt", colmap("OPENCV", *FOCAL), "OPENCV has 4 numbers, expected fx fy"),
    "nerfstudio with k4": ("t.json", nerfstudio(k4=0.01), "k4 is 0.01, but the lens plumb_bob has none"),
    "nerfstudio of several lenses": ("t.json", nerfstudio({"fl_x": 600.0}), "frames have different lenses"),
    "nerfstudio with another number": ("t.json", nerfstudio(k5=0.1), "unknown key 'k5' holds numbers"),
    "nerfstudio, a sphere": ("t.json", nerfstudio(camera_model="EQUIRECTANGULAR"), "camera_model is 'EQUI"),
    "ORB-SLAM stereo": (
        "c.yaml", lambda path: (orb("PinHole", "Camera1")(path), path.write_text(path.read_text() + "Camera2.fx: 5\n")),
        "holds two cameras",
    ),
    "ORB-SLAM, another word": ("c.yaml", orb("PinHole", s=2.0), "unknown key 'Camera.s'"),
    "MATLAB fisheye": ("p.mat", lambda path: savemat(path, {"s": {"MappingCoefficients": [1.0]}}), "Scaramuzza"),
    "MATLAB 7.3": ("p.mat", lambda path: path.write_bytes(b"MATLAB 7.3 MAT-file" + bytes(600)), "'-v7'"),
    "MATLAB without a struct": ("p.mat", lambda path: savemat(path, {"K": ONE}), "toStruct(cameraParams)"),
    "MATLAB cut": ("p.mat", lambda path: (matlab(K=ONE)(path), path.write_bytes(path.read_bytes()[:300])), "cannot be"),
    "MATLAB, a great deal": (
        "p.mat", lambda path: savemat(path, {"s": {"K": np.zeros(1 << 23)}}, do_compression=True), "more than 64 MB",
    ),
    "ROS without a size": (
        "c.yaml", text(ros("plumb_bob", STRAIGHT).replace(f"image_height: {H}\n", "")), "add image_width and image_h",
    ),
    "ROS without distortion": (
        "c.yaml", text(MESSAGE.replace(f"D: {list(FIVE)}\n", "")), "D is missing; zeros mean no distortion",
    ),
    "ROS of an unknown model": ("c.yaml", text(ros("eucm", (T1,) * 4)), "unknown lens model 'eucm'"),
    "ROS with another number": (
        "c.yaml", text(ros("plumb_bob", STRAIGHT) + "xi: 1.2\n"), "unknown key 'xi' holds numbers",
    ),
    "ROS, binned": ("c.yaml", text(ros("plumb_bob", STRAIGHT) + "binning_x: 2\n"), "binning_x is 2"),
    "ROS, part of the picture": (
        "c.yaml", text(ros("plumb_bob", STRAIGHT) + "roi: {x_offset: 8, width: 9}\n"), "roi is {",
    ),
    "skew": ("c.yaml", text(MESSAGE.replace(str(MATRIX), str([FX, 3.0, *MATRIX[2:]]))), "skew"),
    "a transposed matrix": (
        "c.yaml", text(MESSAGE.replace(str(MATRIX), str(np.reshape(MATRIX, (3, 3)).T.ravel().tolist()))),
        "expected rows [fx, 0, cx]",
    ),
    "no camera matrix": (
        "c.yaml", text(MESSAGE.replace(str(MATRIX), str([1.0, *MATRIX[1:8], 2.0]))), "expected rows [fx, 0, cx]",
    ),
    "eight numbers": ("c.yaml", text(MESSAGE.replace(str(MATRIX), str(MATRIX[:8]))), "K holds 8 numbers, expected 9"),
    "Kalibr with one size": (
        "c.yaml", text(KALIBR.replace(str([W, H]), str([W]))), "size of the image is missing: add resolution",
    ),
    "Kalibr of an unknown projection": ("c.yaml", text(KALIBR.replace("pinhole", "omni")), "camera_model 'omni'"),
    "Kalibr with two cameras": (
        "c.yaml", text(KALIBR + KALIBR.replace("cam0", "cam1")), "holds cam0, cam1, expected one camera",
    ),
    "MATLAB with one radial coefficient": (
        "p.json", matlab(K=ONE.tolist(), RadialDistortion=[K1]), "RadialDistortion of 2 or 3 numbers",
    ),
    "MATLAB with one tangential coefficient": (
        "p.json", matlab(K=ONE.tolist(), TangentialDistortion=[P1]), "TangentialDistortion of 2",
    ),
    "OpenCV with width and height, or rows and columns": (
        "c.json", text(json.dumps({"mtx": np.reshape(MATRIX, (3, 3)).tolist(), "dist": [K1], "image_size": [W, H]})),
        "give image_width and image_height",
    ),
    "XML of something else": ("c.xml", text("<opencv_storage><a>1</a></opencv_storage>"), "camera_matrix is missing"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_lens_of_ours_is_refused_by_name(name, tmp_path):
    file, write, sentence = REFUSED[name]
    write(tmp_path / file)
    with pytest.raises(LocalizationError) as refusal:
        load_camera(tmp_path / file)
    assert sentence in str(refusal.value) and file in str(refusal.value)


def test_a_principal_point_far_from_the_middle_is_questioned(tmp_path):
    """An offset of a quarter of the size, as when width and height, or cx and cy, are swapped, gives a warning."""
    path, far = tmp_path / "c.yaml", f"{FX}, 0.0, 359.5, 0.0, {FY}, 639.5"
    path.write_text(ros("plumb_bob", STRAIGHT).replace(f"{FX}, 0.0, {CX}, 0.0, {FY}, {CY}", far))
    with pytest.warns(
        LensWarning, match=r"principal point is .*outside the middle half of the picture of 1280 x 720"
    ):
        load_camera(path)
    path.write_text(ros("plumb_bob", STRAIGHT).replace(f"{CX}", "900.0"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_camera(path)


def test_an_importer_of_lenses_is_registered_under_its_name():
    assert {"lens.ros", "lens.opencv", "lens.kalibr", "lens.matlab", "lens.colmap"} <= set(IMPORTERS)
    with pytest.raises(RegistryError, match="expected an Importer of kind 'lens'"):
        check_registered("lens.own", object())
    with pytest.raises(RegistryError, match="begins with vehicle. or "):
        IMPORTERS["camera.own"] = object()
