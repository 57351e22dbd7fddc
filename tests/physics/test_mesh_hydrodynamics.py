"""Drag and displacement of a hull mesh against closed forms, exact booleans and the laws they must keep."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import finssim
from finssim.core.mesh import MeshError, load_stl, mesh_volume, parametric_hull
from finssim.physics.hydrodynamics.mesh import HullMesh, hull_mesh, mesh_displacement, mesh_drag
from finssim.physics.types import vec6

wp.set_module_options({"enable_backward": False})

RHO = 1027.0
DEEP = -100.0
FORM, SKIN = 1.1, 0.02
NO_SHEAR = np.zeros((3, 3))


@wp.kernel
def drag_kernel(
    hull: HullMesh,
    kind: int,
    nu: wp.array(dtype=vec6),
    v_water: wp.array(dtype=wp.vec3),
    gradient: wp.array(dtype=wp.mat33),
    normal: wp.array(dtype=wp.vec3),
    height: wp.array(dtype=float),
    form: float,
    skin: float,
    tau: wp.array(dtype=vec6),
):
    i = wp.tid()
    tau[i] = mesh_drag(hull, kind, nu[i], v_water[i], gradient[i], 1027.0, form, skin, normal[i], height[i])


@wp.kernel
def displacement_kernel(
    hull: HullMesh,
    kind: int,
    normal: wp.array(dtype=wp.vec3),
    height: wp.array(dtype=float),
    result: wp.array(dtype=wp.vec4),
):
    i = wp.tid()
    result[i] = mesh_displacement(hull, kind, normal[i], height[i])


def drag(
    hull, nu=(0,) * 6, v_water=(0,) * 3, gradient=NO_SHEAR, normal=(0, 0, 1), height=DEEP,
    form=FORM, skin=SKIN, kind=0, device="cpu",
):  # fmt: skip
    """Return wrenches (..., 6) of `mesh_drag` for arguments with any common leading shape."""
    hull = hull_mesh([hull], device) if isinstance(hull, tuple) else hull
    arguments = [(nu, (6,)), (v_water, (3,)), (gradient, (3, 3)), (normal, (3,)), (height, ())]
    arrays = [np.asarray(a, np.float32) for a, _ in arguments]
    batch = np.broadcast_shapes(
        *[a.shape[: a.ndim - len(t)] for a, (_, t) in zip(arrays, arguments, strict=True)]
    )
    flat = [
        np.ascontiguousarray(np.broadcast_to(a, batch + t)).reshape(-1, *t)
        for a, (_, t) in zip(arrays, arguments, strict=True)
    ]
    types = [vec6, wp.vec3, wp.mat33, wp.vec3, wp.float32]
    inputs = [wp.array(a, dtype=t, device=device) for a, t in zip(flat, types, strict=True)]
    tau = wp.empty(len(flat[0]), dtype=vec6, device=device)
    wp.launch(drag_kernel, len(tau), [hull, kind, *inputs, form, skin], [tau], device=device)
    return tau.numpy().astype(float).reshape(*batch, 6)


def displacement(hull, normal, height, kind=0, device="cpu"):
    """Return volumes (n,) and centroids (n, 3) of `mesh_displacement` for normals (n, 3) and heights (n,)."""
    hull = hull_mesh([hull], device) if isinstance(hull, tuple) else hull
    inputs = [
        wp.array(np.asarray(normal, np.float32), dtype=wp.vec3, device=device),
        wp.array(np.asarray(height, np.float32), dtype=float, device=device),
    ]
    result = wp.empty(len(inputs[1]), dtype=wp.vec4, device=device)
    wp.launch(displacement_kernel, len(result), [hull, kind, *inputs], [result], device=device)
    result = result.numpy().astype(float)
    return result[:, 0], result[:, 1:]


def box(size, center=(0.0, 0.0, 0.0)):
    return parametric_hull(size, float(np.prod(size)), center)


def fine_box(size, times):
    """Return a box whose faces are split into four, `times` times."""
    mesh = trimesh.creation.box(size)
    for _ in range(times):
        mesh = mesh.subdivide()
    return np.array(mesh.vertices), np.array(mesh.faces)


def sphere(radius, times):
    mesh = trimesh.creation.icosphere(subdivisions=times, radius=radius)
    return np.array(mesh.vertices), np.array(mesh.faces)


def rexrov():
    """The mesh of the catalogue: four bodies that touch."""
    return load_stl(Path(finssim.__file__).parent / "vehicles" / "catalogue" / "meshes" / "rexrov.stl")


FINSROV = parametric_hull((0.56, 0.42, 0.25), 0.0118, (0.0, 0.0, 0.03))


def random_surfaces(n, reach, seed):
    """Return unit normals (n, 3) over the sphere and heights (n,) of the body origin within ± reach."""
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(n, 3))
    return normal / np.linalg.norm(normal, axis=1, keepdims=True), rng.uniform(-reach, reach, n)


def parts_of(hull):
    """Return the separate bodies of a hull, which touch or overlap in RexROV's."""
    return trimesh.Trimesh(*hull, process=False).split()


