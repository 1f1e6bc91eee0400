"""Start of the parameter-varying fit, from the fit of one configuration or from the model before an event."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.errors import ModelError
from flexmanip_ros.identification import parameter_varying as lpv
from flexmanip_ros.identification.batch_fit import BLOCK, Recursion
from flexmanip_ros.identification.prediction_check import DAMPED
from flexmanip_ros.identification.realization import known_output_basis, slowest, to_continuous, transform
from flexmanip_ros.identification.varying_kernel import basis
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.samples.signals import relative_angle
from flexmanip_ros.types import Array, StateSpace

CUTOFF = 2.0
"""Ratio of the corner frequency of the low-pass filter to the highest frequency of the model."""
FINE = 18.0
"""Least number of kept samples per period of the corner frequency; torques are taken as linear between them."""
WINDOW = 1024
"""Number of samples in the longest stretch that is fitted at once, as one block."""
GROWTH = (256, 512, 640, 768, WINDOW)
"""Numbers of samples of the growing stretches up to that one; each fit starts from the previous one."""
FEWEST = 24
"""Least number of kept samples in a block of a first fit, after the settling time of the filter."""
ITERATIONS = 8
CENTERED = 2
"""Number of first fits, each around the offsets that the one before found: the mean of a few periods is no offset."""
LATE = 16.0
"""Factor on the noise covariance in fits of fewer than ``WINDOW`` samples, whose starting model may be far off."""
ZETA = 0.8
"""First value of zeta: k = 0.69."""
MOST_SWING = 0.04
"""Largest square of the swing's amplitude [rad^2] at which a fit may begin. In the 12 s after a begin f1 of the default
arm is 0.3 to 0.6 % off (median) up to 0.03, and no band misses by a factor of three; above 0.05 10 % do."""
SAME = 0.3
"""Factor on the prior deviations around the model before an event: the arm is the same, its object another."""


def from_model(model: StateSpace, role: lpv.Roles) -> tuple[Array, Array, Array] | None:
    """G, D, H of a model of one configuration, in its own units; None without h lightly damped oscillations.

    From a model with more modes than the h displacements the slowest modes are taken.
    """
    h = len(role.displacements)
    if model.order > 2 * h:
        slow = slowest(model, h, DAMPED)  # a fit may start from modes below this damping ratio alone
        if slow is None:
            return None
        model = slow
    seen = model.C[list(role.displacements)]  # from these alone x = [w; w'], where w' is the derivative of w
    W = known_output_basis(replace(model, C=seen, D=model.D[list(role.displacements)]))
    if W is None:
        return None
    moved = transform(model, W)
    try:
        A, B = to_continuous(moved.A, moved.B, model.dt)
    except (ModelError, np.linalg.LinAlgError):
        return None
    G, D, H = -A[h:, :h], -A[h:, h:], B[h:]
    values = np.linalg.eigvals(np.block([[np.zeros((h, h)), np.eye(h)], [-G, -D]]))
    swings = values[values.imag > 0.0]
    if len(swings) != h or not np.all(np.abs(swings.real) < DAMPED * swings.imag):
        return None
    return G, D, H


def start(config: IdentifierParameters, rows: Rows, old: Recursion | None, before: lpv.Varying | None
          ) -> lpv.Varying | None:
    """Start with a stretch of samples, from the fit of one configuration or from the model before an event."""
    role = lpv.roles(config)
    if role is None or len(rows) < GROWTH[0] or rows.angles.shape[1] != 2 or (old is None and before is None):
        return None
    stamps = rows.stamp_ns
    dt = float(stamps[-1] - stamps[0]) * 1e-9 / (len(rows) - 1)
    h, r, c = len(role.displacements), len(config.inputs), math.cos(float(np.mean(relative_angle(config, rows.angles))))
    if before is not None:
        begun: lpv.Varying | None = before._replace(x=np.zeros(2 * h), blocks=0, strikes=0, lost=False, settling=0)
    else:
        assert old is not None
        begun = _from_recursion(old, role, r, dt, c)
    if begun is None or begun.every < 1 or GROWTH[0] % begun.every:
        return None
    Y = rows.y[:, list(role.displacements)]
    power = np.concatenate([np.mean(rows.u ** 2, axis=0), np.var(Y, axis=0)])
    if not np.all(power > 0.0) or not np.all(np.isfinite(power)):
        return None
    G, _, H, _, D, _, _ = lpv.local(begun.theta, h, r, c, lpv.AT_REST)
    unit = 1.0 / np.sqrt(power)
    more_u, more_y = unit[:r] / begun.scale_u, unit[r:] / begun.scale_y
    ratio = more_y[:, None] / more_y
    turn = _turn(config, rows, Y * unit[r:])
    if 2.0 * turn ** 2 > MOST_SWING:
        return None
    theta, root = _around(G * ratio, H * more_y[:, None] / more_u, D * ratio, c, turn)
    if before is not None:  # the arm is the same, its object another; the products start anew
        known = np.ones(len(theta))
        known[:lpv.parts(h, r)['Q'][0].start], known[-1] = SAME, SAME
        root[:len(theta), :len(theta)] *= known
    return _fit_stretch(config, begun._replace(
        dt=dt, theta=theta, root=root, scale_u=unit[:r], scale_y=unit[r:], turn=turn,
        center=np.mean(Y, axis=0), prior=np.stack([theta, np.diag(root)[:len(theta)]]), past=()), rows, role)


def _turn(config: IdentifierParameters, rows: Rows, Y: Array) -> float:
    """Return the angle through which the links swing with displacements Y (N, h) [rad, rms]."""
    angles = np.column_stack([relative_angle(config, rows.angles), rows.angles[:, 0]])
    turns = Y @ lpv.straight(np.linspace(-1.0, 1.0, len(Y)), Y, angles)[2:]
    return math.sqrt(float(np.var(turns[:, 1]) + np.var(turns.sum(axis=1))))  # relative angle, and that of link 1


def _around(G: Array, H: Array, D: Array, c: float, turn: float) -> tuple[Array, Array]:
    """Theta that is most likely under the prior among those that have these matrices at c, and the prior's root.

    The root is that of the covariance of [theta; state].
    """
    h, r = H.shape
    value, variance = basis(c, ZETA)[0][:, None, None], lpv.shares(h) ** 2
    g = variance * value / np.sum(variance * value ** 2, axis=0) * G
    b, d = (np.concatenate([X.ravel(), np.zeros(2 * X.size)]) for X in (H, D))
    rest = sum(lpv.parts(h, r)[name][0].stop - lpv.parts(h, r)[name][0].start for name in 'bQR')
    theta = np.concatenate([g.ravel(), b, np.zeros(4 * h * r), d, np.zeros(rest), np.full(1, ZETA)])
    return theta, np.diag(np.concatenate([lpv.prior(G, H, turn), np.full(2 * h, lpv.UNKNOWN)]))


def _from_recursion(old: Recursion, role: lpv.Roles, r: int, dt: float, c: float) -> lpv.Varying | None:
    fit, scale = old.theta, old.scale
    found = from_model(StateSpace(fit.A, fit.B[:, :r], fit.C, fit.D, fit.K, dt), role)
    if found is None:
        return None
    G, D, H = found
    h = len(G)
    # G, D, H belong to the state [y; dy/dt] in the order of the displacements
    frequencies = np.sqrt(np.abs(np.linalg.eigvals(G)))
    shift = float(frequencies.mean())
    corner = CUTOFF * float(frequencies.max()) / (2.0 * np.pi)
    every = 2 ** max(math.floor(math.log2(1.0 / (dt * corner * FINE))), -1) if corner * dt > 0.0 else 0
    if every < 1:
        return None
    theta, root = _around(G / shift ** 2, H / shift ** 2, D / shift, c, 0.0)
    return lpv.Varying(
        shift=shift, scale_u=scale[:r].copy(), scale_y=scale[r:][list(role.displacements)].copy(), theta=theta,
        x=np.zeros(2 * h), root=root, noise=np.zeros((h, h)), share=np.zeros(h), chi2=1.0, corner=corner,
        every=every, filtered=np.zeros((4, lpv.width(h, r))), dt=dt, angle=0.0, blocks=0, strikes=0, lost=False,
        settling=0, turn=0.0, power=np.zeros((h, h)), center=np.zeros(h), level=np.zeros((h, h)),
        white=np.zeros((h, h)), prior=np.zeros((2, len(theta))), past=())


def _fit_stretch(config: IdentifierParameters, v: lpv.Varying, rows: Rows, role: lpv.Roles) -> lpv.Varying | None:
    """Fit a whole stretch: its first ``WINDOW`` samples at once, the rest block by block."""
    begun = None
    for _ in range(CENTERED):
        signals = lpv.signals_of(config, rows, role, v.center)
        if not np.all(np.isfinite(signals)):
            return None
        begun = _fit_at_once(v, signals[:WINDOW], rows.missing[:WINDOW])
        if begun is None:
            return None
        offset = lpv.part(begun.theta, 'b', len(v.scale_y), len(v.scale_u)) / v.scale_y
        v = v._replace(center=v.center + offset)
    for row in range(rows.first + WINDOW, rows.until, BLOCK):
        begun = None if begun is None else lpv.advance(config, begun, rows.between(row, min(row + BLOCK, rows.until)))
    return begun


def _fit_at_once(v: lpv.Varying, signals: Array, missing: NDArray[np.int64]) -> lpv.Varying | None:
    """Fit growing stretches of signals (N, w), leaving out gaps and, after each, the settling time of the filter."""
    quiet, begin = lpv.settling(v), v
    stretches = [(first, last, *lpv.passed(v, signals[first:last], True))
                 for first, last in lpv.measured(v, signals, missing)]
    least = lpv.noise_of(signals, v)
    inside = slice(len(v.scale_u), len(v.scale_u) + len(v.scale_y))
    if not any(out.shape[1] >= quiet + FEWEST for _, _, out, _ in stretches):
        return None
    power = np.diag(np.var(np.vstack([out[0, quiet:, inside] for _, _, out, _ in stretches]) * v.scale_y, axis=0))
    for count in sorted({min(length, len(signals)) for length in GROWTH}):
        blocks = []
        for first, last, out, _ in stretches:
            end = (min(count, last) - first) // v.every
            if end >= quiet + FEWEST:
                blocks.append(lpv.block_of(v, out[:, quiet:end]))
        if not blocks:
            continue
        noise = (LATE if count < WINDOW else 4.0) * least + 1e-4 * power
        found = lpv.updated(begin, blocks, noise, least, ITERATIONS)
        if found is not None:  # once more, weighted with the residuals' covariance
            begin = begin._replace(theta=found.theta)
            found = lpv.updated(begin, blocks, 1.5 * found.noise + least, least, ITERATIONS)
        if found is None:
            return None
        begin, v = begin._replace(theta=found.theta), found
    _, last, out, state = stretches[-1]
    if out.shape[1] < quiet + FEWEST:  # the filter has not settled since the last gap
        v = lpv.reopened(v, max(quiet - out.shape[1], 0))
    settled = (out[:, quiet:] for _, _, out, _ in stretches)
    v = v._replace(level=least, white=least, past=tuple(out for out in settled if out.shape[1] >= FEWEST))
    return v._replace(filtered=state) if last == len(signals) else lpv.lost(v)
