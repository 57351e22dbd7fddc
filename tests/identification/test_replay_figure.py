"""The figures of a replay show medians and interquartile ranges of sign-aligned, scaled responses."""

from __future__ import annotations

import numpy as np
import pytest

from finssim.identification.replay_metrics import Pair, find_phases
from finssim.identification.replay_report import draw_overlay, draw_response_envelopes, normalised

T = np.arange(501) / 50.0
MODELS = (("calibrated", 0.8), ("mesh", 1.5))
"""Name and gain of two models."""


def square(level, gain=1.0, axis=0, in_sample=False, name="a"):
    """Return a response that follows its input at once: `level` from 2 s to 8 s; one model gives `gain` times that."""
    tau = np.zeros((len(T), 6))
    tau[:, axis] = np.where((T >= 2.0) & (T < 8.0), level, 0.0)
    response = "uvwpqr"[axis]
    word = ("surge", "sway", "heave", "roll", "pitch", "yaw")[axis]
    return Pair(
        name=name,
        sha256="0",
        t=T,
        rate=50.0,
        axes=(word,),
        phase=find_phases(T, tau, (word,)),
        tau=tau,
        measured={response: 0.1 * tau[:, axis]},
        simulated={"calibrated": {response: 0.1 * gain * tau[:, axis]}},
        in_sample=in_sample,
    )


def lines(axes):
    return {line.get_label(): np.asarray(line.get_ydata()) for line in axes.lines}


@pytest.mark.parametrize("level", [3.0, -3.0, 12.0])
def test_a_normalised_response_is_one_whatever_its_sign_and_level(level):
    pair = square(level)
    t, x = normalised(pair, pair.measured["u"], "surge")
    assert t[np.argmax(x > 0.0)] == 0.0
    assert set(np.round(x, 9)) == {0.0, 1.0}


def test_the_envelope_draws_the_median_of_each_model():
    """For trials whose model is 1, 2 and 9 times the measurement, the median is 2."""
    figure = draw_response_envelopes([square(5.0, 1.0), square(-7.0, 2.0), square(2.0, 9.0)])
    (axes,) = [a for a in figure.axes if a.get_visible()]
    drawn = lines(axes)
    assert drawn["measured"].max() == pytest.approx(1.0)
    assert drawn["Calibrated Fossen"].max() == pytest.approx(2.0)
    assert "3 trials" in axes.get_title(loc="left")


def test_a_panel_for_each_axis_and_none_for_others():
    figure = draw_response_envelopes([square(5.0, axis=i) for i in (0, 2, 5)])
    titles = [a.get_title(loc="left").split()[0] for a in figure.axes if a.get_visible()]
    assert titles == ["surge", "heave", "yaw"]


def test_held_out_trials_are_preferred_and_in_sample_figures_say_so():
    mixed = draw_response_envelopes([square(5.0), square(6.0, in_sample=True)])
    assert "1 trial)" in mixed.axes[0].get_title(loc="left") and not mixed.get_suptitle()
    assert "in-sample" in draw_response_envelopes([square(6.0, in_sample=True)]).get_suptitle()


def test_nothing_measured_is_refused():
    with pytest.raises(ValueError, match="nothing was measured"):
        draw_response_envelopes([square(0.0)])


def test_the_overlay_has_the_input_every_response_and_its_score(tmp_path):
    pair = square(5.0, 1.5)
    pair.measured["depth"] = 1.0 + 0.1 * T
    pair.simulated["calibrated"]["depth"] = 1.0 + 0.1 * T
    figure = draw_overlay(pair)
    assert [a.get_ylabel() for a in figure.axes] == ["input", "$u$ [m/s]", "depth [m]"]
    # Half the span over the 300 of 401 scored samples in which the input lasts: 0.5 √(300/401).
    assert set(lines(figure.axes[1])) == {"measured", "Calibrated Fossen 0.432"}
    figure.savefig(tmp_path / "overlay.png")
    assert (tmp_path / "overlay.png").read_bytes().startswith(b"\x89PNG")


def test_a_passive_trial_has_no_panel_of_inputs():
    pair = square(5.0)
    pair.tau[:] = 0.0
    figure = draw_overlay(pair)
    assert [a.get_ylabel() for a in figure.axes] == ["$u$ [m/s]"] and "passive" in figure.get_suptitle()


def test_no_line_joins_two_replays():
    pair = square(5.0)
    restarted = Pair(**{**vars(pair), "segment": (T >= 5.0).astype(int)})
    assert np.isnan(lines(draw_overlay(restarted).axes[1])["Calibrated Fossen 0.000"]).sum() == 1


@pytest.mark.parametrize(("axes", "columns"), [((0,), 1), ((0, 5), 2), ((0, 1, 2, 5), 2)])
def test_panels_stand_in_two_columns(axes, columns):
    """One axis fills the figure; several are drawn side by side in pairs."""
    figure = draw_response_envelopes([square(5.0, axis=i, name=str(i)) for i in axes])
    drawn = [a for a in figure.axes if a.get_visible()]
    assert len(drawn) == len(axes)
    assert {a.get_subplotspec().get_gridspec().ncols for a in drawn} == {columns}
