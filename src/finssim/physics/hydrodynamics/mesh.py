"""Drag and displacement of a closed triangle mesh that the water surface cuts (paper, eq. 3-4).

The water surface is a plane in body axes: its upward normal and the signed height of the body origin above it.
"""
# mypy: disable-error-code="call-overload,valid-type,no-untyped-call,misc,attr-defined,operator,no-any-return"
# mypy: disable-error-code="assignment,arg-type"

from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from finssim.core.mesh import check_closed, face_geometry, mesh_centroid, mesh_volume
from finssim.physics.hydrostatics import BodyMotion, WaterWrench, hydrostatic_wrench
from finssim.physics.lanes import sum_in_lanes
from finssim.physics.plant import VehicleParameters
from finssim.physics.types import angular, join, linear, mat66, vec6, vec8
from finssim.physics.water import Flow, WaterArrays


@wp.struct
class HullMesh:
    """Closed hulls of one or several kinds of vehicle, body frame; hull k consists of faces start[k] to start[k +
    1]."""

    start: wp.array(dtype=wp.int32)
    """First face of each hull, and last the total number of faces (kinds + 1,)."""
    volume: wp.array(dtype=wp.float32)
    """Enclosed volume (kinds,) [m³]."""
    centroid: wp.array(dtype=wp.vec3)
    """Centroid of the enclosed volume (kinds,) [m]."""
    box_center: wp.array(dtype=wp.vec3)
    """Centre of the hull's bounding box (kinds,) [m]."""
    box_half: wp.array(dtype=wp.vec3)
    """Half lengths of the bounding box (kinds,) [m]."""
    face: wp.array(dtype=vec8)
    """Centroid [m], outward unit normal and area [m²] of each face (faces,), together for one memory read; then 0."""
    slope_form: wp.array(dtype=mat66)
    """Slope of the form drag on each axis, with the columns of `drag_slope` (kinds,), for a density and a coefficient
    of 1 [m², m³, m⁴ and m⁵]."""
    slope_skin: wp.array(dtype=mat66)
    """Slope of the skin drag on each axis, with the columns of `drag_slope` (kinds,), for a density and a coefficient
    of 1 [m², m³, m⁴ and m⁵]."""
    corners: wp.array(dtype=wp.mat33)
    """Corners of each face, one per row (faces,) [m]; only used near the surface."""


def hull_mesh(hulls: Sequence[tuple[ArrayLike, ArrayLike]], device: str | None = None) -> HullMesh:
    """Return closed hulls as the arrays that the mesh functions read.

    Args:
        hulls: For each kind of vehicle its vertices (n, 3) [m], body frame, and outward faces (m, 3).
        device: Warp device; None is the default device.

    Returns:
        The hulls in float32; kind k is the k-th of `hulls`.

    Raises:
        MeshError: A hull is not closed, or its faces do not point outward.
    """
    start, volume, centroid, box_center, box_half, face, corners = [0], [], [], [], [], [], []
    form, skin = [], []
    for vertices, faces in hulls:
        points, triangles = np.asarray(vertices, np.float64), np.asarray(faces)
        check_closed(points, triangles)
        normal, area, middle = face_geometry(points, triangles)
        low, high = points[triangles].min(axis=(0, 1)), points[triangles].max(axis=(0, 1))
        start.append(start[-1] + len(triangles))
        volume.append(mesh_volume(points, triangles))
        centroid.append(mesh_centroid(points, triangles))
        box_center.append((low + high) / 2.0)
        box_half.append((high - low) / 2.0)
        face.append(np.column_stack([middle, normal, area, np.zeros(len(area))]))
        corners.append(points[triangles])
        slopes = _slopes(middle, normal, area)
        form.append(slopes[0])
        skin.append(slopes[1])

    result = HullMesh()
    result.start = wp.array(start, dtype=wp.int32, device=device)
    result.volume = wp.array(volume, dtype=wp.float32, device=device)
    result.centroid = wp.array(np.array(centroid), dtype=wp.vec3, device=device)
    result.box_center = wp.array(np.array(box_center), dtype=wp.vec3, device=device)
    result.box_half = wp.array(np.array(box_half), dtype=wp.vec3, device=device)
    result.face = wp.array(np.concatenate(face), dtype=vec8, device=device)
    result.slope_form = wp.array(np.array(form), dtype=mat66, device=device)
    result.slope_skin = wp.array(np.array(skin), dtype=mat66, device=device)
    result.corners = wp.array(np.concatenate(corners), dtype=wp.mat33, device=device)
    return result


