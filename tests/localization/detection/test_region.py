"""A tag is searched near its expected position, found again wherever it reappears, and never reported twice."""

import itertools

import numpy as np
import pytest

from finssim.localization.detection.detector import RegionTracker, detector, merged, region_around
from reference.tag_picture import draw, pose_corners

SHAPE = (360, 480)
EMPTY = np.full(SHAPE, 120, np.uint8)


def picture(seed=0, **tags):
    """Return a picture with tags t15=(u, v), each of 32 px."""
    rings = {int(name[1:]): ring_at(*place) for name, place in tags.items()}
    return draw(SHAPE, rings, family="tag25h9", blur=0.6, noise=1.5, seed=seed, oversampling=4)


def ring_at(u, v):
    """Return corners of a slightly rotated tag of 32 px."""
    return pose_corners(32.0, centre=(u, v), turn=0.2)


class Searches:
    """Detector that records its search regions; None is the whole picture."""

    def __init__(self):
        self.find, self.regions = detector("tag25h9"), []

    def detect(self, image, region=None):
        self.regions.append(region)
        return self.find.detect(image, region)

    @property
    def whole(self):
        return self.regions.count(None)


@pytest.mark.slow
def test_a_moving_tag_is_followed_in_regions_with_the_corners_of_a_whole_search():
    """At 9 px per picture, only regions are searched after the first picture, a fraction of the pixels."""
    searches = Searches()
    tracker = RegionTracker(searches, [15, 16])
    for k in range(8):
        image = picture(k, t15=(100 + 9 * k, 80 + 4 * k), t16=(300 - 6 * k, 250.4))
        found = {d.tag: d for d in tracker.detect(image, 0.033 * k)}
        whole = {d.tag: d for d in searches.find.detect(image)}
        assert found.keys() == whole.keys() == {15, 16}
        for tag, detection in found.items():
            assert np.abs(detection.corners - whole[tag].corners).max() < 0.02
    parts = [region for region in searches.regions if region is not None]
    assert searches.whole == 1 and len(parts) == 14
    assert sum((right - left) * (low - top) for left, top, right, low in parts) < 7 * 0.12 * EMPTY.size


def test_a_tag_that_jumps_is_found_in_the_same_picture():
    """If the tag is not at its expected position, the whole picture is searched at once."""
    searches = Searches()
    tracker = RegionTracker(searches, [15])
    places = [(60, 60), (62, 60), (400, 300), (402, 300)]
    found = [tracker.detect(picture(k, t15=place), 0.1 * k) for k, place in enumerate(places)]
    assert [len(f) for f in found] == [1, 1, 1, 1]
    assert np.abs(found[2][0].corners - ring_at(400, 300)).max() < 0.3
    assert searches.whole == 2


@pytest.mark.slow
def test_a_missing_tag_is_searched_in_the_whole_picture_every_so_often():
    """The unseen one of two is always searched near its last position, and everywhere in every third picture."""
    searches = Searches()
    tracker = RegionTracker(searches, [15, 16], search_every=3)
    tracker.detect(picture(t15=(100, 100), t16=(300, 250)), 0.0)
    for k in range(1, 7):
        tracker.detect(picture(k, t15=(100, 100)), 0.1 * k)
    assert searches.whole == 1 + 2
    back = picture(9, t15=(100, 100), t16=(420, 60))
    seen = [{d.tag for d in tracker.detect(back, 0.7 + 0.1 * k)} for k in range(4)]
    assert seen[0] == {15} and seen[-1] == {15, 16}


def test_a_tag_that_is_hidden_for_a_while_is_found_near_where_it_was():
    """While a tag is lost, the search region grows and follows the tag's last velocity."""
    corners = ring_at(100, 100)
    widths = [np.diff(np.reshape(region_around(corners, lost), (2, 2)), axis=0).min() for lost in range(5)]
    assert all(a < b for a, b in itertools.pairwise(widths))
    searches = Searches()
    tracker = RegionTracker(searches, [15, 16], search_every=1000)
    for k in range(3):
        tracker.detect(picture(k, t15=(60, 300), t16=(100 + 10 * k, 100)), 0.1 * k)
    for k in range(3, 6):
        tracker.detect(picture(k, t15=(60, 300)), 0.1 * k)
    found = tracker.detect(picture(6, t15=(60, 300), t16=(160, 108)), 0.6)
    assert {d.tag for d in found} == {15, 16}
    assert searches.whole == 1


@pytest.mark.parametrize("times", [True, False])
def test_an_id_is_never_reported_twice(times):
    """For two plates with one id, and for overlapping regions, the more certain one stays."""
    rings = {15: ring_at(100, 100), 16: ring_at(145, 110)}
    tracker = RegionTracker(detector("tag25h9"))
    for k in range(4):
        image = draw(SHAPE, rings, family="tag25h9", seed=k, oversampling=4)
        image[200:300, 250:350] = image[50:150, 50:150]  # a second detection of 15
        found = tracker.detect(image, 0.1 * k if times else np.nan)
        assert sorted(d.tag for d in found) == [15, 16]


def test_tags_nobody_asked_for_are_left_out():
    """Only the vehicle's ids are reported."""
    tracker = RegionTracker(detector("tag25h9"), [15])
    assert [d.tag for d in tracker.detect(picture(t15=(100, 100), t3=(300, 200)))] == [15]


def test_pictures_without_tags_cost_one_whole_search_each():
    """Pictures without tags need one whole search each and give no detections."""
    searches = Searches()
    tracker = RegionTracker(searches, [15])
    assert [tracker.detect(EMPTY, 0.1 * k) for k in range(3)] == [[], [], []]
    assert searches.regions == [None] * 3


def test_merged_regions_cover_the_same_places_without_overlap():
    """Chains of overlaps become one region; regions that only touch stay separate."""
    assert merged([(0, 0, 10, 10), (10, 0, 20, 10)]) == [(0, 0, 10, 10), (10, 0, 20, 10)]
    assert merged([(0, 0, 10, 10), (18, 0, 30, 10), (9, 0, 19, 10)]) == [(0, 0, 30, 10)]
    rng = np.random.default_rng(3)
    for _ in range(50):
        low = rng.integers(0, 80, (6, 2))
        regions = [
            (*map(int, a), *map(int, a + s)) for a, s in zip(low, rng.integers(5, 30, (6, 2)), strict=True)
        ]
        apart = merged(regions)
        for a, b in itertools.combinations(apart, 2):
            assert a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]
        for r in regions:
            assert any(o[0] <= r[0] and o[1] <= r[1] and o[2] >= r[2] and o[3] >= r[3] for o in apart)
