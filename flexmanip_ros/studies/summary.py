"""The result of a run: its numbers, named as in the ``--json`` line of identify_bag, and its payload in words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from flexmanip_ros import pipeline
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload.structured_model import unobservable_reason
from flexmanip_ros.studies.smoothing import Smoothed
from flexmanip_ros.types import CaptureEvent, Estimate, EventKind, Payload, Status

ADVICE: Mapping[Status, str] = {
    Status.WARMING_UP: 'record for longer, while the arm moves',
    Status.TRACKING: 'the estimates can be used',
    Status.POORLY_EXCITED: 'move the arm more, or raise the torque',
    Status.ILL_CONDITIONED: 'lower the order or the past window',
    Status.ORDER_TOO_LOW: 'raise the order',
    Status.INCONSISTENT: 'check the parameters arm.* and the time of the capture',
    Status.UNOBSERVABLE: 'add the torques, angles and bends of both links to inputs, outputs and angles',
    Status.DIVERGED: 'check the units of the signals and the parameters arm.*',
}
"""What a user can do next."""


def status_text(status: Status, config: IdentifierParameters | None = None) -> str:
    """Return a status in words, with its reason where the configuration shows it, and what to do next."""
    reason = ''
    if status is Status.UNOBSERVABLE and config is not None:
        reason = f': {unobservable_reason(config)}'
    return f'{status.value.partition(";")[0]}{reason}; {ADVICE[status]}'


@dataclass(frozen=True)
class Summary:
    """Times count from the first sample's stamp [s]; None where a value does not apply."""

    samples: int
    gaps: int
    sample_time_s: float | None
    wall_s: float
    status: str
    frequencies_hz: tuple[float, ...]
    damping_ratios: tuple[float, ...]
    payload_mass_kg: float | None
    payload_std_kg: float | None
    payload_ci95_kg: tuple[float | None, float | None] | None
    consistency: float | None
    capture_time_s: float | None
    release_time_s: float | None
    payload_com_m: tuple[float, ...] | None = None
    payload_com_std_m: tuple[float, ...] | None = None
    payload_inertia_kgm2: float | None = None
    payload_inertia_std_kgm2: float | None = None
    vaf_simulation_percent: tuple[float | None, ...] | None = None
    vaf_prediction_percent: tuple[float | None, ...] | None = None
    vaf_horizon_percent: tuple[float | None, ...] | None = None
    smoothed: tuple[Smoothed, ...] | None = None
    """Models of whole stretches, where they are asked for; in the JSON then, too."""
    model_status: str = 'TRACKING'
    """Status of the model, where ``status`` is that of the payload. It is not in the JSON."""

    def as_json(self) -> dict[str, Any]:
        """Return the values as JSON has them: no NaN, no infinity, lists instead of tuples."""
        return {item.name: _json(getattr(self, item.name)) for item in fields(self)
                if item.name != 'model_status' and (item.name != 'smoothed' or self.smoothed is not None)}

    def payload_text(self) -> str:
        """Return payload and interval in words; where they are not reliable, the reason and what to do next."""
        if self.payload_ci95_kg is None:
            return 'not estimated'
        status = Status[self.status]
        mass, (low, high) = self.payload_mass_kg, self.payload_ci95_kg
        reason = '' if status is Status.TRACKING else status_text(status)
        if mass is None or low is None or high is None:
            return f'not known: {reason or "its interval is unbounded; record for longer, while the arm moves"}'
        interval = f'95 % interval {low:.6g} .. {high:.6g} kg'
        if reason:
            return f'not reliable: {mass:.6g} kg, {interval}; {reason}'
        if self.held_since_s is None and mass == 0.0:
            return f'none: the arm is taken as empty, {interval}'
        return f'{mass:.6g} kg, {interval}'

    @property
    def held_since_s(self) -> float | None:
        """Time of the capture of what is held at the end [s]; None where nothing is held."""
        capture, release = self.capture_time_s, self.release_time_s
        return None if capture is None or (release is not None and release >= capture) else capture


def summarize(state: pipeline.State, estimate: Estimate | None, wall_s: float) -> Summary:
    """Return the numbers of the last estimate of a run. ``estimate`` is None when there never was one."""
    modes = () if estimate is None else tuple(mode for mode in estimate.modes if math.isfinite(mode.frequency_hz))
    payload = None if estimate is None else estimate.payload
    return Summary(
        samples=state.counters.accepted,
        gaps=state.counters.gaps,
        sample_time_s=_known(state.clock.dt or math.nan),
        wall_s=wall_s,
        status='WARMING_UP' if estimate is None else estimate.status.name,
        model_status='WARMING_UP' if estimate is None else estimate.model_status.name,
        frequencies_hz=tuple(mode.frequency_hz for mode in modes),
        damping_ratios=tuple(mode.damping_ratio for mode in modes),
        payload_mass_kg=None if payload is None else _known(payload.mass),
        payload_std_kg=None if payload is None else _known(payload.std),
        payload_ci95_kg=None if payload is None else (_known(payload.lower), _known(payload.upper)),
        consistency=None if payload is None else _known(payload.consistency),
        **_body(payload),
        capture_time_s=event_time(state, EventKind.CAPTURE),
        release_time_s=event_time(state, EventKind.RELEASE),
    )


def _body(payload: Payload | None) -> dict[str, Any]:
    """Return centre of mass and inertia with their deviations; nothing where the object is a point."""
    if payload is None or not payload.covariance:
        return {}
    std = np.sqrt(np.maximum(np.array(payload.covariance)[::5], 0.0)).tolist()
    return {'payload_com_m': payload.com[:2], 'payload_com_std_m': tuple(std[1:3]),
            'payload_inertia_kgm2': payload.inertia[5], 'payload_inertia_std_kgm2': std[3]}


def event_time(state: pipeline.State, kind: EventKind) -> float | None:
    """Return when the latest event of a kind was, from the first sample's stamp [s]; None if not reached."""
    stamp = state.stamp_of(kind)
    waiting = () if state.payload is None else state.payload.pending
    return None if stamp is None or CaptureEvent(stamp, kind) in waiting else (stamp - state.first_ns) / 1e9


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _json(value: Any) -> Any:
    if isinstance(value, Smoothed):
        return {name: _json(part) for name, part in value.as_json().items()}
    if isinstance(value, tuple):
        return [_json(item) for item in value]
    if isinstance(value, float):
        return _known(value)
    return value
