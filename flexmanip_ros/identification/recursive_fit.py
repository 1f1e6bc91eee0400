"""Prediction-error fit of growing stretches, then of blocks: the schedule of the fits, and the update by a block."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from flexmanip_ros.identification import decimation, model_output, parameter_varying, varying_start
from flexmanip_ros.identification.batch_fit import (
    BLOCK,
    UNEXPLAINED,
    Recursion,
    arrive,
    fit_stretch,
    scaled,
    unexplained,
)
from flexmanip_ros.identification.factor import Outcomes
from flexmanip_ros.identification.moments import triangle
from flexmanip_ros.identification.parameter_varying import Varying
from flexmanip_ros.identification.prediction_error import condition, derivatives, measured, moved, run
from flexmanip_ros.numerics.background import Background
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.types import Array

CHUNK = 64
"""Samples that the fit takes over at once."""
FIRST, LONGEST = 256, 2048
"""Samples in the first fit of a stretch, and in the last fit of the whole stretch; multiples of CHUNK."""
SOON = (640, 768)
"""Samples in further fits of the whole stretch, after an event before which the parameter-varying model was known."""
DELAY = 4
SOONEST = 128
"""Delay of the result of a fit of N samples: N / DELAY samples, and at least ``SOONEST`` samples."""
SOONEST_S, EACH_S = 0.1, 2e-4
"""Least delay of that result [s], and least delay per sample of the fit [s]. At 1 kHz ``DELAY`` and ``SOONEST`` give
more."""
BLOCK_S = 0.06
"""Delay of the result of a block [s]. It is at least CHUNK samples, and below BLOCK samples to keep up with them."""
REFIT_S = 0.25
"""Delay of the result of a block with which all blocks are fitted again [s]; that takes up to 0.2 s on a slow core."""
LATEST = 4096
"""Largest delay in samples that a time [s] may ask for: it bounds the samples that are kept, at any sample rate."""
PARAMETERS, USUAL = 120, 80
"""Number of entries in A, B, C, D and K above which the subspace model is not refined, and number up to which the
delays above hold. Beyond it the delays grow as the square of the number, as the time for a fit does."""
PAUSE = 8192
"""Samples from a failed fit to the begin of the next stretch; a multiple of CHUNK."""


@dataclass(frozen=True, eq=False)
class FitRequest:
    """A fit to be made; ``background.Request``.

    rows: samples of the fit, a slice of the sample log; R: (q, q) factor of the moments and scale: (r +
    m,), both None for the update by a block; old: the previous fit, if any; older: the fit from before the last event,
    where that is another one; later: samples from the last row until the result is taken; varying: the
    parameter-varying fit that the block updates, or for a whole stretch that from before the last event.
    """

    config: IdentifierParameters
    rows: Rows
    R: Array | None
    scale: Array | None
    old: Recursion | None
    older: Recursion | None = None
    later: int = 0
    varying: Varying | None = None

    def solve(self) -> FitResult:
        """Make the fit without warnings: numbers that are not finite are detected where the result is checked."""
        try:
            with np.errstate(over='ignore', invalid='ignore'):
                if self.R is not None and self.scale is not None:
                    return _stretch(self, self.R, self.scale)
                if self.varying is not None:
                    return FitResult(self.old, varying=parameter_varying.advance(self.config, self.varying, self.rows))
                assert self.old is not None
                return FitResult(_block(self.old, samples_of(self.rows)))
        except np.linalg.LinAlgError:
            return FitResult(None, failed=True)


class FitResult(NamedTuple):
    """Result of a request: None where no model fits. failed: a matrix decomposition failed."""

    recursion: Recursion | None
    failed: bool = False
    varying: Varying | None = None


class Refined(NamedTuple):
    """State of the refinement.

    begin: first row of the stretch in the sample log, in the future during a pause after a failed fit; end: the row
    after the last one taken; seen: the row after the last one that a fit has used; batch: each fit still uses every
    sample of the stretch; request: the fit under way, whose result is taken at row ``due``; before: the fit from before
    the last event, a starting point; since_ns: stamp of the first sample; varying: the parameter-varying fit, which
    takes the blocks once it exists; varying_before: the parameter-varying fit from before the last event.
    """

    begin: int
    end: int
    seen: int
    batch: bool = True
    recursion: Recursion | None = None
    request: FitRequest | None = None
    due: int = 0
    before: Recursion | None = None
    since_ns: int = 0
    varying: Varying | None = None
    varying_before: Varying | None = None

    @property
    def total(self) -> int:
        """Number of samples in the stretch; negative before it begins."""
        return self.end - self.begin

    @property
    def closed(self) -> int:
        """The row after the last whole chunk of the stretch."""
        return self.begin + self.total // CHUNK * CHUNK


def start(row: int, before: Recursion | None = None, varying_before: Varying | None = None, pause: int = 0) -> Refined:
    """Begin without a fit at a row of the sample log, or ``pause`` rows later."""
    return Refined(row + pause, row, row + pause, before=before, varying_before=varying_before)


def restart(refined: Refined) -> Refined:
    """Begin a new stretch after an event; the present fit is a starting point of the next one."""
    return start(refined.end, refined.recursion or refined.before, refined.varying or refined.varying_before)


def first_needed(refined: Refined) -> int:
    """Return the first row of the sample log that will be read again."""
    return min(refined.end, refined.seen if not refined.batch else refined.begin)


def until_chunk(refined: Refined) -> int:
    """Number of samples until the present chunk is full (at least 1)."""
    return CHUNK - refined.total % CHUNK


def take(refined: Refined, rows: Rows) -> Refined:
    """Take note of rows, at most ``until_chunk(refined)``."""
    if refined.total == 0:
        refined = refined._replace(since_ns=int(rows.stamp_ns[0]))
    return refined._replace(end=rows.until)


def is_fit_due(config: IdentifierParameters, refined: Refined) -> bool:
    """Whether the whole stretch is to be fitted now: at FIRST samples and each time their number has doubled.

    With a parameter-varying model from before an event the stretch is also fitted at ``SOON`` samples, where that model
    may already hold. A fit from before a gap is replaced once the stretch has more than half of the samples behind it.
    No fit is due while another one is under way; only the last fit, that of LONGEST samples, is then made later.
    """
    total = refined.total
    if not refined.batch or refined.request is not None or total <= 0:
        return False
    if refined.recursion is not None and 2 * total <= refined.recursion.weight:
        return False
    if total in SOON and refined.varying_before is not None:
        return parameter_varying.roles(config) is not None
    if total > LONGEST:
        return total % CHUNK == 0
    doublings = total // FIRST
    return total % FIRST == 0 and doublings & (doublings - 1) == 0


def is_first_under_way(refined: Refined) -> bool:
    """Whether the first fit of a stretch is being made."""
    request = refined.request
    return refined.batch and request is not None and request.R is not None and len(request.rows) == FIRST


def is_block_due(refined: Refined) -> bool:
    """Whether a recursive update is due."""
    waiting = refined.closed - refined.seen
    is_there = refined.recursion is not None or refined.varying is not None
    return is_there and refined.request is None and waiting >= BLOCK


def size(config: IdentifierParameters) -> int:
    """Return the number of entries in A, B, C, D and K."""
    n, r, m = config.order, len(config.inputs), len(config.outputs)
    return n * (n + r + 2 * m + 1) + m * r


def fitted(config: IdentifierParameters) -> IdentifierParameters:
    """Return what is fitted: of a large model only the order that the parameter-varying model starts from, if any."""
    role = parameter_varying.roles(config) if size(config) > USUAL else None
    return config if role is None else replace(config, order=2 * len(role.displacements))


def result_delay(config: IdentifierParameters, refined: Refined, now_ns: int) -> int:
    """Number of samples until the result of a fit is taken, a multiple of CHUNK; now_ns: stamp of the last sample.

    It follows from the stamps of the stretch, so a replay takes the result at the same sample as the live node.
    """
    count, longer = refined.total, max(1.0, (size(config) / USUAL) ** 2)
    needed = _chunks(refined, now_ns, longer * max(SOONEST_S, EACH_S * count), LATEST)
    return max(SOONEST, count // DELAY // CHUNK * CHUNK, needed)


def _chunks(refined: Refined, now_ns: int, duration: float, most: int) -> int:
    """Number of samples in ``duration`` [s], at most ``most``, rounded up to a multiple of CHUNK; 0 where unknown.

    The sample time is the mean one of the stretch so far.
    """
    spacing = max(now_ns - refined.since_ns, 0) * 1e-9 / (refined.total - 1)
    return CHUNK * math.ceil(min(duration / spacing, most) / CHUNK) if spacing > 0.0 else 0


def ask_fit(config: IdentifierParameters, refined: Refined, rows: Rows, R: Array, scale: Array) -> Refined:
    """Request a fit of the whole stretch, see ``batch_fit.fit_stretch``; rows: the latest ones."""
    old, older, *_ = *(fit for fit in (refined.recursion, refined.before) if fit is not None), None, None
    config = fitted(config)
    later = result_delay(config, refined, int(rows.stamp_ns[-1]))
    request = FitRequest(config, rows.since(refined.begin).between(refined.begin, refined.closed), R.copy(),
                         scale.copy(), old, older, later, refined.varying_before)
    return refined._replace(request=request, due=refined.end + later)


def ask_block(config: IdentifierParameters, refined: Refined, rows: Rows) -> Refined:
    """Request an update by the oldest block that the fit has not used; rows: the latest ones."""
    block = rows.since(refined.seen).between(refined.seen, refined.seen + BLOCK)
    request = FitRequest(config, block, None, None, refined.recursion, varying=refined.varying)
    again = refined.varying is not None and refined.varying.blocks + 1 in parameter_varying.REFITS
    duration, most = (REFIT_S, LATEST) if again else (BLOCK_S, BLOCK - CHUNK)
    later = max(CHUNK, _chunks(refined, int(rows.stamp_ns[-1]), duration, most))
    return refined._replace(request=request, due=refined.end + later)


def delivered(refined: Refined, background: Background) -> Refined:
    """Take the result of the fit under way, if there is one."""
    request = refined.request
    if request is None:
        return refined
    result: FitResult = background.result(request)
    refined = refined._replace(request=None)
    if result.failed:  # the subspace model is published, and a new stretch begins
        return start(refined.end)
    count, whole = len(request.rows), request.R is not None
    if request.varying is not None and result.varying is None and not whole:  # that fit has ended: a new stretch begins
        return start(refined.end, result.recursion)
    batch = count < LONGEST if whole else refined.batch
    if result.recursion is None and result.varying is None and not batch:  # the model may not suit the plant at all
        return start(refined.end, pause=PAUSE)
    return refined._replace(recursion=result.recursion, varying=result.varying, batch=batch,
                            seen=(refined.begin if whole else refined.seen) + count)


def broken(refined: Refined, background: Background) -> Refined:
    """Take the result under way and begin another stretch, where samples are missing.

    The fits are kept, their state is unknown. A fit of fewer than ``LONGEST`` samples may be a poor one, and blocks
    alone may not mend it. So the new stretch is fitted as a whole, too.
    """
    refined = delivered(refined, background)
    if refined.total <= 0:  # nothing to break; a pause goes on
        return refined
    old = refined.recursion
    fresh = start(refined.end, refined.before, refined.varying_before)
    if refined.varying is not None:
        return fresh._replace(batch=False, recursion=old, varying=parameter_varying.lost(refined.varying))
    if old is None:
        return fresh
    n, k = old.theta.A.shape[0], old.root.shape[0]
    root = np.zeros((k, k))
    root[:k - n, :k - n] = triangle(old.root[:k - n].T).T[:, :k - n]
    root[k - n:, k - n:] = 10.0 * np.eye(n)  # deviation 10 of an unknown state: signals have unit power
    theta = old.theta._replace(x=np.zeros(n))
    return fresh._replace(batch=old.weight < LONGEST, recursion=old._replace(theta=theta, root=root, lost=True))


MEMORY = 1_000_000.0
"""Number of samples in which the covariance of the parameters grows by a factor e, so that they may drift slowly."""
NOISE_BLOCKS, DRIFT_BLOCKS, TREND_BLOCKS = 16, 4, 8
"""Blocks over which the covariance of the innovations, the drift and the mean step of the parameters are averaged."""
SURPRISE = 4.0
"""Excess of a block's score statistic, in standard deviations, above which the parameters count as changed."""
AGE = 1.25
"""Mean age of a block's result when it is read, counted from the middle of the block, in blocks."""
CHANCE = 2.0
"""Excess, in standard deviations, up to which larger residuals or a trend of the parameters count as chance."""
LARGEST_DRIFT = 1.4
"""Logarithm of the largest factor by which one block may raise the prior variances."""


