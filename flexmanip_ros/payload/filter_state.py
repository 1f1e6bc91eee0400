"""What the structured estimator remembers: arrays of constant size, copied before a call writes them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.types import Array

HORIZON = 4096
"""Largest number of samples after an event that the moving-horizon estimation reads again."""
ENOUGH = 512
"""Least number of samples after which it ends once it has converged."""
TONES = 32
"""Frequencies at which the spectrum of each sensor is taken."""
PARTS = 4
"""Beginnings of the horizon that are kept apart: its first 16, 64, 256 and 1024 samples, see ``disagreement``."""

# Columns of ``noise``, one row a sensor: variance used by the filter; variance of the innovations; its slow part;
# sum and sum of squares of the residuals in this block; least variance assumed; variance of the fourth differences
# (white noise only); information on the payload that came from this sensor; sum of squares in this iteration; variance
# used at the last event; most that white noise can be by the median level of the spectrum.
EFFECTIVE, POWER, SLOW, BLOCK_SUM, BLOCK_POWER, FLOOR, WHITE, WEIGHT, FIT, AT_EVENT, LEVEL = range(11)
# Elements of ``counts``.
(HELD, STORED, ITERATED, ITERATING, IN_BLOCK, BLOCKS, SINCE_EVENT, SINCE_NOISE, IN_BATCH, MOVED, SEEN, BEFORE,
 REJECTED, AGAIN, LEARNED, REFITS, USED, IN_A_ROW, MEASURED, TRIED,
 IN_SPECTRUM, SPECTRA, LINEARIZED, EFFORTS, RESTS, SKIPPED, WITH_TIP, EXPLAINS) = range(28)
# Elements of ``score``.
(SHIFT, DOUBT, NOW, EMPTY_ARM_BIAS, EXCESS_BIAS, COST, COST_BEFORE, LAMBDA, MOVES, SANDWICH,
 MISFIT, EXCESS, LOG_DETERMINANT, LIKELIHOOD, DISAGREES) = range(15)
# Values of ``counts[EFFORTS]``: whether the white part of the reported efforts is noise or acts on the arm.
NOISY, COMPARED, EXACT, CONFIRMED = range(4)
# Values of ``counts[RESTS]``: whether the arm is at rest, and its horizon slides until it moves.
MOVES_ABOUT, RESTING, SLIDES, BEGINS_TO_MOVE = range(4)


class FilterState(NamedTuple):
    """State of the square-root Kalman filter and of the moving-horizon estimation; nx states, m sensors."""

    x: Array
    """(nx,) mean."""
    S: Array
    """(nx, nx) square root of the covariance."""
    noise: Array
    """(m, 11) what is known of each sensor's noise."""
    recent: Array
    """(m, 4) its last measurements."""
    swing: Array
    """(m, 4) of its measurements since the event, or since the horizon of an arm at rest slid: the first one; number,
    sum and sum of squares of their differences from it."""
    spectrum: Array
    """(m, 3, TONES) of its fourth differences: both states of Goertzel's filter, mean power over that of white noise
    of unit variance."""
    counts: NDArray[np.int64]
    """(28,) counters and flags (1: yes).

    Filter: HELD: the arm holds something; LEARNED: it was seen empty before; SEEN: samples measured, at most 2000;
    SINCE_EVENT: those since the last event; IN_A_ROW: those since the last one that was missing; SINCE_NOISE: samples
    since process noise was added; USED: number of the first columns of S and S0, beyond which they are zero. Noise:
    IN_BLOCK, IN_BATCH, IN_SPECTRUM: samples of the present block, batch, spectrum; BLOCKS, SPECTRA, MOVED: how many of
    them, and of moves, are in the means. Fit: STORED: samples in the horizon, ``HORIZON`` once it has closed;
    ITERATING: an iteration is under way; ITERATED, MEASURED: samples that it has read, and those of them that were not
    missing; BEFORE: samples of the last accepted iteration; REJECTED: steps rejected since then; AGAIN: the next one
    reads the same samples, as it has not converged; TRIED: iterations over the same samples so far; REFITS: fits begun
    again since the event; LINEARIZED: the iteration carries a linearized Kalman filter; EFFORTS: NOISY: their white
    part is taken for noise; COMPARED: the iteration takes it for true; EXACT: it fits better so; CONFIRMED: it does
    not; RESTS: RESTING: the samples since the event tell nothing yet of the payload, so no fit reads them and the
    horizon slides along, IN_BATCH counts the samples since it slid; SLIDES: it is due; BEGINS_TO_MOVE: the last sample
    tells; SKIPPED: samples from the event to the horizon, where that had to begin later (``begins_later``, ``strays``);
    WITH_TIP: the simplest arm is to be fitted again with an unknown rotary inertia of the tip mass (``give_up``);
    EXPLAINS: this fit of an empty arm has explained later samples (``strays``)."""
    score: Array
    """(15,) SHIFT: move of the payload in the last iteration, in standard deviations; DOUBT: root of the sum of the
    squares of that move and of the deviation, over the payload; NOW: time since process noise was added [s];
    EMPTY_ARM_BIAS: payload that the arm seemed to hold before the event, when it was empty, in the filter's standard
    deviations; EXCESS_BIAS: the same over the deviation that its moves give, with the error of the inertia, or that for
    which the empty arm is fitted again, until a horizon closes (``close_horizon``), infinite where no fit explained the
    empty arm; COST: of the samples read in this iteration, COST_BEFORE: of the last accepted one; LAMBDA: damping of
    Levenberg and Marquardt; MOVES: mean of the squared moves of payload and arm parameters, over the variance that the
    filter says, see ``judge_moves``; SANDWICH: factor, at least 1, by which the variances of the last fit of the empty
    arm are too small, see ``sandwich``; MISFIT: power of the residuals of the last accepted iteration (of the
    innovations where there is a linearized filter) over the noise assumed; EXCESS: by how many deviations of chance it
    exceeds the white noise, see ``judge_residuals``; LOG_DETERMINANT: sum of the logarithms of the variances of the
    innovations of the linearized filter over those of the noise, in this iteration; LIKELIHOOD: -2 times the logarithm
    of the likelihood of the last accepted iteration; DISAGREES: standard deviations by which the payload moves where
    the first samples after the event do not count, see ``disagreement``."""
    moved: Array
    """(nx, 2) mean and variance of payload and arm parameters when their moves were last judged, with the process noise
    since then in the variance; see ``judge_moves``."""
    known: Array
    """(2, nx, nx + 1) square root of the covariance and mean of an empty arm, the last two times that the filter
    explained the samples, the latest first (``strays``); zero before that."""
    x0: Array
    """(nx,) mean just after the last event."""
    S0: Array
    """(nx, nx) square root of its covariance."""
    xi: Array
    """(nx,) fitted departure from x0 in units of S0."""
    accepted: Array
    """(nx,) xi of the last accepted iteration, which did not raise the cost."""
    normal: Array
    """(nx, nx) information N at that xi."""
    gradient: Array
    """(nx,) gradient at that xi."""
    xr: Array
    """(nx,) present state of the trajectory about which the Gauss-Newton iteration linearizes."""
    Sr: Array
    """(nx, 2 nx + 1) its derivative by xi (USED columns); then, of the linearized filter, square root of the covariance
    (USED columns) and mean departure from it (one column)."""
    N: Array
    """(nx, nx) information gathered in the iteration."""
    g: Array
    """(nx,) gradient gathered in the iteration."""
    batch: Array
    """(nx,) that gradient at the end of the last batch of samples."""
    B: Array
    """(nx, nx) sum over the batches of b b', b the part of the gradient that comes from one batch; lower triangle."""
    early_normal: Array
    """(PARTS, nx, nx) that information after the first samples of the horizon; lower triangles."""
    early_gradient: Array
    """(PARTS, nx) that gradient then."""
    torque_noise: Array
    """(2, L) variance of the torque of each joint [N^2 m^2], summed over the samples since its process noise was added:
    in the filter, and in the linearized one."""
    effort_noise: Array
    """(L,) variance of the white part of each reported effort [N^2 m^2]."""
    rate_noise: Array
    """(L,) variance of the white noise of each measured joint rate, over ``STICTION_RATE``^2; infinity: never used."""
    ringing: Array
    """(3, 3, L) vibration that the changes of each torque excite in omitted modes, a phasor of two parts [N m], and its
    last effort [N m]: in the filter, at the last event, and in the iteration; see ``note_change``."""
    innovation: Array
    """(m, 2) the latest, and its variance before the update."""
    power: Array
    """(m,) mean squared normalised innovation of each sensor since the event, slowly forgotten."""


