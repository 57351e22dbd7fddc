"""Registries of everything that can be added to FinsSim: one dictionary per family.

An installed package adds members by entry points, and FinsSim's own members are references of the same form:

    [project.entry-points."finssim.sensors"]
    pinger = "acoustics.pinger:PingerBatch"

A member is imported and checked when it is first used, so that a broken package affects only its own users.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator, Mapping, MutableMapping
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

__all__ = [
    "ACTUATORS",
    "COMMANDS",
    "FAMILIES",
    "IMPORTERS",
    "LEARNERS",
    "SENSORS",
    "TASKS",
    "TERMS",
    "VEHICLES",
    "WORLDS",
    "Family",
    "RegistryError",
    "RegistryWarning",
    "object_at",
]


class RegistryError(ValueError):
    """A member of a family cannot be used; the message names the package that registers it."""


class RegistryWarning(UserWarning):
    """A member of a family is omitted because it cannot be used."""


class Family(MutableMapping[str, Any]):
    """Members of one family by name: those of FinsSim, of installed packages, and those added by the program.

    Iteration yields all names without importing anything; an item is imported when it is accessed.
    """

    def __init__(self, noun: str, shipped: Mapping[str, Any], check: str | None = None) -> None:
        """
        Args:
            noun: Name of one member in messages; its plural is the group of entry points.
            shipped: Name -> `module:object`, or the object itself, of FinsSim's own members.
            check: `module:function` of (name, member) that raises a ValueError for an invalid member.
        """
        self.noun = noun
        self.group = f"finssim.{noun}s"
        self._shipped = dict(shipped)
        self._check = check
        self._added: dict[str, Any] = {}
        self._imported: dict[tuple[str, str], Any] = {}

    def __getitem__(self, name: str) -> Any:
        """Return a member, importing it if necessary.

        Raises:
            KeyError: There is no member of that name.
            RegistryError: Its package cannot be imported, the object is invalid, or several packages register the name.
        """
        if name in self._added:
            return self._added[name]
        if name in self._shipped:
            shipped = self._shipped[name]
            return object_at(shipped) if isinstance(shipped, str) else shipped
        point, package = self._point(name)
        key = (package, point.value)
        if key not in self._imported:
            try:
                member = object_at(point.value)
                self._refuse_unfit(name, member)
            except Exception as error:  # a package's code may raise anything when it is imported
                raise RegistryError(
                    f"{self.noun} '{name}' of package {package} cannot be used: {point.value}: "
                    f"{type(error).__name__}: {error}; repair or uninstall that package"
                ) from error
            self._imported[key] = member
        return self._imported[key]

    def __setitem__(self, name: str, member: Any) -> None:
        """Add a member for this program; a class or function that is redefined replaces the earlier one.

        Raises:
            RegistryError: FinsSim, a package, or another object of this program already uses that name.
        """
        known = self._added.get(name)
        again = known is member or (_identity(known) is not None and _identity(known) == _identity(member))
        if not again and name in self:
            raise RegistryError(
                f"there is a {self.noun} '{name}' already, of {self.packages()[name]}: choose another name"
            )
        self._refuse_unfit(name, member)
        self._added[name] = member

    def __delitem__(self, name: str) -> None:
        """Remove a member that this program added."""
        del self._added[name]

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys([*self._shipped, *self._points(), *self._added]))

    def __len__(self) -> int:
        return len({*self._shipped, *self._points(), *self._added})

    def __contains__(self, name: object) -> bool:
        return name in self._shipped or name in self._added or name in self._points()

    def ship(self, members: Mapping[str, Any]) -> None:
        """Add members of FinsSim itself, as the constructor does."""
        self._shipped |= members

    def of_packages(self) -> list[str]:
        """Return the names that only other packages register."""
        return [name for name in self._points() if name not in self._shipped]

    def packages(self) -> dict[str, str]:
        """Return the package of each member by name: `finssim`, name and version of another, or `this program`."""
        of_points = {
            name: " and ".join(package for _, package in points) for name, points in self._points().items()
        }
        return (
            of_points | dict.fromkeys(self._added, "this program") | dict.fromkeys(self._shipped, "finssim")
        )

    def failures(self) -> dict[str, str]:
        """Import the members of other packages, and return name -> error message of each that cannot be used."""
        sentences = {}
        for name, points in self._points().items():
            if name in self._shipped:
                package = points[0][1]
                sentences[name] = (
                    f"{self.noun} '{name}' of package {package} is not used: FinsSim has that name"
                )
                continue
            try:
                self[name]
            except RegistryError as error:
                sentences[name] = str(error)
        return sentences

    def usable(self) -> dict[str, Any]:
        """Return all members, except unusable ones of other packages, for which a warning states the reason."""
        failed = self.failures()
        for sentence in failed.values():
            warnings.warn(sentence, RegistryWarning, stacklevel=2)
        return {name: self[name] for name in self if name in self._shipped or name not in failed}

    def reference(self, name: str) -> str:
        """Return `module:object` of a member of another package, without importing it.

        Raises:
            KeyError: No package registers that name.
            RegistryError: Several packages register it.
        """
        return str(self._point(name)[0].value)

    def _refuse_unfit(self, name: str, member: Any) -> None:
        if self._check is not None:
            object_at(self._check)(name, member)

    def _point(self, name: str) -> tuple[Any, str]:
        """Return the entry point of a name, and its package."""
        points = self._points()[name]
        if len(points) > 1:
            names = " and ".join(package for _, package in points)
            raise RegistryError(
                f"packages {names} both register a {self.noun} '{name}': uninstall one of them"
            )
        return points[0]

    def _points(self) -> dict[str, list[tuple[Any, str]]]:
        return _entry_points(self.group, tuple(sys.path))


@cache
def _entry_points(group: str, path: tuple[str, ...]) -> dict[str, list[tuple[Any, str]]]:
    """Return name -> entry points of a group with their packages; `path` is the search path, part of the
    cache key."""
    from importlib.metadata import entry_points  # slow to import

    points: dict[str, list[tuple[Any, str]]] = {}
    for point in entry_points(group=group):
        package = "unknown" if point.dist is None else f"{point.dist.name} {point.dist.version}"
        if point.dist is not None and point.dist.name == "finssim":  # an extension
            package = "finssim"
        points.setdefault(point.name, []).append((point, package))
    return points


def object_at(reference: str) -> Any:
    """Return the object of `module:object`."""
    module, _, name = reference.partition(":")
    value: Any = import_module(module)
    for part in name.split(".") if name else ():
        value = getattr(value, part)
    return value


def _identity(member: Any) -> tuple[str, str] | None:
    """Return module and qualified name of a class or function; None for other objects."""
    name = getattr(member, "__qualname__", None)
    return None if name is None else (str(member.__module__), name)


CATALOGUE = Path(__file__).parents[1] / "vehicles/catalogue"
"""Directory of FinsSim's vehicle files."""

