"""Work of `finssim calibrate camera`: read pictures, find the board, fit the lens, write the camera file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from finssim.core.least_squares import block_of, rms
from finssim.core.optics import COEFFICIENTS, Lens
from finssim.core.palette import BLUE, VERMILION
from finssim.core.provenance import provenance
from finssim.core.rotations import quat_from_rotvec, quat_to_matrix, skew
from finssim.identification.fit import Correlation, Estimate
from finssim.identification.report import (
    GRAY,
    HEADS,
    ExtraTable,
    Report,
    command_line,
    draw_arrows,
    interval_text,
    new_figure,
    number_text,
    picture_axes,
    png,
    publish,
    refuse_places,
)
from finssim.identification.uncertainty import (
    Covariance,
    Evidence,
    arrow_evidence,
    correlation,
    intervals,
    trial_covariance,
)
from finssim.localization.camera_file import write_camera
from finssim.localization.detection.pictures import pictures
from finssim.localization.poses.methods import plane_pose, refine_pose, through_lens
from finssim.survey.pose import Pose
from finssim.trials.findings import CalibrationError, Finding, finding, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "Board", "BoardView", "MODELS", "adjust", "calibrate_camera", "evidence",
    "lens_names", "lens_vector", "parse_size", "run", "see_board",
]  # fmt: skip

Array = NDArray[np.float64]

# Boards of known corners, and where a picture shows those corners.

REFINE_SHARE = 0.35
"""Half width of the window that refines a corner, in distances to its nearest neighbour: no other corner is in it."""

WIDEST, NARROWEST = 11, 2
"""Bounds of that half width [px]."""


@dataclass(frozen=True, kw_only=True)
class Board:
    """A flat chessboard or ChArUco board."""

    columns: int
    """Inner corners along x of a chessboard; squares of a ChArUco board."""
    rows: int
    """Along y."""
    square: float
    """Edge of a square [m]."""
    marker: float | None = None
    """Edge of a marker's black border [m]; None for a chessboard."""
    dictionary: str = "DICT_5X5_100"
    """Dictionary of the markers, by OpenCV's name."""

    def __post_init__(self) -> None:
        least = 3 if self.marker is None else 2
        if self.columns < least or self.rows < least:
            raise CalibrationError(
                f"the board has {self.columns}x{self.rows} {'corners' if self.marker is None else 'squares'}, "
                f"expected at least {least} each way"
            )
        if not (math.isfinite(self.square) and self.square > 0.0):
            raise CalibrationError(f"the square is {self.square:.4g} m, expected a length above 0")
        if self.marker is not None and not 0.0 < self.marker < self.square:
            raise CalibrationError(
                f"the marker is {self.marker:.4g} m, expected more than 0 and less than the square's "
                f"{self.square:.4g} m"
            )

    @property
    def words(self) -> str:
        """`chessboard of 9x6 inner corners, squares of 25 mm`."""
        kind = "chessboard" if self.marker is None else "ChArUco board"
        pattern = "inner corners" if self.marker is None else f"squares, markers of {1e3 * self.marker:g} mm"
        return f"{kind} of {self.columns}x{self.rows} {pattern}, squares of {1e3 * self.square:g} mm"

    @property
    def corners(self) -> Array:
        """Inner corners on the board, row by row, z = 0 [m], (n, 3)."""
        less = 0 if self.marker is None else 1
        x, y = np.meshgrid(np.arange(self.columns - less), np.arange(self.rows - less))
        return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1) * self.square


@dataclass(frozen=True, kw_only=True)
class BoardView:
    """The corners that one picture shows."""

    name: str
    width: int
    """Width of the picture [px]."""
    height: int
    """Height of the picture [px]."""
    pixels: Array
    """(n, 2); integer coordinates are pixel centres."""
    points: Array
    """Corners on the board, board frame, z = 0 [m], (n, 3)."""


def parse_size(text: str, option: str) -> tuple[int, int]:
    """`9x6` as two numbers.

    Raises:
        CalibrationError: It reads otherwise.
    """
    parts = text.lower().replace("×", "x").split("x")
    if len(parts) != 2 or not all(part.strip().isdigit() for part in parts):
        raise CalibrationError(f"{option} is '{text}', expected columns x rows such as 9x6")
    return int(parts[0]), int(parts[1])


def see_board(image: NDArray[np.uint8], board: Board) -> tuple[Array, Array] | None:
    """Find a board in a picture.

    Args:
        image: Gray, (h, w).
        board: The board.

    Returns:
        Pixels (n, 2) and the corners on the board (n, 3) [m]; None if it is not seen. A chessboard is seen as a whole
        or not at all, a ChArUco board in parts of at least 6 corners.

    Raises:
        CalibrationError: OpenCV has no such dictionary.
    """
    detection = (
        _chessboard(image, board.columns, board.rows) if board.marker is None else _charuco(image, board)
    )
    if detection is None:
        return None
    pixels, index = detection
    return pixels, board.corners[index]


