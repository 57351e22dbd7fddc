"""Mounts are recovered from a moving vehicle, and parameters that are not identifiable keep their values."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.core.rotations import quat_from_euler, quat_to_matrix
from finssim.survey import mounts_fit
from finssim.survey.mounts_fit import (
    Moment,
    MountState,
    Rig,
    change,
    fit_mounts,
    moment_blocks,
    moved,
    reference_tag,
    residuals,
    start_state,
)
from finssim.survey.pose import Pose
from finssim.trials.findings import CalibrationError
from survey.moving_vehicle import EDGE, MOUNTS, POOL, PORT, moments, motion

RIG = Rig(pool=POOL, edge=EDGE, port=PORT, reference=15)
TRUTH = MountState(reference=MOUNTS[15], others={16: MOUNTS[15].inverse.then(MOUNTS[16])}, poses=[])
LEVEL = quat_to_matrix(quat_from_euler(0.0, 0.0, np.pi / 2))
FILE = {15: Pose(LEVEL, np.array([0.07, 0.0, 0.10])), 16: Pose(LEVEL, np.array([-0.07, 0.0, 0.10]))}
"""Mounts of a vehicle file: a centimetre and two degrees off."""


def errors(fit, names, truth=TRUTH):
    return dict(zip(names, change(truth, fit.state, names), strict=True))


@pytest.fixture(scope="module")
def rocked():
    return moments(motion(tilt=0.2), np.random.default_rng(0))


@pytest.fixture(scope="module")
def fitted(rocked):
    return fit_mounts(RIG, FILE, rocked)


def test_derivatives_are_those_of_the_prediction(rocked, monkeypatch):
    """Every column of the normal equations' right side equals a numerical derivative of the cost."""
    some = [replace(m, corners=dict(m.corners)) for m in rocked[:3]]
    state, _ = start_state(RIG, FILE, some)
    monkeypatch.setattr(mounts_fit, "PIXEL_STD", 1e3)  # no corner is far off

    def cost(s):
        pixels, _, rest = residuals(RIG, s, some)
        return 0.5 * (np.sum((pixels / 1e3) ** 2) + sum(np.sum(r**2) for r in rest))

    blocks = moment_blocks(RIG, state, some)
    still, h = [np.zeros(6)] * 3, 1e-5
    slope = np.sum([block.a for block in blocks], axis=0)
    for k in range(len(state.names)):
        step = h * np.eye(len(state.names))[k]
        numeric = (cost(moved(state, step, still)) - cost(moved(state, -step, still))) / (2 * h)
        assert -slope[k] == pytest.approx(numeric, rel=2e-4, abs=2e-4 * np.abs(slope).max() * 1e-2 + 1e-6)
    for k in range(6):
        step = h * np.eye(6)[k]
        zero = np.zeros(len(state.names))
        numeric = (
            cost(moved(state, zero, [step, *still[1:]])) - cost(moved(state, zero, [-step, *still[1:]]))
        ) / (2 * h)
        assert -blocks[0].b[k] == pytest.approx(numeric, rel=2e-4, abs=1e-4)


@pytest.mark.slow
def test_a_rocking_vehicle_tells_its_tags_whole(fitted):
    """Relative mounts are right to tenths of a millimetre; those in the body follow from the IMU's tilt and
    the depth."""
    assert not fitted.frozen
    off = errors(fitted, fitted.free)
    for name, error in off.items():
        assert abs(error) < 2.5 * fitted.half_width(name), name
    assert np.linalg.norm([off["16.x"], off["16.y"]]) < 5e-4
    assert np.degrees(max(abs(off[f"reference.turn_{axis}"]) for axis in "xyz")) < 1.0
    assert np.linalg.norm([off[f"reference.{axis}"] for axis in "xy"]) < 0.01
    assert abs(off["reference.z"]) < 3e-3
    assert fitted.rms == pytest.approx(0.15 * np.sqrt(2.0), rel=0.25)


@pytest.mark.slow
def test_a_level_vehicle_keeps_the_files_heading_and_place():
    """Without tilt only the file defines the body's axes and origin; relative mounts are still identified."""
    fit = fit_mounts(RIG, FILE, moments(motion(tilt=0.0), np.random.default_rng(1)))
    assert set(fit.frozen) == {"reference.turn_z", "reference.x", "reference.y"}
    np.testing.assert_allclose(fit.state.reference.t[:2], FILE[15].t[:2], atol=1e-9)
    yaw = np.arctan2(fit.state.reference.R[1, 0], fit.state.reference.R[0, 0])
    assert yaw == pytest.approx(np.pi / 2, abs=1e-3)
    off = errors(fit, ("16.x", "16.y", "16.turn_z"))
    assert max(abs(off["16.x"]), abs(off["16.y"])) < 5e-4


@pytest.mark.slow
@pytest.mark.parametrize("quarter", [1, 2])
def test_a_tag_glued_on_turned_is_found(quarter):
    """The file's heading of the tag is wrong by quarter turns; the IMU's tilt identifies the right one."""
    wrong = quat_to_matrix(quat_from_euler(0.0, 0.0, quarter * np.pi / 2)) @ LEVEL
    seen = moments(motion(tilt=0.2, seconds=24.0), np.random.default_rng(quarter))
    fit = fit_mounts(RIG, {15: Pose(wrong, FILE[15].t)}, seen)
    off = errors(fit, ("reference.turn_z", "16.x", "16.y"))
    assert abs(np.degrees(off["reference.turn_z"])) < 1.5
    assert max(abs(off["16.x"]), abs(off["16.y"])) < 1e-3  # included although the file lacks it


@pytest.mark.slow
def test_intervals_hold_the_truth():
    """For three recordings, at least 85 % of the intervals contain the truth where 95 % are nominal."""
    inside = []
    for seed in range(3):
        seen = moments(motion(tilt=0.2, seconds=20.0), np.random.default_rng(100 + seed))
        fit = fit_mounts(RIG, FILE, seen)
        inside += [abs(error) < fit.half_width(name) for name, error in errors(fit, fit.free).items()]
    assert np.mean(inside) > 0.85


@pytest.mark.slow
def test_wrongly_read_tags_do_not_pull(rocked):
    """Pictures in which something else was read as a tag are dropped."""
    rng = np.random.default_rng(0)
    broken = list(rocked[:84])
    for i in range(0, 84, 12):
        corners_px = {
            tag: px + rng.uniform(-40.0, 40.0, 2) * (tag == 16) for tag, px in broken[i].corners.items()
        }
        broken[i] = replace(broken[i], corners=corners_px)
    fit = fit_mounts(RIG, FILE, broken)
    off = errors(fit, ("16.x", "16.y"))
    assert max(abs(off["16.x"]), abs(off["16.y"])) < 1e-3
    assert fit.excluded > 0


def test_what_shows_too_little_is_refused(rocked):
    with pytest.raises(CalibrationError, match="expected at least 8"):
        fit_mounts(RIG, FILE, rocked[:4])
    with pytest.raises(CalibrationError, match=r"none of the vehicle file's tags \[3\] is seen"):
        reference_tag(rocked, {3: FILE[15]})
    blind = [Moment(time=m.time, corners={}) for m in rocked]
    with pytest.raises(CalibrationError, match="0 pictures"):
        fit_mounts(RIG, FILE, blind)
