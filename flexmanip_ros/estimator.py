"""Identifier and payload side by side: they see only samples and events, in order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from flexmanip_ros.identification import rpbsid
from flexmanip_ros.identification.memory_kernel import FILLED, USED
from flexmanip_ros.identification.modal import modes
from flexmanip_ros.identification.uncertainty import Identified
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import block_extraction, structured
from flexmanip_ros.types import Array, CaptureEvent, Estimate, Payload, Sample, Status


class Core(NamedTuple):
    """Everything the estimators remember; constant in size."""

    rpbsid: rpbsid.RpbsidState
    structured: structured.StructuredState | None
    angles: Array
    """The latest measured configuration: (2,) [rad], or (0,) when there is none."""


def init(config: IdentifierParameters) -> Core:
    """Start with nothing known. ``config.outputs`` are those the messages really carry."""
    wanted = config.payload_method == 'structured'
    return Core(rpbsid.init(config), structured.init(config) if wanted else None, np.empty(0))


def advance(config: IdentifierParameters, core: Core, samples: Sequence[Sample]) -> Core:
    """Run samples through both estimators; one call of N samples gives the bits of N calls of one."""
    identifier = core.rpbsid
    start = 0
    for stop in [i for i, sample in enumerate(samples) if sample.gap and i > 0] + [len(samples)]:
        part = samples[start:stop]
        if part[0].gap:
            identifier = rpbsid.window_restart(config, identifier)
        identifier = rpbsid.advance(
            config, identifier, np.array([s.u for s in part]), np.array([s.y for s in part]))
        start = stop
    held = core.structured
    if held is not None:
        held = structured.advance(config, held, samples)
    return Core(identifier, held, samples[-1].angles)


def event(config: IdentifierParameters, core: Core, event: CaptureEvent) -> Core:
    """Tell both estimators that the arm caught or let go of something before the next sample."""
    held = core.structured
    if held is not None:
        held = structured.event(config, held, event)
    return core._replace(rpbsid=rpbsid.restart(config, core.rpbsid), structured=held)


def anew(config: IdentifierParameters, core: Core, events: Sequence[CaptureEvent]) -> Core:
    """Begin the payload anew, after events from before every sample; the model is of what was held anyway."""
    if core.structured is None:
        return core
    held = structured.init(config)
    for event in events:
        held = structured.event(config, held, event)
    return core._replace(structured=held)


def estimate(config: IdentifierParameters, core: Core, stamp_ns: int, dt: float) -> Estimate:
    """Read model, modes and payload out of the estimators; the model is the costly part."""
    found, without = _identified(config, core.rpbsid, dt)
    payload = None
    if config.payload_method == 'structured' and core.structured is not None:
        payload = structured.estimate(config, core.structured)
    elif config.payload_method == 'block' and found is not None:
        payload = block_extraction.estimate(config, found, core.angles)
    if found is None:
        return Estimate(stamp_ns, without, None, (), payload, model_status=without)
    return Estimate(
        stamp_ns, _overall(config, found.status, payload), found.model, modes(found), payload,
        excitation=found.excitation, condition=found.condition, singular_values=found.singular_values,
        innovation_power=found.innovation_power, model_status=found.status)


def follow(config: IdentifierParameters, core: Core, stamp_ns: int, last: Estimate) -> Estimate:
    """Return an estimate with the model of the last one; only a structured payload is read anew."""
    payload = last.payload if core.structured is None else structured.estimate(config, core.structured)
    return replace(last, stamp_ns=stamp_ns, payload=payload, model_is_new=False,
                   status=_overall(config, last.model_status, payload))


def samples_used(core: Core) -> int:
    """Return how many samples the model rests on."""
    return int(core.rpbsid.counts[USED])


def _overall(config: IdentifierParameters, model: Status, payload: Payload | None) -> Status:
    """What to say of both: of the payload where it does not rest on the model, else of the weaker."""
    if payload is not None and (model is Status.TRACKING or config.payload_method == 'structured'):
        return payload.status
    return model


def _identified(config: IdentifierParameters, state: rpbsid.RpbsidState, dt: float
                ) -> tuple[Identified | None, Status]:
    """Return the model, and what to say while there is none: too few samples, or signals that stand still."""
    try:
        found = rpbsid.identified(config, state, dt)
    except np.linalg.LinAlgError:  # signals that barely move, or in one direction only
        return None, Status.POORLY_EXCITED
    parameters = config.past_window * (len(config.inputs) + len(config.outputs)) + len(config.inputs)
    enough = state.counts[FILLED] > 2 * parameters + config.past_window
    return found, Status.POORLY_EXCITED if enough else Status.WARMING_UP
