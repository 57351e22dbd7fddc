"""`finssim experiment localization`: the paper's Table II, calibrated on half of the locations, measured at
the others."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from finssim.core.files import atomic_directory, refuse_unwritable
from finssim.core.optics import Camera, Interface, Lens, Status, project
from finssim.core.palette import COLORS
from finssim.core.provenance import provenance
from finssim.core.rotations import matrix_to_quat, quat_from_euler, quat_to_matrix
from finssim.core.text_table import write_csv
from finssim.core.yaml_file import yaml_text
from finssim.evaluation.campaign import Progress, check_choices, write_json
from finssim.evaluation.figures import clean, legend_below, new_figure, save_figure
from finssim.evaluation.metrics import PAPER
from finssim.evaluation.statistics import bootstrap
from finssim.evaluation.tables import Columns, Table, cells, figure_text
from finssim.localization.camera_file import write_camera
from finssim.localization.detection.detections import Detection, Frame, write_detections
from finssim.localization.detection.families import bitmap, corners, tag_corners_b
from finssim.localization.overhead_camera import Pool, write_pool
from finssim.localization.poses import Constraints
from finssim.localization.poses.methods import METHODS
from finssim.sim.overhead_camera import ObjectPose, OverheadCamera, Ripples, Scene, TagInScene, TiledBasin
from finssim.survey.points import Observations, observe, read_survey
from finssim.survey.pool import pool_record
from finssim.survey.pool_fit import PoolFit, calibrate_pool
from finssim.survey.pool_model import PoolFitSettings
from finssim.vehicles import Tags
from finssim.vehicles.equipment import TagMount

Array = NDArray[np.float64]

LOCATIONS = (17, 10)
"""Numbers of surveyed locations along and across the pool, 170 in all."""
IMAGES = 720
REACH = (1.84, 0.84)
"""Coordinates of the outermost locations from the middle of the 4 m x 2 m pool [m]."""
WATER_HEIGHT = 1.0
"""Height of the surface over the floor, where z = 0 [m]."""

TAG = Tags(family="tag25h9", edge=0.098, mounts={1: TagMount(position=np.zeros(3))})
"""Tag of the published test; its own frame is the body frame."""


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """Standard deviations of the errors."""

    depth: float = 0.01
    """Error of the depth reading, drawn once per visit [m]."""
    tilt: float = float(np.radians(0.5))
    """Error of the roll and pitch readings, drawn once per visit [rad]."""
    survey: float = 0.002
    """Error of a surveyed location along each axis [m]."""
    heading: float = float(np.radians(0.5))
    """Error of the tag's yaw [rad]."""
    lens: float = 0.5
    """Error of focal length and principal point in the camera file [px]."""
    tape: float = 0.003
    """Error of the measured water height [m]."""
    level: float = float(np.radians(0.1))
    """Tilt error of the survey's frame, about x and about y [rad]."""
    ripples: float = 0.01
    """RMS slope of the surface [-]."""


CONDITIONS: Mapping[str, Conditions] = {
    "published": Conditions(),
    "flat": Conditions(ripples=0.0),
    "quiet": Conditions(**dict.fromkeys(Conditions.__dataclass_fields__, 0.0)),
}
"""`published`: all errors; `flat`: all errors except ripples; `quiet`: only picture noise."""


@dataclass(frozen=True)
class Visit:
    """Tag at one surveyed location."""

    nominal: Array
    """Surveyed position, pool frame [m], (3,); the surveyed yaw is 0."""
    position: Array
    """True position [m], (3,)."""
    R_pb: Array
    """True attitude, (3, 3)."""
    depth_read: float
    """Depth of the tag measured by the pressure sensor [m]."""
    roll_read: float
    """Measured roll [rad]."""
    pitch_read: float
    """Measured pitch [rad]."""
    images: int
    """Number of pictures at the location."""


