"""Check of a model by predictions 0.25 s ahead over the last second, and by its frequencies in the same samples.

A wrong model has a large innovation covariance, so its residuals are not compared with that but with the sensors' white
noise. The fourth differences of an output give this noise without a model. A frequency error of a few percent changes a
prediction 0.25 s ahead little, so the frequencies have a test of their own (``frequency_errors``).
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy  # its submodules are imported at first use
from numpy.typing import NDArray

from flexmanip_ros.identification.uncertainty import REAL, Identified, modes
from flexmanip_ros.identification.validation import affine, simulate
from flexmanip_ros.numerics.compiled import library
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.types import QUANTILE, Array, Mode, StateSpace, Status

Complex = NDArray[np.complex128]

AHEAD_S = 0.25
"""Prediction horizon [s]. In the first 0.75 s after an event the horizon is a third of the time since the event."""
LAST_S = 1.5
"""Time of the latest samples on which a model is judged [s], that for the first state of the predictions included."""
INSTANTS = 10
"""Number of predictions that start within one horizon: one every ``horizon / INSTANTS`` samples."""
STRETCHES = 6
"""Least number of stretches into which ``frequency_errors`` divides the latest samples."""
MOST_ROWS = 4096
MISSED, MISSED_OF_RATE = 0.5, 0.65
"""Largest share of the power that predictions may miss: of an output, and of a rate beside displacements. Rates contain
modes above the order; right models of the default run miss 0.52 of one. With 0.65, 0.5 % of all readings are TRACKING
though their predictions miss half of an output; without a bound 1 % are."""
SILENT = 10.0
"""Power of an output, in units of its white noise, below which the output is silent: it does not count."""
FOURTH = 0.6744897501960817 * math.sqrt(70.0)
"""Median of the absolute fourth differences of white noise, in standard deviations of the noise."""

MEDIAN_SPREAD = 3.2
"""Relative standard deviation of ``white_noise`` from N samples of white noise, times the root of N."""
CHANCE = 4.0
"""Number of standard deviations that count as chance: by which the power of the residuals exceeds that of the white
noise (``MEDIAN_SPREAD``), and by which a damping ratio is below zero."""
OFF, VAGUE = 0.02, 0.01
"""Largest relative error of a frequency beyond its 95 % interval, and largest relative standard deviation of one."""
UNSHOWN = 0.1
"""Half 95 % interval of a relative frequency error above which the samples do not show the frequency. It was at most
0.066 in 4762 readings of right models, and 0.21 to 0.41 for a mode that the plant did not have."""
EARLY_S = 4.0
"""Time learned since the last event [s] below which an uncertain mode means WARMING_UP, not POORLY_EXCITED: 22 periods
of the default arm's first mode. An arm at rest teaches nothing. It is a time, as a slow sensor tells no more about a
mode in as many samples."""
DAMPED = 0.3
"""Damping ratio above which the frequency of a mode is not judged."""
LOOSE = 0.1
"""Largest standard deviation of the damping ratio of a known mode. It was 0.01 to 0.06 for the damped mode of the
measured ist_arm after the first second, and 0.106 to 0.29 for modes that the plant did not have."""
MOST_TURN = 0.2
"""Largest range of the angle between the links since the last event, vibration included, in which a model of one
configuration may hold [rad]. Half of it changes a frequency of two links by up to 1 %; encoders swing by the rest."""
PER_RAD = 0.1
"""Relative change of a frequency with the angle between the links [1/rad], root mean square over all angles. The second
frequency of the default arm has 0.093 empty and 0.135 with 60 kg; both frequencies of 34 random arms 0.06 to 0.08."""
MOST_MODES = 4
"""Number of modes that are judged, from the lowest frequency on."""
MOST_SKEW = 1e8
"""Condition number of the eigenvectors of A above which A counts as defective."""
TWO_SIDED = 0.975
"""Probability of the upper quantile of Student's t that bounds a two-sided 95 % interval."""


def length(dt: float, order: int = 0) -> int:
    """Return the number of latest samples on which a model is judged: those of 1.5 s, or as many as the order needs.

    dt: sample time [s].
    """
    return max(min(math.ceil(LAST_S / max(dt, 1e-9)), MOST_ROWS), STRETCHES * order)


