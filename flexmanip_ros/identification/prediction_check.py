"""Whether a model predicts: 0.25 s ahead, over the last second, against the sensors' noise, with the right frequencies.

A model that is wrong leaves residuals which it takes for its noise, so it must not be judged against them. White noise
of a sensor shows in fourth differences, whatever the model. A frequency that is a few percent off costs such a
prediction little, so the frequencies are asked for by themselves (``frequency_errors``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy  # its parts are loaded where they are first used
from numba import njit
from numpy.typing import NDArray

from flexmanip_ros.identification.uncertainty import REAL, Identified, modes
from flexmanip_ros.identification.validation import simulate
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.types import Array, Mode, StateSpace, Status

Complex = NDArray[np.complex128]

AHEAD_S = 0.25
"""How far ahead predictions are judged [s]; in the first 0.75 s after an event a third of that time."""
LAST_S = 1.5
"""Time over which they are judged [s], with that of the first state."""
INSTANTS = 10
"""Predictions start every ``horizon / INSTANTS`` samples."""
STRETCHES = 6
"""Stretches in that time, at least, whose frequencies are compared."""
MOST_ROWS = 4096
MISSED = 0.5
"""Share of an output's power that predictions may miss."""
SILENT = 10.0
"""Power of an output, in units of its white noise, below which it says nothing."""
FOURTH = 0.6744897501960817 * math.sqrt(70.0)
"""Median of the absolute fourth differences of white noise, in standard deviations."""

MEDIAN_SPREAD = 2.9
"""Relative standard deviation of ``white_noise`` from N samples of white noise, times the root of N."""
CHANCE = 4.0
"""Of these deviations by which residuals may exceed the white noise before the model is taken to miss something."""
OFF, VAGUE = 0.02, 0.01
"""Relative error of a frequency that the last samples may show, and its relative standard deviation."""
UNSHOWN = 0.1
"""Half 95 % interval of that error beyond which the samples do not show the frequency. It was at most 0.066 in 4762
readings of right models, and 0.21 to 0.41 for a mode that was not there."""
EARLY = 4096
"""Samples before which a model whose modes are not known so well is still warming up."""
DAMPED = 0.3
"""Damping ratio above which a mode has no frequency worth a verdict."""
LOOSE = 0.1
"""Standard deviation of a damping ratio beyond which the mode is not known. It was 0.01 to 0.06 for the damped mode of
the measured ist_arm after the first second, and 0.106 to 0.29 for modes that were not there."""
MOST_MODES = 4
"""The lowest ones are judged."""
MOST_SKEW = 1e8
"""Condition of the eigenvectors of an A that is as good as defective."""
TWO_SIDED = 0.975
"""Student's t lies between this quantile and its negative in 95 %."""


def length(dt: float) -> int:
    """Return the number of samples that are looked at. dt: sample time [s]."""
    return min(math.ceil(LAST_S / max(dt, 1e-9)), MOST_ROWS)


def white_noise(Y: Array) -> Array:
    """(m,) variance of the white noise in Y (N, m), N > 4, by the median of fourth differences."""
    found: Array = (np.median(np.abs(np.diff(Y, 4, axis=0)), axis=0) / FOURTH) ** 2
    return found


def free_motion(model: StateSpace, count: int) -> Array:
    """(count, m, n) C A^k."""
    free, ahead = model.C[None], model.A
    while len(free) < count:  # twice as many each time
        free, ahead = np.concatenate([free, free @ ahead]), ahead @ ahead
    return free[:count]


