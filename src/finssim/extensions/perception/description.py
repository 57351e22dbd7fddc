"""Worlds as data: YAML files that are read, checked and refused in one sentence each.

World frame as everywhere: z up, z = 0 on the still water surface. Colours are reflectances and radiances of (red,
green, blue); radiance 1 is that of white paper lying level just below the surface.
"""

from __future__ import annotations

import io
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, PrivateAttr, model_validator

from finssim.core.budget import read_bytes
from finssim.core.files import plain_name
from finssim.core.mesh import MeshError, load_stl
from finssim.core.rotations import quat_from_euler, quat_from_yaw
from finssim.vehicles.device_files import Count, Pair
from finssim.vehicles.part import (
    NonNegative,
    Number,
    Part,
    Positive,
    Positive3,
    Probability,
    Quaternion,
    Vector3,
    did_you_mean,
    refuse_section,
    refuse_value,
    zeros,
)
from finssim.vehicles.part_file import GREATEST, checked_part, locate, names_in, read_tree

if TYPE_CHECKING:
    from finssim.extensions.perception.layout import WorldLayout
    from finssim.extensions.perception.model import WorldBatch
    from finssim.extensions.perception.onboard import OnboardPlan
    from finssim.extensions.perception.onlooker import Onlooker
    from finssim.extensions.perception.parts import ModelPart
    from finssim.extensions.perception.sight import Sight
    from finssim.sim.overhead_camera import WaterOptics
    from finssim.sim.simulator import Simulator
    from finssim.tasks.arrays import TaskArrays
    from finssim.tasks.environment import Environment
    from finssim.tasks.task import Task
    from finssim.vehicles import Vehicle

Array = NDArray[np.float64]

SITES = Path(__file__).parent / "catalogue"
LARGEST = 4096
"""Shapes in one world."""
FINEST = 1 << 20
"""Heights of a seabed."""


class WorldError(ValueError):
    """A world that is not possible: one sentence that states where, what and what to do."""


def _within(low: float, high: float) -> AfterValidator:
    def check(values: Array) -> Array:
        if np.any((values < low) | (values > high)):
            raise refuse_value(f"is {values.tolist()}, expected 3 numbers from {low:g} to {high:g}")
        return values

    return AfterValidator(check)


Colour = Annotated[Vector3, _within(0.0, 1.0)]
"""Reflectance of red, green and blue, (3,)."""
NonNegative3 = Annotated[Vector3, _within(0.0, math.inf)]


class Texture(Part):
    """A pattern on a shape, drawn in the shape's own axes; a seabed's and a plane's lies in x and y."""

    kind: Literal["checker", "stripes", "tiles", "mottled", "picture", "tag"]
    """Squares of two colours; bands along z; tiles with joints; patches of random brightness, as sand has; a picture or
    a printed tag in the middle of each face, upright along z, on faces across z along y."""
    size: Annotated[float, Field(strict=True, ge=1e-4, le=1e6)]
    """Size of a square, a pair of bands, a tile, a patch; width of a picture; edge of a tag's black border [m]."""
    file: str | None = None
    """File of a picture: PNG or JPEG beside the world file."""
    tag: Annotated[int, Field(strict=True, ge=0)] | None = None
    """Number of a tag in its family."""
    family: str = "apriltag_36h11"
    """Family of a tag: one of OpenCV's dictionaries, such as `apriltag_36h11` or `4x4_50`."""
    colour: Colour = Field(default_factory=lambda: zeros(3))
    """Colour of every other square or band, and of joints, which are 6 % of a tile wide."""
    contrast: Probability = 0.3
    """Contrast of patches: greatest change of brightness as a share of it; of tiles: from tile to tile."""

    @model_validator(mode="after")
    def _complete(self) -> Texture:
        for kind, key in (("picture", "file"), ("tag", "tag")):
            if (self.kind == kind) != (getattr(self, key) is not None):
                raise refuse_section(f"{key} is for kind: {kind}, which needs it; kind is {self.kind}")
        return self


