"""Models that are held back: each predicts the samples that come after it, before they are learned.

A model that has learned the samples on which it is judged may predict them well and nothing else. So the moments of the
samples so far are copied at the start of a stretch, and at its end the model of that copy predicts the stretch. The
shares that were missed are averaged over all stretches: this is Dawid's prequential error (1984), here of predictions
0.25 s ahead. A model of no samples is taken to have missed a first stretch, as in Laplace's rule of succession.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.identification import model_output, realization
from flexmanip_ros.identification.prediction_check import AHEAD_S, INSTANTS, LAST_S, MISSED, MOST_ROWS, missed
from flexmanip_ros.identification.uncertainty import Identified
from flexmanip_ros.identification.validation import affine
from flexmanip_ros.numerics.background import Background
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.types import Array, StateSpace, Status

STRETCH_NS = round(0.5 * LAST_S * 1e9)
"""Longest stretch [ns]: a verdict is then no older than the samples on which a model is judged (``LAST_S``)."""
LONGEST = MOST_ROWS // 2
"""Largest number of rows of a stretch, and of the rows kept before it: together no more than ``prediction_check`` looks
at, at any sample rate."""
EARLIER = 3
"""A stretch is at most this part of the time learned before it: early on, a model of 3/4 of the samples predicts the
last quarter, as in a cross-validation with four folds."""
DELAY = 8
"""The result of a stretch is taken this part of its length later, 94 ms after 0.75 s. The model of a stretch took 4
to 56 ms for four measured machines of 10 to 16 states, and it is computed on another thread."""


class Learned(NamedTuple):
    """Copy of what gives the subspace model; the fields are those of ``RpbsidState``. weight: sum of the weights."""

    memory: tuple[Array, ...]
    scale: Array
    mean: Array
    weight: float
    used: int


@dataclass(frozen=True, eq=False)
class StretchRequest:
    """Prediction of a stretch by the model held back; ``background.Request``.

    rows: the stretch, with rows before it, see ``lead_of``; begin: its first row; weight, used: at its end, as in
    ``Learned``.
    """

    config: IdentifierParameters
    learned: Learned
    rows: Rows
    begin: int
    weight: float
    used: int

    def solve(self) -> Array:
        """Return for each output the time missed and the time predicted (2, m) [s], see ``HeldBack``.

        A share of the power that is missed counts as that share of the time, and no more than the whole of it. The time
        is that of the samples that were learned: a machine at rest teaches nothing. It is 0 where an output is silent.
        """
        nothing = np.zeros((2, self.rows.y.shape[1]))
        dt = spacing(self.rows)
        rows, length = self.rows, self.rows.until - self.begin
        time = (self.used - self.learned.used) * dt
        if not time > 0.0 or not np.all(np.isfinite(rows.u_y)):
            return nothing
        try:
            held = held_model(self.config, self.learned, dt)
        except np.linalg.LinAlgError:
            return nothing
        horizon = max(1, min(round(AHEAD_S / dt), length, len(rows) // 3))
        lead = lead_of(self.config, horizon)
        rows = rows.since(max(rows.first, self.begin - lead))
        if held is None or len(rows) <= max(lead, INSTANTS):
            return nothing
        with np.errstate(over='ignore', invalid='ignore'):
            shares = missed(*affine(held, None, rows.u), rows.y, horizon, rows.missing == 0)
        silent = np.isnan(shares)
        return time * np.array([np.where(silent, 0.0, np.minimum(shares, 1.0)), ~silent])


class HeldBack(NamedTuple):
    """Models held back, and how they have predicted what came after them.

    since_ns: stamp of the first sample that was learned, -1 before it; start, start_ns: first row after the last gap,
    and its stamp, -1 at a gap; begin, begin_ns: first row of the present stretch, and its stamp; first: first row that
    is needed to predict it; learned: what was learned before it, None before the first stretch; request: the stretch
    before, whose result is taken at the first row from ``due_ns`` [ns] on; latest, total: time missed and time
    predicted (2, m) [s] in the last stretch and in all of them, with the first one that a model of no samples missed;
    tried: (m,) outputs that were predicted.
    """

    since_ns: int = -1
    start: int = -1
    start_ns: int = 0
    first: int = 0
    begin: int = 0
    begin_ns: int = 0
    learned: Learned | None = None
    request: StretchRequest | None = None
    due_ns: int = 0
    latest: Array | None = None
    total: Array | None = None
    tried: NDArray[np.bool_] | None = None


def first_needed(held: HeldBack, row: int) -> int:
    """Return the first row of the sample log that will be read again; row: the one that is taken next."""
    if held.learned is not None:
        return min(row, held.first)
    return row if held.start < 0 else min(row, max(held.start, row - LONGEST))


def lead_of(config: IdentifierParameters, horizon: float) -> int:
    """Return the number of rows before a stretch from which its first row is predicted, see ``missed``."""
    return round(horizon) + max(round(horizon), 2 * config.order) - 1


def spacing(rows: Rows) -> float:
    """Mean time between rows [s]; 0 where there is none."""
    stamps = rows.stamp_ns
    return float(stamps[-1] - stamps[0]) * 1e-9 / (len(stamps) - 1) if len(stamps) > 1 else 0.0


def held_model(config: IdentifierParameters, learned: Learned, dt: float) -> StateSpace | None:
    """Return the model that was held back, in any basis; None where there is none. dt: sample time [s]."""
    if config.estimator == 'paper':
        realized, _ = model_output.from_recursion(config, learned.memory, learned.mean)
        scale = learned.scale
    else:
        realized, _, scale = model_output.from_factor(config, learned.memory[0], learned.scale)
    model = None if realized is None else model_output.raw_model(config, realized, scale, dt)[0]
    if model is not None and config.stable_model:
        return replace(model, A=realization.stabilized(model.A))
    return model


def broken(held: HeldBack) -> HeldBack:
    """Take note of a gap: the stretch ends there, as no prediction spans it."""
    return held._replace(start=-1)


def due(config: IdentifierParameters, held: HeldBack, rows: Rows, learned: Learned, regressors: int,
        background: Background) -> HeldBack:
    """Do what is due before the first of these rows. learned: what was learned before it, not copied yet.

    A result is taken, a stretch ends, and the next one begins.
    """
    now, now_ns = rows.first, int(rows.stamp_ns[0])
    ends = held.learned is not None and (
        held.start < 0 or now_ns >= _end_ns(held) or now >= held.begin + LONGEST)
    if held.request is not None and (now_ns >= held.due_ns or ends):
        held = delivered(held, background)
    if ends and held.learned is not None:
        request = StretchRequest(config, held.learned, rows.since(held.first).between(held.first, now), held.begin,
                                 learned.weight, learned.used)
        background.start(request)
        held = held._replace(request=request, due_ns=now_ns + (now_ns - held.begin_ns) // DELAY, learned=None)
    if held.start < 0:
        held = held._replace(start=now, start_ns=now_ns, since_ns=now_ns if held.since_ns < 0 else held.since_ns)
    if held.learned is None and learned.used >= regressors:
        copied = learned._replace(memory=tuple(part.copy() for part in learned.memory), scale=learned.scale.copy(),
                                  mean=learned.mean.copy())
        dt = (now_ns - held.start_ns) * 1e-9 / max(now - held.start, 1)
        lead = min(lead_of(config, AHEAD_S / dt), LONGEST) if dt > 0.0 else 0
        held = held._replace(first=max(held.start, held.first, now - lead), begin=now, begin_ns=now_ns, learned=copied)
    return held


def until(held: HeldBack, rows: Rows, used: int, regressors: int) -> int:
    """Return the row before which something is due next, at least one row later. used: samples learned so far."""
    stamps, found = rows.stamp_ns, rows.until
    if held.learned is None:
        found = min(found, rows.first + max(1, regressors - used))
    else:
        found = min(found, rows.first + int(np.searchsorted(stamps, _end_ns(held))), held.begin + LONGEST)
    if held.request is not None:
        found = min(found, rows.first + int(np.searchsorted(stamps, held.due_ns)))
    return max(found, rows.first + 1)


def _end_ns(held: HeldBack) -> int:
    return held.begin_ns + max(1, min(STRETCH_NS, (held.begin_ns - held.since_ns) // EARLIER))


def delivered(held: HeldBack, background: Background) -> HeldBack:
    """Take the result that is awaited, if any. Earlier stretches count as far as the memory holds their samples."""
    request = held.request
    if request is None:
        return held
    latest = background.result(request)
    held = held._replace(request=None)
    before, heard = request.learned, latest[1] > 0.0
    kept = max(request.weight - (request.used - before.used), 0.0) / before.weight
    total = np.full(latest.shape, 1e-9 * STRETCH_NS) if held.total is None else min(kept, 1.0) * held.total
    tried = heard if held.tried is None else held.tried | heard
    if not heard.any():  # nothing was predicted: what was said before remains
        return held
    return held._replace(latest=latest, total=total + latest, tried=tried)


def judged(found: Identified, held: HeldBack | None, outputs: tuple[str, ...], early: bool) -> Identified:
    """Return the model with the status that its forerunners give it: a subspace model that is TRACKING must have them.

    WARMING_UP: none has been tried yet, or they missed over half of an output ``early``. INCONSISTENT: later. A refined
    model has few parameters, and its fit is used when a quarter more samples have come; ``prediction_check`` looks at
    those.
    """
    if found.refined or found.status is not Status.TRACKING or held is None:
        return found
    wrong = misses(held)
    if wrong is None:
        return found._replace(status=Status.WARMING_UP, reason='no samples were predicted before they were learned')
    if not wrong.any():
        return found
    first = outputs[int(np.argmax(wrong))]
    return found._replace(
        status=Status.WARMING_UP if early else Status.INCONSISTENT,
        reason=f'models of earlier samples missed over half of what {first} did next')


def misses(held: HeldBack) -> NDArray[np.bool_] | None:
    """(m,) outputs of which models held back missed over half, lately or in the mean; None: none was tried yet.

    An output that was silent in every stretch does not count.
    """
    if held.latest is None or held.total is None:
        return None
    lately, mean = (part[0] > MISSED * part[1] for part in (held.latest, held.total))
    found: NDArray[np.bool_] = lately | (mean & held.tried)
    return found
