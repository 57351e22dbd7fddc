"""Error statistics against the survey and the truth, by visit, with intervals; and the effect of each error source."""

import json
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from finssim.studies import localization as localization_experiment
from finssim.studies.localization import CONDITIONS, Scores, draw_campaign, pictures, pooled

PIXEL_STD = 0.2
locate = partial(localization_experiment.locate, pixel_std=PIXEL_STD)
SMALL = {"locations": (6, 4), "images": 48}


def seen_by_geometry(name, seed=1):
    """Return a campaign and its geometric pictures."""
    campaign = draw_campaign(CONDITIONS[name], seed, **SMALL)
    return campaign, list(pictures(campaign, "geometry"))


@pytest.fixture(scope="module")
def published():
    """The campaign with every error."""
    return seen_by_geometry("published")


@pytest.fixture(scope="module")
def exact():
    """The campaign without any error."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(localization_experiment, "CORNER_NOISE", 0.0)
        return seen_by_geometry("quiet")


@pytest.mark.parametrize("method", ["refractive", "refractive-6dof"])
def test_without_errors_refraction_is_exact(exact, method):
    """With exact corners and the true pool, every position is within 0.1 mm."""
    campaign, seen = exact
    scores = locate(campaign, seen, campaign.truth, method)
    assert scores.located == scores.pictures == 24 and not scores.reasons
    assert np.linalg.norm(scores.surveyed, axis=1).max() < 1e-4


def test_straight_lines_with_depth_are_centimetres_off_even_then(exact):
    """With the true camera pose, straight lines that ignore the water are centimetres off."""
    campaign, seen = exact
    dry = replace(campaign.truth, interface=replace(campaign.truth.interface, index_far=1.0003))
    assert locate(campaign, seen, dry, "pinhole-depth").rmse > 0.02


def test_refraction_beats_straight_lines_with_depth(published):
    """With every error and the true camera, refraction is at least ten times better."""
    campaign, seen = published
    rmse = {m: locate(campaign, seen, campaign.truth, m).rmse for m in ("refractive", "pinhole-depth")}
    assert 10.0 * rmse["refractive"] < rmse["pinhole-depth"]
    assert rmse["refractive"] < 0.01


def test_refraction_with_depth_is_less_noisy_than_what_finds_the_depth_itself():
    """With picture noise alone, the error is 1.5 times smaller than with distance from a tag's apparent size."""
    campaign, seen = seen_by_geometry("quiet")
    rmse = {m: locate(campaign, seen, campaign.truth, m).rmse for m in ("refractive", "pinhole")}
    assert 1.5 * rmse["refractive"] < rmse["pinhole"]


def test_held_out_visits_alone_are_scored_each_once(published):
    """Held-out visits are scored once; errors against survey and truth differ by the survey's own error."""
    campaign, seen = published
    scores = locate(campaign, seen, campaign.truth, "refractive")
    np.testing.assert_array_equal(scores.visits, np.flatnonzero(~campaign.calibrates))
    own = [campaign.visits[k].position[:2] - campaign.visits[k].nominal[:2] for k in scores.visits]
    np.testing.assert_allclose(scores.surveyed - scores.true, own, atol=1e-12)
    assert scores.pictures == sum(not campaign.calibrates[p.visit] for p in seen)
    assert scores.rmse == pytest.approx(np.sqrt(np.mean(np.sum(scores.surveyed**2, axis=1))))


def test_pictures_of_a_visit_are_averaged(published):
    """Half of the pictures give the same visits with larger errors."""
    campaign, seen = published
    one_each = list({p.visit: p for p in seen}.values())
    several, single = (
        locate(campaign, pictures_, campaign.truth, "refractive") for pictures_ in (seen, one_each)
    )
    assert single.located == len(single.visits) == len(several.visits) < several.located
    first, second = ([p for p in seen if p.visit == k] for k in several.visits[:2])
    alone = [locate(campaign, [p], campaign.truth, "refractive").surveyed[0] for p in first]
    np.testing.assert_allclose(several.surveyed[0], np.mean(alone, axis=0), atol=1e-12)
    assert second


def test_refused_pictures_are_counted_by_their_reason(published):
    """An undetected tag, and one whose corners fit no pose, are counted by reason."""
    campaign, seen = published
    held_out = [p for p in seen if not campaign.calibrates[p.visit]]
    lost, broken, *rest = held_out
    crossed = replace(broken.detection, corners=broken.detection.corners[[0, 2, 1, 3]])
    given = [replace(lost, detection=None), replace(broken, detection=crossed), *rest]
    scores = locate(campaign, given, campaign.truth, "refractive")
    assert scores.located == scores.pictures - 2 == len(held_out) - 2
    assert sum(scores.reasons.values()) == 2 and scores.reasons["tag not detected"] == 1


