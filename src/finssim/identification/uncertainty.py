"""Uncertainty of estimates: the evidence of every trial, and the agreement between trials.

Notation: a fit minimises Σ_g |W_g^½ r_g(theta)|² over trials g. Trial g contributes N_g = J_gᵀ W J_g to the normal
matrix and s_g = J_gᵀ W r_g to the score, r = measured - predicted, both at the solution, where Σ s_g = 0. No other
data is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.core.least_squares import Block, eliminated
from finssim.identification.fit import Correlation
from finssim.trials.findings import CalibrationError, Finding, finding

__all__ = [
    "Covariance",
    "Evidence",
    "arrow_evidence",
    "correlated_samples",
    "correlation",
    "degeneracy",
    "intervals",
    "pooled_covariance",
    "releases_disagree",
    "trial_covariance",
]

Array = NDArray[np.float64]

FLOOR = 1e-13
"""Eigenvalue of the scaled normal matrix (unit diagonal) below which a direction counts as unknown."""

FAINT = 0.05
"""Fraction of the information on a direction, times the number of trials, below which a trial does not
contribute to it."""

ALONE = 0.9
"""Fraction of the information on a parameter above which it is determined by one trial alone."""


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Evidence of each trial for the parameters, linearised at the solution."""

    names: tuple[str, ...]
    """Names of the parameters, (P,)."""
    normal: Array
    """N_g with W the inverse variance of the residuals, per product of the units of theta, (G, P, P)."""
    score: Array
    """s_g per unit of theta, (G, P); they sum to zero if no bound is active."""
    unit: str = "trials"
    """Unit of the groups: `trials`, or `blocks` of consecutive samples if there are too few trials."""
    prior: Array | None = None
    """Inverse covariance of the prior, per product of the units of theta, (P, P); None without a prior."""

    @property
    def information(self) -> Array:
        """Information Σ_g N_g plus that of the prior, (P, P), per product of the units of theta."""
        total = np.asarray(self.normal, float).sum(axis=0)
        return total if self.prior is None else total + self.prior


@dataclass(frozen=True, kw_only=True)
class Covariance:
    """Two estimates of the covariance; if they differ strongly, the assumptions about model or noise are wrong."""

    names: tuple[str, ...]
    local: Array
    """Inverse information (Σ_g N_g)⁻¹: for independent errors of the stated variance, in the units of theta,
    (P, P)."""
    trials: Array
    """Covariance from the disagreement between trials in the units of theta, (P, P): valid for any noise
    within a trial."""
    dof: Array
    """Degrees of freedom [-] of each variance in `trials`, (P,); infinite if `local` is used instead."""
    alone: NDArray[np.bool_]
    """True if a parameter is determined by one trial alone, so that no disagreement can be observed, (P,)."""

    @property
    def std(self) -> Array:
        """Standard errors, (P,): from the trials, or from `local` for parameters determined by one trial alone.

        They have the units of theta.
        """
        local, trials = np.diagonal(self.local), np.diagonal(self.trials)
        return np.asarray(np.sqrt(np.where(self.alone, np.maximum(local, trials), trials)))


def _whitener(normal: Array) -> tuple[Array, Array]:
    """Return T (P, K) with Tᵀ N T = 1 on the K known directions, and a mask of the parameters affected by
    unknown ones, (P,)."""
    if not np.isfinite(normal).all():
        raise CalibrationError("the trials contain numbers that overflow: check the units of their columns")
    scale = np.sqrt(np.maximum(np.diagonal(normal), 0.0))
    safe = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(normal / np.outer(safe, safe))
    determined = values > FLOOR
    T = vectors[:, determined] / np.sqrt(values[determined]) / safe[:, None]
    unknown = (np.abs(vectors[:, ~determined]) > 1e-6).any(axis=1) | (scale == 0.0)
    return T, unknown


