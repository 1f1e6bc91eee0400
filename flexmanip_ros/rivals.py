"""The paper's rivals over the same messages and the same publishing grid as the identifier."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import NamedTuple

from flexmanip_ros import sampling
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import algebraic, rigid_rls
from flexmanip_ros.payload.rival import RivalState
from flexmanip_ros.types import CaptureEvent, Estimate, JointRecord, Payload, Sample


class Rival(NamedTuple):
    """The calls of one estimator."""

    init: Callable[[IdentifierParameters], RivalState]
    step: Callable[[IdentifierParameters, RivalState, Sample], RivalState]
    event: Callable[[IdentifierParameters, RivalState, CaptureEvent], RivalState]
    estimate: Callable[[IdentifierParameters, RivalState], Payload]


RIVALS: Mapping[str, Rival] = {
    'rigid_rls': Rival(rigid_rls.init, rigid_rls.step, rigid_rls.event, rigid_rls.estimate),
    'algebraic': Rival(algebraic.init, algebraic.step, algebraic.event, algebraic.estimate),
}


def run(name: str, config: IdentifierParameters, items: Iterable[JointRecord | CaptureEvent]
        ) -> Iterator[Estimate]:
    """Yield estimates with a payload and no model; events act before the first sample at their stamp."""
    rival = RIVALS[name]
    clock, state = sampling.init(), rival.init(config)
    waiting: list[CaptureEvent] = []
    first_ns: int | None = None
    published = -1
    for item in items:
        if isinstance(item, CaptureEvent):
            waiting.append(item)
            continue
        clock, sampled = sampling.step(config, clock, item)
        for sample in sampled.samples:
            first_ns = sample.stamp_ns if first_ns is None else first_ns
            for event in [event for event in waiting if event.stamp_ns <= sample.stamp_ns]:
                state = rival.event(config, state, event)
                waiting.remove(event)
            state = rival.step(config, state, sample)
            instant = int((sample.stamp_ns - first_ns) * config.publish_rate * 1e-9 + 1e-6)
            if instant > published:
                published = instant
                payload = rival.estimate(config, state)
                yield Estimate(sample.stamp_ns, payload.status, None, (), payload)
