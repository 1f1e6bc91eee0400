"""The model as a function of the configuration: a recursive output-error fit that goes on while the arm moves.

In the basis x = [w; w'] of the measured displacements no change of coordinates is needed as the arm turns:

    w'' = -G(c) w - D w' + H(c) tau,   y = w + E(c) tau + F tau'' + b,   c = cos(theta2 - theta1)

G, H and E are linear in three functions of c (``varying_kernel.basis``). D holds two terms with the rates of the
links, b is a slow offset, F and E stand for the modes above those of the model. Samples pass one low-pass filter
above the modes; blocks of ``BLOCK`` of them update parameters and state together, as in ``recursive_fit``.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np
import scipy

from flexmanip_ros.identification.moments import triangle
from flexmanip_ros.identification.prediction_error import condition
from flexmanip_ros.identification.varying_kernel import basis, low_pass, simulate_block
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.samples.signals import reads_angles, relative_angle
from flexmanip_ros.types import Array

FUNCTIONS = 3
"""Functions of the configuration, see ``varying_kernel.basis``."""
LONGEST_STEP = 3.0
"""Largest step of an iteration in units of the prior deviations."""
VARIES, KNOWN = 0.12, 1.0
"""Prior deviations, as shares of the largest entry: of the parts of G and H that vary with c, and of the rest."""
DIRECT, DAMPED, TURNING, OFFSET, SHARED = 0.05, 0.05, 2.0, 0.3, 1.0
"""Prior deviations of E and F, D, its terms with rates, b and zeta; signals at unit power, time in 1 / shift."""
WALK = 0.001
"""Standard deviation by which a parameter may move in a block, as a share of its prior one."""
STATE_WALK, OFFSET_WALK = 0.005, 0.01
"""The same of the state and of the offset b, as shares of the size of the displacements."""
NOISE_BLOCKS, SHARE_BLOCKS = 8, 16
"""Blocks over which the noise, and the share that is not predicted, are remembered."""
UNPREDICTED = 0.7
"""Share of an output's amplitude that the prediction of a block may miss before it counts against the model."""
STRIKES = 3
"""Such blocks in a row that end the fit."""
UNKNOWN = 3.0
"""Standard deviation of a state of which nothing is known, in signals of unit power."""
AT_REST = np.array([1.0, 0.0, 0.0])
"""Factors on the parts of D when the links stand still."""
QUALITIES = (1.0 / 0.5411961, 1.0 / 1.3065630)
"""Damping of the two stages of a Butterworth filter of fourth order, times two."""


class Roles(NamedTuple):
    """Which outputs are displacements (h), and for each output the state that it shows."""

    displacements: tuple[int, ...]
    states: tuple[int, ...]


class Varying(NamedTuple):
    """The fit and what it remembers, constant in size; h displacements, r inputs, k parameters.

    shift: unit of time [1/s]; scale_u (r,), scale_y (h,): factors on signals; theta: (k,) see ``parts``; x: (2h,);
    root: (k + 2h, k + 2h) S with S S' their covariance; noise: (h, h); averaged over the last blocks, share: (h,) of
    the outputs' amplitude that the prediction of a block misses, and swing: ``Block.swing``; corner [Hz], every: the
    filter and the samples that it keeps one of; filtered: (4, r + h + 2) its state; dt: sample time [s]; angle, rate:
    relative angle of the links at the end [rad, rad/s]; blocks: number taken; strikes: bad ones in a row; lost: samples
    were missing, so filter and state begin anew; gain: (n, m) published K.
    """

    shift: float
    scale_u: Array
    scale_y: Array
    theta: Array
    x: Array
    root: Array
    noise: Array
    share: Array
    swing: float
    corner: float
    every: int
    filtered: Array
    dt: float
    angle: float
    rate: float
    blocks: int
    strikes: int
    lost: bool
    gain: Array


class Block(NamedTuple):
    """Filtered and scaled samples, and the configuration in the middle of them; see ``simulate_block``.

    swing: square of the angle through which a link swings with the displacements, summed over the links [rad^2]; that
    of a sinusoid is twice its mean square.
    """

    U: Array
    slope: Array
    V: Array
    Y: Array
    s: Array
    dt: float
    c: float
    by_s: float
    rates: Array
    angle: float
    rate: float
    swing: float


def roles(config: IdentifierParameters) -> Roles | None:
    """Return the roles of the outputs, or None where the model cannot be one of the configuration.

    It needs angles, at most half as many displacements as states, and no other outputs than these and their rates. A
    payload that is read out of the model, or has linear dynamics, is weighed at one working point, with that model.
    """
    at_one_point = config.payload_method in ('block', 'frequency') or config.payload.dynamics == 'linear'
    return None if at_one_point or not reads_angles(config) else shown(config)