def wet_boolean(part, normal, height):
    """Return the part of a mesh below the plane normal·x + height = 0, by an exact boolean with a large box."""
    side = 10.0
    below = trimesh.creation.box([side, side, side])
    below.apply_translation([0.0, 0.0, -0.5 * side])
    below.apply_transform(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], normal))
    below.apply_translation(-height * normal)
    return trimesh.boolean.intersection([part, below], engine="manifold", check_volume=False)


# ---- displacement


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hull", "reach"), [(lambda: FINSROV, 0.3), (rexrov, 1.5)], ids=["finsrov", "rexrov"]
)
def test_displacement_is_that_of_the_boolean(hull, reach):
    """At 300 random poses volume and first moment are those of the hull cut by an exact boolean.

    Tolerance: float32 over about 300 pyramids, 3e-6 of the whole volume, and of that times the hull's half length.
    """
    vertices, faces = hull()
    normal, height = random_surfaces(300, reach, seed=1)
    volume, centroid = displacement((vertices, faces), normal, height)
    parts = parts_of((vertices, faces))
    whole, length = mesh_volume(vertices, faces), np.ptp(vertices, axis=0).max() / 2
    expected_volume, expected_moment = np.zeros(300), np.zeros((300, 3))
    for i, (n, h) in enumerate(zip(normal, height, strict=True)):
        for wet in (wet_boolean(part, n, h) for part in parts):
            if len(wet.faces):
                expected_volume[i] += wet.volume
                expected_moment[i] += wet.volume * wet.center_mass
    assert ((expected_volume > 0.01 * whole) & (expected_volume < 0.99 * whole)).sum() > 120
    assert volume == pytest.approx(expected_volume, abs=3e-6 * whole)
    assert volume[:, None] * centroid == pytest.approx(expected_moment, abs=3e-6 * whole * length)


def test_displacement_of_an_upright_box_is_its_draught():
    """Sunk to the draught d, a box displaces A d with the centre d/2 above its bottom.

    Tolerance: a few hundred roundings of float32, eps = 6e-8 each, alike for the many faces that are alike.
    """
    a, b, c = 0.6, 0.4, 0.3
    draught = np.linspace(0.01, 0.29, 15)
    height = c / 2 - draught
    volume, centroid = displacement(box((a, b, c)), np.tile([0.0, 0.0, 1.0], (15, 1)), height)
    assert volume == pytest.approx(a * b * draught, rel=1e-5)
    assert centroid[:, 2] == pytest.approx(-c / 2 + draught / 2, abs=1e-6)
    assert centroid[:, :2] == pytest.approx(0.0, abs=1e-6)


def test_displacement_of_a_sphere_is_its_cap():
    """A cap of height h has V = π h² (3R - h)/3; the mesh is inscribed, short by its own volume defect."""
    radius, vertices_faces = 0.3, sphere(0.3, 4)
    defect = 1.0 - mesh_volume(*vertices_faces) / (4 / 3 * np.pi * radius**3)
    depth = np.linspace(0.1, 0.5, 9)
    normal, _ = random_surfaces(9, 1.0, seed=2)
    volume, centroid = displacement(vertices_faces, normal, radius - depth)
    expected = np.pi * depth**2 * (3 * radius - depth) / 3
    assert volume == pytest.approx(expected, rel=3 * defect)
    arm = -3 * (2 * radius - depth) ** 2 / (4 * (3 * radius - depth))
    assert centroid == pytest.approx(arm[:, None] * normal, abs=3 * defect * radius)