def samples_of(rows: Rows) -> Array:
    """Return inputs and outputs (N, r + m); outputs that were not measured are NaN, and no fit uses them."""
    samples = rows.u_y
    absent = rows.missing > 0
    if absent.any():
        samples = samples.copy()
        samples[absent, rows.log.width.inputs:] = np.nan
    return samples


def whole_fit(config: IdentifierParameters, samples: Array, R: Array, scale: Array, noise: str,
              old: list[Recursion]) -> Recursion | None:
    """Fit samples (N, r + m), see ``batch_fit.fit_stretch``, from subspace models with one or two future windows.

    R, scale: see ``model_output.from_factor``; old: earlier fits, which are starts as well.
    """
    starts = [model_output.from_factor(config, R, scale)]
    if config.order > len(config.outputs) and config.past_window > config.future_window:
        longer = replace(config, future_window=config.past_window)
        starts.append(model_output.from_factor(longer, R, scale))
    found = fit_stretch(samples, [realized for realized, _, _ in starts if realized is not None], old, starts[0][2],
                        config.direct_feedthrough, noise, parameter_varying.has_constant(config))
    if found is None or found.structure.free_gain:  # a free K makes the residuals white
        return found
    return found._replace(widening=max(found.widening, decimation.colour(config.decimation)))


