"""`finssim worlds`: sites are listed, described and drawn."""

import math
import sys

import numpy as np
import pytest

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.core.sonar_fan import fan_picture
from finssim.extensions.perception.description import sites
from finssim.vehicles.device_files import devices


def finssim(*words):
    return boundary.run(app, [str(word) for word in words])


def test_every_site_and_sensor_is_listed(capsys):
    """Each entry has a name and a description."""
    assert finssim("worlds") == 0
    out = capsys.readouterr().out
    assert all(name in out for name in (*sites(), *devices()))


def test_a_fan_shows_each_echo_where_it_is():
    """A beam's cell lands at its azimuth and range: left of the middle for positive azimuth, as y points
    left."""
    sector, side = math.radians(120.0), 400
    levels = np.zeros((60, 40))
    levels[10, 29] = 1.0  # azimuth 60° - 21° = 39°, range 0.7375
    picture = fan_picture(levels, sector, side)
    v, u = np.nonzero(picture == 1.0)
    x, y = u.mean() - 0.5 * (picture.shape[1] - 1), side - 1 - v.mean()
    assert math.degrees(math.atan2(-x, y)) == pytest.approx(39.0, abs=0.3)
    assert math.hypot(x, y) / side == pytest.approx(0.7375, abs=0.005)
    assert np.isnan(picture[0, 0]) and picture.shape[1] == round(2.0 * side * math.sin(0.5 * sector))


def test_what_is_no_camera_or_no_picture_is_refused(capsys, tmp_path):
    """A sensor that is not a camera and an output that is not a picture are refused in one sentence each."""
    assert finssim("worlds", "show", "pool", "--camera", "ping") == 2
    assert "expected a camera and an imaging sonar" in capsys.readouterr().err
    assert finssim("worlds", "show", "pool", "--out", tmp_path / "pool.doc") == 2
    assert "expected .png" in capsys.readouterr().err
    assert finssim("worlds", "show", "pol") == 2
    assert "did you mean 'pool'?" in capsys.readouterr().err


@pytest.mark.slow
def test_a_site_is_drawn(capsys, tmp_path, monkeypatch):
    """Images of camera and sonar are drawn side by side, with the numbers of the site."""
    pytest.importorskip("newton", reason="finssim[perception] is not installed")
    from finssim.extensions.perception import show as worlds_show

    monkeypatch.setattr(worlds_show, "WIDTH", 120)
    assert finssim("worlds", "show", "dock", "--lamps", "--seed", 1, "--out", tmp_path / "dock.png") == 0
    assert (tmp_path / "dock.png").read_bytes().startswith(b"\x89PNG")
    assert "beacons_upper" in capsys.readouterr().out


def test_without_newton_the_extra_is_named(capsys, tmp_path, monkeypatch):
    """Worlds are read without Newton; rendering them is refused with the extra to install."""
    monkeypatch.setitem(sys.modules, "newton", None)
    assert finssim("worlds", "show", "pool") == 0
    assert finssim("worlds", "show", "pool", "--out", tmp_path / "pool.png") == 2
    assert "newton is not installed: pip install 'finssim[perception]'" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
