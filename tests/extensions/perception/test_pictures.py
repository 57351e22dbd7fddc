"""Camera images of pictures and tags on shapes, motion blur, marine snow and water types."""

import math

import numpy as np
import pytest
import warp as wp

from finssim.extensions.perception import CameraBatch, WorldBatch, WorldError, load_world
from finssim.extensions.perception.description import JERLOV, WorldWater
from finssim.physics.types import vec6
from finssim.vehicles.device_files import CameraDevice

cv2 = pytest.importorskip("cv2", reason="finssim[vision] is not installed")
pytestmark = pytest.mark.slow

CLEAR = "attenuation: [0, 0, 0], veil: [0, 0, 0], daylight_attenuation: [0, 0, 0]"
EVEN = "light: {diffuse: 1.0, sky: [0, 0, 0]}\n"
PLATE = "objects:\n  plate: {{shape: box, position: [0, 0, -5], size: [1, 1, 1], colour: [0, 0, 0], texture: {}}}\n"


def make(folder, text, water=CLEAR):
    path = folder / "site.yaml"
    head = f"about: A site.\nwater: {{{water}}}\n"
    path.write_text(head + EVEN + text + "viewpoint: {position: [0, 0, -5]}\n", encoding="utf-8")
    return WorldBatch(load_world(path))


def camera(width=200, focal_length=200.0, **changes):
    values = {"about": "-", "source": "-", "width": width, "height": width, "focal_length": focal_length}
    return CameraDevice(**{**values, "rate": 10.0, "exposure": 1.0, "gamma": 1.0, **changes})


def pose(position, attitude=(0.0, 0.0, 0.0, 1.0)):
    return wp.array(np.float32([[*position, *attitude]]), dtype=wp.transform)


