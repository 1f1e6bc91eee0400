"""Samples and events in the order of their stamps, whatever the order of their arrival.

An event that arrives early waits for its stamp. One that arrives late is applied at its own stamp: the last
``rewind_time`` of samples is kept, the estimator goes back to a checkpoint before the event and runs them
again. From its arrival on, the result depends on stamps alone. An older event is applied at once and counted.
One from before the first sample (latched, heard only now) held all along: the payload begins anew with it.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple

from flexmanip_ros import estimator
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.types import CaptureEvent, EventKind, Sample

BEFORE_ALL = -(1 << 63)
"""Stamp of the sample before the first one."""
CHECKPOINTS = 2
"""Checkpoints within ``rewind_time``; one more is kept so that the whole of it can be run again."""

MOST_EVENTS = 100
"""Events that wait for their stamps at most, the earliest ones."""
LET_GO = 2
"""Blocks no longer needed that are let go of with each new one, or more until as many samples have gone."""
MOST_SAMPLES = 20_000
"""Samples needed at most; at rates (or with stamps) that need more the time to go back is shorter."""


class Checkpoint(NamedTuple):
    """The estimator after the sample at ``after_ns``, before the one at ``stamp_ns`` and its events."""

    after_ns: int
    stamp_ns: int
    core: estimator.Core


class Timeline(NamedTuple):
    """The estimator now, and what is needed to go back."""

    core: estimator.Core
    checkpoints: tuple[Checkpoint, ...] = ()
    blocks: tuple[tuple[Sample, ...], ...] = ()
    """Samples from the oldest checkpoint on, as they were run; no block reaches over a checkpoint."""
    kept: int = 0
    """How many samples these are."""
    stale: int = 0
    """Blocks in front of these, of before it: let go of a few at a time, or a sample would wait for it."""
    applied: tuple[CaptureEvent, ...] = ()
    """Events at or after the oldest checkpoint, in the order of their stamps."""
    waiting: tuple[CaptureEvent, ...] = ()
    """Events whose stamp has not been reached."""
    latest: tuple[CaptureEvent, ...] = ()
    """The latest event of each kind that was taken, to recognise a repeated one."""
    last_ns: int = BEFORE_ALL
    late_events: int = 0
    repeated_events: int = 0
    rewinds: int = 0

    def stamp_of(self, kind: EventKind) -> int | None:
        """Return the stamp of the latest event of a kind, None when there was none."""
        return next((event.stamp_ns for event in self.latest if event.kind is kind), None)


def advance(config: IdentifierParameters, line: Timeline, samples: Sequence[Sample], *, ahead: bool = False
            ) -> Timeline:
    """Run samples, in rising stamps, through the estimator, with the events that fall among them.

    ahead: somebody waits for the payload of the last one; what can be done after it is left for later (the
    identifier's step to ``estimator.settle``, a checkpoint to the next sample).
    """
    block: list[Sample] = []
    for sample in samples:
        due = tuple(event for event in line.waiting if event.stamp_ns <= sample.stamp_ns)
        checkpoint_due = (is_checkpoint_due(config, line, sample.stamp_ns, ahead and sample is samples[-1])
                          or line.kept + len(block) >= MOST_SAMPLES)
        if block and (due or checkpoint_due):
            line = _run(config, line, block)
            block = []
        if checkpoint_due:
            line = _checkpoint(config, line, sample.stamp_ns)
        for event in due:
            line = line._replace(core=estimator.event(config, line.core, event),
                                 applied=(*line.applied, event),
                                 waiting=tuple(e for e in line.waiting if e is not event))
        block.append(sample)
    return _run(config, line, block, ahead=ahead) if block else line


def is_checkpoint_due(config: IdentifierParameters, line: Timeline, stamp_ns: int, awaited: bool = False
                      ) -> bool:
    """Whether it is time for a checkpoint before a sample of this stamp [ns].

    awaited: somebody waits for it, and the checkpoint may be late, but at the same sample always.
    """
    if not line.checkpoints:
        return True
    spacing_ns = int(config.rewind_time * 1e9) // CHECKPOINTS
    return stamp_ns - line.checkpoints[-1].stamp_ns >= spacing_ns * (3 if awaited else 2) // 2


def event(config: IdentifierParameters, line: Timeline, event: CaptureEvent, first_ns: int = BEFORE_ALL
          ) -> Timeline:
    """Take an event: let it wait, go back for it, or (too old to go back) apply it now.

    first_ns: stamp of the first sample [ns]; BEFORE_ALL when it is unknown.
    """
    previous = line.stamp_of(event.kind)
    if previous is not None and abs(event.stamp_ns - previous) <= config.event_merge_time * 1e9:
        return line._replace(repeated_events=line.repeated_events + 1)
    line = line._replace(latest=(*(e for e in line.latest if e.kind is not event.kind), event))
    if event.stamp_ns > line.last_ns:
        return _wait(line, event)
    if event.stamp_ns <= line.checkpoints[0].after_ns:
        if all(taken.stamp_ns <= first_ns for taken in line.latest):
            return _all_along(config, line)
        now = event._replace(stamp_ns=line.last_ns + 1)
        return _wait(line._replace(late_events=line.late_events + 1), now)
    return _rewind(config, line, event)


def _all_along(config: IdentifierParameters, line: Timeline) -> Timeline:
    """Every sample came after the events: forget a payload that was read as if they had not happened."""
    core = estimator.anew(config, line.core, sorted(line.latest, key=_order))
    return line._replace(core=core, checkpoints=(Checkpoint(line.last_ns, line.last_ns + 1, core),),
                         blocks=(), kept=0, stale=0, applied=(), late_events=line.late_events + 1)


def _order(event: CaptureEvent) -> tuple[int, bool]:
    """By stamp, whatever the order of arrival; with the same stamp the arm lets go before it catches."""
    return event.stamp_ns, event.kind is EventKind.CAPTURE


def _wait(line: Timeline, event: CaptureEvent) -> Timeline:
    waiting = sorted((*line.waiting, event), key=_order)
    return line._replace(waiting=tuple(waiting[:MOST_EVENTS]))


def _run(config: IdentifierParameters, line: Timeline, block: list[Sample], *, ahead: bool = False
         ) -> Timeline:
    run = estimator.payload_ahead if ahead else estimator.advance
    gone = min(line.stale, LET_GO)
    while gone < line.stale and sum(map(len, line.blocks[:gone])) < len(block):
        gone += 1
    return line._replace(core=run(config, line.core, block), blocks=(*line.blocks[gone:], tuple(block)),
                         stale=line.stale - gone, kept=line.kept + len(block), last_ns=block[-1].stamp_ns)


def _last_ns(block: tuple[Sample, ...]) -> int:
    return block[-1].stamp_ns


def _checkpoint(config: IdentifierParameters, line: Timeline, stamp_ns: int) -> Timeline:
    """Remember the estimator as it is before the sample at ``stamp_ns``; forget what is too old."""
    kept = (*line.checkpoints, Checkpoint(line.last_ns, stamp_ns, line.core))
    oldest_needed = stamp_ns - int(config.rewind_time * 1e9)
    too_many = line.kept >= MOST_SAMPLES
    while len(kept) > 1 and (kept[1].stamp_ns <= oldest_needed or too_many):
        kept = kept[1:]
    start = kept[0].after_ns
    stale = bisect_right(line.blocks, start, key=_last_ns)
    return line._replace(checkpoints=kept, stale=stale,
                         kept=line.kept - sum(map(len, line.blocks[line.stale:stale])),
                         applied=tuple(e for e in line.applied if e.stamp_ns > start))


def _rewind(config: IdentifierParameters, line: Timeline, event: CaptureEvent) -> Timeline:
    """Go back to the last checkpoint not after the event, and run samples and events again from there."""
    kept = tuple(c for c in line.checkpoints if c.after_ns < event.stamp_ns)
    start = kept[-1].after_ns
    first = bisect_right(line.blocks, start, key=_last_ns)
    again = tuple(sample for block in line.blocks[first:] for sample in block)
    redo = sorted((*(e for e in line.applied if e.stamp_ns > start), *line.waiting, event), key=_order)
    back = line._replace(
        core=kept[-1].core, checkpoints=kept, blocks=line.blocks[:first], kept=line.kept - len(again),
        applied=tuple(e for e in line.applied if e.stamp_ns <= start),
        waiting=tuple(redo), last_ns=start, rewinds=line.rewinds + 1)
    return advance(config, back, again)