@pytest.mark.parametrize("hull", [lambda: FINSROV, rexrov], ids=["finsrov", "rexrov"])
def test_displacement_is_continuous_where_the_hull_touches_the_surface(hull):
    """The clipped sum meets the whole volume on one side and zero on the other."""
    vertices, faces = hull()
    whole = mesh_volume(vertices, faces)
    normal, _ = random_surfaces(50, 1.0, seed=3)
    top = (normal @ vertices.T).max(axis=1)
    bottom = (normal @ vertices.T).min(axis=1)
    # 1 mm of hull beyond the plane is at most its section's area times 1 mm, and far less at a corner.
    assert displacement((vertices, faces), normal, -top + 1e-4)[0] == pytest.approx(whole, rel=1e-3)
    assert displacement((vertices, faces), normal, -top - 1e-4)[0] == pytest.approx(whole, rel=3e-6)
    assert displacement((vertices, faces), normal, -bottom - 1e-4)[0] == pytest.approx(0.0, abs=1e-3 * whole)
    assert np.all(displacement((vertices, faces), normal, -bottom + 1e-4)[0] == 0.0)


def test_deep_hull_displaces_its_volume_at_its_centroid():
    volume, centroid = displacement(FINSROV, [[0.6, 0.0, 0.8]], [-5.0])
    assert volume == pytest.approx(0.0118, rel=1e-6)
    assert centroid[0] == pytest.approx([0.0, 0.0, 0.03], abs=1e-7)


# ---- drag: closed forms


def test_plate_broadside_and_edge_on():
    """Form ½ρC A v² on the side that meets the flow; skin ½ρC A v² on each side along it. The rim counts likewise."""
    a, b, t, v = 0.5, 0.4, 0.002, 0.8
    q = 0.5 * RHO * v**2
    broadside = drag(box((a, b, t)), v_water=(0, 0, v))
    assert broadside == pytest.approx([0, 0, q * (FORM * a * b + SKIN * 2 * (a + b) * t), 0, 0, 0], abs=1e-4)
    edge_on = drag(box((a, b, t)), v_water=(v, 0, 0))
    assert edge_on == pytest.approx([q * (FORM * b * t + SKIN * 2 * a * (b + t)), 0, 0, 0, 0, 0], abs=1e-5)


def test_moving_in_still_water_is_water_moving_past():
    """Only the velocity relative to the water counts, and drag opposes it."""
    nu = np.array([0.4, -0.3, 0.2, 0.0, 0.0, 0.0])
    moving, held = drag(FINSROV, nu=nu), drag(FINSROV, v_water=-nu[:3])
    assert moving == pytest.approx(held, rel=1e-6, abs=1e-6)
    assert np.all(moving[:3] * nu[:3] < 0.0)
    assert np.all(drag(FINSROV, nu=nu, v_water=nu[:3]) == 0.0)


def test_sphere_converges_to_the_integral_over_it():
    """With cos θ = -n·v/|v|: form ∫[cos θ]_+ v² dA = π R² v², skin ∫ v² sin³θ dA = 3π²/4 R² v².

    The error of flat faces falls with the square of their size: by four where each is split into four.
    """
    radius, v = 0.25, np.array([0.5, -0.3, 0.7])
    q = 0.5 * RHO * np.linalg.norm(v) * v * radius**2
    for form, skin, expected in [(1.0, 0.0, np.pi * q), (0.0, 1.0, 0.75 * np.pi**2 * q)]:
        found = [drag(sphere(radius, n), v_water=v, form=form, skin=skin) for n in (1, 2, 3, 4)]
        error = [np.linalg.norm(tau[:3] - expected) / np.linalg.norm(expected) for tau in found]
        assert error[3] < 0.002
        assert np.array(error[:-1]) / error[1:] == pytest.approx(4.0, rel=0.15)
        assert found[3][3:] == pytest.approx(0.0, abs=1e-4)


