"""When samples were taken, where header stamps jitter: the clock of a periodic publisher.

The interval between two stamps is the sample time T plus e. Stamps that are off by white noise of variance v have
E(e_k e_k-1) = -v, and a publisher whose period varies by q has E(e^2) = 2 v + q. In this local level model the steady
Kalman filter is exponential smoothing (Muth 1960) with the gain a: of what a stamp differs from its prediction, the
part a goes on to all later stamps, a^2 / (1 - a) = q / v.

The rest is either in the stamps alone (a robot samples regularly, its driver stamps what arrives) or in the samples
too (a loop that wakes up late samples late). The signals tell: where a sample is late by d, it is y' d off.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.types import Array

SHARP_NS = 1e3
"""Jitter [ns] up to which stamps are taken as they are: it moves a mode of 100 Hz by 6e-4 rad."""
LEAST_GAIN = 0.01
"""Least gain a. It leaves 7 % of the jitter, and follows a clock that is set right by 500 parts in a million to 0.05
sample times."""
MEMORY = 10_000
"""Intervals over which the moments of e are averaged."""
LOSS = 1e-3
"""Probability of a lost message that is assumed where jitter could explain an interval as well."""
CHANCE = 3.0
"""Standard deviations of the moments that may be chance."""
PRIOR_INFORMATION = 10.0
"""Information on the share of the jitter that is in the samples, before any: 1/2 +- 1/2. That is 4, times 2.63, as
successive fourth differences are correlated (sum of their squared autocorrelations)."""


class Jitter(NamedTuple):
    """What the intervals so far tell of the stamps."""

    late_ns: float = 0.0
    """By how much the last stamp is later than one without jitter [ns]."""
    since: int = 0
    """Intervals since a stamp was taken as it is."""
    deviation_ns: float = 0.0
    """e of the last interval [ns]."""
    square: float = 0.0
    """Mean of e^2 [ns^2]."""
    product: float = 0.0
    """Mean of the products of successive e [ns^2]."""
    intervals: int = 0
    """Number of intervals in these means, at most ``MEMORY``."""
    in_samples: float = 0.0
    """Sum of the products of what the signals show and what jitter of the samples would add to them, ``regress``."""
    information: float = 0.0
    """Sum of the squares of the latter, ``regress``."""

    @property
    def is_sharp(self) -> bool:
        """Whether stamps are taken as they are."""
        return self.square < SHARP_NS ** 2

    @property
    def correction_ns(self) -> float:
        """By how much the last stamp is later than its sample [ns]: the part of the jitter that is not in the samples.

        The share in the samples is the coefficient of a linear regression, with a prior (ridge).
        """
        share = (self.in_samples + 0.5 * PRIOR_INFORMATION) / (self.information + PRIOR_INFORMATION)
        return (1.0 - min(max(share, 0.0), 1.0)) * self.late_ns

    @property
    def gain(self) -> float:
        """Gain a of the smoothing, 0 to 1; 1: each stamp is taken as it is."""
        if self.is_sharp:
            return 1.0
        # chance: where q = 0, 2 product / square scatters by sqrt(2 / intervals) (Bartlett 1946)
        q = max(self.square + 2.0 * self.product - CHANCE * math.sqrt(2.0 / self.intervals) * self.square, 0.0)
        v = 0.5 * (self.square - q)
        ratio = q / v if v > 0.0 else math.inf
        steady = 0.5 * (math.sqrt(ratio * (ratio + 4.0)) - ratio) if ratio < 1e3 else 1.0
        return max(steady, LEAST_GAIN, 1.0 / (self.since + 1.0))

    @property
    def std_ns(self) -> float:
        """Standard deviation of a stamp from its prediction [ns]."""
        return math.sqrt(self.square / (1.0 + (1.0 - self.gain) ** 2))

    def ahead_ns(self, interval_ns: float, period_ns: float) -> float:
        """Return by how much the next stamp is later than predicted [ns], if no message was lost."""
        return interval_ns + self.late_ns - period_ns

    def most_ns(self, period_ns: float, regular: float = 0.5) -> float:
        """Return how late a stamp may be until a lost message explains it better [ns].

        Without jitter that is ``regular`` times the sample time T, half of it. Jitter of variance s^2 adds s^2 / T
        times ln(1 / LOSS): there both explanations have the same posterior probability.
        """
        return regular * period_ns - self.std_ns ** 2 / period_ns * math.log(LOSS)

    def after(self, interval_ns: float, steps: int, period_ns: float) -> Jitter:
        """Return the state after an interval of ``steps`` sample times; more than one: messages were lost."""
        late = (1.0 - self.gain) * self.ahead_ns(interval_ns, steps * period_ns)
        if steps != 1:
            return self._replace(late_ns=late, since=self.since + 1, deviation_ns=0.0)
        e = min(interval_ns - period_ns, period_ns)  # one interval far from all others may not count for ever
        known = min(self.intervals + 1, MEMORY)
        return self._replace(late_ns=late, since=self.since + 1, deviation_ns=e,
                             square=self.square + (e * e - self.square) / known,
                             product=self.product + (e * self.deviation_ns - self.product) / known, intervals=known)

    def after_equal(self, count: int) -> Jitter:
        """Return the state after ``count`` intervals of exactly one sample time, where all before were."""
        return self._replace(since=self.since + count, intervals=min(self.intervals + count, MEMORY))

    def restarted(self) -> Jitter:
        """Return the state where nothing but the last stamp tells when its sample was taken."""
        return self._replace(late_ns=0.0, since=0, deviation_ns=0.0)

    def judged(self, stamp_ns: NDArray[np.int64], Y: Array) -> Jitter:
        """Return the state after rows without a gap have told whether samples jitter as their stamps do."""
        product, square = regress(stamp_ns, Y)
        return self._replace(in_samples=self.in_samples + product, information=self.information + square)


def regress(stamp_ns: NDArray[np.int64], Y: Array) -> tuple[float, float]:
    """Return sums of D x / s^2 and x^2 / s^2 over signals Y (N, m) of a publisher with stamps (N,).

    D: fourth differences of a signal y, in which slow motion has no part; s^2: their mean square; x: fourth differences
    of y' d, d what the stamps differ from a straight line.
    """
    stamps = np.asarray(stamp_ns - stamp_ns[0], dtype=np.float64)
    k = np.arange(len(stamps)) - 0.5 * (len(stamps) - 1)
    period = float(k @ stamps / (k @ k))
    late = stamps - np.mean(stamps) - period * k
    with np.errstate(over='ignore', invalid='ignore'):
        D = np.diff(Y[1:-1], 4, axis=0)
        X = np.diff((Y[2:] - Y[:-2]) * (0.5 / period * late[1:-1, None]), 4, axis=0)
        variance, squares, products = np.mean(D ** 2, axis=0), np.sum(X ** 2, axis=0), np.sum(D * X, axis=0)
        told = np.isfinite(variance + squares) & (variance > 0.0)  # a rate may be unknown, a signal constant
    return float(np.sum(products[told] / variance[told])), float(np.sum(squares[told] / variance[told]))
