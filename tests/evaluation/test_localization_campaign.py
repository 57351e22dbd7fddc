"""The simulated campaign: repeatable, with errors of the stated size, and a calibration isolated from the truth."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest

from finssim.core.rotations import matrix_to_quat, quat_to_euler
from finssim.studies.localization import (
    CONDITIONS,
    IMAGES,
    LOCATIONS,
    REACH,
    Conditions,
    calibrate,
    draw_campaign,
    lifted,
    pictures,
    published_pool,
    scene_of,
)

SMALL = {"locations": (6, 4), "images": 48}


def plain(thing):
    """Return a campaign as nested lists, which compare equal number by number."""
    if dataclasses.is_dataclass(thing):
        return {f.name: plain(getattr(thing, f.name)) for f in dataclasses.fields(thing)}
    if isinstance(thing, (tuple, list)):
        return [plain(item) for item in thing]
    return thing.tolist() if isinstance(thing, np.ndarray) else str(thing)


@pytest.mark.parametrize("name", CONDITIONS)
def test_equal_seeds_give_equal_campaigns(name):
    """Campaigns of equal seeds are equal number by number; another seed gives another campaign."""
    one, same, other = (draw_campaign(CONDITIONS[name], seed, **SMALL) for seed in (4, 4, 5))
    assert plain(one) == plain(same)
    assert plain(one)["calibrates"] != plain(other)["calibrates"]


def test_the_campaign_is_the_published_one():
    """The campaign has 170 places over the pool's middle, 720 pictures shared evenly, and 85 calibration places."""
    campaign = draw_campaign(CONDITIONS["published"], 1)
    places = np.array([visit.nominal for visit in campaign.visits])
    assert len(places) == LOCATIONS[0] * LOCATIONS[1] == 170
    np.testing.assert_allclose(np.abs(places).max(axis=0), [*REACH, 0.0])
    assert len(np.unique(places.round(9), axis=0)) == 170
    images = [visit.images for visit in campaign.visits]
    assert sum(images) == IMAGES == 720 and set(images) == {4, 5}
    assert campaign.calibrates.sum() == 85


def test_the_camera_is_the_published_one():
    """Every digit of the lens and the height above the water are as published."""
    camera = published_pool().camera
    assert (camera.lens.fx, camera.lens.fy) == (540.9305, 540.9305)
    assert (camera.lens.cx, camera.lens.cy) == (682.2341, 348.6136)
    assert camera.lens.distortion == (0.02944176, -0.05975546, 0.00088098, 0.00179148, 0.01256862)
    assert camera.position[2] == 2.171935


def errors_of(campaign):
    """Return the errors of each visit: survey (3), heading, true roll and pitch, depth, measured roll and pitch."""
    rows = []
    for visit in campaign.visits:
        roll, pitch, yaw = quat_to_euler(matrix_to_quat(visit.R_pb))
        depth = visit.depth_read + float(campaign.truth.interface.distance(visit.position))
        rows.append(
            [*(visit.position - visit.nominal), yaw, roll, pitch, depth]
            + [visit.roll_read - roll, visit.pitch_read - pitch]
        )
    return np.array(rows)


def test_errors_of_visits_have_the_stated_spread():
    """Standard deviations and means are within four of their standard errors; no error is repeated."""
    c = CONDITIONS["published"]
    errors = np.concatenate([errors_of(draw_campaign(c, seed)) for seed in range(6)])
    stated = np.array([c.survey] * 3 + [c.heading, c.tilt, c.tilt, c.depth, c.tilt, c.tilt])
    n = len(errors)
    assert np.abs(errors.std(axis=0) / stated - 1.0).max() < 4.0 / np.sqrt(2 * n)
    assert (np.abs(errors.mean(axis=0)) / stated).max() < 4.0 / np.sqrt(n)
    correlation = np.corrcoef(errors.T) - np.eye(errors.shape[1])
    assert np.abs(correlation).max() < 5.0 / np.sqrt(n)


def test_errors_of_a_campaign_have_the_stated_spread():
    """Lens, tape and level are drawn once per campaign."""
    c, true = CONDITIONS["published"], published_pool()
    drawn = [draw_campaign(c, seed, locations=(2, 2), images=4) for seed in range(400)]
    lens = true.camera.lens
    errors = np.array(
        [
            [
                one.lens.fx - lens.fx,
                one.lens.cx - lens.cx,
                one.lens.cy - lens.cy,
                one.water_read - 1.0,
                *one.truth.interface.normal[:2],
            ]
            for one in drawn
        ]
    )
    stated = np.array([c.lens] * 3 + [c.tape, c.level, c.level])
    assert np.abs(errors.std(axis=0) / stated - 1.0).max() < 4.0 / np.sqrt(2 * len(drawn))
    assert (np.abs(errors.mean(axis=0)) / stated).max() < 4.0 / np.sqrt(len(drawn))
    assert all(one.lens.fx == one.lens.fy + (lens.fx - lens.fy) for one in drawn)
    # The camera is as given; its file has the error.
    assert all(one.truth.camera.lens == lens for one in drawn)