@settings(max_examples=40, deadline=None)
@given(v=st.tuples(*[st.floats(-2.0, 2.0)] * 3), center=st.tuples(*[st.floats(-0.5, 0.5)] * 3))
def test_box_in_oblique_flow_is_the_sum_over_six_faces(v, center):
    """Uniform flow: eq. 4 with A, n and c of the six rectangles is exact, moments about the body origin included."""
    size, v, center = np.array([0.6, 0.4, 0.3]), np.array(v), np.array(center)
    speed = np.linalg.norm(v)
    expected = np.zeros(6)
    for axis in range(3):
        for sign in (-1.0, 1.0):
            n = sign * np.eye(3)[axis]
            area, c = np.prod(np.delete(size, axis)), center + 0.5 * size * n
            v_t = (np.eye(3) - np.outer(n, n)) @ v
            mu = n @ v / speed if speed > 0 else 0.0
            force = 0.5 * RHO * area * (FORM * max(-mu, 0.0) * v * speed + SKIN * v_t * np.linalg.norm(v_t))
            expected += np.concatenate([force, np.cross(c, force)])
    assert drag(box(size, center), v_water=v) == pytest.approx(
        expected, rel=1e-5, abs=1e-5 * RHO * speed**2 + 1e-12
    )


def test_spinning_disc_feels_the_skin_moment():
    """A cylinder turning about its axis: K = -½ρC ω² (2 · 2π R⁵/5 + 2π R⁴ L), from its ends and its side."""
    radius, length, omega = 0.3, 0.1, 2.0
    expected = -0.5 * RHO * SKIN * omega**2 * (4 * np.pi * radius**5 / 5 + 2 * np.pi * radius**4 * length)
    errors = []
    for times in (3, 4):
        mesh = trimesh.creation.cylinder(radius, length, sections=64)
        for _ in range(times - 1):
            mesh = mesh.subdivide()
        tau = drag((np.array(mesh.vertices), np.array(mesh.faces)), nu=(0, 0, 0, 0, 0, omega), form=0.0)
        assert tau[:5] == pytest.approx(0.0, abs=1e-3)
        errors.append(tau[5] / expected - 1.0)
    assert abs(errors[1]) < 0.01 and abs(errors[1]) < abs(errors[0])


def flap(a, b):
    """Return the integral of |y|³ over a plate a x b that turns about the middle line of its side a: a b⁴/32."""
    return a * b**4 / 32


def test_flapping_plate_feels_the_form_moment():
    """A plate turning about a line in it: K = -½ρC p² a b⁴/32, half on each side; second order in the face size."""
    a, b, p = 0.5, 0.4, 1.5
    expected = -0.5 * RHO * FORM * p**2 * flap(a, b)
    found = [drag(fine_box((a, b, 1e-4), n), nu=(0, 0, 0, p, 0, 0), skin=0.0) for n in (3, 4, 5)]
    error = np.array([tau[3] / expected - 1.0 for tau in found])
    assert np.abs(error[2]) < 0.005
    assert error[:-1] / error[1:] == pytest.approx(4.0, rel=0.2)
    assert found[2][:3] == pytest.approx(0.0, abs=1e-4)


def test_plate_in_pure_shear():
    """A plate across a flow v_x = γ z: no force, and the moment M = ½ρC γ² b a⁴/32 about y."""
    height, width, gamma = 0.4, 0.5, 1.2
    gradient = np.zeros((3, 3))
    gradient[0, 2] = gamma
    tau = drag(fine_box((1e-4, width, height), 5), gradient=gradient, skin=0.0)
    assert tau[4] == pytest.approx(0.5 * RHO * FORM * gamma**2 * flap(width, height), rel=0.005)
    assert tau[[0, 1, 2, 3, 5]] == pytest.approx(0.0, abs=1e-3)


