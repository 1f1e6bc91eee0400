"""Whether a model predicts: 0.25 s ahead, over the last second, against the sensors' noise.

A model that is wrong leaves residuals which it takes for its noise, so it must not be judged against them. White noise
of a sensor shows in fourth differences, whatever the model.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.identification.uncertainty import Identified
from flexmanip_ros.identification.validation import simulate
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.types import Array, StateSpace, Status

AHEAD_S = 0.25
"""How far ahead predictions are judged [s]; less in the first 1.5 s after an event."""
LAST_S = 1.5
"""Time over which they are judged [s], with that of the first state."""
INSTANTS = 10
"""From how many instants in the time ahead one prediction each is made."""
MOST_ROWS = 4096
MISSED = 0.5
"""Share of an output's power that predictions may miss."""
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
    """(m,) share of the power of Y (N, m) that predictions ``horizon`` samples ahead miss.

    Each begins at the state that fits as many samples before it, outputs at unit power; no output after that is used.
    seen: (N,) rows that were measured, all of them by default. nan where an output is silent.
    """
    n, m = model.order, model.C.shape[0]
    before = max(horizon, 2 * n)
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
    errors = []
    for first in range(before, len(Y) - horizon + 1, max(1, horizon // INSTANTS)):
        used, at = known[first - before:first], first + horizon - 1
        if not known[at] or np.count_nonzero(used) < before // 2:
            continue
        y = left[first - before:first]
        x = back @ y.ravel() if used.all() else np.linalg.lstsq(
            free[:before][used].reshape(-1, n), y[used].ravel(), rcond=1e-9)[0]
        errors.append((left[at] - free[-1] @ x) ** 2)
    if not errors:
        return np.full(m, np.nan)
    return np.where(power > SILENT * white, np.mean(errors, axis=0), np.nan)


def judged(found: Identified, rows: Rows, outputs: tuple[str, ...]) -> Identified:
    """Return the model with what its predictions of the last samples are worth; outputs: their names.

    INCONSISTENT where they miss too much of the outputs in the mean; ORDER_TOO_LOW where that is so of one while the
    others are predicted. Rates count in the mean alone where there are others: they ring with modes above the order,
    which displacements hardly show, so that right models of the first modes would be refused.
    """
    if found.status is not Status.TRACKING:
        return found
    dt = found.model.dt
    horizon = max(2, min(round(AHEAD_S / dt), len(rows) // 6))
    if 3 * len(rows) < length(dt) or len(rows) < 6 * max(horizon, found.model.order) or rows.gap[1:].any():
        return found
    with np.errstate(over='ignore', invalid='ignore'):
        shares = missed(found.model, rows.u, rows.y, horizon, rows.missing == 0)
    heard = shares[~np.isnan(shares)]
    if heard.size and float(heard.mean()) > MISSED:
        return found._replace(status=Status.INCONSISTENT)
    rates = np.array([name.endswith('/velocity') for name in outputs])
    alone = shares[~np.isnan(shares) & (~rates | rates.all())]
    if alone.size and float(alone.max()) > MISSED:
        return found._replace(status=Status.ORDER_TOO_LOW)
    return found
