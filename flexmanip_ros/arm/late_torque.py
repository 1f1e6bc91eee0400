"""Torque that follows the effort in a message after a dead time and through a first-order lag.

The torque's response to a unit step of the effort is 1 - exp(-(t - delay) / lag), t > delay. The arm is integrated with
torques that are held over a sample, so the functions below give the mean torque over each sample.
"""

import math

import numpy as np

from flexmanip_ros.numerics.compiled import inner, kernel
from flexmanip_ros.types import Array

SETTLED = 9.0
"""Number of lags after which the response to a step of the effort counts as settled: 1e-4 of the step is left."""


@inner
def integrated_step(t: float, delay: float, lag: float) -> tuple[float, float, float]:
    """Return the integral of the step response up to t, and the derivatives of the integral by delay and lag."""
    since = t - delay
    if since <= 0.0:
        return 0.0, 0.0, 0.0
    left = math.exp(-since / lag) if since < 40.0 * lag else 0.0
    by_lag = left - 1.0
    if left > 0.0:
        by_lag += left * since / lag
    return since - lag * (1.0 - left), left - 1.0, by_lag


@inner
def late_torque(efforts: Array, i: int, delay: float, lag: float, period: float, slope: Array) -> float:
    """Return the mean torque of a joint over the latest sample; slope (2,): its derivatives by delay and lag.

    efforts: (P, >= i + 1); column i has the efforts held over the latest sample and those before it, newest last. The
    future effort that a delay below zero needs is extrapolated. At fixed delay + lag the torque is an even function of
    the lag up to second order. This symmetry defines the torque at a lag below zero, which noise may give as the
    estimate for a torque that is not late.
    """
    newest = efforts.shape[0] - 1
    mirrored = lag < 0.0
    if mirrored:
        delay, lag = delay + 2.0 * lag, -lag
    delay = max(delay, -period)
    torque: float = efforts[newest, i]
    by_delay, by_lag = 0.0, 0.0
    for j in range(newest):
        change = efforts[newest - j, i] - efforts[newest - j - 1, i]
        if change != 0.0:
            end, end_by_delay, end_by_lag = integrated_step((j + 1) * period, delay, lag)
            begin, begin_by_delay, begin_by_lag = integrated_step(j * period, delay, lag)
            if j == 0 and delay < 0.0:
                earlier, earlier_by_delay, earlier_by_lag = integrated_step(-period, delay, lag)
                begin, begin_by_delay, begin_by_lag = earlier, earlier_by_delay, earlier_by_lag
            torque += ((end - begin) / period - 1.0) * change
            by_delay += (end_by_delay - begin_by_delay) / period * change
            by_lag += (end_by_lag - begin_by_lag) / period * change
        if j * period >= delay + SETTLED * lag:
            break
    slope[0] = by_delay
    slope[1] = 2.0 * by_delay - by_lag if mirrored else by_lag
    return torque


@kernel
def late_torques(efforts: Array, delay: float, lag: Array, period: float, slope: Array, torques: Array) -> None:
    """Fill torques (N, L), the mean torques over the last N samples of efforts (P - 1 + N, L); slope: (2,) scratch."""
    before = efforts.shape[0] - torques.shape[0]
    for k in range(torques.shape[0]):
        for i in range(torques.shape[1]):
            torques[k, i] = late_torque(efforts[k:k + before + 1], i, delay, lag[i], period, slope)


def efforts_needed(delay: float, lag: float, period: float) -> int:
    """Return P, how many efforts a torque depends on; 1 where it is not late."""
    late = max(delay, 0.0) + SETTLED * lag
    return int(np.ceil(late / period)) + 2 if late > 0.0 else 1