class Finish(Part):
    """Optical and acoustic properties of a surface."""

    colour: Colour = Field(default_factory=lambda: zeros(3) + 0.5)
    """Diffuse reflectance."""
    texture: Texture | None = None
    glow: NonNegative3 = Field(default_factory=lambda: zeros(3))
    """Emitted radiance [-], as of a beacon."""
    backscatter_strength_db: Annotated[float, Field(strict=True, ge=-200.0, le=100.0)] = -27.0
    """10 log10 of Lambert's parameter mu [dB]: echo strength of 1 m² seen head-on. The default is that of sea floors
    (Mackenzie 1961); hard and rough walls have -15 to -5."""


class Variation(Part):
    """Ranges by which an object's pose and size differ from the file, by world; poses are drawn uniformly."""

    position: NonNegative3 = Field(default_factory=lambda: zeros(3))
    """Largest shift along x, y, z of its frame [m]."""
    yaw: NonNegative = 0.0
    """Largest turn about z of its frame [rad]."""
    size: Annotated[float, Field(strict=True, ge=1.0, le=4.0)] = 1.0
    """Largest factor by which it, and all that is in its frame, is drawn greater or smaller, log-uniformly."""


class Repeat(Part):
    """Copies of a shape in a row."""

    count: Count
    step: Vector3
    """Offset from each copy to the next, in the frame of the shape's position [m]."""


SIZES = {
    "box": {"size"},
    "sphere": {"radius"},
    "capsule": {"radius", "length"},
    "cylinder": {"radius", "length"},
    "plane": set(),
    "mesh": {"file"},
    "model": {"file"},
    "group": set(),
}
"""Kind of shape -> keys that it needs."""


class Object(Finish):
    """A shape with its pose, or a group that is the frame of others."""

    shape: Literal["box", "sphere", "capsule", "cylinder", "plane", "mesh", "model", "group"]
    position: Vector3
    """Position of the shape's middle, in the world or in `frame` [m]."""
    orientation: Quaternion | None = None
    """q_world<shape> (or q_frame<shape>), xyzw; at most one of orientation, axis and yaw."""
    axis: Vector3 | None = None
    """Direction of the shape's z axis: along a cylinder or capsule, out of a plane; any length but 0 [-]."""
    yaw: Number | None = None
    """Turn about z [rad]."""
    frame: str | None = None
    """An object before this one: this one's position is in its axes, and it moves with it."""
    size: Positive3 | None = None
    """Size of a box, along its axes [m]."""
    radius: Positive | None = None
    """[m]"""
    length: Positive | None = None
    """Length of the cylinder, or of the straight part of a capsule [m]."""
    file: str | None = None
    """Beside the world file: STL of a mesh [m]; of a model MJCF (.xml) or URDF (.urdf)."""
    scale: Positive | None = None
    """Factor on the file's coordinates."""
    vary: Variation | None = None
    repeat: Repeat | None = None
    solid: bool = True
    """True if vehicles collide with it; no meaning for a group."""

    @model_validator(mode="after")
    def _complete(self) -> Object:
        dimensions = {"size", "radius", "length", "file", "scale"}
        present = {key for key in dimensions if getattr(self, key) is not None}
        required = SIZES[self.shape]
        if required - present:
            raise refuse_section(f"a {self.shape} needs {', '.join(sorted(required - present))}: add it")
        if surplus := present - required - ({"scale"} if self.shape in ("mesh", "model") else set()):
            raise refuse_section(f"a {self.shape} has no {', '.join(sorted(surplus))}: remove it")
        if sum(x is not None for x in (self.orientation, self.axis, self.yaw)) > 1:
            raise refuse_section("more than one of orientation, axis and yaw: give one")
        if self.axis is not None and not np.any(self.axis):
            raise refuse_section("axis is [0, 0, 0], expected a direction")
        if self.shape == "group" and self.repeat is not None:
            raise refuse_section("a group has no repeat: give it to the shapes in it")
        return self

    @property
    def quaternion(self) -> Array:
        """Return the quaternion from shape to its frame, xyzw, (4,); a shape with an axis is turned to it the shortest
        way."""
        if self.orientation is not None:
            return self.orientation
        if self.axis is None:
            return quat_from_yaw(self.yaw or 0.0)
        z = self.axis / np.linalg.norm(self.axis)
        if z[2] < -1.0 + 1e-12:
            return np.array([1.0, 0.0, 0.0, 0.0])
        q = np.array([-z[1], z[0], 0.0, 1.0 + z[2]])
        return np.asarray(q / np.linalg.norm(q))

    @property
    def positions(self) -> Array:
        """Return the positions of the shape and its copies, in its frame [m], (count, 3)."""
        if self.repeat is None:
            return self.position[None]
        return self.position + np.arange(self.repeat.count)[:, None] * self.repeat.step


