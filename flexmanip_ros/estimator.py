"""Identifier and payload side by side: they see only samples and events, in order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flexmanip_ros.identification import rpbsid
from flexmanip_ros.identification.memory_kernel import FILLED, REJECTED
from flexmanip_ros.identification.modes import modes
from flexmanip_ros.identification.recursive_fit import Answer, Job
from flexmanip_ros.identification.uncertainty import Identified
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import block_extraction, model_check, structured
from flexmanip_ros.payload.block_extraction import NOWHERE
from flexmanip_ros.payload.model_comparison import Verdict
from flexmanip_ros.types import Array, CaptureEvent, Estimate, Payload, Sample, Status

BATCH, MOST_OWED = 4, 16
"""Samples that the identifier takes at once, for only who reads a model waits for it: from so many on when
there is nothing else to do, and at most."""


class Core(NamedTuple):
    """Everything the estimators remember; constant in size."""

    rpbsid: rpbsid.RpbsidState
    structured: structured.StructuredState | None
    angles: Array
    """The latest measured configuration: (2,) [rad], or (0,) when there is none."""
    swept: Array
    """What the configuration went through since the last event, see ``block_extraction.sweep``."""
    turned: Array = NOWHERE
    """The same for the model check, see ``model_check.sweep``."""
    since_ns: int = 0
    """Stamp of the last event; 0 before the first."""
    owed: tuple[Sample, ...] = ()
    """Samples that the identifier has still to take; the payload has them already."""


def init(config: IdentifierParameters) -> Core:
    """Start with nothing known. ``config.outputs`` are those the messages really carry."""
    wanted = config.payload_method == 'structured'
    return Core(rpbsid.init(config), structured.init(config) if wanted else None, np.empty(0),
                np.empty(0))


def advance(config: IdentifierParameters, core: Core, samples: Sequence[Sample]) -> Core:
    """Run samples through both estimators; the identifier owes the last ones where they are few.

    One call of N samples gives, once settled, the bits of N calls of one.
    """
    return settle(config, payload_ahead(config, core, samples), MOST_OWED)


def payload_ahead(config: IdentifierParameters, core: Core, samples: Sequence[Sample]) -> Core:
    """Run samples through the payload's estimator alone: the identifier owes them, see ``settle``.

    Where every sample is awaited, it still has to take those before.
    """
    core = settle(config, core, MOST_OWED)
    held = core.structured
    if held is not None:
        held = structured.advance(config, held, samples)
    turned = core.turned
    if held is not None and held.model is not None:
        turned = model_check.sweep(turned, samples, config.arm.angle_convention == 'encoder')
    swept = block_extraction.sweep(config, core.swept, samples)
    return core._replace(structured=held, angles=samples[-1].angles, swept=swept, turned=turned,
                         owed=(*core.owed, *samples))


def settle(config: IdentifierParameters, core: Core, least: int = 1) -> Core:
    """Run the samples that the identifier owes, if they are at least so many."""
    samples = core.owed
    if len(samples) < least:
        return core
    identifier = core.rpbsid
    start = 0
    for stop in [i for i, sample in enumerate(samples) if sample.gap and i > 0] + [len(samples)]:
        part = samples[start:stop]
        if part[0].gap:
            identifier = rpbsid.window_restart(config, identifier)
        identifier = rpbsid.advance(
            config, identifier, np.array([s.u for s in part]), np.array([s.y for s in part]),
            np.array([s.stamp_ns for s in part]))
        start = stop
    return core._replace(rpbsid=identifier, owed=())


def event(config: IdentifierParameters, core: Core, event: CaptureEvent) -> Core:
    """Tell both estimators that the arm caught or let go of something before the next sample."""
    core = settle(config, core)
    held = core.structured
    if held is not None:
        held = structured.event(config, held, event)
    return core._replace(rpbsid=rpbsid.restart(config, core.rpbsid), structured=held, swept=np.empty(0),
                         turned=NOWHERE, since_ns=event.stamp_ns)


def anew(config: IdentifierParameters, core: Core, events: Sequence[CaptureEvent]) -> Core:
    """Begin the payload anew, after events from before every sample; the model is of what was held anyway."""
    if core.structured is None:
        return core
    held = structured.init(config)
    for event in events:
        held = structured.event(config, held, event)
    return core._replace(structured=held, since_ns=events[-1].stamp_ns)


def finish(config: IdentifierParameters, core: Core) -> Core:
    """No sample follows: await what is under way."""
    core = settle(config, core)
    return core._replace(rpbsid=rpbsid.finish(config, core.rpbsid))


def job(config: IdentifierParameters, core: Core) -> tuple[Job, int] | None:
    """Return the long work under way, and the samples until its result is taken, or fewer."""
    found = rpbsid.job(core.rpbsid)
    return None if found is None else (found[0], found[1] - math.ceil(len(core.owed) / config.decimation))


def answered(core: Core, job: Job, answer: Answer) -> Core:
    """Return the core knowing the result of that work."""
    return core._replace(rpbsid=rpbsid.answered(core.rpbsid, job, answer))


def payload(config: IdentifierParameters, core: Core, verdicts: tuple[Verdict, ...] = ()) -> Payload | None:
    """Return the payload where it does not rest on the model; else None. verdicts: of models read before."""
    if core.structured is None:
        return None
    return model_check.apply(core.structured, structured.estimate(config, core.structured), verdicts,
                             core.since_ns)


def estimate(config: IdentifierParameters, core: Core, stamp_ns: int, dt: float, payload: Payload | None,
             verdicts: tuple[Verdict, ...] = (), *, compare: bool = False
             ) -> tuple[Estimate, tuple[Verdict, ...]]:
    """Read model and modes out of the identifier, the costly part, and a payload that rests on the model.

    compare: see what the model says of a payload that does not rest on it; returned with the verdicts before.
    """
    found, without = _identified(config, core.rpbsid, dt)
    if config.payload_method == 'block' and found is not None:
        payload = block_extraction.estimate(config, found, core.angles, core.swept)
    if found is None:
        return Estimate(stamp_ns, without, None, (), payload, model_status=without), verdicts
    oscillations = modes(found)
    verdict = None
    if compare and core.structured is not None:
        alone = structured.estimate(config, core.structured)
        verdict = model_check.check(config, core.structured, alone, core.turned, found, oscillations,
                                    stamp_ns, core.since_ns)
    estimate = Estimate(
        stamp_ns, _overall(config, found.status, payload), found.model, oscillations, payload,
        excitation=found.excitation, condition=found.condition, singular_values=found.singular_values,
        innovation_power=found.innovation_power, model_status=found.status,
        modes_deviation=float('nan') if verdict is None else verdict.deviation)
    return estimate, model_check.remember(verdicts, verdict, int(2e9 * config.rewind_time))


def follow(config: IdentifierParameters, stamp_ns: int, last: Estimate, payload: Payload | None) -> Estimate:
    """Return an estimate with the model of the last one, and the payload if that stands by itself."""
    payload = last.payload if payload is None else payload
    return last._replace(stamp_ns=stamp_ns, payload=payload, model_is_new=False,
                         status=_overall(config, last.model_status, payload))


def outliers(core: Core) -> int:
    """Return how many samples the identifier refused: values that cannot be, or far outside all before."""
    return int(core.rpbsid.counts[REJECTED])


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
