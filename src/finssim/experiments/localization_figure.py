"""The error map of the localization experiment, and what its errors come from."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from finssim.experiments.localization_campaign import REACH, Campaign
from finssim.experiments.localization_scores import Scores

__all__ = ["draw_error_map", "draw_sensitivity"]

INK, PINHOLE, REFRACTIVE = "#222222", "#c0392b", "#1f6fb2"


def draw_error_map(campaign: Campaign, pinhole: Scores, refractive: Scores, path: Path) -> None:
    """Arrows from every held-out place to where each method puts it, longer than true as the titles say.

    Args:
        campaign: What lay where.
        pinhole: Scores of the pinhole method.
        refractive: Scores of the refractive method.
        path: Picture to write.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    places = np.array([visit.nominal[:2] for visit in campaign.visits])
    figure, axes = plt.subplots(1, 2, figsize=(12.0, 4.2), sharey=True, layout="constrained")
    panels = (("pinhole PnP", pinhole, 3.0, PINHOLE), ("refractive", refractive, 10.0, REFRACTIVE))
    for axis, (title, scores, scale, colour) in zip(axes, panels, strict=True):
        axis.plot(*places[campaign.calibrates].T, "+", color="0.7", markersize=5, label="calibrated here")
        at = places[scores.visits]
        axis.plot(*at.T, ".", color=INK, markersize=3, label="held out")
        axis.quiver(
            *at.T,
            *(scale * scores.surveyed.T),
            angles="xy",
            scale_units="xy",
            scale=1.0,
            width=0.003,
            color=colour,
        )
        times = f", arrows {scale:.0f} times as long"
        axis.set_title(f"{title}: RMSE {100.0 * scores.rmse:.2f} cm{times}")
        axis.set(aspect="equal", xlabel="x [m]", xlim=(-REACH[0] - 0.3, REACH[0] + 0.3))
    axes[0].set_ylabel("y [m]")
    axes[0].legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def draw_sensitivity(sensitivity: Mapping[str, Any], path: Path) -> None:
    """RMSE against an error put in on purpose: depth, tilt, index, ripples.

    Args:
        sensitivity: Name -> pairs of the error and the RMSE [cm].
        path: Picture to write.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    labels = {
        "depth_cm": "error of depth [cm]",
        "tilt_deg": "tilt of the water that is not known [°]",
        "index": "error of the water's index",
        "ripples": "rms slope of ripples",
    }
    shown = [name for name in labels if name in sensitivity]
    figure, axes = plt.subplots(
        1, len(shown), figsize=(3.1 * len(shown), 3.0), sharey=True, layout="constrained"
    )
    for axis, name in zip(np.atleast_1d(axes), shown, strict=True):
        axis.plot(*np.array(sensitivity[name], float).T, "o-", color=REFRACTIVE, markersize=4)
        axis.set(xlabel=labels[name], ylim=(0.0, None))
        axis.grid(alpha=0.3)
    np.atleast_1d(axes)[0].set_ylabel("RMSE [cm]")
    figure.savefig(path, dpi=110)
    plt.close(figure)
