"""From a simulation-error fit to changes of the vehicle file: only what the trials determine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.fit import Estimate
from finssim.calibration.regression.axis_estimates import USEFUL, outside, trim
from finssim.calibration.simulation.evidence import Findings
from finssim.calibration.simulation.parameters import Parameters
from finssim.vehicles import AXES

__all__ = ["changes"]

Array = NDArray[np.float64]


def changes(
    p: Parameters,
    x: Array,
    found: dict[str, Estimate],
    evidence: Findings,
    axes: Sequence[str],
    speed: dict[str, float],
    scaled: bool,
) -> dict[str, Any]:
    """Changes of the vehicle file; an axis' damping changes as a pair, where its force at top speed is known.

    Args:
        p: What was free.
        x: Where it ended, (P,).
        found: Its estimates.
        evidence: For the error of the damping force.
        axes: Which to write.
        speed: Highest speed of each axis [m/s or rad/s].
        scaled: Whether a thrust scale belongs to the thrusters' curves.
    """
    out: dict[str, Any] = {}
    base = f"hydrodynamics.{p.hydrodynamics}"
    new = dict(
        zip(("added_mass", "linear_damping", "quadratic_damping"), (m[0] for m in p.matrices(x)), strict=True)
    )
    chosen = p.set
    written: dict[str, list[int]] = {"added_mass": [], "linear_damping": [], "quadratic_damping": []}
    for axis in axes:
        i = AXES.index(axis)
        whole = found[f"{axis}.m_eff"]
        half = 0.5 * (whole.ci95[1] - whole.ci95[0])
        added = found[f"{axis}.added_mass"]
        before = float(np.asarray(chosen.added_mass, float)[i, i])
        if added.estimate > 0.0 and (half <= USEFUL * whole.estimate or outside(before, added.ci95)):
            written["added_mass"].append(i)
        if _force_known(p, x, evidence, axis, speed.get(axis, 0.0)):
            written["linear_damping"].append(i)
            written["quadratic_damping"].append(i)
    # The numbers of axes that nobody measured, but that were simulated: the others hold with these.
    for axis in p.unseen:
        for rows in written.values():
            rows.append(AXES.index(axis))
    for family, rows in written.items():
        old = np.asarray(getattr(chosen, family), float)
        for i in rows:
            for j in range(6):
                # Couplings are written where both axes are, and where the fit did away with them.
                if i == j or (new[family][i, j] != old[i, j] and (j in rows or new[family][i, j] == 0.0)):
                    out[f"{base}.{family}.{i}.{j}"] = float(new[family][i, j])
    water, body = p.vehicle.water, p.vehicle.body
    volume = float(body.displaced_volume)
    excess = found.get("buoyancy_excess")
    if excess is not None and excess.identifiable:
        volume = (p.vehicle.weight + excess.estimate) / (water.density * water.gravity)
        out["body.displaced_volume"] = volume
    stiff = [found[n] for n in ("roll.k", "pitch.k") if n in found]
    before = p.expected[p.names.index("k")] if "k" in p.names else 0.0
    stiff = [e for e in stiff if e.identifiable or (e.estimate > 0.0 and outside(before, e.ci95))]
    if stiff:
        out["body.center_of_buoyancy.2"] = float(p.buoyancy_height(stiff[0].estimate, volume))
    out |= trim(found, water.density * water.gravity * volume, body.center_of_buoyancy)
    for name, path in (("thrust_lag", "time_constant"), ("thrust_delay", "delay")):
        if name in found and found[name].identifiable:
            out[f"thrusters.*.{path}"] = max(found[name].estimate, 1e-4 if path == "time_constant" else 0.0)
    if "thrust_scale" in found and found["thrust_scale"].identifiable and scaled:
        scale = found["thrust_scale"].estimate
        for name, thruster in p.vehicle.thrusters.items():
            for key in ("c_plus", "c_minus", "force_min", "force_max"):
                out[f"thrusters.{name}.{key}"] = scale * float(getattr(thruster, key))
    return out


def _force_known(p: Parameters, x: Array, found: Findings, axis: str, speed: float) -> bool:
    """Whether the damping force of an axis at a speed is known to `USEFUL`, or excludes that of the vehicle file."""
    i = AXES.index(axis)
    unit = 1e-5 * np.maximum(np.abs(x), p.scale)
    points = np.concatenate([x[None], np.clip(x + np.diag(unit), p.low, p.high)])
    _, D1, D2 = p.matrices(points)
    force = D1[:, i, i] * speed + D2[:, i, i] * speed**2
    slope = (force[1:] - force[0]) / unit
    before = float(p.set.linear_damping[i][i] * speed + p.set.quadratic_damping[i][i] * speed**2)
    used = np.flatnonzero(slope)
    V = found.covariance.trials[np.ix_(used, used)]
    if found.covariance.alone[used].any():
        V = found.covariance.local[np.ix_(used, used)]
    if not np.isfinite(V).all():
        return False
    std = float(np.sqrt(max(slope[used] @ V @ slope[used], 0.0)))
    close, excluded = 2.0 * std < USEFUL * force[0], abs(before - force[0]) > 2.0 * std
    return bool(force[0] > 0.0 and (close or excluded))
