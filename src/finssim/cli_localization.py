"""`finssim localize`, `fuse`, `project`, `backproject`: from pictures and logs to where the vehicle was."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from finssim.cli_options import Json, PixelStd, Pool, Vehicle

__all__ = ["backproject", "fuse", "localize", "project"]


def localize(
    inputs: Annotated[
        list[Path],
        typer.Argument(help="Pictures, folders of them, videos, or detection files (.csv).", metavar="INPUT"),
    ],
    pool: Pool,
    vehicle: Vehicle,
    out: Annotated[Path, typer.Option(help="Table to write (.csv), one row a picture.", metavar="FILE")],
    depth: Annotated[
        str | None,
        typer.Option(
            help="Table with columns t, depth, or one depth of the pressure port below the surface [m].",
            metavar="FILE|Z",
        ),
    ] = None,
    imu: Annotated[
        Path | None,
        typer.Option(
            help="Table with columns t and roll, pitch [rad] or qx, qy, qz, qw; level if not given.",
            metavar="FILE",
        ),
    ] = None,
    method: Annotated[
        str,
        typer.Option(
            help="refractive, refractive-weighted, refractive-6dof, pinhole-depth or pinhole.",
            metavar="METHOD",
        ),
    ] = "refractive",
    family: Annotated[
        str | None,
        typer.Option(help="Family of the tags; that of the vehicle file if not given.", metavar="NAME"),
    ] = None,
    library: Annotated[str | None, typer.Option(help="Detector: apriltag or opencv.", metavar="NAME")] = None,
    refine: Annotated[
        str, typer.Option(help="How corners are placed: fit, or a way of the library.", metavar="WAY")
    ] = "fit",
    gamma: Annotated[float, typer.Option(help="Encoding of the pictures: 1 linear, 2.2 video.")] = 1.0,
    times: Annotated[
        Path | None,
        typer.Option(
            help="Table with columns image, time [s], where names of pictures hold none.", metavar="FILE"
        ),
    ] = None,
    pixel_std: PixelStd = None,
    shared_pixel_std: Annotated[
        float, typer.Option(help="Error that all corners of a picture share, per axis [px]: waves.")
    ] = 0.0,
    depth_std: Annotated[
        float | None, typer.Option(help="Error of the depth [m]; that of the vehicle file if not given.")
    ] = None,
    tilt_std_deg: Annotated[
        float | None,
        typer.Option(help="Error of roll and pitch [deg]; 0.5 with --imu, 2 without, if not given."),
    ] = None,
    longest_gap: Annotated[
        float, typer.Option(help="Depth and tilt are not interpolated over longer gaps [s].")
    ] = 1.0,
    truth: Annotated[
        Path | None,
        typer.Option(help="Table with columns image or t, x, y, to compare with.", metavar="FILE"),
    ] = None,
    as_json: Json = False,
) -> None:
    """Measure position and yaw in every picture: x, y, z [m], yaw [rad], pool frame, with standard deviations.

    Example: finssim localize video.mp4 --pool pool.yaml --vehicle finsrov --depth depth.csv --out poses.csv
    """
    from finssim.localization.locate.localize import run

    run(
        inputs,
        pool=pool,
        vehicle=vehicle,
        out=out,
        depth=depth,
        imu=imu,
        method=method,
        family=family,
        library=library,
        refine=refine,
        gamma=gamma,
        times=times,
        pixel_std=pixel_std,
        shared_pixel_std=shared_pixel_std,
        depth_std=depth_std,
        tilt_std_deg=tilt_std_deg,
        longest_gap=longest_gap,
        truth=truth,
        as_json=as_json,
    )


def fuse(
    log: Annotated[
        Path,
        typer.Argument(
            help="Folder of imu.csv, depth.csv and vision.csv or detections.csv, or one table.", metavar="LOG"
        ),
    ],
    pool: Pool,
    vehicle: Vehicle,
    out: Annotated[Path, typer.Option(help="Table to write (.csv).", metavar="FILE")],
    rate: Annotated[float, typer.Option(help="Rows a second [Hz].")] = 60.0,
    mode: Annotated[
        str,
        typer.Option(
            help="constant-velocity (paper, eq. 14-15) or error-state (uses IMU acceleration).",
            metavar="MODE",
        ),
    ] = "constant-velocity",
    profile: Annotated[
        str, typer.Option(help="Noise of the filter: default, or published as in the paper.", metavar="NAME")
    ] = "default",
    method: Annotated[
        str,
        typer.Option(
            help="How detections become fixes: refractive, refractive-weighted, refractive-6dof, "
            "pinhole-depth or pinhole.",
            metavar="METHOD",
        ),
    ] = "refractive",
    pixel_std: PixelStd = None,
    imu_axes: Annotated[
        str | None,
        typer.Option(
            help="Axes of the IMU's columns: body or sensor; told by their names if not given.",
            metavar="AXES",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Fuse vision, depth and IMU in the order of arrival: position [m], velocity [m/s], yaw [rad], health.

    Example: finssim fuse log --pool pool.yaml --vehicle finsrov --out fused.csv
    """
    from finssim.localization.fusion.fuse import run

    run(
        log,
        pool=pool,
        vehicle=vehicle,
        out=out,
        rate=rate,
        mode=mode,
        profile=profile,
        method=method,
        pixel_std=pixel_std,
        imu_axes=imu_axes,
        as_json=as_json,
    )


def project(
    points: Annotated[
        Path,
        typer.Argument(
            help="Table with columns x, y, z, pool frame [m]; - for standard input.", metavar="POINTS"
        ),
    ],
    pool: Pool,
    out: Annotated[
        Path | None, typer.Option(help="Table to write; standard output if not given.", metavar="FILE")
    ] = None,
    as_json: Json = False,
) -> None:
    """Pixels [px] at which points in the water appear.

    Example: finssim project points.csv --pool pool.yaml
    """
    from finssim.localization.locate.points import run_project

    run_project(points, pool=pool, out=out, as_json=as_json)


def backproject(
    pixels: Annotated[
        Path, typer.Argument(help="Table with columns u, v [px]; - for standard input.", metavar="PIXELS")
    ],
    pool: Pool,
    z: Annotated[
        float | None,
        typer.Option(help="Height of the points, pool frame [m]; a column z goes before it."),
    ] = None,
    plane: Annotated[
        str | None,
        typer.Option(help="Plane of the points in place of --z: a,b,c,d with a x + b y + c z + d = 0 [m]."),
    ] = None,
    pixel_std: Annotated[
        float | None,
        typer.Option(help="Error of a pixel [px]; adds columns with the error of the points [m]."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Table to write; standard output if not given.", metavar="FILE")
    ] = None,
    as_json: Json = False,
) -> None:
    """Points [m] in the water that pixels see, on a plane.

    Example: finssim backproject pixels.csv --pool pool.yaml --z 0
    """
    from finssim.localization.locate.points import run_backproject

    run_backproject(pixels, pool=pool, z=z, plane=plane, pixel_std=pixel_std, out=out, as_json=as_json)
