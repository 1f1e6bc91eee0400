"""What the structured estimator's state says of the payload, its interval and whether to believe it."""

from __future__ import annotations

import math

import numpy as np

from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import memory as mem
from flexmanip_ros.payload.structured_model import Model
from flexmanip_ros.types import Payload, Status

QUANTILE = 1.959963984540054
"""Of the normal distribution, for 95 %."""
UNKNOWN_STD = 0.5
"""A payload whose logarithm is less certain than this is not known."""
FEW = 50
"""Samples after an event before anything is claimed."""
POWER_LIMIT = 3.0
"""Innovation power over white noise beyond which the model does not fit."""
DRIFT_LIMIT = 6.0
"""Mean squared move of the payload over its variance beyond which the model does not fit."""


def judge(config: IdentifierParameters, model: Model | None, m: mem.Memory | None, restarts: int) -> Payload:
    """Return the payload; never a NaN."""
    if model is None:
        return Payload(0.0, math.inf, 0.0, math.inf, 1.0, Status.UNOBSERVABLE)
    if m is None:
        return Payload(0.0, math.inf, 0.0, math.inf, 1.0, Status.WARMING_UP)
    state = m.x.size - 5
    inflation = drift(m)
    std = float(np.sqrt(m.S[state] @ m.S[state]) * math.sqrt(inflation))
    consistency = misfit(m)
    status = Status.TRACKING
    if consistency > POWER_LIMIT or inflation > DRIFT_LIMIT:
        status = Status.INCONSISTENT
    if m.counts[mem.SINCE_EVENT] < FEW:
        status = Status.WARMING_UP
    if not m.counts[mem.HELD]:
        return empty(float(m.x[state]), std, consistency, status)
    mass = float(model.motion.scale * np.exp(min(m.x[state], 12.0)))
    if std > UNKNOWN_STD and status is Status.TRACKING:
        status = Status.POORLY_EXCITED
    lower = max(0.0, mass * (1.0 - QUANTILE * std))
    upper = mass * math.exp(min(QUANTILE * std, 20.0))
    return Payload(mass, mass * std, lower, upper, consistency, status)


def empty(seeming: float, std: float, consistency: float, status: Status) -> Payload:
    """Return the payload of an arm that should be empty and seems to hold ``seeming`` kg."""
    upper = max(seeming, 0.0) + QUANTILE * std
    if abs(seeming) > 3.0 * std and status is Status.TRACKING:
        return Payload(max(seeming, 0.0), std, 0.0, upper, consistency, Status.INCONSISTENT)
    return Payload(0.0, std, 0.0, upper, consistency, status)


def drift(m: mem.Memory) -> float:
    """Factor on the payload's variance: how much farther it moved than it should, beyond chance."""
    batches = int(m.counts[mem.BATCHES])
    if batches == 0:
        return 1.0
    return max(1.0, float(m.score[mem.DRIFT]) - 2.0 * math.sqrt(2.0 / batches))


def misfit(m: mem.Memory) -> float:
    """Innovation power over white noise, each sensor weighted by what it tells of the payload."""
    weight = m.noise[:, mem.WEIGHT]
    total = float(weight.sum())
    ratio = m.noise[:, mem.POWER] / np.maximum(m.noise[:, mem.WHITE], m.noise[:, mem.FLOOR])
    if total <= 0.0:
        return float(np.median(ratio))
    return float(weight @ ratio / total)