class WorldBasin(Finish):
    """A rectangular tank: floor and four walls that reach above the water, centred on the world's z axis."""

    size: Positive3
    """Inner length along x, width along y, depth of the water [m]."""
    freeboard: NonNegative = 0.3
    """Height of the walls above the water [m]."""


class Roughness(Part):
    """Heights as a sum of 48 sine waves of random direction and phase, amplitudes in proportion to their lengths."""

    rms: Positive
    """Root mean square of the height [m]."""
    wavelength: Positive
    """The longest; the shortest is an eighth of it [m]."""
    seed: Annotated[int, Field(strict=True, ge=0)] = 0


class Seabed(Finish):
    """The bottom: a plane, or a heightfield of a slope, roughness and a table of heights, which add up."""

    depth: Positive
    """Below the surface at x = y = 0, of the plane that the heights are added to [m]."""
    slope: Pair = (0.0, 0.0)
    """Slopes dz/dx, dz/dy of that plane [-]."""
    size: Pair | None = None
    """Extent along x and y about the origin [m]; without it the bottom is a plane without end."""
    spacing: Positive = 0.5
    """Between heights [m]."""
    roughness: Roughness | None = None
    heights: str | None = None
    """CSV beside the world file: heights [m], one row for each y from least to greatest, stretched over `size`."""

    @model_validator(mode="after")
    def _extent(self) -> Seabed:
        rough = self.roughness is not None or self.heights is not None
        if self.size is not None and min(self.size) <= 0.0:
            raise refuse_section(f"size is {list(self.size)}, expected 2 numbers > 0")
        if self.size is None and rough:
            raise refuse_section("roughness and heights need a size: add it, such as size: [40, 40]")
        if self.size is not None and math.prod(max(2.0, x / self.spacing + 1.0) for x in self.size) > FINEST:
            raise refuse_section(f"more than {FINEST} heights: give a smaller size or a wider spacing")
        return self


JERLOV = {
    "I": (0.235, 0.063, 0.018),
    "IA": (0.240, 0.067, 0.025),
    "IB": (0.245, 0.072, 0.033),
    "II": (0.260, 0.089, 0.062),
    "III": (0.295, 0.120, 0.116),
    "1C": (0.300, 0.120, 0.170),
    "3C": (0.330, 0.190, 0.290),
    "5C": (0.400, 0.300, 0.430),
    "7C": (0.480, 0.460, 0.710),
    "9C": (0.600, 0.630, 1.230),
}
"""Attenuation of downward daylight K_d at 600, 550 and 475 nm [1/m] (Jerlov, Marine Optics, 1976, table XXVII, as two
public programs have it, which agree), for red, green and blue."""
BEAM_OVER_DAYLIGHT = 1.5
"""Beam attenuation over K_d if only a water type is given. A choice: the table has none, and most light that scatters
forwards still arrives near its pixel, so a picture fades by less than a + b."""


class Snow(Part):
    """Marine snow: particles in the water, lit by daylight and lamps; cameras see those near them."""

    density: Annotated[float, Field(strict=True, gt=0.0, le=1e5)]
    """[1/m³]"""
    size: Annotated[float, Field(strict=True, gt=0.0, le=0.05)] = 0.001
    """Diameter [m]."""


