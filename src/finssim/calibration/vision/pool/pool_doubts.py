"""What a finished calibration of a pool says against itself: no water, a wrong unit, a frame that cannot be told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.vision.pool.observations import Observations
from finssim.calibration.vision.pool.pool_fit import PoolFit, calibrate_pool
from finssim.calibration.vision.pool.pool_held_out import rms
from finssim.calibration.vision.pool.pool_solver import clearances
from finssim.geometry.optics import Lens

__all__ = ["EXACT_LENS", "doubted"]

STRAIGHTER = 0.7
"""Held-out error of straight lines over that of refraction below which refraction is not believed."""

ENOUGH = 8
"""Held-out rows from which the two are compared."""

TOUCHING = 0.01
"""Distance of the camera from the plane, over that of the points from the camera, below which it lies on it."""

ODD, ABSURD = 3.0, 10.0
"""Residuals of a camera on the plane [px] above which it is doubted, and refused."""

TOO_DEEP = 1.5
"""Depth of the points below the plane as it was told, over the deepest that a camera above it could see so large."""

FLAT = 0.02
"""Thickness of the points, over their lesser width, below which their mirror image cannot be told from them."""

AGAINST = 0.002
"""Clearance of a point from the plane below which the plane ends against it [m]."""

MOST_ABOVE = 0.4
"""Share of the points that may be marks above the water."""

MET = 4.0, 3.0
"""Residual of straight lines that meets a mark: so many residuals of the rest, and so many pixels more."""

MOST_NAMES = 12
"""Marks that a sentence names."""

EXACT_LENS = (
    "the lens is taken as exact, because neither the camera file nor the options tell its errors: if its focal length "
    "or centre is off, the intervals of the camera's place are too narrow; a lens that was calibrated is usually known "
    "to 0.3 % and 4 px, --focal-sigma 0.003 --center-sigma 4"
)
"""A note, not an alarm: what the intervals of most camera files rest on."""


def doubted(fit: PoolFit, lens: Lens, *, lens_told: bool = True) -> PoolFit:
    """The calibration with what speaks against it put before its advice.

    Args:
        fit: The calibration.
        lens: That it began with.
        lens_told: Somebody said how sure the lens is.

    Raises:
        CalibrationError: It cannot be a camera before water; says which number to check.
    """
    _refuse_depth(fit)
    _refuse_touching(fit)
    found = [*_straight(fit), *_touching(fit), *_unmarked(fit, lens), *_handed(fit)]
    exact = [] if lens_told or "focal" in fit.lens_fitted else [EXACT_LENS]
    return replace(fit, advice=(*found, *fit.advice), notes=(*fit.notes, *exact))


def _refuse_depth(fit: PoolFit) -> None:
    """Refuse a plane told so far from the points that the camera, seen through it, would be between."""
    told, option = _told_depth(fit)
    camera = fit.pinhole.model
    apparent = abs(float(fit.model.interface.normal @ (camera.camera.position - camera.reference)))
    if told > TOO_DEEP * fit.model.interface.index_far * apparent:
        raise CalibrationError(
            f"{option} puts the plane {told:.3g} m from the points, but by the pixels the camera is only about "
            f"{apparent:.3g} m from them: check its unit (metres) and the survey's; nothing is written"
        )


def _told_depth(fit: PoolFit) -> tuple[float, str]:
    """Distance of the plane from the middle of the points under water as it was measured [m], and by which option."""
    settings, middle = fit.settings, fit.seen.points[~fit.seen.dry].mean(axis=0)
    if settings.water_height is not None:
        return abs(settings.water_height - float(middle[2])), f"--water-height {settings.water_height:g}"
    if settings.water_depth is not None:
        return abs(settings.water_depth), f"--water-depth {settings.water_depth:g}"
    if settings.plane is not None:
        normal = np.array(settings.plane[:3])
        return abs(float(normal @ middle) + settings.plane[3]) / float(np.linalg.norm(normal)), "--plane"
    return 0.0, ""


def _refuse_touching(fit: PoolFit) -> None:
    error = rms(fit.residual[fit.used])
    if _on_plane(fit) and error > ABSURD:
        raise CalibrationError(
            f"the camera ends on the plane itself, with residuals of {error:.0f} px: no camera before this plane sees "
            "the points so; check the unit and sign of the water's height, the window's thickness [m], the index, and "
            "whether there is water between at all; nothing is written"
        )


def _touching(fit: PoolFit) -> list[str]:
    error = rms(fit.residual[fit.used])
    if not _on_plane(fit) or error <= ODD:
        return []
    return [
        f"the camera ends on the plane itself, with residuals of {error:.1f} px: the plane's place, the window, the "
        "index or the camera file is wrong; do not use this pool file"
    ]


def _on_plane(fit: PoolFit) -> bool:
    model = fit.model
    return model.clearance < TOUCHING * (model.clearance + max(model.depth, 0.0))


def _straight(fit: PoolFit) -> list[str]:
    """Where straight lines foretell points better than refraction."""
    bent, straight = fit.held_out, fit.pinhole_held_out
    if bent is None or straight is None or len(bent.rows) < ENOUGH:
        return []
    errors = rms(bent.pixels), rms(straight.pixels)
    if not errors[1] < STRAIGHTER * errors[0]:
        return []
    return [
        f"straight lines meet held-out points better ({errors[1]:.2f} px) than refraction does ({errors[0]:.2f} px): "
        "there is probably no water between camera and points, or the index, the window or the place given for the "
        "plane is wrong; do not use this pool file under water"
    ]


def _unmarked(fit: PoolFit, lens: Lens) -> list[str]:
    """Marks above the water that nobody called dry, for which the plane was put over them, or the lens bent."""
    seen, rows = fit.seen, _highest(fit)
    if not rows.any():
        return []
    try:
        other = calibrate_pool(seen.subset(~rows), lens, fit.settings)
    except (CalibrationError, np.linalg.LinAlgError):
        return []
    marks = seen.subset(rows)
    above = clearances(other.model, marks.points) + other.model.interface.thickness < 0.0
    if not (above & _met(other, marks)).all():
        return []
    listed = ", ".join(marks.names[:MOST_NAMES]) + (", ..." if len(marks) > MOST_NAMES else "")
    return [
        f"without {listed}, the plane is found {other.model.clearance:.2f} m from the camera in place of "
        f"{fit.model.clearance:.2f} m, beyond them, and straight lines meet them: mark them dry (a column dry with "
        "yes); do not use this pool file"
    ]


def _highest(fit: PoolFit) -> NDArray[np.bool_]:
    """Points nearest to the plane, down to the widest gap between heights, (N,).

    None of them where nothing is odd: the plane ends against no point, and the lens gave up nothing.
    """
    seen, model = fit.seen, fit.model
    distance = np.where(seen.dry, np.inf, clearances(model, seen.points))
    bent = fit.settings.fit is None and bool(fit.lens_fitted)
    order = np.sort(distance[~seen.dry])
    most = int(MOST_ABOVE * len(order))
    if most < 1 or not (bent or float(distance[fit.used].min()) < AGAINST):
        return np.zeros(len(seen), bool)
    gap = int(np.argmax(np.diff(order[: most + 1])))
    return np.asarray(distance <= order[gap])


def _met(fit: PoolFit, marks: Observations) -> NDArray[np.bool_]:
    """Which marks the camera sees where straight lines say, (K,)."""
    off = marks.pixels - fit.model.predict(marks.points, np.ones(len(marks), bool))
    times, more = MET
    return np.asarray(np.linalg.norm(off, axis=1) < times * rms(fit.residual[fit.used]) + more)


def _handed(fit: PoolFit) -> list[str]:
    """A flat survey whose z points down, or is left-handed: the same pixels, unless the water's height is told."""
    settings = fit.settings
    if not fit.surface or fit.model.interface.normal[2] > 0.0:
        return []
    if settings.water_height is not None or settings.plane is not None:
        return []
    values = np.linalg.svd(fit.seen.points - fit.seen.points.mean(axis=0), compute_uv=False)
    if values[2] >= FLAT * values[1]:
        return []
    return [
        "flat points cannot tell whether the survey's z points down or its x and y are left-handed (seen from the "
        "camera, y to the right of x): it is taken for the first; if z points up, every height but theirs comes out "
        "mirrored: negate y in the survey, or give --water-height, which tells the two apart"
    ]
