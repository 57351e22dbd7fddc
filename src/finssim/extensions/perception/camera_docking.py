"""Docking by camera: the funnel is located in the picture."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import warp as wp

from finssim.extensions.perception.seeing import SeeingTask
from finssim.sim import Dock, RectangularPool
from finssim.sim.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.docking import OBSERVATION, Docking, HullNumbers, start
from finssim.tasks.terms import ObservationPart, Terms
from finssim.tasks.validation import EnvironmentSetupError
from finssim.vehicles import Vehicle

MOUTH, THROAT, CONE, TUBE = 0.745, 0.32, 0.75, 0.93
"""Inner radii of the funnel of the site `dock` at mouth and throat, its length, and that of its tube up to
the plate [m]."""


@wp.func
def start_at_site(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """Place the dock at its pose in the world, or as `Docking` draws it, and a vehicle at rest in front of
    its mouth."""
    x = arrays.goal_position[w]
    q = arrays.goal_quaternion[w]
    start(state, arrays, p, key, w)
    if p.placed:
        back = wp.quat_inverse(arrays.goal_quaternion[w])
        state.position[w, 0] = x + wp.quat_rotate(q * back, state.position[w, 0] - arrays.goal_position[w])
        state.quaternion[w, 0] = q * back * state.quaternion[w, 0]
        arrays.goal_position[w] = x
        arrays.goal_quaternion[w] = q


@dataclass(frozen=True, kw_only=True)
class CameraDocking(SeeingTask, Docking):
    """Docking into the dock of the site `dock`, whose pose, appearance and light differ in each episode.

    The observed numbers are only attitude, velocity and depth; the dock's position must be inferred from the
    picture. The observation of `docking` is the privileged observation `teacher` for training.
    """

    title: ClassVar[str] = "dock by camera"
    landmark: ClassVar[str] = "dock"
    teacher: ClassVar[tuple[ObservationPart, ...]] = OBSERVATION
    baselines: ClassVar = {"light-servo": "finssim.extensions.perception.servos:LightServo"}
    name: str = "camera-docking"
    world: str = "dock"
    time_limit: float = 30.0
    cone: float = math.atan((MOUTH - THROAT) / CONE)
    berth: float = 0.55
    inside: float = 0.3
    start: tuple[float, float] = (2.0, 4.5)
    start_aside: tuple[float, float] = (1.2, 0.6)
    turn: float = math.radians(15.0)
    tank: tuple[float, float] = (10.0, 6.0)

    def fitted(self, vehicles: Sequence[Vehicle]) -> "CameraDocking":
        """Return the task for the vehicle, if it fits into the dock."""
        fitted = replace(self, hull=HullNumbers.of(vehicles[0]))
        if fitted.hull.girth > 0.95 * THROAT:
            raise EnvironmentSetupError(
                f"vehicle '{vehicles[0].name}' is {2.0 * fitted.hull.girth:.2f} m across its corners, and the dock of "
                f"site 'dock' takes {2.0 * 0.95 * THROAT:.2f} m: take a slimmer one, such as finsrov"
            )
        return fitted

    def dock(self) -> Dock:
        """Return the funnel of the site, with stiffness and damping as in `Docking`."""
        return replace(
            super().dock(),
            mouth_radius=MOUTH, throat_radius=THROAT, cone_length=CONE, tube_length=TUBE, rim=0.06,
        )  # fmt: skip

    def arena(self) -> RectangularPool:
        """Return the arena up to the quay and the bottom; without the world it is square, since the dock may
        face any direction."""
        return replace(Docking.arena(self), length=24.0, width=7.8 if self.placed else 24.0, depth=4.95)

    def terms(self) -> Terms:
        """Return the terms of `Docking`."""
        return replace(super().terms(), start=start_at_site)
