"""What the pipeline remembers, and when it is time for an estimate and for a model."""

from __future__ import annotations

from typing import NamedTuple

from flexmanip_ros import estimator, event_replay
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload.model_comparison import Verdict
from flexmanip_ros.samples import sampling
from flexmanip_ros.samples.sampling import Counters
from flexmanip_ros.types import CaptureEvent, Estimate, EventKind, Payload, Sample


class Reading(NamedTuple):
    """A model as it was read: its estimate, the event it came after, and the index of its instant."""

    estimate: Estimate
    since_ns: int
    instant: int


class Due(NamedTuple):
    """An estimate that is due: its payload where that stands by itself, and what its model is read from."""

    stamp_ns: int
    core: estimator.Core
    payload: Payload | None


class State(NamedTuple):
    """All that the identifier remembers."""

    sampling: sampling.SamplingState = sampling.SamplingState()
    timeline: event_replay.Timeline | None = None
    config: IdentifierParameters | None = None
    """The configuration with the outputs that the messages really carry."""
    early: tuple[CaptureEvent, ...] = ()
    """Events that came before the first usable message."""
    first_ns: int = 0
    published: int = -1
    """Index of the last publishing instant, counted from the first stamp."""
    reading: Reading | None = None
    """The last estimate whose model was read anew."""
    verdicts: tuple[Verdict, ...] = ()
    """What models read so far say of the payloads that follow."""
    held: tuple[Sample, ...] = ()
    """Samples still to be run, none of which an estimate waits for."""

    @property
    def counters(self) -> Counters:
        """What became of the messages."""
        return self.sampling.counters

    def stamp_of(self, kind: EventKind) -> int | None:
        """Return the stamp of the latest event of a kind [ns], None when there was none."""
        return self.timeline.stamp_of(kind) if self.timeline is not None else None


def instant_of(state: State, stamp_ns: int, rate: float) -> int:
    """Index of the instant at or before a stamp on the grid of a rate [Hz] from the first stamp on."""
    return int((stamp_ns - state.first_ns) * rate * 1e-9 + 1e-6)


def is_young(state: State, due: Due) -> bool:
    """Whether an event before this estimate may still come late, or the first sample was as little ago.

    By the stamp of the last event that counts, not of the last one heard: these may have changed places.
    """
    config = state.config
    assert config is not None
    settling = 2.0 * config.rewind_time + 1.0 / config.publish_rate
    return due.stamp_ns - max(state.first_ns, due.core.since_ns) <= settling * 1e9


def is_due(state: State, stamp_ns: int) -> bool:
    """Whether a sample of this stamp [ns] is the first at or after an instant of ``publish_rate``."""
    assert state.config is not None
    return instant_of(state, stamp_ns, state.config.publish_rate) > state.published


def is_read_anew(state: State, due: Due) -> bool:
    """Whether ``read`` reads a model, the long part of it, or repeats the last one.

    It does by ``model_rate``, and with every estimate for as long after an event as it may arrive late: so
    any order of arrival reads models at the same stamps.
    """
    last = state.reading
    assert state.config is not None
    return (last is None or last.since_ns != due.core.since_ns or is_young(state, due)
            or instant_of(state, due.stamp_ns, state.config.model_rate) > last.instant)


def awaits(state: State, stamp_ns: int) -> bool:
    """Whether an estimate is due once a sample of this stamp [ns] has come."""
    return state.config is not None and state.timeline is not None and is_due(state, stamp_ns)


def is_next_due(state: State) -> bool:
    """Whether an estimate is to be expected with the next sample, and all before it has been run."""
    line = state.timeline
    return (line is not None and not state.held and line.last_ns != event_replay.BEFORE_ALL
            and awaits(state, line.last_ns + int(state.sampling.dt * 1e9)))
