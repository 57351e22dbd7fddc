"""Renderers of a campaign: exact corners, our camera, and Mitsuba show the same tag at the same place."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.core.optics import project
from finssim.localization.detection.families import corners
from finssim.studies import localization as module
from finssim.studies.localization import (
    CONDITIONS,
    RENDERERS,
    TAG,
    draw_campaign,
    lifted,
    pictures,
)

SMALL = {"locations": (5, 4), "images": 20}


def exact(campaign, visit):
    """Return the pixels of the tag's corners through the water, (4, 2)."""
    points = visit.position + corners(TAG.edge) @ visit.R_pb.T
    return project(campaign.truth.camera, campaign.truth.interface, points).pixels


def some(campaign, count):
    """Return a campaign of the first visits, with one picture each."""
    visits = tuple(replace(visit, images=1) for visit in campaign.visits[:count])
    return replace(campaign, visits=visits, calibrates=np.zeros(count, bool))


def errors(campaign, seen):
    """Return detected minus exact corners, (n, 4, 2) [px]."""
    return np.array([p.detection.corners - exact(campaign, campaign.visits[p.visit]) for p in seen])


def test_every_visit_has_its_pictures_with_names_of_their_own():
    campaign = draw_campaign(CONDITIONS["published"], 1, locations=(5, 4), images=50)
    seen = list(pictures(campaign, "geometry"))
    assert len({p.name for p in seen}) == len(seen) == 50
    counts = np.bincount([p.visit for p in seen])
    assert counts.tolist() == [visit.images for visit in campaign.visits]
    assert {p.detection.tag for p in seen} == set(TAG.mounts)
    assert {p.detection.family for p in seen} == {TAG.family}


def test_corners_by_geometry_have_white_noise_alone():
    """The noise has the stated standard deviation and no common part; without noise the corners are exact."""
    campaign = draw_campaign(CONDITIONS["published"], 1, locations=(5, 4), images=600)
    e = errors(campaign, pictures(campaign, "geometry"))
    assert e.std() == pytest.approx(module.CORNER_NOISE, rel=4.0 / np.sqrt(2 * e.size))
    assert e.mean(axis=1).std() == pytest.approx(module.CORNER_NOISE / 2.0, rel=0.1)


def test_corners_without_noise_are_exact(monkeypatch):
    monkeypatch.setattr(module, "CORNER_NOISE", 0.0)
    campaign = draw_campaign(CONDITIONS["published"], 1, **SMALL)
    assert np.abs(errors(campaign, pictures(campaign, "geometry"))).max() < 1e-9


def test_what_lies_outside_the_picture_is_not_detected():
    """A tag that is lifted far towards the camera leaves the picture at the pool's ends."""
    campaign = draw_campaign(CONDITIONS["quiet"], 1, **SMALL)
    higher = lifted(campaign, 0.9)
    lens = campaign.truth.camera.lens
    seen = list(pictures(higher, "geometry"))
    inside = [bool(lens.inside(exact(higher, higher.visits[p.visit])).all()) for p in seen]
    assert [p.detection is not None for p in seen] == inside
    assert any(inside) and not all(inside)


@pytest.mark.slow
@pytest.mark.parametrize("renderer", ["own", "geometry"])
def test_equal_seeds_give_equal_pictures(renderer):
    """Pictures of equal seeds are bit-identical, whatever was drawn before; another campaign has other noise."""
    campaign = some(draw_campaign(CONDITIONS["published"], 1, **SMALL), 3)
    one, same = (np.array([p.detection.corners for p in pictures(campaign, renderer)]) for _ in range(2))
    np.testing.assert_array_equal(one, same)
    noisier = replace(campaign, seed=2)
    other = np.array([p.detection.corners for p in pictures(noisier, renderer)])
    assert (one != other).all()


@pytest.mark.slow
def test_our_camera_shows_the_tag_where_it_is():
    """In still water corners are within 0.3 px of their projection, 0.1 px rms; ripples increase the error."""
    flat = draw_campaign(CONDITIONS["flat"], 1, **SMALL)
    still = errors(flat, pictures(flat, "own"))
    assert still.shape == (20, 4, 2)
    assert np.abs(still).max() < 0.3 and np.sqrt(np.mean(still**2)) < 0.1
    rippled = draw_campaign(CONDITIONS["published"], 1, **SMALL)
    moved = errors(rippled, [p for p in pictures(rippled, "own") if p.detection is not None])
    assert np.sqrt(np.mean(moved**2)) > 3.0 * np.sqrt(np.mean(still**2))


def test_an_unknown_renderer_is_refused_by_name():
    campaign = draw_campaign(CONDITIONS["quiet"], 1, **SMALL)
    with pytest.raises(ValueError, match=r"unknown renderer 'blender'; available: own, geometry"):
        next(pictures(campaign, "blender"))
    assert set(RENDERERS) == {"own", "geometry"}
