"""Compiled change detection: tell that something began to push on the tip within the last samples.

A capture or release acts on the arm as a force and a moment at the tip: an impulse, and the inertia of the object
from then on. Its trace in the innovations of a filter that does not know of it is H exp(A t) of an impulse, a step
and a ramp of force in two directions and of moment: nine numbers. The six of the force are tested for every onset in
the window (generalized likelihood ratio); all nine date the onset (``capture_detection.onset``).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.arm.equations_of_motion import solve
from flexmanip_ros.numerics.compiled import inner, kernel, separate
from flexmanip_ros.numerics.square_root import factor_information, forward, ordered_dot
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload.gauss_newton import UNFIT
from flexmanip_ros.payload.measurement_update import MeasurementModel
from flexmanip_ros.payload.moving_horizon import slide_length, take, tells
from flexmanip_ros.payload.process_model import SERIES, STEP_ANGLE, ProcessModel, predict
from flexmanip_ros.types import Array

DIRECTIONS = 3
"""Number of components of what acts on the tip: force along x and y, moment."""
CAUSES = 3 * DIRECTIONS
"""Number of causes: impulse, step and ramp of each component in turn."""
TESTED = 6
"""Number of causes that are tested, the first ones, those of the force, which every capture exerts. With the three of
the moment as well a capture is found 2 ms later, and one at rest 9 ms later."""
SHORTEST = 3
"""Least number of samples from the onset to an alarm."""
REFRESH = 16
"""Samples between computations of the traces."""
BEGIN = 2.0
"""Energy of the torques' changes over that two windows before, above which they begin to move an arm at rest. Sums of
100 squares of noise differ by less: their ratio has a deviation of 0.2."""
CALM = 3.0
"""Factor by which the statistic must exceed its own recent peaks, which errors of the model cause. At a capture it
reaches 10 to 1000 times these peaks within 0.1 s. With 3 none of 48 runs has a false alarm
(``detection_real_arms``); without these peaks three of eight with friction had."""
MOST_HALVINGS = 20
"""Largest number of halvings of a sample time in the matrix exponential: no real arm needs more."""

# elements of ``clock``
NEWEST, FILLED, SINCE_TRACES, QUIET, HISTORY, ALARMED = range(6)
# elements of ``level``
STATISTIC, PEAK, THRESHOLD, ENERGY = range(4)


class GlrState(NamedTuple):
    """What the detector remembers; w onsets in the window, m sensors."""

    trace: Array
    """(w, m, 9) innovation at each lag after an onset, per unit of prior standard deviation."""
    factors: Array
    """(w, 6, 6) Cholesky factor of I + information at each lag."""
    scores: Array
    """(w, 6) score of each onset, a ring buffer."""
    past: Array
    """(w, m) innovations over their variance at the time, limited to five deviations, a ring buffer."""
    innovations: Array
    """(w, m) innovations [rad or m], a ring buffer."""
    clock: NDArray[np.int64]
    """(6,) counters."""
    level: Array
    """(4,) statistic, recent peak, threshold, energy of the torques' changes within the window [N^2 m^2]."""
    history: Array
    """(2, 2 w) statistics of the last 2 w samples and energies of the torque's changes; a peak counts once it is
    older."""
    torques: Array
    """(L,) the last torques [N m]."""
    flow: Array
    """(n2, n2) scratch: state transition of a sample."""
    state: Array
    """(2, n2, 3) scratch."""


@inner
def transition(motion: ProcessModel, flow: Array, state: Array, dt: float) -> None:
    """Fill flow (n2, n2) with exp(A dt) by scaling and squaring, right after ``predict``. Scratch: motion.X."""
    n = motion.arm.stiffness.size
    fastest = STEP_ANGLE / motion.substeps
    for r in range(n):
        fastest -= motion.F[r, n + r]  # Coulomb friction of a joint at rest is a stiff damper
    halvings = 0
    while fastest * dt > STEP_ANGLE * 2.0**halvings and halvings < MOST_HALVINGS:
        halvings += 1
    h = dt / 2.0**halvings
    for column in range(2 * n):
        for i in range(2 * n):
            state[1, i, 0] = 1.0 if i == column else 0.0
            flow[i, column] = state[1, i, 0]
        weight = 1.0
        for order in range(1, SERIES + 1):
            for i in range(n):
                state[1, i, 1] = state[1, n + i, 0]
                value = 0.0
                for j in range(n):
                    value += motion.F[i, j] * state[1, j, 0] + motion.F[i, n + j] * state[1, n + j, 0]
                state[1, n + i, 1] = value
            weight *= h / order
            for i in range(2 * n):
                state[1, i, 0] = state[1, i, 1]
                flow[i, column] += weight * state[1, i, 0]
    for _ in range(halvings):
        for i in range(2 * n):
            for c in range(2 * n):
                motion.X[i, c] = flow[i, c]
        for i in range(2 * n):
            for c in range(2 * n):
                flow[i, c] = ordered_dot(motion.X[i], motion.X[:, c])


