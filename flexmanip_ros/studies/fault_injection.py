"""Faults of networks and publishers, put into the messages of a simulation."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from flexmanip_ros.studies.scenario import Faults
from flexmanip_ros.types import CaptureEvent, JointRecord

Item = JointRecord | CaptureEvent


def inject(items: Iterable[Item], faults: Faults, rng: np.random.Generator) -> list[Item]:
    """Return the messages with the faults of a scenario; events are delayed, never lost."""
    given = list(items)
    records = [item for item in given if isinstance(item, JointRecord)]
    events = [item for item in given if isinstance(item, CaptureEvent)]
    if not records:
        return given
    start = records[0].stamp_ns
    begin, end = (start + round(edge * 1e9) for edge in faults.gap)
    arriving: list[tuple[int, Item]] = []
    for record in records:
        chances = rng.random(4)  # always drawn, so that the probability of one fault does not move another
        if chances[0] < faults.drop or begin <= record.stamp_ns < end:
            continue
        sent = _with_nan(record, rng) if chances[3] < faults.nan else record
        arriving.append((record.stamp_ns, sent))
        if chances[1] < faults.duplicate:
            arriving.append((record.stamp_ns, sent))
        if chances[2] < faults.swap and len(arriving) > 1:
            (earlier, first), (later, second) = arriving[-2:]
            arriving[-2:] = [(earlier, second), (later, first)]
    delay = round(faults.event_delay * 1e9)
    # An event without delay arrives before the sample of its own stamp, as in a recording.
    arriving += [(event.stamp_ns + delay - (delay == 0), event) for event in events]
    return [item for _, item in sorted(arriving, key=lambda pair: pair[0])]


def _with_nan(record: JointRecord, rng: np.random.Generator) -> JointRecord:
    position = record.position.copy()
    position[int(rng.integers(position.size))] = np.nan
    return record._replace(position=position)
