"""Docking by camera: find a dock in the picture, enter its funnel nose first, gently, and stay in its tube."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import warp as wp

from finssim.engine import Dock, Pool
from finssim.engine.state import State
from finssim.tasks import docking
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.docking import Docking
from finssim.tasks.given import EnvironmentSetupError
from finssim.tasks.sight import Picture
from finssim.tasks.terms import ObservationPart, Terms, own_velocity
from finssim.vehicles import Vehicle

MOUTH, THROAT, CONE, TUBE = 0.745, 0.32, 0.75, 0.93
"""Inner radii of the funnel of the site `dock`, its length, and that of its tube up to the plate [m]."""
DEPTH_SCALE = 5.0
"""The depth is divided by this in the observation [m]."""


@wp.func
def up(arrays: TaskArrays, w: int, a: int) -> wp.vec3:
    """The world's up, body frame."""
    return wp.quat_rotate_inv(arrays.quaternion[w, a], wp.vec3(0.0, 0.0, 1.0))


OWN = (
    ObservationPart("up, body frame", 3, "1", term=up),
    *own_velocity(clip=2.0),
    ObservationPart("depth", 1, "m", scale=DEPTH_SCALE, term="-arrays.position[w, a][2]"),
)
"""What a vehicle knows by its own sensors, wherever it is."""


@dataclass(frozen=True, kw_only=True)
class CameraDocking(Docking):
    """Docking into the dock of the site `dock`, which stands, looks and is lit otherwise in each episode.

    The row of numbers holds attitude, velocity and depth alone: where the dock is, the picture shows. What `docking`
    observes is `teacher`, for who may know it in training.
    """

    title: ClassVar[str] = "dock by camera"
    landmark: ClassVar[str] = "dock"
    teacher: ClassVar[tuple[ObservationPart, ...]] = docking.OBSERVATION
    name: str = "camera-docking"
    observation: tuple[ObservationPart, ...] = OWN
    world: str = "dock"
    pictures: tuple[Picture, ...] = (Picture("front_camera", 48),)
    held_out: bool = False
    """Draw the looks of the site that are held out of training."""
    time_limit: float = 30.0
    cone: float = math.atan((MOUTH - THROAT) / CONE)
    berth: float = 0.55
    inside: float = 0.3
    start: tuple[float, float] = (2.0, 4.5)
    start_aside: tuple[float, float] = (1.2, 0.6)
    turn: float = math.radians(15.0)
    tilt: float = math.radians(4.0)
    tank: tuple[float, float] = (10.0, 6.0)

    def fitted(self, vehicles: Sequence[Vehicle]) -> "CameraDocking":
        """For the vehicle, if it fits into the dock."""
        fitted = replace(self, hull=docking.Hull.of(vehicles[0]))
        if fitted.hull.girth > 0.95 * THROAT:
            raise EnvironmentSetupError(
                f"vehicle '{vehicles[0].name}' is {2.0 * fitted.hull.girth:.2f} m across its corners, and the dock of "
                f"site 'dock' takes {2.0 * 0.95 * THROAT:.2f} m: take a slimmer one, such as finsrov"
            )
        return fitted

    def dock(self) -> Dock:
        """The funnel that the picture shows, with stiffness and damping as of `Docking`."""
        return replace(
            super().dock(),
            mouth_radius=MOUTH, throat_radius=THROAT, cone_length=CONE, tube_length=TUBE, rim=0.06,
        )  # fmt: skip

    def arena(self) -> Pool:
        """Up to the quay and the bottom; without the world, where the dock looks any way, as wide as long."""
        return replace(super().arena(), length=24.0, width=7.8 if self.placed else 24.0, depth=4.95)

    @property
    def placed(self) -> bool:
        """Whether a world says where the dock is."""
        return bool(self.world)

    def terms(self) -> Terms:
        """Those of `Docking`."""
        return replace(super().terms(), start=start)


@wp.func
def start(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """The dock where the world has it, or where `Docking` draws it, and a vehicle at rest before its mouth."""
    x = arrays.goal_position[w]
    q = arrays.goal_quaternion[w]
    docking.start(state, arrays, p, key, w)
    if p.placed:
        back = wp.quat_inverse(arrays.goal_quaternion[w])
        state.position[w, 0] = x + wp.quat_rotate(q * back, state.position[w, 0] - arrays.goal_position[w])
        state.quaternion[w, 0] = q * back * state.quaternion[w, 0]
        arrays.goal_position[w] = x
        arrays.goal_quaternion[w] = q