@separate
def traces(motion: ProcessModel, sensors: MeasurementModel, m: mem.FilterState, glr: GlrState, prior: Array, dt: float
           ) -> None:
    """Compute the traces of an onset from the linearization; prior: (3, 3) deviations by order and component."""
    n, links, k = motion.arm.stiffness.size, motion.arm.length.size, motion.arm.kappa
    w, sensors_count = glr.trace.shape[0], glr.trace.shape[1]
    flow, state = glr.flow, glr.state
    transition(motion, flow, state, dt)
    for c in range(DIRECTIONS):
        for i in range(n):
            motion.a[i] = motion.work.J[links, c, i] if c < 2 else 0.0
            if motion.arm.floating and c < 2:
                motion.a[i] -= motion.work.P[c, i] / motion.work.F[2]
        if c == 2:  # the moment works on the angle of the last cross-section
            motion.a[links - 1] = 1.0
            for j in range(k):
                motion.a[links + (links - 1) * k + j] = motion.arm.tip_slope[links - 1, j]
        solve(motion.work.M, motion.a)
        for i in range(n):
            state[0, i, c] = 0.0
            state[0, n + i, c] = motion.a[i]
    for lag in range(w):
        for i in range(sensors_count):
            offset = n if sensors.rate[i] else 0
            for c in range(DIRECTIONS):
                impulse = ordered_dot(sensors.H[i], state[0, offset:offset + n, c])
                glr.trace[lag, i, 3 * c] = impulse * prior[0, c]
                for order in range(1, 3):  # a step is the integral of an impulse, a ramp that of a step
                    a = 3 * c + order
                    value = 0.0
                    if lag > 0:
                        before = glr.trace[lag - 1, i]
                        value = before[a] / prior[order, c] + dt * before[a - 1] / prior[order - 1, c]
                    glr.trace[lag, i, a] = value * prior[order, c]
        for i in range(2 * n):
            for c in range(DIRECTIONS):
                state[1, i, c] = ordered_dot(flow[i], state[0, :, c])
        for i in range(2 * n):
            for c in range(DIRECTIONS):
                state[0, i, c] = state[1, i, c]
    information(m, glr)
    rescore(glr)


@inner
def rescore(glr: GlrState) -> None:
    """Compute the score of every onset again, as scores and information must come from the same traces."""
    w = glr.trace.shape[0]
    newest = glr.clock[NEWEST]
    for lag in range(glr.clock[FILLED]):
        onset = (newest - lag) % w
        score = glr.scores[onset]
        score[:] = 0.0
        for since in range(lag + 1):
            for i in range(glr.trace.shape[1]):
                e = glr.past[(onset + since) % w, i]
                for a in range(TESTED):
                    score[a] += glr.trace[since, i, a] * e


@inner
def information(m: mem.FilterState, glr: GlrState) -> None:
    """Factor the information of every lag."""
    for lag in range(glr.trace.shape[0]):
        for a in range(TESTED):
            for b in range(a + 1):
                value = 0.0
                for i in range(glr.trace.shape[1]):
                    value += glr.trace[lag, i, a] * glr.trace[lag, i, b] / m.noise[i, mem.EFFECTIVE]
                glr.factors[lag, a, b] = value + glr.factors[lag - 1, a, b] if lag > 0 else value
    # factors after all sums over the lags, which would be lost if each were factored at once
    for lag in range(glr.trace.shape[0]):
        if not factor_information(glr.factors[lag]):  # no real arm: no onset can be found
            glr.factors[lag] = 0.0
            for a in range(TESTED):
                glr.factors[lag, a, a] = 1e150


