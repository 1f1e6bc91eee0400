"""The estimators of payload and model, each with its own cursor into the sample log, and their estimates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flexmanip_ros import event_replay
from flexmanip_ros.event_replay import EventReplay
from flexmanip_ros.identification import held_back, parameter_varying, prediction_check, rpbsid
from flexmanip_ros.identification.factor import FILLED, REJECTED, SEEN, USED
from flexmanip_ros.identification.uncertainty import Identified, modes
from flexmanip_ros.numerics.background import INLINE, Background
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import block_extraction, frequency, structured
from flexmanip_ros.payload.arm_parameters import input_friction, taught
from flexmanip_ros.payload.structured_model import longest_sample_time, signals
from flexmanip_ros.samples.sample_log import Rows, SampleLog
from flexmanip_ros.samples.signals import relative_angle, without_friction
from flexmanip_ros.types import ArmParameter, Array, CaptureEvent, Estimate, Payload, Status

NO_ANGLES: Array = np.empty(0)


class PayloadEstimator(NamedTuple):
    """Estimator of a payload that is not read from the model: ``event_replay.Estimator``; constant in size."""

    structured: structured.StructuredState | None
    """None where the payload is read from the model, or not estimated."""
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
        """Take an event: the arm caught or released an object before the next row."""
        held = self.structured if self.structured is None else structured.event(config, self.structured, event)
        return PayloadEstimator(held, event.stamp_ns)

    def restart(self, config: IdentifierParameters, events: Sequence[CaptureEvent]) -> PayloadEstimator:
        """Begin again from the cursor, with events from before the first sample."""
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
    """Range of the configuration since the last event, see ``block_extraction.extend_range``."""
    since_ns: int = 0
    """Stamp of the last event; 0 before the first."""
    turned: Array = NO_ANGLES
    """Smallest and largest angle between the links since the last event, their sum [rad], and number; (0,) where the
    model has no angles."""

    def first_needed(self, cursor: int) -> int:
        """Return the first row of the sample log that will be read again."""
        return rpbsid.first_needed(self.rpbsid)

    def advance(self, config: IdentifierParameters, rows: Rows, background: Background) -> ModelEstimator:
        """Take the next rows of the log. One call with N rows gives the bits of N calls with one."""
        return ModelEstimator(
            rpbsid.advance(config, self.rpbsid, without_friction(config, rows), background), rows.angles[-1].copy(),
            block_extraction.extend_range(config, self.configuration_range, rows), self.since_ns,
            extended(config, self.turned, rows))

    def event(self, config: IdentifierParameters, event: CaptureEvent, background: Background) -> ModelEstimator:
        """Take an event: the arm caught or released an object before the next row."""
        return self._replace(rpbsid=rpbsid.restart(config, self.rpbsid, background), configuration_range=NO_ANGLES,
                             since_ns=event.stamp_ns, turned=NO_ANGLES)

    def restart(self, config: IdentifierParameters, events: Sequence[CaptureEvent]) -> ModelEstimator:
        """Keep the model: every sample came after these events, so it is that of the arm with its present payload."""
        return self._replace(since_ns=events[-1].stamp_ns)

    @property
    def outliers(self) -> int:
        """Number of rejected samples: a value was not finite, or far beyond all earlier ones."""
        return int(self.rpbsid.counts[REJECTED])


def measured_angles(config: IdentifierParameters, rows: Rows) -> Array:
    """Return the angle between the links [rad] in the rows in which it was measured."""
    angles = relative_angle(config, rows.angles)
    return angles[np.isfinite(angles)]


def extended(config: IdentifierParameters, turned: Array, rows: Rows) -> Array:
    """Return smallest, largest, sum and number of angles between the links (4,) after more rows; see ``turned``."""
    if parameter_varying.roles(config) is None or rows.angles.shape[1] != 2:
        return turned
    known = measured_angles(config, rows)
    if not known.size:
        return turned
    low, high, total, count = turned if turned.size else (np.inf, -np.inf, 0.0, 0.0)
    # added one by one, so that the sum does not depend on how many rows come at once
    total = np.cumsum(np.append(total, known))[-1]
    return np.array([min(low, known.min()), max(high, known.max()), total, count + known.size])


def turning(config: IdentifierParameters, turned: Array, lately: Rows) -> tuple[float, float]:
    """Return the range of the angle between the links since the last event, and how far its mean drifted [rad].

    The drift is the mean of the latest rows less that of all rows since the event, see ``turned``.
    """
    if not turned.size:
        return 0.0, 0.0
    low, high, total, count = turned.tolist()
    known = measured_angles(config, lately)
    return high - low, float(np.mean(known)) - total / count if known.size else 0.0


def init(config: IdentifierParameters) -> tuple[PayloadEstimator, ModelEstimator]:
    """Start with empty estimators. ``config.outputs`` are those that the messages contain."""
    wanted = config.payload_method == 'structured'
    return PayloadEstimator(structured.init(config) if wanted else None), ModelEstimator(rpbsid.init(config))


def payload(config: IdentifierParameters, state: PayloadEstimator) -> Payload | None:
    """Return the payload where it is not read from the model; else None."""
    return None if state.structured is None else structured.estimate(config, state.structured)


def arm_parameters(config: IdentifierParameters, state: PayloadEstimator) -> tuple[ArmParameter, ...]:
    """Return the arm parameters learnt by the payload's estimator; empty where the payload is read from the model."""
    return taught(config, state.structured)


