"""`finssim worlds`: the sites of the catalogue, the numbers of one of them, and simulated camera and sonar
pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from finssim.core.files import atomic_write
from finssim.core.sonar_fan import fan_picture
from finssim.evaluation.figures import DPI, new_figure
from finssim.evaluation.tables import Table
from finssim.extensions.perception.description import World, WorldError, load_world, sites
from finssim.vehicles.device_files import CameraDevice, SonarDevice, devices, load_device

WIDTH = 800
"""Width of the camera's part of a picture [px]; each pixel is the mean of 2 x 2 rays."""
SETTLING = 10
"""Number of small pictures until automatic exposure has settled."""
LAMPS = ((0.15, 0.30, -0.05), (0.15, -0.30, -0.05))
"""Positions of a vehicle's two lights, body axes [m]."""


def worlds_list() -> dict[str, Any]:
    """List the sites and sensors in the catalogue; `show SITE` describes and renders one.

    Example: finssim worlds
    """
    return {
        "sites": {name: load_world(name).about for name in sites()},
        "sensors": {name: load_device(name).about for name in devices()},
    }


def worlds_show(
    site: str,
    *,
    camera: str = "low_light_camera",
    sonar: str = "gemini_720is",
    sonar_range: Annotated[float, (0.5, 200.0)] | None = None,
    lamps: bool = False,
    seed: int | None = None,
    out: Path | None = None,
) -> dict[str, Any]:
    """Describe a site, and render the view of a camera and a sonar from its viewpoint.

    Example: finssim worlds show dock --lamps --out dock.png

    Args:
        site (SITE|FILE): Site in the catalogue, or path of a world file.
        camera (NAME|FILE): Camera in the catalogue, or path of its file.
        sonar (NAME|FILE): Imaging sonar in the catalogue, or path of its file.
        sonar_range: Longest range of its image, instead of that in its file [m].
        lamps: Two lights on the vehicle, next to the camera.
        seed: Seed for drawing objects and water; by default as in the file.
        out (FILE): Image to write: the camera's view and the sonar's fan (.png).
    """
    world = load_world(site)
    eye, ear = load_device(camera), load_device(sonar)
    if not isinstance(eye, CameraDevice) or not isinstance(ear, SonarDevice):
        raise WorldError(f"expected a camera and an imaging sonar, got {camera} and {sonar}: exchange them")
    if sonar_range is not None:
        ear = ear.model_copy(update={"range": sonar_range})
    if out is not None:
        if out.suffix != ".png":
            raise WorldError(f"{out} ends in '{out.suffix}', expected .png")
        with atomic_write(out) as temporary:
            _draw(world, eye, ear, lamps, seed, temporary)
    water = world.water
    return {
        "name": world.name,
        "about": world.about,
        "attenuation": water.attenuation.tolist(),
        "visibility_m": [round(-math.log(0.02) / c, 2) if c > 0.0 else None for c in water.attenuation],
        "sound_speed": water.sound_speed,
        "sound_absorption_db_per_m": water.sound_absorption(ear.frequency),
        "sonar_frequency": ear.frequency,
        "objects": {
            name: {
                "shape": item.shape,
                "count": len(item.positions),
                "frame": item.frame,
                "position": item.position.tolist(),
                "varies": item.vary is not None,
            }
            for name, item in world.objects.items()
        },
        "viewpoint": world.viewpoint.values(),
    }


def _draw(
    world: World, eye: CameraDevice, ear: SonarDevice, lamps: bool, seed: int | None, path: Path
) -> None:
    import warp as wp

    from finssim.extensions.perception import CameraBatch, Headlight, SonarBatch, WorldBatch

    batch = WorldBatch(world)
    if seed is not None:
        batch.draw(seed)
    pose = wp.array(np.float32(world.viewpoint.pose[None]), dtype=wp.transform)
    lights = (
        tuple(Headlight(position=position, intensity=0.15, half_angle=0.6) for position in LAMPS)
        if lamps
        else ()
    )
    small = CameraBatch(batch, eye, width=WIDTH // 5, lamps=lights)
    for k in range(SETTLING):
        small.update(pose, seed=0, time=float(k))
    camera = CameraBatch(batch, eye, width=2 * WIDTH, lamps=lights)
    camera.gain.assign(small.gain)
    fine = camera.update(pose, seed=0, time=float(SETTLING)).numpy()[0].astype(float)
    rows, columns = fine.shape[0] // 2, fine.shape[1] // 2
    picture = fine[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2, 3).mean(axis=(1, 3)) / 255.0
    levels = SonarBatch(batch, ear).update(pose, seed=0).numpy()[0]
    fan = fan_picture(levels, ear.sector)
    ratio = fan.shape[1] / fan.shape[0]
    height = 5.2
    figure = new_figure(height * (columns / rows + ratio), height)
    figure.patch.set_facecolor("black")
    left, right = figure.subplots(1, 2, width_ratios=[columns / rows, ratio])
    left.imshow(picture, interpolation="none")
    left.axis("off")
    right.set_facecolor("black")
    half = 0.5 * ratio * ear.range
    right.imshow(fan, cmap="copper", vmin=0, vmax=255, extent=(-half, half, 0.0, ear.range))
    turn = np.linspace(-0.5 * ear.sector, 0.5 * ear.sector, 181)
    for r in np.linspace(0.0, ear.range, 6)[1:]:
        right.plot(r * np.sin(turn), r * np.cos(turn), color="0.45", linewidth=0.5)
        right.text(
            r * math.sin(turn[-1]), r * math.cos(turn[-1]), f" {r:g} m", color="0.75", fontsize=8, va="top"
        )
    right.axis("off")
    figure.savefig(path, dpi=DPI, facecolor="black", format="png")


def tables_of(result: Mapping[str, Any]) -> Sequence[Table]:
    """Return tables of sites and sensors with their descriptions, or of one site."""
    if "sites" in result:
        return [
            Table(
                title=title, heads=["", ""], rows=[list(item) for item in result[title].items()], left=(0, 1)
            )
            for title in ("sites", "sensors")
        ]
    rows = [
        [
            name,
            f"{item['count']} x {item['shape']}" if item["count"] > 1 else item["shape"],
            item["frame"] or "world",
            ", ".join(f"{x:g}" for x in item["position"]),
            "yes" if item["varies"] else "",
        ]
        for name, item in result["objects"].items()
    ]
    red, green, blue = (f"{x} m" if x is not None else "any distance" for x in result["visibility_m"])
    return [
        Table(
            title=result["name"],
            headline=f"{result['name']}: {result['about']}",
            heads=["object", "shape", "in", "position [m]", "drawn"],
            rows=rows,
            left=(0, 1, 2, 3),
            note=f"a beam of red, green, blue light keeps 2 % over {red}, {green}, {blue}; "
            f"sound {result['sound_speed']:.0f} m/s, {result['sound_absorption_db_per_m']:.3f} dB/m "
            f"at {result['sonar_frequency'] / 1e3:.0f} kHz",
        )
    ]