def white_noise(Y: Array) -> Array:
    """(m,) variance of the white noise in Y (N, m), N > 4, from the median of absolute fourth differences."""
    return np.asarray((np.median(np.abs(np.diff(Y, 4, axis=0)), axis=0) / FOURTH) ** 2)


def to_unit(power: Array) -> Array:
    """(m,) factors that bring outputs of this power (m,) to unit power; 1 for an output of none."""
    return np.asarray(1.0 / np.sqrt(np.where(power > 0.0, power, 1.0)))


def free_motion(model: StateSpace, count: int) -> Array:
    """(count, m, n) C A^k, k = 0 to count - 1."""
    free, ahead = model.C[None], model.A
    while len(free) < count:  # doubles the number of powers
        free, ahead = np.concatenate([free, free @ ahead]), ahead @ ahead
    return free[:count]


def missed(model: StateSpace, U: Array, Y: Array, horizon: int, seen: NDArray[np.bool_]) -> Array:
    """(m,) share of the power of Y (N, m) that predictions ``horizon`` samples ahead miss.

    Each prediction starts from the state that fits the ``horizon`` samples (at least 2 n) before it best, with outputs
    scaled to unit power; it uses no later output. seen: (N,) rows that were measured. nan where an output is silent
    (``SILENT``).
    """
    n, m = model.order, model.C.shape[0]
    before = max(horizon, 2 * n)
    free = free_motion(model, before + horizon)
    power, white = np.var(Y, axis=0), white_noise(Y)
    unit = to_unit(power)
    free = free * unit[:, None]
    left = (Y - simulate(model, U)) * unit  # of a right model: its free motion and noise
    if not np.all(np.isfinite(free)) or not np.all(np.isfinite(left)):  # a model that diverges
        return np.full(m, np.inf)
    back = np.linalg.pinv(free[:before].reshape(-1, n), rcond=1e-9)
    errors = []
    for first in range(before, len(Y) - horizon + 1, max(1, horizon // INSTANTS)):
        used, at = seen[first - before:first], first + horizon - 1
        if not seen[at] or np.count_nonzero(used) < before // 2:
            continue
        y = left[first - before:first]
        x = back @ y.ravel() if used.all() else np.linalg.lstsq(
            free[:before][used].reshape(-1, n), y[used].ravel(), rcond=1e-9)[0]
        errors.append((left[at] - free[-1] @ x) ** 2)
    if not errors:
        return np.full(m, np.nan)
    return np.where(power > SILENT * white, np.mean(errors, axis=0), np.nan)


@library
def swing(poles: Complex, turns: Complex, gains: Complex, U: Array, Z: Complex, S: Complex) -> None:
    """Simulate modes z+ = pole z + gain u from rest over U (N, r), and S, the derivative of z along d ln(pole) = turn.

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


def eigen(A: Array) -> tuple[Complex, Complex]:
    """Eigenvalues (n,) and eigenvectors (n, n) of A."""
    values, right = np.linalg.eig(A + 0j)
    return np.asarray(values, dtype=np.complex128), np.asarray(right, dtype=np.complex128)


def light_modes(values: Complex) -> tuple[Complex, list[int]]:
    """Logarithms (n,) of the poles, and the places of those of the lowest lightly damped modes, by frequency."""
    logs: Complex = np.log(np.where(values == 0.0, 1e-300, values))
    swings = (logs.imag > REAL) & (-logs.real < DAMPED * np.abs(logs))
    return logs, sorted(np.flatnonzero(swings).tolist(), key=lambda k: float(logs[k].imag))[:MOST_MODES]


def frequency_errors(model: StateSpace, U: Array, Y: Array, horizon: int, seen: NDArray[np.bool_]
                     ) -> tuple[Array, Array]:
    """Relative errors (g,) of the model's lowest frequencies that the samples show, and half their 95 % intervals.

    The errors are one Gauss-Newton step from the model's own frequencies (Rao's score over its information). Y (N, m)
    is scaled to unit power and divided into stretches of ``horizon`` samples, each with a free first state. The
    standard deviations come from the scatter of the stretches' scores (White's sandwich estimator), the intervals from
    Student's t, as the stretches are few. Empty where there is no mode, nan where there are fewer than 3 stretches.
    seen: as in ``missed``.
    """
    values, right = eigen(model.A)
    logs, chosen = light_modes(values)
    g, n = len(chosen), model.order
    if not g or not np.linalg.cond(right) < MOST_SKEW:
        return np.zeros(0), np.zeros(0)
    left, power = np.linalg.inv(right), np.var(Y, axis=0)
    unit = to_unit(power)
    shape, turns = (model.C @ right) * unit[:, None], np.asarray(1j * logs.imag, dtype=np.complex128)
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
    scores, informations = [], []
    for first in range(len(Y) % horizon, len(Y) - horizon + 1, horizon):
        at = slice(first, first + horizon)
        used = seen[at]
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

    The share is the root of the mean power over the outputs that are not silent; an output within chance (``CHANCE``)
    counts as 0. seen: as in ``missed``.
    """
    power, white = np.var(Y, axis=0), white_noise(Y)
    heard = power > SILENT * white
    unit = to_unit(power)
    free = (free_motion(model, len(Y)) * unit[:, None])[seen]
    left = ((Y - simulate(model, U)) * unit)[seen]
    if not heard.any() or not np.all(np.isfinite(free)) or not np.all(np.isfinite(left)):
        return math.inf if heard.any() else 0.0
    x = np.linalg.lstsq(free.reshape(-1, model.order), left.ravel(), rcond=1e-9)[0]
    rest = np.mean((left - free @ x) ** 2, axis=0)[heard]
    noise = (white * unit ** 2)[heard]
    beyond = rest > (1.0 + CHANCE * MEDIAN_SPREAD / math.sqrt(len(left))) * noise
    return math.sqrt(float(np.mean(np.where(beyond, rest - noise, 0.0))))


