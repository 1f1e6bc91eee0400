"""The two estimators, payload and model, each a cursor into the sample log, and what is read out of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flexmanip_ros import event_replay
from flexmanip_ros.event_replay import EventReplay
from flexmanip_ros.identification import prediction_check, rpbsid
from flexmanip_ros.identification.factor import FILLED, REJECTED
from flexmanip_ros.identification.uncertainty import Identified, modes
from flexmanip_ros.numerics.background import INLINE, Background
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import block_extraction, frequency, structured
from flexmanip_ros.payload.arm_parameters import taught
from flexmanip_ros.samples.sample_log import Rows, SampleLog
from flexmanip_ros.types import ArmParameter, Array, CaptureEvent, Estimate, Payload, Status

NO_ANGLES: Array = np.empty(0)


class PayloadEstimator(NamedTuple):
    """The payload where it does not rest on the model: ``event_replay.Estimator``; constant in size."""

    structured: structured.StructuredState | None
    """None where the payload is read out of the model, or not at all."""
    since_ns: int = 0
    """Stamp of the last event; 0 before the first."""

    def first_needed(self, cursor: int) -> int:
        """Return the first row of the sample log that will be read again."""
        return cursor if self.structured is None else structured.first_needed(self.structured)

    def advance(self, config: IdentifierParameters, rows: Rows, background: Background) -> PayloadEstimator:
        """Take the next rows of the log. One call with N rows gives the bits of N calls with one."""
        if self.structured is None:
            return self
        return self._replace(structured=structured.advance(config, self.structured, rows))

    def event(self, config: IdentifierParameters, event: CaptureEvent, background: Background) -> PayloadEstimator:
        """The arm caught or let go of something before the next row."""
        held = self.structured if self.structured is None else structured.event(config, self.structured, event)
        return PayloadEstimator(held, event.stamp_ns)

    def restart(self, config: IdentifierParameters, events: Sequence[CaptureEvent]) -> PayloadEstimator:
        """Begin again, after events from before every sample."""
        if self.structured is None:
            return self
        held = structured.init(config)._replace(cursor=self.structured.cursor)
        for event in events:
            held = structured.event(config, held, event)
        return self._replace(structured=held, since_ns=events[-1].stamp_ns)


class ModelEstimator(NamedTuple):
    """The identifier: ``event_replay.Estimator``; constant in size."""

    rpbsid: rpbsid.RpbsidState
    angles: Array = NO_ANGLES
    """The latest measured configuration: (2,) [rad], or (0,) when there is none."""
    configuration_range: Array = NO_ANGLES
    """What the configuration went through since the last event, see ``block_extraction.extend_range``."""
    since_ns: int = 0
    """Stamp of the last event; 0 before the first."""

    def first_needed(self, cursor: int) -> int:
        """Return the first row of the sample log that will be read again."""
        return rpbsid.first_needed(self.rpbsid)

    def advance(self, config: IdentifierParameters, rows: Rows, background: Background) -> ModelEstimator:
        """Take the next rows of the log. One call with N rows gives the bits of N calls with one."""
        return ModelEstimator(rpbsid.advance(config, self.rpbsid, rows, background), rows.angles[-1].copy(),
                              block_extraction.extend_range(config, self.configuration_range, rows), self.since_ns)

    def event(self, config: IdentifierParameters, event: CaptureEvent, background: Background) -> ModelEstimator:
        """The arm caught or let go of something before the next row."""
        return self._replace(rpbsid=rpbsid.restart(config, self.rpbsid, background), configuration_range=NO_ANGLES,
                             since_ns=event.stamp_ns)

    def restart(self, config: IdentifierParameters, events: Sequence[CaptureEvent]) -> ModelEstimator:
        """Go on: every sample came after these events, so the model is of what the arm holds now."""
        return self._replace(since_ns=events[-1].stamp_ns)

    @property
    def outliers(self) -> int:
        """How many samples were rejected: values that cannot be, or far outside all before."""
        return int(self.rpbsid.counts[REJECTED])


def init(config: IdentifierParameters) -> tuple[PayloadEstimator, ModelEstimator]:
    """Start with nothing known. ``config.outputs`` are those the messages really carry."""
    wanted = config.payload_method == 'structured'
    return PayloadEstimator(structured.init(config) if wanted else None), ModelEstimator(rpbsid.init(config))


def payload(config: IdentifierParameters, state: PayloadEstimator) -> Payload | None:
    """Return the payload where it does not rest on the model; else None."""
    return None if state.structured is None else structured.estimate(config, state.structured)


def arm_parameters(config: IdentifierParameters, state: PayloadEstimator) -> tuple[ArmParameter, ...]:
    """Return what the arm taught; empty where the payload rests on the model."""
    return taught(config, state.structured)


class PayloadReading(NamedTuple):
    """What the payload's estimator says at a row."""

    payload: Payload | None
    """None where it rests on the model."""
    arm_parameters: tuple[ArmParameter, ...]