@dataclass(frozen=True)
class Campaign:
    """One random realization of the test."""

    seed: int
    conditions: Conditions
    truth: Pool
    """True camera and water."""
    lens: Lens
    """Lens of the camera file."""
    water_read: float
    """Measured height of the water [m]."""
    visits: tuple[Visit, ...]
    calibrates: NDArray[np.bool_]
    """Mask of visits used for calibration; the others are held out, (170,)."""


def published_pool(*, tilt_x: float = 0.0, tilt_y: float = 0.0) -> Pool:
    """Return the camera of the FinsROV pool, 1.17 m above 1 m of water; the floor is z = 0.

    Args:
        tilt_x: Tilt of the water surface's normal towards the pool's +x [rad].
        tilt_y: Tilt towards +y [rad].
    """
    lens = Lens(
        width=1280,
        height=720,
        fx=540.9305,
        fy=540.9305,
        cx=682.2341,
        cy=348.6136,
        distortion=(0.02944176, -0.05975546, 0.00088098, 0.00179148, 0.01256862),
    )
    orientation = np.array([0.99876852, -0.00261252, 0.00069494, -0.04953919])
    camera = Camera(
        lens, np.array([0.032897, -0.167178, 2.171935]), orientation / np.linalg.norm(orientation)
    )
    return Pool(camera, Interface.water(WATER_HEIGHT, tilt_x=tilt_x, tilt_y=tilt_y))