def with_pole_errors(found: Identified, values: Complex, right: Complex, errors: Sequence[tuple[int, complex]]
                     ) -> Identified:
    """Return the model with its spread widened by errors of its poles; as it is where no spread is known.

    values (n,), right (n, n): eigenvalues and eigenvectors of A; errors: the place of a pole, and a deviation of the
    logarithm of that pole and its conjugate.
    """
    if not found.spread.size or not np.linalg.cond(right) < MOST_SKEW:
        return found
    left, more = np.linalg.inv(right), np.zeros((len(found.spread), len(errors)))
    for column, (k, error) in enumerate(errors):
        moved = 2.0 * error * values[k] * np.outer(right[:, k], left[k])
        more[:found.model.A.size, column] = moved.real.ravel()
    return found._replace(spread=np.hstack([found.spread, more]))


def widened(found: Identified, share: float) -> Identified:
    """Return the model with its spread widened by the pole errors that explain a share of the amplitude.

    share: what the model leaves, see ``unfitted``. A pole error d [rad a sample] changes the phase or the logarithm of
    the amplitude of the motion by d k after k samples; over N samples this has the root mean square d N / sqrt(3).
    """
    if share == 0.0 or not found.samples > 0.0:
        return found
    values, right = np.linalg.eig(found.model.A)
    off = math.sqrt(3.0) * share / found.samples
    swinging = np.flatnonzero(values.imag > 0.0).tolist()
    return with_pole_errors(found, values, right, [(k, error) for k in swinging for error in (1j * off, off)])


def with_errors(found: Identified, errors: Array) -> Identified:
    """Return the model with bands that contain these relative errors (g,) of its frequencies, see ``frequency_errors``.

    An error e adds a deviation of e over the normal quantile.
    """
    values, right = eigen(found.model.A)
    logs, chosen = light_modes(values)
    return with_pole_errors(found, values, right, [
        (k, 1j * logs[k].imag * error / QUANTILE) for k, error in zip(chosen, errors.tolist(), strict=True)])


def lightly_damped(oscillations: Sequence[Mode]) -> list[Mode]:
    """Return the modes damped by less than ``DAMPED``, or growing by less."""
    return [mode for mode in oscillations if abs(mode.damping_ratio) < DAMPED]