def friction(config: IdentifierParameters, state: PayloadEstimator) -> tuple[float, ...] | None:
    """Return the learned Coulomb friction of each joint in units of its input (L,) [N m]; None while not TRACKING."""
    return input_friction(config, state.structured)


PayloadReading = tuple[Payload | None, tuple[ArmParameter, ...]]
"""The payload at a row, None where it is read from the model, and the arm parameters."""


@dataclass(frozen=True, eq=False)
class PayloadRequest:
    """Request to advance the payload's estimator over rows; ``background.Request``."""

    config: IdentifierParameters
    replay: EventReplay[PayloadEstimator]
    log: SampleLog
    until: int
    """The row to stop before."""
    rows: Sequence[int] = ()
    """Rows at which an estimate is due."""
    seconds: Sequence[int] = ()
    """For each of ``rows`` the second, counted from the first stamp."""
    told: int = -1
    """The last second for which the arm's parameters were returned."""

    def solve(self) -> tuple[EventReplay[PayloadEstimator], list[PayloadReading], int]:
        """Return the estimator before ``until``, its reading at each of ``rows``, and the last second told."""
        now, told, readings = self.replay, self.told, list[PayloadReading]()
        for row, second in zip(self.rows, self.seconds, strict=True):
            now = event_replay.advance(self.config, now, self.log, row + 1, INLINE)
            arm = arm_parameters(self.config, now.estimator) if second > told else ()
            told = second if arm else told
            readings.append((payload(self.config, now.estimator), arm))
        return event_replay.advance(self.config, now, self.log, self.until, INLINE), readings, told


