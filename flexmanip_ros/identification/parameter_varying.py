"""The model as a function of the configuration: a recursive output-error fit that goes on while the arm moves.

The state is x = [w; w'] with the measured displacements w, so its basis stays the same as the arm turns:

    w'' = -G(c) w - D w' + H(c) tau + s Q(c) [p; p''] + R(c) t,   y = w + E(c) tau + F tau'' + b

c = cos(theta2 - theta1) and s = sin(theta2 - theta1). G, H, E, Q and R are linear in three functions of c
(``varying_kernel.basis``). Links that swing by an angle in proportion to w turn the configuration to and fro, so the
equations of motion have terms of second and third order: p are the products of two displacements, t those of three, and
of one displacement and two rates. Measured signals stand for w and w' in them, so the model stays linear in its state.
The published model is that of small vibrations, without p and t. D has a constant term and one term for the rate of
each link. b is a slow offset. E and F stand for the modes above those of the model. All signals, p and t too, pass one
low-pass filter with a corner above the modes. Each block of ``BLOCK`` samples updates parameters and state together, as
in ``recursive_fit``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from flexmanip_ros.identification.batch_fit import BLOCK
from flexmanip_ros.identification.moments import solved, triangle
from flexmanip_ros.identification.prediction_check import white_noise
from flexmanip_ros.identification.varying_kernel import basis, low_pass, simulate_block
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.samples.signals import reads_angles, relative_angle
from flexmanip_ros.types import Array

FUNCTIONS = 3
"""Number of functions of the configuration, see ``varying_kernel.basis``."""
MOST_TRIALS, SHORTER = 3, 0.3
"""Largest number of trial steps per iteration of a fit, and factor that shortens a step that would raise the cost."""
VARIES, KNOWN = 0.12, 1.0
"""Prior deviations, as shares of the largest entry: of the parts of G and H that vary with c, and of constant parts."""
UNEVEN = 1e-4
"""Prior deviation, as a share of the largest entry, of the parts of G that no arm of two links has. With link 2
pointing the other way, c and the displacements of link 2 change sign. So the entries of G of one link are even
functions of c, and those that couple the links are odd."""
SQUARES, CUBES = 2.0, 1.0
"""Prior deviations of Q for each radian, and of R for each square radian, of the angle through which the links swing.
Within a radian G changes by about as much as it is large, and a joint swings to and fro within it. With R of 0.1, which
ten minutes of the default arm show, a fit that begins on an arm that swings is too sure: R and G cannot be told apart
in its first seconds, and 13 to 32 % of its bands of f1 missed by a factor of three (with 1: none)."""
DIRECT, DAMPED, TURNING, OFFSET, SHARED = 0.05, 0.05, 2.0, 0.3, 1.0
"""Prior deviations of E and F, of the constant term of D, of its terms with the rates, of b and of zeta. They hold for
signals of unit power and time in units of 1 / shift."""
WALK = 0.0001
"""Standard deviation of a parameter's random walk in a block, as a share of its prior one: 0.5 % in ten minutes."""
STATE_WALK = 0.01
"""Standard deviation of the state's random walk in a block, as a share of the displacements' standard deviation."""
OFFSET_WALK = 0.01
"""Standard deviation of the random walk of b in a block, as a share of the displacements' standard deviation."""
NOISE_BLOCKS, SHARE_BLOCKS = 8, 16
"""Blocks over which the covariance of residuals and of white noise, and the values of ``Missed``, are averaged."""
UNPREDICTED = 0.7
"""Share of an output's amplitude that the prediction of a block may miss; a block that misses more is a bad one."""
STRIKES = 3
"""Number of bad blocks in a row that ends the fit, see ``UNPREDICTED``."""
UNKNOWN = 3.0
"""Prior standard deviation of an unknown state, for signals of unit power."""
SETTLE = 2.0
"""Settling time of a restarted filter, in periods of its corner frequency."""
ITERATIONS = 4
"""Largest number of Gauss-Newton iterations in each of the first ``SHARE_BLOCKS`` blocks, which move the parameters
far. A later block gets one iteration: more improved nothing in three minutes of a wandering arm."""
REFITS = (8, 16, 32)
"""Numbers of blocks at which all blocks since the begin are fitted again, linearized at the present parameters. A block
is linearized where the parameters are when it comes; those of the first seconds are far off, and that error would
remain. Without it f1 of the default arm is 0.15 to 0.21 % off (rms, four noises) from 15 to 26 s, with it 0.03 to 0.05
%."""
AT_REST = np.array([1.0, 0.0, 0.0])
"""Factors on the three terms of D when the links stand still."""
QUALITIES = (1.0 / 0.5411961, 1.0 / 1.3065630)
"""Twice the damping ratio of each of the two second-order stages of a fourth-order Butterworth filter."""