class WorldWater(Part):
    """Water as light and sound meet it, the same everywhere in a world."""

    jerlov: Literal["I", "IA", "IB", "II", "III", "1C", "3C", "5C", "7C", "9C"] | None = None
    """Jerlov's water type: gives daylight_attenuation, and 1.5 times that as attenuation, where they are not given."""
    snow: Snow | None = None
    attenuation: NonNegative3
    """Beam attenuation c of red, green, blue [1/m], (3,)."""
    veil: NonNegative3
    """Radiance B [-] of water without end just below the surface: backscattered daylight, (3,)."""
    daylight_attenuation: NonNegative3
    """K_d: daylight at depth h is exp(-K_d h) of that just below the surface [1/m], at most c, (3,)."""
    temperature: Annotated[float, Field(strict=True, ge=-2.0, le=40.0)] = 15.0
    """[°C], for the speed and the absorption of sound."""
    salinity: Annotated[float, Field(strict=True, ge=0.0, le=42.0)] = 0.0
    """[g/kg], for the same."""
    vary: Annotated[float, Field(strict=True, ge=1.0, le=10.0)] = 1.0
    """Largest factor by which c and K_d of a world are drawn greater or smaller, log-uniformly."""

    @model_validator(mode="before")
    @classmethod
    def _typed(cls, values: Any) -> Any:
        if isinstance(values, dict) and values.get("jerlov") in JERLOV:
            K_d = np.array(JERLOV[values["jerlov"]])
            values = {"daylight_attenuation": K_d.tolist(), **values}
            values = {"attenuation": (BEAM_OVER_DAYLIGHT * K_d).tolist(), **values}
        return values

    @model_validator(mode="after")
    def _ordered(self) -> WorldWater:
        if np.any(self.daylight_attenuation > self.attenuation):
            raise refuse_section(
                "daylight_attenuation exceeds attenuation: diffuse light fades no faster than a beam, give less"
            )
        return self

    @property
    def optical(self) -> WaterOptics:
        """Return the water in the form of the overhead camera."""
        from finssim.sim.overhead_camera import WaterOptics  # which imports Warp

        return WaterOptics(attenuation=_triple(self.attenuation), veil=_triple(self.veil))

    @property
    def sound_speed(self) -> float:
        """Return the speed of sound at the surface [m/s] (Medwin 1975; 0 to 35 °C, 0 to 45 g/kg).

        c = 1449.2 + 4.6 T - 0.055 T² + 0.00029 T³ + (1.34 - 0.010 T)(S - 35)
        """
        T, S = self.temperature, self.salinity
        return 1449.2 + 4.6 * T - 0.055 * T**2 + 0.00029 * T**3 + (1.34 - 0.010 * T) * (S - 35.0)

    def sound_absorption(self, frequency: float, depth: float = 0.0) -> float:
        """Absorption of sound [dB/m] (Ainslie & McColm 1998, at pH 8).

        alpha = 0.106 f1 f²/(f1² + f²) + 0.52 (1 + T/43) (S/35) f2 f²/(f2² + f²) e^(-z/6)
                + 0.00049 f² e^(-(T/27 + z/17))

        in dB/km, with f in kHz, z in km, f1 = 0.78 sqrt(S/35) e^(T/26) of boric acid and f2 = 42 e^(T/17) of magnesium
        sulphate; the last term is that of the water itself.

        Args:
            frequency: [Hz].
            depth: [m].
        """
        T, S, f, z = self.temperature, self.salinity / 35.0, frequency / 1e3, depth / 1e3
        boric, sulphate = 0.78 * math.sqrt(S) * math.exp(T / 26.0), 42.0 * math.exp(T / 17.0)
        per_km = 0.106 * boric * f**2 / (boric**2 + f**2)
        per_km += 0.52 * (1.0 + T / 43.0) * S * sulphate * f**2 / (sulphate**2 + f**2) * math.exp(-z / 6.0)
        per_km += 0.00049 * f**2 * math.exp(-(T / 27.0 + z / 17.0))
        return per_km / 1e3


