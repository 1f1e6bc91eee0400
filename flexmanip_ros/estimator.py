"""Identifier and payload side by side, as cursors into one sample log, and what is read out of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flexmanip_ros.identification import rpbsid
from flexmanip_ros.identification.memory_kernel import FILLED, REJECTED
from flexmanip_ros.identification.modes import modes
from flexmanip_ros.identification.uncertainty import Identified
from flexmanip_ros.numerics.background import Background
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import block_extraction, model_check, structured
from flexmanip_ros.payload.block_extraction import NOWHERE
from flexmanip_ros.payload.model_comparison import Verdict
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.types import Array, CaptureEvent, Estimate, Payload, Status


class EstimatorState(NamedTuple):
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


def init(config: IdentifierParameters) -> EstimatorState:
    """Start with nothing known. ``config.outputs`` are those the messages really carry."""
    wanted = config.payload_method == 'structured'
    return EstimatorState(
        rpbsid.init(config), structured.init(config) if wanted else None, np.empty(0), np.empty(0))


def first_needed(state: EstimatorState) -> int:
    """Return the first row of the sample log that will be read again."""
    first = rpbsid.first_needed(state.rpbsid)
    return first if state.structured is None else min(first, structured.first_needed(state.structured))


def advance(config: IdentifierParameters, state: EstimatorState, rows: Rows, background: Background
            ) -> EstimatorState:
    """Take the next rows of the log. One call with N rows gives the bits of N calls with one."""
    held, turned = state.structured, state.turned
    if held is not None:
        held = structured.advance(config, held, rows)
        if held.model is not None:
            turned = model_check.sweep(turned, rows, config.arm.angle_convention == 'encoder')
    return EstimatorState(
        rpbsid.advance(config, state.rpbsid, rows, background), held, rows.angles[-1].copy(),
        block_extraction.sweep(config, state.swept, rows), turned, state.since_ns)


def event(config: IdentifierParameters, state: EstimatorState, event: CaptureEvent, background: Background
          ) -> EstimatorState:
    """Tell both estimators that the arm caught or let go of something before the next row."""
    held = state.structured
    if held is not None:
        held = structured.event(config, held, event)
    return state._replace(rpbsid=rpbsid.restart(config, state.rpbsid, background), structured=held,
                          swept=np.empty(0), turned=NOWHERE, since_ns=event.stamp_ns)


def restart_payload(config: IdentifierParameters, state: EstimatorState, events: Sequence[CaptureEvent]
                    ) -> EstimatorState:
    """Begin the payload again, after events from before every sample; the model is of what was held anyway."""
    if state.structured is None:
        return state
    held = structured.init(config)._replace(cursor=state.structured.cursor)
    for event in events:
        held = structured.event(config, held, event)
    return state._replace(structured=held, since_ns=events[-1].stamp_ns)


def payload(config: IdentifierParameters, state: EstimatorState, verdicts: tuple[Verdict, ...] = ()
            ) -> Payload | None:
    """Return the payload where it does not rest on the model; else None. verdicts: of models read before."""
    if state.structured is None:
        return None
    return model_check.apply(state.structured, structured.estimate(config, state.structured), verdicts,
                             state.since_ns)


@dataclass(frozen=True, eq=False)
class ModelRequest:
    """A model to be read out of the identifier; ``background.Request``.

    compare: see what the model says of a payload that does not rest on it.
    """

    config: IdentifierParameters
    state: EstimatorState
    stamp_ns: int
    dt: float
    payload: Payload | None
    compare: bool

    def solve(self) -> tuple[Estimate, Verdict | None]:
        """Return the estimate with model and modes, and the verdict on the payload."""
        config, state, payload = self.config, self.state, self.payload
        found, without = _identified(config, state.rpbsid, self.dt)
        if config.payload_method == 'block' and found is not None:
            payload = block_extraction.estimate(config, found, state.angles, state.swept)
        if found is None:
            return Estimate(self.stamp_ns, without, None, (), payload, model_status=without), None
        oscillations = modes(found)
        verdict = None
        if self.compare and state.structured is not None:
            alone = structured.estimate(config, state.structured)
            verdict = model_check.check(config, state.structured, alone, state.turned, found, oscillations,
                                        self.stamp_ns, state.since_ns)
        return Estimate(
            self.stamp_ns, _overall(config, found.status, payload), found.model, oscillations, payload,
            excitation=found.excitation, condition=found.condition, singular_values=found.singular_values,
            innovation_power=found.innovation_power, model_status=found.status,
            modes_deviation=math.nan if verdict is None else verdict.deviation), verdict


def with_model_of(config: IdentifierParameters, stamp_ns: int, last: Estimate, payload: Payload | None
                  ) -> Estimate:
    """Return an estimate with the model of the last one, and the payload if that stands by itself."""
    payload = last.payload if payload is None else payload
    return last._replace(stamp_ns=stamp_ns, payload=payload, model_is_new=False,
                         status=_overall(config, last.model_status, payload))


def without_model(config: IdentifierParameters, stamp_ns: int, payload: Payload) -> Estimate:
    """Return an estimate before there is a model."""
    status = Status.WARMING_UP
    return Estimate(stamp_ns, _overall(config, status, payload), None, (), payload, model_status=status,
                    model_is_new=False)


def outliers(state: EstimatorState) -> int:
    """Return how many samples the identifier rejected: values that cannot be, or far outside all before."""
    return int(state.rpbsid.counts[REJECTED])


def _overall(config: IdentifierParameters, model: Status, payload: Payload | None) -> Status:
    """Return the status of both: of the payload where it does not rest on the model, else of the weaker."""
    if payload is not None and (model is Status.TRACKING or config.payload_method == 'structured'):
        return payload.status
    return model


def _identified(config: IdentifierParameters, state: rpbsid.RpbsidState, dt: float
                ) -> tuple[Identified | None, Status]:
    """Return the model, and the status while there is none: too few samples, or signals that stand still."""
    try:
        found = rpbsid.identified(config, state, dt)
    except np.linalg.LinAlgError:  # signals that barely move, or in one direction only
        return None, Status.POORLY_EXCITED
    parameters = config.past_window * (len(config.inputs) + len(config.outputs)) + len(config.inputs)
    enough = state.counts[FILLED] > 2 * parameters + config.past_window
    return found, Status.POORLY_EXCITED if enough else Status.WARMING_UP