SIDES = {
    "west": ((-2.5, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
    "east": ((2.5, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)),
    "south": ((0.0, -2.5, 0.0), (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))),
    "north": ((0.0, 2.5, 0.0), (0.0, 0.0, -math.sqrt(0.5), math.sqrt(0.5))),
}
"""Camera position and attitude before each side of a box."""


@pytest.mark.parametrize("side", SIDES)
def test_a_tag_stands_upright_on_every_side(side, tmp_path):
    """OpenCV's detector finds the tag's number and, in order, its corners within 0.5 px of their projections."""
    batch = make(tmp_path, PLATE.format("{kind: tag, tag: 23, size: 0.6}"))
    position, attitude = SIDES[side]
    sensor = CameraBatch(batch, camera())
    picture = sensor.update(pose(np.add(position, [0, 0, -5.0]), attitude)).numpy()[0]
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(picture)
    assert ids.ravel().tolist() == [23]
    half = 200.0 * 0.3 / 2.0
    expected = 99.5 + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    np.testing.assert_allclose(corners[0][0], expected, atol=0.5)


def test_a_picture_keeps_its_colours_and_proportions(tmp_path):
    """Red lies above blue at half the width on a black face: reflectances to 2 % in even light, edges to a
    pixel."""
    board = np.zeros((60, 120, 3), np.uint8)
    board[:30, :, 2], board[30:, :, 0] = 200, 200  # OpenCV's order is blue, green, red
    cv2.imwrite(str(tmp_path / "board.png"), board)
    batch = make(tmp_path, PLATE.format("{kind: picture, file: board.png, size: 0.8}"))
    sensor = CameraBatch(batch, camera(), linear=True)
    sensor.update(pose((-2.5, 0, -5)))
    radiance = sensor.radiance.numpy()[0]
    level = 0.5 * (200 / 255) ** 2.2  # of a wall, which receives half the light from above
    np.testing.assert_allclose(radiance[90, 100], [level, 0, 0], atol=0.02 * level)
    np.testing.assert_allclose(radiance[110, 100], [0, 0, level], atol=0.02 * level)
    rows, columns = np.nonzero(radiance.sum(axis=-1) > 0.5 * level)
    assert abs(np.ptp(columns) + 1 - 80) <= 1 and abs(np.ptp(rows) + 1 - 40) <= 1


def test_textures_that_cannot_be_are_refused(tmp_path):
    """A missing file, a file that is not a picture and a tag that its family lacks are refused."""
    with pytest.raises(
        WorldError, match=r"texture: file is for kind: picture, which needs it; kind is picture"
    ):
        make(tmp_path, PLATE.format("{kind: picture, size: 0.8}"))
    with pytest.raises(WorldError, match="none.png is not there: give a PNG or JPEG"):
        make(tmp_path, PLATE.format("{kind: picture, file: none.png, size: 0.8}"))
    (tmp_path / "huge.png").write_bytes(
        b"\x89PNG\r\n\x1a\n" + b"\0\0\0\rIHDR" + (60_000).to_bytes(4, "big") * 2
    )
    with pytest.raises(
        WorldError, match="huge.png is a picture of 60000 x 60000 pixels.*: give a PNG or JPEG"
    ):
        make(tmp_path, PLATE.format("{kind: picture, file: huge.png, size: 0.8}"))
    with pytest.raises(WorldError, match="tag 99999 of 4x4_50: it has 50 tags"):
        make(tmp_path, PLATE.format("{kind: tag, tag: 99999, family: 4x4_50, size: 0.8}"))
    with pytest.raises(WorldError, match="tag 1 of 9x9: no such family"):
        make(tmp_path, PLATE.format("{kind: tag, tag: 1, family: 9x9, size: 0.8}"))


def test_blur_is_the_mean_of_the_exposure(tmp_path):
    """The picture of a moving, turning vehicle is the mean of five along its path; at rest it is exactly the
    sharp one."""
    batch = make(tmp_path, PLATE.format("{kind: tag, tag: 23, size: 0.6}"))
    nu = np.array([0.1, 0.8, -0.2, 0.0, 0.3, 0.5])
    sharp = CameraBatch(batch, camera(), linear=True)
    twists = [wp.array(np.float32(x[None, None]), dtype=vec6) for x in (nu, 0.0 * nu)]
    blurred = [CameraBatch(batch, camera(exposure_time=0.1), linear=True, twists=x) for x in twists]
    start = pose((-2.5, 0, -5))
    for sensor in (sharp, *blurred):
        sensor.update(start)
    np.testing.assert_allclose(blurred[1].radiance.numpy(), sharp.radiance.numpy(), atol=1e-6)
    mean, moment = np.zeros((200, 200, 3)), CameraBatch(batch, camera(), linear=True)
    for time in 0.1 * ((np.arange(5) + 0.5) / 5.0 - 1.0):
        angle = time * np.linalg.norm(nu[3:])
        axis = nu[3:] / np.linalg.norm(nu[3:])
        moment.update(
            pose(
                np.array([-2.5, 0, -5]) + time * nu[:3],
                (*(math.sin(0.5 * angle) * axis), math.cos(0.5 * angle)),
            )
        )
        mean += moment.radiance.numpy()[0] / 5.0
    np.testing.assert_allclose(blurred[0].radiance.numpy()[0], mean, atol=1e-3)
    assert np.abs(mean - sharp.radiance.numpy()[0]).max() > 0.1


@pytest.mark.parametrize(("density", "size"), [(50.0, 0.01), (400.0, 0.003)])
def test_snow_covers_what_its_density_and_size_say(density, size, tmp_path):
    """Over all pixels the cover is rho pi a² times the path through twenty cells; 0.4 as bright as white
    paper."""
    batch = make(tmp_path, "", CLEAR + f", snow: {{density: {density}, size: {size}}}")
    sensor = CameraBatch(batch, camera(width=400, focal_length=300.0), linear=True)
    bright = []
    for x in range(6):
        sensor.update(pose((3.0 * x, 0, -50.0), (0.0, math.sin(0.3), 0.0, math.cos(0.3))))
        bright.append(sensor.radiance.numpy()[0, ..., 0].mean())
    way = 20.0 * (0.7 / density) ** (1.0 / 3.0)
    expected = 0.4 * density * math.pi * (0.5 * size) ** 2 * way
    assert np.mean(bright) == pytest.approx(expected, rel=0.2)


def test_water_types_give_what_is_not_given():
    """Omitted keys become Jerlov's K_d, and 1.5 times it for a beam; a given key is kept.

    The attenuation of blue grows from the clearest type to the most turbid.
    """
    for name, K_d in JERLOV.items():
        water = WorldWater(jerlov=name, veil=[0.1, 0.2, 0.2])
        np.testing.assert_allclose(water.daylight_attenuation, K_d)
        np.testing.assert_allclose(water.attenuation, 1.5 * np.array(K_d))
    assert np.all(np.diff(list(JERLOV.values()), axis=0)[:, 2] > 0.0)
    own = WorldWater(jerlov="3C", veil=[0.1, 0.2, 0.2], attenuation=[0.6, 0.5, 0.7])
    np.testing.assert_allclose(own.attenuation, [0.6, 0.5, 0.7])
    np.testing.assert_allclose(own.daylight_attenuation, JERLOV["3C"])
