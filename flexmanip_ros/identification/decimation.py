"""Fewer samples a second for the identifier: one anti-alias filter for every signal, then every D-th sample.

Inputs and outputs go through the same linear-phase filter, so the linear relation between them stays as it
was; only the course of the input between the kept samples is lost (a direct term takes up most of that).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.types import Array

TAPS = 8
"""Length of the filter in kept sample times."""
LAG = TAPS // 2
"""Kept sample times from the instant that a filtered sample describes to the last sample that it is made of."""


class Decimator(NamedTuple):
    """taps: (L,) filter; history: (L - 1, r + m) latest samples; seen: samples since the last gap."""

    taps: Array
    history: Array
    seen: int


def start(factor: int, width: int) -> Decimator:
    """Begin with an empty filter. factor: D >= 2; width: r + m."""
    length = TAPS * factor + 1
    cutoff = 0.8 / factor  # of the Nyquist frequency
    taps = np.hamming(length) * np.sinc(cutoff * (np.arange(length) - (length - 1) / 2.0))
    taps /= taps.sum()
    return Decimator(taps, np.zeros((length - 1, width)), 0)


def restart(decimator: Decimator) -> Decimator:
    """Forget the samples: nothing is filtered across a gap or an event."""
    return decimator._replace(seen=0)


def decimate(decimator: Decimator, samples: Array, factor: int) -> tuple[Decimator, Array, list[int]]:
    """Take samples (k, r + m); return the filtered ones (0.., r + m), and which sample each is due with.

    A sample that is not finite restarts the filter and is handed on as it is, so that the identifier
    sees the break.
    """
    kept: list[Array] = []
    at: list[int] = []
    good = np.all(np.isfinite(samples), axis=1)
    begin = 0
    for k in [*np.flatnonzero(~good).tolist(), len(samples)]:
        decimator, some, due = _run(decimator, samples[begin:k], factor)
        kept.append(some)
        at.extend(begin + i for i in due)
        if k < len(samples):
            decimator = restart(decimator)
            kept.append(samples[k:k + 1])
            at.append(k)
        begin = k + 1
    return decimator, np.vstack(kept), at


def whole(samples: Array, factor: int) -> tuple[Array, NDArray[np.int64]]:
    """Filter one stretch (N, w) at once; return the kept samples (k, w) and the row (k,) that each describes.

    factor 1: the samples themselves. The last row that kept sample i is made of is LAG * factor rows later.
    """
    if factor == 1:
        return samples, np.arange(len(samples))
    _, kept, due = decimate(start(factor, samples.shape[1]), samples, factor)
    return kept, np.array(due, dtype=np.int64) - LAG * factor


def _run(decimator: Decimator, samples: Array, factor: int) -> tuple[Decimator, Array, list[int]]:
    """Filter finite samples of one stretch."""
    taps, history, seen = decimator
    joint = np.vstack([history, samples])
    order = len(taps) - 1
    # joint[order + i] has number seen + i + 1 since the gap; kept when the filter is full and it is due
    numbers = seen + 1 + np.arange(len(samples))
    due = np.flatnonzero((numbers > order) & ((numbers - order - 1) % factor == 0))
    out = np.empty((len(due), samples.shape[1]))
    for row, i in enumerate(due):
        out[row] = taps @ joint[i:i + order + 1]
    going_on = decimator._replace(history=joint[len(joint) - order:], seen=seen + len(samples))
    return going_on, out, due.tolist()
