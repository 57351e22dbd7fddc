"""The net between two netters: a rectangle that hangs from one to the other, and how far something is from it."""

import warp as wp


@wp.func
def net_distance(x: wp.vec3, left: wp.vec3, right: wp.vec3, height: float) -> float:
    """Distance from a point to the net's surface [m].

    The net reaches from one netter to the other; half its height lies above that line and half below, along the
    direction across the line that is nearest to upright; with the netters one above the other it shrinks to the line.

    Args:
        x: The point, world frame [m].
        left: One netter.
        right: The other.
        height: Of the net [m].
    """
    span = right - left
    length = wp.max(wp.length(span), 1.0e-6)
    along = span / length
    up = wp.vec3(0.0, 0.0, 1.0) - along[2] * along
    rise = wp.length(up)
    up = up / wp.max(rise, 1.0e-3)
    gap = x - left
    s = wp.clamp(wp.dot(gap, along), 0.0, length)
    t = wp.clamp(wp.dot(gap, up), -0.5 * height, 0.5 * height)
    return wp.length(gap - s * along - t * up)