class Roles(NamedTuple):
    """Indices of the outputs that are displacements (h), and for each output the index of the state it measures."""

    displacements: tuple[int, ...]
    states: tuple[int, ...]


class Varying(NamedTuple):
    """State of the parameter-varying fit, constant in size; h displacements, r inputs, k parameters.

    shift: 1 over the unit of time [1/s]; scale_u (r,), scale_y (h,): factors on signals; theta: (k,) parameters, see
    ``parts``; x: (2h,) state; root: (k + 2h, k + 2h) S with S S' the covariance of [theta; x]; noise: (h, h) covariance
    of the residuals; share (h,), chi2: averages of ``Missed`` over the last blocks; corner: of the low-pass [Hz];
    every: one of so many filtered samples is kept; filtered: (4, ``width``) state of the filter; dt: sample time [s];
    angle: relative angle of the links after the last block [rad]; blocks: number taken; strikes: number of bad blocks
    in a row; lost: samples were missing, so filter and state restart; settling: kept samples until the restarted filter
    has settled; turn: angle through which the links swing with displacements of unit power [rad, rms]; power: (h, h)
    covariance of the scaled displacements, an average over the last blocks; center: see ``signals_of``; level: (h, h)
    average of ``noise_of`` over the last blocks; white: (h, h) the least ``level`` so far; prior: (2, k) mean
    and deviations of theta when the fit began; past: filtered samples (3, n, w) of each block since then, as long as a
    refit is to follow, see ``REFITS``.
    """

    shift: float
    scale_u: Array
    scale_y: Array
    theta: Array
    x: Array
    root: Array
    noise: Array
    share: Array
    chi2: float
    corner: float
    every: int
    filtered: Array
    dt: float
    angle: float
    blocks: int
    strikes: int
    lost: bool
    settling: int
    turn: float
    power: Array
    center: Array
    level: Array
    white: Array
    prior: Array
    past: tuple[Array, ...]


class Block(NamedTuple):
    """Filtered and scaled samples of a block, and the configuration in its middle; see ``simulate_block``.

    c: cos(theta2 - theta1) in the middle; turn: (N,) that cosine at each row, minus c; rates: (3,) factors on the terms
    of D; angle: theta2 - theta1 at the end [rad]; P (N, d): [p; p''; t]; bend (N, d): its changes from row to row;
    sine: sin(theta2 - theta1) in the middle.
    """

    U: Array
    slope: Array
    P: Array
    bend: Array
    V: Array
    Y: Array
    turn: Array
    dt: float
    c: float
    rates: Array
    angle: float
    sine: float


def roles(config: IdentifierParameters) -> Roles | None:
    """Return the roles of the outputs, or None where the model cannot be a function of the configuration.

    Such a model needs measured angles, at most half as many displacements as states, and no outputs besides the
    displacements and their rates. A payload that is read out of the model, or estimated with linear dynamics, needs the
    model of one working point instead.
    """
    at_one_point = config.payload_method in ('block', 'frequency') or config.payload.dynamics == 'linear'
    return None if at_one_point or not reads_angles(config) else shown(config)


def has_constant(config: IdentifierParameters) -> bool:
    """Return whether a fit may have a constant, for offsets of sensors and bends under gravity.

    With x = y, or x = [w; w'] for displacements w, no state is left to stand for them. Other models represent an offset
    by a slow pole. So their published matrices, which have no constant, predict the signals as they are measured.
    """
    return config.order == len(config.outputs) or roles(config) is not None


def shown(config: IdentifierParameters) -> Roles | None:
    """Return the roles of the outputs from their names; None where these do not suit the order or the decimation."""
    names = config.outputs
    places = tuple(k for k, name in enumerate(names) if name.endswith('/position'))
    if not 0 < 2 * len(places) <= config.order or config.decimation > 1:
        return None
    joints = [names[k].rpartition('/')[0] for k in places]
    states = []
    for name in names:
        joint, _, field = name.rpartition('/')
        if joint not in joints or field not in ('position', 'velocity'):
            return None
        states.append(joints.index(joint) + (len(places) if field == 'velocity' else 0))
    if len(names) not in (len(places), 2 * len(places)):
        return None
    return Roles(places, tuple(states))


def pairs(h: int) -> int:
    """Return the number of products of two of h displacements."""
    return h * (h + 1) // 2


def triples(h: int) -> int:
    """Return the number of products of three of h displacements."""
    return h * (h + 1) * (h + 2) // 6