def trial_covariance(evidence: Evidence) -> Covariance:
    """Return the local and the trial-based covariance of the estimates.

    V = N⁻¹ [Σ_g A_g s_g s_gᵀ A_gᵀ + N_0] N⁻¹,  A_g = (1 - N_g N⁻¹)⁻¹           (CR3; Bell and McCaffrey 2002)

    with N = Σ_g N_g + N_0 and the information N_0 of a prior, whose variance is taken as stated.

    N⁻¹ A_g s_g is the change when trial g is left out: V is the jackknife over trials. The power -½ would be
    exact for independent errors, but too small if a few trials with large weight differ systematically, as
    they do. The degrees of freedom are Satterthwaite's for independent errors, so that few or unequal trials
    result in wide intervals.

    Args:
        evidence: Contributions of G trials; with one trial, `local` is used for all parameters.

    Returns:
        The covariance; variances are infinite where the information matrix is singular.
    """
    N_g, s_g = np.asarray(evidence.normal, float), np.asarray(evidence.score, float)
    P = len(evidence.names)
    T, unknown = _whitener(evidence.information)
    local = T @ T.T
    local[unknown, unknown] = np.inf
    if len(N_g) < 2 or T.shape[1] == 0:
        return Covariance(
            names=evidence.names,
            local=local,
            trials=local.copy(),
            dof=np.full(P, np.inf),
            alone=np.ones(P, bool),
        )
    B = T.T @ N_g @ T  # leverage of each trial: the fractions of the information, which sum to 1
    share, axes = np.linalg.eigh(B)
    remaining = 1.0 - np.clip(share, 0.0, 1.0)
    root = np.where(remaining > 1e-3, 1.0 / np.maximum(remaining, 1e-3), 0.0)
    A = np.einsum("gij,gj,gkj->gik", axes, root, axes)
    errors = np.einsum("pk,gkl,gl->gp", T, A, s_g @ T)
    trials = errors.T @ errors
    stated = np.zeros((P, P))
    if evidence.prior is not None:
        stated = T @ (T.T @ evidence.prior @ T) @ T.T
        trials = trials + stated

    a = np.einsum("pk,gkl->gpl", T, A)  # A_gᵀ N⁻¹ e_p, whitened
    Ba = np.einsum("gkl,gpl->gpk", B, a)
    gram = -np.einsum("gpk,hpk->pgh", Ba, Ba)
    index = np.arange(len(N_g))
    gram[:, index, index] += np.einsum("gpk,gpk->pg", a, Ba)
    trace = np.trace(gram, axis1=1, axis2=2)
    # In units of the largest entry: squares of the variance of a nearly undetermined parameter would overflow.
    unit = gram / np.maximum(np.abs(gram).max(axis=(1, 2), keepdims=True), 1e-300)
    square = np.einsum("pgh,pgh->p", unit, unit)
    dof = np.where(square > 0.0, np.trace(unit, axis1=1, axis2=2) ** 2 / np.maximum(square, 1e-300), 1.0)
    # A stated variance has infinitely many degrees of freedom; Satterthwaite's formula for the sum of both.
    mixed = (1.0 + np.minimum(np.diagonal(stated) / np.maximum(trace, 1e-300), 1e6)) ** 2

    variance = np.maximum(np.diagonal(T @ T.T), 1e-300)
    alone = (np.einsum("pk,gkl,pl->gp", T, B, T) / variance).max(axis=0) > ALONE
    trials[unknown, unknown] = np.inf
    return Covariance(
        names=evidence.names,
        local=local,
        trials=trials,
        dof=np.where(alone, np.inf, np.clip(dof, 1.0, len(N_g) - 1.0) * mixed),
        alone=alone | unknown,
    )


def pooled_covariance(evidence: Evidence) -> Covariance:
    """Return the covariance of the estimates scaled by one common factor, from the disagreement of all trials
    on all parameters.

    V = max(1, Q / ν) N⁻¹,  Q = Σ_g s_gᵀ N_g⁺ s_g,  with ν the expectation of Q for independent errors.

    A few equal trials determine one common scatter far better than a variance for each parameter.

    Args:
        evidence: Contributions of G trials, at least 2.
    """
    T, unknown = _whitener(evidence.information)
    local = T @ T.T
    local[unknown, unknown] = np.inf
    q, dof = _scatter(evidence, T)
    share = np.max([np.einsum("pk,kl,pl->p", T, T.T @ N @ T, T) for N in evidence.normal], axis=0)
    factor, P = max(1.0, q / max(dof, 1e-9)), len(T)
    alone = share > ALONE * np.maximum(np.diagonal(T @ T.T), 1e-300)
    return Covariance(
        names=evidence.names,
        local=local,
        trials=factor * local,
        dof=np.where(alone, np.inf, np.full(P, max(dof, 1.0))),
        alone=alone | unknown,
    )


def _scatter(evidence: Evidence, T: Array) -> tuple[float, float]:
    """Return Q of `pooled_covariance` and its expectation ν for independent errors, for a whitener, (P, n)."""
    q = dof = 0.0
    for normal, score in zip(evidence.normal, evidence.score, strict=True):
        values, axes = np.linalg.eigh(T.T @ normal @ T)
        shown = values > FAINT / len(evidence.normal)
        q += float(np.sum((axes.T @ (T.T @ score))[shown] ** 2 / values[shown]))
        dof += float(np.sum(1.0 - values[shown]))
    return q, dof


def releases_disagree(evidence: Evidence) -> bool:
    """Return whether releases differ by more than their noise: Q of `pooled_covariance` beyond 95 % of χ²(ν).

    With blocks of too few trials, agreement cannot be established: the result is True.
    """
    from scipy.stats import chi2

    q, dof = _scatter(evidence, _whitener(evidence.information)[0])
    return evidence.unit != "trials" or q > float(chi2.ppf(0.95, max(dof, 1.0)))