def _chessboard(image: NDArray[np.uint8], columns: int, rows: int) -> tuple[Array, NDArray[np.int64]] | None:
    """Pixels and indices of all inner corners; two finders, for each misses boards that the other sees."""
    import cv2

    size = (columns, rows)
    success, corners = cv2.findChessboardCorners(
        image,
        size,
        flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK,
    )
    if not success:
        success, corners = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not success:
        return None
    pixels = np.asarray(corners, float).reshape(-1, 2)
    return _refined(image, pixels), np.arange(columns * rows)


def _refined(image: NDArray[np.uint8], pixels: Array) -> Array:
    """Corners where the gradients around them say, each within a window that holds no other corner.

    A window as wide as is usual pulls the corners of a small or oblique board towards their neighbours, by pixels.
    """
    import cv2

    distance = np.linalg.norm(pixels[:, None] - pixels[None], axis=-1)
    spacing = np.where(distance > 0.0, distance, np.inf).min(axis=1)
    half = np.clip((REFINE_SHARE * spacing).astype(int), NARROWEST, WIDEST)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-3)
    refined = pixels.copy()
    for size in np.unique(half):
        start = pixels[half == size].astype(np.float32).reshape(-1, 1, 2)
        refined[half == size] = cv2.cornerSubPix(
            image, start, (int(size), int(size)), (-1, -1), stop
        ).reshape(-1, 2)
    return refined


def _charuco(image: NDArray[np.uint8], board: Board) -> tuple[Array, NDArray[np.int64]] | None:
    """Pixels and indices of the corners between squares whose markers are read; refined like a chessboard's."""
    import cv2

    code = getattr(cv2.aruco, board.dictionary.upper(), None)
    if not isinstance(code, int):
        raise CalibrationError(
            f"unknown dictionary '{board.dictionary}', expected one of OpenCV's such as DICT_5X5_100 or DICT_4X4_50"
        )
    drawn = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.square, board.marker, cv2.aruco.getPredefinedDictionary(code)
    )
    # Boards drawn before OpenCV 4.6 start with the other colour if rows are even.
    for legacy in (False, True):
        drawn.setLegacyPattern(legacy)
        pixels, ids, _, _ = cv2.aruco.CharucoDetector(drawn).detectBoard(image)
        if ids is not None and len(ids) >= 6:
            index = np.asarray(ids).ravel().astype(np.int64)
            at = np.asarray(pixels, float).reshape(-1, 2)
            return _refined(image, at), index
    return None


# A lens and the poses of all boards, from the pixels of their corners.

MODELS = tuple(COEFFICIENTS)

FOCAL_SHARES = (1.0 / math.pi, 0.6, 1.2)
"""Focal lengths from which a fisheye is fitted, in widths of the image."""

FEWEST_VIEWS = 4

NO_LIMIT = 1e9
"""Distance from which corners of a held-out board would count linearly: they are not judged [px]."""

STRAY = 6.0
"""Times the median residual of its view for a corner to be left out: it was taken for another."""

OUTLIER = 2.0
"""Times the median residual of all views, at least, for a view to be left out; and beyond their usual spread."""

SPREAD = 4.0
"""Robust standard deviations of the logarithm of the views' residuals."""

NONSENSE = 0.003
"""Residual of the usual picture, in widths of the image, with which nothing can be right."""

MAX_EXCLUDED = 0.25
FOLDS = 8

UNSURE_FOCAL = 0.02
"""Half width of its interval, relative, beyond which a focal length does not count as identified."""

UNSURE_CENTRE = 0.02
"""Half width of its interval, in widths of the image, beyond which a principal point does not count as identified."""

COLUMNS, ROWS = 12, 9
"""Points of the picture at which the uncertainty of a pixel is computed."""

TWO_SIGMA_PLANE = 5.991
"""95 % point of chi-squared with two degrees of freedom."""

BORDER = 0.10
"""Empty share of the picture's width or height that is spoken of."""

FLAT, TILTED = math.radians(10.0), math.radians(20.0)
"""Tilts below which a board gives almost no information on the focal length, and little."""

FEW_VIEWS = 10
LARGE_ERROR = 1.0
"""Uncertainty somewhere in the picture that is spoken of [px]."""


@dataclass(frozen=True, kw_only=True)
class Bundle:
    """A lens and one pose per view."""

    lens: Lens
    poses: tuple[Pose, ...]
    residuals: tuple[Array, ...]
    """Measured less predicted, per view (n, 2) [px]."""

    @property
    def sigma(self) -> float:
        """Robust standard deviation of one coordinate of a corner [px]."""
        return max(1.4826 * float(np.median(np.abs(np.concatenate(self.residuals)))), 1e-9)

    @property
    def rms(self) -> Array:
        """Root of the mean squared distance of corners, per view [px]."""
        return np.array([rms(r) for r in self.residuals])