VEHICLES = Family(
    "vehicle",
    {path.stem: path for path in sorted(CATALOGUE.glob("*.yaml"))},
    check="finssim.vehicles.loader:check_registered",
)
"""Name -> path of the vehicle file."""

TASKS = Family(
    "task",
    {
        "t1": "finssim.tasks.station_keeping:StationKeeping",
        "t2": "finssim.tasks.trajectory_tracking:TrajectoryTracking",
        "t3": "finssim.tasks.moving_target:MovingTarget",
        "velocity6": "finssim.tasks.velocity:VelocityControl",
        "docking": "finssim.tasks.docking:Docking",
        "path": "finssim.tasks.path:PathFollowing",
        "waypoints": "finssim.tasks.path:WaypointTour",
        "terrain": "finssim.tasks.terrain:TerrainFollowing",
        "homing": "finssim.tasks.homing:Homing",
    },
    check="finssim.tasks.catalogue:check_registered",
)
"""Name -> class of the task, or another callable; called without arguments, it returns the task with its defaults."""

SENSORS = Family(
    "sensor",
    {
        "imu": "finssim.sim.sensors.imu:ImuBatch",
        "depth": "finssim.sim.sensors.depth:DepthBatch",
        "dvl": "finssim.sim.sensors.dvl:DvlBatch",
        "compass": "finssim.sim.sensors.compass:CompassBatch",
    },
    check="finssim.sim.sensors.batch:check_registered",
)
"""Kind of a section under `sensors` in a vehicle file -> its `finssim.sim.sensors.SensorBatch`."""

