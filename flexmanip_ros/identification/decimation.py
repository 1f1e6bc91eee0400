"""Decimation for the identifier: one anti-alias filter for every signal, then every D-th sample is kept.

Inputs and outputs pass the same linear-phase filter, so the linear relation between them is preserved. Only the input
between the kept samples is lost; a direct term takes up most of its effect.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.types import Array

TAPS = 8
"""Length of the filter in kept sample times."""
LAG = TAPS // 2
"""Delay of the filter in kept sample times, from the instant of a filtered sample to the last sample it depends on."""

Missing = NDArray[np.int64]
"""See ``Rows.missing``."""


class Decimator(NamedTuple):
    """taps: (L,) filter; history: (L - 1, r + m) and missing: (L - 1,) of the latest samples; seen: since a gap."""

    taps: Array
    history: Array
    missing: Missing
    seen: int


def start(factor: int, width: int) -> Decimator:
    """Begin with an empty filter. factor: D >= 2; width: r + m."""
    length = TAPS * factor + 1
    cutoff = 0.8 / factor  # of the Nyquist frequency
    taps = np.hamming(length) * np.sinc(cutoff * (np.arange(length) - (length - 1) / 2.0))
    taps /= taps.sum()
    return Decimator(taps, np.zeros((length - 1, width)), np.zeros(length - 1, dtype=np.int64), 0)


def colour(factor: int) -> float:
    """Return the factor on standard deviations that were computed as if filtered noise were white.

    It is the root of the noise's power density below the cutoff over its mean density: 1.19; 1 without decimation.
    """
    taps = start(factor, 0).taps
    return 1.0 if factor == 1 else float((factor * taps @ taps) ** -0.5)


def decimate(decimator: Decimator, samples: Array, missing: Missing, factor: int
             ) -> tuple[Decimator, Array, NDArray[np.int64], Missing]:
    """Filter samples (k, r + m); return the kept ones (j, r + m), and for each the index of the sample it ends with.

    missing: (k,) of the samples; last result: (j,) of those that the kept ones describe, ``LAG`` earlier. A sample that
    is not finite makes those not finite that depend on it, and the identifier rejects them.
    """
    taps, history, before, seen = decimator
    joint, missing = np.vstack([history, samples]), np.concatenate([before, missing])
    order = len(taps) - 1
    # joint[order + i] is sample number seen + i + 1 since the gap; it is kept where the filter is full, every factor-th
    numbers = seen + 1 + np.arange(len(samples))
    due = np.flatnonzero((numbers > order) & ((numbers - order - 1) % factor == 0))
    out = np.empty((len(due), samples.shape[1]))
    for row, i in enumerate(due):
        out[row] = taps @ joint[i:i + order + 1]
    going_on = Decimator(taps, joint[len(joint) - order:], missing[len(joint) - order:], seen + len(samples))
    return going_on, out, due, missing[due + LAG * factor]


def whole(samples: Array, factor: int) -> tuple[Array, NDArray[np.int64]]:
    """Filter one stretch (N, w) at once; return the kept samples (k, w) and the row (k,) that each describes.

    factor 1: the samples themselves. The last row on which kept sample i depends is LAG * factor rows later.
    """
    if factor == 1:
        return samples, np.arange(len(samples))
    _, kept, due, _ = decimate(start(factor, samples.shape[1]), samples, np.zeros(len(samples), np.int64), factor)
    return kept, due - LAG * factor
