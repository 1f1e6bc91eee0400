"""From one payload estimate to the next: which estimates a controller may use, and when one is sent to a driver."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum
from itertools import pairwise
from typing import NamedTuple

from flexmanip_ros.parameters import AdapterParameters, ControllerParameters

LONGEST_AGE = 5.0
"""Time without an estimate [s] after which a consumer warns: by default 250 estimates are missing then."""
LONGEST_PERIODS = 2.0
"""The same in periods of the estimates, where that is longer: ``publish_rate`` may be as low as 0.01 Hz."""


class PayloadEstimate(NamedTuple):
    """Estimate of ``~/payload_estimate``: mass, standard deviation, 95 % interval [kg], residual power, body."""

    mass: float
    std: float
    lower: float
    upper: float
    consistency: float
    com: tuple[float, float] = (0.0, 0.0)
    """Centre of mass in the frame of the tip [m]; a point at the tip where nothing else is known."""
    inertia: float = 0.0
    """Inertia about the centre of mass [kg m^2]."""

    def having(self, body: Sequence[float]) -> PayloadEstimate | None:
        """Return the estimate with the body (20,) of ``~/payload_body``; None where that is of another time.

        body: mass, centre of mass x, y, inertia about it, then their covariance.
        """
        if not self.fits(body):
            return None
        return self._replace(com=(body[1], body[2]), inertia=max(body[3], 0.0))

    def fits(self, body: Sequence[float]) -> bool:
        """Whether a body, with its mass first, is finite and belongs to the estimate.

        Messages that belong together are at most a few samples apart, so their masses are close.
        """
        near = abs(body[0] - self.mass) <= max(3.0 * self.std, 1e-3 * abs(self.mass))
        return near and all(map(math.isfinite, body))


class Arrivals(NamedTuple):
    """When the latest three estimates came [s], oldest first; NaN where fewer came."""

    times: tuple[float, float, float] = (math.nan, math.nan, math.nan)

    def with_latest(self, now: float) -> Arrivals:
        """Return the arrivals after an estimate that comes now [s]."""
        return Arrivals((*self.times[1:], now))

    def age(self, now: float) -> float:
        """Return the age of the latest estimate [s]; NaN before the first."""
        return now - self.times[-1]

    def have_ceased(self, now: float) -> bool:
        """Whether an estimate is overdue; False before the first.

        The period is the longer of the last two, as an event brings an estimate between two others.
        """
        periods = (after - before for before, after in pairwise(self.times))
        period = max((period for period in periods if not math.isnan(period)), default=0.0)
        return self.age(now) > max(LONGEST_AGE, LONGEST_PERIODS * period)


class Verdict(Enum):
    """Result of the check of an estimate: trusted, or the reason why not."""

    TRUSTED = 'trusted'
    NOT_FINITE = 'the estimate is not finite'
    OUT_OF_RANGE = 'the mass is negative or above max_payload, or the body larger than the arm'
    UNSURE = 'the interval is wider than max_interval'
    INCONSISTENT = 'the residual power is above max_consistency'


def judge(config: ControllerParameters, estimate: PayloadEstimate) -> Verdict:
    """Say whether an estimate may change the gains.

    A mass near zero whose interval reaches below zero is in range: the interval, not the sign of the mass, decides.
    A body is in range where its centre of mass and its radius of gyration together are within the reach of the arm.
    """
    if not all(map(math.isfinite, (*estimate[:4], *estimate.com, estimate.inertia))):
        return Verdict.NOT_FINITE
    size = math.hypot(*estimate.com, gyration(estimate))
    if estimate.mass > config.max_payload or estimate.upper < 0.0 or size > sum(config.arm.link_length):
        return Verdict.OUT_OF_RANGE
    half = max(estimate.upper - estimate.mass, estimate.mass - estimate.lower)
    if half > config.max_interval * (config.arm.tip_mass + max(estimate.mass, 0.0)):
        return Verdict.UNSURE
    if not estimate.consistency <= config.max_consistency:
        return Verdict.INCONSISTENT
    return Verdict.TRUSTED


class HandoverState(NamedTuple):
    """Since when the estimate is trusted [s], which one the driver accepted, when it was last asked or answered [s]."""

    trusted_since: float | None = None
    sent: PayloadEstimate | None = None
    sent_at: float = -math.inf


def trusted(config: AdapterParameters, found: PayloadEstimate) -> bool:
    """Whether this payload may be sent to a driver."""
    is_finite = all(map(math.isfinite, (found.mass, found.std, gyration(found))))
    if not is_finite or not 0.0 <= found.mass <= config.max_payload:
        return False
    sure = found.std <= max(config.max_std, config.max_relative_std * found.mass)
    return sure and found.consistency <= config.max_consistency


def step(config: AdapterParameters, state: HandoverState, found: PayloadEstimate, now: float
         ) -> tuple[HandoverState, bool]:
    """Take an estimate at time ``now`` [s]; return whether it is to be sent."""
    if not trusted(config, found):
        return state._replace(trusted_since=None), False
    since = now if state.trusted_since is None else state.trusted_since
    state = state._replace(trusted_since=since)
    if now - since < config.settle_time or now - state.sent_at < config.min_period:
        return state, False
    return state, state.sent is None or changed(config, state.sent, found)


def changed(config: AdapterParameters, sent: PayloadEstimate, found: PayloadEstimate) -> bool:
    """Whether a body differs from the one that was sent by more than the parameters allow."""
    moved = max(math.dist(sent.com, found.com), abs(gyration(sent) - gyration(found)))
    return abs(found.mass - sent.mass) > max(config.max_std, config.min_change * sent.mass) \
        or moved > config.min_displacement


def gyration(body: PayloadEstimate) -> float:
    """Radius of gyration sqrt(inertia / mass) [m] about the centre of mass; infinite for an inertia without a mass."""
    if body.inertia <= 0.0:
        return 0.0
    return math.sqrt(body.inertia / body.mass) if body.mass > 0.0 else math.inf