def memory(nx: int, m: int, links: int) -> FilterState:
    """Allocate for nx states, m sensors and the joints of ``links`` links."""
    return FilterState(
        x=np.zeros(nx), S=np.zeros((nx, nx)), noise=np.zeros((m, 11)), recent=np.zeros((m, 4)), swing=np.zeros((m, 4)),
        spectrum=np.zeros((m, 3, TONES)), counts=np.zeros(28, dtype=np.int64), score=np.zeros(15),
        moved=np.zeros((nx, 2)), known=np.zeros((2, nx, nx + 1)),
        x0=np.zeros(nx), S0=np.zeros((nx, nx)), xi=np.zeros(nx), accepted=np.zeros(nx),
        normal=np.zeros((nx, nx)), gradient=np.zeros(nx), xr=np.zeros(nx), Sr=np.zeros((nx, 2 * nx + 1)),
        N=np.zeros((nx, nx)), g=np.zeros(nx), batch=np.zeros(nx), B=np.zeros((nx, nx)),
        early_normal=np.zeros((PARTS, nx, nx)), early_gradient=np.zeros((PARTS, nx)),
        torque_noise=np.zeros((2, links)), effort_noise=np.zeros(links), rate_noise=np.zeros(links),
        ringing=np.zeros((3, 3, links)), innovation=np.zeros((m, 2)), power=np.ones(m))


OF_HORIZON = ('x0', 'S0', 'xi', 'accepted', 'normal', 'gradient', 'xr', 'Sr', 'N', 'g', 'batch', 'B', 'early_normal',
              'early_gradient')
"""What belongs to the moving horizon."""


def copy(state: FilterState, *, horizon: bool = True) -> FilterState:
    """Return the same values in arrays of their own.

    horizon False: what belongs to a complete moving horizon is shared; then only an event writes it.
    """
    shared = () if horizon or state.counts[STORED] < HORIZON else OF_HORIZON
    return FilterState._make(part if name in shared else part.copy()
                             for name, part in zip(FilterState._fields, state, strict=True))