def intervals(theta: Array, covariance: Covariance) -> Array:
    """Return Student's 95 % intervals of the estimates.

    Args:
        theta: Estimates in their units, (P,).
        covariance: Covariance of the estimates.

    Returns:
        Lower and upper ends in the units of theta, (P, 2); infinite for unknown parameters.
    """
    from scipy.stats import norm, t

    finite = np.isfinite(covariance.dof)
    quantile = np.where(finite, t.ppf(0.975, np.where(finite, covariance.dof, 1.0)), norm.ppf(0.975))
    # Few trials may agree by chance: no interval is narrower than that for independent errors.
    half = np.maximum(quantile * covariance.std, norm.ppf(0.975) * np.sqrt(np.diagonal(covariance.local)))
    return np.stack([theta - half, theta + half], axis=-1)


def correlated_samples(residual: Array, breaks: Sequence[int] = ()) -> float:
    """Return the number of samples per independent one: 1 + 2 Σ ρ_k up to the first pair with negative sum
    (Geyer 1992).

    Args:
        residual: Equally spaced residuals, in any unit, (n,).
        breaks: Indices at which a new segment starts; no product crosses them.

    Returns:
        The number of samples, at least 1.
    """
    stretches = [part - np.mean(residual) for part in np.split(residual, list(breaks)) if len(part)]
    longest = max(len(part) for part in stretches)
    size = 2 ** int(np.ceil(np.log2(2 * longest)))
    power = sum(np.abs(np.fft.rfft(part, size)) ** 2 for part in stretches)
    rho = np.fft.irfft(power, size)[:longest]
    if rho[0] <= 0.0:
        return 1.0
    pairs = rho[: longest // 2 * 2].reshape(-1, 2).sum(axis=1) / rho[0]
    ends = np.flatnonzero(pairs <= 0.0)
    return float(max(1.0, 2.0 * pairs[: ends[0] if len(ends) else None].sum() - 1.0))


TIGHT = 0.98
"""Multiple correlation of a parameter with the others above which it counts as traded off."""

LOOSE = 0.1
"""Relative standard error below which a trade-off does not matter."""
EXACT = 0.9999
"""Multiple correlation above which parameters trade off however well they seem to be known: a fit may move
them far along their common direction, so that their errors are small relative to their values [-]."""


def correlation(names: Sequence[str], covariance: Array) -> Correlation:
    """Return the correlation of the errors; zero for parameters without a finite variance.

    Args:
        names: Names of the parameters, (P,).
        covariance: Covariance in the units of theta, (P, P).
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
    """Return the correlation of the errors, and a finding for each group of parameters that trade off.

    The groups are the weak directions of the scaled information: eigenvectors of the errors' correlation with
    large eigenvalues. A trade-off among well-known parameters is omitted, unless it is exact.

    Args:
        names: Names of the parameters, (P,).
        covariance: Covariance of the estimates in their units, preferably the local one, (P, P); infinite
            variances mark unknown parameters.
        theta: Estimates, from which well-known ones are identified; all count as loose if None, (P,).

    Returns:
        Correlation, and findings with the trade-offs and their remedies.
    """
    correlations = correlation(names, covariance)
    variance = np.diagonal(covariance)
    unknown = [name for name, v in zip(names, variance, strict=True) if not np.isfinite(v)]
    findings = [finding("undetermined", parameters=tuple(unknown))] if unknown else []
    std = np.sqrt(np.where(np.isfinite(variance), np.maximum(variance, 0.0), 0.0))
    loose = np.isfinite(variance) & (variance > 0.0)
    if theta is not None:
        loose &= std > LOOSE * np.abs(theta)
    index = np.flatnonzero(np.isfinite(variance) & (variance > 0.0))
    if len(index) < 2:
        return correlations, findings
    R = correlations.matrix[np.ix_(index, index)]
    values, vectors = np.linalg.eigh(R)
    inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T
    multiple = np.sqrt(np.clip(1.0 - 1.0 / np.maximum(np.diagonal(inverse), 1.0), 0.0, 1.0))
    traded = (multiple > TIGHT) & (loose[index] | (multiple > EXACT))
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
    return correlations, findings


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
    return finding("stiffness_traded" if "k" in kinds else "traded", **fields)


def arrow_evidence(
    blocks: Sequence[Block], names: tuple[str, ...], unit: str, groups: int | None = None
) -> Evidence:
    """Return the evidence of each group for the shared unknowns, after elimination of its own.

    Args:
        blocks: Normal equations at the solution.
        names: Names of the shared unknowns.
        unit: Kind of the groups.
        groups: Number of groups of consecutive blocks; None keeps each block separate.
    """
    normal, score, _ = zip(*(eliminated(block, 0.0) for block in blocks), strict=True)
    parts = np.array_split(np.arange(len(blocks)), min(groups or len(blocks), len(blocks)))
    return Evidence(
        names=names,
        normal=np.array([np.sum([normal[i] for i in p], axis=0) for p in parts]),
        score=np.array([np.sum([score[i] for i in p], axis=0) for p in parts]),
        unit=unit,
    )