def shown(config: IdentifierParameters) -> Roles | None:
    """Return the roles of the outputs by their names alone."""
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


@cache
def parts(h: int, r: int) -> dict[str, tuple[slice, tuple[int, ...]]]:
    """Return where each part of theta stands, and its shape: G, H, E by functions of c, F, D by rates, b, zeta."""
    shapes = {'G': (FUNCTIONS, h, h), 'H': (FUNCTIONS, h, r), 'E': (FUNCTIONS, h, r), 'F': (h, r), 'D': (3, h, h),
              'b': (h,), 'zeta': (1,)}
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


def prior(G: Array, H: Array) -> Array:
    """(k,) prior standard deviations around matrices G (h, h), H (h, r) of one configuration."""
    h, r = H.shape
    share = np.array([KNOWN, VARIES, VARIES])
    return np.concatenate([
        np.repeat(share * np.abs(G).max(), h * h), np.repeat(share * np.abs(H).max(), h * r),
        np.repeat(DIRECT * np.array([1.0, 0.3, 0.3]), h * r), np.full(h * r, DIRECT),
        np.full(h * h, DAMPED), np.full(2 * h * h, TURNING), np.full(h, OFFSET), np.full(1, SHARED)])


def walk(theta: Array, h: int, r: int, size: Array) -> Array:
    """(k + 2h,) standard deviations of the random walk in a block whose displacements have the size (h,)."""
    found = WALK * prior(part(theta, 'G', h, r)[0], part(theta, 'H', h, r)[0])
    found[parts(h, r)['b'][0]] = OFFSET_WALK * size
    return np.concatenate([found, STATE_WALK * size, STATE_WALK * size])


def local(theta: Array, h: int, r: int, c: float, by_s: float, rates: Array
          ) -> tuple[Array, Array, Array, Array, Array, Array]:
    """G, G1, H, H1, D, E of ``simulate_block`` at c, where c changes by ``by_s`` towards the end of the block."""
    value, by_c, _ = basis(c, float(theta[-1]))
    G, H, E = (part(theta, name, h, r) for name in 'GHE')
    D = np.tensordot(rates, part(theta, 'D', h, r), 1)
    direct = np.hstack([np.tensordot(value, E, 1), part(theta, 'F', h, r), part(theta, 'b', h, r)[:, None]])
    return (np.tensordot(value, G, 1), np.tensordot(by_c * by_s, G, 1), np.tensordot(value, H, 1),
            np.tensordot(by_c * by_s, H, 1), D, direct)