def lens_names(model: str) -> tuple[str, ...]:
    """Names of a lens's numbers, in the order of `Lens.parameter_jacobian`."""
    return ("fx", "fy", "cx", "cy", *COEFFICIENTS[model])


def lens_vector(lens: Lens) -> Array:
    """The lens's numbers in that order. Focal lengths and centre are in pixels."""
    return np.array([lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion])


def adjust(views: Sequence[BoardView], model: str) -> Bundle:
    """The lens and the poses with least squared distances of all corners, by OpenCV.

    Raises:
        CalibrationError: OpenCV finds none.
    """
    import cv2

    size = (views[0].width, views[0].height)
    solve, threads = _fisheye if model == "fisheye" else _perspective, cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)  # with more, sums depend on which of them ends first
        K, distortion, turns, shifts = solve(views, size, model)
    except cv2.error as error:
        raise CalibrationError(
            f"no {model} lens explains the pictures: is the board as stated, and flat? ({error.err})"
        ) from None
    finally:
        cv2.setNumThreads(threads)
    fx, _, cx, _, fy, cy = map(float, np.ravel(K)[:6])
    lens = Lens(*size, fx, fy, cx, cy, model, tuple(np.ravel(distortion)[: len(COEFFICIENTS[model])]))
    poses = tuple(
        Pose(quat_to_matrix(quat_from_rotvec(np.ravel(turn))), np.ravel(shift))
        for turn, shift in zip(turns, shifts, strict=True)
    )
    residuals = tuple(_residual(lens, pose, view) for pose, view in zip(poses, views, strict=True))
    return Bundle(lens=lens, poses=poses, residuals=residuals)


def _perspective(views: Sequence[BoardView], size: tuple[int, int], model: str) -> tuple[Any, ...]:
    import cv2

    points, pixels = ([np.asarray(getattr(v, n), np.float32) for v in views] for n in ("points", "pixels"))
    flags = cv2.CALIB_RATIONAL_MODEL if model == "rational" else 0
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-12)
    return tuple(cv2.calibrateCamera(points, pixels, size, None, None, flags=flags, criteria=stop)[1:])


def _fisheye(views: Sequence[BoardView], size: tuple[int, int], model: str) -> tuple[Any, ...]:
    import cv2

    points, pixels = ([np.asarray(getattr(v, n), float)[None] for v in views] for n in ("points", "pixels"))
    names = cv2 if hasattr(cv2, "CALIB_RECOMPUTE_EXTRINSIC") else cv2.fisheye  # where OpenCV 4 has them
    flags = names.CALIB_RECOMPUTE_EXTRINSIC | names.CALIB_FIX_SKEW | names.CALIB_USE_INTRINSIC_GUESS
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-12)
    ends, refusal = [], None
    for share in FOCAL_SHARES:
        f = share * size[0]
        K = np.array([[f, 0.0, 0.5 * (size[0] - 1)], [0.0, f, 0.5 * (size[1] - 1)], [0.0, 0.0, 1.0]])
        try:
            ends.append(
                cv2.fisheye.calibrate(points, pixels, size, K, np.zeros(4), flags=flags, criteria=stop)
            )
        except cv2.error as error:
            refusal = error
    if refusal is not None and not ends:
        raise refusal
    return tuple(min(ends, key=lambda end: end[0])[1:])


def _residual(lens: Lens, pose: Pose, view: BoardView) -> Array:
    """Measured less predicted pixels, NaN where the lens cannot see, (n, 2)."""
    return np.asarray(view.pixels - lens.project(pose.at(view.points))[0])


def board_pose(lens: Lens, view: BoardView) -> Pose | None:
    """The pose of a board with least squared residuals; None where none lies before the camera."""
    rays, ok = lens.rays(view.pixels)
    start = plane_pose(rays[ok], view.points[ok, :2]) if ok.sum() >= 4 else None
    if start is None:
        return None
    pose = refine_pose(through_lens(lens), view.points, view.pixels, start[1], start[0], NO_LIMIT)
    return None if pose is None else Pose(pose.rotation, pose.position)


def evidence(bundle: Bundle, views: Sequence[BoardView]) -> Evidence:
    """Return the evidence of each view on the lens without its own pose, for intervals that treat a view as one."""
    blocks = []
    for view, pose, residual in zip(views, bundle.poses, bundle.residuals, strict=True):
        points_c = pose.at(view.points)
        J = bundle.lens.project_jacobian(points_c)
        pose_jacobian = np.concatenate([-J @ skew(points_c - pose.t), J], axis=-1).reshape(-1, 6)
        shared = bundle.lens.parameter_jacobian(points_c).reshape(len(pose_jacobian), -1)
        blocks.append(block_of(*(x / bundle.sigma for x in (shared, pose_jacobian, residual.ravel()))))
    return arrow_evidence(blocks, lens_names(bundle.lens.model), "views")


