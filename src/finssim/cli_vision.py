"""`finssim calibrate camera`, `pool` and `mounts`, and `finssim experiment localization`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from finssim.cli_options import Json, Pool, Seed, Vehicle

__all__ = ["camera", "experiment_localization", "mounts", "pool"]

Report = Annotated[
    Path | None, typer.Option(help="Directory for the report and its pictures.", metavar="DIR")
]


def camera(
    images: Annotated[
        list[Path], typer.Argument(help="Pictures of a board, folders of them, or videos.", metavar="IMAGE")
    ],
    out: Annotated[Path, typer.Option(help="Camera file to write (.yaml).", metavar="FILE")],
    board: Annotated[
        str | None,
        typer.Option(
            help="Inner corners of a chessboard, such as 9x6; common ones are tried if not given.",
            metavar="NxM",
        ),
    ] = None,
    square: Annotated[float, typer.Option(help="Edge of a square [m].")] = 0.025,
    charuco: Annotated[
        str | None,
        typer.Option(help="Squares of a ChArUco board in place of a chessboard, such as 7x5.", metavar="NxM"),
    ] = None,
    marker: Annotated[
        float | None,
        typer.Option(help="Edge of its markers [m]; three quarters of a square if not given."),
    ] = None,
    dictionary: Annotated[
        str, typer.Option(help="Dictionary of its markers, as OpenCV calls it.", metavar="NAME")
    ] = "DICT_5X5_100",
    model: Annotated[
        str, typer.Option(help="Lens: plumb_bob, rational or fisheye.", metavar="MODEL")
    ] = "plumb_bob",
    report: Report = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Fit a lens to pictures of a board: focal length and centre [px], distortion, with 95 % intervals.

    Example: finssim calibrate camera board/*.jpg --board 9x6 --square 0.025 --out camera.yaml
    """
    from finssim.calibration.vision.camera_command import run

    run(
        images,
        out=out,
        board=board,
        square=square,
        charuco=charuco,
        marker=marker,
        dictionary=dictionary,
        model=model,
        report=report,
        seed=seed,
        as_json=as_json,
    )


