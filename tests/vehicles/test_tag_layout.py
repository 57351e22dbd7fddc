"""Tag files of apriltag_ros: bundles and settings become tags of a vehicle; invalid ones are refused."""

from pathlib import Path

import numpy as np
import pytest

import finssim as fs
from finssim.core.rotations import quat_from_euler, quat_to_matrix
from finssim.localization.detection.families import tag_corners_b
from finssim.vehicles.part import VehicleError
from finssim.vehicles.tag_layout import read_tag_layout

BUNDLE = """
standalone_tags: [{id: 03, size: 0.2, name: gate}]
tag_bundles:
  [
    {
      name: 'rov_top',
      layout:
        [
          {id: 10, size: 0.08, x: 0.0, y: 0.0, z: 0.0, qw: 1.0, qx: 0.0, qy: 0.0, qz: 0.0},
          {id: 11, size: 0.08, x: 0.15},
          {id: 12, size: 0.05, x: 0.15, y: 0.12, z: -0.03, qw: 0.9659258, qx: 0.2588190, qy: 0.0, qz: 0.0}
        ]
    }
  ]
"""
SETTINGS = """
/**:
  ros__parameters:
    image_transport: raw
    family: 36h11
    size: 0.16
    max_hamming: 0
    tag:
      ids: [9, 14]
      frames: [base, object]
      sizes: [0.162, 0.1]
"""


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def vehicle(folder: Path, section: str, **files: str):
    for name, text in files.items():
        written(folder / f"{name}.yaml", text)
    return fs.load_vehicle(written(folder / "rov.yaml", f"extends: finsrov\ntags: {section}\n"))


def test_a_bundle_is_read_with_its_defaults_and_says_what_it_leaves_out(tmp_path):
    layout = read_tag_layout(written(tmp_path / "tags.yaml", BUNDLE))
    assert layout.sizes == {10: 0.08, 11: 0.08, 12: 0.05} and not layout.family
    assert layout.poses[11].position.tolist() == [0.15, 0.0, 0.0]
    assert layout.poses[11].orientation.tolist() == [0.0, 0.0, 0.0, 1.0]
    assert layout.remarks[0].endswith("standalone tags 3 have no pose and are not read")


def test_settings_give_sizes_and_family_in_any_namespace(tmp_path):
    for text in (SETTINGS, SETTINGS.replace("/**:", "apriltag:\n node:").replace("\n  ros__", "\n  ros__")):
        layout = read_tag_layout(written(tmp_path / "settings.yaml", text))
        assert layout.sizes == {9: 0.162, 14: 0.1} and layout.family == "36h11" and not layout.poses
    usual = read_tag_layout(
        written(tmp_path / "usual.yaml", SETTINGS.replace("      sizes: [0.162, 0.1]\n", ""))
    )
    assert usual.sizes == {9: 0.16, 14: 0.16}


def test_a_bundle_becomes_the_tags_of_a_vehicle(tmp_path):
    """Corners have each tag's own size and move with the bundle's frame, here a quarter turn."""
    turn = quat_from_euler(0.0, 0.0, np.pi / 2)
    about = "origin: measured, source: ruler"
    tags = f"{{family: tag36h11, layout: t.yaml, {about}, position: [0.1, 0.2, 0.3], orientation: {turn.tolist()}}}"
    rov = vehicle(tmp_path, tags, t=BUNDLE)
    assert set(rov.tags.mounts) == {10, 11, 12} and rov.tags.edge == 0.08 and rov.tags.edge_of(12) == 0.05
    found = tag_corners_b(rov.tags)
    R = quat_to_matrix(turn)
    tilted = quat_to_matrix(quat_from_euler(np.radians(30.0), 0.0, 0.0))
    flat = np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
    by_hand = [0.1, 0.2, 0.3] + ([0.15, 0.12, -0.03] + 0.025 * flat @ tilted.T) @ R.T
    np.testing.assert_allclose(found[12], by_hand, atol=1e-7)
    np.testing.assert_allclose(found[11].mean(axis=0), [0.1, 0.35, 0.3], atol=1e-12)
    assert fs.load_vehicle(rov.path).sha256 == rov.sha256


def test_settings_give_mounts_of_a_vehicle_their_sizes(tmp_path):
    mounts = "{9: {position: [0.1, 0, 0.1]}, 14: {position: [-0.1, 0, 0.1]}}"
    rov = vehicle(
        tmp_path, f"{{origin: measured, source: ruler, layout: s.yaml, mounts: {mounts}}}", s=SETTINGS
    )
    assert rov.tags.family == "36h11" and {rov.tags.edge_of(9), rov.tags.edge_of(14)} == {0.162, 0.1}


REFUSED = {
    "unknown word of a tag": (BUNDLE.replace("x: 0.15}", "x: 0.15, roll: 3}"), "unknown key 'roll'"),
    "unknown word": (BUNDLE + "tag_bundle: []\n", "unknown key 'tag_bundle', did you mean 'tag_bundles'"),
    "two bundles": (BUNDLE.replace("bundles:\n  [", "bundles:\n  [{name: b, layout: []},"), "the bundles b, rov_top"),
    "twice": (BUNDLE.replace("id: 11", "id: 10"), "tag 10 is there twice"),
    "no size": (BUNDLE.replace("id: 11, size: 0.08", "id: 11"), "size is [None], expected 1 finite number"),
    "no number": (BUNDLE.replace("id: 11", "id: eleven"), "id is 'eleven', expected an integer from 0"),
    "a size of 0": (BUNDLE.replace("id: 11, size: 0.08", "id: 11, size: 0.0"), "size is 0 m, expected above 0"),
    "no rotation": (BUNDLE.replace("qw: 0.9659258", "qw: 0.1"), "has length 0.2775, expected 1"),
    "sizes of too few": (SETTINGS.replace("[0.162, 0.1]", "[0.162]"), "2 ids and 1 sizes"),
    "unknown parameter": (SETTINGS.replace("max_hamming", "max_haming"), "unknown key 'max_haming', did you mean"),
    "nothing": ("standalone_tags: []\ntag_bundles: []\n", "has no tags"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_wrong_is_refused_by_name(name, tmp_path):
    text, sentence = REFUSED[name]
    with pytest.raises(VehicleError) as refusal:
        read_tag_layout(written(tmp_path / "tags.yaml", text))
    assert sentence in str(refusal.value) and "tags.yaml" in str(refusal.value)


def test_a_vehicle_needs_poses_and_a_family(tmp_path):
    for tags, files, sentence in (
        ("{layout: t.yaml}", {"t": BUNDLE}, "tags.family is missing"),
        ("{layout: t.yaml}", {"t": SETTINGS}, "sizes of tags 9, 14 without poses: add mounts"),
        ("{layout: t.yaml, family: tag36h11, mounts: {}}", {"t": BUNDLE}, "both give poses"),
        ("{layout: other.yaml}", {}, "other.yaml: cannot be read"),
    ):
        with pytest.raises(VehicleError, match=sentence):
            vehicle(tmp_path, tags, **files)