def vague(oscillations: Sequence[Mode]) -> str:
    """Return which frequency has a standard deviation above ``VAGUE`` of itself, or ''."""
    for mode in oscillations:
        if mode.frequency_std_hz > VAGUE * mode.frequency_hz:
            return (f'the frequency of the mode at {mode.frequency_hz:.3g} Hz has a standard deviation of '
                    f'{100.0 * mode.frequency_std_hz / mode.frequency_hz:.2g} %')
    return ''


def uncertain(oscillations: Sequence[Mode]) -> str:
    """Return which frequency of a low lightly damped mode, or damping ratio of any low mode, is too uncertain, or ''.

    A mode damped above ``DAMPED`` may have an uncertain frequency, but no uncertain damping ratio: a mode that the
    samples do not contain may also drift to such a damping.
    """
    if reason := vague(lightly_damped(oscillations)[:MOST_MODES]):
        return reason
    for mode in oscillations[:MOST_MODES]:
        if mode.damping_ratio_std > LOOSE:
            return (f'the damping ratio of the mode at {mode.frequency_hz:.3g} Hz has a standard deviation of '
                    f'{mode.damping_ratio_std:.2g}')
    return ''


def lacks_modes(oscillations: Sequence[Mode], bends: int) -> bool:
    """Whether there are fewer lightly damped modes than measured bends: a mode that died out is not in the samples."""
    return len(lightly_damped(oscillations)) < bends


def gains_energy(oscillations: Sequence[Mode]) -> str:
    """Return which low lightly damped mode has a damping ratio below zero beyond chance, or ''.

    An arm dissipates energy, so each of its modes decays.
    """
    for mode in lightly_damped(oscillations)[:MOST_MODES]:
        if mode.damping_ratio < -CHANCE * mode.damping_ratio_std:
            return (f'the mode at {mode.frequency_hz:.3g} Hz has a damping ratio of {mode.damping_ratio:.2g} +- '
                    f'{mode.damping_ratio_std:.2g}, but an arm gains no energy')
    return ''


def is_early(found: Identified, since: float) -> bool:
    """Whether a model is of the first ``EARLY_S``. since: as in ``judged``."""
    return max(found.samples, since) * found.model.dt < EARLY_S


def judged(found: Identified, rows: Rows, outputs: tuple[str, ...], bends: int = 0, turned: float = 0.0,
           since: float = 0.0, *, drift: float = 0.0, filtered: bool = False) -> Identified:
    """Return the model with the status that its predictions of the last samples give; outputs: the outputs' names.

    bends: number of measured bends, where the model is to be one of every configuration; turned: range of the angle
    between the links since the last event [rad]; drift: its mean in the rows less its mean since the event [rad];
    since: number of samples learned since the event, where they are more than those behind the model. filtered: rows
    are those of ``decimation``; frequencies are not looked for in them, as right ones were not found (a mode 0.3 % off
    seemed to be 3.1 +- 1.3 % off).

    INCONSISTENT: the predictions miss over half of the outputs' mean power, the last samples show another frequency, or
    a mode gains energy (``gains_energy``).
    ORDER_TOO_LOW: they miss too much of one output (``MISSED``). POORLY_EXCITED, in the first ``EARLY_S`` WARMING_UP: a
    mode of a model of one configuration is too uncertain, or the last samples do not show its frequency. Where the
    model should be one of every configuration, the same status means that it has fewer lightly damped modes than there
    are bends, or that it is still of one configuration and the links have turned by more than ``MOST_TURN``.

    Rates contain modes above the order, which displacements hardly show. So the frequencies are those of the outputs
    other than rates, where there are any.

    The spread of a model of one configuration is widened by what the model leaves of the samples, and by the errors of
    its frequencies that the last samples show. Nothing else shows the errors from a fit to two periods, or from an arm
    that turns. Where the arm may turn and the fit is of more than twice the time that is looked at, the errors count
    with their intervals: such a fit is a mean over configurations, and the last samples alone tell the present one.
    As they do not tell it to 0.1 %, an error of ``PER_RAD`` times the drift counts as well.
    """
    found = _predicting(found, rows, outputs, bends, turned, since, drift=drift, filtered=filtered)
    if found.status is Status.TRACKING and (reason := gains_energy(modes(found))):
        return found._replace(status=Status.INCONSISTENT, reason=reason)
    return found