def test_water_that_turns_with_the_body_does_not_act():
    """The gradient [ω]× is rigid rotation: with the body's ω no wrench, with -ω on a still body that of turning."""
    omega = np.array([0.3, -0.5, 0.8])
    cross = np.cross(np.eye(3), omega)
    turning = np.concatenate([np.zeros(3), omega])
    assert drag(FINSROV, nu=turning, gradient=-cross.T) == pytest.approx(0.0, abs=1e-6)
    assert drag(FINSROV, gradient=cross.T) == pytest.approx(drag(FINSROV, nu=turning), rel=1e-5, abs=1e-6)


# ---- drag: laws


@settings(max_examples=100, deadline=None)
@given(
    nu=st.tuples(*[st.floats(-3.0, 3.0)] * 6),
    normal=st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda n: np.linalg.norm(n) > 0.1),
    height=st.floats(-0.5, 0.5),
)
def test_drag_never_adds_energy(nu, normal, height):
    """In still water every face's force opposes its motion: nu · tau <= 0, wholly or partly submerged."""
    tau = drag(FINSROV, nu=nu, normal=np.array(normal) / np.linalg.norm(normal), height=height)
    assert np.dot(nu, tau) <= 1e-6 * np.linalg.norm(nu) * np.linalg.norm(tau)


@settings(max_examples=50, deadline=None)
@given(nu=st.tuples(*[st.floats(-2.0, 2.0)] * 6), height=st.floats(-0.5, 0.5), axis=st.integers(0, 2))
def test_mirrored_motion_gives_the_mirrored_wrench(nu, height, axis):
    """The hull mirrors on its planes: vectors flip along the axis, turning and moments on the other two."""
    flip = np.ones(6)
    flip[axis] = -1.0
    flip[[3 + (axis + 1) % 3, 3 + (axis + 2) % 3]] = -1.0
    hull = parametric_hull((0.56, 0.42, 0.25), 0.0118)
    normal = np.array([0.36, -0.48, 0.8])
    tau = drag(hull, nu=nu, normal=normal, height=height)
    mirrored = drag(hull, nu=flip * nu, normal=flip[:3] * normal, height=height)
    assert mirrored == pytest.approx(flip * tau, rel=1e-4, abs=2e-5 * (1.0 + np.abs(tau).max()))


def test_drag_grows_with_the_square_of_the_velocity():
    nu = np.array([0.3, -0.2, 0.1, 0.4, -0.5, 0.6])
    assert drag(FINSROV, nu=3.0 * nu) == pytest.approx(9.0 * drag(FINSROV, nu=nu), rel=1e-5, abs=1e-5)


def test_drag_turns_with_the_body():
    """A hull given in rotated axes has the rotated wrench."""
    R = Rotation.from_euler("xyz", [0.4, -0.7, 1.1]).as_matrix()
    nu, normal, height = np.array([0.5, -0.2, 0.3, 0.4, 0.6, -0.5]), np.array([0.48, 0.6, 0.64]), 0.02
    turn = np.kron(np.eye(2), R)
    tau = drag(FINSROV, nu=nu, normal=normal, height=height)
    turned = drag((FINSROV[0] @ R.T, FINSROV[1]), nu=turn @ nu, normal=R @ normal, height=height)
    assert turned == pytest.approx(turn @ tau, rel=1e-4, abs=1e-4)