class LightVariation(Part):
    """Ranges of daylight, drawn by world."""

    brightness: Annotated[float, Field(strict=True, ge=1.0, le=10.0)] = 1.0
    """Largest factor by which daylight, veil and sky are drawn brighter or darker, log-uniformly."""
    sun: Annotated[float, Field(strict=True, ge=0.0, le=math.pi)] = 0.0
    """Largest turn of the sun about the vertical, and in height, uniformly [rad]; it stays 5° above the horizon."""


class Light(Part):
    """Daylight just below the surface."""

    daylight: NonNegative3 = Field(default_factory=lambda: zeros(3) + 1.0)
    """Irradiance of a level surface [-], relative to that which gives white paper radiance 1, (3,)."""
    sun: Vector3 = Field(default_factory=lambda: zeros(3) + np.array([0.3, 0.2, 0.93]))
    """Direction towards the sun as seen from below the surface, any length but 0 [-], (3,)."""
    diffuse: Probability = 0.5
    """Share of the irradiance that comes evenly from above rather than from the sun."""
    sky: NonNegative3 = Field(default_factory=lambda: zeros(3) + 1.0)
    """Radiance [-] of the sky, or the ceiling, as seen through the surface from below, (3,)."""
    vary: LightVariation = Field(default_factory=lambda: LightVariation())

    @model_validator(mode="after")
    def _from_above(self) -> Light:
        if self.sun[2] <= 0.0:
            raise refuse_section(f"sun is {self.sun.tolist()}, expected a direction that points up (z > 0)")
        return self


class Contact(Part):
    """Stiffness of basin, seabed and objects at a hull's points of contact: spring, damper and friction."""

    stiffness: Positive = 4000.0
    """Per corner, or sphere, of the hull [N/m]."""
    damping: NonNegative = 100.0
    """Against approach [N s/m]."""
    friction: NonNegative = 0.2
    """Coulomb coefficient [-]."""


class Viewpoint(Part):
    """Pose from which `finssim worlds show` draws, and where a vehicle may start."""

    position: Vector3
    """[m]"""
    yaw: Number = 0.0
    """[rad]"""
    pitch: Number = 0.0
    """[rad], nose down is positive."""

    @property
    def pose(self) -> Array:
        """Position [m] and attitude xyzw, world frame, (7,)."""
        return np.concatenate([self.position, quat_from_euler(0.0, self.pitch, self.yaw)])


class Look(Part):
    """Another look of a site, which a draw may give a world: water and surfaces in place of the file's own."""

    water: WorldWater | None = None
    """For light alone: sound keeps the file's temperature and salinity."""
    surfaces: dict[str, Finish] = Field(default_factory=dict)
    """Finish by the name of an object, or `seabed` or `basin`, for light and echoes."""
    held_out: Annotated[bool, Field(strict=True)] = False
    """Never drawn in training: what is learnt can be tried there."""