def missed(model: StateSpace, U: Array, Y: Array, horizon: int, seen: NDArray[np.bool_] | None = None) -> Array:
    """(m,) share of the power of Y (N, m) that predictions ``horizon`` samples ahead miss.

    Each begins at the state that fits as many samples before it, outputs at unit power; no output after that is used.
    seen: (N,) rows that were measured, all of them by default. nan where an output is silent.
    """
    n, m = model.order, model.C.shape[0]
    before = max(horizon, 2 * n)
    free = free_motion(model, before + horizon)
    power, white = np.var(Y, axis=0), white_noise(Y)
    unit = 1.0 / np.sqrt(np.where(power > 0.0, power, 1.0))
    free = free * unit[:, None]
    left = (Y - simulate(model, U)) * unit  # a free motion of the model, as far as it is right
    if not np.all(np.isfinite(free)) or not np.all(np.isfinite(left)):  # a model that runs away
        return np.full(m, np.inf)
    known = np.ones(len(Y), dtype=np.bool_) if seen is None else seen
    back = np.linalg.pinv(free[:before].reshape(-1, n), rcond=1e-9)
    errors = []
    for first in range(before, len(Y) - horizon + 1, max(1, horizon // INSTANTS)):
        used, at = known[first - before:first], first + horizon - 1
        if not known[at] or np.count_nonzero(used) < before // 2:
            continue
        y = left[first - before:first]
        x = back @ y.ravel() if used.all() else np.linalg.lstsq(
            free[:before][used].reshape(-1, n), y[used].ravel(), rcond=1e-9)[0]
        errors.append((left[at] - free[-1] @ x) ** 2)
    if not errors:
        return np.full(m, np.nan)
    return np.where(power > SILENT * white, np.mean(errors, axis=0), np.nan)


@njit(cache=True, nogil=True)
def swing(poles: Complex, turns: Complex, gains: Complex, U: Array, Z: Complex, S: Complex) -> None:
    """Run modes z+ = pole z + gain u from rest over U (N, r), and their derivatives S = dz by ln(pole) = turn.

    poles, turns: (n,), gains: (n, r), Z, S: (N, n).
    """
    for i in range(poles.size):
        z, s = 0j, 0j
        for k in range(U.shape[0]):
            Z[k, i], S[k, i] = z, s
            s = poles[i] * (s + turns[i] * z)
            z = poles[i] * z
            for j in range(U.shape[1]):
                z += gains[i, j] * U[k, j]


def frequency_errors(model: StateSpace, U: Array, Y: Array, horizon: int, seen: NDArray[np.bool_] | None = None
                     ) -> tuple[Array, Array]:
    """Relative errors (g,) of the model's lowest frequencies that the samples show, and half their 95 % intervals.

    One Gauss-Newton step from the model's own frequencies (Rao's score over its information) on stretches of
    ``horizon`` samples of Y (N, m), outputs at unit power; the state at the begin of each is free. The deviations are
    White's sandwich: from the scatter of the scores of the stretches, of which Student's t allows for there being few.
    Empty where there is no mode, nan where there are too few stretches. seen: as in ``missed``.
    """
    values, right = np.linalg.eig(model.A + 0j)
    logs = np.log(np.where(values == 0.0, 1e-300, values))
    swings = (logs.imag > REAL) & (-logs.real < DAMPED * np.abs(logs))
    chosen = sorted(np.flatnonzero(swings), key=lambda k: float(logs[k].imag))[:MOST_MODES]
    g, n = len(chosen), model.order
    if not g or not np.linalg.cond(right) < MOST_SKEW:
        return np.zeros(0), np.zeros(0)
    left, power = np.linalg.inv(right), np.var(Y, axis=0)
    unit = 1.0 / np.sqrt(np.where(power > 0.0, power, 1.0))
    shape, turns = (model.C @ right) * unit[:, None], 1j * logs.imag
    Z, S = np.empty((2, len(Y), n), dtype=np.complex128)
    swing(values, turns, left @ (model.B + 0j), np.ascontiguousarray(U), Z, S)
    rest = (Y - U @ model.D.T) * unit - np.real(Z @ shape.T)
    forced = 2.0 * np.real(S[:, None, chosen] * shape[:, chosen])  # (N, m, g)
    steps = np.arange(horizon)[:, None]
    moving = shape * (values ** steps)[:, None, :]  # (horizon, m, n)
    free = np.real(moving @ left)
    turned = 2.0 * np.real(((steps * turns)[:, None, :] * moving)[..., chosen, None] * left[chosen])
    if not np.all(np.isfinite(rest)) or not np.all(np.isfinite(free)):
        return np.full(g, np.nan), np.full(g, np.nan)
    whole = np.linalg.svd(free.reshape(-1, n), full_matrices=False)
    known = np.ones(len(Y), dtype=np.bool_) if seen is None else seen
    scores, informations = [], []
    for first in range(len(Y) % horizon, len(Y) - horizon + 1, horizon):
        at = slice(first, first + horizon)
        used = known[at]
        if np.count_nonzero(used) < max(horizon // 2, n):
            continue
        basis, size, back = whole if used.all() else np.linalg.svd(free[used].reshape(-1, n), full_matrices=False)
        kept = size > 1e-9 * size[0]
        basis, error = basis[:, kept], rest[at][used].ravel()
        x = back[kept].T @ ((basis.T @ error) / size[kept])
        slope = (forced[at] + turned @ x)[used].reshape(-1, g)
        error, slope = error - basis @ (basis.T @ error), slope - basis @ (basis.T @ slope)
        scores.append(slope.T @ error)
        informations.append(slope.T @ slope)
    if len(scores) < 3:
        return np.full(g, np.nan), np.full(g, np.nan)
    inverse = np.linalg.pinv(np.sum(informations, axis=0))
    step = inverse @ np.sum(scores, axis=0)
    scatter = np.array([score - information @ step for score, information in zip(scores, informations, strict=True)])
    root = scatter @ inverse
    deviation = np.sqrt(np.sum(root ** 2, axis=0) * len(scores) / (len(scores) - 1))
    return step, float(scipy.special.stdtrit(len(scores) - 1, TWO_SIDED)) * deviation


def unfitted(model: StateSpace, U: Array, Y: Array, seen: NDArray[np.bool_]) -> float:
    """Share of the amplitude of Y (N, m) that the model leaves beyond white noise, the first state being free.

    In the mean over the outputs that say something; 0 where it may be chance. seen: as in ``missed``.
    """
    power, white = np.var(Y, axis=0), white_noise(Y)
    heard = power > SILENT * white
    unit = 1.0 / np.sqrt(np.where(power > 0.0, power, 1.0))
    free = (free_motion(model, len(Y)) * unit[:, None])[seen]
    left = ((Y - simulate(model, U)) * unit)[seen]
    if not heard.any() or not np.all(np.isfinite(free)) or not np.all(np.isfinite(left)):
        return math.inf if heard.any() else 0.0
    x = np.linalg.lstsq(free.reshape(-1, model.order), left.ravel(), rcond=1e-9)[0]
    rest = np.mean((left - free @ x) ** 2, axis=0)[heard]
    noise = (white * unit ** 2)[heard]
    beyond = rest > (1.0 + CHANCE * MEDIAN_SPREAD / math.sqrt(len(left))) * noise
    return math.sqrt(float(np.mean(np.where(beyond, rest - noise, 0.0))))


def widened(found: Identified, share: float) -> Identified:
    """Return the model with what errors of its poles explain of a share of the amplitude that it leaves.

    A pole that is off by d [rad a sample] turns or swells the motion by d k in k samples, in the mean over N samples by
    d N / sqrt(3) (root of the mean square).
    """
    A = found.model.A
    values, right = np.linalg.eig(A)
    if share == 0.0 or not found.samples > 0.0 or not found.spread.size or not np.linalg.cond(right) < MOST_SKEW:
        return found
    left, off = np.linalg.inv(right), math.sqrt(3.0) * share / found.samples
    more = np.zeros((len(found.spread), 2 * np.count_nonzero(values.imag > 0.0)))
    for column, k in enumerate(np.flatnonzero(values.imag > 0.0)):
        turn = 2.0 * off * values[k] * np.outer(right[:, k], left[k])
        more[:A.size, 2 * column:2 * column + 2] = np.column_stack([(1j * turn).real.ravel(), turn.real.ravel()])
    return found._replace(spread=np.hstack([found.spread, more]))


def is_vague(oscillations: Sequence[Mode]) -> bool:
    """Whether the frequency of a low light mode, or the damping ratio of any low mode, is not known well enough.

    A damped mode may have an uncertain frequency, not an uncertain damping ratio: a mode that the samples do not hold
    may drift above DAMPED as well.
    """
    light = [mode for mode in oscillations if abs(mode.damping_ratio) < DAMPED][:MOST_MODES]
    return (any(mode.frequency_std_hz > VAGUE * mode.frequency_hz for mode in light)
            or any(mode.damping_ratio_std > LOOSE for mode in oscillations[:MOST_MODES]))


def judged(found: Identified, rows: Rows, outputs: tuple[str, ...]) -> Identified:
    """Return the model with what its predictions of the last samples are worth; outputs: their names.

    INCONSISTENT where they miss too much of the outputs in the mean, or where the last samples show another frequency;
    ORDER_TOO_LOW where they miss one output while the others are predicted; POORLY_EXCITED, at first WARMING_UP, where
    a mode of a model of one configuration is not known well enough, or the last samples do not show its frequency.
    Rates count in the mean alone where there are others: they ring with modes above the order, which displacements
    hardly show, so that right models of the first modes would be refused.
    A model of one configuration has its deviations widened by what it leaves of the samples, as nothing else tells how
    far a fit of two periods, or an arm that turns, leads it astray.
    """
    if found.status is not Status.TRACKING:
        return found
    gaps = np.flatnonzero(rows.gap[1:])
    if gaps.size:  # predictions cannot go over unknown torques
        rows = rows.between(rows.first + 1 + int(gaps[-1]), rows.until)
    rates = np.array([name.endswith('/velocity') for name in outputs])
    chosen = ~rates | rates.all()
    model = replace(found.model, C=found.model.C[chosen], D=found.model.D[chosen])
    seen = rows.missing == 0
    unknown = Status.WARMING_UP if found.samples < EARLY else Status.POORLY_EXCITED
    if found.configurations is None:  # that of every configuration has rules of its own
        last = slice(max(0, len(rows) - round(found.samples)), None)
        if len(seen[last]) > STRETCHES * model.order:
            with np.errstate(over='ignore', invalid='ignore'):
                share = unfitted(model, rows.u[last], rows.y[last][:, chosen], seen[last])
            if not math.isfinite(share):
                return found._replace(status=Status.INCONSISTENT)
            found = widened(found, share)
        if is_vague(modes(found)):
            return found._replace(status=unknown)
    dt = found.model.dt
    stretch = max(2, min(round(AHEAD_S / dt), len(rows) // STRETCHES))
    horizon = max(2, min(round(AHEAD_S / dt), len(rows) // 3))
    if 3 * len(rows) < length(dt) or len(rows) < STRETCHES * max(stretch, found.model.order):
        return found
    with np.errstate(over='ignore', invalid='ignore'):
        shares = missed(found.model, rows.u, rows.y, horizon, seen)
    heard = shares[~np.isnan(shares)]
    if heard.size and float(heard.mean()) > MISSED:
        return found._replace(status=Status.INCONSISTENT)
    if np.any(shares[chosen] > MISSED):
        return found._replace(status=Status.ORDER_TOO_LOW)
    with np.errstate(over='ignore', invalid='ignore'):
        error, chance = frequency_errors(model, rows.u, rows.y[:, chosen], stretch, seen)
    if np.any(np.abs(error) - chance > OFF):
        return found._replace(status=Status.INCONSISTENT)
    if found.configurations is None and np.any(chance > UNSHOWN):
        return found._replace(status=unknown)
    return found
