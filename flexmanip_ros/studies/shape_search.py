"""Choice of decimation, windows, order and direct term by cross-validation on a recording.

For each decimation and past window, the moments of each fold of the recording are gathered in one triangular factor.
The models of every order, future window and direct term are computed from sums of these factors: a model of the other
folds predicts a fold a given time ahead.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.identification import decimation, validation
from flexmanip_ros.identification.model_output import at_unit_power, in_units
from flexmanip_ros.identification.moments import realize_orders, triangle
from flexmanip_ros.samples.sample_log import Signals
from flexmanip_ros.types import Array, StateSpace

DECIMATIONS = (1, 2, 3, 5, 10, 20, 50, 100)
WINDOWS_S = (0.05, 0.1, 0.2, 0.3, 0.5)
"""Lengths of the past window that are tried [s]; windows of ``WINDOWS`` samples are tried too."""
WINDOWS = (6, 10, 20)
ORDERS = tuple(range(2, 17))
COARSE = (4, 6, 8, 10, 12, 16)
"""Orders of the first pass."""
FINALISTS = 3
"""Number of pairs of decimation and past window that the second pass tries with all orders."""
FOLDS, BLOCKS = 4, 12
"""Numbers of folds and blocks. The blocks of a recording go to the folds in turn: each has every kind of motion."""
STEPS = 4
"""Least number of steps of the model in the horizon: a model of a lower rate predicts nothing."""
ROWS = 2.0
"""Least number of training samples for each element of the regressor; a window with fewer is not tried."""
WORK = 2.5e7
"""Largest product of squared length of the regressor and rate [1/s] for a live node: it takes 15 % of a core."""
LONGEST = 300
"""Largest length of the regressor: beyond it the factor takes minutes."""
MARGIN = 1.03
"""Largest ratio of error to least error that is accepted: the smallest order within it is chosen."""
PRIOR = 1e-3
"""Ridge parameter of the regression, for signals of unit peak."""
BRIDGED_S = 0.02
"""Longest gap in the samples that is interpolated, in the search alone [s]."""
WORST = 1e9
"""Unexplained share that stands for a model whose prediction diverges."""
WARM = 5
"""Number of past windows that a predictor runs before the samples it is scored on: its state has settled then."""
CHUNK = 4096
"""Number of regressors that are formed at once."""
Progress = Callable[[int, int | None], None]
Kept = tuple[Array, NDArray[np.int64]]


class Shape(NamedTuple):
    """The parameters chosen on moments: decimation factor, past and future window, direct term, weighting, order."""

    factor: int
    past: int
    future: int
    direct: bool
    weighted: bool
    order: int


class Stretch(NamedTuple):
    """Samples without a gap: raw (N, r + m) at unit peak, number of the first one in the recording."""

    raw: Array
    first: int


@dataclass
class Search:
    """The recording, the parameters that are given, and the shapes tried so far."""

    given: Mapping[str, Any]
    stretches: list[Stretch]
    r: int
    m: int
    dt: float
    horizon_s: float
    tried: dict[Shape, float] = field(default_factory=dict)
    """Loss of each shape, errors and powers summed over the folds."""

    @property
    def count(self) -> int:
        """Number of samples."""
        return sum(len(part.raw) for part in self.stretches)

    @property
    def fold(self) -> NDArray[np.int64]:
        """Fold (N,) that each sample belongs to."""
        return np.arange(self.count) * BLOCKS // self.count % FOLDS

    def kept(self, factor: int) -> list[Kept]:
        """Return the samples (k, r + m) of each stretch that a decimation keeps, and the row (k,) each describes."""
        return [decimation.whole(part.raw, factor) for part in self.stretches]

    def best(self, **fixed: object) -> Shape:
        """Return the shape of the least loss, among those with the given parts."""
        kept = [s for s in self.tried if all(getattr(s, name) == value for name, value in fixed.items())]
        return min(kept, key=lambda s: (self.tried[s], s))


def search_shapes(search: Search, runs: Sequence[tuple[int, int]], step: Callable[[], None]) -> Shape:
    """Try every shape that is not given; return the smallest order that is nearly as good as the best.

    runs: ``plan`` of the search; ``step`` is called that many times, and ``FINALISTS`` times.
    Raises ParameterError when the recording is too short for any model, or none can be computed from it.
    """
    if not runs:
        raise ParameterError(f'{search.count} samples without a gap are too few to choose parameters from',
                             'record for longer, or set the parameters by hand')
    for factor, past in runs:
        _try(search, factor, past, _futures(search, past)[:1], (True,), _orders(search, COARSE))
        step()
    if not search.tried:
        raise ParameterError(f'no model of these {search.count} samples can be computed and scored',
                             'record for longer; check that every input and output moves')
    ranked = sorted(search.tried, key=lambda s: (search.tried[s], s))
    for factor, past in list(dict.fromkeys((s.factor, s.past) for s in ranked))[:FINALISTS]:
        _try(search, factor, past, _futures(search, past)[1:], (True, False), _orders(search, ORDERS))
        step()
    return smallest(search.tried)


def smallest(tried: Mapping[Shape, float]) -> Shape:
    """Return the shape of the smallest order that is nearly as good as the best; tried: the loss of each shape."""
    least = min(tried.values())
    good = [s for s in tried if tried[s] <= MARGIN * least]
    return min(good, key=lambda s: (s.order, tried[s], s))


def stretches_of(signals: Signals, dt: float) -> list[Stretch]:
    """Return the samples between gaps at unit peak, short gaps bridged."""
    stamps = signals.stamp_ns * 1e-9
    joint = np.hstack([signals.u, signals.y])
    peak = np.max(np.abs(joint), axis=0, initial=0.0)
    joint = joint / np.where(peak > 0.0, peak, 1.0)
    wide = np.flatnonzero(signals.gap & (np.diff(stamps, prepend=stamps[:1]) > BRIDGED_S + 1.5 * dt))
    found, first = [], 0
    for a, b in pairwise([0, *wide[wide > 0].tolist(), len(joint)]):
        part = joint[a:b]
        if signals.gap[a + 1:b].any():
            at = np.arange(stamps[a], stamps[b - 1] + 0.5 * dt, dt)
            part = np.column_stack([np.interp(at, stamps[a:b], column) for column in part.T])
        found.append(Stretch(part, first))
        first += len(part)
    return found


def plan(search: Search) -> list[tuple[int, int]]:
    """Return the pairs of decimation and past window to try, the largest decimation first: its fits cost least."""
    width, runs = search.r + search.m, []
    for factor in _choices(search.given, 'decimation', DECIMATIONS):
        dt = factor * search.dt
        if 'decimation' not in search.given and factor > 1 and dt * STEPS > search.horizon_s:
            continue
        kept = sum(max(0, len(part.raw) // factor - decimation.TAPS) for part in search.stretches)
        most = min(LONGEST, (WORK * dt) ** 0.5, kept * (FOLDS - 1) / FOLDS / ROWS)
        windows = {max(1, round(window / dt)) for window in WINDOWS_S} | set(WINDOWS)
        for past in _choices(search.given, 'past_window', sorted(windows)):
            least = -(-min(_orders(search, COARSE)) // search.m)
            if past >= max(least, search.given.get('future_window', 1)) and (
                    (past + 1) * width <= most or 'past_window' in search.given) and past <= 200:
                runs.append((factor, past))
    return runs[::-1]


def _choices(given: Mapping[str, Any], name: str, otherwise: Sequence[Any]) -> tuple[Any, ...]:
    return (given[name],) if name in given else tuple(otherwise)


def _orders(search: Search, otherwise: Sequence[int]) -> tuple[int, ...]:
    return _choices(search.given, 'order', otherwise)


def _futures(search: Search, past: int) -> tuple[int, ...]:
    """Return the future window of the first pass, then those of the second."""
    enough = min(past, -(-max(_orders(search, ORDERS)) // search.m))
    fine = (max(min(past, 10), enough), max(past // 2, enough), past)
    if 'future_window' in search.given:
        return (search.given['future_window'],) * 2
    return min(past, 30), *dict.fromkeys(fine)


def _try(search: Search, factor: int, past: int, futures: Sequence[int], switches: Sequence[bool],
         orders: Sequence[int]) -> None:
    """Identify on the other folds and predict each fold. switches: values of direct term and weighting to try."""
    directs = _choices(search.given, 'direct_feedthrough', switches)
    weights = _choices(search.given, 'weighted_observability', switches)
    kept = search.kept(factor)
    sums = moments(search, kept, past)
    for future in futures:
        able = [n for n in orders if n <= future * search.m]
        for direct, weighted in product(directs, weights):
            shape = Shape(factor, past, future, direct, weighted, 0)
            found = losses(search, kept, sums, shape, able, PRIOR)
            search.tried.update({shape._replace(order=n): value for n, value in found.items()})


def losses(search: Search, kept: list[Kept], sums: list[Array], shape: Shape, orders: Sequence[int], alpha: float
           ) -> dict[int, float]:
    """Return the loss of each order for which every fold has a model, and every output varies where it is scored."""
    d = shape.past * (search.r + search.m)
    prior = np.zeros((d, d + search.r + search.m))
    prior[:, :d] = alpha ** 0.5 * np.eye(d)
    found: dict[int, list[Array]] = {n: [] for n in orders}
    for fold in range(FOLDS):
        R = triangle(np.vstack([prior, *(sums[k] for k in range(FOLDS) if k != fold)]))
        for n, model in zip(orders, _models(R, search, orders, shape), strict=True):
            if model is not None:
                found[n].append(powers(search, model, kept, shape.factor, shape.past, search.fold == fold))
    totals = {n: np.sum(parts, axis=0) for n, parts in found.items() if len(parts) == FOLDS}
    return {n: loss(total) for n, total in totals.items() if np.all(total[1] > 0.0)}


def moments(search: Search, kept: list[Kept], past: int) -> list[Array]:
    """Return the factor of the moments of [z; u; y] of each fold."""
    sums, folds = [], search.fold
    for fold in range(FOLDS):
        R = np.zeros((0, (past + 1) * (search.r + search.m)))
        for (samples, rows), part in zip(kept, search.stretches, strict=True):
            ends = np.flatnonzero(folds[part.first + rows] == fold)
            ends = ends[ends >= past]
            for some in np.array_split(ends, len(ends) // CHUNK + 1):
                if len(some):
                    phi = np.hstack([samples[some - past + i] for i in range(past + 1)])
                    R = triangle(np.vstack([R, phi]))
        sums.append(R)
    return sums


def _models(R: Array, search: Search, orders: Sequence[int], shape: Shape) -> list[StateSpace | None]:
    """Return the model of each order, in the units of the stretches."""
    R, unit = at_unit_power(R, search.r + search.m)
    try:
        found = realize_orders(R, search.r, search.m, orders, shape.future,
                               feedthrough=shape.direct, weighted=shape.weighted, riccati=True)
    except np.linalg.LinAlgError:
        return [None] * len(orders)
    su, sy = unit[:search.r], unit[search.r:]
    return [None if part is None else StateSpace(
        *in_units(part.A, part.B, part.C, part.D, part.K, su, sy), shape.factor * search.dt) for part in found]


def powers(search: Search, model: StateSpace, kept: list[Kept], factor: int, past: int,
            chosen: NDArray[np.bool_], constant: Array | None = None) -> Array:
    """Return variances (2, m): of the error of the prediction ahead at the samples chosen (N,), and of the samples.

    constant: (n,) of the model, see ``Identified``. A model with K = 0 learns no state from the outputs on the way: its
    first state is the one that fits the samples before best.
    """
    steps = max(1, round(search.horizon_s / model.dt)) + (decimation.LAG if factor > 1 else 0)
    targets, errors = [np.empty((0, search.m))], [np.empty((0, search.m))]
    with np.errstate(all='ignore'):
        for (samples, rows), part in zip(kept, search.stretches, strict=True):
            inside = np.concatenate([[False], chosen[part.first + rows], [False]])
            borders = np.flatnonzero(inside[1:] != inside[:-1]).tolist()
            for first, end in zip(borders[::2], borders[1::2], strict=True):  # runs of samples that are chosen
                begin = max(0, first - steps - WARM * past)
                some = samples[begin:end]
                at = np.arange(max(first, begin + steps - 1 + past), end)
                if not len(at):
                    continue
                whole, U = validation.affine(model, constant, samples[:end, :search.r])
                x0 = None if model.K.any() else validation.state_at_end(whole, U[:begin], samples[:begin, search.r:])
                ahead = validation.predict_ahead(whole, U[begin:], some[:, search.r:], steps, x0)
                target = part.raw[rows[at], search.r:]
                targets.append(target)
                errors.append(target - ahead[at - begin - steps + 1])
        joint = np.vstack(targets)
        if len(joint) < 2:
            return np.zeros((2, search.m))
        spread = np.var(joint, axis=0)
        left = np.var(np.vstack(errors), axis=0)
    return np.array([np.where(np.isfinite(left), left, np.inf), spread])


def loss(powers: Array) -> float:
    """Return the mean of log(1 + share) over the outputs that vary; one wild output does not hide the rest.

    powers: (2, m) variances of error and output, whose ratio is the share left unexplained. The mean is close to that
    of small shares.
    """
    left, spread = powers
    share = np.divide(left, spread, out=np.full(len(left), np.nan), where=spread > 0.0)
    return float(np.nanmean(np.log1p(np.minimum(share, WORST))))