@dataclass(frozen=True, eq=False)
class PayloadRequest:
    """Rows that the payload's estimator is to take; ``background.Request``."""

    config: IdentifierParameters
    replay: EventReplay[PayloadEstimator]
    log: SampleLog
    until: int
    """The row to stop before."""
    rows: Sequence[int] = ()
    """Rows at which an estimate is due."""
    seconds: Sequence[int] = ()
    """The second, counted from the first stamp on, of each."""
    told: int = -1
    """The last second in which the arm's parameters were told."""

    def solve(self) -> tuple[EventReplay[PayloadEstimator], list[PayloadReading], int]:
        """Return the estimator before ``until``, what it says at each row, and the last second told."""
        now, told, readings = self.replay, self.told, []
        for row, second in zip(self.rows, self.seconds, strict=True):
            now = event_replay.advance(self.config, now, self.log, row + 1, INLINE)
            arm = arm_parameters(self.config, now.estimator) if second > told else ()
            told = second if arm else told
            readings.append(PayloadReading(payload(self.config, now.estimator), arm))
        return event_replay.advance(self.config, now, self.log, self.until, INLINE), readings, told


@dataclass(frozen=True, eq=False)
class ModelRequest:
    """A model to be read out of the identifier; ``background.Request``."""

    config: IdentifierParameters
    identifier: ModelEstimator
    stamp_ns: int
    dt: float
    rows: Rows
    """The latest samples, on which the model is judged."""

    def solve(self) -> Estimate:
        """Return the estimate with model and modes, and with the payload where it rests on them."""
        config, identifier = self.config, self.identifier
        payload: Payload | None = None
        found, without = _identified(config, identifier.rpbsid, self.dt, self.rows)
        if found is not None and config.decimation == 1:
            found = prediction_check.judged(found, self.rows, config.outputs)
        if config.payload_method == 'block' and found is not None:
            payload = block_extraction.estimate(config, found, identifier.angles, identifier.configuration_range)
        if found is None:
            return Estimate(self.stamp_ns, without, None, (), payload, model_status=without)
        oscillations = modes(found)
        if config.payload_method == 'frequency':
            payload = frequency.estimate(config, oscillations, identifier.angles, identifier.configuration_range)
        return Estimate(
            self.stamp_ns, _overall(config, found.status, payload), found.model, oscillations, payload,
            excitation=found.excitation, condition=found.condition, singular_values=found.singular_values,
            innovation_power=found.innovation_power, model_status=found.status)


def with_payload(config: IdentifierParameters, estimate: Estimate, payload: Payload | None) -> Estimate:
    """Return the estimate of a model with the payload of the same sample, where that does not rest on the model."""
    if payload is None:
        return estimate
    status = estimate.status if estimate.model is None else _overall(config, estimate.model_status, payload)
    return estimate._replace(payload=payload, status=status)


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


def _overall(config: IdentifierParameters, model: Status, payload: Payload | None) -> Status:
    """Return the status of both: of the payload where it does not rest on the model, else of the weaker."""
    if payload is not None and (model is Status.TRACKING or config.payload_method == 'structured'):
        return payload.status
    return model


def _identified(config: IdentifierParameters, state: rpbsid.RpbsidState, dt: float, rows: Rows
                ) -> tuple[Identified | None, Status]:
    """Return the model, and the status while there is none: too few samples, or signals that stand still."""
    try:
        found = rpbsid.identified(config, state, dt, rows)
    except np.linalg.LinAlgError:  # signals that barely move, or in one direction only
        return None, Status.POORLY_EXCITED
    parameters = config.past_window * (len(config.inputs) + len(config.outputs)) + len(config.inputs)
    enough = state.counts[FILLED] > 2 * parameters + config.past_window
    return found, Status.POORLY_EXCITED if enough else Status.WARMING_UP
