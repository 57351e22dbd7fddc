"""A hand-made fit with every kind of outcome: written, unidentifiable, without a key in the vehicle file."""

from __future__ import annotations

from typing import Any

import numpy as np

from finssim.identification.fit import Correlation, Curve, Estimate, Fit
from finssim.trials.findings import finding
from finssim.vehicles import Vehicle, load_vehicle

SET = "hydrodynamics.calibrated"


def made_fit(vehicle: Vehicle | None = None, **changes: Any) -> Fit:
    """Return a fit with surge identified, yaw's quadratic term not, thrust without a key, one lag for all thrusters."""
    t = np.linspace(0.0, 10.0, 60)
    estimates = [
        ("surge.m_eff", 30.1, (29.0, 31.2), "kg", True, "", None),
        ("surge.added_mass", 17.9, (16.9, 19.0), "kg", True, "", f"{SET}.added_mass.0.0"),
        ("surge.d1", 39.1, (37.9, 40.2), "N s/m", True, "", f"{SET}.linear_damping.0.0"),
        (
            "yaw.d2",
            0.1,
            (0.0, 9.0),
            "N m s²/rad²",
            False,
            "is at its bound",
            f"{SET}.quadratic_damping.5.5",
        ),
        ("heave.d1", 81.0, (-np.inf, np.nan), "N s/m", False, "no speed", f"{SET}.linear_damping.2.2"),
        ("thrust_lag", 0.15, (0.1, 0.2), "s", True, "", "thrusters.*.time_constant"),
        ("thrust_scale", 0.97, (0.95, 0.99), "-", True, "", None),
    ]
    names = [name for name, *_ in estimates]
    return Fit(
        **{
            "kind": "hydrodynamics",
            "method": "simulation",
            "before": vehicle or load_vehicle("finsrov"),
            "estimates": {
                n: Estimate(name=n, estimate=e, ci95=ci, unit=u, identifiable=i, note=note, path=path)
                for n, e, ci, u, i, note, path in estimates
            },
            "changes": {
                f"{SET}.added_mass.0.0": 17.9,
                f"{SET}.linear_damping.0.0": 39.1,
                "thrusters.*.time_constant": 0.15,
            },
            "quality": {"surge": {"r2": 0.998, "rmse": 0.01, "samples": 900.0}},
            "correlation": Correlation(names=tuple(names), matrix=np.eye(len(names))),
            "findings": (finding("at_bound", "yaw.d2", free=-1.2, unit="N m s²"),),
            "curves": (
                Curve(
                    title="surge, trial a",
                    x_label="t [s]",
                    y_label="u [m/s]",
                    x=t,
                    measured=np.sin(t),
                    fitted=np.sin(t) + 0.01,
                ),
                Curve(
                    title="surge",
                    x_label="u [m/s]",
                    y_label="drag [N]",
                    x=t,
                    measured=t,
                    fitted=t + 0.1,
                    kind="scatter",
                ),
            ),
            "trials": {"a": "11" * 32, "b": "22" * 32},
            "settings": {"axes": ["surge"], "seed": np.int64(4), "horizon": None},
            **changes,
        }
    )
