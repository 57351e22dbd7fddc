"""Lenses: agreement with OpenCV, the inverse, the fold of a distortion, derivatives, refusals."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from core.optics.scenes import LENSES, SIZE
from finssim.core.optics import Lens, OpticsError

every_lens = pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())


def front(count: int = 500, widest: float = 60.0) -> np.ndarray:
    """Return points in front of a camera, up to `widest` degrees from its axis, at all distances."""
    rng = np.random.default_rng(1)
    angle, turn = np.radians(rng.uniform(0.0, widest, count)), rng.uniform(-np.pi, np.pi, count)
    ray = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=-1)
    return ray * rng.uniform(0.1, 10.0, (count, 1))


@every_lens
def test_projects_as_opencv(lens):
    """Pixels equal cv2.projectPoints and cv2.fisheye.projectPoints: same models, same pixel centres."""
    points, zero = front(), np.zeros(3)
    if lens.model == "fisheye":
        theirs, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, lens.K, np.array(lens.distortion))
    else:
        distortion = np.array(lens.distortion) if lens.distortion else None
        theirs, _ = cv2.projectPoints(points, zero, zero, lens.K, distortion)
    ours, ok = lens.project(points)
    assert ok.all()
    np.testing.assert_allclose(ours, theirs[:, 0], atol=1e-9)


@every_lens
def test_a_pixel_looks_where_it_sees(lens):
    """Rays of the pixels of points pass through the points: the distortion is inverted to rounding."""
    points = front()
    pixels, _ = lens.project(points)
    rays, ok = lens.rays(pixels)
    assert ok.all()
    np.testing.assert_allclose(rays, points / np.linalg.norm(points, axis=-1, keepdims=True), atol=1e-12)


@every_lens
def test_every_pixel_of_the_image_has_its_own_ray(lens):
    """Over the whole image, corners included, each pixel's ray projects back to that pixel."""
    u, v = np.meshgrid(np.linspace(-0.5, 1279.5, 41), np.linspace(-0.5, 719.5, 23))
    pixels = np.stack([u, v], axis=-1)
    rays, ok = lens.rays(pixels)
    assert ok.all()
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, atol=1e-14)
    np.testing.assert_allclose(lens.project(rays)[0], pixels, atol=1e-9)


@every_lens
def test_derivatives(lens):
    """Derivatives by point and by parameter equal central differences."""
    points, e = front(60), 1e-6
    p = points / np.linalg.norm(points, axis=-1, keepdims=True)
    steps = e * np.eye(3)
    numeric = [(lens.project(p + d)[0] - lens.project(p - d)[0]) / (2 * e) for d in steps]
    # Error of the difference: e² third derivatives and rounding (1e3 px 1e-16)/e.
    np.testing.assert_allclose(lens.project_jacobian(p), np.stack(numeric, -1), rtol=1e-6, atol=1e-5)
    values = np.array([lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion])
    numeric = []
    for d in e * np.eye(len(values)):
        plus, minus = (replace_values(lens, values + sign * d).project(p)[0] for sign in (1, -1))
        numeric.append((plus - minus) / (2 * e))
    np.testing.assert_allclose(lens.parameter_jacobian(p), np.stack(numeric, -1), rtol=1e-6, atol=1e-5)


def replace_values(lens: Lens, values: np.ndarray) -> Lens:
    """Return the lens with other fx, fy, cx, cy and coefficients."""
    fx, fy, cx, cy, *distortion = values.tolist()
    return replace(lens, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(distortion))


@every_lens
def test_the_axis_is_as_smooth_as_the_rest(lens):
    """On the optical axis and close to it, values and derivatives are finite and agree."""
    at, beside = np.array([0.0, 0.0, 2.0]), np.array([1e-9, -2e-9, 2.0])
    np.testing.assert_allclose(lens.project(at)[0], [lens.cx, lens.cy], atol=1e-12)
    np.testing.assert_allclose(lens.rays([lens.cx, lens.cy])[0], [0.0, 0.0, 1.0], atol=1e-12)
    for derivative in (lens.project_jacobian, lens.parameter_jacobian):
        np.testing.assert_allclose(derivative(at), derivative(beside), atol=2e-6)


def test_the_fisheye_series_near_the_axis_meets_the_closed_form():
    """Just inside and outside of the radius where a series takes over, d²u/dxdy per x y is the same."""
    r = np.array([0.9e-4, 1.1e-4])
    jacobian = LENSES["fisheye"].project_jacobian(np.stack([0.6 * r, 0.7 * r, np.ones(2)], axis=-1))
    bend = jacobian[:, 0, 1] / (0.6 * 0.7 * r * r)
    assert bend[0] == pytest.approx(bend[1], rel=1e-6)


def test_a_barrel_refuses_what_lies_beyond_its_fold():
    """r (1 - 0.4 r²) turns back at r = sqrt(1/1.2): points beyond and pixels outside of its image are refused."""
    lens = Lens(**SIZE, distortion=(-0.4, 0.0, 0.0, 0.0))
    fold = np.sqrt(1.0 / 1.2)
    assert lens.field_of_view == pytest.approx(np.arctan(fold), rel=1e-8)
    # The last but one reappears near the axis.
    r = fold * np.array([0.5, 0.99, 0.999999, 1.000001, 1.2, 1.58, 2.0])
    points = np.stack([r, 0 * r, 1 + 0 * r], axis=-1)
    pixels, ok = lens.project(points)
    assert ok.tolist() == [True] * 3 + [False] * 4
    assert np.isnan(pixels[3:]).all()
    assert np.allclose(lens.rays(pixels[:3])[0] @ [0, 0, 1], 1.0 / np.hypot(1.0, r[:3]), atol=1e-9)
    widest = lens.cx + lens.fx * fold * (1 - 0.4 * fold**2)
    rays, ok = lens.rays([[widest - 1e-3, lens.cy], [widest + 1e-3, lens.cy], [1e5, 0.0], [np.nan, 3.0]])
    assert ok.tolist() == [True, False, False, False]
    assert np.isnan(rays[1:]).all()