def to_local(theta: Array, h: int, r: int, c: float, by_s: float, rates: Array) -> Array:
    """(l, k + 2h) derivative of the local parameters and the state by theta and the state."""
    value, by_c, by_zeta = basis(c, float(theta[-1]))
    at = {name: where.start for name, (where, _) in parts(h, r).items()}
    a, b, q, k = h * h, h * r, 2 * r + 1, len(theta)
    at_e = 3 * a + 2 * b
    T = np.zeros((at_e + h * q + 2 * h, k + 2 * h))
    for i in range(FUNCTIONS):
        j = np.arange(a)
        T[j, at['G'] + i * a + j], T[a + j, at['G'] + i * a + j] = value[i], by_c[i] * by_s
        T[2 * a + 2 * b + j, at['D'] + i * a + j] = rates[i]
        j = np.arange(b)
        T[2 * a + j, at['H'] + i * b + j], T[2 * a + b + j, at['H'] + i * b + j] = value[i], by_c[i] * by_s
        T[at_e + j // r * q + j % r, at['E'] + i * b + j] = value[i]
        if i == 0:
            T[at_e + j // r * q + r + j % r, at['F'] + j] = 1.0
    j = np.arange(h)
    T[at_e + j * q + 2 * r, at['b'] + j] = 1.0
    T[:a, at['zeta']] = np.tensordot(by_zeta, part(theta, 'G', h, r), 1).ravel()
    T[2 * a:2 * a + b, at['zeta']] = np.tensordot(by_zeta, part(theta, 'H', h, r), 1).ravel()
    j = np.arange(2 * h)
    T[at_e + h * q + j, k + j] = 1.0
    return T


def _filter(v: Varying) -> tuple[Array, Array, Array]:
    w = 2.0 * np.pi * v.corner
    A, B, C = np.zeros((5, 5)), np.zeros(4), np.zeros((2, 4))
    for i, quality in enumerate(QUALITIES):
        A[2 * i, 2 * i + 1], A[2 * i + 1, 2 * i], A[2 * i + 1, 2 * i + 1] = 1.0, -w * w, -w * quality
    A[3, 0], B[1] = w * w, w * w
    C[0, 2], C[1] = 1.0, A[3, :4]
    A[:4, 4] = B
    step = scipy.linalg.expm(A * v.dt)
    return np.ascontiguousarray(step[:4, :4]), np.ascontiguousarray(step[:4, 4]), C


def signals_of(config: IdentifierParameters, rows: Rows, role: Roles) -> Array:
    """(N, r + h + 2) inputs, displacements, relative angle of the links and absolute angle of the first."""
    relative = relative_angle(config, rows.angles)
    columns = rows.u, rows.y[:, list(role.displacements)], relative, rows.angles[:, 0]
    return np.ascontiguousarray(np.column_stack(columns))


def passed(v: Varying, signals: Array, anew: bool) -> tuple[Array, Array, Array]:
    """Filter signals (N, w): those that are kept, their second derivatives, and the state of the filter."""
    state = np.zeros_like(v.filtered) if anew else v.filtered.copy()
    if anew:
        state[0], state[2] = signals[0], signals[0]  # as if the first sample had been there for long
    count = len(signals) // v.every
    out, second = np.empty((count, signals.shape[1])), np.empty((count, signals.shape[1]))
    low_pass(signals, *_filter(v), state, v.every, out, second)
    return out, second, state


def block_of(v: Varying, out: Array, second: Array) -> Block:
    """Scale filtered signals (N, w) and find the configuration in them.

    The angles are straight lines and what goes with the displacements: encoders see the slopes of bent links.
    """
    r, h, n = len(v.scale_u), len(v.scale_y), len(out)
    U, Y = out[:, :r] * v.scale_u, out[:, r:r + h] * v.scale_y
    s = np.asarray((np.arange(n) - 0.5 * (n - 1)) / (0.5 * n), dtype=np.float64)
    lines = np.linalg.lstsq(np.column_stack([np.ones(n), s, Y - Y.mean(axis=0)]), out[:, r + h:], rcond=None)[0]
    half, turns = 0.5 * n * v.every * v.dt, Y @ lines[2:]
    middle, relative, first = float(lines[0, 0]), float(lines[1, 0]) / half, float(lines[1, 1]) / half
    bent = math.sin(middle) / v.shift
    slope = np.zeros_like(U)
    slope[:-1] = U[1:] - U[:-1]
    slope[-1] = slope[-2]
    V = np.column_stack([U, second[:, :r] * (v.scale_u / v.shift ** 2), np.ones(n)])
    return Block(
        np.ascontiguousarray(U), slope, V, np.ascontiguousarray(Y), s, v.every * v.dt * v.shift, math.cos(middle),
        -math.sin(middle) * relative * half, np.array([1.0, bent * first, bent * (first + relative)]),
        middle + relative * half, relative, 2.0 * float(np.var(turns[:, 1]) + np.var(turns.sum(axis=1))))


def _run(v: Varying, block: Block, theta: Array, x: Array, noise: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Information (l, l), gradient (l,), residual moments, derivative of the state at the end, and that state."""
    h, r = len(v.scale_y), len(v.scale_u)
    width = 3 * h * h + 2 * h * r + h * (2 * r + 1) + 2 * h
    N, g, moments, X = np.zeros((width, width)), np.zeros(width), np.zeros((h, h)), np.zeros((2 * h, width))
    X[:, width - 2 * h:] = np.eye(2 * h)
    end = x.copy()
    whiten = np.linalg.inv(np.linalg.cholesky(noise))
    G, G1, H, H1, D, E = local(theta, h, r, block.c, block.by_s, block.rates)
    simulate_block(block.U, block.slope, block.V, block.Y, block.s, block.dt, G, G1, H, H1, D, E, end, whiten, N, g,
                   moments, X)
    return N, g, moments / len(block.U), X, end


def noise_of(signals: Array, v: Varying) -> Array:
    """(h, h) covariance of the sensors' white noise behind the filter, by fourth differences of signals (N, w)."""
    r, h = len(v.scale_u), len(v.scale_y)
    white = np.median(np.abs(np.diff(signals[:, r:r + h], 4, axis=0)), axis=0) / (0.6745 * math.sqrt(70.0))
    size = np.std(signals[:, r:r + h], axis=0) * v.scale_y
    inside = math.sqrt(2.0 * v.corner * v.dt)
    return np.diag(np.maximum(white * v.scale_y * inside, 1e-4 * size + 1e-12) ** 2)


def updated(v: Varying, block: Block, noise: Array, iterations: int) -> Varying | None:
    """Update parameters and state by one block; None where the numbers leave the finite range."""
    h, r, k = len(v.scale_y), len(v.scale_u), len(v.theta)
    wide = max(1.0, 1.0 / (2.1 * v.corner * v.dt * v.every))  # filtered noise: that many samples say what one says
    root = v.root
    if v.blocks:
        root = triangle(np.hstack([root, np.diag(walk(v.theta, h, r, np.std(block.Y, axis=0)))]).T).T
    theta, x, z = v.theta, v.x, np.zeros(k + 2 * h)
    share, after, moments = v.share, root, noise
    for i in range(iterations):
        N, g, moments, _, _ = _run(v, block, theta, x, noise)
        if not np.all(np.isfinite(N)):
            return None
        if i == 0:
            power = np.maximum(np.var(block.Y, axis=0), np.diag(noise))
            share = np.sqrt(np.diag(moments) / power)
        derivative = to_local(theta, h, r, block.c, block.by_s, block.rates)
        if i == 0:  # what the parameters' own deviations explain of it is no fault of the model
            own = derivative[:, :k] @ root[:k]
            share = share / (1.0 + float(np.sum((N @ own) * own)) / block.Y.size) ** 0.25
        turned = derivative @ root
        after, step = root.copy(), np.empty(k + 2 * h)
        condition(turned.T @ N @ turned / wide, after, turned.T @ g / wide - z, step)
        size = float(np.linalg.norm(step))
        if not np.isfinite(size):
            return None
        z = z + (step * min(1.0, LONGEST_STEP / size) if iterations > 1 and size > 0.0 else step)
        moved = root @ z
        theta, x = v.theta + moved[:k], v.x + moved[k:]
        if size < 0.1:
            break
    _, _, moments, X, end = _run(v, block, theta, x, noise)
    if not np.all(np.isfinite(moments)) or not np.all(np.isfinite(end)):
        return None
    arrival = X @ to_local(theta, h, r, block.c, block.by_s, block.rates)
    after[k:] = arrival @ after
    fresh = max(1.0 / (v.blocks + 1.0), 1.0 / NOISE_BLOCKS)
    known = (1.0 - fresh) * v.noise + fresh * moments if v.blocks else moments
    if not v.blocks:
        share, strikes = np.sqrt(np.diag(moments) / np.var(block.Y, axis=0)), 0
    elif not v.x.any():  # after a loss the state was unknown: that was no prediction
        share, strikes = v.share, 0
    else:
        strikes = v.strikes + 1 if float(share.max()) > UNPREDICTED else 0
        share = v.share + (share - v.share) * max(1.0 / v.blocks, 1.0 / SHARE_BLOCKS)
    return v._replace(theta=theta, x=end, root=after, noise=known, share=share, angle=block.angle, rate=block.rate,
                      swing=v.swing + (block.swing - v.swing) * max(1.0 / (v.blocks + 1.0), 1.0 / SHARE_BLOCKS),
                      blocks=v.blocks + 1, strikes=strikes)


def advance(config: IdentifierParameters, v: Varying, rows: Rows) -> Varying | None:
    """Take a block of ``BLOCK`` samples; None where the fit has come to its end."""
    role = shown(config)
    assert role is not None
    signals = signals_of(config, rows, role)
    # a straight line through more missing samples than that is no motion that the filter lets pass
    blind = int(rows.missing.max()) * v.dt > 0.25 / v.corner
    if blind or not np.all(np.isfinite(signals)):
        return v._replace(lost=True)
    out, second, state = passed(v, signals, v.lost)
    v = v._replace(filtered=state)
    if v.lost:  # the filter settles; the state is unknown
        k, n = len(v.theta), len(v.x)
        root = np.zeros_like(v.root)
        root[:k, :k] = triangle(v.root[:k].T).T
        root[k:, k:] = UNKNOWN * np.eye(n)
        block = block_of(v, out, second)
        return v._replace(lost=False, root=root, x=np.zeros(n), angle=block.angle, rate=block.rate)
    done = updated(v, block_of(v, out, second), v.noise + 0.05 * noise_of(signals, v), 1)
    return None if done is None or done.strikes >= STRIKES else done


def lost(v: Varying) -> Varying:
    """Samples are missing: what was learnt is kept, the state is unknown."""
    return v._replace(lost=True)