@dataclass(frozen=True, eq=False)
class ModelRequest:
    """Request to read a model from the identifier; ``background.Request``."""

    config: IdentifierParameters
    identifier: ModelEstimator
    stamp_ns: int
    dt: float
    rows: Rows
    """The latest samples, on which the model is judged; with decimation the identifier has filtered ones instead."""

    def solve(self) -> Estimate:
        """Return the estimate with model and modes, and with the payload where it is read from them."""
        config, identifier, rows = self.config, self.identifier, without_friction(self.config, self.rows)
        payload: Payload | None = None
        elapsed = round((self.stamp_ns - identifier.since_ns) * 1e-9 / self.dt) if self.dt > 0.0 else 0
        found, without, reason = _identified(config, identifier.rpbsid, self.dt, rows, elapsed)
        if found is not None:
            role = parameter_varying.roles(config)
            turned, drift = turning(config, identifier.turned, rows)
            filtered = rpbsid.latest(config, identifier.rpbsid, identifier.since_ns, self.dt)
            since = float(identifier.rpbsid.counts[USED])
            found = prediction_check.judged(
                found, rows if filtered is None else filtered, config.outputs,
                0 if role is None else len(role.displacements), turned, since,
                drift=drift, filtered=filtered is not None)
            found = held_back.judged(
                found, identifier.rpbsid.held, config.outputs, prediction_check.is_early(found, since))
            is_arm = config.payload_method == 'structured' and signals(config) is not None
            if is_arm and self.dt > longest_sample_time(config.arm):
                found = found._replace(status=Status.UNOBSERVABLE,
                                       reason='the links vibrate faster than half the sample rate: modes are aliases')
        if config.payload_method == 'block' and found is not None:
            payload = block_extraction.estimate(config, found, identifier.angles, identifier.configuration_range)
        if found is None:
            return Estimate(self.stamp_ns, without, None, (), payload, model_status=without, reason=reason)
        oscillations = modes(found)
        if config.payload_method == 'frequency':
            payload = frequency.estimate(config, oscillations, identifier.angles, identifier.configuration_range)
        return Estimate(
            self.stamp_ns, _overall(config, found.status, payload), found.model, oscillations, payload,
            excitation=found.excitation, condition=found.condition, singular_values=found.singular_values,
            innovation_power=found.innovation_power, model_status=found.status, constant=found.constant,
            reason=found.reason)


def with_payload(config: IdentifierParameters, estimate: Estimate, payload: Payload | None) -> Estimate:
    """Return the estimate of a model with the payload of the same sample; None: the payload is read from the model."""
    if payload is None:
        return estimate
    return estimate._replace(payload=payload, status=_overall(config, estimate.model_status, payload),
                             payload_is_new=False)


def with_model_of(config: IdentifierParameters, stamp_ns: int, last: Estimate, payload: Payload | None
                  ) -> Estimate:
    """Return an estimate with the model of the last one, and with ``payload``, or where it is None the last one."""
    payload = last.payload if payload is None else payload
    return last._replace(stamp_ns=stamp_ns, payload=payload, model_is_new=False,
                         status=_overall(config, last.model_status, payload))


def without_model(config: IdentifierParameters, stamp_ns: int, payload: Payload) -> Estimate:
    """Return an estimate before there is a model."""
    status = Status.WARMING_UP
    return Estimate(stamp_ns, _overall(config, status, payload), None, (), payload, model_status=status,
                    model_is_new=False)


def _overall(config: IdentifierParameters, model: Status, payload: Payload | None) -> Status:
    """Return the joint status: the payload's where it is not read from the model, else the weaker of the two."""
    if payload is not None and (model is Status.TRACKING or config.payload_method == 'structured'):
        return payload.status
    return model


def _identified(config: IdentifierParameters, state: rpbsid.RpbsidState, dt: float, rows: Rows, elapsed: int
                ) -> tuple[Identified | None, Status, str]:
    """Return the model, and status and reason to publish while there is none.

    WARMING_UP: there are too few samples. POORLY_EXCITED: the signals are constant, or the regression is singular.
    elapsed: time since the last event in samples.
    """
    try:
        found = rpbsid.identified(config, state, dt, rows)
    except np.linalg.LinAlgError:  # signals that are almost constant, or vary in one direction only
        return None, Status.POORLY_EXCITED, ''
    parameters = config.past_window * (len(config.inputs) + len(config.outputs)) + len(config.inputs)
    enough = 2 * parameters + config.past_window
    if state.counts[FILLED] > enough:
        return found, Status.POORLY_EXCITED, ''
    lossy = state.counts[USED] == 0 and min(elapsed, state.counts[SEEN]) > enough
    return found, Status.WARMING_UP, '' if not lossy else (
        f'no {config.past_window + 1} samples in a row came without a loss (lower past_window)')