# ---- drag: the surface


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hull", "reach"), [(lambda: FINSROV, 0.3), (rexrov, 1.5)], ids=["finsrov", "rexrov"]
)
def test_clipped_drag_is_that_of_the_cut_hull(hull, reach):
    """In uniform flow eq. 4, written out over the boolean's faces but the cut, gives force and moment.

    Tolerance: 2e-6 of ½ρ v² times the hull's whole area.
    """
    vertices, faces = hull()
    normal, height = random_surfaces(200, reach, seed=4)
    v = np.random.default_rng(5).normal(size=(200, 3))
    tau = drag((vertices, faces), v_water=v, normal=normal, height=height)
    parts = parts_of((vertices, faces))
    expected = np.zeros((200, 6))
    for i, (up, h, v_i) in enumerate(zip(normal, height, v, strict=True)):
        for wet in (wet_boolean(part, up, h) for part in parts):
            if len(wet.faces) == 0:
                continue
            n, area, c = wet.face_normals, wet.area_faces, wet.triangles_center
            cut = (n @ up > 0.99999) & (np.abs(c @ up + h) < 1e-5)
            n, area, c = n[~cut], area[~cut], c[~cut]
            speed = np.linalg.norm(v_i)
            v_t = v_i - (n @ v_i)[:, None] * n
            form = FORM * np.maximum(-(n @ v_i) / speed, 0.0)[:, None] * v_i * speed
            force = (
                0.5 * RHO * area[:, None] * (form + SKIN * v_t * np.linalg.norm(v_t, axis=1, keepdims=True))
            )
            expected[i] += np.concatenate([force.sum(axis=0), np.cross(c, force).sum(axis=0)])
    scale = 0.5 * RHO * sum(part.area for part in parts) * np.max(np.sum(v**2, axis=1))
    assert tau == pytest.approx(expected, abs=2e-6 * scale)


def test_dry_hull_feels_no_drag_and_a_half_sunk_box_half_of_it():
    """Broadside form drag is proportional to the draught."""
    a, b, c, v = 0.5, 0.4, 0.3, 0.7
    height = np.linspace(-0.2, 0.2, 9)
    tau = drag(box((a, b, c)), v_water=(v, 0, 0), height=height, skin=0.0)
    draught = np.clip(c / 2 - height, 0.0, c)
    assert tau[:, 0] == pytest.approx(0.5 * RHO * FORM * b * draught * v**2, rel=2e-6, abs=1e-6)
    assert tau[:, 4] == pytest.approx(tau[:, 0] * (-c / 2 + draught / 2), rel=1e-5, abs=1e-5)
    assert np.all(tau[height > c / 2] == 0.0)


def test_drag_is_continuous_through_the_surface():
    """Raised in steps of h, spinning and moving, the wrench changes by no more than the wetted area it loses."""
    height = np.linspace(-0.3, 0.3, 3001)
    tau = drag(FINSROV, nu=(1, 0.5, -0.3, 1, -1, 2), normal=(0.36, 0.48, 0.8), height=height)
    step = np.abs(np.diff(tau, axis=0)).max(axis=0)
    assert np.all(step < 0.02 * np.abs(tau).max(axis=0))


# ---- hulls side by side, devices, refusals


def test_each_kind_of_hull_is_its_own():
    """In one set of arrays every hull has the same wrench as alone."""
    hulls = [FINSROV, box((0.6, 0.4, 0.3)), sphere(0.2, 2)]
    together = hull_mesh(hulls, "cpu")
    normal, height = random_surfaces(20, 0.2, seed=6)
    nu = np.array([0.3, 0.4, -0.5, 0.6, -0.7, 0.8])
    for kind, hull in enumerate(hulls):
        alone = drag(hull, nu=nu, normal=normal, height=height)
        assert np.array_equal(drag(together, nu=nu, normal=normal, height=height, kind=kind), alone)
        one, both = displacement(hull, normal, height), displacement(together, normal, height, kind=kind)
        assert np.array_equal(one[0], both[0]) and np.array_equal(one[1], both[1])


@pytest.mark.skipif(not wp.get_cuda_devices(), reason="needs a CUDA device")
def test_cpu_and_cuda_agree():
    """The same functions to float32: fused multiply-adds differ in the last digits."""
    normal, height = random_surfaces(1000, 0.3, seed=7)
    nu = np.random.default_rng(8).normal(size=(1000, 6))
    one, other = (drag(FINSROV, nu=nu, normal=normal, height=height, device=d) for d in ("cpu", "cuda:0"))
    assert one == pytest.approx(other, abs=2e-5 * np.abs(one).max())
    one, other = (displacement(FINSROV, normal, height, device=d)[0] for d in ("cpu", "cuda:0"))
    assert one == pytest.approx(other, abs=1e-6 * 0.0118)


def test_open_hull_is_refused():
    vertices, faces = FINSROV
    with pytest.raises(MeshError, match="open"):
        hull_mesh([(vertices, faces[1:])])