def third_order(h: int) -> int:
    """Return the number of products of three of h displacements, and of one displacement and two rates."""
    return triples(h) + h * pairs(h)


@cache
def parts(h: int, r: int) -> dict[str, tuple[slice, tuple[int, ...]]]:
    """Return the slice of theta and the shape of each of its parts G, H, E, F, D, b, Q, R and zeta.

    G, H, E, Q, R have one matrix for each function of c, D has one for each factor of ``Block.rates``.
    """
    shapes = {'G': (FUNCTIONS, h, h), 'H': (FUNCTIONS, h, r), 'E': (FUNCTIONS, h, r), 'F': (h, r), 'D': (3, h, h),
              'b': (h,), 'Q': (FUNCTIONS, h, 2 * pairs(h)), 'R': (FUNCTIONS, h, third_order(h)), 'zeta': (1,)}
    found, at = {}, 0
    for name, shape in shapes.items():
        size = math.prod(shape)
        found[name] = slice(at, at + size), shape
        at += size
    return found


def part(theta: Array, name: str, h: int, r: int) -> Array:
    """Return one part of theta."""
    where, shape = parts(h, r)[name]
    return theta[where].reshape(shape)


def shares(h: int) -> Array:
    """(FUNCTIONS, h, h) prior deviations of G as shares of its largest entry."""
    own = np.eye(h, dtype=np.bool_)
    return np.array([np.where(own, KNOWN, UNEVEN), np.where(own, UNEVEN, VARIES), np.where(own, VARIES, UNEVEN)])


def prior(G: Array, H: Array, turn: float) -> Array:
    """(k,) prior standard deviations around matrices G (h, h), H (h, r) of one configuration; turn: see ``Varying``."""
    h, r = H.shape
    share = np.array([KNOWN, VARIES, VARIES])
    return np.concatenate([
        np.abs(G).max() * shares(h).ravel(), np.repeat(share * np.abs(H).max(), h * r),
        np.repeat(DIRECT * np.array([1.0, 0.3, 0.3]), h * r), np.full(h * r, DIRECT),
        np.full(h * h, DAMPED), np.full(2 * h * h, TURNING), np.full(h, OFFSET),
        np.full(2 * FUNCTIONS * h * pairs(h), SQUARES * turn),
        np.full(FUNCTIONS * h * third_order(h), CUBES * turn ** 2), np.full(1, SHARED)])


def walk(theta: Array, h: int, r: int, size: Array, turn: float) -> Array:
    """(k + 2h,) standard deviations of the random walk in a block; size: (h,) those of the displacements."""
    found = WALK * prior(part(theta, 'G', h, r)[0], part(theta, 'H', h, r)[0], turn)
    found[parts(h, r)['b'][0]] = OFFSET_WALK * size
    return np.concatenate([found, STATE_WALK * size, STATE_WALK * size])


def local(theta: Array, h: int, r: int, c: float, rates: Array, sine: float = 0.0
          ) -> tuple[Array, Array, Array, Array, Array, Array, Array]:
    """G, G1, H, H1, D, E, Q of ``simulate_block`` at the configuration c; rates, sine: see ``Block``."""
    value, by_c, _, _ = basis(c, float(theta[-1]))

    def mean(weight: Array, name: str) -> Array:
        where, shape = parts(h, r)[name]
        return np.asarray((weight @ theta[where].reshape(len(weight), -1)).reshape(shape[1:]))

    direct = np.hstack([mean(value, 'E'), part(theta, 'F', h, r), part(theta, 'b', h, r)[:, None]])
    by_products = np.hstack([sine * mean(value, 'Q'), mean(value, 'R')])
    return (mean(value, 'G'), mean(by_c, 'G'), mean(value, 'H'), mean(by_c, 'H'), mean(rates, 'D'),
            direct, by_products)


