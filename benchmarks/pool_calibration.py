"""Accuracy of a pool's camera and water, and coverage of the 95 % intervals, in many simulated surveys.

    python benchmarks/pool_calibration.py [--draws 100] [--case NAME ...]

Each draw has its own water (index 1.333 ± 0.003, level within 0.2 degrees), survey (2 mm, tags rotated by 0.5 degrees),
pixels (0.25 px) and tape (2 mm); the fit knows these deviations.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace

import numpy as np

from finssim.core.optics import Camera, Interface, Layer, Lens, project
from finssim.core.rotations import matrix_to_quat, quat_from_rotvec, quat_from_yaw, quat_to_matrix
from finssim.localization.detection.families import corners
from finssim.survey.points import Observations
from finssim.survey.pool_fit import PoolFit, calibrate_pool
from finssim.survey.pool_model import PoolFitSettings

DISTORTION = (0.02944176, -0.05975546, 0.00088098, 0.00179148, 0.01256862)
LENS = Lens(1280, 720, 540.9305, 540.9305, 682.2341, 348.6136, "plumb_bob", DISTORTION)
TANK_LENS = Lens(1280, 720, 900.0, 900.0, 640.0, 360.0, "plumb_bob", (-0.1, 0.05, 0.0, 0.0))
SURVEY, TURN, PIXEL, TAPE = 0.002, np.radians(0.5), 0.25, 0.002
FIT = ("pose", "height", "tilt", "index")


@dataclass(frozen=True)
class Case:
    """Method of surveying a pool."""

    heights: tuple[float, ...] = (0.0,)
    locations: int = 85
    reach: tuple[float, float] = (1.9, 0.95)
    tape: bool = False
    focal: bool = False
    window: float | None = None
    """Angle of the camera to a window [deg]; None: the water surface."""
    plane: bool = False


CASES = {
    "floor": Case(),
    "floor, tape": Case(tape=True),
    "floor, tape, focal": Case(tape=True, focal=True),
    "floor 20, tape": Case(tape=True, locations=20),
    "two depths": Case(heights=(0.0, 0.5)),
    "two depths, tape": Case(heights=(0.0, 0.5), tape=True),
    "near the axis": Case(reach=(0.2, 0.2), locations=40),
    "near the axis, tape": Case(reach=(0.2, 0.2), locations=40, tape=True),
    "window 0": Case(window=0.0, locations=60),
    "window 40": Case(window=40.0, locations=60),
    "window 0, plane": Case(window=0.0, locations=60, plane=True),
    "window 40, plane": Case(window=40.0, locations=60, plane=True),
}


def draw(case: Case, rng: np.random.Generator) -> tuple[Camera, Interface, Observations, PoolFitSettings]:
    """Draw one pool with its survey, and the settings of its fit."""
    index = 1.333 + 0.003 * rng.standard_normal()
    if case.window is not None:
        return _tank(case, rng, index)
    view = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    lean = quat_to_matrix(quat_from_rotvec(0.05 * rng.standard_normal(3)))
    camera = Camera(LENS, np.array([0.03, -0.17, 2.2]), matrix_to_quat(lean @ view))
    tilt_x, tilt_y = np.radians(0.2) * rng.standard_normal(2)
    water = Interface.water(1.0, tilt_x=tilt_x, tilt_y=tilt_y, n_water=index)
    seen = _tags(case, rng, camera, water)
    height = float(water.height(*seen.points[:, :2].mean(axis=0)))
    settings = PoolFitSettings(
        water_height=height + TAPE * rng.standard_normal() if case.tape else None,
        place_sigma=TAPE,
        fit=FIT + (("focal",) if case.focal else ()),
        focal_sigma=0.0,
    )
    return camera, water, seen, settings


def _tank(
    case: Case, rng: np.random.Generator, index: float
) -> tuple[Camera, Interface, Observations, PoolFitSettings]:
    """Return points in a tank seen through 10 mm of glass, with z up and the window at y = 0."""
    angle = np.radians(case.window or 0.0)
    position = np.array([0.6 * np.sin(angle), -0.6 * np.cos(angle), 0.2])
    ahead = np.array([0.0, 0.15, 0.2]) - position
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right)
    camera = Camera(TANK_LENS, position, matrix_to_quat(np.stack([right, np.cross(ahead, right), ahead], 1)))
    glass = Layer(0.010, 1.52)
    window = Interface(np.array([0.0, -1.0, 0.0]), 0.0, index_far=index, window=(glass,))
    points = rng.uniform((-0.3, 0.03, 0.0), (0.3, 0.35, 0.4), (4000, 3))
    seen = _seen(points[:, None, :], 0.0005, 0.0, rng, camera, window, case.locations)
    lean = 1e-3 * rng.standard_normal(2)
    known = (float(lean[0]), -1.0, float(lean[1]), TAPE * rng.standard_normal()) if case.plane else None
    settings = PoolFitSettings(
        window=glass, plane=known, place_sigma=TAPE, tilt_sigma=1e-3 if case.plane else None,
        survey_sigma=0.0005, fit=FIT,
    )  # fmt: skip
    return camera, window, seen, settings


def _tags(case: Case, rng: np.random.Generator, camera: Camera, water: Interface) -> Observations:
    centre = np.column_stack([rng.uniform(-1.0, 1.0, (4000, 2)) * case.reach, rng.choice(case.heights, 4000)])
    turned = quat_to_matrix(quat_from_yaw(rng.uniform(-np.pi, np.pi, 4000)))
    nominal = centre[:, None, :] + np.einsum("nij,kj->nki", turned, corners(0.098))
    return _seen(nominal, SURVEY, TURN, rng, camera, water, case.locations)


def _seen(
    nominal: np.ndarray,
    survey: float,
    turn: float,
    rng: np.random.Generator,
    camera: Camera,
    plane: Interface,
    count: int,
) -> Observations:
    """Return the first points that are completely in the picture, (N, K, 3)."""
    middle = nominal.mean(axis=1, keepdims=True)
    arm = np.cross(np.array([0.0, 0.0, 1.0]), nominal - middle)
    true = nominal + survey * rng.standard_normal((len(nominal), 1, 3))
    true = true + turn * rng.standard_normal((len(nominal), 1, 1)) * arm
    found = project(camera, plane, true)
    whole = np.flatnonzero((found.status == 0).all(axis=1))[:count]
    if len(whole) < count:
        raise SystemExit("the picture holds too few of the places")
    k = nominal.shape[1]
    pixels = found.pixels[whole] + PIXEL * rng.standard_normal((count, k, 2))
    return Observations(
        pixels=pixels.reshape(-1, 2),
        points=nominal[whole].reshape(-1, 3),
        location=np.repeat(np.arange(count), k),
        names=tuple(f"{i}/{j}" for i in range(count) for j in range(k)),
        locations=tuple(str(i) for i in range(count)),
        sigma=np.full(count * k, np.nan),
        arm=arm[whole].reshape(-1, 3),
        dry=np.zeros(count * k, bool),
    )


def errors(fit: PoolFit, camera: Camera, plane: Interface) -> dict[str, tuple[float, float]]:
    """Return estimate minus truth, and half the interval, of each parameter with a known truth."""
    surface = fit.settings.surface
    truth = {f"camera_{axis}": float(camera.position[k]) for k, axis in enumerate("xyz")}
    clearance = float(plane.normal @ camera.position + plane.offset)
    truth["camera_height" if surface else "camera_distance"] = clearance
    truth["index"] = plane.index_far
    if surface:
        truth["water_height"] = float(plane.height(0.0, 0.0))
        truth["tilt_x"], truth["tilt_y"] = (
            float(np.degrees(np.arctan2(plane.normal[k], plane.normal[2]))) for k in range(2)
        )
    else:
        truth["normal_x"], truth["normal_z"] = float(plane.normal[0]), float(plane.normal[2])
    if fit.lens_fitted:
        truth["focal"] = camera.lens.fx
    table = fit.estimates
    return {
        name: (table[name].estimate - value, 0.5 * (table[name].ci95[1] - table[name].ci95[0]))
        for name, value in truth.items()
    }


def main() -> None:
    """Print one block for each case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--case", action="append", choices=list(CASES))
    options = parser.parse_args()
    for name in options.case or CASES:
        case, found, cm, pinhole_cm = CASES[name], [], [], []
        for seed in range(options.draws):
            camera, plane, seen, settings = draw(case, np.random.default_rng([7, seed]))
            fit = calibrate_pool(seen, camera.lens, replace(settings, seed=seed))
            found.append(errors(fit, camera, plane))
            cm.append(fit.held_out.as_json()["rms_cm"])
            pinhole_cm.append(fit.pinhole_held_out.as_json()["rms_cm"])
        held = f"held-out rms {np.mean(cm):.2f} cm (straight lines {np.mean(pinhole_cm):.2f} cm)"
        print(f"{name}: {options.draws} draws, {held}")
        print(f"  {'parameter':<16}{'rms error':>12}{'half interval':>16}{'covered':>10}")
        for key in found[0]:
            e, half = np.array([f[key] for f in found]).T
            rms, covered = np.sqrt(np.mean(e**2)), 100.0 * np.mean(np.abs(e) < half)
            print(f"  {key:<16}{rms:>12.5f}{np.median(half):>16.5f}{covered:>9.0f}%", flush=True)


if __name__ == "__main__":
    main()
