"""Bundles of apriltag_ros as a survey, and detections with other orders of corners."""

import numpy as np
import pytest

from finssim.core.optics import Interface, project
from finssim.core.rotations import quat_from_euler, quat_rotate
from finssim.localization.camera_file import write_camera
from finssim.localization.detection.detections import Detection, Frame, in_our_order, write_detections
from finssim.localization.detection.families import corners
from finssim.localization.overhead_camera import load_pool
from finssim.survey.points import observe, read_survey
from finssim.survey.pool import run
from finssim.trials.findings import CalibrationError

from .surveyed_pools import PLUMB_BOB, overhead

WATER = Interface.water(1.0)
PLACES = {
    tag: ((x, y, z), (0.0, 0.0, np.radians(37.0 * tag)), edge)
    for tag, (x, y, z, edge) in enumerate(
        [(-1.4, -0.6, 0, 0.16), (1.2, -0.7, 0, 0.16), (0.1, 0.1, 0.3, 0.1), (-1.2, 0.6, 0.2, 0.16), (1.3, 0.5, 0.5, .1)]
    )
}  # fmt: skip
"""Tag -> centre [m], roll, pitch and yaw [rad], and edge [m]."""


def bundle():
    """Return the layout in the format of apriltag_ros."""
    rows = []
    for tag, ((x, y, z), angles, edge) in PLACES.items():
        qx, qy, qz, qw = (float(value) for value in quat_from_euler(*angles))
        rows.append(
            f"{{id: {tag}, size: {edge}, x: {x}, y: {y}, z: {z}, qw: {qw}, qx: {qx}, qy: {qy}, qz: {qz}}}"
        )
    return f"tag_bundles: [{{name: floor, layout: [{', '.join(rows)}]}}]\n"


def surveyed():
    return {
        tag: np.asarray(place) + quat_rotate(quat_from_euler(*angles), corners(edge))
        for tag, (place, angles, edge) in PLACES.items()
    }


def pictures(order, tags=tuple(PLACES), noise=0.1):
    """Return one picture through the water, with the corners of each tag in another order."""
    rng = np.random.default_rng(1)
    found = []
    for tag in tags:
        pixels = project(overhead(), WATER, surveyed()[tag]).pixels + noise * rng.standard_normal((4, 2))
        found.append(Detection(tag, pixels[list(order)]))
    return [Frame(0.0, "a.png", tuple(found))]


ORDERS = {
    "ours": (0, 1, 2, 3), "bottom-left first, counter-clockwise": (3, 2, 1, 0), "bottom-left first": (3, 0, 1, 2),
    "top-right first": (1, 2, 3, 0), "bottom-right first": (2, 3, 0, 1), "down, then right": (0, 3, 2, 1),
    "to the left": (1, 0, 3, 2), "bottom-right, counter-clockwise": (2, 1, 0, 3),
}  # fmt: skip


@pytest.mark.parametrize("name", ORDERS)
def test_any_order_of_corners_is_recognised_where_two_tags_are_seen(name):
    """Eight orders run along a square's edges; the message names the file's first two corners."""
    frames, remark = in_our_order(pictures(ORDERS[name]), surveyed())
    expected = pictures(ORDERS["ours"])[0]
    for ours, theirs in zip(expected.detections, frames[0].detections, strict=True):
        np.testing.assert_allclose(theirs.corners, ours.corners)
    assert bool(remark) == (name != "ours")
    if name == "bottom-left first, counter-clockwise":
        assert remark.startswith("corners are read as bottom-left, bottom-right, ...")


def test_a_single_tag_says_nothing_about_the_first_corner():
    """Its corners stay unchanged, and so do those of tags without a survey."""
    for tags in ((2,), ()):
        given = pictures(ORDERS["top-right first"], tags)
        assert in_our_order(given, surveyed()) == (given, "")


def test_a_bundle_and_detections_of_its_detector_give_the_pool(tmp_path):
    """The camera position is recovered from corners in the order of the AprilTag library."""
    (tmp_path / "tags.yaml").write_text(bundle(), encoding="utf-8")
    (tmp_path / "survey.yaml").write_text(
        "points: tags.yaml\nsigma: 0.001\nsurface: {height: 1.0, sigma: 0.002}\nfit: [pose]\n",
        encoding="utf-8",
    )
    write_camera(tmp_path / "camera.yaml", PLUMB_BOB, {})
    write_detections(pictures(ORDERS["bottom-left first, counter-clockwise"]), tmp_path / "seen.csv")
    files = {"survey": "survey.yaml", "camera": "camera.yaml", "out": "pool.yaml"}
    fit = run([tmp_path / "seen.csv"], **{key: tmp_path / name for key, name in files.items()})
    assert any("bottom-left, bottom-right" in finding.text for finding in fit.findings)
    found = load_pool(tmp_path / "pool.yaml").camera
    np.testing.assert_allclose(found.position, overhead().position, atol=0.01)


def test_sizes_without_poses_are_edges_of_a_table(tmp_path):
    """Settings of ROS 2 give the edge by id, and the family; alone they are not a survey."""
    settings = tmp_path / "settings.yaml"
    settings.write_text("/**: {ros__parameters: {family: 36h11, tag: {ids: [7, 8], sizes: [0.2, 0.1]}}}\n")
    with pytest.raises(
        CalibrationError, match="settings.yaml: gives sizes of tags without poses: give a table of tag"
    ):
        read_survey(settings)
    table = tmp_path / "survey.csv"
    table.write_text("tag,x,y,z,yaw_deg\n7,0,0,0,0\n8,1,0,0,0\n")
    survey = read_survey(table, edges={7: 0.2, 8: 0.1})
    assert [np.ptp(survey.tags[tag].points[:, 0]) for tag in (7, 8)] == pytest.approx([0.2, 0.1])
    from finssim.survey.survey_file import load_survey_file

    (tmp_path / "survey.yaml").write_text("points: survey.csv\nsurface: {}\ntags: {sizes: settings.yaml}\n")
    file = load_survey_file(tmp_path / "survey.yaml")
    assert file.edges == {7: 0.2, 8: 0.1} and file.family == "36h11"
    write_detections([Frame(0.0, "", (Detection(8, 10.0 * corners(1.0)[:, :2]),))], tmp_path / "seen.csv")
    seen = file.observe([tmp_path / "seen.csv"])
    assert np.ptp(seen.points[:, 0]) == pytest.approx(0.1)
    assert observe([tmp_path / "seen.csv"], survey).names == seen.names
