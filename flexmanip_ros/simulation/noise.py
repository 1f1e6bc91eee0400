"""Stationary white measurement noise that depends on the seed and the sample number alone.

Sample k of a seed has the same noise in whatever pieces a run is computed: blocks of normal numbers come
from the counter-based Philox generator, keyed by the seed, the block number its counter.
"""

from __future__ import annotations

import numpy as np

from flexmanip_ros.types import Array

BLOCK = 512
"""Samples drawn at once."""
COLUMNS = 10


def block(seed: int, number: int) -> Array:
    """Standard normal numbers (BLOCK, 10) from sample BLOCK * number on: positions, rates, stamp, loss."""
    bits = np.random.Philox(key=seed, counter=[0, 0, 0, number])
    return np.random.Generator(bits).standard_normal((BLOCK, COLUMNS))


def normal(seed: int, first: int, count: int) -> Array:
    """Standard normal numbers (count, 10) of samples first .. first + count - 1."""
    if count == 0:
        return np.zeros((0, COLUMNS))
    numbers = range(first // BLOCK, (first + count - 1) // BLOCK + 1)
    drawn = np.concatenate([block(seed, number) for number in numbers])
    start = first - BLOCK * numbers[0]
    return drawn[start:start + count]


def std_for_snr(position: Array, velocity: Array, snr_db: float) -> Array:
    """Standard deviations (8,) for a signal-to-noise ratio [dB] of every output.

    The signal is the deviation from its mean over the run: for a joint angle the motion counts, not the
    posture. position, velocity: (N, 4) noise-free.
    """
    signal = np.concatenate([position.std(axis=0), velocity.std(axis=0)])
    level: Array = signal * 10.0 ** (-snr_db / 20.0)
    return level