class World(Part):
    """A site: what light, sound and hulls meet there. `name` and `path` come from the file's own path."""

    about: str
    """One line for lists."""
    water: WorldWater
    light: Light = Field(default_factory=lambda: Light())
    basin: WorldBasin | None = None
    seabed: Seabed | None = None
    objects: dict[str, Object] = Field(default_factory=dict)
    contact: Contact = Field(default_factory=lambda: Contact())
    viewpoint: Viewpoint
    looks: dict[str, Look] = Field(default_factory=dict)
    """Looks by name; a draw takes the file's own look or one of these, with equal probability."""
    colour_vary: Annotated[float, Field(strict=True, ge=1.0, le=4.0)] = 1.0
    """Largest factor by which colour and glow of each object are drawn darker or brighter, log-uniformly."""
    name: str = Field(exclude=True)
    path: Path = Field(exclude=True)
    _models: dict[str, list[ModelPart]] = PrivateAttr(default_factory=dict)
    """Object -> its shapes from a model file, which is read once."""

    @model_validator(mode="after")
    def _objects_fit(self) -> World:
        earlier: list[str] = []
        for name, item in self.objects.items():
            if item.frame is not None and item.frame not in earlier:
                raise refuse_section(
                    f"objects.{name}: frame is '{item.frame}'{did_you_mean(item.frame, earlier)} expected an "
                    f"object defined before it: {', '.join(earlier) or 'there is none'}"
                )
            earlier.append(name)
        if (count := sum(len(item.positions) for item in self.objects.values())) > LARGEST:
            raise refuse_section(f"objects: {count} shapes with their copies, expected at most {LARGEST}")
        surfaces = [*earlier, *(name for name in ("basin", "seabed") if getattr(self, name) is not None)]
        for look, name in (
            (look, name) for look, appearance in self.looks.items() for name in appearance.surfaces
        ):
            if name not in surfaces:
                raise refuse_section(
                    f"looks.{look}.surfaces: '{name}' is no object of this world{did_you_mean(name, surfaces)} "
                    f"expected of: {', '.join(surfaces)}"
                )
        return self

    def beside(self, file: str, key: str) -> Path:
        """A file that the world names: it lies beside the world file.

        Args:
            file: Its name, never a path.
            key: Who names it, for messages.
        """
        return self.path.parent / plain_name(file, f"{self.path}: {key}", WorldError)

    def mesh(self, name: str) -> tuple[Array, NDArray[np.int64]]:
        """Vertices [m], shape axes, (n, 3), and faces (m, 3) of an object from a file."""
        item = self.objects[name]
        path = self.beside(item.file or "", f"objects.{name}: file")
        try:
            vertices, faces = load_stl(path)
        except (OSError, MeshError) as error:
            raise WorldError(f"{self.path}: objects.{name}: cannot read {path.name}: {error}") from None
        return self._reachable(vertices * (item.scale or 1.0), f"objects.{name}"), faces

    def model(self, name: str) -> list[ModelPart]:
        """The shapes of an object from a model file, unscaled, in the object's axes."""
        from finssim.extensions.perception.parts import PartsError, parts_of

        if name in self._models:
            return self._models[name]
        path = self.beside(self.objects[name].file or "", f"objects.{name}: file")
        if not path.is_file():
            raise WorldError(f"{self.path}: objects.{name}: no file {path.name} next to it")
        try:
            self._models[name] = parts_of(path)
            for part in self._models[name]:
                numbers = [
                    part.position,
                    part.size,
                    np.ravel(0.0 if part.vertices is None else part.vertices),
                ]
                self._reachable(
                    np.concatenate(numbers) * (self.objects[name].scale or 1.0), f"objects.{name}"
                )
        except PartsError as error:
            raise WorldError(f"{self.path}: objects.{name}: {path.name} {error}") from None
        return self._models[name]

    def seabed_heights(self) -> Array | None:
        """z of the seabed on a grid over its size [m], (ny, nx), row 0 at the least y; None for a plane."""
        bed = self.seabed
        if bed is None or bed.size is None:
            return None
        nx, ny = (max(2, round(extent / bed.spacing) + 1) for extent in bed.size)
        x, y = np.linspace(-0.5, 0.5, nx) * bed.size[0], np.linspace(-0.5, 0.5, ny)[:, None] * bed.size[1]
        z = -bed.depth + bed.slope[0] * x + bed.slope[1] * y
        if bed.roughness is not None:
            random = np.random.default_rng(bed.roughness.seed)
            length = bed.roughness.wavelength * np.exp(random.uniform(math.log(0.125), 0.0, 48))
            heading, phase = random.uniform(0.0, 2.0 * math.pi, (2, 48))
            amplitude = length * bed.roughness.rms * math.sqrt(2.0) / np.linalg.norm(length)
            for a, k, h, p in zip(amplitude, 2.0 * math.pi / length, heading, phase, strict=True):
                z = z + a * np.sin(k * (np.cos(h) * x + np.sin(h) * y) + p)
        if bed.heights is not None:
            z = z + _stretched(self._table(bed.heights), z.shape)
        return self._reachable(z, "seabed")

    def _reachable(self, places: Array, label: str) -> Array:
        """The places themselves [m], unless one is farther than worlds are computed."""
        if not np.abs(places).max() <= GREATEST:
            raise WorldError(
                f"{self.path}: {label}: reaches {np.abs(places).max():g} m, expected up to {GREATEST:g} m"
            )
        return places

    def _table(self, file: str) -> Array:
        path = self.beside(file, "seabed: heights")
        data = read_bytes(path, WorldError, f"{self.path}: seabed: heights: {file}", limit=64 << 20)
        try:
            table = np.loadtxt(io.BytesIO(data), delimiter=",", ndmin=2, max_rows=4096)
        except ValueError as error:
            raise WorldError(f"{self.path}: seabed: heights: cannot read {file}: {error}") from None
        if min(table.shape) < 2 or table.size > FINEST or not np.isfinite(table).all():
            raise WorldError(
                f"{self.path}: seabed: heights: {file} has {table.shape[0]} rows of {table.shape[1]}, expected 2 to "
                f"{FINEST} finite heights"
            )
        return table

    # What an environment, a simulator and a virtual pool make of a world; see the classes that are returned.

    def layout(self, worlds: int = 1, device: str = "cpu") -> WorldLayout:
        """Return copies of the world, in which vehicles collide with its solids."""
        from finssim.extensions.perception.layout import WorldLayout

        return WorldLayout(self, worlds, device)

    def sight(self, task: Task, simulator: Simulator, arrays: TaskArrays, seed: int) -> Sight:
        """Return the world around the vehicle of a task, and what its sensors measure of it."""
        from finssim.extensions.perception.sight import Sight

        return Sight(task, self, simulator, arrays, seed)

    def drawn_for(self, task: Task, arrays: TaskArrays, seed: int) -> WorldBatch:
        """Return one copy, drawn as for a task's first episode, whose goal is set to the landmark."""
        from finssim.extensions.perception.sight import drawn_for

        return drawn_for(task, self, arrays, seed)

    def onboard(self, vehicle: Vehicle, seed: int, *, solid: bool = True) -> OnboardPlan:
        """Return the plan of a vehicle's cameras and sonars in the world, drawn from a seed."""
        from finssim.extensions.perception.onboard import OnboardPlan

        return OnboardPlan(vehicle=vehicle, world=self, seed=seed, solid=solid)

    def onlooker(self, environment: Environment, world: int = 0, width: int = 640) -> Onlooker:
        """Return a camera that follows a vehicle of an environment; the world is drawn around tasks without one."""
        from finssim.extensions.perception.onlooker import Onlooker

        return Onlooker(environment, self, world, width)


