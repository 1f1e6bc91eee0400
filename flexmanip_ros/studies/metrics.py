"""How good estimates are: their error, how often their interval holds the truth, and the least error possible."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from flexmanip_ros.errors import ModelError
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import cramer_rao
from flexmanip_ros.payload.structured_model import chords
from flexmanip_ros.samples.sample_log import Signals
from flexmanip_ros.types import Array

ORDER = 4
"""Order of differences. They keep white noise and remove signals that are slow against the sample time."""
GAIN = float(np.sqrt(70.0))
"""Factor by which they raise the standard deviation of white noise: sqrt(1 + 16 + 36 + 16 + 1)."""
NORMAL_MEDIAN = 0.6744897501960817
"""Median of |x| of a standard normal x."""
RATE_WINDOW = 50
"""Samples over which the rates of the chord angles at the capture are measured."""
LONGEST = 20_000
"""Samples after the capture that the bound is computed from at most; more would lower it further."""


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


def coverage(hits: int, runs: int) -> tuple[float, float, float]:
    """Return the share of hits and its Clopper-Pearson interval of 95 % confidence [%]."""
    if runs == 0:
        return math.nan, math.nan, math.nan
    tail = (1.0 - 0.95) / 2.0
    low = 0.0 if hits == 0 else float(scipy.special.betaincinv(hits, runs - hits + 1, tail))
    high = 1.0 if hits == runs else float(scipy.special.betaincinv(hits + 1, runs - hits, 1.0 - tail))
    return 100.0 * hits / runs, 100.0 * low, 100.0 * high


def score(rows: Sequence[Mapping[str, Any]]) -> Score:
    """Return the scores of the rows of one estimator."""
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


def noise_std(columns: Array) -> Array:
    """Return the standard deviation of white noise on smooth signals (N, k): (k,).

    sigma = median |d^4 s| / (0.674 sqrt(70)); jumps and vibrations do not change this median.
    """
    if columns.shape[0] <= ORDER:
        return np.zeros(columns.shape[1])
    differences = np.abs(np.diff(columns, ORDER, axis=0))
    return np.asarray(np.median(differences, axis=0) / (NORMAL_MEDIAN * GAIN), dtype=np.float64)


def payload_bound(config: IdentifierParameters, signals: Signals, capture_time: float, mass: float,
                dt: float) -> float | None:
    """Return the Cramer-Rao bound of the payload's standard deviation at the end of a run [kg].

    It is computed from the samples after the capture, for the moving arm. An estimator that learned gains and
    friction from the empty arm can be several times better. mass: the payload, or its estimate [kg]; the noise is
    measured on the signals. None where there is no bound: no angles, no sample after the capture, or no noise.
    """
    if signals.angles.shape[1] != len(config.arm.link_length) or not mass > 0.0 or dt <= 0.0:
        return None
    first = int(np.searchsorted(signals.time, capture_time - 0.5 * dt))
    count = min(signals.stamp_ns.size - first, LONGEST)
    if count < RATE_WINDOW:
        return None
    config = replace(config, outputs=signals.outputs)
    extra = [k for k, name in enumerate(config.angles) if name not in signals.outputs]
    noise = np.concatenate([noise_std(signals.y[first:]), noise_std(signals.angles[first:][:, extra])])
    if not (noise > 0.0).all():
        return None
    theta = chords(config.arm, signals.angles[first])
    later = chords(config.arm, signals.angles[first + RATE_WINDOW - 1])
    rates = (later - theta) / ((RATE_WINDOW - 1) * dt)
    try:
        found = float(cramer_rao.nonlinear(config, theta, mass, signals.u[first:], noise, dt, (count,), rates)[0])
    except ModelError:
        return None
    return found if np.isfinite(found) else None


def _number(row: Mapping[str, Any], name: str, missing: Any = None) -> Any:
    value = row.get(name)
    return value if isinstance(value, (int, float)) and math.isfinite(value) else missing


def _mean(values: Array) -> float:
    return float(np.mean(values)) if values.size else math.nan
