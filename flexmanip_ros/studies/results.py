"""The result of a run: its numbers, named as in the ``--json`` line of identify_bag, and its payload in words.

The scores of many runs are here too: the error of the payload, how often its 95 % interval holds the true mass, and
the least error possible (Cramer-Rao bound).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import scipy

from flexmanip_ros import pipeline
from flexmanip_ros.arm.manipulator import chords
from flexmanip_ros.errors import ModelError
from flexmanip_ros.identification.prediction_check import white_noise
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import cramer_rao
from flexmanip_ros.payload.structured_model import unobservable
from flexmanip_ros.samples.sample_log import Signals
from flexmanip_ros.studies.whole_recording import Smoothed
from flexmanip_ros.types import QUANTILE, Array, Estimate, EventKind, Mode, Payload, Status

ADVICE: Mapping[Status, str] = {
    Status.WARMING_UP: 'record for longer, while the arm moves',
    Status.TRACKING: 'the estimates can be used',
    Status.POORLY_EXCITED: 'move the arm more, or raise the torque',
    Status.ILL_CONDITIONED: 'lower the order or the past window',
    Status.ORDER_TOO_LOW: 'raise the order',
    Status.INCONSISTENT: 'check the units of the signals (rad, m, N m), the parameters arm.* and the times of events',
    Status.UNOBSERVABLE: 'add the torques, angles and bends of both links to inputs, outputs and angles',
    Status.DIVERGED: 'check the units of the signals, the parameters arm.* and the times of events',
}
"""What a user can do next, for each status."""
MODEL_ADVICE: Mapping[Status, str] = {
    Status.INCONSISTENT: 'check inputs and outputs, or let --suggest choose order and windows',
    Status.POORLY_EXCITED: 'move the arm more, raise the torque, or lower the order where it has no such mode',
}
"""The same for the status of a model."""


def status_text(status: Status, config: IdentifierParameters | None = None, known: str = '', *, of_model: bool = False
                ) -> str:
    """Return a status in words, with its reason where that is known or the configuration shows it, and what to do next.

    known: the reason that came with the estimate, if any; of_model: the status is that of the model alone.
    """
    reason, advice = f': {known}' if known else '', ADVICE[status]
    if status is Status.UNOBSERVABLE and config is not None:
        why, advice = unobservable(config)
        reason = f': {why}'
    if of_model or (config is not None and config.payload_method == 'none'):
        advice = MODEL_ADVICE.get(status, advice)
    return f'{status.value.partition(";")[0]}{reason}; {advice}'


@dataclass(frozen=True)
class Summary:
    """The numbers of a run. Times count from the first sample's stamp [s]; None where a value does not apply."""

    samples: int
    gaps: int
    sample_time_s: float | None
    wall_s: float
    status: str
    frequencies_hz: tuple[float, ...]
    damping_ratios: tuple[float, ...]
    payload_mass_kg: float | None = None
    payload_std_kg: float | None = None
    payload_ci95_kg: tuple[float | None, float | None] | None = None
    consistency: float | None = None
    capture_time_s: float | None = None
    release_time_s: float | None = None
    payload_com_m: tuple[float, ...] | None = None
    payload_com_std_m: tuple[float, ...] | None = None
    payload_inertia_kgm2: float | None = None
    payload_inertia_std_kgm2: float | None = None
    vaf_simulation_percent: tuple[float | None, ...] | None = None
    vaf_prediction_percent: tuple[float | None, ...] | None = None
    vaf_horizon_percent: tuple[float | None, ...] | None = None
    smoothed: tuple[Smoothed, ...] | None = None
    """Models of whole stretches, where they are asked for; only then are they in the JSON."""
    model_status: str = 'TRACKING'
    """Status of the model, where ``status`` is that of the payload. It is not in the JSON."""
    reason: str = ''
    """What gave the model its status. It is not in the JSON."""
    horizon_reason: str = ''
    """Why there is no score of the prediction ahead. It is not in the JSON."""

    def as_json(self) -> dict[str, Any]:
        """Return the values as JSON has them: no NaN, no infinity, lists instead of tuples."""
        left_out = {'model_status', 'reason', 'horizon_reason', *(['smoothed'] if self.smoothed is None else [])}
        return {item.name: _json(getattr(self, item.name)) for item in fields(self) if item.name not in left_out}

    def payload_text(self, config: IdentifierParameters | None = None) -> str:
        """Return payload and interval in words; where they are not reliable, the reason and what to do next."""
        if self.payload_ci95_kg is None:
            return 'not estimated'
        status = Status[self.status]
        mass, (low, high) = self.payload_mass_kg, self.payload_ci95_kg
        reason = '' if status is Status.TRACKING else status_text(status, config)
        if mass is None or low is None or high is None:
            return f'not known: {reason or "its interval is unbounded; record for longer, while the arm moves"}'
        interval = f'95 % interval {low:.6g} .. {high:.6g} kg'
        if reason:
            return f'not reliable: {mass:.6g} kg, {interval}; {reason}'
        if self.held_since_s is None and mass == 0.0:
            return f'none: the arm is taken as empty, {interval}'
        return f'{mass:.6g} kg, {interval}'

    @property
    def status_reason(self) -> str:
        """``reason`` where ``status`` is that of the model."""
        return self.reason if self.status == self.model_status else ''

    @property
    def held_since_s(self) -> float | None:
        """Time of the capture of what is held at the end [s]; None where nothing is held."""
        capture, release = self.capture_time_s, self.release_time_s
        return None if capture is None or (release is not None and release > capture) else capture