def to_local(theta: Array, h: int, r: int, c: float, rates: Array, sine: float = 0.0) -> Array:
    """(l, k + 2h) derivative of [local parameters; state] with respect to [theta; state]; see ``local``."""
    value, by_c, by_zeta, by_both = basis(c, float(theta[-1]))
    row, column, weight, (first_direct, first_product, end) = _entries(h, r)
    T = np.zeros((end + 2 * h, len(theta) + 2 * h))
    T[row, column] = np.concatenate([value, by_c, rates, sine * value, [1.0]])[weight]
    G, H, E, Q, R = (part(theta, name, h, r).reshape(FUNCTIONS, -1) for name in 'GHEQR')
    at = parts(h, r)['zeta'][0].start
    a, b, d = h * h, h * r, 2 * pairs(h)
    direct, products = (T[begin:stop].reshape(h, (stop - begin) // h, -1)
                        for begin, stop in ((first_direct, first_product), (first_product, end)))
    T[:a, at], T[a:2 * a, at] = by_zeta @ G, by_both @ G
    T[2 * a:2 * a + b, at], T[2 * a + b:2 * a + 2 * b, at] = by_zeta @ H, by_both @ H
    direct[:, :r, at] = (by_zeta @ E).reshape(h, r)
    products[:, :d, at], products[:, d:, at] = (sine * by_zeta @ Q).reshape(h, d), (by_zeta @ R).reshape(h, -1)
    return T


@cache
def _entries(h: int, r: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], tuple[int, int, int]]:
    """Rows, columns and numbers of the weights in the derivative ``to_local``, zeta's column excepted.

    The weights are those of the functions of c, of their derivatives, of ``rates``, and of the functions with the sine,
    then 1. Last come three row numbers: the first rows of the local E, of the local Q and of the state.
    """
    where = parts(h, r)
    size = where['zeta'][0].stop
    column, one, found = np.arange(size), 4 * FUNCTIONS, []
    F, b = (part(column, name, h, r) for name in 'Fb')
    for i in range(FUNCTIONS):
        G, H, D, E, Q, R = (part(column, name, h, r)[i] for name in 'GHDEQR')
        columns = G, G, H, H, D, np.hstack([E, F, b[:, None]]), np.hstack([Q, R])
        weights = i, FUNCTIONS + i, i, FUNCTIONS + i, 2 * FUNCTIONS + i, i, 3 * FUNCTIONS + i
        entries = np.concatenate([block.ravel() for block in columns])
        weight = np.concatenate([np.full(block.size, number) for block, number in zip(columns, weights, strict=True)])
        weight[np.isin(entries, np.concatenate([F.ravel(), b]))], weight[np.isin(entries, R)] = one, i
        found.append((np.arange(len(entries)), entries, weight))
    end, product = len(entries), columns[-1].size
    state = np.arange(2 * h)
    found.append((end + state, size + state, np.full(2 * h, one)))
    rows, all_columns, all_weights = (np.concatenate(some) for some in zip(*found, strict=True))
    return rows, all_columns, all_weights, (end - product - columns[-2].size, end - product, end)


def _filter(v: Varying) -> tuple[Array, Array, Array]:
    w = 2.0 * np.pi * v.corner
    A, B, C = np.zeros((5, 5)), np.zeros(4), np.zeros((3, 4))
    for i, quality in enumerate(QUALITIES):
        A[2 * i, 2 * i + 1], A[2 * i + 1, 2 * i], A[2 * i + 1, 2 * i + 1] = 1.0, -w * w, -w * quality
    A[3, 0], B[1] = w * w, w * w
    C[0, 2], C[1, 3], C[2] = 1.0, 1.0, A[3, :4]
    A[:4, 4] = B
    step = scipy.linalg.expm(A * v.dt)
    return np.ascontiguousarray(step[:4, :4]), np.ascontiguousarray(step[:4, 4]), C


def signals_of(config: IdentifierParameters, rows: Rows, role: Roles, center: Array) -> Array:
    """(N, ``width``) inputs, displacements, relative angle of the links, absolute angle of the first, and products.

    center: (h,) mean of the displacements when the fit began. Without it the products would have linear terms, and
    change G.
    """
    relative, Y = relative_angle(config, rows.angles), rows.y[:, list(role.displacements)] - center
    columns = rows.u, Y, relative, rows.angles[:, 0], products(Y, 2), products(Y, 3)
    return np.ascontiguousarray(np.column_stack(columns))


def width(h: int, r: int) -> int:
    """Return the number of columns of ``signals_of``."""
    return r + h + 2 + pairs(h) + triples(h)


def products(Y: Array, count: int) -> Array:
    """Products of each ``count`` of the columns of Y (..., h), repetitions included, in the last axis."""
    chosen = np.array(list(combinations_with_replacement(range(Y.shape[-1]), count)))
    return np.asarray(np.prod(Y[..., chosen], axis=-1))