@dataclass(frozen=True, kw_only=True)
class FittedView:
    """One picture after the fit."""

    name: str
    pixels: Array
    """(n, 2)"""
    residuals: Array
    """Measured less predicted, (n, 2) [px]."""
    pose: Pose
    left_out: str = ""
    """Reason why it was not used; empty if it was."""

    @property
    def rms(self) -> float:
        """Root of the mean squared distance of its corners [px]."""
        return rms(self.residuals)

    @property
    def tilt(self) -> float:
        """Angle between the board's normal and the optical axis [rad], 0 to pi/2."""
        return float(np.arccos(np.clip(abs(self.pose.R[2, 2]), 0.0, 1.0)))


@dataclass(frozen=True, kw_only=True)
class CameraFit:
    """A calibrated lens."""

    lens: Lens
    estimates: dict[str, Estimate]
    """fx, fy, cx, cy and the distortion, by name."""
    correlation: Correlation
    views: tuple[FittedView, ...]
    """Every picture in which the board was seen, in the order given."""
    rms: float
    """Root of the mean squared distance of corners over the views used [px]."""
    held_out_rms: float
    """Residual of views that the lens was not fitted to, only their pose; NaN if there are too few views [px]."""
    error95: tuple[float, float]
    """Largest radius of the 95 % circle of a pixel of known direction, where corners were seen and anywhere [px]."""
    covariance: Covariance
    """Covariance of the lens's numbers, in the order of `lens_names`."""
    findings: tuple[Finding, ...]
    settings: dict[str, Any] = field(default_factory=dict)

    @property
    def used(self) -> tuple[FittedView, ...]:
        """The views that the lens rests on."""
        return tuple(view for view in self.views if not view.left_out)


def calibrate_camera(views: Sequence[BoardView], *, model: str = "plumb_bob", seed: int = 0) -> CameraFit:
    """Fit a lens to views of a board.

    Args:
        views: From `see_board`; all of one size.
        model: plumb_bob, rational or fisheye.
        seed: Of the split for the held-out error.

    Raises:
        CalibrationError: Unknown model, fewer than four views, pictures of several sizes, which are named, or corners
            that no lens explains.
    """
    _check(views, model)
    bundle = adjust(views, model)
    _refuse_nonsense(bundle, views)
    used, bundle = _without_outliers(views, bundle)
    some = [_without_strays(view, bundle.residuals[i]) for i, view in enumerate(used)]
    if sum(len(view.pixels) for view in some) < sum(len(view.pixels) for view in used):
        bundle = adjust(some, model)
    covariance = trial_covariance(evidence(bundle, some))
    every = _views(views, {view.name: i for i, view in enumerate(used)}, bundle)
    pixels = np.concatenate([view.pixels for view in some])
    error95 = tuple(
        float(np.nanmax(pixel_error(bundle.lens, at, pixels, covariance)))
        for at in (pixels, picture_grid(bundle.lens))
    )
    half = intervals(np.zeros(len(covariance.names)), covariance)[:, 1]
    estimates = _estimates(bundle.lens, half)
    return CameraFit(
        lens=bundle.lens,
        estimates=estimates,
        correlation=correlation(covariance.names, covariance.local),
        views=every,
        rms=rms(np.concatenate(bundle.residuals)),
        held_out_rms=_held_out(some, model, seed),
        error95=error95,
        covariance=covariance,
        findings=camera_findings(bundle.lens, [v for v in every if not v.left_out], estimates, error95),
        settings={"model": model, "seed": seed},
    )


def _check(views: Sequence[BoardView], model: str) -> None:
    if model not in MODELS:
        raise CalibrationError(f"unknown lens model '{model}'; available: {', '.join(MODELS)}")
    if len(views) < FEWEST_VIEWS:
        raise CalibrationError(
            f"{len(views)} pictures show the board, expected at least {FEWEST_VIEWS}: take 15 to 30, the board tilted "
            "by 20 to 50 degrees each way and in every corner of the picture"
        )
    sizes: dict[tuple[int, int], list[str]] = {}
    for view in views:
        sizes.setdefault((view.width, view.height), []).append(view.name)
    if len(sizes) > 1:
        usual = max(sizes, key=lambda size: len(sizes[size]))
        others = [f"{name} ({w}x{h})" for (w, h), names in sizes.items() if (w, h) != usual for name in names]
        raise CalibrationError(
            f"pictures of several sizes: most are {usual[0]}x{usual[1]}, but not {', '.join(others[:6])}: "
            "give pictures of one camera in one mode"
        )


def _outliers(rms: Array) -> NDArray[np.bool_]:
    log = np.log(np.maximum(rms, 1e-12))
    middle = np.median(log)
    spread = max(1.4826 * float(np.median(np.abs(log - middle))), 0.1)
    return np.asarray((log > middle + SPREAD * spread) & (log > middle + math.log(OUTLIER)))


