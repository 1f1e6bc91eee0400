"""When a payload is sent to a driver: trusted for a while, and another one than the driver has."""

from __future__ import annotations

import math
from typing import NamedTuple

from flexmanip_ros.control.gate import PayloadEstimate
from flexmanip_ros.parameters import AdapterParameters


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
