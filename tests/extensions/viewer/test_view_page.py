"""The page in a real browser: it plays, draws the vehicle at its pose, and follows the slider."""

import shutil
import time

import cv2
import numpy as np
import pytest

from finssim.core.rotations import quat_to_matrix
from finssim.extensions.viewer.app import View
from finssim.extensions.viewer.sources import RecordSource

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
SOFTWARE = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
PATIENCE = 120.0
"""Time limit for software rendering on a busy machine [s]."""


@pytest.fixture
def view(trial):
    """Page of the record, paused at its beginning."""
    view = View(
        RecordSource(trial.record, truth=trial.truth, basin=(4.0, 2.0, 1.0)), port=8230, playing=False
    )
    yield view
    view.close()


@pytest.fixture
def page(view):
    """The page in headless Chromium."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(SOFTWARE))
        page = browser.new_page(viewport={"width": 960, "height": 640})
        page.set_default_timeout(1e3 * PATIENCE)
        page.goto(view.url)
        page.wait_for_selector("canvas")
        page.locator(".mantine-Notification-closeButton").first.click()  # renders without a GPU
        yield page
        browser.close()


def shot(page):
    """Return a screenshot of the page, (h, w, 3) BGR."""
    return cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)


def place_of(view, position):
    """Return the position on the page of a point of the world [px]."""
    (client,) = view.server.get_clients().values()
    camera = client.camera
    w, x, y, z = camera.wxyz
    ray = quat_to_matrix([x, y, z, w]).T @ (np.asarray(position) - camera.position)
    focal = 0.5 * camera.image_height / np.tan(0.5 * camera.fov)
    return 0.5 * np.array([camera.image_width, camera.image_height]) + focal * ray[:2] / ray[2]


def orange_near(picture, place, reach=45):
    """Return the number of pixels around a position that have the colour of the true vehicle."""
    x, y = place.round().astype(int)
    part = picture[max(y - reach, 0) : y + reach, max(x - reach, 0) : x + reach].astype(int)
    blue, green, red = np.moveaxis(part, 2, 0)
    return int(((red - blue > 40) & (red > green)).sum())


def until(view, page, holds):
    """Turn the loop until the page fulfils the condition, and return the picture."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        view.turn(0.6)
        picture = shot(page)
        if holds(picture):
            return picture
    pytest.fail("the page never showed it")


def wait(holds):
    """Wait until another thread makes a condition true."""
    end = time.monotonic() + PATIENCE
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Debian's chromium")
def test_the_vehicle_is_drawn_where_it_is_and_moves_with_the_slider(view, page):
    """The page has hundreds of colours, and truth-coloured pixels at the projected pose.

    At the slider's end they are elsewhere.
    """
    page.get_by_role("button", name="play").click()
    wait(lambda: view.playback.playing)
    view.turn(0.6)
    assert view.playback.time > 0.0
    view.playback.play(False)
    view.playback.seek(1.0)
    view.turn(0.6)
    true = view.source.frame(1.0).truth.position
    before = until(view, page, lambda picture: orange_near(picture, place_of(view, true)) > 150)
    first = place_of(view, true)
    scene = before[:, : int(2 * first[0])]
    assert len(np.unique(scene.reshape(-1, 3), axis=0)) > 200

    page.get_by_role("slider").first.press("End")
    last = place_of(view, view.source.frame(view.source.duration).truth.position)
    assert np.linalg.norm(last - first) > 40.0
    left = 0.5 * orange_near(before, first, reach=20)

    def moved(picture):
        there, here = orange_near(picture, last, reach=20), orange_near(picture, first, reach=20)
        return view.playback.time > 5.0 and there > 100 and here < left

    after = until(view, page, moved)
    # The camera's picture in the panel follows, too.
    panel = np.s_[200:, int(0.7 * after.shape[1]) :]
    assert (np.abs(after[panel].astype(int) - before[panel]) > 40).sum() > 500


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Debian's chromium")
def test_on_a_phone_the_panel_lies_below_the_scene(page):
    """The panel is as wide as the page and at most half as high; a tap on its head collapses it to the head."""
    page.set_viewport_size({"width": 390, "height": 844})
    panel = page.locator(".mantine-Paper-root[style*='fixed']")
    panel.wait_for()
    wait(lambda: panel.bounding_box()["height"] > 0.2 * 844)
    box = panel.bounding_box()
    assert box["x"] == 0 and box["width"] == 390 and box["height"] <= 0.5 * 844
    assert box["y"] + box["height"] == pytest.approx(844, abs=1)
    page.get_by_text("FinsSim", exact=True).first.click()
    wait(lambda: panel.bounding_box()["height"] < 0.1 * 844)
