"""Drawn shapes have the sizes and positions of the objects that they represent."""

import numpy as np
import pytest

from finssim.core.rotations import quat_from_yaw, quat_to_matrix
from finssim.extensions.viewer.app import FIRST, LINE, blank, draw_picture, legend_of, plots_of
from finssim.extensions.viewer.frame import BodyPose, LatestPicture, PlotLine
from finssim.extensions.viewer.shapes import (
    ARROW,
    fin_attitude,
    fin_plates,
    force_arrows,
    hull_of,
    line_of,
    propeller_poses,
    tag_plates,
)
from finssim.robot.messages import TagCorners
from finssim.vehicles import load_vehicle
from reference.finned import torpedo

FINSROV = load_vehicle("finsrov")


def volume(mesh):
    """Return the volume of a closed mesh by the divergence theorem: sum of a . (b x c) / 6."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def test_arrows_push_where_thrusters_push():
    """Full forward thrust has the full length along the turned axis; zero thrust has no arrow."""
    force = np.zeros(len(FINSROV.thruster_names))
    force[0] = -np.max(np.abs(FINSROV.force_limits))
    pose = BodyPose(np.array([1.0, 2.0, -0.5]), quat_from_yaw(np.pi / 2))
    (arrow,) = force_arrows(FINSROV, force, pose)
    thruster = FINSROV.thrusters[FINSROV.thruster_names[0]]
    x, y, z = -np.asarray(thruster.axis) * ARROW * np.max(FINSROV.body.size)
    assert arrow[1] - arrow[0] == pytest.approx([-y, x, z])
    assert not len(force_arrows(FINSROV, 0.0 * force, pose)) and not len(
        force_arrows(FINSROV, force[:0], pose)
    )


def test_a_vehicle_without_a_hull_is_a_body_of_its_size_and_volume():
    """The body is closed and faces outwards; a volume that exceeds the size gives the box."""
    bare = load_vehicle("remus100")
    assert bare.hull is None
    hull = hull_of(bare)
    assert volume(hull) == pytest.approx(bare.body.displaced_volume, rel=1e-6)
    assert np.ptp(hull.vertices, axis=0) == pytest.approx(np.array(bare.body.size))
    size = float(np.prod(bare.body.size))
    heavy = bare.body.model_copy(update={"displaced_volume": 1.5 * size})
    assert volume(hull_of(bare.model_copy(update={"body": heavy}))) == pytest.approx(size)


def test_propellers_turn_about_the_axes_of_their_thrusters():
    """z lies along the thrust axis at every angle; a quarter turn moves a blade to the previous position of
    the next axis."""
    n = len(FINSROV.thrusters)
    begin, places, radii = propeller_poses(FINSROV, np.zeros(n))
    turned, *_ = propeller_poses(FINSROV, np.full(n, 0.5 * np.pi))
    for k, thruster in enumerate(FINSROV.thrusters.values()):
        before, after = (quat_to_matrix(np.roll(q[k], -1)) for q in (begin, turned))
        assert before[:, 2] == pytest.approx(thruster.axis) and after[:, 2] == pytest.approx(thruster.axis)
        assert after[:, 0] == pytest.approx(before[:, 1])
        assert places[k] == pytest.approx(thruster.position) and radii[k] > 0.0


def test_plates_lie_on_the_mounts():
    """One plate for each tag, around its position."""
    plates, tags = tag_plates(FINSROV)
    positions = [m.position for m in FINSROV.tags.mounts.values()]
    assert plates.vertices.reshape(-1, 4, 3).mean(axis=1) == pytest.approx(np.array(positions))
    assert np.ptp(tags.vertices[:4], axis=0).max() == pytest.approx(0.9 * FINSROV.tags.edge)


def test_a_line_leaves_out_what_is_unknown():
    """k points make k - 1 segments; NaN is not drawn."""
    points = np.array([[0.0, 0.0, 0.0], [np.nan] * 3, [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    assert line_of(points).shape == (2, 2, 3) and line_of(points[:1]).shape == (0, 2, 3)


def test_tags_are_outlined_where_they_were_found():
    """The outline follows the corners, with the enlarged tag beside it; a tag at the border or of NaN is
    harmless."""
    image = np.full((720, 1280), 90, np.uint8)
    corners = np.array([[600.0, 300.0], [640.0, 300.0], [640.0, 340.0], [600.0, 340.0]])
    plain, drawn = (
        draw_picture(LatestPicture(image)),
        draw_picture(LatestPicture(image, [TagCorners(3, corners)])),
    )
    assert plain.shape == drawn.shape == (360, 640, 3) and (plain == 90).all()
    assert tuple(drawn[150, 310]) == FIRST and tuple(drawn[170, 310]) == LINE
    assert tuple(drawn[160, 310]) == (90, 90, 90)
    odd = [TagCorners(1, corners - [620.0, 320.0]), TagCorners(2, corners * np.nan)]
    draw_picture(LatestPicture(image, odd[:1]))
    draw_picture(LatestPicture(None, odd[:1]))
    assert blank().shape[2] == 3


def test_plots_show_the_past_in_full():
    """Curves of one title share a plot; the part of each up to now is highlighted."""
    time = np.arange(5.0)
    curves = [
        PlotLine("a", "x", time, time),
        PlotLine("b", "x", time, -time),
        PlotLine("a", "y", time, 2 * time),
    ]
    first, second = plots_of(curves)
    assert [c.label for c in first.curves] == ["x", "y"] and second.title == "b"
    _, whole, past, *_ = first.data(2.0)
    assert whole.tolist() == [0, 1, 2, 3, 4] and np.isnan(past).tolist() == [False] * 3 + [True] * 2
    assert len(first.series()) == len(first.data(2.0)) == 5
    assert legend_of([first, second]).count("■") == 2


def test_a_plot_begins_where_all_its_curves_have_values():
    """The first estimate comes later than the first distance to the goal, and the browser draws nothing after
    a NaN."""
    time, late = np.arange(4.0), np.array([np.nan, 2.0, 3.0, 4.0])
    curves = [
        PlotLine("position", "to the goal", time, time),
        PlotLine("position", "of the estimate", time, late),
    ]
    (plot,) = plots_of(curves)
    data = plot.data(0.0)
    assert [column[0] for column in data] == [1.0, 1.0, 1.0, 2.0, 2.0]
    assert all(len(column) == 3 for column in data)


def test_fins_are_plates_that_turn_with_their_deflection():
    """A plate has the fin's area in the plane of chord and span; a positive deflection turns it about the
    span."""
    vehicle = torpedo()
    plates = fin_plates(vehicle)
    assert list(plates) == [0, 1]
    rudder = vehicle.actuators["rudder"]
    length, height = np.ptp(plates[0].vertices, axis=0)[[0, 2]]
    assert length * height == pytest.approx(rudder.area)
    edge = quat_to_matrix(fin_attitude(rudder, 0.3)) @ rudder.chord
    assert edge == pytest.approx([np.cos(0.3), np.sin(0.3), 0.0])
