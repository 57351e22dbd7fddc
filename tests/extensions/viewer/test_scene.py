"""The scene that is sent to the page: objects that move with a frame, and their displacements."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2

from finssim.core.rotations import quat_from_yaw, quat_to_matrix
from finssim.extensions.viewer.app import LANDSCAPE, REGION, View
from finssim.extensions.viewer.frame import BodyPose, Placeholder, ViewFrame
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
AT = np.array([0.4, -0.2, -0.6])


@pytest.fixture
def view():
    """A page with a vehicle at rest."""
    view = View(Placeholder(FINSROV, "a vehicle", "compiling kernels …"), port=8280)
    yield view
    view.close()


def node(view, name):
    """Return a handle of the scene."""
    handle = view.server.scene.get_handle_by_name(name)
    assert handle is not None, name
    return handle


def frame_at(time, **values):
    """Return a frame with a true pose and an estimate."""
    pose = BodyPose(AT, quat_from_yaw(0.3))
    return ViewFrame(time=time, truth=pose, estimate=pose, **values)


@pytest.mark.slow
def test_the_placeholder_shows_the_vehicle_in_its_pool(view):
    """Hull, propellers, walls and floor are there, with a notice at the vehicle."""
    view.turn(0.0)
    for name in (
        "/truth/hull",
        "/truth/thrusters/ducts",
        "/truth/thrusters/propellers",
        "/pool/walls",
        "/pool/surface",
        "/floor/0",
    ):
        node(view, name)
    assert node(view, "/truth").visible and not node(view, "/estimate").visible
    notice = node(view, "/notice")
    assert notice.visible and notice.text == "compiling kernels …"
    assert notice.position == pytest.approx(node(view, "/truth").position)


@pytest.mark.slow
def test_beside_the_truth_the_estimate_is_a_net_without_thrusters(view):
    """Beside the truth the estimate is a net, which hides nothing; alone it is the whole vehicle."""
    view.scene.draw(frame_at(0.0))
    hull, thrusters = (node(view, f"/estimate/{part}") for part in ("hull", "thrusters"))
    assert hull.wireframe and not thrusters.visible and node(view, "/truth/thrusters").visible
    view.scene.draw(replace(frame_at(0.1), truth=None))
    assert not hull.wireframe and thrusters.visible and not node(view, "/truth").visible


@pytest.mark.slow
def test_the_ellipsoid_contains_the_position_with_95_percent(view):
    """The ellipsoid's axes follow the covariance, with chi-square lengths of three degrees of freedom.

    Without a covariance there is no ellipsoid.
    """
    axes = quat_to_matrix(quat_from_yaw(0.7))
    std = np.array([0.03, 0.05, 0.08])
    view.scene.draw(frame_at(0.0, covariance=axes @ np.diag(std**2) @ axes.T))
    region = node(view, "/region")
    assert chi2.cdf(REGION**2, 3) == pytest.approx(0.95, abs=1e-4)
    assert region.visible and region.scale == pytest.approx(REGION * std)
    turned = quat_to_matrix(np.roll(region.wxyz, -1))
    assert np.abs(turned.T @ axes) == pytest.approx(np.eye(3), abs=1e-9)
    view.scene.draw(frame_at(0.1))
    assert not region.visible


@pytest.mark.slow
def test_propellers_turn_with_their_thrusts(view):
    """Propellers turn forward for a positive thrust, backward for a negative one, and stop at zero or in a
    pause."""
    force = np.zeros(len(FINSROV.thrusters))
    force[0], force[1] = 0.5 * np.array([1.0, -1.0]) * np.max(np.abs(FINSROV.force_limits))
    view.scene.draw(frame_at(1.0, force=force))
    view.scene.draw(frame_at(1.05, force=force))
    ahead, astern, *others = view.scene._angles
    assert ahead == pytest.approx(-astern) and 0.1 < ahead < 2.0 * np.pi / 6.0 and not np.any(others)
    sent = node(view, "/truth/thrusters/propellers").batched_wxyzs.copy()
    view.scene.draw(frame_at(1.05, force=force))
    assert np.array_equal(node(view, "/truth/thrusters/propellers").batched_wxyzs, sent)


@pytest.mark.slow
def test_caustics_move_with_time(view):
    """Exactly one picture of the floor is visible at a time, and another one later."""
    seen = []
    for k in range(20):
        view.scene.draw(frame_at(0.2 * k))
        seen.append([k for k, floor in enumerate(view.scene._floors) if floor.visible])
    assert all(len(visible) == 1 for visible in seen) and len({visible[0] for visible in seen}) > 8


@pytest.mark.slow
def test_the_trail_fades_with_its_age(view):
    """The newest end of the trail has its full colour, the oldest nearly that of the water."""
    view.scene.draw(frame_at(0.0, trail=np.linspace(AT - 1.0, AT, 12)))
    colours = node(view, "/trail").colors.astype(int)
    assert colours.shape == (11, 2, 3)
    assert np.abs(np.diff(colours[:, 0, 2])).max() > 0 and colours[0, 0, 2] > colours[-1, 1, 2] + 60


@pytest.mark.slow
def test_a_source_replaces_the_placeholder(view):
    """The page shows only the new stage, from its beginning."""
    other = Placeholder(load_vehicle("torpedo"), "another", "")
    other.stage = replace(other.stage, walls=False)
    view.turn(0.05)
    view.show(other)
    view.turn(0.0)
    assert view.playback.time == 0.0 and node(view, "/truth/thrusters/propellers").batched_wxyzs.shape == (
        1,
        4,
    )
    assert view.server.scene.get_handle_by_name("/pool/walls") is None


@pytest.mark.slow
def test_a_phone_sees_the_water_from_farther_away(view):
    """A narrow window is viewed from a greater distance, a wide one from the usual distance."""

    def distance(aspect):
        camera = SimpleNamespace()
        view.scene.look(camera, aspect)
        return np.linalg.norm(
            np.subtract(camera.position, 0.5 * (view.scene.stage.lower + view.scene.stage.upper))
        )

    assert distance(390.0 / 844.0) > 1.4 * distance(LANDSCAPE) and distance(2.0) == distance(1.0)


@pytest.mark.slow
@pytest.mark.parametrize("name, thrusters, fins", [("slocum", 0, 1), ("eca_a9", 1, 4), ("rexrov", 8, 0)])
def test_vehicles_of_every_build_are_drawn(view, name, thrusters, fins):
    """A glider without propeller, a torpedo with fins and one propeller, and a vehicle with its own mesh are
    drawn."""
    view.show(Placeholder(load_vehicle(name), name, ""))
    view.turn(0.05)
    propellers = view.server.scene.get_handle_by_name("/truth/thrusters/propellers")
    assert thrusters == (0 if propellers is None else len(propellers.batched_wxyzs))
    assert len(view.scene._fins) == 2 * fins and node(view, "/truth/hull").vertices.shape[0] > 20
    assert (view.server.scene.get_handle_by_name("/truth/thrusters/ducts") is not None) == (thrusters > 1)
