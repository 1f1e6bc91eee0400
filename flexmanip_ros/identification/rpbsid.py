"""Recursive predictor-based subspace identification, paper section 3.1: init, step, restart.

Two estimators behind one interface. ``factor`` (default) carries one triangular factor of the moments of [z; u; y] and
computes the model from it when one is read (``moments``); ``paper`` runs the three recursive least squares of the paper
at every sample (``paper_recursion``). Memory is constant and the cost per sample bounded in both; decompositions happen
only in ``identified``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.errors import SignalError
from flexmanip_ros.identification import (
    decimation,
    factor,
    held_back,
    model_output,
    paper_recursion,
    prediction_check,
    recursive_fit,
)
from flexmanip_ros.identification.factor import FILLED, POWER, PRIOR, REJECTED, SEEN, USED, WEIGHT, WEIGHT2, Outcomes
from flexmanip_ros.identification.moments import solve_regressor
from flexmanip_ros.identification.uncertainty import Identified
from flexmanip_ros.identification.varying_model import Configurations
from flexmanip_ros.numerics.background import INLINE, Background
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples.sample_log import Rows, SampleLog, Width
from flexmanip_ros.types import Array, Status

MODES = {'constant': factor.CONSTANT, 'excitation': factor.EXCITATION, 'innovation': factor.INNOVATION}
FRESH = 3.0
"""Largest ratio of the samples behind the subspace model to those behind a fit at which the fit is published."""


class RpbsidState(NamedTuple):
    """State of the identifier, constant in size.

    z: (p (r + m),) past window, scaled; scale: (r + m,) factors on the signals; mean: (2, r + m) slow means and peaks;
    variance: (m,) of the innovations, scaled; scalars, counts: see ``factor``; memory: the arrays of the estimator, in
    the order of its kernel's arguments; refined: the prediction-error fit, None where it is off; decimator: the
    anti-alias filter, None without decimation; decimated: the log of filtered samples, None without decimation; cursor:
    row of the sample log that is taken next; held: the models that are held back, None
    where nobody asks for a status.
    """

    z: Array
    scale: Array
    mean: Array
    variance: Array
    scalars: Array
    counts: Array
    memory: tuple[Array, ...]
    refined: recursive_fit.Refined | None
    decimator: decimation.Decimator | None
    decimated: SampleLog | None
    cursor: int = 0
    held: held_back.HeldBack | None = None

    def owned(self) -> RpbsidState:
        """Return a copy whose arrays may be overwritten."""
        return RpbsidState(
            self.z.copy(), self.scale.copy(), self.mean.copy(), self.variance.copy(), self.scalars.copy(),
            self.counts.copy(), tuple(array.copy() for array in self.memory), self.refined,
            self.decimator, self.decimated, self.cursor, self.held)


def init(config: IdentifierParameters) -> RpbsidState:
    """Start with an empty memory."""
    r, m = len(config.inputs), len(config.outputs)
    p = config.past_window
    memory = _paper_memory(config, r, m) if config.estimator == 'paper' else _factor_memory(config, r, m)
    scalars = np.zeros(factor.SCALARS)
    scalars[PRIOR] = scalars[POWER] = 1.0
    return RpbsidState(
        z=np.zeros(p * (r + m)), scale=np.zeros(r + m), mean=np.zeros((2, r + m)), variance=np.zeros(m),
        scalars=scalars, counts=np.zeros(factor.COUNTS, dtype=np.int64), memory=memory,
        refined=recursive_fit.start(0) if _is_refined(config) else None,
        decimator=decimation.start(config.decimation, r + m) if config.decimation > 1 else None,
        decimated=SampleLog(Width(r, m, 0)) if config.decimation > 1 else None, held=held_back.HeldBack())


def _is_refined(config: IdentifierParameters) -> bool:
    """Whether the prediction-error fit runs: it needs a growing memory and at most ``PARAMETERS`` model entries."""
    return (config.refinement != 'none' and config.estimator == 'factor'
            and config.forgetting == 'innovation'
            and recursive_fit.size(recursive_fit.fitted(config)) <= recursive_fit.PARAMETERS)


def _regressors(config: IdentifierParameters, r: int, m: int) -> int:
    return config.past_window * (r + m) + (r if config.direct_feedthrough else 0)


def _factor_memory(config: IdentifierParameters, r: int, m: int) -> tuple[Array, ...]:
    q = (config.past_window + 1) * (r + m)
    d = _regressors(config, r, m)
    return np.zeros((q, q)), np.zeros(q), np.zeros(q), np.zeros(d), np.zeros((m, d))


def _paper_memory(config: IdentifierParameters, r: int, m: int) -> tuple[Array, ...]:
    n, f = config.order, config.future_window
    d1 = _regressors(config, r, m)
    d2 = n + r + m
    d3 = n + r if config.direct_feedthrough else n
    theta_x, theta_y = np.eye(n, d2), np.eye(m, d3)  # initial values of the paper's step (d)
    return (
        np.zeros((d1, d1)), np.zeros((m, d1)), np.zeros((m, d1)), np.zeros(d1),
        np.zeros((d2, d2)), theta_x, np.zeros(d2), np.zeros((d3, d3)), theta_y, np.zeros(d3),
        np.eye(n, f * m), np.eye(n), np.zeros(d2 + 1))


def advance(config: IdentifierParameters, state: RpbsidState, rows: Rows, background: Background = INLINE
            ) -> RpbsidState:
    """Take the next N rows of the sample log; N calls with one row each give the same bits.

    The function is pure: it copies the given state once. A sample that is not finite is rejected and empties the past
    window. Raises SignalError on wrong sizes.
    """
    r, m = len(config.inputs), len(config.outputs)
    width = rows.log.width
    if (width.inputs, width.outputs) != (r, m):
        raise SignalError(
            f'samples of {width.inputs} inputs and {width.outputs} outputs do not fit {r} inputs and {m} outputs',
            'give one column per configured signal')
    for part in rows.stretches():
        if part.gap[0]:
            state = window_restart(config, state, background)
        state = _advance(config, state, part, background)
    return state._replace(cursor=rows.until)


def first_needed(state: RpbsidState) -> int:
    """Return the first row of the sample log that will be read again."""
    if state.decimated is not None:
        return state.cursor
    return min(state.cursor, _first_read(state, state.cursor))


def _first_read(state: RpbsidState, row: int) -> int:
    """Return the first row, of the log of filtered samples if there is one, that will be read again."""
    first = row if state.held is None else held_back.first_needed(state.held, row)
    return first if state.refined is None else min(first, recursive_fit.first_needed(state.refined))


def _advance(config: IdentifierParameters, state: RpbsidState, rows: Rows, background: Background
             ) -> RpbsidState:
    """Take rows without a gap among them."""
    new = state.owned()
    if new.decimator is not None and new.decimated is not None:
        new, rows = _decimate(config, new, new.decimator, new.decimated, rows)
    done = rows.first
    regressors = _regressors(config, len(config.inputs), len(config.outputs))
    while done < rows.until:
        until = rows.until
        if new.held is not None:
            left = rows.between(done, rows.until)
            held = held_back.due(config, new.held, left, _learned(config, new), regressors, background)
            new, until = new._replace(held=held), held_back.until(held, left, int(new.counts[USED]), regressors)
        if new.refined is not None:
            until = min(until, done + recursive_fit.until_chunk(new.refined))
        some = rows.between(done, until)
        outcome = _run(config, new, np.ascontiguousarray(some.u), np.ascontiguousarray(some.y),
                       np.ascontiguousarray(some.missing))
        if new.refined is not None:
            new = new._replace(refined=recursive_fit.refine(
                config, new.refined, some, outcome, new.memory[0], new.scale, background))
        done = until
    return new


def _learned(config: IdentifierParameters, state: RpbsidState) -> held_back.Learned:
    """Return what has been learned so far, as a view of the state."""
    parts = state.memory if config.estimator == 'paper' else state.memory[:1]
    return held_back.Learned(parts, state.scale, state.mean, float(state.scalars[WEIGHT]), int(state.counts[USED]))


def _decimate(config: IdentifierParameters, state: RpbsidState, decimator: decimation.Decimator,
              log: SampleLog, rows: Rows) -> tuple[RpbsidState, Rows]:
    """Filter rows; return the new state and the rows that they add to the decimated log."""
    was_empty = decimator.seen < len(decimator.taps)  # the filter has given no sample since the gap
    decimator, kept, at, absent = decimation.decimate(decimator, rows.u_y, rows.missing, config.decimation)
    r = log.width.inputs
    first = log.end
    needed = min(first - prediction_check.MOST_ROWS, _first_read(state, first))
    gap = np.zeros(len(at), dtype=np.bool_)
    gap[:1] = was_empty and first > 0
    log = log.from_row(needed).append(
        rows.stamp_ns[at], kept[:, :r], kept[:, r:], np.zeros((len(at), 0)), gap,
        missing=np.where(absent > config.decimation // 2, absent, 0))
    return state._replace(decimator=decimator, decimated=log), log.rows(first, log.end)


def _run(config: IdentifierParameters, state: RpbsidState, U: Array, Y: Array, missing: NDArray[np.int64]) -> Outcomes:
    """Run the compiled kernel, overwriting the arrays of the state; return the outcome of each sample."""
    recursive = config.estimator == 'paper'  # its states date from earlier parameters, so it must forget
    mode = MODES['excitation' if recursive and config.forgetting == 'innovation' else config.forgetting]
    outcome = np.zeros(len(U), dtype=np.int8)
    if config.estimator == 'paper':
        Y = Y.copy()
        Y[missing > 0] = np.nan  # rejected like a sample that is not finite, but no outlier
        advance: Any = paper_recursion.advance_paper
        advance(
            U, Y, *state.memory, state.z, state.scale, state.mean, state.variance, state.scalars, state.counts,
            config.past_window, config.future_window, int(config.direct_feedthrough),
            int(config.weighted_observability), int(config.state_basis == 'tracked'),
            np.array(config.regularization), np.array(config.forgetting_factor), mode)
        state.counts[[SEEN, REJECTED]] -= np.count_nonzero(missing)
        return outcome
    R, row, scratch, peaks, prior = state.memory
    factor.advance_factor(
        U, Y, R, state.z, row, scratch, peaks, prior, state.scale, state.mean, state.variance, state.scalars,
        state.counts, config.past_window, int(config.direct_feedthrough), config.regularization[0],
        config.forgetting_factor[0], mode, missing, outcome)
    return outcome


def latest(config: IdentifierParameters, state: RpbsidState, since_ns: int, dt: float) -> Rows | None:
    """Return the filtered samples on which a model is judged; None without decimation.

    They are the last 1.5 s, or as many as the order needs, but none before ``since_ns`` [ns]. dt: sample time [s].
    """
    log = state.decimated
    if log is None:
        return None
    first = max(log.start, log.end - prediction_check.length(dt * config.decimation, config.order))
    return log.rows(min(log.row_at(since_ns, first), log.end), log.end)


def finish(state: RpbsidState, background: Background = INLINE) -> RpbsidState:
    """Take the results of the fit and of the prediction under way now, as no sample follows."""
    if state.held is not None:
        state = state._replace(held=held_back.delivered(state.held, background))
    if state.refined is None:
        return state
    return state._replace(refined=recursive_fit.delivered(state.refined, background))


def window_restart(config: IdentifierParameters, state: RpbsidState, background: Background = INLINE
                   ) -> RpbsidState:
    """Empty the past window where samples are missing, so no regressor spans the gap; what was learnt is kept."""
    new = state.owned()
    if new.held is not None:
        new = new._replace(held=held_back.broken(new.held))
    new.counts[FILLED] = 0
    if config.estimator == 'paper':
        new.memory[-1][-1] = 0.0
    if new.decimator is not None:
        new = new._replace(decimator=new.decimator._replace(seen=0))  # no filtered sample depends on older ones
    if new.refined is not None:
        new = new._replace(refined=recursive_fit.broken(new.refined, background))
    return new


def restart(config: IdentifierParameters, state: RpbsidState, background: Background = INLINE) -> RpbsidState:
    """Take note that the plant changed at this instant (capture, release).

    The past window is emptied. With ``restart_on_event`` the information is dropped too; the parameters remain as the
    mean of a prior of weight ``regularization`` on signals of unit peak.
    """
    new = window_restart(config, state, background)
    if new.refined is not None:
        new = new._replace(refined=recursive_fit.restart(new.refined))
    if not config.restart_on_event or not new.counts[USED]:
        return new
    if new.held is not None:
        new = new._replace(held=held_back.HeldBack())
    new.counts[USED] = 0
    new.scalars[[WEIGHT, WEIGHT2]] = 0.0
    new.scalars[[PRIOR, POWER]] = 1.0
    roots = [np.sqrt(alpha) for alpha in config.regularization]
    if config.estimator == 'paper':
        S1, xi, prior1, peaks1, S2, _, peaks2, S3, _, peaks3 = new.memory[:10]
        prior1[:] = xi
        for S, peaks, root in ((S1, peaks1, roots[0]), (S2, peaks2, roots[1]), (S3, peaks3, roots[2])):
            S[:] = np.diag(np.divide(1.0, root * peaks, out=np.zeros_like(peaks), where=peaks > 0.0))
        return new
    R, _, _, peaks, prior = new.memory
    d, m = peaks.size, prior.shape[0]
    prior[:] = solve_regressor(R, d, m)[0]
    R[:] = 0.0
    R[np.arange(d), np.arange(d)] = roots[0] * peaks
    R[:d, -m:] = (roots[0] * peaks)[:, None] * prior.T
    return new


def identified(config: IdentifierParameters, state: RpbsidState, dt: float, rows: Rows | None = None
               ) -> Identified | None:
    """Return the model as of the last sample, or None before there is one. dt: sample time [s].

    With decimation a step of the model is ``decimation`` sample times. rows: the latest ones, from which a model of
    every configuration takes the present one; without them it takes the configuration at the end of the last block.
    """
    dt *= config.decimation
    d = _regressors(config, len(config.inputs), len(config.outputs))
    refined = state.refined
    if refined is not None and refined.varying is not None:
        last = refined.recursion
        read = Configurations(
            config, refined.varying, dt, model_output.excitation(state.memory[0][:d, :d]), float(state.scalars[POWER]),
            np.zeros(0) if last is None else last.singular_values, float('nan') if last is None else last.condition)
        return read.with_relative(refined.varying.angle) if rows is None else read.now(rows)
    if refined is not None and refined.recursion and len(refined.recursion.theta.A) == config.order \
            and FRESH * refined.recursion.weight >= min(state.counts[USED], recursive_fit.MEMORY):
        return model_output.from_fit(
            config, refined.recursion, state.scalars, model_output.excitation(state.memory[0][:d, :d]), dt)
    few = state.counts[USED] <= max(config.past_window, config.order)
    if few or not np.all(np.isfinite(state.memory[0])):
        return None
    if config.estimator == 'paper':
        scale = state.scale
        realized, R = model_output.from_recursion(config, state.memory, state.mean)
    else:
        realized, R, scale = model_output.from_factor(config, state.memory[0], state.scale)
    if realized is None:
        return None
    found = model_output.publish(
        config, realized, R, scale, state.scalars, state.variance, int(state.counts[USED]), d, dt)
    early = refined is not None and (state.counts[USED] < recursive_fit.FIRST + recursive_fit.SOONEST
                                     or recursive_fit.is_first_under_way(refined))
    if found is not None and early and found.status is Status.TRACKING:
        return found._replace(  # a short past window gives a bias
            status=Status.WARMING_UP, reason='the first fit has not been made yet')
    return found

