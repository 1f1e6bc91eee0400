"""Whether a model predicts: a quarter of its slowest period ahead, in the last second, against the sensors' noise.

A model that is wrong leaves residuals which it takes for its noise, so it must not be judged against them. White noise
of a sensor shows in fourth differences, whatever the model.
"""

from __future__ import annotations

import math

import numpy as np

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


def missed(model: StateSpace, U: Array, Y: Array, horizon: int) -> Array:
    """(m,) share of the power of Y (N, m) that predictions up to ``horizon`` samples ahead miss, beyond white noise.

    Each begins at the state that fits twice as many samples before it; no output after that is used. nan where an
    output is silent.
    """
    n, m = model.order, model.C.shape[0]
    before = 2 * max(horizon, n)
    free, row = np.empty((before, m, n)), model.C
    for k in range(before):
        free[k], row = row, row @ model.A
    end = np.linalg.matrix_power(model.A, before)
    back = np.linalg.pinv(free.reshape(-1, n), rcond=1e-9)
    errors = np.zeros(m)
    count = 0
    for first in range(before, len(Y) - horizon + 1, horizon):
        u, y = U[first - before:first], Y[first - before:first]
        x = back @ (y - simulate(model, u)).ravel()
        forced = np.zeros(n)
        for sample in u:
            forced = model.A @ forced + model.B @ sample
        ahead = slice(first, first + horizon)
        errors += np.sum((Y[ahead] - simulate(model, U[ahead], end @ x + forced)) ** 2, axis=0)
        count += horizon
    power, white = np.var(Y, axis=0), white_noise(Y)
    if not count:
        return np.full(m, np.nan)
    share = np.maximum(errors / count - 2.0 * white, 0.0) / np.where(power > 0.0, power, np.inf)
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
        shares = missed(model, np.ascontiguousarray(rows.u), np.ascontiguousarray(rows.y), horizon)
    heard = shares[np.isfinite(shares)]  # rates may ring with modes above the order, which displacements hardly show
    if heard.size and float(heard.mean()) > MISSED:
        return found._replace(status=Status.INCONSISTENT)
    return found
