"""Apply events at their own stamps, whatever the order of their arrival.

An event that arrives early waits for its stamp. One that arrives late is applied at its own stamp: the estimator goes
back to a snapshot before the event and takes the rows of the log again. Once the event has arrived, the result depends
on stamps alone. An event older than ``rewind_time`` is applied at once and counted. An event from before the first
sample (latched, received only now) holds for all samples: the payload's estimator begins again with it.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Generic, NamedTuple, Protocol, Self, TypeVar

from flexmanip_ros.numerics.background import Background
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples.sample_log import Rows, SampleLog
from flexmanip_ros.types import CaptureEvent, EventKind

BEFORE_ALL = -(1 << 63)
"""Stamp that stands for the row before the first one [ns]."""
SNAPSHOTS = 2
"""Number of snapshots within ``rewind_time``. One older snapshot is kept, so a rewind can go back all this time."""
FAR_EVENT_NS = 10_000_000_000
"""Time between an event and the samples beyond which its stamp is probably of another clock, or zero [ns]."""
MOST_EVENTS = 100
"""Largest number of events that wait in a node for their stamps; it rejects more. A recording may have more."""
MOST_ROWS = 20_000
"""Largest number of rows kept for a rewind. Where ``rewind_time`` has more rows, a rewind goes back less far."""


class Estimator(Protocol):
    """An immutable estimator that takes rows of the sample log, and events between them."""

    def first_needed(self, cursor: int) -> int:
        """Return the first row that the estimator will read again; cursor: the row that it takes next."""

    def advance(self, config: IdentifierParameters, rows: Rows, background: Background) -> Self:
        """Take the next rows."""

    def event(self, config: IdentifierParameters, event: CaptureEvent, background: Background) -> Self:
        """Take an event: the arm caught or released an object before the next row."""

    def restart(self, config: IdentifierParameters, events: Sequence[CaptureEvent]) -> Self:
        """Take account of events from before the first row, which arrived late."""


E = TypeVar('E', bound=Estimator)


class Snapshot(NamedTuple, Generic[E]):
    """The estimator before the row ``row`` and the events at it.

    stamp_ns: stamp of that row [ns]; before_ns: stamp of the row before it [ns].
    """

    row: int
    stamp_ns: int
    before_ns: int
    estimator: E


class EventReplay(NamedTuple, Generic[E]):
    """The present estimator, with the snapshots and events that a rewind needs."""

    estimator: E
    cursor: int = 0
    """Row of the sample log that is taken next."""
    last_ns: int = BEFORE_ALL
    """Stamp of the row before ``cursor`` [ns]."""
    snapshots: tuple[Snapshot[E], ...] = ()
    applied: tuple[tuple[int, CaptureEvent], ...] = ()
    """Events at or after the oldest snapshot, each with the row before which it was applied."""
    pending: tuple[CaptureEvent, ...] = ()
    """Events whose stamp has not been reached."""
    latest: tuple[CaptureEvent, ...] = ()
    """The latest event of each kind that was taken, to recognise a repeated one."""
    late_events: int = 0
    repeated_events: int = 0
    rewinds: int = 0

    def stamp_of(self, kind: EventKind) -> int | None:
        """Return the stamp of the latest event of a kind, None when there was none."""
        return next((event.stamp_ns for event in self.latest if event.kind is kind), None)


def first_needed(replay: EventReplay[E]) -> int:
    """Return the first row of the log that may be read again."""
    return min(replay.estimator.first_needed(replay.cursor), replay.cursor,
               *(min(one.row, one.estimator.first_needed(one.row)) for one in replay.snapshots))


def advance(config: IdentifierParameters, replay: EventReplay[E], log: SampleLog, until: int,
            background: Background) -> EventReplay[E]:
    """Take the rows of the log up to ``until``, with the events that fall among them."""
    while replay.cursor < until:
        stop = min(until, _next_snapshot(config, replay, log, until))
        if stop == replay.cursor:
            replay = _snapshot(config, replay, log)
            stop = min(until, _next_snapshot(config, replay, log, until))
        event = replay.pending[0] if replay.pending else None
        if event is not None:
            row = log.row_at(event.stamp_ns, replay.cursor)
            if row == replay.cursor:
                replay = replay._replace(
                    estimator=replay.estimator.event(config, event, background),
                    applied=(*replay.applied, (row, event)), pending=replay.pending[1:])
                continue
            stop = min(stop, row)
        rows = log.rows(replay.cursor, stop)
        replay = replay._replace(
            estimator=replay.estimator.advance(config, rows, background), cursor=stop,
            last_ns=int(rows.stamp_ns[-1]))
    return replay


def insert(config: IdentifierParameters, replay: EventReplay[E], event: CaptureEvent, first_ns: int) -> EventReplay[E]:
    """Take an event: let it wait for its stamp, go back to before it, or apply it now where it is too old for that.

    After it went back, rows have to be taken again (``advance``). An event that is too old, and has an event after it
    that was applied, is only counted: what the arm holds now is known from the later event. One near another of its
    kind is that one, unless an event of the other kind lies between them. first_ns: stamp of the first sample [ns].
    """
    if same_event(config, event, replay.latest) is not None:
        return replay._replace(repeated_events=replay.repeated_events + 1)
    known = replay.latest
    replay = replay._replace(latest=(*(e for e in known if e.kind is not event.kind), event))
    if event.stamp_ns > replay.last_ns:
        return _wait(replay, event)
    if event.stamp_ns > replay.snapshots[0].before_ns:
        return _rewind(replay, event)
    replay = replay._replace(late_events=replay.late_events + 1)
    if all(taken.stamp_ns <= first_ns for taken in replay.latest):
        return _restart(config, replay)
    if any(event.stamp_ns < taken.stamp_ns <= replay.last_ns for taken in known):
        return replay._replace(latest=known)
    late_ns = replay.last_ns + 1 - event.stamp_ns
    return _wait(replay, event._replace(stamp_ns=replay.last_ns + 1, std_s=math.hypot(event.std_s, late_ns * 1e-9)))


def same_event(config: IdentifierParameters, event: CaptureEvent, latest: Iterable[CaptureEvent]
               ) -> CaptureEvent | None:
    """Return the one of the latest events, one of each kind, that an event is taken for; None where it is another."""
    previous = next((one for one in latest if one.kind is event.kind), None)
    if previous is None or abs(event.stamp_ns - previous.stamp_ns) > config.event_merge_time * 1e9:
        return None
    first_ns, last_ns = sorted((previous.stamp_ns, event.stamp_ns))
    is_apart = any(first_ns < one.stamp_ns <= last_ns for one in latest if one.kind is not event.kind)
    return None if is_apart else previous


def distinct(config: IdentifierParameters, events: Iterable[CaptureEvent]
             ) -> tuple[list[CaptureEvent], list[tuple[CaptureEvent, CaptureEvent]]]:
    """Return the events that count, and each of the others with the one that it was taken for. events: as they came."""
    counted: list[CaptureEvent] = []
    merged: list[tuple[CaptureEvent, CaptureEvent]] = []
    latest: dict[EventKind, CaptureEvent] = {}
    for event in events:
        same = same_event(config, event, latest.values())
        if same is None:
            latest[event.kind] = event
            counted.append(event)
        else:
            merged.append((event, same))
    return counted, merged


def _restart(config: IdentifierParameters, replay: EventReplay[E]) -> EventReplay[E]:
    """Restart the estimator with the events, as every sample came after them; drop the older snapshots."""
    estimator = replay.estimator.restart(config, sorted(replay.latest, key=_order))
    only = Snapshot(replay.cursor, replay.last_ns + 1, replay.last_ns, estimator)
    return replay._replace(estimator=estimator, snapshots=(only,), applied=())


def _order(event: CaptureEvent) -> tuple[int, bool]:
    """Sort key of events: the stamp, and at the same stamp a release before a capture."""
    return event.stamp_ns, event.kind is EventKind.CAPTURE


def _wait(replay: EventReplay[E], event: CaptureEvent) -> EventReplay[E]:
    return replay._replace(pending=tuple(sorted((*replay.pending, event), key=_order)))


def _next_snapshot(config: IdentifierParameters, replay: EventReplay[E], log: SampleLog, until: int) -> int:
    """Return the row before which the next snapshot is due: the first row, then one each rewind_time / SNAPSHOTS.

    A snapshot that would be too old for a rewind at row ``until`` is left out. Events are inserted only after all rows
    before ``until`` are taken.
    """
    if not replay.snapshots:
        return replay.cursor
    rewind_ns = int(config.rewind_time * 1e9)
    spacing_ns = max(rewind_ns // SNAPSHOTS, 1)
    last_ns = int(log.rows(until - 1, until).stamp_ns[0])
    oldest = (last_ns // spacing_ns * spacing_ns - rewind_ns) // spacing_ns
    instant = max(replay.snapshots[-1].stamp_ns // spacing_ns + 1, oldest)
    return min(log.row_at(instant * spacing_ns, replay.cursor), replay.snapshots[0].row + MOST_ROWS)


def _snapshot(config: IdentifierParameters, replay: EventReplay[E], log: SampleLog) -> EventReplay[E]:
    """Keep a snapshot of the estimator before the next row; drop snapshots and events that are too old."""
    stamp_ns = int(log.rows(replay.cursor, replay.cursor + 1).stamp_ns[0])
    kept = (*replay.snapshots, Snapshot(replay.cursor, stamp_ns, replay.last_ns, replay.estimator))
    oldest_needed = stamp_ns - int(config.rewind_time * 1e9)
    too_many = replay.cursor - kept[0].row >= MOST_ROWS
    while len(kept) > 1 and (kept[1].stamp_ns <= oldest_needed or too_many):
        kept = kept[1:]
    return replay._replace(snapshots=kept,
                           applied=tuple((row, e) for row, e in replay.applied if row >= kept[0].row))


def _rewind(replay: EventReplay[E], event: CaptureEvent) -> EventReplay[E]:
    """Go back to the last snapshot not after the event; ``advance`` then takes the rows and events again."""
    kept = tuple(one for one in replay.snapshots if one.before_ns < event.stamp_ns)
    back = kept[-1]
    again = sorted((*(e for row, e in replay.applied if row >= back.row), *replay.pending, event), key=_order)
    return replay._replace(
        estimator=back.estimator, cursor=back.row, last_ns=back.before_ns, snapshots=kept,
        applied=tuple((row, e) for row, e in replay.applied if row < back.row), pending=tuple(again),
        rewinds=replay.rewinds + 1)