def _slopes(
    middle: NDArray[np.float64], normal: NDArray[np.float64], area: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Return the slope of form and skin drag over speed on each axis, (6, 6) each: column 0 per |v|, column 1 per |ω|.

    A face at c moves along s = e_i or e_i × c with axis i, and its drag grows with its speed |v| + |c| |ω|. The slope
    of the form drag is at most |n·s| |s| + |s|² [n·v]_+/|v|; the means of its terms over all flow directions are a half
    and a quarter. The slope of the skin drag is at most 2 |s|².
    """
    turning = np.stack([np.cross(e, middle) for e in np.eye(3)], axis=1)
    s = np.concatenate([np.broadcast_to(np.eye(3), turning.shape), turning], axis=1)  # (faces, 6, 3)
    size = np.linalg.norm(s, axis=-1)
    across = np.abs((s @ normal[..., None])[..., 0])
    out = []
    for growth in (0.5 * across * size + 0.25 * size**2, 2.0 * size**2):
        table = np.zeros((6, 6))
        table[:, 0] = area @ growth
        table[:, 1] = (area * np.linalg.norm(middle, axis=1)) @ growth
        out.append(table)
    return out


@wp.func
def drag_slope(hull: HullMesh, kind: int, nu_r: vec6, density: float, form: float, skin: float) -> vec6:
    """Estimate the slope of the drag of a submerged hull over the speed on each axis [N s/m, N m s/rad].

    Args:
        hull: The hulls.
        kind: Index of the hull.
        nu_r: Twist relative to the water, body frame [m/s, rad/s].
        density: Density of the water [kg/m³].
        form: Form drag coefficient [-].
        skin: Skin drag coefficient [-].
    """
    x = vec6(wp.length(linear(nu_r)), wp.length(angular(nu_r)), 0.0, 0.0, 0.0, 0.0)
    return 0.5 * density * (form * (hull.slope_form[kind] * x) + skin * (hull.slope_skin[kind] * x))


@wp.func
def wet_corner(a: wp.vec3, b: wp.vec3, c: wp.vec3, h_a: float, h_b: float, h_c: float) -> wp.vec4:
    """Return centroid and area fraction of the part at a, the only corner below the surface (h_a < 0)."""
    s = h_a / (h_a - h_b)
    t = h_a / (h_a - h_c)
    m = a + (s * (b - a) + t * (c - a)) / 3.0
    return wp.vec4(m[0], m[1], m[2], s * t)


@wp.func
def wet_side(a: wp.vec3, b: wp.vec3, c: wp.vec3, h_a: float, h_b: float, h_c: float) -> wp.vec4:
    """Return centroid and area fraction of the part at b and c, where a is the only corner above the surface (h_a >
    0)."""
    s = h_b / (h_b - h_a)
    t = h_c / (h_c - h_a)
    p = b + s * (a - b)
    q = c + t * (a - c)
    # As two triangles (b, c, q) and (b, q, p): a difference of areas would lose accuracy for a small part.
    first = t
    second = s * (1.0 - t)
    m = b + (first * (c - b + q - b) + second * (q - b + p - b)) / (3.0 * wp.max(first + second, 1.0e-30))
    return wp.vec4(m[0], m[1], m[2], first + second)


@wp.func
def wet_part(corners: wp.mat33, surface_normal: wp.vec3, surface_height: float) -> wp.vec4:
    """Return the part of a triangle below the water surface.

    Args:
        corners: Corners a, b, c, one per row, body frame [m].
        surface_normal: Upward unit normal of the surface [-], body frame.
        surface_height: Height of the body origin above the surface [m].

    Returns:
        Centroid of the part, body frame [m], and its fraction of the triangle's area, 0 to 1.
    """
    a = corners[0]
    b = corners[1]
    c = corners[2]
    h_a = surface_height + wp.dot(surface_normal, a)
    h_b = surface_height + wp.dot(surface_normal, b)
    h_c = surface_height + wp.dot(surface_normal, c)
    if h_a >= 0.0 and h_b >= 0.0 and h_c >= 0.0:
        return wp.vec4(0.0)
    if h_a <= 0.0 and h_b <= 0.0 and h_c <= 0.0:
        m = (a + b + c) / 3.0
        return wp.vec4(m[0], m[1], m[2], 1.0)
    # The corners are rotated cyclically so that the single corner is first.
    if h_a < 0.0 and h_b >= 0.0 and h_c >= 0.0:
        return wet_corner(a, b, c, h_a, h_b, h_c)
    if h_b < 0.0 and h_c >= 0.0 and h_a >= 0.0:
        return wet_corner(b, c, a, h_b, h_c, h_a)
    if h_c < 0.0 and h_a >= 0.0 and h_b >= 0.0:
        return wet_corner(c, a, b, h_c, h_a, h_b)
    if h_a > 0.0:
        return wet_side(a, b, c, h_a, h_b, h_c)
    if h_b > 0.0:
        return wet_side(b, c, a, h_b, h_c, h_a)
    return wet_side(c, a, b, h_c, h_a, h_b)


@wp.func
def face_drag(v: wp.vec3, normal: wp.vec3, form: float, skin: float) -> wp.vec3:
    """Return form and skin drag per area on a face in the flow v                           (paper, eq. 4)

    form [-μ]_+ v |v| + skin v_t |v_t|,  μ = n·v / |v|,  v_t = (I - n nᵀ) v

    Args:
        v: Velocity of the water relative to the face, body frame [m/s].
        normal: Outward unit normal of the face [-], body frame.
        form: ½ ρ C_form [kg/m³].
        skin: ½ ρ C_skin [kg/m³].

    Returns:
        Force per area, body frame [N/m²].
    """
    across = wp.dot(normal, v)
    v_t = v - across * normal
    # |v| cancels with the one in μ.
    return form * wp.max(-across, 0.0) * v + skin * wp.length(v_t) * v_t


@wp.func
def wet_face_drag(
    i: int, hull: HullMesh, v_origin: wp.vec3, turn: wp.mat33, form: float, skin: float
) -> vec6:
    """Return the drag of face i, completely submerged, about the body origin [N, N m]; see `mesh_drag` and
    `face_drag`."""
    f = hull.face[i]
    c = wp.vec3(f[0], f[1], f[2])
    pull = f[6] * face_drag(v_origin + turn * c, wp.vec3(f[3], f[4], f[5]), form, skin)
    return join(pull, wp.cross(c, pull))


@wp.func
def faces_drag(
    first: int, end: int, hull: HullMesh, v_origin: wp.vec3, turn: wp.mat33, form: float, skin: float
) -> vec6:
    """Return the sum of `wet_face_drag` over the faces from `first` to before `end` [N, N m]."""
    tau = vec6()
    for i in range(first, end):
        tau += wet_face_drag(i, hull, v_origin, turn, form, skin)
    return tau


sum_in_lanes(faces_drag, wet_face_drag)


@wp.func
def mesh_drag(
    hull: HullMesh,
    kind: int,
    nu: vec6,
    v_water: wp.vec3,
    flow_gradient: wp.mat33,
    density: float,
    form_drag: float,
    skin_drag: float,
    surface_normal: wp.vec3,
    surface_height: float,
) -> vec6:
    """Return form and skin drag over the submerged part of the hull                        (paper, eq. 3-4)

    The flow at a face is v_i = v_water + G c_i - (v + ω × c_i), at the centroid c_i of its submerged part.

    Args:
        hull: The hulls.
        kind: Index of the hull.
        nu: Twist of the body at its origin, body frame [m/s, rad/s].
        v_water: Velocity of the water at the body origin, body frame [m/s].
        flow_gradient: G, spatial derivative of the water's velocity, body frame [1/s].
        density: ρ [kg/m³].
        form_drag: C_form [-].
        skin_drag: C_skin [-].
        surface_normal: Upward unit normal of the water surface [-], body frame.
        surface_height: Height of the body origin above the surface along that normal, negative below [m].

    Returns:
        Wrench about the body origin, body frame [N, N m].
    """
    form = 0.5 * density * form_drag
    skin = 0.5 * density * skin_drag
    v_origin = v_water - linear(nu)
    turn = flow_gradient - wp.skew(angular(nu))
    force = wp.vec3(0.0)
    moment = wp.vec3(0.0)

    middle = surface_height + wp.dot(surface_normal, hull.box_center[kind])
    reach = wp.dot(wp.abs(surface_normal), hull.box_half[kind])
    if middle + reach <= 0.0:
        return faces_drag(hull.start[kind], hull.start[kind + 1], hull, v_origin, turn, form, skin)
    elif middle - reach < 0.0:
        for i in range(hull.start[kind], hull.start[kind + 1]):
            wet = wet_part(hull.corners[i], surface_normal, surface_height)
            if wet[3] > 0.0:
                f = hull.face[i]
                c = wp.vec3(wet[0], wet[1], wet[2])
                pull = wet[3] * f[6] * face_drag(v_origin + turn * c, wp.vec3(f[3], f[4], f[5]), form, skin)
                force += pull
                moment += wp.cross(c, pull)
    return join(force, moment)


@wp.func
def mesh_displacement(hull: HullMesh, kind: int, surface_normal: wp.vec3, surface_height: float) -> wp.vec4:
    """Return volume and centroid of the submerged part of the hull.

    The volume is the sum, over the submerged parts of the faces, of pyramids with apex P on the surface:
    V_i = A_i n_i·(c_i - P)/3, with centroid P + 3/4 (c_i - P). The cut through the hull lies in the surface, as P does,
    so its pyramid is zero.

    Args:
        hull: The hulls.
        kind: Index of the hull.
        surface_normal: Upward unit normal of the water surface [-], body frame.
        surface_height: Height of the body origin above the surface along that normal, negative below [m].

    Returns:
        Volume [m³] and its centroid, body frame [m]; zeros if the hull is above the surface.
    """
    center = hull.box_center[kind]
    middle = surface_height + wp.dot(surface_normal, center)
    reach = wp.dot(wp.abs(surface_normal), hull.box_half[kind])
    if middle + reach <= 0.0:
        c = hull.centroid[kind]
        return wp.vec4(hull.volume[kind], c[0], c[1], c[2])
    if middle - reach >= 0.0:
        return wp.vec4(0.0)

    # With the apex at the surface point nearest to the hull centre, pyramids are small enough for float32.
    apex = center - middle * surface_normal
    volume = float(0.0)
    moment = wp.vec3(0.0)
    for i in range(hull.start[kind], hull.start[kind + 1]):
        wet = wet_part(hull.corners[i], surface_normal, surface_height)
        if wet[3] > 0.0:
            f = hull.face[i]
            arm = wp.vec3(wet[0], wet[1], wet[2]) - apex
            pyramid = wet[3] * f[6] * wp.dot(wp.vec3(f[3], f[4], f[5]), arm) / 3.0
            volume += pyramid
            moment += pyramid * arm
    # Below float32's resolution of the total volume, the quotient of two rounding errors is meaningless.
    if volume <= 1.0e-7 * hull.volume[kind]:
        return wp.vec4(0.0)
    c = apex + 0.75 * moment / volume
    return wp.vec4(volume, c[0], c[1], c[2])


@wp.func
def mesh_inflow(
    hull: HullMesh, kind: int, nu_r: vec6, surface_normal: wp.vec3, surface_height: float
) -> float:
    """Return the rate at which the submerged volume grows: the volume swept by the wet faces, ∫ n·(v + ω × c) dA.

    Args:
        hull: The hulls.
        kind: Index of the hull.
        nu_r: Twist of the body at its origin relative to the water, body frame [m/s, rad/s].
        surface_normal: Upward unit normal of the water surface [-], body frame.
        surface_height: Height of the body origin above the surface along that normal, negative below [m].

    Returns:
        Rate [m³/s]; 0, up to rounding, for a hull that is completely above or below the surface.
    """
    v = linear(nu_r)
    omega = angular(nu_r)
    inflow = float(0.0)
    for i in range(hull.start[kind], hull.start[kind + 1]):
        wet = wet_part(hull.corners[i], surface_normal, surface_height)
        if wet[3] > 0.0:
            f = hull.face[i]
            c = wp.vec3(wet[0], wet[1], wet[2])
            inflow += wet[3] * f[6] * wp.dot(wp.vec3(f[3], f[4], f[5]), v + wp.cross(omega, c))
    return inflow


# Physics-mesh hydrodynamics (paper, eq. 3-4), as a model of the simulator.


@wp.func
def mesh_wrench(
    plant: wp.array2d(dtype=VehicleParameters),
    hull: HullMesh,
    water: WaterArrays,
    w: int,
    v: int,
    body: BodyMotion,
    flow: Flow,
) -> WaterWrench:
    """Return the wrench on the part of a hull mesh below the instantaneous surface: buoyancy, form drag and skin drag.

    The surface is the plane tangent to the waves above the body origin; the water's velocity varies linearly over the
    hull. Displaced volume and centre of buoyancy of the submerged vehicle are those of the vehicle file; the mesh
    determines how they change at the surface, so a mesh without the vehicle's interior also floats correctly.

    Args:
        plant: Parameters.
        hull: Hull meshes.
        water: Density and gravity.
        w: World.
        v: Vehicle.
        body: Pose and motion.
        flow: Water at the body origin.

    Returns:
        Wrench about the body origin, mass of displaced water and submerged fraction.
    """
    kind = plant[w, v].hull
    normal = body.up
    G = wp.mat33(0.0)
    if water.moving != 0:
        normal = wp.quat_rotate_inv(body.q, flow.normal)
        R = wp.quat_to_matrix(body.q)
        G = wp.transpose(R) * flow.gradient * R
    height = flow.normal[2] * (body.position[2] - flow.elevation)
    wet = mesh_displacement(hull, kind, normal, height)
    out = WaterWrench()
    out.wet = wet[0] / hull.volume[kind]
    water_b = linear(body.nu) - linear(body.nu_r)
    if out.wet > 0.0 and out.wet < 1.0:
        out.wet_rate = mesh_inflow(hull, kind, body.nu_r, normal, height) / hull.volume[kind]
    out.displaced = water.density * plant[w, v].volume * out.wet
    center = wp.vec3(wet[1], wet[2], wet[3]) + plant[w, v].r_b - hull.centroid[kind]
    weight = plant[w, v].mass * water.gravity
    tau = hydrostatic_wrench(weight, out.displaced * water.gravity, plant[w, v].r_g, center, body.up)
    form = plant[w, v].form_drag
    tau += mesh_drag(
        hull, kind, body.nu, water_b, G, water.density, form, plant[w, v].skin_drag, normal, height
    )
    out.tau = tau
    return out
