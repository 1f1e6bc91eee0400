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
    clock, log = sampling.Clock(), sampling.EMPTY
    state: capture_detection.DetectionState | None = None
    trigger = TriggerParameters()
    cursor = 0
    for item in items:
        yield item
        if isinstance(item, CaptureEvent):
            continue
        clock, log, reset = sampling.push(config, clock, log, item)
        if clock.outputs is None:
            continue
        if state is None or reset:
            trigger = TriggerParameters(
                mode='auto', inputs=config.inputs, outputs=clock.outputs, angles=config.angles,
                arm=config.arm, payload=config.payload)
            state, cursor = capture_detection.init(trigger), 0
        state, events = capture_detection.advance(trigger, state, log.rows(cursor, log.end))
        cursor = log.end
        log = log.from_row(capture_detection.first_needed(state))
        yield from events
