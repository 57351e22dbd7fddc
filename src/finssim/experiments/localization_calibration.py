"""Calibrating a drawn campaign as its operator would: survey and detections of one half, a camera file, a tape."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from finssim.calibration.vision.pool.observations import Observations, observe
from finssim.calibration.vision.pool.pool_fit import PoolFit, calibrate_pool
from finssim.calibration.vision.pool.pool_record import pool_record
from finssim.calibration.vision.pool.pool_settings import Settings
from finssim.calibration.vision.pool.survey import read_survey
from finssim.experiments.localization_campaign import TAG, Campaign
from finssim.experiments.localization_pictures import Picture
from finssim.geometry.optics import Interface
from finssim.localization.detection.detections import Frame, write_detections
from finssim.localization.pool import Pool

__all__ = ["Calibrated", "calibrate", "survey_rows", "write_survey"]

Row = dict[str, float | int | str]


@dataclass(frozen=True)
class Calibrated:
    """What the operator has afterwards."""

    refractive: Pool
    pinhole: Pool
    """Straight lines fitted to the same half."""
    fit: PoolFit
    frames: list[Frame]
    """Detections of the half that calibrates."""
    survey: list[Row]
    """Where the tag was said to lie in each of them."""

    @property
    def pixel_std(self) -> float:
        """Standard deviation of a corner per axis, ripples included, as the residuals tell it [px]."""
        return self.refractive.pixel_std


def calibrate(campaign: Campaign, seen: Sequence[Picture]) -> Calibrated:
    """Calibrate on the visits chosen for it; the truth is not looked at.

    Args:
        campaign: What was surveyed and read.
        seen: Its pictures.
    """
    chosen = [p for p in seen if campaign.calibrates[p.visit] and p.detection is not None]
    frames = [Frame(np.nan, p.name, (p.detection,)) for p in chosen if p.detection is not None]
    rows = survey_rows(campaign, chosen)
    settings = Settings(
        interface="surface",
        water_height=campaign.water_read,
        water_height_sigma=max(campaign.conditions.tape, 5e-4),
        survey_sigma=max(campaign.conditions.survey, 1e-4),
        focal_sigma=campaign.conditions.lens / campaign.lens.fx,
        center_sigma=campaign.conditions.lens,
        seed=campaign.seed,
    )
    fit = calibrate_pool(_observed(frames, rows), campaign.lens, settings)
    level = Interface.water(campaign.water_read, n_air=1.0, n_water=1.0)
    straight = fit.pinhole.model.shifted(fit.seen.points.mean(axis=0))  # it was fitted about their middle
    return Calibrated(
        Pool(fit.model.camera, fit.model.interface, record=pool_record(fit, {})),
        Pool(straight.camera, level),
        fit,
        frames,
        rows,
    )


def survey_rows(campaign: Campaign, chosen: Sequence[Picture]) -> list[Row]:
    """The survey as a table: where the tag was said to lie in each picture."""
    (tag,) = TAG.mounts
    rows: list[Row] = []
    for picture in chosen:
        x, y, z = campaign.visits[picture.visit].nominal.tolist()
        rows.append(
            {
                "image": picture.name,
                "x": x,
                "y": y,
                "z": z,
                "yaw_deg": 0.0,
                "tag": tag,
                "edge": TAG.edge,
                "group": f"place {picture.visit}",  # all pictures of a visit share its survey error
            }
        )
    return rows


def write_survey(rows: Sequence[Row], path: Path) -> None:
    """Write the table as `finssim calibrate pool --surveyed` reads it."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _observed(frames: list[Frame], rows: list[Row]) -> Observations:
    """Through files, as a user's data come."""
    with TemporaryDirectory() as folder:
        detections, survey = Path(folder) / "detections.csv", Path(folder) / "survey.csv"
        write_detections(frames, detections)
        write_survey(rows, survey)
        return observe([detections], read_survey(survey))
