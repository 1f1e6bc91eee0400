"""The parameters to identify a recording with, and why.

``shape_search`` chooses decimation, windows, order and direct term on moments. The prior is chosen here, by
cross-validation on these moments. What they cannot tell (forgetting, refinement) is tried with the identifier itself:
it runs through the recording and predicts the samples that follow. It may change the prior too: the folds of the
moments are mixed in time, and a prior that serves between them may be too strong or too weak for what follows.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from flexmanip_ros.identification import recursive_fit, rpbsid
from flexmanip_ros.parameters import IdentifierParameters, configure
from flexmanip_ros.samples.sample_log import Signals, log_of
from flexmanip_ros.studies import shape_search
from flexmanip_ros.studies.shape_search import PRIOR, Progress, Search, Shape

PLAIN = 1.03
"""Least factor by which another setting must reduce the error to replace the plain one."""
NEARLY, REFINED = 1.3, 1.1
"""Factors of the error: a refined model, of small order, is tried if the order costs less than the first of them, and
taken if the refinement gains more than the second, or is of a smaller order and as good."""
PRIORS = (1e-5, 0.1)
"""Ridges tried on the moments beside ``PRIOR``."""
RIDGES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
"""Ridges tried with the identifier itself."""
TOLD = float(np.log1p(0.5))
"""Error above which a run of the identifier tells nothing of the ridge: it misses over half of what follows."""
SHOWN = 5
"""Number of values that the reason for a choice compares."""
TRIALS = 5 + len(RIDGES)
"""Number of runs of the identifier itself, at most."""
FORGOTTEN = 3
"""Length of the recording over the time constant of the constant forgetting that is tried."""
PARTS = 6
"""Number of parts of the recording: the model of the first half predicts the fourth sixth, and so on."""


def suggest(given: Mapping[str, Any], signals: Signals, dt: float, horizon_s: float, progress: Progress
            ) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """Choose the parameters for a recording of one machine that does not change meanwhile.

    Return them by dotted name, and for each choice its name and its reason in one line.

    given: dotted names and values that stay as they are, ``inputs`` and ``outputs`` among them; signals: those of
    these inputs and outputs; dt: sample time [s]; horizon_s: how far ahead the models are to predict [s].
    Raises ParameterError when the recording is too short for any model, or none can be computed from it.
    """
    stretches = shape_search.stretches_of(signals, dt)
    search = Search(given, stretches, signals.u.shape[1], signals.y.shape[1], dt, horizon_s)
    runs = shape_search.plan(search)
    total, done = len(runs) + shape_search.FINALISTS + TRIALS, 0

    def step() -> None:
        nonlocal done
        done += 1
        progress(done, total)

    shape = shape_search.search_shapes(search, runs, step)
    values, settled, told = _settings(search, shape, step)
    progress(total, total)
    of_order = 'best of those that are refined' if settled != shape else (
        f'smallest within {100.0 * (shape_search.MARGIN - 1.0):.0f} % of the best')
    return values, [*_shape_reasons(search, settled, of_order), *told]


def _shape_reasons(search: Search, shape: Shape, of_order: str) -> list[tuple[str, str]]:
    """Return the reason for each part of the shape, with the unexplained shares of the values compared.

    of_order: reason for the order where it is not given.
    """
    found = []
    for name, part, text in (
            ('decimation', 'factor', lambda factor: f'{1.0 / (factor * search.dt):.4g} Hz'),
            ('past_window', 'past', lambda past: f'{past * shape.factor * search.dt:.3g} s'),
            ('future_window', 'future', str), ('order', 'order', str), ('direct_feedthrough', 'direct', str),
            ('weighted_observability', 'weighted', str)):
        value = getattr(shape, part)
        same: dict[str, object] = {} if part == 'factor' else {'factor': shape.factor}
        if part not in ('factor', 'past'):
            same['past'] = shape.past
        kinds = sorted({getattr(s, part) for s in search.tried if all(getattr(s, k) == v for k, v in same.items())})
        near = sorted(kinds, key=lambda kind: abs(kinds.index(kind) - kinds.index(value)))[:SHOWN]
        shares = ', '.join(f'{text(kind)} {_percent(search.tried[search.best(**same, **{part: kind})])}'
                           for kind in sorted(near))
        why = 'given; ' if name in search.given else f'{of_order}; ' if part == 'order' else ''
        found.append((name, f'{text(value)}: {why}unexplained {search.horizon_s:g} s ahead at {shares}'))
    return found


def _percent(loss: float) -> str:
    """Return a loss as the share of the variance that it stands for."""
    return f'{100.0 * min(np.expm1(loss), 1.0):.3g} %'


def _prior(search: Search, shape: Shape) -> float:
    """Return the ridge on the regression, PRIOR unless another one predicts better."""
    kept = search.kept(shape.factor)
    sums = shape_search.moments(search, kept, shape.past)
    errors = {}
    for alpha in (PRIOR, *PRIORS):
        found = shape_search.losses(search, kept, sums, shape, (shape.order,), alpha)
        errors[alpha] = found.get(shape.order, np.inf)
    best = min(errors, key=lambda alpha: errors[alpha])
    return best if errors[best] * PLAIN < errors[PRIOR] else PRIOR


def _ridge(errors: Mapping[float, float], alpha: float) -> float:
    """Return the ridge for errors of the identifier: that of the moments where it is nearly as good as the best.

    errors: by ridge; alpha: the ridge that the moments chose, one of them. Else it is the largest that is nearly as
    good as the best; where no run predicts what follows, that of the moments.
    """
    least = min(errors.values())
    if not least < TOLD or errors[alpha] <= PLAIN * least:
        return alpha
    return max(ridge for ridge, error in errors.items() if error <= PLAIN * least)


def _settings(search: Search, shape: Shape, step: Callable[[], None]
              ) -> tuple[dict[str, Any], Shape, list[tuple[str, str]]]:
    """Choose what the moments cannot tell by runs of the identifier itself.

    Return all values, the shape among them (that of a refinement may be another one), and the reasons.
    """
    memory = max(0.5, 1.0 - FORGOTTEN * shape.factor / search.count)
    alpha = _prior(search, shape)
    plain: dict[str, Any] = {
        **_values(shape), 'forgetting': 'innovation', 'forgetting_factor': (1.0,) * 3, 'regularization': (alpha,) * 3,
        'refinement': 'none', **search.given}
    errors = {alpha: _identified_error(search, plain)}
    step()
    is_free = 'regularization' not in search.given and plain['refinement'] == 'none'  # a refined model takes long
    for ridge in RIDGES if is_free else ():
        if ridge != alpha:
            errors[ridge] = _identified_error(search, {**plain, 'regularization': (ridge,) * 3})
        step()
    chosen = _ridge(errors, alpha)
    if chosen != alpha:
        plain['regularization'] = (chosen,) * 3
    is_set = 'forgetting' in search.given
    trials: list[tuple[str, float, dict[str, Any]]] = [
        ('forgetting_factor 0.99' if is_set else 'forgetting where the model ceases to fit', PLAIN,
         {'forgetting_factor': (0.99,) * 3}),
        (f'forgetting beyond {search.count * search.dt / FORGOTTEN:.3g} s', PLAIN,
         {'forgetting': 'constant', 'forgetting_factor': (memory,) * 3})]
    r, m = search.r, search.m
    light = [s for s in search.tried  # fits of more parameters would take most of the time
             if s.order * (s.order + r + 2 * m + 1) + m * r <= recursive_fit.USUAL]
    own = shape_search.smallest({s: search.tried[s] for s in light}) if light else None
    refined = own is not None and search.tried[own] < NEARLY * search.tried[shape]
    if own is not None and refined:
        # one of a smaller order needs no gain: each state that the signals do not need is a mode that is not there
        gain = REFINED if own.order >= shape.order else 1.0
        trials += [(f'{kind} of order {own.order}', gain, {**_values(own), 'refinement': kind})
                   for kind in ('output_error', 'prediction_error') if search.given.get('refinement', kind) == kind]
    words = 'no forgetting' if plain['forgetting_factor'][0] == 1.0 else 'forgetting as it is set'
    settled, name, least = plain, words, errors[chosen]
    told = [f'{words} {_percent(least)}']
    for words, gain, trial in trials:
        values = {**plain, **trial, **search.given}
        error = np.inf
        if values != plain:
            error = _identified_error(search, values)
            told.append(f'{words} {_percent(error)}')
        if error * gain < least:
            settled, name, least = values, words, error
        step()
    beside = '' if refined else '; no refinement, which needs a smaller order than these signals do'
    if least > TOLD:
        beside += '; what was learned hardly holds later: record every kind of motion, several times'
    tried = sorted((PRIOR, *PRIORS))
    why = 'given' if 'regularization' in search.given else (
        f'best of {", ".join(f"{value:g}" for value in tried)} by the same error' if chosen == alpha else
        f'run through the recording, {", ".join(f"{value:g} {_percent(errors[value])}" for value in sorted(errors))}')
    is_own = own is not None and all(settled[name] == value for name, value in _values(own).items())
    return settled, own if own is not None and is_own else shape, [
        ('forgetting, refinement', f'{name}: run through the recording, unexplained {search.horizon_s:g} s ahead with '
                                   f'{", ".join(told)}{beside}'),
        ('regularization', f'{settled["regularization"][0]:g}: {why}')]


def _values(shape: Shape) -> dict[str, Any]:
    return {'decimation': shape.factor, 'order': shape.order, 'past_window': shape.past,
            'future_window': shape.future, 'direct_feedthrough': shape.direct,
            'weighted_observability': shape.weighted}


def _identified_error(search: Search, values: Mapping[str, Any]) -> float:
    """Return the loss, over all outputs, of the identifier's predictions ahead on the later parts of the recording.

    It runs through the recording once; the model of the first half predicts the fourth sixth, and so on.
    """
    config = configure(IdentifierParameters, values)
    raw = np.vstack([part.raw for part in search.stretches])
    gap = np.zeros(search.count, dtype=np.bool_)
    gap[[part.first for part in search.stretches[1:]]] = True
    stamps = (np.arange(search.count) * round(search.dt * 1e9)).astype(np.int64)
    log = log_of(raw[:, :search.r], raw[:, search.r:], stamp_ns=stamps, gap=gap)
    kept, number = search.kept(config.decimation), np.arange(search.count)
    state, powers = rpbsid.init(config)._replace(held=None), np.zeros((2, search.m))
    borders = [0, *(search.count * part // PARTS for part in range(PARTS // 2, PARTS + 1))]
    for before, now, later in zip(borders, borders[1:], borders[2:], strict=False):
        state = rpbsid.advance(config, state, log.rows(before, now))
        found = rpbsid.identified(config, rpbsid.finish(state), search.dt)
        if found is None:
            return np.inf
        powers += shape_search.powers(search, found.model, kept, config.decimation, config.past_window,
                          (number >= now) & (number < later), found.constant)
    return shape_search.loss(powers)
