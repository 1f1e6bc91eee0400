"""When a payload is worth telling a driver: trusted for a while, and not what it knows already."""

from __future__ import annotations

import math
from typing import NamedTuple

from flexmanip_ros.control.gate import PayloadEstimate
from flexmanip_ros.parameters import AdapterParameters


class HandoverState(NamedTuple):
    """Since when the estimate is trusted, and what was told when [s, kg]."""

    trusted_since: float | None = None
    told_mass: float | None = None
    told_at: float = -math.inf


def trusted(config: AdapterParameters, found: PayloadEstimate) -> bool:
    """Say whether a driver may be told this payload."""
    if not all(map(math.isfinite, (found.mass, found.std))) or not 0.0 <= found.mass <= config.max_payload:
        return False
    sure = found.std <= max(config.max_std, config.max_relative_std * found.mass)
    return sure and found.consistency <= config.max_consistency


def step(config: AdapterParameters, state: HandoverState, found: PayloadEstimate, now: float
         ) -> tuple[HandoverState, bool]:
    """Take an estimate at time ``now`` [s]; return whether it is to be told."""
    if not trusted(config, found):
        return state._replace(trusted_since=None), False
    since = now if state.trusted_since is None else state.trusted_since
    state = state._replace(trusted_since=since)
    if now - since < config.settle_time or now - state.told_at < config.min_period:
        return state, False
    told = state.told_mass
    same = told is not None and abs(found.mass - told) <= max(config.max_std, config.min_change * told)
    return state, not same


def told(state: HandoverState, mass: float, now: float) -> HandoverState:
    """Note that the driver took a payload."""
    return state._replace(told_mass=mass, told_at=now)


def refused(state: HandoverState, now: float) -> HandoverState:
    """Note that it did not: try again after the shortest period."""
    return state._replace(told_at=now)
