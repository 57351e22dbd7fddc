"""The pool file: a written file reads back, short forms equal full ones, and frames agree with each other."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.core.optics import Camera, Interface, Layer, Lens
from finssim.core.rotations import quat_from_rotvec
from finssim.localization import LocalizationError
from finssim.localization.overhead_camera import Pool, load_pool, write_pool

LENS = Lens(
    width=1280,
    height=720,
    fx=541.0,
    fy=541.0,
    cx=682.0,
    cy=349.0,
    distortion=(0.03, -0.06, 0.001, 0.002, 0.01),
)
DOWN = np.array([1.0, 0.0, 0.0, 0.0])
HEAD = """camera:
  lens: {width: 1280, height: 720, fx: 541, cx: 682, cy: 349}
  position: [0.03, -0.17, 2.17]
  orientation: [1, 0, 0, 0]
"""


def pool(**changes):
    """Return a camera over level water in a frame with its origin on the floor."""
    camera = Camera(LENS, np.array([0.03, -0.17, 2.17]), DOWN)
    return replace(Pool(camera, Interface.water(0.96), latency=0.03), **changes)


POOLS = {
    "water": pool(),
    "tilted": pool(interface=Interface.water(0.96, tilt_x=0.01, tilt_y=-0.02)),
    "wall": pool(
        interface=Interface(np.array([0.0, -1.0, 0.0]), 0.3, 1.0003, 1.333, (Layer(0.01, 1.49),)),
        world_position=(0.1, 0.2, 0.9),
        world_orientation=tuple(quat_from_rotvec([0.0, 0.0, 0.4]).tolist()),
    ),
}


@pytest.mark.parametrize("name", POOLS)
def test_a_written_pool_reads_back(name, tmp_path):
    """Every digit is kept, so the hash is too, and so is the record."""
    made = replace(POOLS[name], record={"kind": "pool", "rms_px": 0.21})
    write_pool(made, tmp_path / "pool.yaml")
    read = load_pool(tmp_path / "pool.yaml")
    assert read.sha256 == made.sha256
    assert read.record == made.record
    np.testing.assert_array_equal(read.T_wp, made.T_wp)


@pytest.mark.parametrize("name", POOLS)
def test_pool_and_world_frames_are_inverse(name):
    """T_pw T_wp = 1."""
    np.testing.assert_allclose(POOLS[name].T_pw @ POOLS[name].T_wp, np.eye(4), atol=1e-15)


def test_the_world_lies_on_the_water_where_nothing_else_is_said():
    """The world's origin is the surface point above the survey's origin, with z = 0 on the still surface."""
    np.testing.assert_allclose(pool().T_wp @ [0.0, 0.0, 0.96, 1.0], [0, 0, 0, 1], atol=1e-15)
    assert pool().is_surface and not POOLS["wall"].is_surface


def test_the_hash_is_of_the_geometry_alone():
    """A record does not change the hash, a millimetre of water does."""
    assert pool(record={"a": 1}).sha256 == pool().sha256
    assert pool(interface=Interface.water(0.961)).sha256 != pool().sha256


@pytest.mark.parametrize(
    "interface",
    ["{height: 0.96}", "{normal: [0, 0, 1], offset: -0.96}", "{normal: [0, 0, 1], point: [3, 4, 0.96]}"],
)
def test_level_water_may_be_written_in_three_ways(interface, tmp_path):
    """Height, offset and a point of the plane define the same plane."""
    path = tmp_path / "pool.yaml"
    path.write_text(HEAD + f"interface: {interface}\n")
    assert load_pool(path).interface.height(1.0, -2.0) == pytest.approx(0.96, abs=1e-15)


def test_the_lens_may_stand_in_a_file_of_its_own(tmp_path):
    """A lens given as `lens: camera.yaml` is read beside the pool file."""
    (tmp_path / "camera.yaml").write_text("lens: {width: 1280, height: 720, fx: 541, cx: 682, cy: 349}\n")
    path = tmp_path / "pool.yaml"
    path.write_text(
        "camera: {lens: camera.yaml, position: [0, 0, 2], orientation: [1, 0, 0, 0]}\ninterface: {height: 1}\n"
    )
    assert load_pool(path).camera.lens.fx == 541.0


@pytest.mark.parametrize(
    ("record", "expected"),
    [({}, 0.5), ({"residual": {"pixel_sigma": 0.83}}, 0.83), ({"residual": {"pixel_sigma": 0.001}}, 0.05)],
)
def test_the_noise_of_a_corner_is_what_the_calibration_found(record, expected):
    """The noise is that of the residuals, but never below a detector's limit; half a pixel if it is unknown."""
    assert pool(record=record).pixel_std == expected


REFUSED = {
    "no camera": ("interface: {height: 1}\n", "camera: lens is missing"),
    "no plane": (HEAD, "interface: normal is missing"),
    "not unit": (
        HEAD.replace("[1, 0, 0, 0]", "[1, 1, 0, 0]") + "interface: {height: 1}\n",
        "orientation has length 1.414",
    ),
    "unknown key": (HEAD + "interface: {height: 1, tilt: 2}\n", "unknown key 'tilt'"),
    "index": (HEAD + "interface: {height: 1, index_far: -1}\n", "interface"),
    "format": (HEAD + "interface: {height: 1}\nformat: 7\n", "format is 7"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_file_that_tells_no_pool_is_refused(case, tmp_path):
    """The sentence names file, section and the expected values."""
    text, expected = REFUSED[case]
    path = tmp_path / "pool.yaml"
    path.write_text(text)
    with pytest.raises(LocalizationError, match=r"pool\.yaml") as refusal:
        load_pool(path)
    assert expected in str(refusal.value)