@pytest.mark.parametrize("name", [f.name for f in dataclasses.fields(Conditions)])
def test_each_condition_alone_does_what_it_says(name):
    """With all other errors zero, only that of the condition is present."""
    none = {field.name: 0.0 for field in dataclasses.fields(Conditions)}
    campaign = draw_campaign(Conditions(**{**none, name: 0.01}), 3, **SMALL)
    true = published_pool()
    # The tilt is drawn twice: the tag's own and the measured one.
    wrong = set(np.flatnonzero(np.abs(errors_of(campaign)).max(axis=0) > 1e-9))
    expected = {"survey": {0, 1, 2}, "heading": {3}, "tilt": {4, 5, 7, 8}, "depth": {6}}
    assert wrong == expected.get(name, set())
    assert (campaign.lens != true.camera.lens) == (name == "lens")
    assert (campaign.water_read != 1.0) == (name == "tape")
    assert np.allclose(campaign.truth.interface.normal, [0, 0, 1], atol=1e-12) == (name != "level")
    assert (scene_of(campaign).ripples is None) == (name != "ripples")


def test_quiet_conditions_have_no_error_but_that_of_the_pictures():
    """Every standard deviation is zero; the flat conditions differ from the published ones in ripples alone."""
    assert not any(vars(CONDITIONS["quiet"]).values())
    assert replace(CONDITIONS["flat"], ripples=CONDITIONS["published"].ripples) == CONDITIONS["published"]


def test_lifting_moves_reading_and_truth_alike():
    """Only held-out visits are lifted, with every error unchanged."""
    campaign = draw_campaign(CONDITIONS["published"], 2, **SMALL)
    higher = lifted(campaign, 0.4)
    before = [v for v, c in zip(campaign.visits, campaign.calibrates, strict=True) if not c]
    assert len(higher.visits) == len(before) == 12 and not higher.calibrates.any()
    for old, new in zip(before, higher.visits, strict=True):
        np.testing.assert_allclose(new.position - old.position, [0, 0, 0.4], atol=1e-12)
        np.testing.assert_allclose(new.nominal - old.nominal, [0, 0, 0.4], atol=1e-12)
        np.testing.assert_array_equal(new.R_pb, old.R_pb)
    np.testing.assert_allclose(errors_of(higher), errors_of(campaign)[~campaign.calibrates], atol=1e-9)
    assert (higher.truth, higher.lens, higher.water_read) == (
        campaign.truth,
        campaign.lens,
        campaign.water_read,
    )


@pytest.fixture(scope="module")
def calibrated():
    """A campaign with geometric pictures, the pictures and the calibration."""
    campaign = draw_campaign(CONDITIONS["published"], 1, **SMALL)
    seen = list(pictures(campaign, "geometry"))
    return campaign, seen, calibrate(campaign, seen)


def test_calibration_uses_its_own_half_alone(calibrated):
    """Frames and survey contain each picture of the calibration visits once, and no others."""
    campaign, seen, found = calibrated
    of_half = {p.name for p in seen if campaign.calibrates[p.visit]}
    assert {frame.image for frame in found.frames} == of_half == {row["image"] for row in found.survey}
    assert len(found.frames) == len(found.survey) == len(of_half) == 24
    held_out = {p.name for p in seen if not campaign.calibrates[p.visit]}
    assert len(held_out) == 24 and not held_out & of_half


def test_calibration_looks_neither_at_the_truth_nor_at_held_out_visits(calibrated):
    """With another truth, or with every held-out visit and its picture moved, the pools are bit-identical."""
    campaign, seen, found = calibrated
    rng = np.random.default_rng(0)
    visits = []
    for visit, calibrates in zip(campaign.visits, campaign.calibrates, strict=True):
        hidden = replace(
            visit,
            position=visit.position + rng.normal(size=3),
            R_pb=np.full((3, 3), np.nan),
            depth_read=float(rng.normal()),
            roll_read=float(rng.normal()),
        )
        if not calibrates:
            hidden = replace(hidden, nominal=hidden.nominal + rng.normal(size=3))
        visits.append(hidden)
    other = replace(campaign, visits=tuple(visits), truth=published_pool(tilt_x=0.1, tilt_y=-0.2))
    elsewhere = []
    for picture in seen:
        if not campaign.calibrates[picture.visit]:
            moved = replace(picture.detection, corners=picture.detection.corners + 50.0)
            picture = replace(picture, detection=moved)
        elsewhere.append(picture)
    again = calibrate(other, elsewhere)
    assert again.refractive.sha256 == found.refractive.sha256
    assert again.pinhole.sha256 == found.pinhole.sha256


def test_calibration_is_near_the_truth_which_it_does_not_know(calibrated):
    """The camera is found within 2 cm, its height above the water within 1 cm, the water's tilt within half a
    degree."""
    campaign, _, found = calibrated
    true, ours = campaign.truth, found.refractive
    assert np.linalg.norm(ours.camera.position - true.camera.position) < 0.02
    x, y, z = true.camera.position
    assert ours.interface.height(x, y) == pytest.approx(true.interface.height(x, y), abs=0.01)
    assert ours.interface.normal @ true.interface.normal > np.cos(np.radians(0.5))
    straight = found.pinhole.interface
    assert straight.index_near == straight.index_far  # straight lines, above the same water
    assert straight.height(0.0, 0.0) == pytest.approx(campaign.water_read)
    assert found.pinhole.camera.position[2] < z - 0.1  # for which the floor appears raised
