"""Payload from the blocks of the identified model: mass matrix, truncation, and its interval."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.arm.linearization import Blocks, blocks, vibration_model
from flexmanip_ros.arm.manipulator import chords, count, manipulator
from flexmanip_ros.errors import ModelError
from flexmanip_ros.identification.factor import POWER_RATE
from flexmanip_ros.identification.realization import to_continuous
from flexmanip_ros.identification.uncertainty import Identified
from flexmanip_ros.parameters import ArmParameters, IdentifierParameters
from flexmanip_ros.payload.structured_model import Quantity, signals, working_point
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.types import QUANTILE, Array, Payload, Status

STEPS = 3
"""Of the search for the payload that would be read as the one that was."""


def sensor_matrix(config: IdentifierParameters, kappa: int | None) -> tuple[Array, tuple[bool, ...]] | None:
    """Return S (m, 2 k), the modal coordinates each output sees, and which outputs are rates.

    The coordinates are those of the arm's own shape functions, or kappa sines a link. None when an output is no bend of
    the arm: a joint angle has a rigid part that the blocks leave out.
    """
    known = signals(config)
    if known is None or not known.torques:
        return None
    if not {role.quantity for role in known.outputs} <= {Quantity.BEND, Quantity.BEND_RATE}:
        return None
    arm, links = manipulator(config.arm, kappa), len(config.arm.link_length)
    seen = arm.output[links:, links:links * (1 + arm.kappa)]
    return (seen[[role.link for role in known.outputs]],
            tuple(role.quantity is Quantity.BEND_RATE for role in known.outputs))


def to_modal(Ac: Array, Bc: Array, C: Array, S: Array, rates: tuple[bool, ...]) -> tuple[Array, Array]:
    """Return (Ac, Bc) with the state [eta; eta'] from continuous models in any basis.

    Ac: (..., n, n), Bc: (..., n, r), C: (..., m, n), S: (m, n / 2). A displacement without its rate among the
    outputs is completed by C Ac, in continuous time, where that is known to read the rates (a discrete
    C A is not: it depends on the payload). Raises numpy.linalg.LinAlgError when that fixes no basis.
    """
    h = S.shape[1]
    is_rate = np.array(rates, dtype=bool)
    known = np.zeros((S.shape[0], 2 * h))
    known[~is_rate, :h] = S[~is_rate]
    known[is_rate, h:] = S[is_rate]
    seen = np.broadcast_to(C, (*Ac.shape[:-2], *C.shape[-2:]))
    alone = [row for row in np.flatnonzero(~is_rate)
             if not any(np.allclose(S[row], S[other]) for other in np.flatnonzero(is_rate))]
    if alone:
        derived = np.zeros((len(alone), 2 * h))
        derived[:, h:] = S[alone]
        known = np.vstack([known, derived])
        seen = np.concatenate([seen, C[..., alone, :] @ Ac], axis=-2)
    if np.linalg.matrix_rank(known) < 2 * h:
        raise np.linalg.LinAlgError('the outputs do not see every modal coordinate')
    # eq. (44): seen = known T, so T = known^+ seen takes the identified state to [eta; eta']
    T = np.linalg.pinv(known) @ seen
    Ac_modal = np.swapaxes(np.linalg.solve(np.swapaxes(T, -1, -2), np.swapaxes(T @ Ac, -1, -2)), -1, -2)
    return Ac_modal, T @ Bc


def truncated(config: IdentifierParameters, theta: Array, payload: float, kappa: int
              ) -> tuple[Array, Array] | None:
    """Return (Ac, Bc) of the lowest L kappa vibrations of the undamped arm, as if it had kappa modes.

    theta: (L,) chord angles; payload [kg]. None where the outputs do not see the modes.
    """
    few, all_modes = sensor_matrix(config, kappa), sensor_matrix(config, None)
    if few is None or all_modes is None:
        return None
    Ac, Bc = vibration_model(replace(config.arm, damping_ratio=0.0), theta, payload)
    h = Ac.shape[0] // 2
    squares, shapes = np.linalg.eig(-Ac[h:, :h])
    lowest = np.argsort(squares.real)[:len(config.arm.link_length) * kappa]
    shapes = shapes.real
    pushed = np.linalg.solve(shapes, Bc[h:])[lowest]
    # the same displacements at the sensors, in the coordinates of kappa modes
    P = np.linalg.lstsq(few[0], all_modes[0] @ shapes[:, lowest], rcond=None)[0]
    n = len(config.arm.link_length) * kappa
    A, B = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, Bc.shape[1]))
    A[:n, n:] = np.eye(n)
    A[n:, :n] = -np.linalg.solve(P.T, (P * squares.real[lowest]).T).T
    B[n:] = P @ pushed
    return A, B


DRAWS = 256
"""Models drawn for the interval."""
STEP = 1e-4
"""Step of the derivatives, in standard deviations."""
CHANCE = 2.0
"""Standard deviations of the power of the innovations, a mean over few samples, that are left to chance."""


def unknown(status: Status, consistency: float = 1.0) -> Payload:
    """Return the payload of which nothing is known."""
    return Payload(0.0, math.inf, 0.0, math.inf, consistency, status)


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


def estimate(config: IdentifierParameters, identified: Identified, angles: Array, configuration_range: Array
             ) -> Payload:
    """Return the payload of an identified model with its 95 % interval; never a NaN.

    angles: (L,) measured, by the arm's convention; configuration_range: from ``extend_range``, or (0,). The interval is
    that of models drawn from the covariance of the identified one. It reaches over what a model of kappa modes at one
    configuration cannot know: further modes, and with a known M_b how the arm moved. Where one of these is larger than
    the noise, the status says INCONSISTENT.
    """
    links, model, known = len(config.arm.link_length), identified.model, config.payload.known_coupling
    kappa = model.order // (2 * links)
    seen = sensor_matrix(config, kappa) if kappa and model.order == 2 * links * kappa else None
    floats = config.arm.base_mass > 0.0  # the extraction is that of an arm on a fixed base
    if floats or seen is None or angles.shape != (links,) or np.linalg.matrix_rank(seen[0]) < links * kappa:
        return unknown(Status.UNOBSERVABLE)
    theta = working_point(config, angles)
    empty = blocks(config.arm, theta, kappa=kappa)

    def mass_of(Ac: Array, Bc: Array) -> Array:
        return masses(config.arm, empty, Ac, Bc, known)

    power = identified.innovation_power if math.isfinite(identified.innovation_power) else 1.0
    if not (np.isfinite(model.A).all() and np.isfinite(model.B).all() and np.isfinite(model.C).all()):
        return unknown(Status.DIVERGED)
    try:
        Ac, Bc = to_continuous(model.A, model.B, model.dt)
        modal = to_modal(Ac, Bc, model.C, *seen)
        mass = float(mass_of(*modal))
        directions = continuous_spread(identified)
        around = mass_of(*_modal(Ac, Bc, model.C, [STEP * part for part in directions], *seen))
        gradient = (around - mass) / STEP
        std = float(np.linalg.norm(gradient))
        normal = draws(directions[0].shape[0])
        drawn = mass_of(*_modal(Ac, Bc, model.C, [np.tensordot(normal, part, axes=1) for part in directions], *seen))
        excess = _excess(config, theta, kappa, mass_of, mass)
        moved = [0.0]
        for turn in np.arccos(configuration_range):  # the blocks depend on the angle between the links alone
            there = blocks(config.arm, np.array([0.0, turn]), kappa=kappa)
            moved.append(float(masses(config.arm, there, *modal, known)) - mass)
    except (np.linalg.LinAlgError, ModelError):
        return unknown(Status.ILL_CONDITIONED, power)
    doubts = [(min(0.0, -2.0 * excess), max(0.0, -2.0 * excess)), (min(moved), max(moved))]
    reach = max(above - below for below, above in doubts)
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


def extend_range(config: IdentifierParameters, before: Array, rows: Rows) -> Array:
    """Return the smallest and largest cosine between the links (2,), after more rows.

    Kept only where it matters: the method takes M_b or the frequencies from the arm (they vary with that cosine), and
    the arm moves.
    """
    payload = config.payload
    wanted = config.payload_method == 'frequency' or (config.payload_method == 'block' and payload.known_coupling)
    if not wanted or payload.dynamics == 'linear' or rows.angles.shape[1] != 2:
        return before
    theta = np.array([chords(config.arm, angles) for angles in rows.angles])
    cosines = np.concatenate([before, np.cos(theta[:, 1] - theta[:, 0])])
    return np.array([cosines.min(), cosines.max()])


def _excess(config: IdentifierParameters, theta: Array, kappa: int, mass_of: Callable[[Array, Array], Array],
            read: float) -> float:
    """Return how much of the mass that was read is none, by the modes that the model has not [kg]."""
    excess = 0.0
    if count(config.arm) <= kappa:
        return excess
    for _ in range(STEPS):
        payload = max(read - excess, 0.0)
        model = truncated(config, theta, payload, kappa)
        if model is None:
            return 0.0
        excess = float(mass_of(*model)) - payload
    return excess


def masses(arm: ArmParameters, empty: Blocks, Ac: Array, Bc: Array, known_mb: bool) -> Array:
    """Return the payload [kg] of each model of a stack, Ac: (..., 2 L kappa, 2 L kappa), Bc: (..., 2 L kappa, L).

    empty: the blocks of the arm without payload. Raises numpy.linalg.LinAlgError when one is singular.
    """
    h = Ac.shape[-1] // 2
    G, H = -Ac[..., h:, :h], Bc[..., h:, :]
    K_c = np.broadcast_to(empty.Kc, G.shape)
    M_t = _transpose(np.linalg.solve(_transpose(G), K_c))  # eq. (48): M_t G = K_c
    # eq. (49), with the bending moments of real joint torques: X = M_b' M_a^-1
    X = _transpose(np.linalg.solve(empty.B_theta.T, _transpose(empty.B_eta - M_t @ H)))
    X_t = _transpose(X)
    if known_mb:
        M_b = np.broadcast_to(empty.Mb, X_t.shape)
    else:
        M_b = np.asarray(np.linalg.solve(X_t @ X, X_t @ (empty.Mc - M_t)))  # eq. (50), least squares
    M_a = np.linalg.solve(X_t @ X, X_t @ _transpose(M_b))  # eq. (51), least squares
    trace = np.trace(M_a - empty.Ma, axis1=-2, axis2=-1)
    return np.asarray(trace / sum(L ** 2 for L in arm.link_length))  # eq. (52)


def _transpose(stack: NDArray[Any]) -> Array:
    return np.swapaxes(stack, -1, -2)
