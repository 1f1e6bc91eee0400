"""From one payload estimate to the next: which estimates a controller may use, and a smooth change between them."""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

from flexmanip_ros.parameters import AdapterParameters, ControllerParameters


class PayloadEstimate(NamedTuple):
    """What ``~/payload_estimate`` says: mass, standard deviation, 95 % interval [kg], residual power."""

    mass: float
    std: float
    lower: float
    upper: float
    consistency: float


class Verdict(Enum):
    """Trusted, or why not."""

    TRUSTED = 'trusted'
    NOT_FINITE = 'the estimate is not finite'
    OUT_OF_RANGE = 'the mass is negative or above max_payload'
    UNSURE = 'the interval is wider than max_interval'
    INCONSISTENT = 'the residual power is above max_consistency'


def judge(config: ControllerParameters, estimate: PayloadEstimate) -> Verdict:
    """Say whether an estimate may change the gains.

    A payload just above zero with an interval below it is range enough: the interval, not the sign, decides.
    """
    if not all(map(math.isfinite, (estimate.mass, estimate.std, estimate.lower, estimate.upper))):
        return Verdict.NOT_FINITE
    if estimate.mass > config.max_payload or estimate.upper < 0.0:
        return Verdict.OUT_OF_RANGE
    half = max(estimate.upper - estimate.mass, estimate.mass - estimate.lower)
    if half > config.max_interval * (config.arm.tip_mass + max(estimate.mass, 0.0)):
        return Verdict.UNSURE
    if not estimate.consistency <= config.max_consistency:
        return Verdict.INCONSISTENT
    return Verdict.TRUSTED


class HandoverState(NamedTuple):
    """Since when the estimate is trusted [s], which mass the driver accepted [kg], and when it was last asked [s]."""

    trusted_since: float | None = None
    sent_mass: float | None = None
    sent_at: float = -math.inf


def trusted(config: AdapterParameters, found: PayloadEstimate) -> bool:
    """Whether this payload may be sent to a driver."""
    if not all(map(math.isfinite, (found.mass, found.std))) or not 0.0 <= found.mass <= config.max_payload:
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
    sent = state.sent_mass
    same = sent is not None and abs(found.mass - sent) <= max(config.max_std, config.min_change * sent)
    return state, not same


def accepted(state: HandoverState, mass: float, now: float) -> HandoverState:
    """The driver accepted a payload."""
    return state._replace(sent_mass=mass, sent_at=now)


def rejected(state: HandoverState, now: float) -> HandoverState:
    """The driver did not accept it: it is sent again after ``min_period``."""
    return state._replace(sent_at=now)