def _refuse_nonsense(bundle: Bundle, views: Sequence[BoardView]) -> None:
    usual, limit = float(np.median(bundle.rms)), max(1.0, NONSENSE * views[0].width)
    if not usual <= limit:
        raise CalibrationError(
            f"corner residuals are {usual:.1f} px in the median image, expected below {limit:.1f} px: no "
            "lens fits them: check the count of the board's corners, that it is flat, and that the "
            "model suits the lens"
        )


def _without_outliers(views: Sequence[BoardView], bundle: Bundle) -> tuple[list[BoardView], Bundle]:
    """Leave out the worst view as long as it is far from the others, and fit again; the others, and their fit."""
    used = list(views)
    for _ in range(min(int(MAX_EXCLUDED * len(views)), len(views) - FEWEST_VIEWS)):
        if not _outliers(bundle.rms).any():
            break
        del used[int(np.argmax(bundle.rms))]
        bundle = adjust(used, bundle.lens.model)
    return used, bundle


def _without_strays(view: BoardView, residual: Array) -> BoardView:
    """Return the view without corners that are far off among those of its own."""
    size = np.linalg.norm(residual, axis=-1)
    keep = size <= STRAY * max(float(np.median(size)), 1e-6)
    return replace(view, pixels=view.pixels[keep], points=view.points[keep])


def _held_out(views: Sequence[BoardView], model: str, seed: int) -> float:
    """Residual of views that the lens has not seen: each fold left out in turn, only the poses of its views fitted."""
    folds = min(FOLDS, len(views))
    if len(views) - math.ceil(len(views) / folds) < FEWEST_VIEWS - 1:
        return math.nan
    fold = np.random.default_rng(seed).permutation(len(views)) % folds
    residuals = []
    for k in range(folds):
        lens = adjust([view for view, part in zip(views, fold, strict=True) if part != k], model).lens
        for view in (view for view, part in zip(views, fold, strict=True) if part == k):
            if (pose := board_pose(lens, view)) is not None:
                residuals.append(_residual(lens, pose, view))
    return rms(np.concatenate(residuals)) if residuals else math.nan


def _views(views: Sequence[BoardView], used: Mapping[str, int], bundle: Bundle) -> tuple[FittedView, ...]:
    median, every = float(np.median(bundle.rms)), []
    for view in views:
        pose = bundle.poses[used[view.name]] if view.name in used else board_pose(bundle.lens, view)
        if pose is None:
            continue
        residual = _residual(bundle.lens, pose, view)
        reason = f"its corners miss by {rms(residual):.2f} px, those of the others by {median:.2f} px"
        exclusion = "" if view.name in used else reason
        every.append(
            FittedView(name=view.name, pixels=view.pixels, residuals=residual, pose=pose, left_out=exclusion)
        )
    return tuple(every)


def _estimates(lens: Lens, half: Array) -> dict[str, Estimate]:
    """Return estimates by name, from half widths of the 95 % intervals in the order of `lens_names`."""
    estimates = {}
    for name, value, width in zip(lens_names(lens.model), lens_vector(lens), half, strict=True):
        unit, limit, note = "-", math.inf, "not told"
        if name.startswith("f"):
            unit, limit, note = (
                "px",
                UNSURE_FOCAL * value,
                "not distinguishable from the distance of the board",
            )
        elif name.startswith("c"):
            unit, limit, note = (
                "px",
                UNSURE_CENTRE * lens.width,
                "not distinguishable from a rotation of the board",
            )
        estimate = Estimate.within(name, value, width, unit, width < limit, note)
        if unit == "-" and abs(value) < width < limit:
            estimate = replace(estimate, note="not distinguishable from 0")
        estimates[name] = estimate
    return estimates


# How well a calibrated lens is known over the picture, and where the pictures taken say nothing about it.


def picture_grid(lens: Lens) -> Array:
    """Centres of `COLUMNS` by `ROWS` cells of the picture [px], (rows, columns, 2)."""
    u, v = (size * (np.arange(n) + 0.5) / n - 0.5 for size, n in ((lens.width, COLUMNS), (lens.height, ROWS)))
    return np.stack(np.meshgrid(u, v), axis=-1)