@pytest.mark.parametrize("tangential", [0.0, 0.004, 0.02])
def test_within_the_fold_the_distortion_keeps_its_orientation(tangential):
    """Everywhere inside the fold of a folding lens the Jacobian is positive; just beyond, it is negative somewhere."""
    lens = Lens(**SIZE, distortion=(-0.4, 0.03, tangential, -0.5 * tangential))
    turn = np.linspace(-np.pi, np.pi, 721)
    least = []
    for part in (0.2, 0.6, 0.9, 0.9999, 1.001):
        r = part * np.tan(lens.field_of_view)
        p = np.stack([r * np.cos(turn), r * np.sin(turn), np.ones_like(turn)], axis=-1)
        least.append(np.linalg.det(lens.project_jacobian(p)[..., :2]).min())
    assert min(least[:4]) > 0.0 > least[4]


def test_a_rational_lens_stops_at_its_pole():
    """1 + k4 r² with k4 = -0.25 has its pole at r = 2: no point beyond has a pixel."""
    lens = Lens(**SIZE, model="rational", distortion=(0.0, 0.0, 0.0, 0.0, 0.0, -0.25, 0.0, 0.0))
    _, ok = lens.project([[1.9, 0.0, 1.0], [2.1, 0.0, 1.0]])
    assert ok.tolist() == [True, False]


def test_a_fisheye_sees_beyond_ninety_degrees():
    """Directions 120 degrees off the axis have pixels, and the pixels have those directions."""
    lens, angle = LENSES["wide"], np.radians([10.0, 89.0, 90.0, 91.0, 120.0])
    assert lens.field_of_view > np.radians(120.0)
    rays = np.stack([np.sin(angle), 0.3 * np.sin(angle), np.cos(angle)], axis=-1)
    pixels, ok = lens.project(rays)
    assert ok.all()
    back, ok = lens.rays(pixels)
    assert ok.all()
    np.testing.assert_allclose(back, rays / np.linalg.norm(rays, axis=-1, keepdims=True), atol=1e-12)


def test_a_perspective_lens_sees_nothing_behind_it():
    """Points behind the camera, and on its plane, have no pixel."""
    for name in ("pinhole", "plumb_bob", "barrel", "rational"):
        pixels, ok = LENSES[name].project([[0.1, 0.2, -1.0], [0.1, 0.2, 0.0], [0.0, 0.0, 0.0]])
        assert not ok.any() and np.isnan(pixels).all()


def test_batches_of_any_shape():
    """A batch equals single calls, for every leading shape, the empty one included."""
    for lens in LENSES.values():
        points = front(24).reshape(2, 3, 4, 3)
        pixels, ok = lens.project(points)
        assert pixels.shape == (2, 3, 4, 2) and ok.shape == (2, 3, 4)
        one, _ = lens.project(points[1, 2, 3])
        np.testing.assert_allclose(one, pixels[1, 2, 3], atol=1e-12)
        np.testing.assert_allclose(lens.rays(one)[0], lens.rays(pixels)[0][1, 2, 3], atol=1e-12)
        assert lens.project(np.empty((0, 3)))[0].shape == (0, 2)
        assert lens.rays(np.empty((0, 2)))[0].shape == (0, 3)


def test_the_image_reaches_half_a_pixel_past_its_outer_centres():
    """(0, 0) is the centre of the first pixel, so the image spans -0.5 to 1279.5."""
    lens = LENSES["pinhole"]
    inside = lens.inside(
        [[-0.49, 0.0], [-0.51, 0.0], [1279.49, 719.49], [1279.51, 0.0], [0.0, 719.51], [np.nan, 0.0]]
    )
    assert inside.tolist() == [True, False, True, False, False, False]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fx": 0.0}, "fx is 0.0, expected a positive number of pixels"),
        ({"fy": -3.0}, "fy is -3.0, expected"),
        ({"fx": float("nan")}, "fx is nan, expected"),
        ({"width": 0}, "width is 0, expected"),
        ({"cx": float("inf")}, "expected finite numbers"),
        ({"model": "fish"}, "unknown lens model 'fish'; available: plumb_bob, rational, fisheye"),
        (
            {"distortion": (0.1, 0.2, 0.3)},
            "distortion has 3 coefficients, expected 0 or 4 or 5 for plumb_bob",
        ),
        ({"model": "rational", "distortion": (0.1,) * 5}, "expected 0 or 8 for rational"),
        ({"model": "fisheye", "distortion": (0.1,) * 5}, "expected 0 or 4 for fisheye"),
        ({"distortion": (float("nan"), 0.0, 0.0, 0.0)}, "expected finite numbers"),
    ],
)
def test_an_impossible_lens_is_refused(change, words):
    """An impossible lens is refused in one sentence that states the expected values."""
    with pytest.raises(OpticsError) as refused:
        Lens(**{**SIZE, **change})
    assert words in str(refused.value)