def draw_campaign(
    conditions: Conditions, seed: int, *, locations: tuple[int, int] = LOCATIONS, images: int = IMAGES
) -> Campaign:
    """Draw locations, readings and the split into two halves.

    Args:
        conditions: Standard deviations of the errors.
        seed: Seed of all random numbers.
        locations: Numbers of locations along and across the pool.
        images: Total number of pictures, spread evenly.
    """
    random = np.random.default_rng(seed)
    truth = published_pool(
        tilt_x=random.normal(0.0, conditions.level), tilt_y=random.normal(0.0, conditions.level)
    )
    focal, x, y = random.normal(0.0, conditions.lens, 3).tolist()
    true = truth.camera.lens
    lens = replace(true, fx=true.fx + focal, fy=true.fy + focal, cx=true.cx + x, cy=true.cy + y)
    places = np.array(list(product(*(np.linspace(-r, r, n) for r, n in zip(REACH, locations, strict=True)))))
    count = len(places)
    pictures = np.full(count, images // count)
    pictures[random.permutation(count)[: images - pictures.sum()]] += 1
    visits = tuple(
        _visit(position, n, conditions, truth, random) for position, n in zip(places, pictures, strict=True)
    )
    half = np.zeros(count, bool)
    half[random.permutation(count)[: count // 2]] = True
    water_read = WATER_HEIGHT + random.normal(0.0, conditions.tape)
    return Campaign(seed, conditions, truth, lens, water_read, visits, half)


def lifted(campaign: Campaign, height: float) -> Campaign:
    """Return the held-out visits with the tag raised in the water, with the same errors.

    Args:
        campaign: Original campaign.
        height: Height by which the tag is raised [m].
    """
    up = np.array([0.0, 0.0, height])
    visits = tuple(
        replace(
            visit,
            nominal=visit.nominal + up,
            position=visit.position + up,
            depth_read=visit.depth_read - height * float(campaign.truth.interface.normal[2]),
        )
        for visit, calibrates in zip(campaign.visits, campaign.calibrates, strict=True)
        if not calibrates
    )
    return replace(campaign, visits=visits, calibrates=np.zeros(len(visits), bool))


def _visit(
    spot: Array, images: int, conditions: Conditions, truth: Pool, random: np.random.Generator
) -> Visit:
    nominal = np.array([*spot, 0.0])
    position = nominal + random.normal(0.0, conditions.survey, 3)
    # The tag lies on an uneven floor; the readings of its tilt have an error of the same spread.
    roll, pitch = random.normal(0.0, conditions.tilt, 2)
    R_pb = quat_to_matrix(quat_from_euler(roll, pitch, random.normal(0.0, conditions.heading)))
    off = random.normal(0.0, [conditions.depth, conditions.tilt, conditions.tilt])
    readings = off + (-float(truth.interface.distance(position)), roll, pitch)
    return Visit(nominal, position, R_pb, *readings.tolist(), int(images))


(TAG_ID,) = TAG.mounts
MARGIN = 0.011
"""White margin around the tag [m]: its sheet is 0.12 m wide."""
SURROUND = 40
"""Width of the margin around the tag in the detector's region [px]."""
INTERVAL = 0.5
"""Interval between pictures, as in the published replay [s]."""
CORNER_NOISE = 0.2
"""Corner noise of `geometry` [px]."""
RENDERERS = ("own", "geometry")
"""Sources of detections: `own` renders pictures of the overhead camera, `geometry` projects exactly and adds noise."""


@dataclass(frozen=True)
class CampaignPicture:
    """One picture of a campaign."""

    visit: int
    name: str
    detection: Detection | None
    """Detection of the tag; None if the detector missed it."""


def pictures(campaign: Campaign, renderer: str = "own") -> Iterator[CampaignPicture]:
    """Yield all pictures of a campaign, visit by visit.

    Args:
        campaign: Campaign with the true positions.
        renderer: One of `RENDERERS`.

    Raises:
        ValueError: There is no such renderer.
    """
    check_choices([renderer], RENDERERS, "renderer", ValueError)
    render = _rendered(campaign, renderer)
    number = 0
    for k, visit in enumerate(campaign.visits):
        for _ in range(visit.images):
            seed = int(np.random.SeedSequence([campaign.seed, number]).generate_state(1)[0] % 2**31)
            yield CampaignPicture(k, f"{number:04d}.png", render(visit, INTERVAL * number, seed))
            number += 1


def scene_of(campaign: Campaign) -> Scene:
    """Return the scene of the overhead camera, without the tag."""
    slope = campaign.conditions.ripples
    return Scene(
        camera=campaign.truth.camera,
        interface=campaign.truth.interface,
        # The tag lies on the tiles; a floor a little lower keeps tilted tags above it.
        basin=TiledBasin(lower=(-2.0, -1.0, -0.02), upper=(2.0, 1.0, WATER_HEIGHT + 0.1)),
        ripples=Ripples(rms_slope=slope, seed=campaign.seed) if slope else None,
    )


def tag_of(visit: Visit) -> TagInScene:
    """Return the tag at its true pose."""
    x, y, z = visit.position.tolist()
    q = matrix_to_quat(visit.R_pb).tolist()
    return TagInScene(
        bitmap=bitmap(TAG.family, TAG_ID).astype(bool),
        edge=TAG.edge,
        pose=ObjectPose(position=(x, y, z), orientation=(q[0], q[1], q[2], q[3])),
        margin=MARGIN,
    )


def _rendered(campaign: Campaign, renderer: str) -> Callable[..., Detection | None]:
    """Return the function that renders a picture and detects the tag; for `geometry`, one that projects and
    adds white noise."""
    from finssim.localization.detection.detector import detector

    find, lens = detector(TAG.family), campaign.truth.camera.lens
    camera = OverheadCamera(scene_of(campaign))

    def look(visit: Visit, time: float, seed: int) -> Detection | None:
        points = visit.position + corners(TAG.edge) @ visit.R_pb.T
        exact = project(campaign.truth.camera, campaign.truth.interface, points)
        if renderer == "geometry":
            noise = np.random.default_rng(seed).normal(0.0, CORNER_NOISE, (4, 2))
            visible = not (exact.status != Status.OK).any()
            return Detection(TAG_ID, exact.pixels + noise, family=TAG.family) if visible else None
        low = np.maximum(np.floor(exact.pixels.min(0)) - SURROUND, 0)
        high = np.minimum(np.ceil(exact.pixels.max(0)) + SURROUND + 1, [lens.width, lens.height])
        region = (*low.astype(int).tolist(), *high.astype(int).tolist())
        picture = camera.render(tags=(tag_of(visit),), time=time, seed=seed, region=region)
        return next((d for d in find.detect(picture, region) if d.tag == TAG_ID), None)

    return look


Row = dict[str, float | int | str]


@dataclass(frozen=True)
class Calibrated:
    """Result of a calibration."""

    refractive: Pool
    pinhole: Pool
    """Straight-line calibration of the same half."""
    fit: PoolFit
    frames: list[Frame]
    """Detections in the calibration half."""
    survey: list[Row]
    """Surveyed location of the tag in each of them [m]."""


def calibrate(campaign: Campaign, observed: Sequence[CampaignPicture]) -> Calibrated:
    """Calibrate on the visits chosen for it, without use of the truth.

    Args:
        campaign: Campaign with survey and readings.
        observed: Its pictures.
    """
    chosen = [p for p in observed if campaign.calibrates[p.visit] and p.detection is not None]
    frames = [Frame(np.nan, p.name, (p.detection,)) for p in chosen if p.detection is not None]
    rows = survey_rows(campaign, chosen)
    settings = PoolFitSettings(
        water_height=campaign.water_read,
        place_sigma=max(campaign.conditions.tape, 5e-4),
        survey_sigma=max(campaign.conditions.survey, 1e-4),
        focal_sigma=campaign.conditions.lens / campaign.lens.fx,
        center_sigma=campaign.conditions.lens,
        seed=campaign.seed,
    )
    fit = calibrate_pool(_observed(frames, rows), campaign.lens, settings)
    level = Interface.water(campaign.water_read, n_air=1.0, n_water=1.0)
    straight = fit.pinhole.model
    return Calibrated(
        Pool(fit.model.camera, fit.model.interface, record=pool_record(fit, {})),
        Pool(straight.camera, level),
        fit,
        frames,
        rows,
    )


def survey_rows(campaign: Campaign, chosen: Sequence[CampaignPicture]) -> list[Row]:
    """Return the survey as a table: the surveyed location of the tag in each picture."""
    rows: list[Row] = []
    for picture in chosen:
        x, y, z = campaign.visits[picture.visit].nominal.tolist()
        # All pictures of a visit share its survey error.
        about = {"yaw_deg": 0.0, "tag": TAG_ID, "edge": TAG.edge, "group": f"place {picture.visit}"}
        rows.append({"image": picture.name, "x": x, "y": y, "z": z, **about})
    return rows


def write_survey(rows: Sequence[Row], path: Path) -> None:
    """Write the table of the surveyed tags. Positions are in [m]."""
    write_csv(path, list(rows[0]), [list(row.values()) for row in rows])


def _observed(frames: list[Frame], rows: list[Row]) -> Observations:
    """Return the observations after writing and reading files, as for a user's data."""
    with TemporaryDirectory() as folder:
        detections, survey = Path(folder) / "detections.csv", Path(folder) / "survey.csv"
        write_detections(frames, detections)
        write_survey(rows, survey)
        return observe([detections], read_survey(survey))


RESULT_FILE = "localization.json"

PAPER_TABLE_2: Mapping[str, Sequence[float]] = PAPER["localization"]
"""Method -> RMSE and 95th percentile in the paper [cm], of its camera over its pool, calibrated on the same
locations."""

METHOD_TITLES = {
    **{name: (name, "refractive") for name in ("refractive", "refractive-weighted", "refractive-6dof")},
    **{name: (name, "pinhole") for name in ("pinhole-depth", "pinhole")},
    "pinhole, refractive pose": ("pinhole", "refractive"),
}
"""Row of the table -> method and the calibration that it uses. The last row follows the paper: pinhole
localization with the camera pose of the refractive calibration."""

LIFT = 0.4
"""Height of the additional visits above the calibration locations [m]."""
Z_STD = 0.01
TILT_STD = float(np.radians(0.5))
TAGS_B = tag_corners_b(TAG)

NOTE = (
    "ours: a virtual pool of the published geometry, calibrated on half of the places, measured at the others. paper: "
    "its camera over its pool, calibrated and measured on the same places, with the depth known. These are different "
    "experiments and stand side by side for orientation."
)
TITLES = {
    "published": "every error",
    "flat": "no ripples",
    "quiet": "noise of the pictures alone",
    "lifted": "every error, and the tag higher than in the calibration",
    "refractive": "refractive",
    "refractive-weighted": "refractive, weighted",
    "refractive-6dof": "refractive, 6 DOF",
    "pinhole-depth": "pinhole with depth",
    "pinhole": "pinhole PnP",
    "pinhole, refractive pose": "pinhole PnP, as paper",
}
HEADS = ("", "RMSE [cm]", "P95 [cm]", "located")
CALIBRATION: Columns = {
    "seed": ("seed", ".0f"),
    "camera_height_mm": ("camera height [mm]", ".2f"),
    "water_height_mm": ("water [mm]", ".2f"),
    "camera_over_water_mm": ("camera over water [mm]", ".2f"),
    "tilt_deg": ("tilt [°]", ".3f"),
    "index": ("index", "+.4f"),
}
"""Errors of a calibration: key -> heading and format."""


@dataclass(frozen=True)
class Scores:
    """Result of one method at the held-out visits of one campaign."""

    visits: NDArray[np.intp]
    """Visits that were localized at least once, (n,)."""
    surveyed: Array
    """Mean estimate minus surveyed position, x and y [m], (n, 2)."""
    true: Array
    """Mean estimate minus true position [m], (n, 2)."""
    pictures: int
    located: int
    reasons: Mapping[str, int]
    """Reason for a missing position -> number of pictures."""

    @property
    def rmse(self) -> float:
        """RMS horizontal error relative to the surveyed positions [m]; NaN without any position."""
        return float(np.sqrt(np.mean(np.sum(self.surveyed**2, 1)))) if len(self.visits) else math.nan


def locate(
    campaign: Campaign, observed: Sequence[CampaignPicture], pool: Pool, method: str, *, pixel_std: float
) -> Scores:
    """Locate the tag in every picture of the held-out visits and average over each visit.

    Args:
        campaign: Campaign with the true positions.
        observed: Its pictures.
        pool: Calibrated pool.
        method: Key of `finssim.localization.poses.methods.METHODS`.
        pixel_std: Standard deviation of a corner, estimated by the calibration [px].
    """
    places: dict[int, list[tuple[float, float]]] = {}
    reasons, water = Counter[str](), pool.interface  # depth is measured along the water's normal, which is up
    held_out = [picture for picture in observed if not campaign.calibrates[picture.visit]]
    for picture in held_out:
        if picture.detection is None:
            reasons["tag not detected"] += 1
            continue
        visit = campaign.visits[picture.visit]
        prior = Constraints(
            z_b=-water.offset - visit.depth_read,
            z_std=Z_STD,
            roll=visit.roll_read,
            pitch=visit.pitch_read,
            tilt_std=TILT_STD,
            up=tuple(water.normal.tolist()),
        )
        measured = METHODS[method]((picture.detection,), pool, TAGS_B, prior, pixel_std)
        if measured.ok:
            places.setdefault(picture.visit, []).append((measured.x, measured.y))
        else:
            reasons[measured.reason.partition(":")[0]] += 1
    index = np.array(sorted(places), np.intp)
    means = np.array([np.mean(places[k], axis=0) for k in index]).reshape(-1, 2)
    surveyed = np.array([visit.nominal[:2] for visit in campaign.visits])[index]
    true = np.array([visit.position[:2] for visit in campaign.visits])[index]
    located = sum(map(len, places.values()))
    return Scores(index, means - surveyed, means - true, len(held_out), located, reasons)


def pooled(scores: Sequence[Scores]) -> dict[str, Any]:
    """Return RMSE and 95th percentile over all seeds, with intervals from a bootstrap of seeds, then of visits.

    Args:
        scores: Scores of each seed.

    Returns:
        Figures in centimetres, as in the paper's table; None without any position.
    """
    scored = [s for s in scores if len(s.visits)]
    errors = [np.linalg.norm(100.0 * s.surveyed, axis=1) for s in scored]
    true = [np.linalg.norm(100.0 * s.true, axis=1) for s in scored]

    def redraw(random: np.random.Generator) -> tuple[float, float]:
        chosen = random.integers(len(errors), size=len(errors))
        return _figures([random.choice(errors[k], len(errors[k])) for k in chosen])

    figures: Any = np.full((4, 2), None)
    if scored:
        figures = np.array([_figures(errors), *bootstrap(redraw), _figures(true)])
    (rmse, p95), low, high, (true_rmse, true_p95) = figures.tolist()
    return {
        "rmse_cm": rmse,
        "rmse_ci95_cm": [low[0], high[0]],
        "p95_cm": p95,
        "p95_ci95_cm": [low[1], high[1]],
        "rmse_to_truth_cm": true_rmse,
        "p95_to_truth_cm": true_p95,
        "visits": sum(len(e) for e in errors),
        "pictures": sum(s.pictures for s in scores),
        "located": sum(s.located for s in scores),
        "reasons": dict(sum((Counter(s.reasons) for s in scores), Counter())),
    }


def _figures(errors: Sequence[Array]) -> tuple[float, float]:
    x = np.concatenate(errors)
    return float(np.sqrt(np.mean(x**2))), float(np.percentile(x, 95))


def _draw_error_map(campaign: Campaign, pinhole: Scores, refractive: Scores, path: Path) -> None:
    """Draw arrows from every held-out location to the estimates of each method, scaled as stated in the titles."""
    places = np.array([visit.nominal[:2] for visit in campaign.visits])
    figure = new_figure(12.0, 4.2)
    panels = (("pinhole PnP", pinhole, 3.0, COLORS[1]), ("refractive", refractive, 10.0, COLORS[0]))
    for axes, (title, scores, scale, color) in zip(figure.subplots(1, 2, sharey=True), panels, strict=True):
        clean(axes)
        axes.plot(*places[campaign.calibrates].T, "+", color="0.7", markersize=5, label="calibrated here")
        at, arrows = places[scores.visits], scale * scores.surveyed
        axes.plot(*at.T, ".", color="0.1", markersize=3, label="held out")
        axes.quiver(*at.T, *arrows.T, angles="xy", scale_units="xy", scale=1.0, width=0.003, color=color)
        axes.set_title(f"{title}: RMSE {100.0 * scores.rmse:.2f} cm, arrows {scale:.0f} times as long")
        axes.set(aspect="equal", xlabel="x [m]", xlim=(-REACH[0] - 0.3, REACH[0] + 0.3))
    figure.axes[0].set_ylabel("y [m]")
    legend_below(figure, figure.axes[0], 2)
    save_figure(figure, path)


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """Return the tables: ours by conditions, the paper's, and the errors of the calibrations."""
    title, origin = "Horizontal localization through water", result["provenance"]
    headline = (
        f"{len(result['seeds'])} seeds, each {result['pictures_per_seed']} pictures at {result['places']} places, "
        f"renderer {result['renderer']}"
    )
    tables = [Table(title=title, headline=headline, note=_gain(result))]
    for name, methods in result["results"].items():
        rows = [
            [
                TITLES[method],
                *(
                    figure_text({"value": m[f"{x}_cm"], "ci95": m[f"{x}_ci95_cm"]}, ".2f")
                    for x in ("rmse", "p95")
                ),
                f"{m['located']}/{m['pictures']}",
            ]
            for method, m in methods.items()
        ]
        tables.append(
            Table(title=f"ours, {name} conditions: {TITLES[name]}", heads=HEADS, rows=rows, intervals=True)
        )
    rows = [
        [f"paper, {TITLES[m]}", f"{p['rmse_cm']:.2f}", f"{p['p95_cm']:.2f}", ""]
        for m, p in result["paper"].items()
    ]
    paper, shown = (
        "the paper: its camera over its pool",
        {"error_map.png": "Errors at the places held out [m]"},
    )
    return [
        *tables,
        Table(
            title=paper,
            heads=HEADS,
            rows=rows,
            note=NOTE,
            pictures=shown,
        ),
        Table(
            title="errors of the calibrations",
            heads=[heading for heading, *_ in CALIBRATION.values()],
            rows=[cells(c, CALIBRATION) for c in result["calibration"]],
            left=(),
            note=f"FinsSim {origin['finssim']}, revision {origin['revision']}, seeds {result['seeds']}.",
        ),
    ]


def _gain(result: Mapping[str, Any]) -> str:
    rivals = {
        "pinhole": "pinhole PnP calibrated on the same half",
        "pinhole, refractive pose": "pinhole PnP with the camera pose of the refractive calibration, as the paper's",
    }
    sentences = []
    for rival, rival_text in rivals.items():
        m = result["results"]["published"]
        if not (m["refractive"]["located"] and m[rival]["located"]):
            continue
        less = [100.0 * (1.0 - m["refractive"][key] / m[rival][key]) for key in ("rmse_cm", "p95_cm")]
        sentences.append(f"Refractive below {rival_text}: RMSE {less[0]:.1f} %, P95 {less[1]:.1f} %.")
    return " ".join(sentences)


@dataclass(frozen=True)
class LocalizationSeed:
    """One realization of the test under one set of conditions."""

    campaign: Campaign
    calibration: Calibrated
    scores: Mapping[str, Scores]
    """Scores by method."""


def localization_experiment(
    *,
    out: Path,
    renderer: str = "own",
    seeds: Annotated[int, (1, 1000)] = 3,
    seed: int = 1,
    progress: Progress = lambda part, text: None,
    **size: Any,
) -> dict[str, Any]:
    """Locate a tag at locations held out from the calibration, by refractive and pinhole methods: RMSE, P95 [cm].

    Every seed draws new survey errors, readings, camera file, frame tilt, ripples and noise.

    Example: finssim experiment localization --seeds 3 --out localization

    Args:
        out (DIR): Directory for JSON, Markdown and figures.
        renderer (NAME): own, or geometry (exact corners with noise instead of images).
        seeds: Number of repetitions with different errors.
        seed: Seed of every random number; equal seeds give equal results.
        progress: Function that receives the completed fraction and the next step.
        size: Arguments of `draw_campaign`: locations (along and across the pool) and images; by default as
            published.

    Returns:
        Content of `localization.json`.

    Raises:
        ValueError: The number of seeds is below 1, or the renderer is unknown.
    """
    if seeds < 1:
        raise ValueError(f"seeds is {seeds}, expected at least 1")
    check_choices([renderer], RENDERERS, "renderer", ValueError)
    refuse_unwritable(atomic_directory(out, replaces=RESULT_FILE))
    drawn: dict[str, list[LocalizationSeed]] = {name: [] for name in CONDITIONS}
    higher: list[Mapping[str, Scores]] = []
    runs = drawn["published"]
    for k in range(seeds):
        for j, name in enumerate(CONDITIONS):
            progress((k + j / len(CONDITIONS)) / seeds, f"seed {seed + k}, {name} conditions")
            drawn[name].append(_play_seed(name, seed + k, renderer, size))
        progress((k + 0.8) / seeds, f"seed {seed + k}, another depth")
        campaign = lifted(runs[k].campaign, LIFT)  # the same calibration, with the tag at another depth
        higher.append(_scored(campaign, list(pictures(campaign, renderer)), runs[k].calibration))
    scores = {
        **{name: [seed_result.scores for seed_result in each] for name, each in drawn.items()},
        "lifted": higher,
    }
    visits = runs[0].campaign.visits
    result = {
        "experiment": "localization",
        "renderer": renderer,
        "seeds": [seed_result.campaign.seed for seed_result in runs],
        "places": len(visits),
        "pictures_per_seed": sum(visit.images for visit in visits),
        "conditions": {name: vars(CONDITIONS[name]) for name in CONDITIONS},
        "results": {
            name: {method: pooled([seed_result[method] for seed_result in each]) for method in METHOD_TITLES}
            for name, each in scores.items()
        },
        "lift_m": LIFT,
        "pixel_std_px": [seed_result.calibration.refractive.pixel_std for seed_result in runs],
        "calibration": [_errors(seed_result) for seed_result in runs],
        "paper": {m: {"rmse_cm": r, "p95_cm": p} for m, (r, p) in PAPER_TABLE_2.items()},
        "provenance": provenance(),
    }
    _write(result, out, runs[0])
    return result


def _write(result: Mapping[str, Any], out: Path, first: LocalizationSeed) -> None:
    """Write the directory: result, page, figures, and the files with which a user can repeat the first seed
    manually."""
    with atomic_directory(out, replaces=RESULT_FILE) as folder:
        scores, calibration = first.scores, first.calibration
        _draw_error_map(first.campaign, scores["pinhole"], scores["refractive"], folder / "error_map.png")
        write_camera(folder / "camera.yaml", first.campaign.lens, {})
        write_pool(calibration.refractive, folder / "pool.yaml")
        write_pool(calibration.pinhole, folder / "pool_pinhole.yaml")
        write_detections(calibration.frames, folder / "detections.csv")
        write_survey(calibration.survey, folder / "survey.csv")
        settings = calibration.fit.settings
        survey = {
            "points": "survey.csv",
            "sigma": settings.survey_sigma,
            "surface": {"height": settings.water_height, "sigma": settings.place_sigma},
            "camera": {"focal_sigma": settings.focal_sigma, "center_sigma_px": settings.center_sigma},
        }
        (folder / "survey.yaml").write_text(yaml_text(survey), encoding="utf-8")
        write_json(folder / RESULT_FILE, result, tables_of(result))


def _play_seed(name: str, seed: int, renderer: str, size: Mapping[str, Any]) -> LocalizationSeed:
    campaign = draw_campaign(CONDITIONS[name], seed, **size)
    observed = list(pictures(campaign, renderer))
    calibration = calibrate(campaign, observed)
    return LocalizationSeed(campaign, calibration, _scored(campaign, observed, calibration))


def _scored(
    campaign: Campaign, observed: Sequence[CampaignPicture], calibration: Calibrated
) -> dict[str, Scores]:
    pools = {"refractive": calibration.refractive, "pinhole": calibration.pinhole}
    return {
        row: locate(campaign, observed, pools[kind], method, pixel_std=calibration.refractive.pixel_std)
        for row, (method, kind) in METHOD_TITLES.items()
    }


def _errors(seed_result: LocalizationSeed) -> dict[str, Any]:
    """Return the calibration errors of one seed, relative to its truth."""
    true, fit = seed_result.campaign.truth, seed_result.calibration.refractive
    (x, y, height), (x_fit, y_fit, height_fit) = true.camera.position, fit.camera.position
    over = height - true.interface.height(x, y)
    over_fit = height_fit - fit.interface.height(x_fit, y_fit)
    lean = float(np.clip(true.interface.normal @ fit.interface.normal, -1.0, 1.0))
    return {
        "seed": seed_result.campaign.seed,
        "camera_height_mm": 1000.0 * float(height_fit - height),
        "water_height_mm": 1000.0 * float(fit.interface.height(x, y) - true.interface.height(x, y)),
        "camera_over_water_mm": 1000.0 * float(over_fit - over),
        "tilt_deg": float(np.degrees(np.arccos(lean))),
        "index": float(fit.interface.index_far - true.interface.index_far),
    }
