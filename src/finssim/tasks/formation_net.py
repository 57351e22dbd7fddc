"""A triangular net between three vehicles: how far something is from its surface, and how it is stretched."""

import warp as wp


@wp.func
def triangle_distance(x: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> float:
    """Distance from a point to a triangle [m].

    The nearest point by the region of the triangle that the point lies before: a corner, an edge or the inside
    (Ericson, Real-Time Collision Detection, section 5.1.5).
    """
    ab = b - a
    ac = c - a
    d1 = wp.dot(ab, x - a)
    d2 = wp.dot(ac, x - a)
    d3 = wp.dot(ab, x - b)
    d4 = wp.dot(ac, x - b)
    d5 = wp.dot(ab, x - c)
    d6 = wp.dot(ac, x - c)
    va = d3 * d6 - d5 * d4
    vb = d5 * d2 - d1 * d6
    vc = d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        return wp.length(x - a)
    if d3 >= 0.0 and d4 <= d3:
        return wp.length(x - b)
    if d6 >= 0.0 and d5 <= d6:
        return wp.length(x - c)
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return wp.length(x - a - (d1 / (d1 - d3)) * ab)
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return wp.length(x - a - (d2 / (d2 - d6)) * ac)
    if va <= 0.0 and d4 >= d3 and d5 >= d6:
        return wp.length(x - b - ((d4 - d3) / ((d4 - d3) + (d5 - d6))) * (c - b))
    whole = va + vb + vc
    return wp.length(x - a - (vb / whole) * ab - (vc / whole) * ac)


@wp.func
def sorted_edges(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec3:
    """Lengths of a triangle's edges, the shortest first [m]."""
    ab = wp.length(b - a)
    bc = wp.length(c - b)
    ca = wp.length(a - c)
    least = wp.min(ab, wp.min(bc, ca))
    most = wp.max(ab, wp.max(bc, ca))
    return wp.vec3(least, ab + bc + ca - least - most, most)
