"""Evaluation of a complete recording.

``score``: how well a model predicts the part that it was not identified on. ``smooth``: the best model of each stretch
between events, from all samples of the stretch. ``sweep``: the frequencies over configurations, of a model that holds
in each configuration.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from flexmanip_ros import pipeline
from flexmanip_ros.errors import ModelError, ParameterError
from flexmanip_ros.identification import (
    decimation,
    model_output,
    parameter_varying,
    prediction_check,
    recursive_fit,
    rpbsid,
    validation,
)
from flexmanip_ros.identification.batch_fit import BLOCK, interpolated
from flexmanip_ros.identification.prediction_check import MOST_TURN, PER_RAD
from flexmanip_ros.identification.uncertainty import Identified, modes
from flexmanip_ros.identification.varying_model import Configurations
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples.sample_log import Rows, Signals, log_of
from flexmanip_ros.samples.signals import relative_angle
from flexmanip_ros.types import Array, Mode, StateSpace, Status

HORIZON_S = 0.25
"""Default prediction horizon of the score [s]: the horizon of a controller of a flexible arm."""


@dataclass(frozen=True, eq=False)
class Scores:
    """Variance accounted for (VAF) per output (m,) [%], and the outputs it is computed from.

    horizon: VAF of the prediction a given time ahead of the last sample used, nan where too few samples are left.
    time: (N,) [s]; measured, simulated, predicted (one step ahead): (N, m).
    """

    simulation: Array
    prediction: Array
    horizon: Array
    time: Array
    measured: Array
    simulated: Array
    predicted: Array
    until_gap: bool
    """Whether a gap ended the scored stretch before the end of the recording."""


def score(model: StateSpace | None, signals: Signals, start_s: float, *, factor: int = 1,
          horizon_s: float = HORIZON_S, constant: Array | None = None) -> Scores:
    """Score a fixed model (no further adaptation) on the samples from ``start_s`` [s] on, up to the first gap.

    The state at the start is estimated on the samples before it, by least squares over a free run of the
    model and of its predictor; simulation then uses no measured output.
    constant: (n,) of the model, see ``Identified``. factor: its decimation. Above 1, signals are filtered as the
    identifier filters them, and simulation and one-step prediction are scored on the filtered signals. The prediction
    ``horizon_s`` [s] ahead is scored on the samples as they were measured; it uses samples up to ``horizon_s`` before.
    Raises ParameterError when nothing is left to score, ModelError when there is no model.
    """
    time = signals.time
    first = int(np.searchsorted(time, start_s))
    if first < 2 or time.size - first < 2:
        length = f'{time[-1]:.3f} s' if time.size else 'nothing'
        raise ParameterError(f'validation from {start_s:g} s leaves no samples to identify on or to score',
                             f'the recording is {length} long; choose a time well inside it')
    if model is None:
        raise ModelError(f'there is no model yet at {start_s:g} s', 'validate from a later time')
    gaps = np.flatnonzero(signals.gap)
    before = int(gaps[gaps <= first][-1]) if (gaps <= first).any() else 0
    after = int(gaps[gaps > first][0]) if (gaps > first).any() else time.size
    measured = signals.y[before:after]
    kept, rows = decimation.whole(np.hstack([signals.u[before:after], measured]), factor)
    if factor > 1:  # a filtered sample is scored if its last raw sample is scored
        lag = decimation.LAG
        split = int(np.searchsorted(rows, first - before - lag * factor))
    else:
        lag, split = 0, first - before
    if len(rows) - split < 2:
        raise ParameterError(f'validation from {start_s:g} s leaves no samples to score at a decimation of {factor}',
                             'choose an earlier time')
    r = signals.u.shape[1]
    (model, U), Y = validation.affine(model, constant, kept[:, :r]), kept[:, r:]
    u, y = U[split:], Y[split:]
    seen = signals.missing[before:after][rows] <= factor // 2  # what was interpolated is not scored
    steps = max(1, round(horizon_s / model.dt)) + lag
    x0 = validation.state_at_end(model, U[:split], Y[:split])
    with np.errstate(all='ignore'):  # an unstable model overflows and scores 0
        simulated = validation.simulate(model, u, x0)
        filtered = validation.state_at_end(_predictor(model), np.hstack([U, Y])[:split], Y[:split])
        predicted = validation.predict(model, u, y, filtered)
        ahead = validation.predict_ahead(model, u, y, steps, filtered)
    target, later = measured[rows[split + steps - 1:]], seen[split + steps - 1:]
    horizon = validation.vaf(target[later], ahead[later]) if np.count_nonzero(later) > 1 else np.full(
        y.shape[1], np.nan)
    seen = seen[split:]
    return Scores(
        validation.vaf(y[seen], simulated[seen]), validation.vaf(y[seen], predicted[seen]), horizon,
        time[before:after][rows[split:]], y, simulated, predicted, after < time.size)


def _predictor(model: StateSpace) -> StateSpace:
    """Return the one-step predictor as a system with the inputs [u; y]."""
    A = model.A - model.K @ model.C
    B = np.hstack([model.B - model.K @ model.D, model.K])
    D = np.hstack([model.D, np.zeros((model.C.shape[0], model.C.shape[0]))])
    return StateSpace(A, B, model.C, D, np.zeros_like(model.K), model.dt)


WORK = 2e9
"""Samples x outputs x squared parameters above which an iteration of the fit takes more than about a second."""
WHOLE = 0.8
"""Share of a stretch that its longest part without a gap must hold, for a fit of that part to stand for it."""


@dataclass(frozen=True)
class Smoothed:
    """The model of a stretch of samples, times from the first stamp of the recording [s].

    method: ``maximum likelihood``, ``subspace``, ``every configuration`` where the arm turned (modes: those in the last
    one), or ``none`` where there is no model.
    """

    start_s: float
    end_s: float
    samples: int
    method: str
    status: Status
    modes: tuple[Mode, ...]
    course: tuple[tuple[float, tuple[Mode, ...]], ...] = ()
    """Where the arm turned: times [s], each with the modes of the same model in the configuration of that time."""

    def as_json(self) -> dict[str, Any]:
        """Return the values by the names that the JSON of identify_bag has."""
        return {
            'start_s': self.start_s, 'end_s': self.end_s, 'samples': self.samples, 'method': self.method,
            'status': self.status.name,
            'frequencies_hz': tuple(mode.frequency_hz for mode in self.modes),
            'frequencies_std_hz': tuple(mode.frequency_std_hz for mode in self.modes),
            'damping_ratios': tuple(mode.damping_ratio for mode in self.modes),
            'damping_ratios_std': tuple(mode.damping_ratio_std for mode in self.modes)}


def smooth(config: IdentifierParameters, signals: Signals, events_ns: Sequence[int], dt: float,
           until_s: float | None = None) -> tuple[Smoothed, ...]:
    """Fit each stretch between events with all of its samples.

    events_ns: stamps of the events; dt: sample time [s]; until_s: later samples are left out [s].
    """
    count = len(signals.stamp_ns) if until_s is None else int(np.searchsorted(signals.time, until_s))
    inside = np.searchsorted(signals.stamp_ns[:count], sorted(events_ns)).tolist()
    borders = list(dict.fromkeys([0, *inside, count]))
    return tuple(_of_every_configuration(config, signals, a, b, dt) or _stretch(config, signals, a, b, dt)
                 for a, b in pairwise(borders))


def _of_every_configuration(config: IdentifierParameters, signals: Signals, a: int, b: int, dt: float
                            ) -> Smoothed | None:
    """Return the model of every configuration that has read rows a to b; None where the arm hardly turned.

    None also where there is no such model.
    """
    if parameter_varying.roles(config) is None or signals.angles.shape[1] != 2:
        return None
    relative = relative_angle(config, signals.angles[a:b])
    if not np.nanmax(relative) - np.nanmin(relative) > MOST_TURN:
        return None
    found = _configurations(config, _after(config, _rows(signals, a, b, signals.angles[a:b])), dt)
    if found is None:
        return None
    course = []
    for first in range(0, b - a - BLOCK + 1, BLOCK):
        angle = float(np.nanmean(relative[first:first + BLOCK]))
        course.append((float(signals.time[a + first + BLOCK // 2]), modes(found.with_relative(angle))))
    status = found.with_relative(found.varying.angle).status
    return Smoothed(float(signals.time[a]), float(signals.time[b - 1]), b - a, 'every configuration', status,
                    course[-1][1], tuple(course))


def _rows(signals: Signals, a: int, b: int, angles: Array | None = None) -> Rows:
    log = log_of(signals.u[a:b], signals.y[a:b], angles, signals.stamp_ns[a:b], signals.gap[a:b], signals.missing[a:b])
    return log.rows(0, b - a)


def _after(config: IdentifierParameters, rows: Rows) -> rpbsid.RpbsidState:
    """Return the state of the identifier after these rows."""
    return rpbsid.advance(config, rpbsid.init(config)._replace(held=None), rows)


def _configurations(config: IdentifierParameters, state: rpbsid.RpbsidState, dt: float) -> Configurations | None:
    """Return the model of every configuration after the last sample; None where it holds at one configuration only."""
    state = rpbsid.finish(state)
    if state.refined is None or state.refined.varying is None:  # a model of one configuration may be singular
        return None
    found = rpbsid.identified(config, state, dt)
    return found.configurations if found is not None and isinstance(found.configurations, Configurations) else None


def _stretch(config: IdentifierParameters, signals: Signals, a: int, b: int, dt: float) -> Smoothed:
    noise = 'sensor' if config.refinement == 'output_error' else 'any'
    config = replace(config, estimator='factor', forgetting='innovation', forgetting_factor=(1.0,) * 3,
                     refinement='none', state_basis='fixed' if config.state_basis == 'fixed' else 'singular')
    found, method = None, 'none'
    try:
        rows = _rows(signals, a, b)
        state, samples = _after(config, rows), _longest(config, rows)
        found, method = _fit(config, state, samples, noise, b - a, dt), 'maximum likelihood'
        if found is None:
            found, method = rpbsid.identified(config, state, dt), 'subspace'
        if found is not None:
            found = _judged(config, found, samples, signals.angles[a:b])
    except np.linalg.LinAlgError:
        found = None
    start_s, end_s = float(signals.time[a]), float(signals.time[b - 1])
    if found is None:
        return Smoothed(start_s, end_s, b - a, 'none', Status.WARMING_UP, ())
    return Smoothed(start_s, end_s, b - a, method, found.status, modes(found))


def _longest(config: IdentifierParameters, rows: Rows) -> Array:
    """Return the longest part of the rows without a gap, as the identifier has it: inputs and outputs (N, r + m).

    Outputs that were not measured are NaN, and no fit counts them.
    """
    rows = max(rows.stretches(), key=len)
    samples, at = decimation.whole(rows.u_y, config.decimation)
    samples = samples.copy()
    samples[rows.missing[at] > config.decimation // 2, rows.log.width.inputs:] = np.nan  # as the identifier counts them
    return samples


def _judged(config: IdentifierParameters, found: Identified, samples: Array, angles: Array) -> Identified:
    """Return the model with the status and the bands that its predictions of all samples (N, r + m) give.

    angles: (N, 2) measured ones [rad], or (N, 0).
    """
    missing, r = np.isnan(samples[:, -1]), len(config.inputs)
    if missing.all():
        return found
    role, samples, turned = parameter_varying.roles(config), interpolated(samples), 0.0
    rows = log_of(samples[:, :r], samples[:, r:], missing=missing.astype(np.int64)).rows(0, len(samples))
    if role is not None and angles.shape[1] == 2:
        relative = relative_angle(config, angles)
        turned, found = float(np.ptp(relative)), _of_a_mean(found, relative)
    return prediction_check.judged(found, rows, config.outputs, 0 if role is None else len(role.displacements), turned,
                                   filtered=config.decimation > 1)


def _of_a_mean(found: Identified, relative: Array) -> Identified:
    """Return the model with its spread widened by the turn of the links: a fixed model is a mean over configurations.

    relative: (N,) angle between the links at each sample [rad]. Half the range of its mean over a period of the slowest
    mode, which leaves the vibration out, is how far the model may be from a configuration of the stretch. ``PER_RAD``
    times that is a relative deviation of each frequency. A fit reads a frequency that drifts as damping too, so each
    damping ratio gets the same deviation. (Of 148 modes of 37 random runs, 11 frequencies and 10 damping ratios were
    beyond their 95 % bands without it, by up to four times, and none with it; with the standard deviation in place of
    half the range, 2 and 1 were.)
    """
    oscillations, relative = modes(found), relative[np.isfinite(relative)]
    period = round(1.0 / (oscillations[0].frequency_hz * found.model.dt)) if oscillations else len(relative)
    if not 0 < period < len(relative):
        return found
    share = PER_RAD * 0.5 * float(np.ptp(np.convolve(relative, np.full(period, 1.0 / period), 'valid')))
    values, right = prediction_check.eigen(found.model.A)
    logs, chosen = prediction_check.light_modes(values)
    return prediction_check.with_pole_errors(
        found, values, right, [(k, way * abs(logs[k]) * share) for k in chosen for way in (1.0, 1j)])


def _fit(config: IdentifierParameters, state: rpbsid.RpbsidState, samples: Array, noise: str, count: int, dt: float
         ) -> Identified | None:
    """Return the maximum-likelihood fit; None where it would take too long, or no model simulates the stretch."""
    size, m = recursive_fit.size(config), len(config.outputs)
    if len(samples) * config.decimation < WHOLE * count or not 2 * size < len(samples) < WORK / (m * size ** 2):
        return None
    fit = recursive_fit.whole_fit(config, samples, state.memory[0], state.scale, noise, [])
    if fit is None:
        return None
    d = state.memory[4].shape[1]
    return model_output.from_fit(config, fit, state.scalars, model_output.excitation(state.memory[0][:d, :d]),
                                 dt * config.decimation)


STEP_DEG = 2.5
"""Step between two configurations of a sweep [degrees]."""


class Sweep(NamedTuple):
    """Modes at each angle between the links, NaN where there is none. Angles of either sign have the same modes.

    relative: (N,) [rad]; frequency, std: (N, k) [Hz]; damping: (N, k); seen: (2,) smallest and largest angle between
    the links since the last event [rad].
    """

    relative: Array
    frequency: Array
    std: Array
    damping: Array
    seen: Array

    def rows(self) -> list[dict[str, Any]]:
        """Return one row a configuration, as a table has them."""
        found = []
        for k, angle in enumerate(self.relative):
            row: dict[str, Any] = {'relative_angle_deg': float(np.degrees(angle)),
                                   'seen': int(self.seen[0] <= angle <= self.seen[1])}
            for i in range(self.frequency.shape[1]):
                for name, table in ((f'frequency{i + 1}_hz', self.frequency), (f'frequency{i + 1}_std_hz', self.std),
                                    (f'damping{i + 1}_ratio', self.damping)):
                    row[name] = float(table[k, i]) if np.isfinite(table[k, i]) else None
            found.append(row)
        return found


def sweep(state: pipeline.State, angles: Array) -> Sweep | None:
    """Return the model's modes at every angle between the links; None where it holds at one configuration only.

    state: at the end of a recording; angles: (N, 2) measured ones since the last event [rad].
    """
    config, identifier = state.config, state.identifier
    if config is None or identifier is None or not len(angles):
        return None
    found = _configurations(config, identifier.estimator.rpbsid, state.clock.dt)
    if found is None:
        return None
    relative = np.radians(np.arange(0.0, 180.0 + STEP_DEG, STEP_DEG))
    count = config.order // 2
    table = np.full((len(relative), count, 3), np.nan)
    for k, angle in enumerate(relative):
        for i, mode in enumerate(modes(found.with_relative(float(angle)))[:count]):
            table[k, i] = mode.frequency_hz, mode.frequency_std_hz, mode.damping_ratio
    seen = np.arccos(np.cos(relative_angle(config, angles)))
    return Sweep(relative, table[:, :, 0], table[:, :, 1], table[:, :, 2], np.array([seen.min(), seen.max()]))
