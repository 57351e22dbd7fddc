"""Worlds as data: YAML files that are read and checked; every refusal is one sentence.

World frame as everywhere: z up, z = 0 on the still water surface. Colours are reflectances and radiances of (red,
green, blue); radiance 1 is that of horizontal white paper just below the surface.
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
    from finssim.extensions.perception.chase_camera import ChaseCamera
    from finssim.extensions.perception.layout import WorldLayout
    from finssim.extensions.perception.model import WorldBatch
    from finssim.extensions.perception.onboard import OnboardPlan
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
"""Greatest number of shapes in one world."""
FINEST = 1 << 20
"""Greatest number of heights of a seabed."""


class WorldError(ValueError):
    """World that is not possible; the message states in one sentence where, what and what to do."""


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
    """Pattern on a shape, in the shape's own axes; on a seabed or a plane, in x and y."""

    kind: Literal["checker", "stripes", "tiles", "mottled", "picture", "tag"]
    """Squares of two colours; bands along z; tiles with joints; patches of random brightness, like sand; a
    picture or a printed tag in the middle of each face, upright along z, on horizontal faces along y."""
    size: Annotated[float, Field(strict=True, ge=1e-4, le=1e6)]
    """Size of a square, a pair of bands, a tile or a patch; width of a picture; edge of a tag's black border [m]."""
    file: str | None = None
    """File of a picture: PNG or JPEG in the folder of the world file."""
    tag: Annotated[int, Field(strict=True, ge=0)] | None = None
    """Id of a tag in its family."""
    family: str = "apriltag_36h11"
    """Family of a tag: one of OpenCV's dictionaries, such as `apriltag_36h11` or `4x4_50`."""
    colour: Colour = Field(default_factory=lambda: zeros(3))
    """Colour of every other square or band, and of joints, which are 6 % of a tile wide."""
    contrast: Probability = 0.3
    """Contrast of patches: greatest relative change of brightness; of tiles: between tiles."""

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
    """Ranges in which an object's pose and size vary between worlds; poses are drawn uniformly."""

    position: NonNegative3 = Field(default_factory=lambda: zeros(3))
    """Largest shift along x, y, z of the object's frame [m]."""
    yaw: NonNegative = 0.0
    """Largest rotation about z of the object's frame [rad]."""
    size: Annotated[float, Field(strict=True, ge=1.0, le=4.0)] = 1.0
    """Largest factor by which the object, and everything in its frame, is scaled up or down, log-uniformly."""


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
"""Kind of shape -> required keys."""


class Object(Finish):
    """Shape with its pose, or a group that is the frame of other objects."""

    shape: Literal["box", "sphere", "capsule", "cylinder", "plane", "mesh", "model", "group"]
    position: Vector3
    """Position of the shape's middle, in the world or in `frame` [m]."""
    orientation: Quaternion | None = None
    """q_world<shape> (or q_frame<shape>), xyzw; at most one of orientation, axis and yaw."""
    axis: Vector3 | None = None
    """Direction of the shape's z axis: along a cylinder or capsule, normal to a plane; any length but 0 [-]."""
    yaw: Number | None = None
    """Rotation about z [rad]."""
    frame: str | None = None
    """Name of an earlier object: the position is in that object's axes, and this object moves with it."""
    size: Positive3 | None = None
    """Size of a box, along its axes [m]."""
    radius: Positive | None = None
    """Radius of a sphere, capsule or cylinder [m]."""
    length: Positive | None = None
    """Length of the cylinder, or of the straight part of a capsule [m]."""
    file: str | None = None
    """File in the folder of the world file: STL of a mesh [m]; MJCF (.xml) or URDF (.urdf) of a model."""
    scale: Positive | None = None
    """Factor on the file's coordinates."""
    vary: Variation | None = None
    repeat: Repeat | None = None
    solid: bool = True
    """True if vehicles collide with the object; not used for a group."""

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
        """Return the quaternion from the shape to its frame, xyzw, (4,); with an axis, the smallest rotation
        of z to it."""
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
    """Rectangular tank: floor and four walls that extend above the water, centred on the world's z axis."""

    size: Positive3
    """Inner length along x, width along y, depth of the water [m]."""
    freeboard: NonNegative = 0.3
    """Height of the walls above the water [m]."""


