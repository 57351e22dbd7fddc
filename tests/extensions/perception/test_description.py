"""World and sensor files: the catalogue loads, invalid files are refused in one sentence, and formulas of
sound."""

import math
import re

import numpy as np
import pytest

from finssim.core.mesh import write_stl
from finssim.core.rotations import quat_rotate
from finssim.extensions.perception.description import (
    SITES,
    Object,
    WorldError,
    WorldWater,
    load_world,
    sites,
)
from finssim.sim.overhead_camera import WaterOptics
from finssim.vehicles.device_files import DEVICES, DeviceError, devices, load_device

WORLD = """
about: A ball over a floor.
water: {attenuation: [0.4, 0.1, 0.08], veil: [0.1, 0.28, 0.33], daylight_attenuation: [0.3, 0.07, 0.05]}
seabed: {depth: 3.0, slope: [0.1, 0.0], size: [20, 10], spacing: 1.0}
objects:
  rig: {shape: group, position: [2, 0, -1]}
  ball: {shape: sphere, position: [0, 1, 0], frame: rig, radius: 0.3}
viewpoint: {position: [0, 0, -1]}
"""


def written(path, text=WORLD, name="world.yaml"):
    (path / name).write_text(text, encoding="utf-8")
    return path / name


@pytest.mark.parametrize("name", sites())
def test_every_site_loads(name):
    """Each file of the catalogue is a world with visible objects and a position in the water to view them
    from."""
    world = load_world(name)
    assert world.objects and world.viewpoint.position[2] < 0.0 and world.about


