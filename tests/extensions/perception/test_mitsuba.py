"""Reference renderer Mitsuba 3, which shares no code with the package's cameras, renders worlds as they do."""

import math

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

pytest.importorskip("mitsuba")

import mitsuba as mi

from finssim.core.frames import FROM_OPTICAL
from finssim.core.rotations import quat_to_matrix
from finssim.extensions.perception import CameraBatch, WorldBatch, load_world
from finssim.vehicles.device_files import CameraDevice, Port

pytestmark = pytest.mark.slow

COLUMNS, ROWS, FINE = 80, 60, 6
"""Compared pixels, and number of the camera's pixels, of one ray each, along each axis of a compared pixel."""
PORT = Port(distance=0.02, thickness=0.006)
WATER = 1.333
SUN, DIFFUSE = np.array([0.3, 0.2, 1.0]), 0.4
ATTENUATION = (0.4, 0.1, 0.2)
OBJECTS = {
    "ball": {"shape": "sphere", "radius": 0.35, "position": [2.5, 0.9, -4.6], "colour": [0.9, 0.4, 0.2]},
    "crate": {"shape": "box", "size": [0.5, 0.6, 0.7], "position": [2.2, -0.8, -4.7], "axis": [0.3, 0.2, 1.0],
              "colour": [0.3, 0.8, 0.4]},
    "post": {"shape": "cylinder", "radius": 0.15, "length": 1.2, "position": [3.0, 0.1, -5.7],
             "axis": [0.5, 0.8, 0.6], "colour": [0.4, 0.5, 0.9]},
}  # fmt: skip
"""World frame; the camera is at (0, 0, -5) and looks along x. No object hides another."""


@pytest.mark.parametrize(
    ("port", "glowing"), [(PORT, False), (PORT, True), (None, False)], ids=["port", "port, murky", "dome"]
)
def test_pictures_are_those_of_mitsuba(port, glowing, poses, tmp_path):
    """Objects appear within 0.1 px of Mitsuba's positions, and the radiance differs by 3 % rms of its range.

    Radiance is compared up to one factor, like that of an exposure: the port's faces reflect 4.2 % at normal
    incidence, which the package's cameras omit. Most of the rms is Mitsuba's own noise.
    """
    batch = world_of(glowing, tmp_path)
    sensor, radiance = ours(port, batch, poses)
    expected = referee(port, glowing, batch)
    factor = (radiance * expected).sum() / (expected * expected).sum()
    assert factor == pytest.approx(1.0 if port is None else 1.0 / ((1 - 0.0387) * (1 - 0.0031)), abs=0.015)
    expected *= factor
    assert np.sqrt(((radiance - expected) ** 2).mean()) < 0.03 * radiance.max()
    dv, du = np.gradient(expected, axis=(0, 1))
    index = sensor.shape_index.numpy()[0].reshape(ROWS, FINE, COLUMNS, FINE).swapaxes(1, 2)
    for k in range(len(OBJECTS)):
        # Shift of one picture against the other around an object, from the picture's slopes.
        near = binary_dilation((index == k).any((2, 3)), iterations=2)
        slopes = np.stack([du[near].ravel(), dv[near].ravel()], axis=1)
        shift = np.linalg.lstsq(slopes, (expected - radiance)[near].ravel(), rcond=None)[0]
        assert np.hypot(*shift) < 0.1


def world_of(glowing, tmp_path):
    """Return the world of the package's cameras: lit from above in clear water, or glowing in dark and murky
    water."""
    lines = ["about: Three things.", "viewpoint: {position: [0, 0, -5]}"]
    attenuation = list(ATTENUATION) if glowing else [0, 0, 0]
    lines.append(f"water: {{attenuation: {attenuation}, veil: [0, 0, 0], daylight_attenuation: [0, 0, 0]}}")
    daylight = 0.0 if glowing else 1.0
    lines.append(
        f"light: {{sun: {SUN.tolist()}, diffuse: {DIFFUSE}, sky: [0, 0, 0], daylight: {[daylight] * 3}}}"
    )
    lines.append("objects:")
    for name, item in OBJECTS.items():
        entry = dict(item)
        if glowing:
            entry["glow"], entry["colour"] = entry["colour"], [0, 0, 0]
        lines.append(f"  {name}: {entry}".replace("'", ""))
    path = tmp_path / "three.yaml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return WorldBatch(load_world(path))


def ours(port, batch, poses):
    """Return the sensor and the mean radiance of each pixel, (ROWS, COLUMNS, 3)."""
    device = CameraDevice(about="-", source="-", width=COLUMNS, height=ROWS, focal_length=62.0, exposure=1.0, rate=10.0,
                          port=port)  # fmt: skip
    sensor = CameraBatch(batch, device, width=FINE * COLUMNS, linear=True)
    sensor.update(poses(((0, 0, -5), (0, 0, 0, 1))))
    fine = sensor.radiance.numpy()[0].astype(float)
    return sensor, fine.reshape(ROWS, FINE, COLUMNS, FINE, 3).mean((1, 3))