class Roughness(Part):
    """Heights as a sum of 48 sine waves of random direction and phase, with amplitudes proportional to their
    wavelengths."""

    rms: Positive
    """Root mean square of the height [m]."""
    wavelength: Positive
    """Longest wavelength; the shortest is an eighth of it [m]."""
    seed: Annotated[int, Field(strict=True, ge=0)] = 0


class Seabed(Finish):
    """Seabed: a plane, or a heightfield of a slope, roughness and a table of heights, which are added."""

    depth: Positive
    """Depth at x = y = 0 of the plane to which heights are added [m]."""
    slope: Pair = (0.0, 0.0)
    """Slopes dz/dx, dz/dy of that plane [-]."""
    size: Pair | None = None
    """Extent along x and y about the origin [m]; None: an infinite plane."""
    spacing: Positive = 0.5
    """Distance between heights [m]."""
    roughness: Roughness | None = None
    heights: str | None = None
    """CSV file in the folder of the world file: heights [m], one row for each y in ascending order, stretched
    over `size`."""

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
"""Attenuation of downward daylight K_d at 600, 550 and 475 nm [1/m] (Jerlov, Marine Optics, 1976, table
XXVII, as in two public programs, which agree), for red, green and blue."""
BEAM_OVER_DAYLIGHT = 1.5
"""Ratio of beam attenuation to K_d if only a water type is given. A choice: the table contains none, and most
light that scatters forwards still arrives near its pixel, so a picture fades by less than a + b."""


class Snow(Part):
    """Marine snow: particles in the water, lit by daylight and lamps, and visible near the camera."""

    density: Annotated[float, Field(strict=True, gt=0.0, le=1e5)]
    """Number of particles per volume [1/m³]."""
    size: Annotated[float, Field(strict=True, gt=0.0, le=0.05)] = 0.001
    """Diameter of a particle [m]."""


class WorldWater(Part):
    """Optical and acoustic properties of the water, uniform in a world."""

    jerlov: Literal["I", "IA", "IB", "II", "III", "1C", "3C", "5C", "7C", "9C"] | None = None
    """Jerlov's water type: sets daylight_attenuation, and attenuation to 1.5 times that, unless they are given."""
    snow: Snow | None = None
    attenuation: NonNegative3
    """Beam attenuation c of red, green, blue [1/m], (3,)."""
    veil: NonNegative3
    """Radiance B [-] of infinitely deep water just below the surface: backscattered daylight, (3,)."""
    daylight_attenuation: NonNegative3
    """K_d [1/m], at most c: daylight at depth h is exp(-K_d h) times that just below the surface, (3,)."""
    temperature: Annotated[float, Field(strict=True, ge=-2.0, le=40.0)] = 15.0
    """Temperature, for the speed and absorption of sound [°C]."""
    salinity: Annotated[float, Field(strict=True, ge=0.0, le=42.0)] = 0.0
    """Salinity, for the speed and absorption of sound [g/kg]."""
    vary: Annotated[float, Field(strict=True, ge=1.0, le=10.0)] = 1.0
    """Largest factor by which c and K_d vary between worlds, up or down, log-uniformly."""

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
        """Return the water's optics in the form used by the overhead camera."""
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
        """Return the absorption of sound [dB/m] (Ainslie & McColm 1998, at pH 8).

        alpha = 0.106 f1 f²/(f1² + f²) + 0.52 (1 + T/43) (S/35) f2 f²/(f2² + f²) e^(-z/6)
                + 0.00049 f² e^(-(T/27 + z/17))

        in dB/km, with f in kHz, z in km, f1 = 0.78 sqrt(S/35) e^(T/26) of boric acid and f2 = 42 e^(T/17) of
        magnesium sulphate; the last term is that of the water itself.

        Args:
            frequency: Frequency [Hz].
            depth: Depth [m].
        """
        T, S, f, z = self.temperature, self.salinity / 35.0, frequency / 1e3, depth / 1e3
        boric, sulphate = 0.78 * math.sqrt(S) * math.exp(T / 26.0), 42.0 * math.exp(T / 17.0)
        per_km = 0.106 * boric * f**2 / (boric**2 + f**2)
        per_km += 0.52 * (1.0 + T / 43.0) * S * sulphate * f**2 / (sulphate**2 + f**2) * math.exp(-z / 6.0)
        per_km += 0.00049 * f**2 * math.exp(-(T / 27.0 + z / 17.0))
        return per_km / 1e3


