"""Every refinement finds rendered tags at their true positions, in one order and one pixel convention."""

import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from finssim.localization import LocalizationError
from finssim.localization.detection.detector import REFINEMENTS, detector, fit_tag
from finssim.localization.detection.families import FAMILIES, bitmap, family_named, printable
from reference.tag_picture import draw, pose_corners

PHOTOGRAPHS = Path(__file__).parents[2] / "data" / "apriltag"

USUAL = ("tag16h5", "tag25h9", "tag36h11", "tagStandard41h12")
"""Families with all measurements; for the others, only corner positions are checked."""
LARGEST_BIAS = 0.05
"""Largest mean error of the corners of many tags, per axis [px]: a wrong convention gives 0.5."""
RMS = {"fit": 0.04, "edges": 0.12, "none": 0.5}
"""Largest allowed error at a border of 40 px, root mean square per axis [px]."""


def poses(count, edge, seed, family="tag25h9"):
    """Return corners of tags at random sub-pixel positions, rotations and tilts, and the picture's size."""
    rng = np.random.default_rng(seed)
    side = round(edge * (3 if FAMILIES[family].outside > 2 else 2) + 50)
    for k in range(count):
        turn = rng.uniform(-np.pi, np.pi) if k else 0.0
        centre = side / 2 + rng.uniform(-1.0, 1.0, 2)
        tilt, towards = rng.uniform(0.0, 0.6), rng.uniform(-np.pi, np.pi)
        yield side, pose_corners(edge, centre=centre, turn=turn, tilt=tilt, towards=towards)


@cache
def pictures(family, edge, count, seed, **light):
    """Yield pictures of one tag each: (tag, corners, picture)."""
    drawn = []
    for k, (side, ring) in enumerate(poses(count, edge, seed, family)):
        tag = (7 * k) % FAMILIES[family].count
        drawn.append((tag, ring, draw((side, side), {tag: ring}, family=family, seed=k, **light)))
    return drawn


def errors(family, find, *, edge=40.0, count=12, seed=1, **light):
    """Return detected minus rendered corners, (n, 4, 2), and the rendered ones."""
    missed, drawn = [], []
    for tag, ring, picture in pictures(family, edge, count, seed, **light):
        for found in find.detect(picture):
            if found.tag == tag:
                missed.append(found.corners - ring)
                drawn.append(ring)
    return np.array(missed), np.array(drawn)


def outward(missed, drawn):
    """Return the mean outward distance of corners along the diagonal [px]."""
    from_centre = drawn - drawn.mean(axis=1, keepdims=True)
    unit = from_centre / np.linalg.norm(from_centre, axis=-1, keepdims=True)
    return float(np.mean(np.sum(missed * unit, axis=-1)))


@pytest.mark.slow
@pytest.mark.parametrize("refine", REFINEMENTS)
@pytest.mark.parametrize("family", FAMILIES)
def test_corners_lie_where_they_were_drawn(family, refine):
    """Corners have one order, integers at pixel centres, no bias, and the error that the refinement allows."""
    find = detector(family, refine=refine)
    missed, drawn = errors(family, find, blur=0.7, noise=2.0)
    assert len(missed) >= 11
    # The mean of n corners with that error scatters by rms / sqrt(n).
    scatter = 3.0 * RMS[refine] / np.sqrt(4 * len(missed))
    assert np.abs(missed.mean(axis=(0, 1))).max() < LARGEST_BIAS + scatter
    assert np.sqrt(np.mean(missed**2)) < RMS[refine]
    if refine == "fit":
        assert abs(outward(missed, drawn)) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("family", USUAL)
@pytest.mark.parametrize("blur", [0.0, 0.5, 1.0])
def test_the_fit_is_better_than_a_tenth_of_a_pixel_on_small_tags(family, blur):
    """Errors are below 0.1 px at borders of 25 px, noise of 2.5 levels, and a margin narrower than the
    required cell."""
    missed, drawn = errors(family, detector(family), edge=25.0, count=12, blur=blur, noise=2.5, margin=0.78)
    assert len(missed) >= 11
    assert np.sqrt(np.mean(missed**2)) < 0.07
    assert np.abs(missed.mean(axis=(0, 1))).max() < 0.02
    assert abs(outward(missed, drawn)) < 0.04


@pytest.mark.slow
@pytest.mark.parametrize("family", USUAL)
def test_linear_light_takes_the_bias_of_encoded_pictures_away(family):
    """Encoded with 2.2, dark borders shrink by tenths of a pixel; `gamma=2.2` restores the corners' positions."""
    light = {"blur": 0.7, "noise": 1.0, "gamma": 2.2}
    naive = outward(*errors(family, detector(family, refine="edges"), **light))
    linear = outward(*errors(family, detector(family, refine="fit", gamma=2.2), **light))
    inward = -1.0 if FAMILIES[family].outside == 0 else 1.0  # if white is inside the edge, the border grows
    assert inward * naive > 0.15
    assert abs(linear) < 0.02