def score(errors, **more):
    """Return the scores of given errors [m]."""
    e = np.array(errors, float).reshape(-1, 2)
    given = {"pictures": len(e), "located": len(e), "reasons": {}, **more}
    return Scores(np.arange(len(e)), e, e / 2.0, **given)


def test_figures_are_pooled_over_visits():
    """3-4-5 triangles give the expected rms and 95th percentile in centimetres; counts and reasons are summed."""
    one = score([[0.03, 0.04], [0.0, 0.05]], reasons={"tag not detected": 1}, pictures=3)
    two = score([[0.06, 0.08]], reasons={"tag not detected": 2, "no": 1}, pictures=4)
    figures = pooled([one, two])
    assert figures["rmse_cm"] == pytest.approx(math.sqrt((25 + 25 + 100) / 3))
    assert figures["p95_cm"] == pytest.approx(np.percentile([5, 5, 10], 95))
    assert figures["rmse_to_truth_cm"] == pytest.approx(figures["rmse_cm"] / 2)
    assert figures["p95_to_truth_cm"] == pytest.approx(figures["p95_cm"] / 2)
    assert (figures["visits"], figures["pictures"], figures["located"]) == (3, 7, 3)
    assert figures["reasons"] == {"tag not detected": 3, "no": 1}


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [1, 3, 10])
def test_intervals_contain_the_estimate_and_are_repeatable(seeds):
    """Intervals contain the estimate, are repeatable, and shrink with more visits of the same errors."""
    rng = np.random.default_rng(seeds)
    drawn = [rng.normal(0.0, 0.01, (20, 2)) for _ in range(seeds)]
    few, many = [score(e) for e in drawn], [score(np.tile(e, (16, 1))) for e in drawn]
    width = {}
    for name, scores in (("few", few), ("many", many)):
        figures = pooled(scores)
        assert figures == pooled(scores)
        for key in ("rmse", "p95"):
            low, high = figures[f"{key}_ci95_cm"]
            assert low < high and low <= figures[f"{key}_cm"] <= high
        width[name] = np.diff(figures["rmse_ci95_cm"])[0]
    assert width["many"] < (0.3 if seeds == 1 else 1.0) * width["few"]


def test_seeds_that_disagree_widen_the_interval():
    """The interval is wider if the same errors are divided between seeds by size instead of evenly."""
    small, large = np.full((50, 2), 0.001), np.full((50, 2), 0.01)
    mixed = [score(np.vstack([small[::2], large[::2]])) for _ in range(2)]
    apart = [score(small), score(large)]
    a, b = (np.diff(pooled(scores)["rmse_ci95_cm"])[0] for scores in (mixed, apart))
    assert b > 3.0 * a


@pytest.mark.parametrize(
    "empty", [[score([])], [score([]), score([[0.03, 0.04]])]], ids=["all", "one of two"]
)
def test_where_nothing_was_located_there_is_no_figure(empty):
    """Without located pictures there is no figure, no exception, and valid JSON."""
    figures = pooled(empty)
    json.dumps(figures, allow_nan=False)
    if len(empty) == 1:
        assert figures["rmse_cm"] is None and figures["p95_ci95_cm"] == [None, None]
    else:
        assert figures["rmse_cm"] == pytest.approx(5.0)


@pytest.mark.parametrize(("offset", "sign"), [(0.05, 1.0), (-0.05, -1.0)])
def test_a_depth_read_too_deep_puts_the_tag_too_far_out(exact, offset, sign):
    """The tag moves outwards from the point below the camera, by tan of the ray's angle in the water."""
    campaign, seen = exact
    visits = tuple(replace(visit, depth_read=visit.depth_read + offset) for visit in campaign.visits)
    scores = locate(replace(campaign, visits=visits), seen, campaign.truth, "refractive")
    outwards = np.array(
        [campaign.visits[k].position[:2] - campaign.truth.camera.position[:2] for k in scores.visits]
    )
    far = np.linalg.norm(outwards, axis=1) > 0.8
    moved = np.sum(scores.true * outwards, axis=1)[far] / np.linalg.norm(outwards, axis=1)[far]
    assert (sign * moved > 0.2 * abs(offset)).all() and (sign * moved < abs(offset)).all()
