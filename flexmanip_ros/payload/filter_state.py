"""What the structured estimator remembers: arrays of constant size, copied before a call writes them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.types import Array

HORIZON = 512
"""Samples after an event that are kept and fitted again and again from the event on."""

# columns of ``noise``, one row a sensor: variance used; of the innovations; slow part of it; two sums of
# this block; least one; of what no motion explains (fourth differences); share in what the payload rests on
EFFECTIVE, POWER, SLOW, BLOCK_SUM, BLOCK_POWER, FLOOR, WHITE, WEIGHT = range(8)
# elements of ``count``
HELD, STORED, PASSED, PASSING, IN_BLOCK, BLOCKS, SINCE_EVENT, SINCE_NOISE, IN_BATCH, BATCHES, SEEN = range(11)
# elements of ``score``
MOVE, VARIANCE, DRIFT, NOW, SEEMED, BEYOND, SHOWN, TOLD, ODDS = range(9)


class Memory(NamedTuple):
    """The filter and the fit that runs behind it; nx states, m sensors."""

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
    """(9,) move of the payload in this batch, its variance; mean squared normalised move; time to diffuse;
    what the arm seemed to hold before the event, when it was empty, in standard deviations, then in those
    that the error to reckon with in its inertia adds to; how much the innovations have in common with the
    ringing of modes beyond kappa, and how much of it they could show (variance of the former), and the odds
    of such modes beforehand (logarithm)."""
    x0: Array
    """(nx,) mean just after the last event."""
    S0: Array
    """(nx, nx) its square root."""
    xi: Array
    """(nx,) fitted departure from x0 in units of S0."""
    corrections: Array
    """(HORIZON, m) what the residual modes were taken to add to the measurements since the event."""
    xr: Array
    """(nx,) reference trajectory of the running pass."""
    Sr: Array
    """(nx, nx) its sensitivity to xi."""
    N: Array
    """(nx, nx) information gathered in the pass."""
    g: Array
    """(nx,) gradient gathered in the pass."""
    tail: Array
    """(2, a) modes beyond kappa: departure from where the torque holds them, its rate."""
    torque: Array
    """(2,) held before the latest sample."""
    torque0: Array
    """(2,) held before the last event."""
    innovation: Array
    """(m, 2) the latest, and its variance before the update."""
    power: Array
    """(m,) mean squared normalised innovation of each sensor since the event, slowly forgotten."""


def memory(nx: int, m: int, a: int = 0) -> Memory:
    """Allocate for nx states, m sensors, a modes beyond kappa."""
    return Memory(
        x=np.zeros(nx), S=np.zeros((nx, nx)), noise=np.zeros((m, 8)), recent=np.zeros((m, 4)),
        counts=np.zeros(11, dtype=np.int64),
        score=np.zeros(9), x0=np.zeros(nx), S0=np.zeros((nx, nx)), xi=np.zeros(nx),
        corrections=np.zeros((HORIZON, m)), xr=np.zeros(nx), Sr=np.zeros((nx, nx)), N=np.zeros((nx, nx)),
        g=np.zeros(nx), tail=np.zeros((2, a)), torque=np.zeros(2), torque0=np.zeros(2),
        innovation=np.zeros((m, 2)), power=np.ones(m))


def copy(state: Memory, *, refit: bool = True) -> Memory:
    """Return the same values in arrays of their own.

    All but the corrections, the largest part, once they are complete: nothing writes them any more. refit
    False: nor what belongs to the refit, which only an event writes then.
    """
    (x, S, noise, recent, counts, score, x0, S0, xi, corrections, xr, Sr, N, g, tail, torque, torque0, innovation,
     power) = state
    complete = counts[STORED] >= HORIZON
    if not complete:
        corrections = corrections.copy()
    if refit or not complete:
        x0, S0, xi, xr, Sr = x0.copy(), S0.copy(), xi.copy(), xr.copy(), Sr.copy()
        N, g, torque0 = N.copy(), g.copy(), torque0.copy()
    return Memory(x.copy(), S.copy(), noise.copy(), recent.copy(), counts.copy(), score.copy(), x0, S0, xi,
                  corrections, xr, Sr, N, g, tail.copy(), torque.copy(), torque0, innovation.copy(), power.copy())
