"""Which payload estimates are trusted: finite, in range, confident, consistent."""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

from flexmanip_ros.parameters import ControllerParameters


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
