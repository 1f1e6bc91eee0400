"""Messages with the captures and releases that their signals reveal, for recordings without a trigger."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters import IdentifierParameters, TriggerParameters
from flexmanip_ros.payload import capture_detection
from flexmanip_ros.samples import sampling
from flexmanip_ros.types import CaptureEvent, JointRecord

Item = JointRecord | CaptureEvent


def with_detected(config: IdentifierParameters, items: Iterable[Item]) -> Iterator[Item]:
    """Yield every message, and after the one that revealed it each event that was found.

    The event carries the stamp of its onset; the pipeline goes back for it, as it does live.
    """
    if not config.angles:
        raise ParameterError('captures cannot be found in the signals without angles',
                             'name the joints in parameter angles, or give --capture-time')
    # The angles are needed here whether or not a payload is estimated.
    config = replace(config, payload_method='structured')
    clock = sampling.init()
    state: capture_detection.DetectionState | None = None
    trigger = TriggerParameters()
    for item in items:
        yield item
        if isinstance(item, CaptureEvent):
            continue
        clock, sampled = sampling.step(config, clock, item)
        if clock.outputs is None:
            continue
        if state is None or sampled.reset:
            trigger = TriggerParameters(
                mode='auto', inputs=config.inputs, outputs=clock.outputs, angles=config.angles,
                arm=config.arm, payload=config.payload)
            state = capture_detection.init(trigger)
        state, events = capture_detection.advance(trigger, state, sampled.samples)
        yield from events
