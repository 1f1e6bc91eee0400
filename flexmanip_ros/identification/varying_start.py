"""The begin of the parameter-varying fit: from the fit of one configuration, or from the model before an event."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from flexmanip_ros.errors import ModelError
from flexmanip_ros.identification.batch_fit import BLOCK, Recursion
from flexmanip_ros.identification.parameter_varying import (
    AT_REST,
    UNKNOWN,
    Roles,
    Varying,
    block_of,
    local,
    noise_of,
    passed,
    prior,
    roles,
    signals_of,
    updated,
)
from flexmanip_ros.identification.prediction_check import DAMPED
from flexmanip_ros.identification.realization import known_output_basis, slowest, to_continuous, transform
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.types import Array, StateSpace

CUTOFF = 2.0
"""Corner of the low-pass filter over the highest frequency of the model."""
FINE = 18.0
"""Samples kept per period of the corner frequency, at least; between them torques are taken for straight lines."""
SETTLE = 2.0
"""Periods of the corner frequency after which a filter that began anew is trusted."""
WINDOW = 1024
"""Samples of the longest stretch that is fitted at once, as one block."""
GROWTH = (256, 512, 640, 768, WINDOW)
"""Samples of the stretches that lead there, each started from the one before."""
ITERATIONS = 8
LATE = 16.0
"""Times the noise by which the first stretches may miss, as their start may be far off."""
ZETA = 0.8
"""First value of zeta: k = 0.69."""
SAME = 0.3
"""Factor on prior deviations around the model before an event: the same arm, with another object."""


def from_model(model: StateSpace, role: Roles) -> tuple[Array, Array, Array] | None:
    """G, D, H of a model of one configuration, in its own units; None where it does not swing as it should.

    Of more modes than displacements the slowest are taken.
    """
    h = len(role.displacements)
    if model.order > 2 * h:
        slow = slowest(model, h, DAMPED)  # the fit may begin with modes below this damping ratio alone
        if slow is None:
            return None
        model = slow
    seen = model.C[list(role.displacements)]  # x = [w; w'] by these alone: then w' is the derivative of w
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


def start(config: IdentifierParameters, rows: Rows, old: Recursion | None, before: Varying | None) -> Varying | None:
    """Begin with a stretch of samples, from the fit of one configuration or from the model before an event."""
    role = roles(config)
    if role is None or len(rows) < GROWTH[0] or rows.angles.shape[1] != 2 or (old is None and before is None):
        return None
    stamps = rows.stamp_ns
    dt = float(stamps[-1] - stamps[0]) * 1e-9 / (len(rows) - 1)
    h, r = len(role.displacements), len(config.inputs)
    if before is not None:
        begun: Varying | None = before._replace(x=np.zeros(2 * h), blocks=0, strikes=0, lost=False)
    else:
        assert old is not None
        begun = _from_recursion(old, role, r, dt)
    if begun is None or begun.every < 1 or GROWTH[0] % begun.every:
        return None
    power = np.concatenate([np.mean(rows.u ** 2, axis=0), np.var(rows.y[:, list(role.displacements)], axis=0)])
    if not np.all(power > 0.0) or not np.all(np.isfinite(power)):
        return None
    G, _, H, _, D, _ = local(begun.theta, h, r, math.cos(begun.angle), 0.0, AT_REST)
    unit = 1.0 / np.sqrt(power)
    more_u, more_y = unit[:r] / begun.scale_u, unit[r:] / begun.scale_y
    ratio = more_y[:, None] / more_y
    theta, root = _around(G * ratio, H * more_y[:, None] / more_u, D * ratio)
    if before is not None:  # the same arm, with another object
        root[:len(theta), :len(theta)] *= SAME
    return _fit_stretch(
        config, begun._replace(dt=dt, theta=theta, root=root, scale_u=unit[:r], scale_y=unit[r:]), rows, role)


def _around(G: Array, H: Array, D: Array) -> tuple[Array, Array]:
    """Theta of a model that does not vary, and the root of its prior covariance, that of the state included."""
    h, r = H.shape
    at_rest = (np.concatenate([X.ravel(), np.zeros(2 * X.size)]) for X in (G, H, D))
    g, b, d = at_rest
    theta = np.concatenate([g, b, np.zeros(4 * h * r), d, np.zeros(h), np.full(1, ZETA)])
    return theta, np.diag(np.concatenate([prior(G, H), np.full(2 * h, UNKNOWN)]))


def _from_recursion(old: Recursion, role: Roles, r: int, dt: float) -> Varying | None:
    fit, scale = old.theta, old.scale
    found = from_model(StateSpace(fit.A, fit.B, fit.C, fit.D, fit.K, dt), role)
    if found is None:
        return None
    G, D, H = found
    h = len(G)
    # of the state [y; dy/dt] in the order of the displacements
    frequencies = np.sqrt(np.abs(np.linalg.eigvals(G)))
    shift = float(frequencies.mean())
    corner = CUTOFF * float(frequencies.max()) / (2.0 * np.pi)
    every = 2 ** max(math.floor(math.log2(1.0 / (dt * corner * FINE))), -1) if corner * dt > 0.0 else 0
    if every < 1:
        return None
    theta, root = _around(G / shift ** 2, H / shift ** 2, D / shift)
    return Varying(
        shift=shift, scale_u=scale[:r].copy(), scale_y=scale[r:][list(role.displacements)].copy(), theta=theta,
        x=np.zeros(2 * h), root=root, noise=np.zeros((h, h)), share=np.zeros(h), swing=0.0, corner=corner,
        every=every, filtered=np.zeros((4, r + h + 2)), dt=dt, angle=0.0, rate=0.0, blocks=0, strikes=0, lost=False,
        gain=np.zeros((0, 0)))


def _fit_stretch(config: IdentifierParameters, v: Varying, rows: Rows, role: Roles) -> Varying | None:
    """Fit a whole stretch: its first second at once, the rest block by block."""
    signals = signals_of(config, rows, role)
    if not np.all(np.isfinite(signals)):
        return None
    out, second, state = passed(v, signals, True)
    quiet = math.ceil(SETTLE / (v.corner * v.dt * v.every))
    least = noise_of(signals, v)
    power = np.diag(np.var(out[quiet:, len(v.scale_u):len(v.scale_u) + len(v.scale_y)] * v.scale_y, axis=0))
    begin, last = v, 0
    for count in (length for length in GROWTH if length <= len(rows)):
        last = count // v.every
        if last < quiet + 24:
            continue
        block = block_of(v, out[quiet:last], second[quiet:last])
        noise = (LATE if count < WINDOW else 4.0) * least + 1e-4 * power
        found = updated(begin, block, noise, ITERATIONS)
        if found is not None:  # once more, with the noise that it leaves
            begin = begin._replace(theta=found.theta)
            found = updated(begin, block, 1.5 * found.noise + least, ITERATIONS)
        if found is None:
            return None
        begin, v = begin._replace(theta=found.theta), found
    if not v.blocks:
        return None
    length = BLOCK // v.every
    for first in range(last, len(out) - length + 1, length):
        done = updated(v, block_of(v, out[first:first + length], second[first:first + length]),
                       v.noise + 0.05 * least, 1)
        if done is None:
            return None
        v = done
    return v._replace(filtered=state)
