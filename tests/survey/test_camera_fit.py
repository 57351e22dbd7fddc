"""Lenses are recovered from pictures of boards, with valid intervals, and advice where the boards are
insufficient."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from finssim.core.optics import COEFFICIENTS
from finssim.identification.uncertainty import intervals, trial_covariance
from finssim.localization.camera_file import load_camera
from finssim.survey.camera_fit import (
    adjust,
    calibrate_camera,
    evidence,
    lens_names,
    lens_vector,
)
from finssim.trials.findings import CalibrationError
from survey.board_views import LENSES, PHOTOGRAPHS, photographed, views


@pytest.mark.slow
@pytest.mark.parametrize("model", COEFFICIENTS)
def test_a_lens_comes_back_from_its_pictures(model):
    """For every model, pixels over the whole picture agree to a fraction of a corner's noise."""
    lens = LENSES[model]
    fit = calibrate_camera(views(lens, 20, np.random.default_rng(3)), model=model)
    assert fit.rms == pytest.approx(0.15 * np.sqrt(2.0), rel=0.1)
    assert fit.held_out_rms == pytest.approx(fit.rms, rel=0.15)
    u, v = np.meshgrid(np.linspace(150, lens.width - 150, 9), np.linspace(120, lens.height - 120, 7))
    pixels = np.stack([u, v], axis=-1)
    seen, _ = fit.lens.project(lens.rays(pixels)[0])
    assert np.abs(seen - pixels - (seen - pixels).mean(axis=(0, 1))).max() < 1.5
    for name in ("fx", "fy"):
        low, high = fit.estimates[name].ci95
        assert low - 1.0 < getattr(lens, name) < high + 1.0


@pytest.mark.slow
def test_intervals_hold_the_truth_nineteen_times_of_twenty():
    """Of 4 x 30 intervals over many sets of ten pictures, at least 84 % must contain the truth."""
    lens, inside = LENSES["plumb_bob"], []
    for seed in range(30):
        seen = views(lens, 10, np.random.default_rng(seed))
        bundle = adjust(seen, "plumb_bob")
        ends = intervals(lens_vector(bundle.lens), trial_covariance(evidence(bundle, seen)))
        truth = lens_vector(lens)
        inside.append(((ends[:, 0] < truth) & (truth < ends[:, 1]))[:4])
    assert np.mean(inside) > 0.84


def test_the_minimum_is_opencvs():
    """On the same corners, with noise and without outliers, both fits give the same lens."""
    lens = LENSES["plumb_bob"]
    seen = views(lens, 12, np.random.default_rng(5), noise=0.05)
    bundle = adjust(seen, "plumb_bob")
    points = [view.points.astype(np.float32) for view in seen]
    pixels = [view.pixels.astype(np.float32) for view in seen]
    _, K, distortion, _, _ = cv2.calibrateCamera(points, pixels, (lens.width, lens.height), None, None)
    assert bundle.lens.fx == pytest.approx(K[0, 0], abs=0.1)
    assert bundle.lens.cy == pytest.approx(K[1, 2], abs=0.1)
    np.testing.assert_allclose(bundle.lens.distortion[:2], distortion.ravel()[:2], atol=2e-3)


def test_opencvs_chessboards_give_the_published_lens():
    """fx is within 1 % of the published 535.9 px, and all 13 pictures are good.

    In the published fit one picture, left02, has 1.18 px: its squares are small, and the window that refined its
    corners included their neighbours. With windows that fit the squares it is as good as the others.
    """
    fit = calibrate_camera(photographed())
    published = load_camera(PHOTOGRAPHS / "left_intrinsics.yml").lens
    assert fit.lens.fx == pytest.approx(published.fx, rel=0.01)
    assert fit.lens.fy == pytest.approx(published.fy, rel=0.01)
    assert abs(fit.lens.cx - published.cx) < 3.0 and abs(fit.lens.cy - published.cy) < 3.0
    assert all(not view.left_out and view.rms < 0.3 for view in fit.views)
    assert fit.rms < 0.2 < 0.393  # the published mean
    assert fit.held_out_rms < 0.21
    low, high = fit.estimates["k1"].ci95
    assert low < published.distortion[0] < high
    low, high = fit.estimates["k2"].ci95
    assert low < published.distortion[1] < high
    assert any("left" in one.values.get("sides", ()) for one in fit.findings)


def test_published_distortion_bends_pixels_as_ours_where_corners_were_seen():
    """Coefficients are correlated; the displacement of pixels, with a free camera rotation, agrees to 2 px.

    Focal lengths differ by 0.5 %, which is 1.5 px at the edge.
    """
    fit = calibrate_camera(photographed())
    published = load_camera(PHOTOGRAPHS / "left_intrinsics.yml").lens
    pixels = np.concatenate([view.pixels for view in fit.used])
    rays = published.rays(pixels)[0]
    shift = fit.lens.project(rays)[0] - pixels
    A = -fit.lens.project_jacobian(rays) @ np.array(
        [[[0, -z, y], [z, 0, -x], [-y, x, 0]] for x, y, z in rays]
    )
    turn, *_ = np.linalg.lstsq(A.reshape(-1, 3), shift.ravel(), rcond=None)
    assert np.linalg.norm(shift - A @ turn, axis=1).max() < 2.0


@pytest.mark.slow
def test_a_picture_that_disagrees_is_named_and_left_out():
    """The lens is that of the other pictures."""
    seen = list(views(LENSES["plumb_bob"], 14, np.random.default_rng(1)))
    clean = calibrate_camera(seen[:6] + seen[7:])
    seen[6] = replace(seen[6], pixels=seen[6].pixels + np.random.default_rng(2).normal(0.0, 3.0, (54, 2)))
    fit = calibrate_camera(seen)
    assert [view.name for view in fit.views if view.left_out] == ["06.png"]
    assert "those of the others" in next(view.left_out for view in fit.views if view.left_out)
    assert fit.lens.fx == pytest.approx(clean.lens.fx, abs=0.1)


def test_level_boards_do_not_tell_the_focal_length():
    """In fronto-parallel views focal length and distance are correlated, which is reported."""
    fit = calibrate_camera(views(LENSES["plumb_bob"], 12, np.random.default_rng(0), tilt=0.02))
    assert not fit.estimates["fx"].identifiable
    assert "views_flat" in {one.code for one in fit.findings}


def test_an_empty_border_is_spoken_of():
    fit = calibrate_camera(views(LENSES["plumb_bob"], 12, np.random.default_rng(0), reach=0.1))
    assert "edges_empty" in {one.code for one in fit.findings}
    assert fit.error95[1] > 2.0 * fit.error95[0]


def test_pictures_of_several_sizes_are_refused_by_name():
    seen = list(views(LENSES["plumb_bob"], 6, np.random.default_rng(0)))
    seen[2] = replace(seen[2], width=640, height=360)
    with pytest.raises(CalibrationError, match=r"02\.png \(640x360\)"):
        calibrate_camera(seen)
    with pytest.raises(CalibrationError, match="expected at least 4"):
        calibrate_camera(seen[:2])
    with pytest.raises(CalibrationError, match="unknown lens model 'pinhole'"):
        calibrate_camera(seen, model="pinhole")


def test_the_same_pictures_give_the_same_fit():
    seen = views(LENSES["plumb_bob"], 8, np.random.default_rng(0))
    one, two = calibrate_camera(seen, seed=4), calibrate_camera(seen, seed=4)
    assert one.lens == two.lens and one.held_out_rms == two.held_out_rms
    assert tuple(one.estimates) == lens_names("plumb_bob")