def _stretch(request: FitRequest, R: Array, scale: Array) -> FitResult:
    """Fit the whole stretch with a model of one configuration, and from it with a parameter-varying one.

    The parameter-varying model is also fitted from that before the event; the better of the two is returned.
    """
    config = request.config
    found = whole_fit(config, samples_of(request.rows), R, scale,
                      'sensor' if config.refinement == 'output_error' else 'any',
                      [fit for fit in (request.old, request.older) if fit is not None])
    if found is not None and found.trend_share > 0.0:  # the arm drifts on until the result is read
        found = found._replace(trend_lag=request.later / BLOCK + 1.0)
    tried = [varying_start.start(config, request.rows, None, request.varying)]
    if found is not None and len(request.rows) >= varying_start.WINDOW:
        tried.append(varying_start.start(config, request.rows, found, None))
    good = [one for one in tried if one is not None and float(one.share.max()) ** 2 < UNEXPLAINED]
    return FitResult(found, varying=min(good, key=lambda one: float(one.share.max()), default=None))


def _block(old: Recursion, samples: Array) -> Recursion | None:
    """Update parameters and state by one block, in square-root covariance form; None where the fit is to be dropped."""
    U, Y = scaled(samples, old.scale, old.theta)
    k, count = old.root.shape[0], measured(Y)
    kept = old.root * np.sqrt(1.0 + len(U) / MEMORY) * np.exp(0.5 * old.drift)
    if old.trend_share > 0.0:
        kept = triangle(np.hstack([kept, old.trend_share * old.trend[:, None]]).T).T
    noise = old.covariance
    if not old.lost:  # residuals beyond the noise (a moving arm is not linear) count as noise
        before, _ = run(U, Y, old.theta)
        if not np.all(np.isfinite(before)):
            return None
        power = float(np.trace(np.linalg.solve(noise, before))) / Y.shape[1]
        known = min(old.weight, 2.0 * NOISE_BLOCKS * len(U))
        noise = noise * max(1.0, power - CHANCE * np.sqrt(2.0 / Y.shape[1] * (1.0 / count + 1.0 / known)))
    zeta, theta, further = np.zeros(k), old.theta, 0.0
    arrival, root = np.zeros((0, k)), kept
    for _ in range(2 if old.lost else 1):  # from an unknown state the first derivatives are poor
        information, gradient, arrival, _ = derivatives(U, Y, theta, old.structure, noise, old.P)
        H = kept.T @ information @ kept
        if not np.all(np.isfinite(H)):
            return None
        g = kept.T @ gradient
        root, step = kept.copy(), np.empty(k)
        condition(H.copy(), root, g - zeta, step)
        if not old.lost and is_surprising(float(g @ step), H, old.widening):
            further = drift(H, g, old.widening)
            kept, H, g = np.exp(0.5 * further) * kept, np.exp(further) * H, np.exp(0.5 * further) * g
            root = kept.copy()
            condition(H, root, g, step)
        if not np.all(np.isfinite(step)):
            return None
        zeta = zeta + step
        theta = moved(old.theta, old.P @ (kept @ zeta), old.structure)
    covariance, end = run(U, Y, theta)
    left = unexplained(covariance, Y, old.mean)
    strikes = old.strikes + 1 if not left < UNEXPLAINED else 0
    if strikes >= 2 or not np.isfinite(left):
        return None
    share = max(count / (old.weight + count), count / len(U) / NOISE_BLOCKS)
    step = kept @ zeta
    step[k - len(end):] = 0.0  # the state changes in any case: no trend of it
    moving = old.drift + further if further > 0.0 else 0.0
    trend = old.trend if old.lost else old.trend + (step - old.trend) / TREND_BLOCKS
    lasting, lag = trend_of(trend[:k - len(end)], kept[:k - len(end)], root[:k - len(end)])
    return old._replace(
        theta=theta._replace(x=end), root=arrive(root, arrival), strikes=strikes,
        gain=theta.K if old.structure.free_gain else old.gain, lost=False,
        covariance=(1.0 - share) * old.covariance + share * covariance,
        weight=min(old.weight + count, MEMORY),
        drift=old.drift + (moving - old.drift) / DRIFT_BLOCKS,
        trend=trend, trend_share=lasting, trend_lag=lag)