class LightVariation(Part):
    """Ranges in which daylight varies between worlds."""

    brightness: Annotated[float, Field(strict=True, ge=1.0, le=10.0)] = 1.0
    """Largest factor by which daylight, veil and sky are scaled up or down, log-uniformly."""
    sun: Annotated[float, Field(strict=True, ge=0.0, le=math.pi)] = 0.0
    """Largest change of the sun's azimuth and elevation, uniformly [rad]; it stays 5° above the horizon."""


class Light(Part):
    """Daylight just below the surface."""

    daylight: NonNegative3 = Field(default_factory=lambda: zeros(3) + 1.0)
    """Irradiance of a horizontal surface [-], relative to the irradiance at which white paper has radiance 1, (3,)."""
    sun: Vector3 = Field(default_factory=lambda: zeros(3) + np.array([0.3, 0.2, 0.93]))
    """Direction towards the sun as seen from below the surface, any length but 0 [-], (3,)."""
    diffuse: Probability = 0.5
    """Fraction of the irradiance that is diffuse from above rather than direct from the sun [-]."""
    sky: NonNegative3 = Field(default_factory=lambda: zeros(3) + 1.0)
    """Radiance [-] of the sky or ceiling, seen from below through the surface, (3,)."""
    vary: LightVariation = Field(default_factory=lambda: LightVariation())

    @model_validator(mode="after")
    def _from_above(self) -> Light:
        if self.sun[2] <= 0.0:
            raise refuse_section(f"sun is {self.sun.tolist()}, expected a direction that points up (z > 0)")
        return self


class Contact(Part):
    """Contact of the hull with basin, seabed and objects: spring, damper and friction."""

    stiffness: Positive = 4000.0
    """Stiffness per corner, or sphere, of the hull [N/m]."""
    damping: NonNegative = 100.0
    """Damping of the approach speed [N s/m]."""
    friction: NonNegative = 0.2
    """Coulomb friction coefficient [-]."""


class Viewpoint(Part):
    """Viewpoint of `finssim worlds show`, and possible start of a vehicle."""

    position: Vector3
    """Position, world frame [m]."""
    yaw: Number = 0.0
    """Yaw [rad]."""
    pitch: Number = 0.0
    """Pitch, positive nose down [rad]."""

    @property
    def pose(self) -> Array:
        """Position [m] and attitude xyzw, world frame, (7,)."""
        return np.concatenate([self.position, quat_from_euler(0.0, self.pitch, self.yaw)])


class Look(Part):
    """Alternative appearance of a site that a draw may select: water and surfaces in place of the file's own."""

    water: WorldWater | None = None
    """Water for light only: sound uses the file's temperature and salinity."""
    surfaces: dict[str, Finish] = Field(default_factory=dict)
    """Finish by the name of an object, or `seabed` or `basin`, for light and echoes."""
    held_out: Annotated[bool, Field(strict=True)] = False
    """True if the look is never drawn in training, so that learned policies can be tested with it."""