def result_rows(summary: Summary, config: IdentifierParameters, modes: Sequence[Mode], events: str = ''
                ) -> list[tuple[str, str]]:
    """Return the result as names and words for people, for the terminal and for the table of a report.

    modes: of the last estimate, with their deviations; events: what was found in the signals.
    """
    dt = 'unknown' if summary.sample_time_s is None else f'{summary.sample_time_s:.6g} s'
    found = [('samples', f'{summary.samples}, {summary.gaps} gaps, sample time {dt}, '
              f'identified in {summary.wall_s:.2f} s'), *([('events', events)] if events else ())]
    found += [(name, f'at {time:.3f} s{", before the first sample" if time < 0.0 else ""}') for name, time in (
        ('capture', summary.capture_time_s), ('release', summary.release_time_s)) if time is not None]
    found.append(('status', f'{summary.status}: {status_text(Status[summary.status], config, summary.status_reason)}'))
    if summary.model_status not in (summary.status, Status.TRACKING.name):
        model = status_text(Status[summary.model_status], known=summary.reason, of_model=True)
        found.append(('model', f'{summary.model_status}: {model}'))
    for k, mode in enumerate(modes):
        spread = f' +- {QUANTILE * mode.frequency_std_hz:.2g}' if mode.frequency_std_hz > 0.0 else ''
        found.append((f'mode {k + 1}',
                      f'{mode.frequency_hz:.4f}{spread} Hz, damping ratio {mode.damping_ratio:.4f}'))
    if summary.payload_ci95_kg is not None:
        found.append(('payload', summary.payload_text(config)))
        if summary.consistency is not None and summary.payload_std_kg is not None:
            found.append(('residuals', f'power {summary.consistency:.6g} times that of the noise (1: noise only)'))
    for words, values in (('simulation', summary.vaf_simulation_percent),
                          ('prediction', summary.vaf_prediction_percent), ('ahead', summary.vaf_horizon_percent)):
        if values is not None:
            shares = [f'{name} {_text(value)} %' for name, value in zip(config.outputs, values, strict=True)]
            why = summary.horizon_reason if words == 'ahead' else ''
            found.append((f'VAF {words}', why or ', '.join(shares)))
    return found


def _text(value: float | None) -> str:
    return 'unknown' if value is None or math.isnan(value) else f'{value:.6g}'


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
        reason='' if estimate is None else estimate.reason,
        frequencies_hz=tuple(mode.frequency_hz for mode in modes),
        damping_ratios=tuple(mode.damping_ratio for mode in modes),
        **({} if payload is None else _numbers(payload)),
        capture_time_s=event_time(state, EventKind.CAPTURE),
        release_time_s=event_time(state, EventKind.RELEASE),
    )


def _numbers(payload: Payload) -> dict[str, Any]:
    """Return mass, interval and consistency; where the object is a body, centre of mass and inertia with deviations."""
    found: dict[str, Any] = {
        'payload_mass_kg': _known(payload.mass), 'payload_std_kg': _known(payload.std),
        'payload_ci95_kg': (_known(payload.lower), _known(payload.upper)), 'consistency': _known(payload.consistency)}
    if payload.covariance:
        std = np.sqrt(np.maximum(np.array(payload.covariance)[::5], 0.0)).tolist()
        found |= {'payload_com_m': payload.com[:2], 'payload_com_std_m': tuple(std[1:3]),
                  'payload_inertia_kgm2': payload.inertia[5], 'payload_inertia_std_kgm2': std[3]}
    return found


def event_time(state: pipeline.State, kind: EventKind) -> float | None:
    """Return the time of the latest event of a kind from the first sample's stamp [s]; None before it is reached."""
    stamp = state.stamp_of(kind)
    waiting = () if state.payload is None else state.payload.pending
    is_to_come = any(event.kind is kind and event.stamp_ns == stamp for event in waiting)
    return None if stamp is None or is_to_come else (stamp - state.first_ns) / 1e9


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


RATE_WINDOW = 50
"""Number of samples over which the rates of the chord angles at the capture are measured."""
LONGEST = 20_000
"""Largest number of samples after the capture that the bound is computed from; more would lower it further."""