@inner
def update_glr(m: mem.FilterState, glr: GlrState, scratch: Array) -> None:
    """Take the latest innovations into the score of every onset, and find the largest statistic."""
    w = glr.trace.shape[0]
    clock = glr.clock
    clock[NEWEST] = (clock[NEWEST] + 1) % w
    clock[FILLED] = min(clock[FILLED] + 1, w)
    glr.scores[clock[NEWEST]] = 0.0
    for i in range(glr.trace.shape[1]):
        variance = max(m.innovation[i, 1], m.noise[i, mem.EFFECTIVE])
        most = 5.0 * np.sqrt(variance)
        glr.past[clock[NEWEST], i] = min(max(m.innovation[i, 0], -most), most) / variance
        glr.innovations[clock[NEWEST], i] = m.innovation[i, 0]
    best = 0.0
    for lag in range(clock[FILLED]):
        onset = (clock[NEWEST] - lag) % w
        score = glr.scores[onset]
        for i in range(glr.trace.shape[1]):
            e = glr.past[clock[NEWEST], i]
            for a in range(TESTED):
                score[a] += glr.trace[lag, i, a] * e
        if lag + 1 < SHORTEST:
            continue
        for a in range(TESTED):
            scratch[a] = score[a]
        forward(glr.factors[lag], scratch)
        best = max(best, ordered_dot(scratch, scratch))
    glr.level[STATISTIC] = best


@inner
def note_torques(glr: GlrState, torques: Array) -> None:
    """Add the change of the torques before a sample to its energy, which fades over the window."""
    glr.level[ENERGY] -= glr.level[ENERGY] / glr.trace.shape[0]
    for i in range(torques.size):
        change = torques[i] - glr.torques[i]
        glr.level[ENERGY] += change * change
        glr.torques[i] = torques[i]


@inner
def limit(glr: GlrState) -> float:
    """Return the limit of the statistic: the threshold, or ``CALM`` times its recent peak, whichever is larger."""
    most: float = max(glr.level[THRESHOLD], CALM * glr.level[PEAK])
    return most


@inner
def remember(glr: GlrState, fade: float) -> None:
    """Make a statistic that is older than the window the recent peak if it is the largest."""
    clock, history = glr.clock, glr.history
    clock[HISTORY] = (clock[HISTORY] + 1) % history.shape[1]
    glr.level[PEAK] = max(fade * glr.level[PEAK], history[0, clock[HISTORY]])
    history[0, clock[HISTORY]], history[1, clock[HISTORY]] = glr.level[STATISTIC], glr.level[ENERGY]


@inner
def slides_or_begins(motion: ProcessModel, sensors: MeasurementModel, m: mem.FilterState) -> bool:
    """Whether the horizon of an arm at rest is to slide, or to open.

    It opens where the samples tell of the payload, or do not fit an arm at rest.
    """
    begins = tells(motion, sensors, m)
    for i in range(m.power.size):
        begins |= m.power[i] > UNFIT
    if begins:
        m.counts[mem.RESTS] = mem.BEGINS_TO_MOVE
        return True
    m.counts[mem.IN_BATCH] += 1
    if m.counts[mem.IN_BATCH] < slide_length(sensors):
        return False
    m.counts[mem.RESTS] = mem.SLIDES
    return True


@inner
def torques_begin(glr: GlrState) -> bool:
    """Whether the torques change far more than two windows before: they, and no event, move an arm at rest.

    An arm that has not moved has taught nothing of its friction and rotors, so its first motion differs from the
    model's. Sooner than two windows after the test began it is compared with the first sample that was remembered.
    """
    remembered = min(glr.clock[QUIET] - 1 - glr.trace.shape[0], glr.history.shape[1])
    oldest = (glr.clock[HISTORY] + 1 - remembered) % glr.history.shape[1]
    return bool(glr.level[ENERGY] > BEGIN * glr.history[1, oldest])


