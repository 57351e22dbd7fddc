"""The table of distributions that the kernel draws from, and one draw."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.engine.distributions import KINDS, Distribution
from finssim.engine.ranges_file import Ranges
from finssim.engine.ranges_table import ENTRIES, INDEX

UNIFORM, LOG_UNIFORM, NORMAL, CHOICE = range(len(KINDS))


@wp.struct
class DrawTable:
    """Distribution of every entry of the table; rows of entries that never vary are not read."""

    count: int
    drawn: wp.array(dtype=int)  # the entries that vary
    kind: wp.array(dtype=int)
    ends: wp.array(dtype=wp.vec4)  # low, high, mean, standard deviation
    probability: wp.array(dtype=float)  # of being drawn at all
    nominal: wp.array(dtype=float)
    stream: wp.array(dtype=int)
    first_choice: wp.array(dtype=int)
    choices: wp.array(dtype=int)
    choice: wp.array(dtype=float)
    cumulative: wp.array(dtype=float)
    first_tie: wp.array(dtype=int)
    ties: wp.array(dtype=int)  # how many normal numbers its own is a sum of; 0: it stands alone
    tied: wp.array(dtype=int)  # entries of these
    tie_weight: wp.array(dtype=float)


@wp.func
def normal_part(x: float) -> float:
    """Share of a standard normal distribution below x."""
    return 0.5 + 0.5 * wp.erf(0.70710678 * x)


@wp.func
def quantile(t: DrawTable, k: int, u: float) -> float:
    """The number of entry k below which a share u in [0, 1) of its distribution lies."""
    e = t.ends[k]
    kind = t.kind[k]
    x = e[0] + u * (e[1] - e[0])
    if kind == LOG_UNIFORM:
        x = e[0] * wp.exp(u * wp.log(e[1] / e[0]))
    if kind == NORMAL:
        x = e[2]
        if e[3] > 0.0:
            a = normal_part((e[0] - e[2]) / e[3])
            b = normal_part((e[1] - e[2]) / e[3])
            p = wp.clamp(a + u * (b - a), 3.0e-7, 1.0 - 3.0e-7)
            x = wp.clamp(e[2] + e[3] * 1.41421356 * wp.erfinv(2.0 * p - 1.0), e[0], e[1])
    if kind == CHOICE:
        i = t.first_choice[k]
        last = i + t.choices[k] - 1
        while i < last and u >= t.cumulative[i]:
            i += 1
        x = t.choice[i]
    return x


@wp.func
def draw_entry(t: DrawTable, k: int, key: int) -> float:
    """Entry k from the stream of its own that a key gives it: other entries do not change it."""
    rng = wp.rand_init(key, 2 * t.stream[k])
    u = wp.randf(rng)
    gate = wp.randf(rng)
    if t.ties[k] > 0:
        z = float(0.0)
        for i in range(t.first_tie[k], t.first_tie[k] + t.ties[k]):
            other = wp.rand_init(key, 2 * t.stream[t.tied[i]] + 1)
            z += t.tie_weight[i] * wp.randn(other)
        u = normal_part(z)
    x = quantile(t, k, u)
    if gate >= t.probability[k]:
        x = t.nominal[k]
    return x


def widened(distribution: Distribution, nominal: float, part: float) -> tuple[list[float], float]:
    """Ends [low, high, mean, standard deviation] and probability of a distribution at a part of its width.

    Widths grow from the number of the range that lies nearest to the nominal one. What is drawn from with a
    probability, and a choice, keep their numbers, and the probability grows.

    Args:
        distribution: At its full width.
        nominal: Where nothing is drawn.
        part: Of the way to both ends, of the standard deviation and of probabilities, in [0, 1].
    """
    low, high = distribution.bounds()
    mean, std = distribution.normal or (0.0, 0.0)
    if distribution.choice is not None or distribution.probability < 1.0:
        return [low, high, mean, std], distribution.probability * part
    anchor = min(max(nominal, low), high)
    if distribution.log_uniform is not None:
        down, up = (math.log(end / anchor) for end in (low, high))
        return [anchor * math.exp(part * down), anchor * math.exp(part * up), 0.0, 0.0], 1.0
    ends = [anchor + part * (low - anchor), anchor + part * (high - anchor)]
    if distribution.normal is None:
        return [*ends, 0.0, 0.0], 1.0
    return [*ends, anchor + part * (mean - anchor), part * std], 1.0


def ties_of(ranges: Ranges) -> dict[int, list[tuple[int, float]]]:
    """Entry -> the entries whose normal numbers its own is a sum of, with their weights: rows of a square root of R."""
    rows = {}
    for group in ranges.correlated:
        values, vectors = np.linalg.eigh(np.array(group.correlation))
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        members = [INDEX[name] for name in group.entries]
        for k, row in zip(members, root, strict=True):
            rows[k] = list(zip(members, (row / np.linalg.norm(row)).tolist(), strict=True))
    return rows


def draw_table(
    drawn: Mapping[str, Distribution], nominal: NDArray[np.float64], ranges: Ranges, device: wp.Device
) -> DrawTable:
    """The table at full width.

    Args:
        drawn: Entry -> distribution, of those that vary.
        nominal: Of every entry, (len(ENTRIES),).
        ranges: For the correlations.
        device: Where.
    """
    n = len(ENTRIES)
    kind, first, choices = np.zeros((3, n), np.int32)
    ends, probability = np.zeros((n, 4)), np.ones(n)
    choice, cumulative = list[float](), list[float]()
    for name, distribution in drawn.items():
        k = INDEX[name]
        kind[k] = KINDS.index(distribution.kind)
        ends[k], probability[k] = widened(distribution, float(nominal[k]), 1.0)
        first[k], choices[k] = len(choice), len(distribution.choice or ())
        choice += distribution.choice or ()
        cumulative += distribution.cumulative()
    first_tie, ties, tied, weights = _flat(ties_of(ranges), n)
    t = DrawTable()
    t.count = len(drawn)
    integer = {"drawn": [INDEX[name] for name in drawn], "kind": kind, "first_choice": first, "choices": choices,
             "stream": [e.stream for e in ENTRIES],
             "first_tie": first_tie, "ties": ties, "tied": tied}  # fmt: skip
    real = {"probability": probability, "nominal": nominal, "choice": choice, "cumulative": cumulative,
            "tie_weight": weights}  # fmt: skip
    for fields, dtype, plain in ((integer, wp.int32, np.int32), (real, wp.float32, np.float32)):
        for name, values in fields.items():
            # No kernel reads beyond the counts: one element keeps empty columns valid.
            column = np.asarray(values if len(values) else [0], dtype=plain)
            setattr(t, name, wp.array(column, dtype=dtype, device=device))
    t.ends = wp.array(ends.astype(np.float32), dtype=wp.vec4, device=device)
    return t


def _flat(rows: Mapping[int, list[tuple[int, float]]], n: int) -> tuple[Any, Any, list[int], list[float]]:
    first, count = np.zeros((2, n), np.int32)
    tied, weights = list[int](), list[float]()
    for k, row in rows.items():
        first[k], count[k] = len(tied), len(row)
        tied += [other for other, _ in row]
        weights += [weight for _, weight in row]
    return first, count, tied, weights
