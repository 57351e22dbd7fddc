"""The pull of a slack tether: none until it is nearly straight. Its drag and weight are the engine's `TetherLine`."""
# mypy: disable-error-code="valid-type,misc,no-any-return,no-untyped-def,untyped-decorator,arg-type"

import warp as wp

from finssim.engine import TetherLine
from finssim.physics.types import join, vec6
from finssim.pool.water_spec import SlackTether


@wp.struct
class Slack:
    """A line that pulls only near its full length; a stiffness of 0 means none."""

    anchor: wp.vec3  # world frame [m]
    attachment: wp.vec3  # body frame [m]
    start: float  # distance at which the pull sets in [m]
    stretch: float  # from there to straight [m]
    stiffness: float  # when straight [N/m]


@wp.func
def slack_pull(line: Slack, position: wp.vec3, q: wp.quat) -> vec6:
    """Wrench of the line on the vehicle about its origin, body frame [N, N m].

    With e the distance beyond the start and s the stretch to straight: F = k e²/(2 s) for e < s, then k (e - s/2). The
    pull derives from a potential, so over a closed path it does no work.

    Args:
        line: The line.
        position: Body origin, world frame [m].
        q: Attitude, body to world.
    """
    if line.stiffness <= 0.0:
        return vec6()
    along = line.anchor - position - wp.quat_rotate(q, line.attachment)
    distance = wp.length(along)
    e = distance - line.start
    if e <= 0.0:
        return vec6()
    pull = line.stiffness * wp.where(e < line.stretch, 0.5 * e * e / line.stretch, e - 0.5 * line.stretch)
    force = wp.quat_rotate_inv(q, along * (pull / distance))
    return join(force, wp.cross(line.attachment, force))


def slack_line(tether: SlackTether | None) -> Slack:
    """The struct that kernels take."""
    line = Slack()
    if tether is not None:
        line.anchor, line.attachment = wp.vec3(*tether.anchor), wp.vec3(*tether.attachment)
        line.stretch = tether.slack_share * tether.length
        line.start = tether.length - line.stretch
        line.stiffness = tether.stiffness
    return line


def dragged_line(tether: SlackTether | None) -> TetherLine | None:
    """Drag and weight of the line, for the engine."""
    if tether is None:
        return None
    return TetherLine(
        anchor=tether.anchor,
        attachment=tether.attachment,
        diameter=tether.diameter,
        drag_coefficient=tether.drag_coefficient,
        wet_weight=tether.wet_weight,
    )