@pytest.mark.parametrize("family", USUAL[1:])
def test_the_fit_finds_its_way_from_a_coarse_start(family):
    """Starting corners that are off by up to 0.8 px each give the same corners to a hundredth of a pixel."""
    [(side, ring)] = poses(1, 36.0, 5)
    picture = draw((side, side), {3: ring}, family=family, blur=0.6, noise=1.0)
    rng = np.random.default_rng(2)
    fits = [fit_tag(picture, family, 3, ring + rng.uniform(-0.8, 0.8, (4, 2))) for _ in range(10)]
    assert all(fit is not None and fit.correlation > 0.99 for fit in fits)
    spread = np.ptp([fit.corners for fit in fits], axis=0)
    assert spread.max() < 0.01


def glare(light, u, v, at):
    """Add a bright spot of the size of a cell."""
    return light + 100.0 * np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / 50.0)


def finger(light, u, v, at):
    """Cover 7 by 7 px of the tag with gray."""
    return np.where((abs(u - at[0]) < 4) & (abs(v - at[1]) < 4), 90.0, light)


def caustic(light, u, v, at):
    """Add a bright line across the tag."""
    return light + 60.0 * (abs(0.6 * (u - at[0]) + 0.8 * (v - at[1])) < 1.0)


def shadow(light, u, v, at):
    """Add the edge of a shadow across the tag."""
    return light * np.where(0.6 * (u - at[0]) + 0.8 * (v - at[1]) > 0.0, 0.7, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize(("disturb", "rms"), [(glare, 0.25), (finger, 0.12), (caustic, 0.15), (shadow, 0.25)])
def test_uneven_light_and_covered_cells_move_corners_little(disturb, rms):
    """The fit uses local contrast, and cells that do not fit lose their weight: a fraction of a pixel remains."""
    rng = np.random.default_rng(4)
    missed = []
    for tag, ring, picture in pictures("tag25h9", 36.0, 16, 3, blur=0.7, noise=2.5):
        v, u = np.mgrid[: picture.shape[0], : picture.shape[1]]
        place = ring.mean(axis=0) + rng.uniform(-15.0, 15.0, 2)
        disturbed = np.clip(disturb(picture.astype(float), u, v, place), 0, 255).astype(np.uint8)
        missed.append(fit_tag(disturbed, "tag25h9", tag, ring).corners - ring)
    assert np.sqrt(np.mean(np.square(missed))) < rms


def test_where_there_is_no_tag_the_fit_says_so():
    """Noise and a flat picture do not correlate with the tag; half outside of the picture, or no ring, gives no fit."""
    ring = pose_corners(30.0, centre=(40.0, 40.0))
    noise = np.random.default_rng(0).integers(0, 255, (80, 80)).astype(np.uint8)
    flat = np.full((80, 80), 100, np.uint8)
    for picture in (noise, flat):
        assert fit_tag(picture, "tag25h9", 3, ring).correlation < 0.5
    for corners in (ring + 30.0, ring + 500.0, ring - 500.0, ring[::-1], np.zeros((4, 2))):
        assert fit_tag(flat, "tag25h9", 3, corners) is None


def test_another_tag_in_its_place_has_less_correlation():
    """A wrong id has too little correlation to be reported."""
    ring = pose_corners(40.0, centre=(50.0, 50.0), turn=0.4)
    picture = draw((100, 100), {3: ring}, family="tag25h9", blur=0.6, noise=1.0)
    assert fit_tag(picture, "tag25h9", 3, ring).correlation > 0.99
    assert max(fit_tag(picture, "tag25h9", tag, ring).correlation for tag in range(4, 35)) < 0.9


def test_a_region_gives_the_corners_of_the_whole_picture():
    """Searching a region, clipped to the picture, changes no corner; tags outside the region are not found."""
    rings = {
        3: pose_corners(40.0, centre=(60.3, 70.7), turn=0.3),
        9: pose_corners(40.0, centre=(180.1, 60.2), turn=2.0),
    }
    picture = draw((140, 260), rings, family="tag25h9", blur=0.6, noise=1.0)
    find = detector("tag25h9")
    whole = {d.tag: d for d in find.detect(picture)}
    assert whole.keys() == rings.keys()
    for tag, region in {3: (-20, 20, 120, 500), 9: (120, 0, 260, 140)}.items():
        [found] = find.detect(picture, region)
        assert found.tag == tag
        assert np.abs(found.corners - whole[tag].corners).max() < 0.02
    for empty in [(0, 0, 0, 0), (500, 0, 600, 100), (50, 50, 40, 60), (0, 0, 5, 5)]:
        assert find.detect(picture, empty) == []


def test_corrected_bits_are_counted():
    """One wrong cell counts as one; a detector that corrects none does not report the tag."""
    picture = printable("tag36h11", 11, pixels_per_cell=8, margin=2.0)
    start = 2 * 8 + 3 * 8
    picture[start : start + 8, start : start + 8] = 255 - picture[start : start + 8, start : start + 8]
    [found] = detector("tag36h11").detect(picture)
    assert (found.tag, found.hamming) == (11, 1)
    assert detector("tag36h11", max_hamming=0).detect(picture) == []


@pytest.mark.parametrize("family", FAMILIES)
def test_printed_pictures_are_read_upright(family):
    """A printed tag's first corner is its top left; its edges have the length of its cells, without bias."""
    kind = FAMILIES[family]
    for tag in (0, kind.count - 1):
        picture = printable(family, tag, pixels_per_cell=10, margin=1.5)
        [found] = [d for d in detector(family).detect(picture) if d.tag == tag]
        low = 10 * (1.5 + kind.outside) - 0.5
        high = low + 10 * kind.border
        assert np.allclose(found.corners, [[low, low], [high, low], [high, high], [low, high]], atol=0.02)


@pytest.mark.parametrize("family", ["tag16h5", "tag25h9", "tag36h11"])
def test_opencv_prints_the_same_tags_turned_by_half_a_turn(family):
    """Every tag of OpenCV's dictionary is AprilTag 3's, upside down."""
    import cv2

    kind = FAMILIES[family]
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_APRILTAG_{family[3:]}"))
    assert len(dictionary.bytesList) == kind.count
    for tag in range(kind.count):
        theirs = dictionary.generateImageMarker(tag, kind.cells, borderBits=1) // 255
        assert np.array_equal(theirs[::-1, ::-1], bitmap(family, tag))


@pytest.mark.parametrize("family", FAMILIES)
def test_tags_of_a_family_differ_in_as_many_cells_as_its_name_says(family):
    """The smallest distance over all pairs and quarter turns, of the family's first tags, is at least h."""
    kind = FAMILIES[family]
    tags = np.array([bitmap(family, tag) for tag in range(min(kind.count, 60))])
    for turn in range(4):
        turned = np.rot90(tags, turn, axes=(1, 2)).reshape(len(tags), 1, -1)
        apart = np.count_nonzero(turned != tags.reshape(1, len(tags), -1), axis=-1)
        if turn == 0:
            np.fill_diagonal(apart, 99)
        assert apart.min() >= kind.distance


def photograph(name):
    """Return a real photograph, and the published corners of its tags in our order and convention.

    The published corners are AprilTag 3's: counter-clockwise from the bottom left, pixel centres at half integers.
    """
    import cv2

    lines = (PHOTOGRAPHS / f"{name}.txt").read_text().splitlines()
    rings = [
        np.array(re.findall(r"\d+\.\d+", line), float).reshape(4, 2)[::-1] - 0.5 for line in lines if line
    ]
    return cv2.imread(str(PHOTOGRAPHS / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE), rings


def matched(found, rings):
    """Return detected minus given corners [px], (4, 2) each, of given tags with a detection within 3 px."""
    apart = [
        min((d.corners - ring for d in found), key=lambda x: np.linalg.norm(x.mean(axis=0))) for ring in rings
    ]
    return [x for x in apart if np.linalg.norm(x.mean(axis=0)) < 3.0]


@pytest.mark.parametrize("name", ["33369213973_9d9bb4cc96_c", "34139872896_defdb2f8d9_c"])
def test_photographs_agree_with_the_published_corners(name):
    """In real photographs, every published tag is found at its published position.

    The published corners are without refinement, and differ from the fit by about half a pixel.
    """
    picture, published = photograph(name)
    plain = matched(detector("tag36h11", refine="none").detect(picture), published)
    assert len(plain) == len(published)
    assert np.median(np.abs(plain)) < 0.01
    found = detector("tag36h11").detect(picture)
    assert {d.tag for d in found} == {0}
    apart = matched(found, published)
    assert len(apart) == len(published)
    assert np.median(np.linalg.norm(apart, axis=-1)) < 0.6


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"family": "tag99h1"}, "unknown tag family 'tag99h1'; available: tag16h5"),
        (
            {"family": "tag25h9", "refine": "subpix"},
            "unknown refinement 'subpix'; available: fit, edges, none",
        ),
        ({"family": "tag25h9", "gamma": 0.0}, "gamma is 0.0"),
    ],
)
def test_what_does_not_exist_is_refused(arguments, sentence):
    """One sentence lists the available names."""
    with pytest.raises(LocalizationError, match=re.escape(sentence)):
        detector(**arguments)


@pytest.mark.parametrize("picture", [np.zeros((9, 9, 3), np.uint8), np.zeros((9, 9))])
def test_a_picture_that_is_not_gray_bytes_is_refused(picture):
    """Colour pictures and other number types are refused."""
    with pytest.raises(LocalizationError, match="expected gray bytes"):
        detector("tag25h9").detect(picture)


def test_families_answer_to_their_usual_names():
    """The names of AprilTag, OpenCV and everyday use are accepted."""
    for name in ("25h9", "Tag25h9", "DICT_APRILTAG_25h9"):
        assert family_named(name).name == "tag25h9"
    assert family_named("41h12") is FAMILIES["tagStandard41h12"]
    with pytest.raises(LocalizationError, match="its ids are 0 to 34"):
        bitmap("tag25h9", 35)
