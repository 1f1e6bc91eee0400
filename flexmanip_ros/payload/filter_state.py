"""What the structured estimator remembers: arrays of constant size, copied before a call writes them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.types import Array

HORIZON = 512
"""Samples after an event that the moving-horizon estimation reads again."""

# Columns of ``noise``, one row a sensor: variance used by the filter; variance of the innovations; its slow part;
# sum and sum of squares of the residuals in this block; least variance assumed; variance of the fourth differences
# (white noise only); information on the payload that came from this sensor.
EFFECTIVE, POWER, SLOW, BLOCK_SUM, BLOCK_POWER, FLOOR, WHITE, WEIGHT = range(8)
# Elements of ``counts``.
HELD, STORED, ITERATED, ITERATING, IN_BLOCK, BLOCKS, SINCE_EVENT, SINCE_NOISE, IN_BATCH, BATCHES, SEEN = range(11)
# Elements of ``score``.
MOVE, VARIANCE, DRIFT, NOW, EMPTY_ARM_BIAS, EXCESS_BIAS, SHOWN, INFORMATION, ODDS = range(9)


class FilterState(NamedTuple):
    """State of the square-root Kalman filter and of the moving-horizon estimation; nx states, m sensors."""

    x: Array
    """(nx,) mean."""
    S: Array
    """(nx, nx) square root of the covariance."""
    noise: Array
    """(m, 8) what is known of each sensor's noise."""
    recent: Array
    """(m, 4) its last measurements."""
    counts: NDArray[np.int64]
    """(11,) counters."""
    score: Array
    """(9,) MOVE: sum of the payload's updates in this batch, VARIANCE: the variance they should have; DRIFT: mean of
    MOVE^2 / VARIANCE; NOW: time since process noise was added [s]; EMPTY_ARM_BIAS: payload of the arm before the event,
    when it was empty, in standard deviations, EXCESS_BIAS: in those left when the inertia error is allowed for; SHOWN:
    correlation of the innovations with the output of the residual modes, INFORMATION: its variance; ODDS: logarithm
    of the prior odds of residual modes."""
    x0: Array
    """(nx,) mean just after the last event."""
    S0: Array
    """(nx, nx) its square root."""
    xi: Array
    """(nx,) fitted departure from x0 in units of S0."""
    corrections: Array
    """(HORIZON, m) what the residual modes were taken to add to the measurements since the event."""
    xr: Array
    """(nx,) reference trajectory of the present Gauss-Newton iteration."""
    Sr: Array
    """(nx, nx) its sensitivity to xi."""
    N: Array
    """(nx, nx) information gathered in the iteration."""
    g: Array
    """(nx,) gradient gathered in the iteration."""
    residual: Array
    """(2, a) modes beyond kappa: departure from where the torque holds them, its rate."""
    torque: Array
    """(2,) held before the latest sample."""
    torque0: Array
    """(2,) held before the last event."""
    innovation: Array
    """(m, 2) the latest, and its variance before the update."""
    power: Array
    """(m,) mean squared normalised innovation of each sensor since the event, slowly forgotten."""


def memory(nx: int, m: int, a: int = 0) -> FilterState:
    """Allocate for nx states, m sensors, a modes beyond kappa."""
    return FilterState(
        x=np.zeros(nx), S=np.zeros((nx, nx)), noise=np.zeros((m, 8)), recent=np.zeros((m, 4)),
        counts=np.zeros(11, dtype=np.int64),
        score=np.zeros(9), x0=np.zeros(nx), S0=np.zeros((nx, nx)), xi=np.zeros(nx),
        corrections=np.zeros((HORIZON, m)), xr=np.zeros(nx), Sr=np.zeros((nx, nx)), N=np.zeros((nx, nx)),
        g=np.zeros(nx), residual=np.zeros((2, a)), torque=np.zeros(2), torque0=np.zeros(2),
        innovation=np.zeros((m, 2)), power=np.ones(m))


def copy(state: FilterState, *, horizon: bool = True) -> FilterState:
    """Return the same values in arrays of their own.

    Once the corrections are complete, nothing writes them any more, and they are shared. horizon False: what belongs to
    the moving horizon is shared too; then only an event writes it.
    """
    (x, S, noise, recent, counts, score, x0, S0, xi, corrections, xr, Sr, N, g, residual, torque, torque0,
     innovation, power) = state
    complete = counts[STORED] >= HORIZON
    if not complete:
        corrections = corrections.copy()
    if horizon or not complete:
        x0, S0, xi, xr, Sr = x0.copy(), S0.copy(), xi.copy(), xr.copy(), Sr.copy()
        N, g, torque0 = N.copy(), g.copy(), torque0.copy()
    return FilterState(
        x.copy(), S.copy(), noise.copy(), recent.copy(), counts.copy(), score.copy(), x0, S0, xi, corrections, xr, Sr,
        N, g, residual.copy(), torque.copy(), torque0, innovation.copy(), power.copy())