def pool(
    inputs: Annotated[
        list[Path],
        typer.Argument(
            help="Detections (.csv), pixels (id,u,v), pixels with points (u,v,x,y,z), or pictures of tags.",
            metavar="INPUT",
        ),
    ],
    camera: Annotated[
        Path, typer.Option(help="Camera file: ours, or one of OpenCV, ROS or Kalibr.", metavar="FILE")
    ],
    out: Annotated[Path, typer.Option(help="Pool file to write (.yaml).", metavar="FILE")],
    surveyed: Annotated[
        Path | None,
        typer.Option(
            help="Survey (.csv): id,x,y,z of points, or tag,x,y,z,yaw_deg,edge of tags, or image,x,y,z,yaw_deg,edge "
            "of one tag that was moved; not needed where the inputs hold the points.",
            metavar="FILE",
        ),
    ] = None,
    report: Report = None,
    interface: Annotated[
        str,
        typer.Option(help="What the camera looks through: surface, wall, or auto to try.", metavar="KIND"),
    ] = "auto",
    plane: Annotated[
        str | None,
        typer.Option(
            help="The surveyed plane itself, n_x,n_y,n_z,b with n . X + b = 0 [m].", metavar="PLANE"
        ),
    ] = None,
    window: Annotated[
        list[str] | None,
        typer.Option(
            help="Solid layer THICKNESS:INDEX, such as 0.010:1.52 for 10 mm of glass; several from the camera on.",
            metavar="LAYER",
        ),
    ] = None,
    water_height: Annotated[
        float | None, typer.Option(help="z of the surface in the survey's frame, by a tape [m].")
    ] = None,
    water_depth: Annotated[
        float | None, typer.Option(help="In place of it: from the surveyed points to the surface [m].")
    ] = None,
    water_height_sigma: Annotated[
        float | None, typer.Option(help="Error of either, or of the plane's place [m]; 0.005 if not given.")
    ] = None,
    index: Annotated[float, typer.Option(help="Refractive index of the water.")] = 1.333,
    index_sigma: Annotated[
        float | None,
        typer.Option(help="Error of that; 0.003 if neither is given, 0 (held) if only --index is."),
    ] = None,
    tilt_sigma: Annotated[
        float | None,
        typer.Option(
            help="How far the plane may lean [deg]; 0.2 for a surface, 0.5 for --plane, free for a wall."
        ),
    ] = None,
    fit: Annotated[
        str | None,
        typer.Option(
            help="What is fitted, of pose,height,tilt,index,focal,center,distortion; chosen if not given.",
            metavar="NAMES",
        ),
    ] = None,
    focal_sigma: Annotated[
        float | None,
        typer.Option(
            help="Relative error of the camera file's focal length; what the file says if not given."
        ),
    ] = None,
    center_sigma: Annotated[
        float | None,
        typer.Option(help="Error of its optical centre [px]; what the file says if not given."),
    ] = None,
    pixel_sigma: Annotated[
        float | None, typer.Option(help="Error of a pixel [px]; from the residuals if not given.")
    ] = None,
    survey_sigma: Annotated[float, typer.Option(help="Error of a surveyed coordinate [m].")] = 0.002,
    survey_yaw_sigma: Annotated[float, typer.Option(help="Error of a tag's direction [deg].")] = 0.5,
    unit: Annotated[
        str | None,
        typer.Option(help="Of lengths in tables that do not say: m, cm, mm, in, ft.", metavar="UNIT"),
    ] = None,
    z: Annotated[
        float | None, typer.Option(help="Height of points whose table has no such column [m].")
    ] = None,
    edge: Annotated[float | None, typer.Option(help="Of tags whose survey has no such column [m].")] = None,
    family: Annotated[str | None, typer.Option(help="Of tags in pictures.", metavar="NAME")] = None,
    latency: Annotated[
        float, typer.Option(help="Time stamps of pictures minus their exposure [s], kept in the file.")
    ] = 0.0,
    folds: Annotated[int, typer.Option(help="Parts that are held out in turn.", min=2)] = 5,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Find camera pose [m, deg] and water plane (height [m], tilt [deg], index) from surveyed points in the water.

    Example: finssim calibrate pool points.csv --surveyed survey.csv --camera camera.yaml --out pool.yaml
    """
    from finssim.calibration.vision.pool_command import run

    run(
        inputs,
        camera=camera,
        out=out,
        surveyed=surveyed,
        report=report,
        interface=interface,
        plane=plane,
        window=window or (),
        water_height=water_height,
        water_depth=water_depth,
        water_height_sigma=water_height_sigma,
        index=index,
        index_sigma=index_sigma,
        tilt_sigma=tilt_sigma,
        fit=fit,
        focal_sigma=focal_sigma,
        center_sigma=center_sigma,
        pixel_sigma=pixel_sigma,
        survey_sigma=survey_sigma,
        survey_yaw_sigma=survey_yaw_sigma,
        unit=unit,
        z=z,
        edge=edge,
        family=family,
        latency=latency,
        folds=folds,
        seed=seed,
        as_json=as_json,
    )


def mounts(
    log: Annotated[
        Path, typer.Argument(help="Folder with detections.csv, imu.csv and depth.csv.", metavar="LOG")
    ],
    pool: Pool,
    vehicle: Vehicle,
    out: Annotated[Path, typer.Option(help="Vehicle file to write (.yaml).", metavar="FILE")],
    estimate: Annotated[
        str,
        typer.Option(
            help="tags: the sensors are right in the vehicle file; sensors: the tag seen most is.",
            metavar="WHAT",
        ),
    ] = "tags",
    turns_about: Annotated[
        str | None,
        typer.Option(
            help="Body point that stays in place while the vehicle turns on the spot: x,y,z [m].",
            metavar="X,Y,Z",
        ),
    ] = None,
    report: Report = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Find where tags, IMU and pressure port sit on the vehicle, from its motion: poses [m, deg], depth offset [m].

    Example: finssim calibrate mounts log --pool pool.yaml --vehicle mine.yaml --out mine.yaml
    """
    from finssim.calibration.vision.mounts_command import run

    run(
        log,
        pool=pool,
        vehicle=vehicle,
        out=out,
        estimate=estimate,
        turns_about=None if turns_about is None else _three(turns_about),
        report=report,
        seed=seed,
        as_json=as_json,
    )


def _three(text: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(word) for word in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
        raise typer.BadParameter(f"--turns-about is '{text}', expected three lengths such as 0,0,-0.08")
    return numbers


def experiment_localization(
    out: Annotated[Path, typer.Option(help="Directory for JSON, Markdown and figures.", metavar="DIR")],
    renderer: Annotated[
        str,
        typer.Option(
            help="own, mitsuba (slow), or geometry (no pictures: exact corners with noise).", metavar="NAME"
        ),
    ] = "own",
    seeds: Annotated[int, typer.Option(help="Repetitions with other errors.", min=1, max=1000)] = 3,
    seed: Seed = 1,
    as_json: Json = False,
) -> None:
    """Locate a tag at places that the calibration has not seen, by refractive and pinhole methods: RMSE, P95 [cm].

    Example: finssim experiment localization --seeds 3 --out localization
    """
    from finssim.experiments.campaign import run_experiment
    from finssim.experiments.localization_experiment import localization_experiment, print_table

    run_experiment(
        "experiment localization", localization_experiment, print_table, out=out, renderer=renderer, seeds=seeds,
        seed=seed, as_json=as_json,
    )  # fmt: skip
