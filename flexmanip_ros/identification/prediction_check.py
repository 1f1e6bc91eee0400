"""Whether a model predicts: a quarter of its slowest period ahead, in the last second, against the sensors' noise.

A model that is wrong leaves residuals which it takes for its noise, so it must not be judged against them. White noise
of a sensor shows in fourth differences, whatever the model.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.identification.uncertainty import Identified, modes
from flexmanip_ros.identification.validation import simulate
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.types import Array, StateSpace, Status

LAST_S = 1.0
"""Time over which predictions are judged [s]."""
MOST_ROWS = 4096
MISSED = 0.5
"""Share of the outputs' power, in the mean over the outputs, that predictions may miss."""
SILENT = 10.0
"""Power of an output, in units of its white noise, below which it says nothing."""
FOURTH = 0.6744897501960817 * math.sqrt(70.0)
"""Median of the fourth differences of white noise, in standard deviations."""


def length(dt: float) -> int:
    """Return the number of samples that are looked at. dt: sample time [s]."""
    return min(math.ceil(LAST_S / max(dt, 1e-9)), MOST_ROWS)


def white_noise(Y: Array) -> Array:
    """(m,) variance of the white noise in Y (N, m), N > 4, by the median of fourth differences."""
    found: Array = (np.median(np.abs(np.diff(Y, 4, axis=0)), axis=0) / FOURTH) ** 2
    return found


def missed(model: StateSpace, U: Array, Y: Array, horizon: int, seen: NDArray[np.bool_] | None = None) -> Array:
    """(m,) share of the power of Y (N, m) that predictions up to ``horizon`` samples ahead miss, beyond white noise.

    Each begins at the state that fits twice as many samples before it, outputs at unit power; no output after that is
    used. seen: (N,) rows that were measured, all of them by default. nan where an output is silent.
    """
    n, m = model.order, model.C.shape[0]
    before = 2 * max(horizon, n)
    free, row = np.empty((before + horizon, m, n)), model.C
    for k in range(len(free)):
        free[k], row = row, row @ model.A
    power, white = np.var(Y, axis=0), white_noise(Y)
    unit = 1.0 / np.sqrt(np.where(power > 0.0, power, 1.0))
    free *= unit[:, None]
    left = (Y - simulate(model, U)) * unit  # a free motion of the model, as far as it is right
    if not np.all(np.isfinite(free)) or not np.all(np.isfinite(left)):  # a model that runs away
        return np.full(m, np.inf)
    known = np.ones(len(Y), dtype=np.bool_) if seen is None else seen
    back = np.linalg.pinv(free[:before].reshape(-1, n), rcond=1e-9)
    errors = np.zeros(m)
    count = 0
    for first in range(before, len(Y) - horizon + 1, horizon):
        used, ahead = known[first - before:first], known[first:first + horizon]
        y = left[first - before:first]
        x = back @ y.ravel() if used.all() else np.linalg.lstsq(
            free[:before][used].reshape(-1, n), y[used].ravel(), rcond=1e-9)[0]
        errors += np.sum((left[first:first + horizon][ahead] - free[before:][ahead] @ x) ** 2, axis=0)
        count += int(np.count_nonzero(ahead))
    if not count:
        return np.full(m, np.nan)
    share = np.maximum(errors / count - 2.0 * white * unit ** 2, 0.0)
    return np.where(power > SILENT * white, share, np.nan)


def judged(found: Identified, rows: Rows) -> Identified:
    """Return the model, INCONSISTENT where its predictions of the last samples miss too much of an output."""
    if found.status is not Status.TRACKING:
        return found
    model = found.model
    slowest = min((mode.frequency_hz for mode in modes(found)), default=1.0)
    horizon = max(2, min(round(0.25 / (slowest * model.dt)), len(rows) // 6))
    if 2 * len(rows) < length(model.dt) or len(rows) < 6 * max(horizon, model.order) or rows.gap[1:].any():
        return found
    with np.errstate(over='ignore', invalid='ignore'):
        shares = missed(model, rows.u, rows.y, horizon, rows.missing == 0)
    heard = shares[~np.isnan(shares)]  # rates may ring with modes above the order, which displacements hardly show
    if heard.size and float(heard.mean()) > MISSED:
        return found._replace(status=Status.INCONSISTENT)
    return found