@pytest.mark.parametrize("name", devices())
def test_every_sensor_says_where_its_figures_are_from(name):
    """Each file of the catalogue is a sensor with its source."""
    assert len(load_device(name).source) > 40


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("radius: 0.3", "radius: -0.3", "objects.ball: radius is -0.3, expected > 0"),
        (", radius: 0.3", "", "objects.ball: a sphere needs radius: add it"),
        ("radius: 0.3", "radius: 0.3, length: 1", "objects.ball: a sphere has no length: remove it"),
        ("radius: 0.3", "radius: 0.3, colour: [1, 2, 0]", "expected 3 numbers from 0 to 1"),
        ("radius: 0.3", "radius: 0.3, backscatter_strength_db: 1e9", "is 1000000000.0, expected <= 100"),
        ("radius: 0.3", "radius: 0.3, axis: [0, 0, 1], yaw: 1", "give one"),
        ("radius: 0.3", "radius: 0.3, repeat: {count: 5000, step: [1, 0, 0]}", "count is 5000, expected <= 4096"),
        ("frame: rig", "frame: rog", "objects.ball: frame is 'rog', did you mean 'rig'?"),
        ("shape: sphere", "shape: globe", "objects.ball: shape is 'globe', expected 'box', 'sphere'"),
        ("seabed:", "seabad:", "unknown key 'seabad', did you mean 'seabed'?"),
        ("size: [20, 10]", "size: [20]", "seabed: size is [20], expected 2 numbers"),
        ("size: [20, 10]", "size: [20, 0]", "seabed: size is [20.0, 0.0], expected 2 numbers > 0"),
        ("slope: [0.1, 0.0]", "slope: [0.1, .inf]", "seabed: slope contains inf, expected 2 numbers"),
        ("depth: 3.0", "depth: 3.0, heights: ../x.csv", "has a separator of folders"),
        ("depth: 3.0", "depth: 3.0, heights: none.csv", "none.csv: cannot be read"),
        ("spacing: 1.0", "spacing: 0.001", "more than 1048576 heights"),
        ("size: [20, 10], spacing: 1.0", "size: [2e6, 1e-6], spacing: 1.0", "more than 1048576 heights"),
        ("radius: 0.3", "radius: 1e308", "objects: ball: radius contains 1e+308, expected 0 or a number from 1e-09 to"),
        ("position: [0, 1, 0]", "position: [0, -1e12, 0]", "objects: ball: position contains -1e+12, expected"),
        ("radius: 0.3", "radius: 0.3, texture: {kind: mottled, size: 1e-300}", "size contains 1e-300, expected"),
        ("radius: 0.3", "radius: 0.3, texture: {kind: mottled, size: 1e-6}", "size is 1e-06, expected >= 0.0001"),
        ("daylight_attenuation: [0.3", "daylight_attenuation: [0.5", "diffuse light fades no faster than a beam"),
        ("about: A ball over a floor.", "about: A ball.\nname: x", "unknown key 'name'"),
        ("shape: sphere, position: [0, 1, 0]", "shape: mesh, file: a.stl, position: [0, 1, 0]", "has no radius"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_in_one_sentence(old, new, sentence, tmp_path):
    """The message names the file, the key and the expected value."""
    assert old in WORLD
    with pytest.raises(WorldError) as refused:
        load_world(written(tmp_path, WORLD.replace(old, new, 1)))
    assert sentence in str(refused.value) and "world.yaml" in str(refused.value)


def test_places_that_come_of_files_are_within_reach(tmp_path):
    """Table heights, a slope over a wide bed and a scaled-up mesh beyond the limits of positions are refused."""
    (tmp_path / "bed.csv").write_text("0,1\n-1e300,0\n")
    write_stl(tmp_path / "a.stl", 1e4 * np.eye(4, 3), [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
    for old, new, sentence in (
        (
            "spacing: 1.0",
            "spacing: 1.0, heights: bed.csv",
            "seabed: reaches 1e\\+300 m, expected up to 1e\\+09 m",
        ),
        ("slope: [0.1, 0.0]", "slope: [9.9e8, 0.0]", "seabed: reaches 9.9e\\+09 m"),
        ("shape: sphere", "shape: mesh, file: a.stl, scale: 1e6", "objects.ball: reaches 1e\\+10 m"),
    ):
        text = WORLD.replace(", radius: 0.3", "") if "mesh" in new else WORLD
        with pytest.raises(WorldError, match=sentence):
            load_world(written(tmp_path, text.replace(old, new)))


def test_a_sensor_of_no_kind_and_a_site_of_no_name_are_refused(tmp_path):
    """The message lists the available kinds and sites."""
    with pytest.raises(DeviceError, match="kind is 'radar', expected one of camera, sonar, range"):
        load_device(written(tmp_path, "kind: radar\n"))
    with pytest.raises(DeviceError, match="kind is \\['camera'\\], expected one of"):
        load_device(written(tmp_path, "kind: [camera]\n"))
    camera = (DEVICES / "low_light_camera.yaml").read_text()
    for key in ("width", "height"):
        camera = re.sub(rf"(?m)^{key}: \d+", f"{key}: 8192", camera)
    with pytest.raises(DeviceError, match="8192 x 8192 pixels, expected at most 8 million"):
        load_device(written(tmp_path, camera))
    sonar = (DEVICES / "oculus_m750d.yaml").read_text()
    for key in ("beams", "bins"):
        sonar = re.sub(rf"(?m)^{key}: \d+", f"{key}: 4096", sonar)
    with pytest.raises(DeviceError, match="4096 beams with 4096 bins .* expected at most 8 million"):
        load_device(written(tmp_path, sonar))
    with pytest.raises(WorldError, match="unknown site 'dok', did you mean 'dock'?"):
        load_world("dok")


def test_an_exposure_is_auto_or_a_number(tmp_path):
    """The refusal is one sentence, although there are two forms."""
    camera = (
        "kind: camera\nabout: x\nsource: y\nwidth: 64\nheight: 48\nfocal_length: 50\nrate: 10\nexposure: "
    )
    assert load_device(written(tmp_path, camera + "0.5\n")).gain == 0.5
    for bad in ("-1", "bright", "[1]", ".nan"):
        with pytest.raises(DeviceError, match="exposure is .*, expected auto or a number > 0$"):
            load_device(written(tmp_path, camera + bad + "\n"))


def test_heights_are_slope_roughness_and_table(tmp_path):
    """Heights add up: the slope exactly, the table stretched linearly, roughness with its root mean square."""
    (tmp_path / "bump.csv").write_text("0,0,0\n0,1,0\n0,0,0\n", encoding="utf-8")
    text = WORLD.replace("spacing: 1.0", "spacing: 0.5, heights: bump.csv")
    z = load_world(written(tmp_path, text)).seabed_heights()
    assert z.shape == (21, 41)
    np.testing.assert_allclose(z[0], -3.0 + 0.1 * np.linspace(-10, 10, 41), atol=1e-12)
    np.testing.assert_allclose(z[10, [0, 10, 20]], [-4.0, -3.5 + 0.5, -2.0], atol=1e-12)
    rough = WORLD.replace("size: [20, 10]", "size: [200, 200], roughness: {rms: 0.2, wavelength: 8.0}")
    z = load_world(written(tmp_path, rough.replace("[0.1, 0.0]", "[0.0, 0.0]"))).seabed_heights()
    # Over many wavelengths the mean square of a sum of sines is half the sum of their squared amplitudes.
    assert np.std(z) == pytest.approx(0.2, rel=0.05) and np.mean(z) == pytest.approx(-3.0, abs=0.02)


@pytest.mark.parametrize("axis", [(0, 0, 2), (0, 0, -1), (1, 0, 0), (1, -2, 0.5)])
def test_the_z_axis_of_a_shape_points_where_axis_says(axis):
    """The z axis of a shape points along `axis` for every direction, upside down too."""
    item = Object(shape="plane", position=[0, 0, 0], axis=list(axis))
    np.testing.assert_allclose(
        quat_rotate(item.quaternion, [0, 0, 1]), np.array(axis) / np.linalg.norm(axis), atol=1e-12
    )


def sea(temperature, salinity):
    return WorldWater(
        attenuation=[0, 0, 0],
        veil=[0, 0, 0],
        daylight_attenuation=[0, 0, 0],
        temperature=temperature,
        salinity=salinity,
    )


def test_sound_is_as_fast_as_the_sea_is_warm_and_salty():
    """The speed of sound matches published values at two temperatures.

    1489.8 m/s at 10 °C and 35 (UNESCO, Fofonoff & Millard 1983) within 0.5; 1482.3 m/s in fresh water at 20 °C (Del
    Grosso & Mader 1972) within 1.
    """
    assert sea(10.0, 35.0).sound_speed == pytest.approx(1489.8, abs=0.5)
    assert sea(20.0, 0.0).sound_speed == pytest.approx(1482.3, abs=1.0)


def test_fresh_water_absorbs_by_the_square_of_frequency():
    """Absorption is 25e-15 f² Np/m at 20 °C (Fisher & Simmons 1977) within a tenth; at 100 kHz salt causes
    most of it."""
    fresh = sea(20.0, 0.0)
    for frequency in (1e5, 7.2e5, 2e6):
        expected = 25e-15 * frequency**2 * 20.0 / math.log(10.0)
        assert fresh.sound_absorption(frequency) == pytest.approx(expected, rel=0.1)
    assert sea(20.0, 35.0).sound_absorption(1e5) > 5.0 * fresh.sound_absorption(1e5)


def test_the_catalogue_is_packaged_beside_the_module():
    """Sites and sensors are files of the package."""
    assert (SITES / "pool.yaml").is_file()


def test_the_pool_has_the_water_of_the_overhead_camera():
    """The pool's water has one definition, shared by underwater cameras and the overhead camera."""
    assert load_world("pool").water.optical == WaterOptics()
