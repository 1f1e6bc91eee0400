"""What the judgement reads from the estimator's arrays, compiled: somebody waits for it.

At 50 Hz a dozen small numpy calls cost several times what they cost in a loop, as none of them is in a cache.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.numerics.compiled import kernel
from flexmanip_ros.payload.filter_state import (
    BATCHES,
    BLOCKS,
    DRIFT,
    EFFECTIVE,
    FLOOR,
    POWER,
    WEIGHT,
    WHITE,
)
from flexmanip_ros.payload.tail_kernel import believed
from flexmanip_ros.types import Array

TAIL_SHARE = 0.5
"""Of the error to reckon with, what is left where nothing misfits but the modes beyond kappa, allowed for."""

Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]


@kernel
def spread(S: Array, row: int) -> float:
    """Standard deviation of one state, S: (nx, nx) square root of the covariance."""
    square = 0.0
    for c in range(S.shape[1]):
        square += S[row, c] * S[row, c]
    return math.sqrt(square)


@kernel
def misfit(noise: Array, rate: Booleans) -> float:
    """Innovation power over white noise, each sensor weighted by what it tells of the payload; nan: none yet.

    noise: (m, 8), see ``memory``; rate: (m,) whether a sensor is one of rates. Those are left out where there
    are displacements: they show the modes that the model leaves out, and have been given a larger noise.
    """
    total = sum_of_weights = 0.0
    for i in range(noise.shape[0]):
        if not rate[i]:
            total += noise[i, WEIGHT] * noise[i, POWER] / max(noise[i, WHITE], noise[i, FLOOR])
            sum_of_weights += noise[i, WEIGHT]
    return total / sum_of_weights if sum_of_weights > 0.0 else math.nan


@kernel
def drift(score: Array, counts: Integers) -> float:
    """Factor on the payload's variance: how much farther it moved than it should, beyond chance."""
    if counts[BATCHES] == 0:
        return 1.0
    beyond: float = score[DRIFT] - 2.0 * math.sqrt(2.0 / counts[BATCHES])
    return max(1.0, beyond)


@kernel
def misjudged(noise: Array, score: Array, counts: Integers) -> float:
    """How far one has to reckon with an arm that is not quite the model, 0 to 1.

    1 where a sensor shows more than its white noise; else ``TAIL_SHARE`` as far as the arm is believed to
    have more modes: seen ringing, or not to be told as no torque stepped.
    """
    chance = 2.5 * math.sqrt(2.0 / max(counts[BLOCKS], 1))
    for i in range(noise.shape[0]):
        if noise[i, EFFECTIVE] >= (1.0 + chance) * max(noise[i, WHITE], noise[i, FLOOR]):
            return 1.0
    return TAIL_SHARE * believed(score)


@kernel
def figures(S: Array, row: int, noise: Array, rate: Booleans, score: Array, counts: Integers
            ) -> tuple[float, float, float, float]:
    """Return deviation of the payload's state, misfit, drift and ``misjudged``, in one call."""
    return spread(S, row), misfit(noise, rate), drift(score, counts), misjudged(noise, score, counts)
