"""Figures that say how good estimates are: error, and whether the interval tells the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import betaincinv

from flexmanip_ros.types import Array


@dataclass(frozen=True)
class Score:
    """One estimator over many runs.

    runs, failed: counts; mean_error_percent, median_error_percent: of the mean relative error in the window;
    rms_error_percent: of the last estimate; bias_kg: mean of its error; coverage_percent: how often its 95 %
    interval, where it gave one, held the truth, with the 95 % interval of that figure; us_per_sample: median
    cost; bound_ratio: root mean square of the last error over its Cramer-Rao bound.
    """

    runs: int
    failed: int
    mean_error_percent: float
    median_error_percent: float
    rms_error_percent: float
    bias_kg: float
    coverage_percent: float
    coverage_low: float
    coverage_high: float
    us_per_sample: float
    bound_ratio: float


def relative_error_percent(masses: Array, true: float) -> float:
    """Mean of |mass - true| / true over a stretch (N,) [%]; nan without a true mass or any estimate."""
    known = masses[np.isfinite(masses)]
    if known.size == 0 or true <= 0.0:
        return math.nan
    return float(100.0 * np.mean(np.abs(known - true)) / true)


def coverage(hits: int, runs: int, confidence: float = 0.95) -> tuple[float, float, float]:
    """Return the share of hits and its Clopper-Pearson interval [%]."""
    if runs == 0:
        return math.nan, math.nan, math.nan
    tail = (1.0 - confidence) / 2.0
    low = 0.0 if hits == 0 else float(betaincinv(hits, runs - hits + 1, tail))
    high = 1.0 if hits == runs else float(betaincinv(hits + 1, runs - hits, 1.0 - tail))
    return 100.0 * hits / runs, 100.0 * low, 100.0 * high


def score(rows: Sequence[Mapping[str, Any]]) -> Score:
    """Sum up the rows of one estimator."""
    good = [row for row in rows if not row.get('error')]
    failed, runs = len(rows) - len(good), len(rows)
    costs = [row['us_per_sample'] for row in good if _number(row, 'us_per_sample') is not None]
    needed = ('payload_mass_kg', 'payload_true_kg')
    good = [row for row in good if all(_number(row, name) is not None for name in needed)]
    errors = np.array([row['payload_mass_kg'] - row['payload_true_kg'] for row in good], dtype=np.float64)
    truths = np.array([row['payload_true_kg'] for row in good], dtype=np.float64)
    window = np.array([_number(row, 'error_percent', math.nan) for row in good], dtype=np.float64)
    window = window[np.isfinite(window)]
    with np.errstate(divide='ignore', invalid='ignore'):
        relative = 100.0 * errors / truths
    relative = relative[np.isfinite(relative)]
    claims = [bool(row['covered']) for row in good if row.get('covered') is not None]
    share, low, high = coverage(sum(claims), len(claims))
    ratios = [(row['payload_mass_kg'] - row['payload_true_kg']) / row['bound_std_kg'] for row in good
              if _number(row, 'bound_std_kg')]
    return Score(
        runs=runs, failed=failed, mean_error_percent=_mean(window),
        median_error_percent=float(np.median(window)) if window.size else math.nan,
        rms_error_percent=math.sqrt(_mean(relative**2)) if relative.size else math.nan,
        bias_kg=_mean(errors), coverage_percent=share, coverage_low=low, coverage_high=high,
        us_per_sample=float(np.median(costs)) if costs else math.nan,
        bound_ratio=math.sqrt(_mean(np.array(ratios) ** 2)) if ratios else math.nan)


def _number(row: Mapping[str, Any], name: str, missing: Any = None) -> Any:
    value = row.get(name)
    return value if isinstance(value, (int, float)) and math.isfinite(value) else missing


def _mean(values: Array) -> float:
    return float(np.mean(values)) if values.size else math.nan
