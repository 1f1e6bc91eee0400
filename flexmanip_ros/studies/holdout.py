"""Scores of a model on the part of a recording that it was not identified on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexmanip_ros.errors import ModelError, ParameterError
from flexmanip_ros.identification import decimation, validation
from flexmanip_ros.samples.sample_log import Signals
from flexmanip_ros.types import Array, StateSpace

HORIZON_S = 0.25
"""How far ahead the prediction is scored where nobody says [s]: what a controller of a flexible arm looks ahead."""


@dataclass(frozen=True, eq=False)
class Scores:
    """Variance accounted for (VAF) per output (m,) [%], and the outputs it is of.

    horizon: of the prediction a given time ahead of the last sample used, nan where too few samples are left.
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
          horizon_s: float = HORIZON_S) -> Scores:
    """Score a model that is not adapted further on the samples from ``start_s`` [s] on, up to the first gap.

    The state at the start is estimated on the samples before it, by least squares over a free run of the
    model and of its predictor; simulation then uses no measured output.
    factor: decimation of the model, whose signals are then filtered as the identifier filters them; simulation and
    one-step prediction are scored on these, the prediction ``horizon_s`` [s] ahead on the samples as they were
    measured, from those that were there by then.
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
    if factor > 1:  # the last of the samples that a filtered one is made of decides
        lag = decimation.LAG
        split = int(np.searchsorted(rows, first - before - lag * factor))
    else:
        lag, split = 0, first - before
    if len(rows) - split < 2:
        raise ParameterError(f'validation from {start_s:g} s leaves no samples to score at a decimation of {factor}',
                             'choose an earlier time')
    r = signals.u.shape[1]
    U, Y = kept[:, :r], kept[:, r:]
    u, y = U[split:], Y[split:]
    steps = max(1, round(horizon_s / model.dt)) + lag
    x0 = validation.state_at_end(model, U[:split], Y[:split])
    with np.errstate(all='ignore'):  # an unstable model overflows and scores 0
        simulated = validation.simulate(model, u, x0)
        filtered = validation.state_at_end(_predictor(model), kept[:split], Y[:split])
        predicted = validation.predict(model, u, y, filtered)
        ahead = validation.predict_ahead(model, u, y, steps, filtered)
    target = measured[rows[split + steps - 1:]]
    horizon = validation.vaf(target, ahead) if len(target) > 1 else np.full(y.shape[1], np.nan)
    return Scores(
        validation.vaf(y, simulated), validation.vaf(y, predicted), horizon, time[before:after][rows[split:]], y,
        simulated, predicted, after < time.size)


def _predictor(model: StateSpace) -> StateSpace:
    """Return the one-step predictor as a system with the inputs [u; y]."""
    A = model.A - model.K @ model.C
    B = np.hstack([model.B - model.K @ model.D, model.K])
    D = np.hstack([model.D, np.zeros((model.C.shape[0], model.C.shape[0]))])
    return StateSpace(A, B, model.C, D, np.zeros_like(model.K), model.dt)
