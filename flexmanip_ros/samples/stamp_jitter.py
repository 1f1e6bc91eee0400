"""When samples were taken, where header stamps jitter: the clock of a periodic publisher.

A stamp is its instant plus white noise of variance v. From sample to sample the instant moves on by the sample time T
and white noise of variance q, and T drifts slowly. The Kalman filter of these two states, phase and period (Galleani
and Tavella 2010), is a line fitted to all stamps at first: its end is 2 sqrt(v / n) off after n of them. The interval
between two stamps is T plus e, E(e^2) = 2 v + q, and E(e_k e_k-1) = -v. So the intervals tell v and q.

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
LEAST_GAIN = 0.005
"""Least gain of the phase. It leaves 6 % of the jitter, and follows a clock whose rate changes by 500 parts in a
million to 0.09 sample times."""
DRIFT = 0.25 * LEAST_GAIN ** 4
"""Variance of the change of T from sample to sample over v: the steady gain of the phase is ``LEAST_GAIN``."""
MEMORY = 10_000
"""Intervals over which the moments of e are averaged."""
LOSS = 1e-3
"""Probability of a lost message that is assumed where jitter could explain an interval as well."""
CHANCE = 4.0
"""Standard deviations of the moments that may be chance: they are looked at after each of some thousand samples."""
WALK = 1e6
"""Largest q / v that the filter takes: there a stamp is taken as it is."""
PRIOR_INFORMATION = 10.0
"""Information on the share of the jitter that is in the samples, before any: 1/2 +- 1/2. That is 4, times 2.63, as
successive fourth differences are correlated (sum of their squared autocorrelations)."""
UNKNOWN = 1.0, 0.0, 2.0
"""Variances over v where one stamp is known, and T from one interval."""


class Jitter(NamedTuple):
    """What the intervals so far tell of the stamps."""

    late_ns: float = 0.0
    """By how much the last stamp is later than one without jitter [ns]."""
    period_ns: float = 0.0
    """Sample time T [ns]; 0 before it is known."""
    variance: tuple[float, float, float] = UNKNOWN
    """Variance of the phase, covariance and variance of T, over v."""
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
        if self.is_sharp:
            return 0.0
        share = (self.in_samples + 0.5 * PRIOR_INFORMATION) / (self.information + PRIOR_INFORMATION)
        return (1.0 - min(max(share, 0.0), 1.0)) * self.late_ns

    @property
    def walk(self) -> float:
        """Ratio q / v, at most ``WALK``; what chance may explain is no walk."""
        # where q = 0, 2 product / square scatters by sqrt(2 / intervals) (Bartlett 1946)
        chance = CHANCE * math.sqrt(2.0 / self.intervals) * self.square
        q = max(self.square + 2.0 * self.product - chance, 0.0)
        v = 0.5 * (self.square - q)
        return min(q / v, WALK) if v > 0.0 else WALK

    @property
    def gain(self) -> float:
        """Gain of the phase at the last stamp, 0 to 1; 1: the stamp was taken as it is."""
        return self.variance[0]

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

    def after(self, interval_ns: float, steps: int, mean_ns: float) -> Jitter:
        """Return the state after an interval of ``steps`` sample times; more than one: messages were lost.

        mean_ns: mean sample time so far [ns].
        """
        known = self._replace(deviation_ns=0.0)
        if steps == 1:
            e = min(interval_ns - mean_ns, mean_ns)  # one interval far from all others may not count for ever
            count = min(self.intervals + 1, MEMORY)
            known = self._replace(deviation_ns=e, intervals=count, square=self.square + (e * e - self.square) / count,
                                  product=self.product + (e * self.deviation_ns - self.product) / count)
        if known.square == 0.0:  # all intervals were equal
            return known
        return known._filtered(interval_ns, steps, self.period_ns or mean_ns)

    def _filtered(self, interval_ns: float, steps: int, period_ns: float) -> Jitter:
        """Return the state after the filter's prediction over ``steps`` sample times and its update by a stamp."""
        a, b, c = self.variance
        a, b, c = a + steps * (2.0 * b + steps * c + self.walk), b + steps * c, c + steps * DRIFT
        innovation = self.ahead_ns(interval_ns, steps * period_ns)
        phase, rate = a / (a + 1.0), b / (a + 1.0)  # gains; v = 1
        return self._replace(late_ns=(1.0 - phase) * innovation, period_ns=period_ns + rate * innovation,
                             variance=(phase, rate, c - rate * b))

    def after_equal(self, count: int) -> Jitter:
        """Return the state after ``count`` intervals of exactly one sample time, where all before were."""
        return self._replace(intervals=min(self.intervals + count, MEMORY))

    def restarted(self) -> Jitter:
        """Return the state where nothing but the last stamp tells when its sample was taken."""
        return self._replace(late_ns=0.0, deviation_ns=0.0, variance=(1.0, 0.0, self.variance[2]))

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
