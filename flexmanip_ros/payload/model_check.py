"""The payload of ``structured`` against the identified model: two routes from the same samples, one arm.

``structured`` fits the arm's equations to every sample; RPBSID knows of no arm. What both say of it is
compared: the lowest two frequencies, and how strongly each torque drives those two modes (the residues of
both together: close modes share them). Where they disagree by more than they may, the payload's interval
reaches over what the model says, and the status is INCONSISTENT. See docs/payload.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flexmanip_ros.identification.uncertainty import Identified
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload.interval import QUANTILE
from flexmanip_ros.payload.model_comparison import Verdict, compare
from flexmanip_ros.payload.structured import StructuredState
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.types import Array, Mode, Payload, Status

EVERY = 32
"""Of so many samples one tells where the arm is."""
LEAST = 1000.0
"""Samples behind a fit that is compared."""
BELIEVED = (Status.TRACKING, Status.POORLY_EXCITED, Status.INCONSISTENT)


def sweep(before: Array, rows: Rows, relative: bool) -> Array:
    """Return where the arm was since the event, after more rows; relative: angle 2 is from link 1 on.

    (5,) smallest and largest cosine of the angle between the links, then angle of joint 1 [rad]; samples.
    """
    count = int(before[4]) if before.size else 0
    after = before.copy() if before.size else np.array([1.0, -1.0, math.inf, -math.inf, 0.0])
    angles = rows.angles
    if angles.shape[1] != 2:
        return before
    for first, second in angles[-count % EVERY::EVERY].tolist():
        cosine = math.cos(second if relative else second - first)
        after[0], after[1] = min(after[0], cosine), max(after[1], cosine)
        after[2], after[3] = min(after[2], first), max(after[3], first)
    after[4] = count + len(rows)
    return after


def remember(verdicts: tuple[Verdict, ...], new: Verdict | None, reach: int) -> tuple[Verdict, ...]:
    """Return the verdicts that may still be asked for: of the arm when it was empty, and the latest.

    reach: time [ns] that an event may come late; what was read meanwhile may turn out to date from after it.
    """
    if new is None:
        return verdicts
    kept = [old for old in verdicts if not old.held and old.at < new.at
            and (old.at < new.since or old.since == new.since)]
    while len(kept) > 1 and kept[1].at < new.at - reach:
        kept = kept[1:]
    return (*kept, new)


def check(config: IdentifierParameters, state: StructuredState | None, payload: Payload | None, swept: Array,
          identified: Identified, modes: Sequence[Mode], at: int = 0, since: int = 0) -> Verdict | None:
    """Compare an identified model with the arm as ``structured`` knows it; None where nothing can be said.

    payload: as estimated without the model; swept: see ``sweep``; modes: of the identified model; at, since:
    stamps now and of the last event [ns]. Only a refined fit of some length is compared, and only with an
    estimate that claims something.
    """
    if state is None or state.model is None or state.memory is None or payload is None or swept.size == 0:
        return None
    if (identified.status is not Status.TRACKING or not identified.refined or identified.samples < LEAST
            or payload.status not in BELIEVED):
        return None
    try:
        found = compare(config, state.model, state.memory, payload, swept, identified, modes)
    except np.linalg.LinAlgError:
        return None
    return found if found is None else found._replace(at=at, since=since)


def apply(state: StructuredState, payload: Payload, verdicts: tuple[Verdict, ...], since: int) -> Payload:
    """Return the payload with the interval that the latest verdict leaves it. since: stamp of the last event.

    One that dates from the same event counts. So does what was found of the arm when it was last empty,
    until a model since the event agrees well.
    """
    if not verdicts or state.memory is None or state.model is None or payload.status not in BELIEVED:
        return payload
    m = state.memory
    own = verdicts[-1] if verdicts[-1].since == since else None
    empty = next((one for one in reversed(verdicts) if one.at < since and not one.held), None)
    disagree = own is not None and own.deviation > 1.0
    doubt = own.doubt if own is not None else 0.0
    if empty is not None and (own is None or not own.clears):
        doubt = max(doubt, empty.doubt)
    if not disagree and doubt == 0.0:
        return payload
    if not m.counts[mem.HELD]:  # an arm that does not move as an empty one may hold anything
        return payload._replace(lower=0.0, upper=math.inf, std=math.inf, status=Status.INCONSISTENT)
    std = math.hypot(payload.std, doubt * (payload.mass + state.model.motion.scale))
    lower, upper = payload.mass - QUANTILE * std, payload.mass + QUANTILE * std
    if own is not None:
        lower, upper = min(lower, own.lower), max(upper, own.upper)
    return payload._replace(std=std, status=Status.INCONSISTENT,
                            lower=max(0.0, min(payload.lower, lower)), upper=max(payload.upper, upper))