@dataclass(frozen=True)
class Score:
    """Scores of one estimator over many runs.

    runs, failed: counts; mean_error_percent, median_error_percent: mean and median over the runs of the mean relative
    error in the window; rms_error_percent: of the relative error of the last estimate; bias_kg: mean error of the last
    estimate; coverage_percent: how often its 95 % interval, where there is one, holds the true mass; coverage_low,
    coverage_high: 95 % interval of coverage_percent; us_per_sample: median cost; bound_ratio: root mean square of the
    last error over its Cramer-Rao bound.
    """

    runs: int
    failed: int
    mean_error_percent: float
    median_error_percent: float
    rms_error_percent: float
    bias_kg: float
    coverage_percent: float
    coverage_low: float
    coverage_high: float
    us_per_sample: float
    bound_ratio: float


def relative_error_percent(masses: Array, true: float) -> float:
    """Mean of |mass - true| / true over a stretch (N,) [%]; nan without a true mass or any estimate."""
    known = masses[np.isfinite(masses)]
    if known.size == 0 or true <= 0.0:
        return math.nan
    return float(100.0 * np.mean(np.abs(known - true)) / true)


def coverage(hits: int, runs: int) -> tuple[float, float, float]:
    """Return the share of hits and its Clopper-Pearson interval of 95 % confidence [%]."""
    if runs == 0:
        return math.nan, math.nan, math.nan
    tail = (1.0 - 0.95) / 2.0
    low = 0.0 if hits == 0 else float(scipy.special.betaincinv(hits, runs - hits + 1, tail))
    high = 1.0 if hits == runs else float(scipy.special.betaincinv(hits + 1, runs - hits, 1.0 - tail))
    return 100.0 * hits / runs, 100.0 * low, 100.0 * high


def score(rows: Sequence[Mapping[str, Any]]) -> Score:
    """Return the scores of the rows of one estimator."""
    good = [row for row in rows if not row.get('error')]
    failed, runs = len(rows) - len(good), len(rows)
    costs = [row['us_per_sample'] for row in good if _number(row, 'us_per_sample') is not None]
    needed = ('payload_mass_kg', 'payload_true_kg')
    good = [row for row in good if all(_number(row, name) is not None for name in needed)]
    errors = np.array([row['payload_mass_kg'] - row['payload_true_kg'] for row in good], dtype=np.float64)
    truths = np.array([row['payload_true_kg'] for row in good], dtype=np.float64)
    window = np.array([_number(row, 'error_percent', math.nan) for row in good], dtype=np.float64)
    window = window[np.isfinite(window)]
    with np.errstate(divide='ignore', invalid='ignore'):
        relative = 100.0 * errors / truths
    relative = relative[np.isfinite(relative)]
    claims = [bool(row['covered']) for row in good if row.get('covered') is not None]
    share, low, high = coverage(sum(claims), len(claims))
    ratios = [(row['payload_mass_kg'] - row['payload_true_kg']) / row['bound_std_kg'] for row in good
              if _number(row, 'bound_std_kg')]
    return Score(
        runs=runs, failed=failed, mean_error_percent=_mean(window),
        median_error_percent=float(np.median(window)) if window.size else math.nan,
        rms_error_percent=math.sqrt(_mean(relative**2)) if relative.size else math.nan,
        bias_kg=_mean(errors), coverage_percent=share, coverage_low=low, coverage_high=high,
        us_per_sample=float(np.median(costs)) if costs else math.nan,
        bound_ratio=math.sqrt(_mean(np.array(ratios) ** 2)) if ratios else math.nan)


def payload_bound(config: IdentifierParameters, signals: Signals, capture_time: float, mass: float,
                dt: float) -> float | None:
    """Return the Cramer-Rao bound of the payload's standard deviation at the end of a run [kg].

    It is computed from the samples after the capture, for the moving arm. An estimator that learned gains and
    friction from the empty arm can be several times better. mass: the payload, or its estimate [kg]; the noise is
    measured on the signals. None where there is no bound: no angles, no sample after the capture, or no noise.
    """
    if signals.angles.shape[1] != len(config.arm.link_length) or not mass > 0.0 or dt <= 0.0:
        return None
    first = int(np.searchsorted(signals.time, capture_time - 0.5 * dt))
    count = min(signals.stamp_ns.size - first, LONGEST)
    if count < RATE_WINDOW:
        return None
    config = replace(config, outputs=signals.outputs)
    extra = [k for k, name in enumerate(config.angles) if name not in signals.outputs]
    noise = np.sqrt(white_noise(np.hstack([signals.y[first:], signals.angles[first:][:, extra]])))
    if not (noise > 0.0).all():
        return None
    theta = chords(config.arm, signals.angles[first])
    later = chords(config.arm, signals.angles[first + RATE_WINDOW - 1])
    rates = (later - theta) / ((RATE_WINDOW - 1) * dt)
    try:
        found = float(cramer_rao.nonlinear(config, theta, mass, signals.efforts[first:], noise, dt, (count,), rates)[0])
    except ModelError:
        return None
    return found if np.isfinite(found) else None


def _number(row: Mapping[str, Any], name: str, missing: Any = None) -> Any:
    value = row.get(name)
    return value if isinstance(value, (int, float)) and math.isfinite(value) else missing


def _mean(values: Array) -> float:
    return float(np.mean(values)) if values.size else math.nan
