"""The methods that the paper compares with, on the messages and at the publishing instants of the identifier."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import algebraic, rigid_rls
from flexmanip_ros.payload.rival import RivalState
from flexmanip_ros.samples import sampling
from flexmanip_ros.types import CaptureEvent, Estimate, JointRecord, Payload, Sample


class Baseline(NamedTuple):
    """The functions of one estimator."""

    init: Callable[[IdentifierParameters], RivalState]
    advance: Callable[[IdentifierParameters, RivalState, Sequence[Sample]], RivalState]
    event: Callable[[IdentifierParameters, RivalState, CaptureEvent], RivalState]
    estimate: Callable[[IdentifierParameters, RivalState], Payload]


BASELINES: Mapping[str, Baseline] = {
    'rigid_rls': Baseline(rigid_rls.init, rigid_rls.advance, rigid_rls.event, rigid_rls.estimate),
    'algebraic': Baseline(algebraic.init, algebraic.advance, algebraic.event, algebraic.estimate),
}


def samples(config: IdentifierParameters, items: Iterable[JointRecord | CaptureEvent]) -> list[Sample | CaptureEvent]:
    """Return messages as samples, each event before the first sample at or after its stamp."""
    clock, log = sampling.Clock(), sampling.EMPTY
    events: list[CaptureEvent] = []
    for item in items:
        if isinstance(item, CaptureEvent):
            events.append(item)
        else:
            clock, log, _ = sampling.push(config, clock, log, item)
    events.sort(key=lambda event: event.stamp_ns)
    found: list[Sample | CaptureEvent] = []
    rows = log.rows(log.start, log.end)
    for k, stamp_ns in enumerate(rows.stamp_ns.tolist()):
        while events and events[0].stamp_ns <= stamp_ns:
            found.append(events.pop(0))
        found.append(Sample(stamp_ns, rows.u[k], rows.y[k], rows.angles[k], bool(rows.gap[k])))
    return found


def run(name: str, config: IdentifierParameters, sampled: Iterable[Sample | CaptureEvent]) -> Iterator[Estimate]:
    """Yield estimates with a payload and no model: at each publishing instant and at the last sample."""
    baseline = BASELINES[name]
    state = baseline.init(config)
    block: list[Sample] = []
    first_ns, published, due = 0, -1, False
    last: Sample | None = None
    for item in sampled:
        if isinstance(item, CaptureEvent):
            state, block = baseline.advance(config, state, block), []
            state = baseline.event(config, state, item)
            continue
        first_ns = item.stamp_ns if last is None else first_ns
        last = item
        block.append(item)
        instant = int((item.stamp_ns - first_ns) * config.publish_rate * 1e-9 + 1e-6)
        due = instant > published
        if due:
            published = instant
            state, block = baseline.advance(config, state, block), []
            yield _estimate(baseline, config, state, item)
    if last is not None and not due:
        yield _estimate(baseline, config, baseline.advance(config, state, block), last)


def _estimate(baseline: Baseline, config: IdentifierParameters, state: RivalState, sample: Sample) -> Estimate:
    payload = baseline.estimate(config, state)
    return Estimate(sample.stamp_ns, payload.status, None, (), payload)
