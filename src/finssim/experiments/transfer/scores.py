"""Trials over plants and seeds: a row's figures with intervals, and its differences from the reference."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

from finssim.experiments.transfer.intervals import Interval, Statistic, paired_difference, with_interval

__all__ = ["difference", "row_figures"]


def row_figures(results: Sequence[Mapping[str, Any]], figures: Mapping[str, Statistic]) -> dict[str, Any]:
    """The figures of one row.

    Args:
        results: Of its trials, as `run_jobs` gives them.
        figures: Key -> how the trials that have it become one figure.

    Returns:
        `trials`, `success` (count), `stopped` (trials that ended in a fault), `worst_success` (fewest successes of a
        plant and seed, of `per_cluster` trials each), and by key an interval, or None where no trial has a figure.
    """
    clusters: dict[tuple[int, int], list[Mapping[str, Any]]] = {}
    for result in results:
        clusters.setdefault((result["job"]["plant"], result["job"]["seed"]), []).append(result)
    counts = [sum(bool(r["success"]) for r in group) for group in clusters.values()]
    out: dict[str, Any] = {
        "trials": len(results),
        "success": sum(counts),
        "stopped": sum(bool(r["fault"]) for r in results),
        "worst_success": min(counts),
        "per_cluster": max(len(group) for group in clusters.values()),
    }
    for key, statistic in figures.items():
        values: dict[Hashable, list[float]] = {
            cluster: [x for r in group if (x := _figure(r, key)) is not None]
            for cluster, group in clusters.items()
        }
        interval = with_interval(values, statistic)
        out[key] = interval and interval.as_json()
    return out


def difference(
    reference: Sequence[Mapping[str, Any]], other: Sequence[Mapping[str, Any]], key: str
) -> Interval | None:
    """Mean of other - reference over the trials that both have a figure for, paired by plant, seed and target."""
    return paired_difference(_by_pair(reference, key), _by_pair(other, key))


def _by_pair(results: Sequence[Mapping[str, Any]], key: str) -> dict[tuple[int, int, str], float]:
    return {
        (r["job"]["plant"], r["job"]["seed"], r["job"]["target"]): x
        for r in results
        if (x := _figure(r, key)) is not None
    }


def _figure(result: Mapping[str, Any], key: str) -> float | None:
    value = result["success"] if key == "success_rate" else result[key]
    return None if value is None else float(value)
