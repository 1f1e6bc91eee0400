"""The methods that the paper compares with, on the messages and at the publishing instants of the identifier."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload.baselines import ALGEBRAIC, RIGID_RLS, Baseline, BaselineState
from flexmanip_ros.samples import sampling
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.types import CaptureEvent, Estimate, JointRecord

BASELINES: Mapping[str, Baseline] = {'rigid_rls': RIGID_RLS, 'algebraic': ALGEBRAIC}


class Recorded(NamedTuple):
    """The rows of a recording, and its events by stamp."""

    rows: Rows
    events: tuple[CaptureEvent, ...]


def recorded(config: IdentifierParameters, items: Iterable[JointRecord | CaptureEvent]) -> Recorded:
    """Return the samples and events of messages."""
    clock, log = sampling.Clock(), sampling.EMPTY
    events: list[CaptureEvent] = []
    for item in items:
        if isinstance(item, CaptureEvent):
            events.append(item)
        else:
            clock, log, _ = sampling.push(config, clock, log, item)
    events.sort(key=lambda event: event.stamp_ns)
    return Recorded(log.rows(log.start, log.end), tuple(events))


def run(name: str, config: IdentifierParameters, recorded: Recorded) -> Iterator[Estimate]:
    """Yield estimates with a payload and no model: at each publishing instant and at the last sample."""
    baseline, rows = BASELINES[name], recorded.rows
    if not len(rows):
        return
    stamps = rows.stamp_ns
    instants = ((stamps - stamps[0]) * config.publish_rate * 1e-9 + 1e-6).astype(np.int64)
    due = set((np.flatnonzero(np.diff(instants, prepend=-1) > 0) + rows.first + 1).tolist()) | {rows.until}
    events = [(rows.log.row_at(event.stamp_ns, rows.first), event) for event in recorded.events]
    state, cursor = baseline.init(config), rows.first
    for until in sorted(due | {row for row, _ in events if row > cursor}):
        while events and events[0][0] == cursor:
            state = baseline.event(config, state, events.pop(0)[1])
        state, cursor = baseline.advance(config, state, rows.between(cursor, until)), until
        if until in due:
            yield _estimate(baseline, config, state, int(stamps[until - 1 - rows.first]))


def _estimate(baseline: Baseline, config: IdentifierParameters, state: BaselineState, stamp_ns: int) -> Estimate:
    payload = baseline.estimate(config, state)
    return Estimate(stamp_ns, payload.status, None, (), payload)
