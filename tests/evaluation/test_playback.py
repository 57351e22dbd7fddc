"""`finssim play`: records are printed, policies are filmed; and the pictures of the chase camera."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.cli.playback import FilmSettings, PlaybackError, play
from finssim.learning.gymnasium_env import Env
from finssim.learning.train import TrainingSettings, train
from finssim.sim.site import described_world
from finssim.tasks import Environment, StationKeeping, make

cv2 = pytest.importorskip("cv2")
pytest.importorskip("newton")
pytestmark = pytest.mark.slow


def test_an_episode_of_a_policy_is_filmed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    policy = train("t1", TrainingSettings(seed=1, steps=8192, worlds=64), out=tmp_path / "hold")
    monkeypatch.setattr("finssim.cli.playback.task_named", lambda _: StationKeeping(time_limit=0.5))
    play(policy, film=FilmSettings(video=tmp_path / "hold.mp4", speed=2.0))
    film = cv2.VideoCapture(str(tmp_path / "hold.mp4"))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == 6 and film.get(cv2.CAP_PROP_FPS) == pytest.approx(20.0)
    good, first = film.read()
    assert good and first.shape == (360, 640, 3) and first.std() > 5.0
    with pytest.raises(PlaybackError, match="give the film to write"):
        play(policy)
    with pytest.raises(PlaybackError, match="not a policy directory"):
        play(tmp_path / "run.mcap", film=FilmSettings(video=tmp_path / "run.mp4"))
    with pytest.raises(PlaybackError, match="--speed applies only to films"):
        play(tmp_path / "run.mcap", film=FilmSettings(speed=4.0))


def test_the_chase_camera_shows_the_vehicle_ahead_of_it_wherever_that_is():
    """FinsROV's orange float is in the middle of the picture, in T1's basin and in front of the dock."""
    for task in (replace(StationKeeping(), time_limit=1.0), make("camera-docking").task):
        env = Environment(task, worlds=2, seed=3)
        camera = described_world("pool").chase_camera(env, 1, width=320)
        for _ in range(2):
            picture = camera.picture().astype(float)
            orange = picture[..., 0] - picture[..., 2] > 25.0
            rows, columns = np.nonzero(orange)
            assert (
                orange.sum() > 200
                and abs(columns.mean() / 320 - 0.5) < 0.12
                and 0.2 < rows.mean() / 180 < 0.75
            )
            env.reset()


def test_gymnasium_renders():
    env = Env("t1", render_mode="rgb_array")
    env.reset(seed=1)
    assert env.render().shape == (360, 640, 3) and Env("t1").render() is None
