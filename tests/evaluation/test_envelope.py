"""The error envelope consists of the quartiles of the errors, and the figure shows them with the success limits."""

from __future__ import annotations

import math

import numpy as np
import pytest

from finssim.control.guidance import Station
from finssim.core.files import OutputError
from finssim.core.rotations import quat_from_yaw
from finssim.evaluation.figures import draw_envelopes, error_envelope, save_figure
from finssim.evaluation.trials import GoalTrial, VehicleMotion

GOAL = np.array([1.0, 0.3, -0.5, math.pi])
T = np.arange(601) / 10.0


def at_distance(distance, turn=0.0, t=T):
    """Return a trial that stays `distance` below the goal, turned by `turn`."""
    position = np.tile(GOAL[:3], (len(t), 1)) - np.outer(np.broadcast_to(distance, t.shape), [0.0, 0.0, 1.0])
    quaternion = quat_from_yaw(np.full(len(t), GOAL[3] - 2 * math.pi) + turn)
    guide = Station(tuple(GOAL[:3]), GOAL[3])
    return GoalTrial(
        name="P", guide=guide, motion=VehicleMotion(t=t, position=position, quaternion=quaternion)
    )


def test_five_constant_errors_have_their_own_quartiles():
    """The quartiles of 1, 2, 3, 4, 5 are 2, 3, 4: in centimetres of distance and in degrees of either sign."""
    t, position, yaw = error_envelope(
        [at_distance(k / 100, math.radians(k) * (-1) ** k) for k in (5, 1, 4, 2, 3)]
    )
    expected = np.tile([[2.0], [3.0], [4.0]], len(T))
    np.testing.assert_allclose(position * 100, expected)
    np.testing.assert_allclose(np.degrees(yaw), expected)
    np.testing.assert_allclose(t, T)


def test_a_trial_that_ends_early_leaves_the_quartiles_to_the_others():
    """If one of three ends at 10 s, two remain; where two of three have ended, nothing is drawn."""
    short = at_distance(0.9, t=T[:101])
    _, two_left, _ = error_envelope([at_distance(0.1), at_distance(0.3), short])
    np.testing.assert_allclose(two_left[1, [100, 101, 600]], [0.3, 0.2, 0.2])
    _, one_left, _ = error_envelope([at_distance(0.1), short, short])
    assert np.isfinite(one_left[:, 100]).all() and np.isnan(one_left[:, 101:]).all()


def test_no_trials_have_no_envelope():
    with pytest.raises(ValueError, match="at least one trial"):
        error_envelope([])


def test_the_figure_draws_each_median_and_both_limits(tmp_path):
    runs = {name: [at_distance(d), at_distance(2 * d)] for name, d in (("pid", 0.2), ("ppo", 0.01))}
    above, below = draw_envelopes(runs).axes
    for axes, limit in ((above, 0.10), (below, 10.0)):
        medians = [line.get_ydata() for line in axes.lines if len(line.get_xdata()) == len(T)]
        assert len(medians) == 2
        assert any(np.allclose(line.get_ydata(), limit) for line in axes.lines)
    np.testing.assert_allclose(above.lines[0].get_ydata(), 0.3)
    assert save_figure(draw_envelopes(runs), tmp_path / "envelope.png").read_bytes().startswith(b"\x89PNG")


def test_a_figure_that_cannot_be_written_says_so(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="write elsewhere"):
        save_figure(draw_envelopes({"pid": [at_distance(0.1)]}), tmp_path / "file" / "envelope.png")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