def passed(v: Varying, signals: Array, anew: bool) -> tuple[Array, Array]:
    """Filter signals (N, w); return kept samples with their two derivatives (3, n, w), and the filter's last state."""
    state = np.zeros_like(v.filtered) if anew else v.filtered.copy()
    if anew:
        state[0], state[2] = signals[0], signals[0]  # the steady state for the first sample
    out = np.empty((3, len(signals) // v.every, signals.shape[1]))
    low_pass(signals, *_filter(v), state, v.every, out)
    return out, state


def straight(s: Array, Y: Array, angles: Array) -> Array:
    """(2 + h, a) coefficients of the least-squares fit of angles (N, a) by [1, s, Y], with s (N,) and Y (N, h).

    Encoders measure the slopes of bent links. The first two rows, a straight line in s, are the angles without bending.
    """
    found = np.linalg.lstsq(np.column_stack([np.ones(len(s)), s, Y]), angles, rcond=None)[0]
    return np.asarray(found)


def end_of_line(s: Array, Y: Array, angles: Array) -> tuple[float, float]:
    """Return the angle without bending at s = 0 and its standard deviation [rad], of the fit ``straight`` of (N,)."""
    known = np.column_stack([np.ones(len(s)), s, Y])
    found = straight(s, Y, angles[:, None])
    variance = float(np.sum((angles - known @ found[:, 0]) ** 2)) / max(len(s) - known.shape[1], 1)
    share = float(np.linalg.lstsq(known.T @ known, np.eye(known.shape[1])[0], rcond=None)[0][0])
    return float(found[0, 0]), math.sqrt(variance * share)


def block_of(v: Varying, filtered: Array) -> Block:
    """Scale filtered signals (3, n, w) and determine the configuration from their angles, see ``straight``.

    The filter holds every sample until the next one. So do the motors: a torque is exact. A displacement is late by
    half a sample time; the torques are delayed as much, by the Taylor series of exp(-s dt / 2).
    """
    (out, rate, second), r, h = filtered, len(v.scale_u), len(v.scale_y)
    n, bends, late = len(out), slice(r, r + h), 0.5 * v.dt
    U = (out[:, :r] - late * rate[:, :r] + 0.5 * late ** 2 * second[:, :r]) * v.scale_u
    Y, rates = out[:, bends] * v.scale_y, rate[:, bends] * (v.scale_y / v.shift)
    s = np.linspace(-1.0, 1.0, n, endpoint=False) + 1.0 / n
    lines, half = straight(s, Y, out[:, r + h:r + h + 2]), 0.5 * n * v.every * v.dt
    middle, relative, first = float(lines[0, 0]), float(lines[1, 0]) / half, float(lines[1, 1]) / half
    c, bent = math.cos(middle), math.sin(middle) / v.shift
    V = np.column_stack([U, second[:, :r] * (v.scale_u / v.shift ** 2), np.ones(n)])
    first_of_three = r + h + 2 + pairs(h)
    two, square = slice(r + h + 2, first_of_three), products(v.scale_y, 2)
    # The filter delays slow signals alike, so the filtered product of w w' w' is nearly that of the filtered signals.
    with_rates = (Y[:, :, None] * products(rates, 2)[:, None]).reshape(n, -1)
    P = np.ascontiguousarray(np.hstack([
        out[:, two] * square, second[:, two] * (square / v.shift ** 2),
        out[:, first_of_three:] * products(v.scale_y, 3), with_rates]))
    return Block(
        np.ascontiguousarray(U), steps(U), P, steps(P), V, np.ascontiguousarray(Y),
        np.cos(middle + lines[1, 0] * s) - c, v.every * v.dt * v.shift, c,
        np.array([1.0, bent * first, bent * (first + relative)]), middle + relative * half, math.sin(middle))


def steps(U: Array) -> Array:
    """(N, r) changes of U (N, r) from each row to the next; of the last row that before."""
    return np.diff(U, axis=0, append=2.0 * U[-1:] - U[-2:-1])


class Run(NamedTuple):
    """Simulation of a block, differentiated by the l local parameters and first states; see ``simulate_block``.

    J: (n h, l) derivative of the whitened outputs; e: (n h,) whitened residuals; moments: (h, h) sum of the residuals'
    outer products; X: (2h, l) derivative of the state at the end; end: (2h,) that state.
    """

    J: Array
    e: Array
    moments: Array
    X: Array
    end: Array


def _run(v: Varying, block: Block, theta: Array, x: Array, noise: Array) -> Run:
    h, r = len(v.scale_y), len(v.scale_u)
    size = 3 * h * h + 2 * h * r + h * (2 * r + 1) + h * (2 * pairs(h) + third_order(h)) + 2 * h
    count = block.Y.size
    J, e, moments, X = np.zeros((count, size)), np.zeros(count), np.zeros((h, h)), np.zeros((2 * h, size))
    X[:, size - 2 * h:] = np.eye(2 * h)
    end = x.copy()
    whiten = np.linalg.inv(np.linalg.cholesky(noise))
    matrices = local(theta, h, r, block.c, block.rates, block.sine)
    simulate_block(block.U, block.slope, block.P, block.bend, block.V, block.Y, block.turn, block.dt, *matrices, end,
                   whiten, J, e, moments, X)
    return Run(J, e, moments, X, end)


def _first_state(v: Varying, block: Block, noise: Array) -> Array:
    """(2h,) first state that fits a block best with the present parameters: a linear least-squares problem."""
    run, n = _run(v, block, v.theta, np.zeros_like(v.x), noise), len(v.x)
    J = run.J[:, -n:]
    return np.asarray(np.linalg.solve(J.T @ J + np.eye(n) / UNKNOWN ** 2, J.T @ run.e))


def noise_of(signals: Array, v: Varying) -> Array:
    """(h, h) covariance of the sensors' white noise after the filter, from fourth differences of signals (N, w).

    Modes near the sample rate add to it while they ring, so the least average over ``NOISE_BLOCKS`` blocks is that of
    the noise (minimum statistics, Martin 2001). The least single block of ten minutes has 0.58 of the variance, which
    256 samples tell to 15 %.
    """
    r, h = len(v.scale_u), len(v.scale_y)
    scaled = signals[:, r:r + h] * v.scale_y
    inside = 2.0 * v.corner * v.dt
    return np.diag(np.maximum(white_noise(scaled) * inside, (1e-4 * np.std(scaled, axis=0) + 1e-12) ** 2))


def updated(v: Varying, blocks: Sequence[Block], noise: Array, white: Array, iterations: int,
            mean: Array | None = None) -> Varying | None:
    """Update parameters and state with one or more blocks; None where a number is not finite.

    mean: (k,) prior mean of the parameters, by default those of v; noise: (h, h) covariance that weighs the residuals;
    white: (h, h) that of the sensors.

    The first block starts from the state of v. The first state of each further block is unknown, as after a gap.
    """
    h, r, k = len(v.scale_y), len(v.scale_u), len(v.theta)
    root = v.root
    if v.blocks:
        root = triangle(np.hstack([root, np.diag(walk(v.theta, h, r, np.std(blocks[0].Y, axis=0), v.turn))]).T).T
    after_gap = bool(v.blocks) and not v.x.any()
    first = _first_state(v, blocks[0], noise) if after_gap else v.x
    fit = _fitted(v, blocks, noise, white, iterations, root, first, mean)
    if fit is None:
        return None
    theta, runs, after, missed = fit
    block, run, Y = blocks[-1], runs[-1], np.vstack([block.Y for block in blocks])
    moments = np.sum([one.moments for one in runs], axis=0) / len(Y)
    after[k:] = run.X @ to_local(theta, h, r, block.c, block.rates, block.sine) @ after
    fresh = max(1.0 / (v.blocks + 1.0), 1.0 / NOISE_BLOCKS)
    known = (1.0 - fresh) * v.noise + fresh * moments if v.blocks else moments
    share, chi2, strikes = v.share, v.chi2, 0
    lately = 1.0 / min(v.blocks + 1, SHARE_BLOCKS)
    power = v.power + (np.cov(Y.T, bias=True).reshape(h, h) - v.power) * lately
    if not v.blocks:
        share, chi2 = np.sqrt(np.diag(moments) / np.var(Y, axis=0)), float(np.mean(np.diag(moments) / np.diag(white)))
    elif not after_gap:  # after a gap the state is unknown, so the block has no prediction
        part_of = max(1.0 / v.blocks, 1.0 / SHARE_BLOCKS)
        strikes = v.strikes + 1 if float(missed.share.max()) > UNPREDICTED else 0
        share, chi2 = share + (missed.share - share) * part_of, chi2 + (missed.chi2 - chi2) * part_of
    return v._replace(theta=theta, x=run.end, root=after if len(blocks) == 1 else triangle(after.T).T, noise=known,
                      share=share, chi2=chi2, power=power, angle=block.angle, blocks=v.blocks + 1,
                      strikes=strikes)


def _fitted(v: Varying, blocks: Sequence[Block], noise: Array, white: Array, iterations: int, root: Array, x: Array,
            mean: Array | None) -> tuple[Array, list[Run], Array, Missed] | None:
    """Return theta, the runs with it, the covariance root of theta and the last block's first state, and ``Missed``.

    ``Missed`` is that of the prediction before the first iteration. The Gauss-Newton iterations run in z, where
    [theta; first states] = base + root z and z has unit prior covariance. With more than one iteration a step that
    raises the cost is shortened (backtracking).
    """
    h, r, k, n = len(v.scale_y), len(v.scale_u), len(v.theta), len(v.x)
    wide = max(1.0, 1.0 / (2.1 * v.corner * v.dt * v.every))  # correlated noise: so many samples count as one
    root = scipy.linalg.block_diag(root, *[UNKNOWN * np.eye(n)] * (len(blocks) - 1))
    base = np.concatenate([v.theta, x, *(_first_state(v, block, noise) for block in blocks[1:])])
    places = [np.r_[:k, k + j * n:k + j * n + n] for j in range(len(blocks))]

    def runs_at(z: Array) -> tuple[Array, list[Run]]:
        found = base + root @ z
        return found[:k], [_run(v, block, found[:k], found[at[k:]], noise)
                           for block, at in zip(blocks, places, strict=True)]

    missed, after, step, i = Missed(v.share, v.chi2), root, np.zeros(len(base)), 0
    center = np.zeros(len(base))
    if mean is not None:
        center[:k] = solved(root[:k, :k].T, mean - v.theta, trans=1)
    best, lowest, z = step, math.inf, step
    for _ in range(MOST_TRIALS * iterations + 1):
        theta, runs = runs_at(z)
        if not all(np.all(np.isfinite(run.J)) and np.all(np.isfinite(run.end)) for run in runs):
            return None
        cost = sum(float(np.trace(np.linalg.solve(noise, run.moments))) for run in runs) / wide
        cost += float((z - center) @ (z - center))
        if cost > lowest and iterations > 1:
            step = SHORTER * step
            z = best + step
            continue
        best, lowest = z, cost
        if i == iterations:
            break
        rows, gradient = [], center - z
        for block, run, at in zip(blocks, runs, places, strict=True):
            along = to_local(theta, h, r, block.c, block.rates, block.sine)
            J = triangle(run.J)
            if i == 0:
                missed = _missed(block, run, noise, white, wide, along[:, :k] @ root[:k])
            turned = along @ root[at]
            rows.append(J @ turned / math.sqrt(wide))
            gradient = gradient + turned.T @ (run.J.T @ run.e) / wide
        tall = np.vstack(rows)
        try:
            after, step = conditioned(root, tall if len(tall) < len(root) else triangle(tall), gradient)
        except np.linalg.LinAlgError:  # the information overflows
            return None
        size = float(np.linalg.norm(step))
        if size < 0.1 and i:
            break
        z, i = z + step, i + 1
    if z is not best:
        theta, runs = runs_at(best)
    return theta, runs, after[places[-1]], missed


def conditioned(root: Array, J: Array, gradient: Array) -> tuple[Array, Array]:
    """Square-root measurement update (Andrews 1968): S with S S' = root (I + J'J)^-1 root', and (I + J'J)^-1 gradient.

    root: (k, k), J: (l, k), of fewer rows than root, gradient: (k,). Raises LinAlgError where I + JJ' is not finite.
    """
    one: Array = np.eye(len(J))
    lower: Array = np.linalg.cholesky(one + J @ J.T)  # type: ignore[assignment]
    whole = solved(lower.T, solved((lower + one).T, J, trans=1))
    step = gradient - J.T @ solved(lower.T, solved(lower.T, J @ gradient, trans=1))
    return root - (root @ J.T) @ whole, step


class Missed(NamedTuple):
    """Errors of the prediction of a block beyond those that the parameters' deviations explain.

    share: (h,) of the outputs' amplitude; chi2: normalized innovation squared over its expectation, with the sensors'
    white noise.
    """

    share: Array
    chi2: float


def _missed(block: Block, run: Run, noise: Array, white: Array, wide: float, root: Array) -> Missed:
    """Return what the prediction of a block misses, apart from a constant: the offset b may walk.

    root: (l, k + n) rows of the parameters' covariance root, as local parameters. With J = [residuals' derivative] root
    in units of the noise, so many rows of which count as one (``wide``), the innovations e have the covariance S = wide
    I + J J', and chi2 = wide e' S^-1 e / N is 1 on average.
    """
    n, h = block.Y.shape
    whole = np.column_stack([run.e, run.J @ root]).reshape(n, h, -1)
    whole -= np.mean(whole, axis=0)
    explained = 1.0 + float(np.sum(whole[:, :, 1:] ** 2)) / (n * h)
    whole = np.einsum('op,npc->noc', np.linalg.cholesky(noise), whole)
    left = np.var(whole[:, :, 0], axis=0)
    share = np.sqrt(left / np.maximum(np.var(block.Y, axis=0), np.diag(noise))) / explained ** 0.25
    whole = (whole / np.sqrt(np.diag(white))[:, None]).reshape(n * h, -1)
    e, J = whole[:, 0], whole[:, 1:]
    seen = J.T @ e
    within = seen @ np.linalg.solve(wide * np.eye(J.shape[1]) + J.T @ J, seen)
    return Missed(share, float(e @ e - within) / len(e))


def advance(config: IdentifierParameters, v: Varying, rows: Rows) -> Varying | None:
    """Update the fit with a block of ``BLOCK`` samples; None where the fit ends, see ``STRIKES`` and ``updated``."""
    role = shown(config)
    assert role is not None
    signals, end = signals_of(config, rows, role, v.center), 0
    for first, last in measured(v, signals, rows.missing):
        done = taken(lost(v) if first > end else v, signals[first:last])
        if done is None or done.strikes >= STRIKES:
            return None
        v, end = done, last
    return lost(v) if end < len(rows) else v


def measured(v: Varying, signals: Array, missing: NDArray[np.int64]) -> list[tuple[int, int]]:
    """First row and the row after the last one of each part of signals (N, w) without a gap; missing: see ``Rows``.

    Missing samples are bridged by straight lines; over more than a quarter of the period of the filter's corner they
    are a gap. The length of a part is a multiple of ``every``, so the filter keeps its last row and the state is that
    at its end.
    """
    blind = ~np.all(np.isfinite(signals), axis=1)
    after = np.append(missing[1:], 0)
    for last in np.flatnonzero((missing > after) & (missing * v.dt > 0.25 / v.corner)):
        blind[max(last + 1 - missing[last], 0):last + 1] = True
    edges = np.flatnonzero(np.diff(np.concatenate([[True], blind, [True]]).astype(np.int8))).reshape(-1, 2)
    return [(int(first + (last - first) % v.every), int(last)) for first, last in edges if last - first >= v.every]


def taken(v: Varying, signals: Array) -> Varying | None:
    """Update the fit with samples (N, w) that have no gap between them, once the filter has settled."""
    out, state = passed(v, signals, v.lost)
    waiting = settling(v) if v.lost else v.settling
    if v.lost or waiting:
        angle = float(out[0, -1, len(v.scale_u) + len(v.scale_y)])
        v = reopened(v, max(waiting - out.shape[1], 0))._replace(angle=angle)
        out = out[:, waiting:]
    v = v._replace(filtered=state)
    if out.shape[1] < BLOCK // v.every // 4:  # a gap follows, or the filter has just settled
        return v
    iterations = ITERATIONS if v.blocks < SHARE_BLOCKS else 1
    level = v.level + (noise_of(signals, v) - v.level) / NOISE_BLOCKS
    v = v._replace(level=level, white=np.minimum(v.white, level))
    count = v.blocks + 1
    past = (*v.past, out) if count <= REFITS[-1] else ()
    done = updated(v, [block_of(v, out)], v.noise + 0.05 * v.white, v.white, iterations)
    if done is not None and count in REFITS:
        done = _refitted(done, past)
    return done if done is None else done._replace(past=past if count < REFITS[-1] else ())


def _refitted(v: Varying, past: Sequence[Array]) -> Varying:
    """Fit all blocks since the begin again, each from an unknown state; see ``REFITS``.

    It is the batch Gauss-Newton fit with the prior of the begin. Its minimum and its information replace those of the
    recursion; where a number is not finite the recursion goes on.
    """
    mean, deviation = v.prior
    noise, blocks = v.noise + 0.05 * v.white, [block_of(v, out) for out in past]
    begun = v._replace(blocks=0, root=np.diag(np.concatenate([deviation, np.full(len(v.x), UNKNOWN)])))
    begun = begun._replace(x=_first_state(begun, blocks[0], noise))
    done = updated(begun, blocks, noise, v.white, ITERATIONS, mean)
    return v if done is None else v._replace(theta=done.theta, x=done.x, root=done.root, noise=done.noise)


def reopened(v: Varying, waiting: int) -> Varying:
    """Make the state unknown, as it is after a gap; waiting: see ``settling`` of ``Varying``."""
    k, n = len(v.theta), len(v.x)
    root = np.zeros_like(v.root)
    root[:k, :k] = triangle(v.root[:k].T).T
    root[k:, k:] = UNKNOWN * np.eye(n)
    return v._replace(lost=False, settling=waiting, root=root, x=np.zeros(n))


def settling(v: Varying) -> int:
    """Return the number of kept samples after which a restarted filter has settled."""
    return math.ceil(SETTLE / (v.corner * v.dt * v.every))


def lost(v: Varying) -> Varying:
    """Mark that samples are missing: the parameters are kept, filter and state restart."""
    return v._replace(lost=True)