def referee(port, glowing, batch):
    """Return Mitsuba's picture: path tracing through two dielectric faces, on surfaces that Mitsuba lights
    itself."""
    mi.set_variant("scalar_rgb")
    axes = np.eye(4)
    axes[:3, :3] = np.stack([FROM_OPTICAL.vector(v) for v in np.eye(3)], axis=1) @ np.diag([-1.0, -1.0, 1.0])
    axes[:3, 3] = (0, 0, -5)
    gain = 1.0 if port is None else WATER**2  # light spreads by the indices squared
    sea = {"type": "homogeneous", "albedo": 0.0, "sigma_t": {"type": "rgb", "value": list(ATTENUATION)}}
    scene = {
        "type": "scene",
        "integrator": {"type": "volpathmis", "max_depth": 4 if glowing else 5, "rr_depth": 99},
        "sensor": {
            "type": "perspective",
            "fov": math.degrees(2.0 * math.atan(0.5 * COLUMNS / 62.0)),
            "fov_axis": "x",
            "near_clip": 1e-3,
            "to_world": mi.ScalarTransform4f(axes),
            "sampler": {"type": "independent", "sample_count": 300 if glowing else 100},
            "film": {"type": "hdrfilm", "width": COLUMNS, "height": ROWS, "rfilter": {"type": "box"}},
        },
    }
    if not glowing:
        scene["integrator"] = {"type": "path", "max_depth": 4 if port else 2, "rr_depth": 99}
        half = np.zeros((512, 1024, 3), np.float32)
        half[:256] = DIFFUSE / math.pi * gain
        upright = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
        scene["above"] = {"type": "envmap", "bitmap": mi.Bitmap(half), "to_world": upright}
        sun = SUN / np.linalg.norm(SUN)
        level = [gain * (1.0 - DIFFUSE) / float(sun[2])] * 3
        scene["sun"] = {
            "type": "directional",
            "direction": (-sun).tolist(),
            "irradiance": {"type": "rgb", "value": level},
        }
    elif port is None:
        scene["sensor"]["medium"] = sea
    if port is not None:
        for k, (x, near, far) in enumerate(((0.02, 1.0, 1.49), (0.026, 1.49, WATER))):
            face = np.eye(4)
            face[:3, :3] = np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]]) * 0.3  # towards the camera
            face[:3, 3] = (x, 0, -5)
            scene[f"face{k}"] = {"type": "rectangle", "to_world": mi.ScalarTransform4f(face),
                                 "bsdf": {"type": "dielectric", "ext_ior": near, "int_ior": far}}  # fmt: skip
        if glowing:
            scene["face1"]["interior"] = sea

    def picture(brightness):
        """Render one object at a time: together, each blocks daylight of the others, which the package's
        cameras omit."""
        total = np.zeros((ROWS, COLUMNS, 3))
        for name, item in OBJECTS.items():
            alone = dict(scene)
            colour = [brightness * c for c in item["colour"]]
            for k, shape in enumerate(shapes_of(item, batch.poses(name)[0])):
                if glowing:
                    light = {"type": "rgb", "value": [gain * c for c in colour]}
                    shape |= {"light": {"type": "area", "radiance": light}, "exterior": sea}
                else:
                    shape["bsdf"] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}}
                alone[f"{name}{k}"] = shape
            total += np.array(mi.render(mi.load_dict(alone), seed=1), dtype=float)[..., :3]
        return total

    # Subtract the background, which black objects leave unchanged.
    return picture(1.0) if glowing else math.pi * (picture(1.0) - picture(0.0))


def shapes_of(item, pose):
    """Return Mitsuba's shapes for one object at a pose of the world frame (7,)."""
    to_world = np.eye(4)
    to_world[:3, :3], to_world[:3, 3] = quat_to_matrix(pose[3:]), pose[:3]
    if item["shape"] == "sphere":
        return [{"type": "sphere", "center": pose[:3].tolist(), "radius": item["radius"]}]
    if item["shape"] == "box":
        size = np.diag([0.5 * s for s in item["size"]] + [1.0])
        return [{"type": "cube", "to_world": mi.ScalarTransform4f(to_world @ size)}]
    half, r = 0.5 * item["length"], item["radius"]
    ends = [np.diag([r, s * r, s * r, 1.0]) for s in (-1.0, 1.0)]  # vertices of the unit disk, z outwards
    for s, end in zip((-1.0, 1.0), ends, strict=True):
        end[2, 3] = s * half
    bottom, top = ((to_world @ [0, 0, s * half, 1])[:3].tolist() for s in (-1.0, 1.0))
    disks = [{"type": "disk", "to_world": mi.ScalarTransform4f(to_world @ end)} for end in ends]
    return [{"type": "cylinder", "p0": bottom, "p1": top, "radius": r}, *disks]