def _predicting(found: Identified, rows: Rows, outputs: tuple[str, ...], bends: int, turned: float, since: float, *,
                drift: float, filtered: bool) -> Identified:
    """Return the model with the status that everything but its damping gives, see ``judged``."""
    if found.status is not Status.TRACKING:
        return found
    gaps = np.flatnonzero(rows.gap[1:])
    if gaps.size:  # a prediction needs every torque
        rows = rows.between(rows.first + 1 + int(gaps[-1]), rows.until)
    rates = np.array([name.endswith('/velocity') for name in outputs])
    chosen = ~rates | rates.all()
    whole, U = affine(found.model, found.constant, rows.u)
    model = replace(whole, C=whole.C[chosen], D=whole.D[chosen])
    seen = rows.missing == 0
    unknown = Status.WARMING_UP if is_early(found, since) else Status.POORLY_EXCITED
    of_one = found.configurations is None
    if bends and lacks_modes(modes(found), bends):
        return found._replace(status=unknown, reason='the model has fewer lightly damped modes than there are bends')
    if bends and of_one and turned > MOST_TURN:
        return found._replace(status=unknown, reason=f'the links have turned by {turned:.2g} rad while it was learned')
    if of_one:  # ``varying_model.judge`` has those of every configuration
        last = slice(max(0, len(rows) - round(found.samples)), None)
        if len(seen[last]) > STRETCHES * model.order:
            with np.errstate(over='ignore', invalid='ignore'):
                share = unfitted(model, U[last], rows.y[last][:, chosen], seen[last])
            if not math.isfinite(share):
                return found._replace(status=Status.INCONSISTENT, reason='the model runs away')
            found = widened(found, share)
        if reason := uncertain(modes(found)):
            return found._replace(status=unknown, reason=reason)
    dt = found.model.dt
    stretch = max(2, min(round(AHEAD_S / dt), len(rows) // STRETCHES))
    horizon = max(2, min(round(AHEAD_S / dt), len(rows) // 3))
    if 3 * len(rows) < length(dt) or len(rows) < STRETCHES * max(stretch, found.model.order):
        return found
    with np.errstate(over='ignore', invalid='ignore'):
        shares = missed(whole, U, rows.y, horizon, seen)
    heard = shares[~np.isnan(shares)]
    if heard.size and float(heard.mean()) > MISSED:
        return found._replace(status=Status.INCONSISTENT,
                              reason='predictions 0.25 s ahead miss over half of the power of the outputs')
    beyond = shares - np.where(chosen, MISSED, MISSED_OF_RATE)
    if np.any(beyond > 0.0):
        worst = int(np.nanargmax(beyond))
        return found._replace(status=Status.ORDER_TOO_LOW, reason=f'predictions 0.25 s ahead miss '
                              f'{100.0 * shares[worst]:.0f} % of the power of {outputs[worst]}')
    if filtered:
        return found
    with np.errstate(over='ignore', invalid='ignore'):
        error, chance = frequency_errors(model, U, rows.y[:, chosen], stretch, seen)
    if np.any(np.abs(error) - chance > OFF):
        return found._replace(status=Status.INCONSISTENT, reason='the last samples show another frequency')
    if not of_one or not np.all(np.isfinite(chance)):  # nan: too few stretches
        return found
    shown = np.abs(error)
    errors = shown + chance if bends and found.samples * dt > 2.0 * LAST_S else np.where(shown > chance, shown, 0.0)
    errors = np.hypot(errors, QUANTILE * PER_RAD * drift)
    if errors.any():
        found = with_errors(found, errors)
    if np.any(chance > UNSHOWN):
        return found._replace(status=unknown, reason='the last samples do not show the frequency of each mode')
    if errors.any() and (reason := uncertain(modes(found))):
        return found._replace(status=unknown, reason=reason)
    return found