def _stretched(table: Array, shape: tuple[int, ...]) -> Array:
    """A table interpolated linearly to another number of rows and columns."""
    columns = np.linspace(0.0, table.shape[1] - 1.0, shape[1])
    wide = np.stack([np.interp(columns, np.arange(table.shape[1]), row) for row in table])
    rows = np.linspace(0.0, table.shape[0] - 1.0, shape[0])
    return np.stack([np.interp(rows, np.arange(table.shape[0]), column) for column in wide.T], axis=1)


def _triple(values: Array) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


# Files.


def sites() -> list[str]:
    """Names of the worlds that come with FinsSim."""
    return names_in(SITES)


def load_world(name_or_path: str | os.PathLike[str]) -> World:
    """Read and check a world.

    Args:
        name_or_path: A site of the catalogue such as `pool`, or the path of a YAML file.

    Raises:
        WorldError: Unknown name, or a file that is refused; the message says where, what and what to do.
    """
    path, label = locate(name_or_path, SITES, "site", WorldError)
    tree = read_tree(path, label, "water: {attenuation: [0.4, 0.1, 0.08]}", WorldError)
    world = checked_part(World, {**tree, "name": path.stem, "path": path}, label, WorldError)
    for name, item in world.objects.items():
        if item.file is not None:
            world.model(name) if item.shape == "model" else world.mesh(name)
    world.seabed_heights()
    return world
