"""Corners of tags agree with the vehicle file."""

import math

import numpy as np

from finssim.localization.detection.families import corners, tag_corners_b
from finssim.vehicles import load_vehicle


def test_corners_run_clockwise_as_printed_and_span_the_edge():
    """From the printed side (z towards the viewer, y up) the order is clockwise, on a square of that edge."""
    ring = corners(0.093)
    sides = np.roll(ring, -1, axis=0) - ring
    assert np.allclose(np.linalg.norm(sides, axis=1), 0.093)
    assert np.all(np.cross(sides, np.roll(sides, -1, axis=0))[:, 2] < 0.0)
    assert np.allclose(ring[0], [-0.0465, 0.0465, 0.0])  # top-left: left and up


def test_a_mount_moves_its_tag_rigidly():
    """FinsROV's tags lie on its back, rotated by 90°: the printed top (y of the tag) points to -x of the body."""
    tags = load_vehicle("finsrov").tags
    for tag, ring_b in tag_corners_b(tags).items():
        assert np.allclose(ring_b.mean(axis=0), tags.mounts[tag].position, atol=1e-12)
        top = 0.5 * (ring_b[0] + ring_b[1]) - ring_b.mean(axis=0)
        assert np.allclose(top, [-tags.edge / 2.0, 0.0, 0.0], atol=1e-7)
        assert math.isclose(np.linalg.norm(ring_b[0] - ring_b[2]), tags.edge * math.sqrt(2.0), rel_tol=1e-7)
