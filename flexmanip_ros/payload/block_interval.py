"""Interval of a payload read from an identified model: the model's covariance through the extraction.

The standard deviation is of first order, and the interval as far from that as the payloads of models drawn
from the covariance are (a fixed set of normal numbers, so the same model gives the same interval): the
extraction bends strongly once the payload is uncertain by some ten per cent, and a symmetric interval misses.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from flexmanip_ros.errors import ModelError
from flexmanip_ros.identification.memory_kernel import POWER_RATE
from flexmanip_ros.identification.realization import to_continuous
from flexmanip_ros.identification.uncertainty import Identified
from flexmanip_ros.payload.modal_basis import to_modal
from flexmanip_ros.types import Array, Payload, Status

DRAWS = 256
"""Models drawn for the interval."""
STEP = 1e-4
"""Step of the derivatives, in standard deviations."""
QUANTILE = 1.959963984540054
"""Of the normal distribution, for 95 %."""
CHANCE = 2.0
"""Standard deviations of the power of the innovations, a mean over few samples, that are left to chance."""


def unknown(status: Status, consistency: float = 1.0) -> Payload:
    """Return the payload of which nothing is known."""
    return Payload(0.0, math.inf, 0.0, math.inf, consistency, status)


def payload(
    identified: Identified, S: Array, rates: tuple[bool, ...], mass_of: Callable[[Array, Array], Array],
    doubts_of: Callable[[Array, Array, float], list[tuple[float, float]]],
) -> Payload:
    """Return the payload; S, rates: what the outputs see; mass_of: payload of modal (Ac, Bc).

    doubts_of: how far below (negative) and above the mass [kg] of modal (Ac, Bc) the payload may be for
    reasons that are not noise. The interval reaches over them; where one is larger than the noise, the status
    says INCONSISTENT.
    """
    model = identified.model
    power = identified.innovation_power if math.isfinite(identified.innovation_power) else 1.0
    if not (np.isfinite(model.A).all() and np.isfinite(model.B).all() and np.isfinite(model.C).all()):
        return unknown(Status.DIVERGED)
    try:
        Ac, Bc = to_continuous(model.A, model.B, model.dt)
        modal = to_modal(Ac, Bc, model.C, S, rates)
        mass = float(mass_of(*modal))
        directions = continuous_spread(identified)
        around = mass_of(*_modal(Ac, Bc, model.C, [STEP * part for part in directions], S, rates))
        gradient = (around - mass) / STEP
        std = float(np.linalg.norm(gradient))
        normal = draws(directions[0].shape[0])
        drawn = mass_of(*_modal(
            Ac, Bc, model.C, [np.tensordot(normal, part, axes=1) for part in directions], S, rates))
        doubts = doubts_of(*modal, mass) if math.isfinite(mass) else []
    except (np.linalg.LinAlgError, ModelError):
        return unknown(Status.ILL_CONDITIONED, power)
    reach = max((above - below for below, above in doubts), default=0.0)
    if not all(map(math.isfinite, (mass, std, reach))) or directions[0].shape[0] == 0:
        return unknown(Status.ILL_CONDITIONED, power)
    # a fit that is worse than its noise has a wider interval by as much
    widening = math.sqrt(max(1.0, power - CHANCE * math.sqrt(POWER_RATE / model.C.shape[0])))
    drawn = np.where(np.isfinite(drawn), drawn, np.inf)
    # The draws tell how far the interval is from that of first order, against first order on the same draws:
    # on their own, a few hundred of them are as much as a tenth too wide or too narrow.
    bent, straight = (np.quantile(masses, [0.025, 0.975], method='nearest')
                      for masses in (drawn, mass + normal @ gradient))
    lower = mass - widening * max(QUANTILE * std + float(straight[0] - bent[0]), 0.0)
    upper = mass + widening * max(QUANTILE * std + float(bent[1] - straight[1]), 0.0)
    status = identified.status
    if status is Status.TRACKING and widening * std > abs(mass):
        status = Status.POORLY_EXCITED
    if status is Status.TRACKING and reach > upper - lower:
        status = Status.INCONSISTENT
    lower += sum(below for below, _ in doubts)
    upper += sum(above for _, above in doubts)
    if mass < 0.0:
        # No payload is negative; an interval cut off at 0 would look the surer the further the model is off.
        if status is Status.TRACKING:
            status = Status.INCONSISTENT if upper < 0.0 else Status.POORLY_EXCITED
        upper = max(upper, widening * QUANTILE * std, -mass if upper < 0.0 else 0.0)
    std = math.hypot(widening * std, 0.5 * reach)
    return Payload(max(mass, 0.0), std, max(lower, 0.0), max(upper, 0.0), power, status)


def continuous_spread(identified: Identified) -> tuple[Array, Array, Array]:
    """Directions (s, ...) in which Ac, Bc and C vary, one standard deviation each.

    The derivative of the matrix logarithm of [[A, B], [0, I]] by its eigenvectors: an element ij in that
    basis is divided by the difference quotient of the logarithm at the poles i and j.
    """
    model, spread = identified.model, identified.spread
    n, r, m = model.order, model.B.shape[1], model.C.shape[0]
    s = spread.shape[1]
    dA = spread[:n * n].T.reshape(s, n, n)
    dB = spread[n * n:n * (n + r)].T.reshape(s, n, r)
    dC = spread[n * (n + r):n * (n + r + m)].T.reshape(s, m, n)
    joint = np.zeros((n + r, n + r))
    joint[:n, :n], joint[:n, n:], joint[n:, n:] = model.A, model.B, np.eye(r)
    poles, V = np.linalg.eig(joint)
    gap = poles[:, None] - poles[None, :]
    near = np.abs(gap) < 1e-9
    quotient = np.where(near, 1.0 / poles[:, None],
                        (np.log(poles)[:, None] - np.log(poles)[None, :]) / np.where(near, 1.0, gap))
    change = np.zeros((s, n + r, n + r))
    change[:, :n, :n], change[:, :n, n:] = dA, dB
    turned = np.linalg.solve(V, change @ V) * quotient
    log = np.real(np.linalg.solve(V.T, np.swapaxes(V @ turned, -1, -2)).swapaxes(-1, -2)) / model.dt
    return log[:, :n, :n], log[:, :n, n:], dC


def draws(size: int) -> Array:
    """Return standard normal vectors (DRAWS, size), in pairs of opposite sign, always the same ones."""
    half = np.random.default_rng(0).standard_normal((DRAWS // 2, size))
    return np.vstack([half, -half])


def _modal(
    Ac: Array, Bc: Array, C: Array, change: list[Array], S: Array, rates: tuple[bool, ...],
) -> tuple[Array, Array]:
    """Return a stack of models away from (Ac, Bc, C), in the modal basis."""
    return to_modal(Ac + change[0], Bc + change[1], C + change[2], S, rates)
