"""Which parameters the data cannot tell apart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.findings import Finding, finding
from finssim.calibration.fit import Correlation

__all__ = ["correlation", "degeneracy"]

Array = NDArray[np.float64]

TIGHT = 0.98
"""Multiple correlation of a parameter with the others above which it counts as traded off."""

LOOSE = 0.1
"""Relative standard error below which a trade-off does not matter."""


def correlation(names: Sequence[str], covariance: Array) -> Correlation:
    """Correlation of the errors; zero for parameters without a finite variance.

    Args:
        names: (P,)
        covariance: (P, P)
    """
    variance = np.diagonal(covariance)
    good = np.isfinite(variance) & (variance > 0.0)
    std = np.sqrt(np.where(good, variance, 1.0))
    matrix = np.where(np.outer(good, good), covariance / np.outer(std, std), 0.0)
    np.fill_diagonal(matrix, 1.0)
    return Correlation(names=tuple(names), matrix=np.clip(matrix, -1.0, 1.0))


def degeneracy(
    names: Sequence[str], covariance: Array, theta: Array | None = None
) -> tuple[Correlation, list[Finding]]:
    """Correlation of the errors, and a finding for each group of parameters that trade off.

    The groups are the weak directions of the scaled information: eigenvectors of the errors' correlation with large
    eigenvalues. A trade-off among parameters that are all known well is left out.

    Args:
        names: (P,)
        covariance: Of the estimates, best the local one, (P, P); infinite variances name unknown parameters.
        theta: Estimates, to tell which are known well; all count as loose where not given, (P,).

    Returns:
        Correlation, and what trades off and what would settle it.
    """
    found = correlation(names, covariance)
    variance = np.diagonal(covariance)
    unknown = [name for name, v in zip(names, variance, strict=True) if not np.isfinite(v)]
    findings = [finding("undetermined", parameters=tuple(unknown))] if unknown else []
    std = np.sqrt(np.where(np.isfinite(variance), np.maximum(variance, 0.0), 0.0))
    loose = np.isfinite(variance) & (variance > 0.0)
    if theta is not None:
        loose &= std > LOOSE * np.abs(theta)
    index = np.flatnonzero(np.isfinite(variance) & (variance > 0.0))
    if len(index) < 2:
        return found, findings
    R = found.matrix[np.ix_(index, index)]
    values, vectors = np.linalg.eigh(R)
    inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T
    multiple = np.sqrt(np.clip(1.0 - 1.0 / np.maximum(np.diagonal(inverse), 1.0), 0.0, 1.0))
    traded = (multiple > TIGHT) & loose[index]
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        # Trade-offs appear as directions whose error is larger than that of independent parameters.
        if value < 1.5:
            break
        large = (np.abs(vector) > 0.4 * np.abs(vector).max()) & traded
        if large.sum() < 2:
            continue
        traded &= ~large
        group = [names[i] for i in index[large]]
        ratio = 1.0 / np.sqrt(1.0 - multiple[large].max() ** 2 + 1e-24)
        findings.append(_traded(group, float(ratio)))
    return found, findings


def _traded(group: list[str], ratio: float) -> Finding:
    kinds = {name.rpartition(".")[2] for name in group}
    axes = {name.rpartition(".")[0] for name in group if "." in name}
    masses = {"m_eff", "added_mass"}
    if "thrust_scale" in kinds:
        return finding("thrust_traded", parameters=tuple(name for name in group if name != "thrust_scale"))
    fields = {"parameters": tuple(group), "ratio": ratio}
    if kinds <= {"thrust_lag", "thrust_delay"}:
        return finding("lag_traded", **fields)
    if kinds <= {"d1", "d2"} and len(axes) == 1:
        return finding("damping_traded", **fields)
    if kinds & masses and kinds & {"d1", "d2", "k"} and len(axes) == 1:
        return finding("inertia_traded", **fields)
    return finding("stiffness_traded", **fields) if "k" in kinds else finding("traded", **fields)