TERMS = Family(
    "term",
    {
        name: f"finssim.physics.terms.{name}:{name.upper()}"
        for name in ("surge_damping", "cross_flow_drag", "lift_drag", "munk_relief")
    },
    check="finssim.physics.terms.composed:check_registered",
)
"""Key in a hydrodynamic set of a vehicle file -> its `finssim.physics.terms.Term`."""

ACTUATORS = Family(
    "actuator",
    {
        name: f"finssim.physics.actuators.{name}:{name.upper()}"
        for name in ("propeller", "fin", "buoyancy", "moving_mass", "gimbal")
    },
    check="finssim.physics.terms.composed:check_actuator",
)
"""`kind` of a section under `actuators` in a vehicle file -> its `finssim.vehicles.actuators.ActuatorKind`;
`propeller` applies to the sections under `thrusters`."""

LEARNERS = Family(
    "learner",
    {
        name: f"finssim.learning.learners.catalogue:{name.upper().replace('-', '_')}"
        for name in (
            "ppo", "sb3-ppo", "rsl-rl", "torchrl-ppo", "torchrl-ippo", "torchrl-mappo", "bc", "dagger", "distill",
        )
    },
    check="finssim.learning.learners.catalogue:check_registered",
)  # fmt: skip
"""Name -> the `LearnerKind`; for other packages, a class derived from `ActingLearner`."""

COMMANDS = Family("command", {})
"""First word after `finssim` -> function; `finssim.cli` adds FinsSim's own commands."""

WORLDS = Family("world", {})
"""Kind of a described world -> function of a name or path that returns the world; perception adds `described`."""

IMPORTERS = Family(
    "importer",
    {
        "vehicle.coefficients": "finssim.vehicles.importers.coefficients:COEFFICIENTS",
        "vehicle.holoocean": "finssim.vehicles.importers.holoocean:HOLOOCEAN",
        "vehicle.marinegym": "finssim.vehicles.importers.marinegym:MARINEGYM",
        "vehicle.sdf": "finssim.vehicles.importers.sdf:SDF",
        "vehicle.urdf": "finssim.vehicles.importers.urdf:URDF",
        "vehicle.stonefish": "finssim.vehicles.importers.stonefish:STONEFISH",
        "trial.qgroundcontrol": "finssim.trials.importers.table:QGROUNDCONTROL",
        "trial.acoustic": "finssim.trials.importers.table:ACOUSTIC",
        "trial.waterlinked_csv": "finssim.trials.importers.table:WATER_LINKED",
        "trial.waterlinked_period_csv": "finssim.trials.importers.table:WATER_LINKED_PERIOD",
        "trial.waterlinked": "finssim.trials.importers.water_linked:WATER_LINKED",
        "trial.ulog": "finssim.trials.importers.ulog:ULOG",
        "trial.ardupilot": "finssim.trials.importers.ardusub:ARDUPILOT",
        "trial.rosbag": "finssim.trials.importers.bag:ROSBAG",
        "trial.csv": "finssim.trials.importers.table:TABLE",
        "lens.ros": "finssim.localization.importers.calibration:ROS",
        "lens.kalibr": "finssim.localization.importers.calibration:KALIBR",
        "lens.matlab": "finssim.localization.importers.calibration:MATLAB",
        "lens.nerfstudio": "finssim.localization.importers.reconstruction:NERFSTUDIO",
        "lens.orb_slam": "finssim.localization.importers.reconstruction:ORB_SLAM",
        "lens.colmap": "finssim.localization.importers.reconstruction:COLMAP",
        "lens.opencv": "finssim.localization.importers.calibration:OPENCV",
    },
    check="finssim.core.importer:check_registered",
)
"""Kind of content, a dot, and the format -> the `Importer` of `finssim.core.importer`."""

FAMILIES: tuple[Family, ...] = (
    VEHICLES,
    TASKS,
    SENSORS,
    TERMS,
    ACTUATORS,
    LEARNERS,
    COMMANDS,
    WORLDS,
    IMPORTERS,
)
"""All families."""
