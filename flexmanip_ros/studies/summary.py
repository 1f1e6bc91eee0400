"""What a run came to, in the names of the ``--json`` line of identify_bag; studies use the same."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

from flexmanip_ros import pipeline
from flexmanip_ros.types import CaptureEvent, Estimate, EventKind


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
    vaf_simulation_percent: tuple[float | None, ...] | None = None
    vaf_prediction_percent: tuple[float | None, ...] | None = None
    model_status: str = 'TRACKING'
    """What the model is worth, where ``status`` is that of the payload; for people, not in the JSON."""
    modes_deviation: float = math.nan
    """Of the model's modes from the arm's with this payload, beyond 1 they disagree; not in the JSON."""

    def as_json(self) -> dict[str, Any]:
        """Return the values as JSON has them: no NaN, no infinity, lists instead of tuples."""
        return {item.name: _json(getattr(self, item.name)) for item in fields(self)
                if item.name not in ('model_status', 'modes_deviation')}


def summarize(state: pipeline.State, estimate: Estimate | None, wall_s: float) -> Summary:
    """Return what the last estimate of a run says. ``estimate`` is None when there never was one."""
    modes = () if estimate is None else tuple(
        mode for mode in estimate.modes if math.isfinite(mode.frequency_hz))
    payload = None if estimate is None else estimate.payload
    return Summary(
        samples=state.counters.accepted,
        gaps=state.counters.gaps,
        sample_time_s=_known(state.clock.dt or math.nan),
        wall_s=wall_s,
        status='WARMING_UP' if estimate is None else estimate.status.name,
        model_status='WARMING_UP' if estimate is None else estimate.model_status.name,
        modes_deviation=math.nan if estimate is None else estimate.modes_deviation,
        frequencies_hz=tuple(mode.frequency_hz for mode in modes),
        damping_ratios=tuple(mode.damping_ratio for mode in modes),
        payload_mass_kg=None if payload is None else _known(payload.mass),
        payload_std_kg=None if payload is None else _known(payload.std),
        payload_ci95_kg=None if payload is None else (_known(payload.lower), _known(payload.upper)),
        consistency=None if payload is None else _known(payload.consistency),
        capture_time_s=event_time(state, EventKind.CAPTURE),
        release_time_s=event_time(state, EventKind.RELEASE),
    )


def event_time(state: pipeline.State, kind: EventKind) -> float | None:
    """Return when the latest event of a kind was, from the first sample's stamp [s]; None if not reached."""
    stamp = state.stamp_of(kind)
    waiting = () if state.payload is None else state.payload.pending
    return None if stamp is None or CaptureEvent(stamp, kind) in waiting else (stamp - state.first_ns) / 1e9


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _json(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_json(item) for item in value]
    if isinstance(value, float):
        return _known(value)
    return value