def pixel_error(lens: Lens, at: Array, corners: Array, covariance: Covariance) -> Array:
    """Radius of the 95 % circle of pixels whose direction is known [px], (...); NaN where the lens cannot see.

    d pixel = A d lens + B turn, without the turn of the whole camera that takes most of it away at the corners: any
    pose takes that up.

    Args:
        lens: The lens.
        at: Pixels, (..., 2).
        corners: Pixels of the corners that were used, (n, 2).
        covariance: Of the lens's numbers, in the order of `Lens.parameter_jacobian`.
    """

    def derivatives(pixels: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        rays, ok = lens.rays(pixels)
        safe = np.where(ok[..., None], rays, np.array([0.0, 0.0, 1.0]))
        return lens.parameter_jacobian(safe), -lens.project_jacobian(safe) @ skew(safe), ok

    A, B, ok = derivatives(corners)
    turn = -np.linalg.pinv(B[ok].reshape(-1, 3)) @ A[ok].reshape(-1, A.shape[-1])
    A, B, ok = derivatives(at)
    J = A + B @ turn
    if not np.isfinite(covariance.local).all():
        return np.full(at.shape[:-1], np.nan)
    # The information gives the shape, the disagreement of the views the size: alone, theirs would lack directions.
    ratio = covariance.std**2 / np.maximum(np.diagonal(covariance.local), 1e-300)
    S = max(float(np.mean(ratio)), 1.0) * J @ covariance.local @ np.swapaxes(J, -1, -2)
    radius = np.sqrt(TWO_SIGMA_PLANE * np.maximum(np.linalg.eigvalsh(S)[..., -1], 0.0))
    return np.asarray(np.where(ok, radius, np.nan))


def camera_findings(
    lens: Lens, views: Sequence[FittedView], estimates: Mapping[str, Estimate], error95: tuple[float, float]
) -> tuple[Finding, ...]:
    """Return findings on coverage, tilt and undetermined numbers, and what to photograph; none if all is well.

    `error95` is in pixels.
    """
    tilts, findings = np.array([view.tilt for view in views]), []
    tilted = int(np.sum(tilts > TILTED))
    if tilts.max() < FLAT:
        findings.append(finding("views_flat", tilt=math.degrees(tilts.max())))
    elif tilted < 3:
        findings.append(finding("few_tilted", views=tilted))
    empty = {side: share for side, share in empty_edges(lens, views).items() if share > BORDER}
    if empty:
        shares = tuple(f"{100.0 * share:.0f} % of the {side} edge" for side, share in empty.items())
        findings.append(finding("edges_empty", sides=tuple(empty), shares=shares))
    if len(views) < FEW_VIEWS:
        findings.append(finding("few_views", views=len(views)))
    unsure = [e for e in estimates.values() if not e.identifiable]
    if unsure:
        names = tuple(e.name for e in unsure)
        findings.append(finding("lens_undetermined", parameters=names, reason=unsure[0].note))
    nothing = [e.name for e in estimates.values() if e.identifiable and e.note]
    if lens.model == "rational" and len(nothing) >= 3:
        findings.append(finding("coefficients_zero", parameters=tuple(nothing)))
    if np.isfinite(error95[1]) and error95[1] >= LARGE_ERROR:
        findings.append(finding("pixels_uncertain", inside=error95[0], anywhere=error95[1]))
    return tuple(findings)


def empty_edges(lens: Lens, views: Sequence[FittedView]) -> dict[str, float]:
    """Border of the picture without a corner at left, right, top and bottom, as a share of its width or height [-]."""
    pixels, size = np.concatenate([view.pixels for view in views]), np.array([lens.width, lens.height])
    low, high = (pixels.min(axis=0) + 0.5) / size, (size - 0.5 - pixels.max(axis=0)) / size
    shares = zip(("left", "right", "top", "bottom"), (low[0], high[0], low[1], high[1]), strict=True)
    return {side: float(share) for side, share in shares}


READING = (
    "The interval holds the true value in 19 of 20 such calibrations: it comes from how much the pictures disagree, "
    "each picture counting once. Coefficients of the distortion go together; judge the lens by the error over the "
    "picture and by the residual of views that it was not fitted to."
)

DIGITS = 7
"""Digits of the numbers in a record."""

OF_A_VIDEO = 15
"""Interval between used pictures of a video: neighbours show the same view."""


def camera_record(fit: CameraFit) -> dict[str, Any]:
    """Return the record of a camera file: estimates, intervals, residuals and their origin, as plain values."""
    record = {
        "estimates": {
            name: {"estimate": e.estimate, "ci95": e.ci95, "unit": e.unit}
            for name, e in fit.estimates.items()
        },
        "rms_px": fit.rms,
        "held_out_rms_px": fit.held_out_rms,
        "views": len(fit.used),
        "left_out": {view.name: view.left_out for view in fit.views if view.left_out},
        "findings": [item.as_json() for item in fit.findings],
        "settings": fit.settings,
        "provenance": provenance(),
    }
    return dict(plain(record, DIGITS))


def camera_json(fit: CameraFit, out: Path | None = None) -> dict[str, Any]:
    """Return what `--json` prints: the record, the lens, every view, the correlation of the errors and the coverage."""
    views = [
        {
            "name": view.name,
            "rms_px": view.rms,
            "tilt_deg": math.degrees(view.tilt),
            "corners": len(view.pixels),
            "left_out": view.left_out or None,
        }
        for view in fit.views
    ]
    record = {
        "per_view": views,
        "error95_px": dict(zip(("where_seen", "anywhere"), fit.error95, strict=True)),
        "empty_edges": empty_edges(fit.lens, fit.used),
        "correlation": fit.correlation.as_json(),
    }
    return {
        "kind": "camera",
        **camera_record(fit),
        "parameters": {name: estimate.as_json() for name, estimate in fit.estimates.items()},
        **plain(record, DIGITS),
        "out": None if out is None else str(out),
    }


def camera_report(fit: CameraFit) -> Report:
    """The calibration in words."""
    worst = max(fit.used, key=lambda view: view.rms)
    held_out = "too few views to hold any out"
    if math.isfinite(fit.held_out_rms):
        held_out = f"views held out: {fit.held_out_rms:.3f} px"
    summary = [
        f"residual {fit.rms:.3f} px rms of a corner, worst view {worst.name} {worst.rms:.3f} px; {held_out}"
    ]
    if math.isfinite(fit.error95[1]):
        summary.append(
            f"a pixel is known to {fit.error95[0]:.2f} px (95 %) where corners were seen, to "
            f"{fit.error95[1]:.2f} px anywhere in the picture"
        )
    return Report(
        title="Camera calibration",
        heads=(*HEADS, "note"),
        headline=f"{fit.settings['model']} lens from {len(fit.used)} of {len(fit.views)} views",
        estimates=list(fit.estimates.values()),
        cells=_cells,
        summary=summary,
        findings=[
            *(finding("view_left_out", v.name, reason=v.left_out) for v in fit.views if v.left_out),
            *fit.findings,
        ],
        advice_title="What to photograph next",
        reading=READING,
    )


def _cells(estimate: Estimate) -> tuple[str, ...]:
    value = f"{estimate.estimate:.2f}" if estimate.unit == "px" else number_text(estimate.estimate)
    return estimate.name, value, interval_text(estimate), estimate.unit, estimate.note


def _views_table(fit: CameraFit) -> ExtraTable:
    rows = [
        (v.name, f"{v.rms:.3f}", f"{math.degrees(v.tilt):.0f}", str(len(v.pixels)), v.left_out or "used")
        for v in fit.views
    ]
    heads = ("view", "rms [px]", "tilt [deg]", "corners", "state")
    return heads, rows, ["doubt" if v.left_out else "" for v in fit.views]


# Pictures of a lens calibration: where corners were seen, how well the picture is known, what is left over.


def camera_pictures(fit: CameraFit) -> dict[str, tuple[str, bytes]]:
    """File name -> what the picture shows, and the PNG."""
    drawn = {
        "coverage.png": ("Detected corners, and uncertainty of pixels", _coverage(fit)),
        "residuals.png": ("Corners less what the lens predicts, enlarged", _residuals(fit)),
    }
    return {name: (text, png(figure)) for name, (text, figure) in drawn.items()}


def _coverage(fit: CameraFit) -> Figure:
    from matplotlib.colors import LogNorm

    width, height = fit.lens.width, fit.lens.height
    figure = new_figure(7.4, 7.4 * height / width + 0.3)
    axes = figure.subplots()
    corners = np.concatenate([view.pixels for view in fit.used])
    error = pixel_error(fit.lens, picture_grid(fit.lens), corners, fit.covariance)
    image = axes.imshow(
        np.clip(np.ma.masked_invalid(error), 0.03, 30.0),
        extent=(-0.5, width - 0.5, height - 0.5, -0.5),
        cmap="viridis_r",
        norm=LogNorm(0.03, 30.0),
        alpha=0.75,
    )
    for view in fit.views:
        mark = {"color": VERMILION, "marker": "x"} if view.left_out else {"color": "black", "marker": "."}
        axes.plot(*view.pixels.T, linestyle="", markersize=2.5, **mark)
    picture_axes(axes, fit.lens)
    axes.set_title("corners (crosses: left out) and 95 % uncertainty of a pixel [px]", fontsize=9)
    figure.colorbar(image, ax=axes, shrink=0.8, label="px")
    return figure


def _residuals(fit: CameraFit) -> Figure:
    pixels = np.concatenate([view.pixels for view in fit.used])
    residuals = np.concatenate([view.residuals for view in fit.used])
    figure = new_figure(7.4, 4.0)
    field, cloud = figure.subplots(1, 2, width_ratios=(1.9, 1.0))
    draw_arrows(field, pixels, residuals, np.ones(len(pixels), bool), "px", 1.0)
    picture_axes(field, fit.lens)
    cloud.plot(*residuals.T, ".", color=BLUE, markersize=2.5)
    limit = 1.1 * float(np.abs(residuals).max())
    cloud.set(xlim=(-limit, limit), ylim=(limit, -limit), aspect="equal")
    cloud.set(xlabel="along u [px]", ylabel="along v [px]")
    cloud.axhline(0.0, color=GRAY, linewidth=0.6)
    cloud.axvline(0.0, color=GRAY, linewidth=0.6)
    cloud.set_title(f"rms {fit.rms:.3f} px", fontsize=9)
    return figure


@dataclass(frozen=True, kw_only=True)
class BoardChoice:
    """Calibration board that the images show."""

    board: str | None = None
    """(NxM) Inner corners of a chessboard, such as 9x6."""
    square: float = 0.025
    """Edge of a square [m]."""
    charuco: str | None = None
    """(NxM) Squares of a ChArUco board instead of a chessboard, such as 7x5."""
    marker: float | None = None
    """Edge of its markers [m]; three quarters of a square if not given."""
    dictionary: str = "DICT_5X5_100"
    """(NAME) OpenCV's name of the marker dictionary."""

    def made(self) -> Board:
        """Return the board.

        Raises:
            CalibrationError: No board is given, or two, or a size cannot be read.
        """
        if (self.board is None) == (self.charuco is None):
            given = (
                "neither --board nor --charuco is" if self.board is None else "--board and --charuco are both"
            )
            raise CalibrationError(
                f"{given} given: name the one board that the pictures show, --board COLUMNSxROWS by its inner corners"
            )
        if self.charuco is not None:
            columns, rows = parse_size(self.charuco, "--charuco")
            edge = 0.75 * self.square if self.marker is None else self.marker
            return Board(
                columns=columns, rows=rows, square=self.square, marker=edge, dictionary=self.dictionary
            )
        columns, rows = parse_size(str(self.board), "--board")
        return Board(columns=columns, rows=rows, square=self.square)

    @property
    def options(self) -> dict[str, Any]:
        """Options of a command line that name it."""
        if self.charuco is None:
            return {"square": self.square, "board": self.board}
        return {
            "square": self.square, "charuco": self.charuco, "dictionary": self.dictionary, "marker": self.marker
        }  # fmt: skip


def run(
    images: Sequence[Path],
    *,
    out: Path,
    board: Annotated[BoardChoice, "options"],
    model: str = "plumb_bob",
    report: Path | None = None,
    seed: int = 1,
    as_json: bool = False,
) -> CameraFit:
    """Fit a lens to images of a board: focal length and centre [px], distortion, with 95 % intervals.

    Example: finssim calibrate camera board/*.jpg --board 9x6 --square 0.025 --out camera.yaml

    Args:
        images (IMAGE): Images of a board, folders of them, or videos.
        out (FILE): Camera file to write (.yaml).
        board: Board that the images show.
        model (MODEL): Lens: plumb_bob, rational or fisheye.
        report (DIR): Directory for the report and its figures.
        seed: Seed of every random number; equal seeds give equal results.
        as_json: Print one JSON object instead of tables.

    Returns:
        The fit.

    Raises:
        CalibrationError, LocalizationError, OutputError: As they say; nothing is written then.
    """
    if model not in MODELS:
        raise CalibrationError(f"unknown lens model '{model}'; available: {', '.join(MODELS)}")
    refuse_places(out, report, "camera")
    screen = Console(stderr=True)
    chosen = board.made()
    views, without = _board_views(images, chosen, screen)
    for name in without:
        screen.print(str(finding("board_unseen", name)), highlight=False, markup=False)
    if not views:
        raise CalibrationError(
            f"none of {len(without)} pictures shows a {chosen.words}: give --board or --charuco"
        )
    fit = calibrate_camera(views, model=model, seed=seed)
    fit.settings.update(board=chosen.words, square=chosen.square)
    write_camera(out, fit.lens, {**camera_record(fit), "without_board": without})
    summary = camera_report(fit)
    if report is not None:
        options = {"out": out, **board.options, "model": model, "seed": seed}
        repeat = [command_line("camera", images, options)]
        summary.write(report, camera_json(fit), camera_pictures(fit), repeat, {"Views": _views_table(fit)})
    publish(camera_json(fit, out) if as_json else None, summary.show, (out, report))
    return fit


def _board_views(images: Sequence[Path], board: Board, screen: Console) -> tuple[list[BoardView], list[str]]:
    """Views of the board, and the names of the pictures that do not show it; Ctrl-C keeps those until then."""
    views: list[BoardView] = []
    without: list[str] = []
    try:
        for _, name, image in pictures(images):
            _, is_video, number = name.partition("#")
            if is_video and int(number) % OF_A_VIDEO:
                continue
            detection = see_board(image, board)
            if detection is None:
                without.append(name)
                continue
            height, width = image.shape
            views.append(
                BoardView(name=name, width=width, height=height, pixels=detection[0], points=detection[1])
            )
    except KeyboardInterrupt:
        screen.print(f"stopped after {len(views) + len(without)} pictures; fitting to those", highlight=False)
    return views, without