@inner
def settled(m: mem.FilterState) -> bool:
    """Whether the filter has taken over a moving-horizon estimation that fits most samples since the last event."""
    rows = m.counts[mem.STORED]
    return bool(rows >= mem.HORIZON or (m.counts[mem.AGAIN] == 0 and m.counts[mem.REJECTED] == 0
                                    and 2 * m.counts[mem.BEFORE] > rows))


@kernel
def advance(
    motion: ProcessModel, sensors: MeasurementModel, m: mem.FilterState, glr: GlrState, prior: Array, dt: float,
    fade: float, hold: int, confirm: int, table: Array, first: int, scratch: Array, watching: bool,
) -> int:
    """Run the filter, and if watching the test, over the rows of the table from ``first`` on; return the next row.

    table: (N, 1 + 3 L + m), see ``structured.input_table``. While the horizon is open (fewer than ``HORIZON`` samples
    since the event), it begins with the first sample after it. The test ends at an alarm. hold: samples to be quiet at
    first; confirm: samples from an alarm to its return, so that it can be dated; fade: factor of the recent peak a
    sample. A negative number -k - 1: at row k numbers left the finite range, a fit failed, or the horizon of an arm at
    rest is to slide or to open (``RESTS``). One function for both, since each compiles the whole filter.
    """
    for k in range(first, table.shape[0]):
        if not take(motion, sensors, m, table, k):
            return -k - 1
        rests = m.counts[mem.RESTS] == mem.RESTING
        if not watching:
            if rests and slides_or_begins(motion, sensors, m):
                return -k - 1
            continue
        note_torques(glr, table[k, 1:1 + motion.effort.size])
        clock = glr.clock
        if clock[SINCE_TRACES] == 0:
            # linearizes there; literal numbers would compile it once more
            rows = table[k + 1 - sensors.reach:k + 1]
            predict(motion, m.x, m.S, m.counts[mem.USED], rows, sensors.period, 0.0)
            traces(motion, sensors, m, glr, prior, dt)
        clock[SINCE_TRACES] = (clock[SINCE_TRACES] + 1) % REFRESH
        update_glr(m, glr, scratch)
        # until the moving-horizon estimation has converged, innovations tell nothing of an event
        clock[QUIET] = clock[QUIET] + 1 if settled(m) else 0
        if clock[ALARMED] > 0:
            clock[ALARMED] += 1
        elif clock[QUIET] > glr.trace.shape[0]:  # the statistic is of samples since then alone
            if clock[QUIET] > hold:
                clock[ALARMED] = glr.level[STATISTIC] > limit(glr)
                if clock[ALARMED] > 0 and rests and torques_begin(glr):
                    m.counts[mem.RESTS] = mem.BEGINS_TO_MOVE
                    return -k - 1
            elif m.counts[mem.STORED] < mem.HORIZON and glr.level[STATISTIC] > glr.level[THRESHOLD]:
                # the model is still wrong and will be another one: wait again, without what it missed
                clock[QUIET] = glr.trace.shape[0]
                glr.level[PEAK] = 0.0
                glr.history[0] = 0.0
            remember(glr, fade)
        if clock[ALARMED] > confirm:  # at once where a sample takes longer than the confirmation
            return k + 1
        # while an alarm is confirmed, what moves an arm at rest is taken for an event
        if rests and clock[ALARMED] == 0 and slides_or_begins(motion, sensors, m):
            return -k - 1
    taken: int = table.shape[0]
    return taken


UNWATCHED = GlrState(
    trace=np.zeros((0, 0, 0)), factors=np.zeros((0, 0, 0)), scores=np.zeros((0, 0)), past=np.zeros((0, 0)),
    innovations=np.zeros((0, 0)),
    clock=np.zeros(0, dtype=np.int64), level=np.zeros(0), history=np.zeros((0, 0)), torques=np.zeros(0),
    flow=np.zeros((0, 0)), state=np.zeros((0, 0, 0)))
"""Stands for a test that is not run."""


def filtered(motion: ProcessModel, sensors: MeasurementModel, m: mem.FilterState, table: Array, first: int) -> int:
    """Run the filter alone, see ``advance``; return the row after the last one taken, less than N where it failed."""
    none = np.zeros(0)
    taken = advance(motion, sensors, m, UNWATCHED, np.zeros((0, 0)), 0.0, 0.0, 0, 0, table, first, none, False)
    return taken if taken >= 0 else -taken - 1
