"""Survey file of `finssim calibrate pool`: surveyed points, priors of water, window and camera, and options."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from finssim.core.optics import Layer, OpticsError
from finssim.core.rotations import quat_from_euler, quat_rotate
from finssim.core.yaml_file import read_mapping
from finssim.localization import LocalizationError
from finssim.localization.camera_file import Fields
from finssim.localization.detection.families import corners, family_named
from finssim.survey.points import (
    METRES,
    Observations,
    Survey,
    SurveyedPoints,
    observe,
    observe_combined,
    read_survey,
)
from finssim.survey.pool_model import PoolFitSettings
from finssim.trials.findings import CalibrationError
from finssim.vehicles.part import VehicleError
from finssim.vehicles.tag_layout import TagLayout, read_tag_layout

PRINTED = 0.0005
"""Default standard error of a tag on a board [m]; printers and glue are not more accurate."""


@dataclass(frozen=True, kw_only=True)
class SurveyFile:
    """Content of a survey file."""

    path: Path
    settings: Mapping[str, Any]
    """Arguments of `PoolFitSettings` that the file specifies."""
    points: Path | None = None
    """Table of surveyed points or tags; None if there is a grid, or if the inputs contain the points."""
    grid: Mapping[int, SurveyedPoints] = field(default_factory=dict)
    """Tags of a board, by their ids."""
    unit: str | None = None
    """Unit of lengths in tables that state none; None: metres."""
    z: float | None = None
    """Height of points in tables without z [m]."""
    edge: float | None = None
    """Edge of tags in a table without that column [m]."""
    edges: Mapping[int, float] = field(default_factory=dict)
    """Edges of tags by id [m], with priority over `edge`."""
    family: str | None = None
    """Family of the tags in images."""
    latency: float = 0.0
    """Time stamp of an image minus the middle of its exposure [s]."""

    @property
    def sources(self) -> list[Path]:
        """Survey file and its table."""
        return [self.path] if self.points is None else [self.path, self.points]

    def fit_settings(self, **defaults: Any) -> PoolFitSettings:
        """Return the settings of the fit.

        Args:
            defaults: Default arguments of `PoolFitSettings`, which the file overrides.

        Raises:
            CalibrationError: The arguments contradict each other, or one is out of its range.
        """
        try:
            return PoolFitSettings(**{**defaults, **self.settings})
        except CalibrationError as error:
            raise CalibrationError(f"{self.path}: {error}") from None

    def observe(self, inputs: Sequence[Path]) -> Observations:
        """Match files of detections, pixels or images with the surveyed points.

        Args:
            inputs: Detections or pixels (.csv), or images; if the file has neither points nor a grid, tables of
                pixels with points.

        Raises:
            CalibrationError: A file cannot be read, or contains no surveyed point.
        """
        if self.grid:
            return observe(inputs, Survey(str(self.path), tags=dict(self.grid)), family=self.family)
        if self.points is None:
            return observe_combined(inputs, unit=self.unit, z=self.z)
        survey = read_survey(self.points, unit=self.unit, edge=self.edge, edges=self.edges, z=self.z)
        return observe(inputs, survey, family=self.family)


_SETTINGS = (
    ("", "sigma", "survey_sigma"),
    ("", "folds", "folds"),
    ("tags", "yaw_sigma_deg", "survey_yaw_sigma"),
    ("surface", "height", "water_height"),
    ("surface", "depth", "water_depth"),
    ("surface", "sigma", "place_sigma"),
    ("surface", "tilt_sigma_deg", "tilt_sigma"),
    ("window", "sigma", "place_sigma"),
    ("window", "tilt_sigma_deg", "tilt_sigma"),
    ("water", "index", "index"),
    ("water", "index_sigma", "index_sigma"),
    ("camera", "focal_sigma", "focal_sigma"),
    ("camera", "center_sigma_px", "center_sigma"),
    ("camera", "pixel_sigma_px", "pixel_sigma"),
)
"""Section, key and argument of `PoolFitSettings` for each number."""


def load_survey_file(path: str | Path) -> SurveyFile:
    """Read a survey file; lengths are in metres, keys with `_deg` in degrees and with `_px` in pixels.

    Raises:
        CalibrationError: The file is unreadable, a key is missing or unknown, or a value is out of its range.
    """
    path = Path(path)
    try:
        top = Fields(read_mapping(path, LocalizationError, such_as="surface: {height: 1.02}"), str(path))
        file = _survey_file(top, path)
    except LocalizationError as error:
        raise CalibrationError(str(error)) from None
    file.fit_settings()
    return file


def _survey_file(top: Fields, path: Path) -> SurveyFile:
    kind = _interface_kind(top, path)
    sections = {"": top, **{name: top.section(name) for name in ("tags", "water", "camera", kind)}}
    tags, settings = sections["tags"], _numbers(sections) | _interface(sections[kind], kind)
    _refuse_lone_sigma(sections[kind], kind, settings)
    names = top.get("fit")
    if names is not None:
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise top.error(
                f"fit is {names!r}, expected a list of names, such as [pose, height, tilt, index]"
            )
        settings["fit"] = tuple(names)
    points, unit, sizes = _word(top, "points"), _word(top, "unit"), _word(tags, "sizes")
    layout = TagLayout({}) if sizes is None else _layout(path.parent / sizes)
    family = _word(tags, "family") or layout.family or None
    if unit is not None and unit not in METRES:
        raise top.error(f"unknown unit '{unit}'; available: {', '.join(METRES)}")
    if family is not None:
        family_named(family)
    grid = _grid(top.section("grid")) if top.contains("grid") else {}
    if grid and points is not None:
        raise top.error("points and grid are given, expected one of them")
    file = SurveyFile(
        path=path,
        settings=settings,
        points=None if points is None else path.parent / points,
        grid=grid,
        unit=unit,
        z=_number(top, "z"),
        edge=_number(tags, "edge"),
        edges=layout.sizes,
        family=family,
        latency=sections["camera"].number("latency", 0.0),
    )
    for section in sections.values():
        section.finish()
    return file


def _interface_kind(top: Fields, path: Path) -> str:
    """Return `surface` or `window`, the one of the two that the file contains."""
    kinds = [kind for kind in ("surface", "window") if top.contains(kind)]
    if len(kinds) == 1:
        return kinds[0]
    count = "both surface and window are" if kinds else "neither surface nor window is"
    bundle = (
        f"; give this file as points: {path.name} of a survey file" if top.contains("tag_bundles") else ""
    )
    raise top.error(
        f"{count} given, expected one: the interface between camera and points (surface: {{}} is enough){bundle}"
    )


def _numbers(sections: Mapping[str, Fields]) -> dict[str, Any]:
    """Return the numbers that are arguments of `PoolFitSettings`, in SI."""
    options: dict[str, Any] = {}
    for section, key, setting in _SETTINGS:
        value = _number(sections[section], key) if section in sections else None
        if value is not None:
            options[setting] = math.radians(value) if key.endswith("_deg") else value
    if "folds" in options:
        if options["folds"] % 1.0:
            raise sections[""].error(f"folds is {options['folds']:g}, expected an integer")
        options["folds"] = int(options["folds"])
    return options


def _interface(fields: Fields, kind: str) -> dict[str, Any]:
    """Return the window and its plane, if the camera looks through a window."""
    if kind == "surface":
        return {}
    try:
        options: dict[str, Any] = {"window": Layer(fields.number("thickness"), fields.number("index"))}
    except OpticsError as error:
        raise fields.error(str(error)) from None
    if fields.get("plane") is not None:
        options["plane"] = fields.numbers("plane", 4)
    return options


def _refuse_lone_sigma(fields: Fields, kind: str, options: Mapping[str, Any]) -> None:
    """Refuse a standard deviation of a quantity that is not given."""
    places, sigmas, lack = ("water_height", "water_depth"), ("place_sigma",), "height or depth"
    if kind == "window":
        places, sigmas, lack = ("plane",), ("place_sigma", "tilt_sigma"), "plane"
    if options.keys() & {*sigmas} and not options.keys() & {*places}:
        raise fields.error(f"a standard deviation is given without {lack}: add the {lack}")


def _layout(path: Path) -> TagLayout:
    try:
        return read_tag_layout(path)
    except VehicleError as error:
        raise CalibrationError(str(error)) from None


def _number(fields: Fields, key: str) -> float | None:
    return None if fields.get(key) is None else fields.number(key)


def _word(fields: Fields, key: str) -> str | None:
    return None if fields.get(key) is None else fields.word(key)


def _grid(fields: Fields) -> dict[int, SurveyedPoints]:
    """Return the tags of a board, by their ids.

    Ids increase along the board's x, then from row to row; `spacing` is the distance of centres along the
    printed x and y (a negative second number counts rows downwards); `position` is the centre of the first
    tag; `yaw_deg`, `pitch_deg`, `roll_deg` rotate the board; `sigma` is the standard error of a tag within
    the board [m].
    """
    first, columns, rows = (int(fields.number(key)) for key in ("first", "columns", "rows"))
    dx, dy = fields.numbers("spacing", 2)
    edge, position = fields.number("edge"), fields.numbers("position", 3)
    angles = [fields.number(f"{name}_deg", 0.0) for name in ("roll", "pitch", "yaw")]
    sigma = fields.number("sigma", PRINTED)
    fields.finish()
    if columns < 1 or rows < 1 or edge <= 0.0 or min(abs(dx), abs(dy)) < edge:
        raise fields.error(
            f"{columns} x {rows} tags of {edge:g} m every {dx:g}, {dy:g} m: expected at least one tag, an edge above 0 "
            "and a spacing above the edge"
        )
    turn = quat_from_euler(*np.radians(angles))
    tags = {}
    for row in range(rows):
        for column in range(columns):
            flat = corners(edge) + np.array([column * dx, row * dy, 0.0])
            tag = first + row * columns + column
            tags[tag] = SurveyedPoints(f"tag {tag}", np.asarray(position) + quat_rotate(turn, flat), sigma)
    return tags