def is_surprising(size: float, H: Array, widening: float) -> bool:
    """Whether a block shows that the parameters have changed, or that its residuals are correlated.

    H: (k, k) information of the block in coordinates of unit prior deviation; size: g' (I + H)^-1 g with the block's
    gradient g (k,). With unchanged parameters ``size`` has the mean tr H and the variance 2 tr H^2.
    """
    deviation = np.sqrt(2.0) * float(np.linalg.norm(H))
    return bool(size > widening ** 2 * (float(np.trace(H)) + SURPRISE * deviation))


def drift(H: Array, g: Array, widening: float) -> float:
    """Logarithm >= 0 of the factor on the prior variances at which ``size`` of ``is_surprising`` equals its mean."""
    values, vectors = np.linalg.eigh(H)
    values = np.maximum(values, 0.0)
    square = (vectors.T @ g) ** 2
    mean = widening ** 2 * float(values.sum())
    low, high = 0.0, LARGEST_DRIFT
    for _ in range(40):
        middle = 0.5 * (low + high)
        more = np.sum(square / (1.0 + np.exp(middle) * values)) > mean
        low, high = (middle, high) if more else (low, middle)
    return low


def trend_of(trend: Array, before: Array, after: Array) -> tuple[float, float]:
    """Return the share of the mean step ``trend`` (a,) that chance does not explain (0 to 1), and the lag in steps.

    before, after: (a, k) roots of the covariance before and after a block. Estimates of constant parameters also move
    in a block. In units of the covariance before, the covariance of such a step is T = 1 - after after'. The squared
    norm of the mean step over the blocks then has the mean tr T / (2 TREND_BLOCKS - 1) and the deviation sqrt(2) |T| /
    (2 TREND_BLOCKS - 1). T is also the share of an error that a block removes, so the fit stays (1 - T) / T steps
    behind a steady drift.
    """
    L = triangle(before.T).T
    step = scipy.linalg.solve_triangular(L, trend, lower=True, check_finite=False)
    size = float(step @ step)
    if not size > 0.0:
        return 0.0, 0.0
    left = scipy.linalg.solve_triangular(L, after, lower=True, check_finite=False)
    T = np.eye(len(trend)) - left @ left.T
    likely = float(np.trace(T)) + CHANCE * np.sqrt(2.0) * float(np.linalg.norm(T))
    share = float(np.sqrt(max(1.0 - likely / (2.0 * TREND_BLOCKS - 1.0) / size, 0.0)))
    gain = float(step @ T @ step) / size
    lag = min((1.0 - gain) / max(gain, 1e-9), float(TREND_BLOCKS))
    return share, share * (AGE + lag)


def refine(config: IdentifierParameters, refined: Refined, rows: Rows, outcome: Outcomes, R: Array, scale: Array,
           background: Background) -> Refined:
    """Hand rows to the prediction-error fit; request the fit that is due, and take the result that is due.

    rows: at most until_chunk(refined); outcome: (N,) of each row; R, scale: factor of the moments and scale after these
    rows. Rejected samples break the stretch, and so do quiet ones, which carry no information.
    """
    first = rows.first
    for k in np.flatnonzero(outcome):
        row = rows.first + int(k)
        refined = take(refined, rows.between(first, row)) if row > first else refined
        refined = broken(refined, background)  # the next stretch begins after this row
        refined = refined._replace(begin=refined.begin + 1, end=refined.end + 1, seen=refined.seen + 1)
        first = row + 1
    if first == rows.until:
        return refined
    refined = take(refined, rows.between(first, rows.until))
    if refined.request is not None and refined.end >= refined.due:
        refined = delivered(refined, background)
    before = refined.request
    if is_fit_due(config, refined):
        refined = ask_fit(config, refined, rows, R, scale)
    elif is_block_due(refined):
        refined = ask_block(config, refined, rows)
    if refined.request is not None and refined.request is not before:
        background.start(refined.request)
    return refined
