"""What the camera of a virtual pool saw at one moment of a trial, with the tags that are found in it."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from finssim.experiments.transfer.job import Job
from finssim.experiments.transfer.series import read_series
from finssim.localization.detection.detector import detector
from finssim.pool.camera import PoolCamera
from finssim.pool.exposures import Exposure
from finssim.pool.site import camera_of
from finssim.vehicles import load_vehicle

__all__ = ["camera_view"]

ZOOM = 110
"""Half the width of the part that is shown larger [px]."""


def camera_view(job: Job, series: Path, at: float, seed: int) -> bytes:
    """The picture drawn anew from the pose that the vehicle truly had, by the same camera through the same water.

    Args:
        job: The trial.
        series: As `run_jobs` left it, without its suffix.
        at: Time since its start [s].
        seed: Of ripples and noise.

    Returns:
        PNG: the whole picture, and the vehicle in it with the outlines of the tags that were found.
    """
    standing = load_vehicle(job.pool_vehicle)
    site, _, settings = camera_of(standing, job.plant, job.severity)  # type: ignore[arg-type]
    camera = PoolCamera(standing, site, mode="pictures", settings=settings, seed=seed)
    motion = read_series(series)
    k = int(np.argmin(np.abs(motion["t"] - at)))
    pose = motion["position"][k], motion["quaternion"][k]
    picture = camera.develop(Exposure(0, at, at + settings.latency, pose, pose))
    assert picture.image is not None and standing.tags is not None
    found = [d for d in detector(standing.tags.family).detect(picture.image) if d.tag in standing.tags.mounts]
    return _drawn(picture.image, found)


def _drawn(image: Any, found: list[Any]) -> bytes:
    figure = Figure(figsize=(9.0, 3.4), layout="compressed")
    FigureCanvasAgg(figure)
    whole, close = figure.subplots(1, 2, width_ratios=(16, 9))
    corners = [np.asarray(d.corners, float) for d in found]
    for axes in (whole, close):
        axes.imshow(image, cmap="gray", vmin=0, vmax=255)
        axes.set_axis_off()
        for tag in corners:
            axes.plot(*np.vstack([tag, tag[:1]]).T, color="#D55E00", linewidth=1.4)
    whole.set_title("the overhead camera's picture", fontsize=9)
    close.set_title(f"tags found: {', '.join(str(d.tag) for d in found) or 'none'}", fontsize=9)
    if corners:
        x, y = np.concatenate(corners).mean(axis=0)
        close.set_xlim(x - ZOOM, x + ZOOM)
        close.set_ylim(y + ZOOM, y - ZOOM)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    return buffer.getvalue()