class World(Part):
    """Site: geometry, surfaces and water that light, sound and hulls interact with. `name` and `path` come
    from the file's path."""

    about: str
    """Description in one line, for lists."""
    water: WorldWater
    light: Light = Field(default_factory=lambda: Light())
    basin: WorldBasin | None = None
    seabed: Seabed | None = None
    objects: dict[str, Object] = Field(default_factory=dict)
    contact: Contact = Field(default_factory=lambda: Contact())
    viewpoint: Viewpoint
    looks: dict[str, Look] = Field(default_factory=dict)
    """Looks by name; a draw selects the file's own look or one of these, with equal probability."""
    colour_vary: Annotated[float, Field(strict=True, ge=1.0, le=4.0)] = 1.0
    """Largest factor by which colour and glow of each object vary, up or down, log-uniformly."""
    name: str = Field(exclude=True)
    path: Path = Field(exclude=True)
    _models: dict[str, list[ModelPart]] = PrivateAttr(default_factory=dict)
    """Object -> its shapes from a model file, cached after the first reading."""

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
        """Return the path of a file named in the world file, which lies in the same folder.

        Args:
            file: Its name, never a path.
            key: Key that names it, for messages.
        """
        return self.path.parent / plain_name(file, f"{self.path}: {key}", WorldError)

    def mesh(self, name: str) -> tuple[Array, NDArray[np.int64]]:
        """Return the vertices [m], shape axes, (n, 3), and faces (m, 3) of an object from a file."""
        item = self.objects[name]
        path = self.beside(item.file or "", f"objects.{name}: file")
        try:
            vertices, faces = load_stl(path)
        except (OSError, MeshError) as error:
            raise WorldError(f"{self.path}: objects.{name}: cannot read {path.name}: {error}") from None
        return self._reachable(vertices * (item.scale or 1.0), f"objects.{name}"), faces

    def model(self, name: str) -> list[ModelPart]:
        """Return the shapes of an object from a model file, unscaled, in the object's axes."""
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
        """Return z of the seabed on a grid over its size [m], (ny, nx), row 0 at the least y; None for a plane."""
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
        """Return the positions [m]; refuse one that is farther away than the greatest computed distance."""
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

    # Objects that environments, simulators and virtual pools create from a world; see the returned classes.

    def layout(self, worlds: int = 1, device: str = "cpu") -> WorldLayout:
        """Return copies of the world, with whose solid objects vehicles collide."""
        from finssim.extensions.perception.layout import WorldLayout

        return WorldLayout(self, worlds, device)

    def sight(self, task: Task, simulator: Simulator, arrays: TaskArrays, seed: int) -> Sight:
        """Return the world around the vehicle of a task, with its sensors' measurements."""
        from finssim.extensions.perception.sight import Sight

        return Sight(task, self, simulator, arrays, seed)

    def drawn_for(self, task: Task, arrays: TaskArrays, seed: int) -> WorldBatch:
        """Return one copy of the world, drawn as for a task's first episode, with the task's goal at the landmark."""
        from finssim.extensions.perception.sight import drawn_for

        return drawn_for(task, self, arrays, seed)

    def onboard(self, vehicle: Vehicle, seed: int, *, solid: bool = True) -> OnboardPlan:
        """Return the plan of a vehicle's cameras and sonars in the world, drawn from a seed."""
        from finssim.extensions.perception.onboard import OnboardPlan

        return OnboardPlan(vehicle=vehicle, world=self, seed=seed, solid=solid)

    def chase_camera(self, environment: Environment, world: int = 0, width: int = 640) -> ChaseCamera:
        """Return a camera that follows a vehicle of an environment; for tasks without a world, the world is
        drawn around them."""
        from finssim.extensions.perception.chase_camera import ChaseCamera

        return ChaseCamera(environment, self, world, width)


def _stretched(table: Array, shape: tuple[int, ...]) -> Array:
    """Return a table interpolated linearly to another number of rows and columns."""
    columns = np.linspace(0.0, table.shape[1] - 1.0, shape[1])
    wide = np.stack([np.interp(columns, np.arange(table.shape[1]), row) for row in table])
    rows = np.linspace(0.0, table.shape[0] - 1.0, shape[0])
    return np.stack([np.interp(rows, np.arange(table.shape[0]), column) for column in wide.T], axis=1)


def _triple(values: Array) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


# Files.


def sites() -> list[str]:
    """Return the names of the worlds in the catalogue."""
    return names_in(SITES)


def load_world(name_or_path: str | os.PathLike[str]) -> World:
    """Read and check a world.

    Args:
        name_or_path: A site of the catalogue such as `pool`, or the path of a YAML file.

    Raises:
        WorldError: The name is unknown or the file is refused; the message states where, what and what to do.
    """
    path, label = locate(name_or_path, SITES, "site", WorldError)
    tree = read_tree(path, label, "water: {attenuation: [0.4, 0.1, 0.08]}", WorldError)
    world = checked_part(World, {**tree, "name": path.stem, "path": path}, label, WorldError)
    for name, item in world.objects.items():
        if item.file is not None:
            world.model(name) if item.shape == "model" else world.mesh(name)
    world.seabed_heights()
    return world
