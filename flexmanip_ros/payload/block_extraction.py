"""Payload from the blocks of an identified state-space model: the paper's eqs. (47)-(52), any kappa.

Symbols are the paper's: M_a, M_b, M_c blocks of the mass matrix, M_t = M_c - M_b' M_a^-1 M_b, K_c the modal
stiffness; h = 2 kappa modal coordinates; the state is [eta; eta'] with eta = [eta_11.. eta_21..].
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.arm.linearization import Blocks, blocks
from flexmanip_ros.errors import ModelError
from flexmanip_ros.identification.uncertainty import Identified
from flexmanip_ros.parameters import ArmParameters, IdentifierParameters
from flexmanip_ros.payload import block_interval, block_truncation
from flexmanip_ros.payload.angles import chords
from flexmanip_ros.payload.modal_basis import sensor_matrix
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.types import Array, Payload, Status


def extract(
    arm: ArmParameters, Ac: Array, Bc: Array, theta: Array, kappa: int, known_mb: bool = False,
) -> float:
    """Return the payload [kg] of a continuous model with the state [eta; eta'].

    Ac: (4 kappa, 4 kappa), Bc: (4 kappa, 2), theta: (2,) chord angles [rad]; known_mb: take M_b from the
    arm instead of from the model. Raises ModelError on other shapes or a singular model.
    """
    order = 4 * kappa
    if Ac.shape != (order, order) or Bc.shape != (order, 2):
        raise ModelError(
            f'block extraction got A {Ac.shape} and B {Bc.shape} for kappa = {kappa}',
            f'give A ({order}, {order}) and B ({order}, 2): the order must be 4 kappa')
    try:
        mass = float(masses(arm, blocks(arm, theta, kappa=kappa), Ac, Bc, known_mb))
    except np.linalg.LinAlgError as err:
        raise ModelError('the identified model has a singular block', 'excite both joints, or lower the order'
                         ) from err
    if not np.isfinite(mass):
        raise ModelError('the identified model gives no finite payload',
                         'excite both joints, or lower the order')
    return mass


NOWHERE: Array = np.empty(0)
"""A sweep of which nothing is known."""


def estimate(config: IdentifierParameters, identified: Identified, angles: Array, swept: Array = NOWHERE
             ) -> Payload:
    """Return the payload of an identified model with its 95 % interval; never a NaN.

    angles: (2,) measured, by the arm's convention; swept: from ``sweep``. The interval comes from models
    drawn from the covariance of the identified one (``block_interval``), and reaches over what a model of
    kappa modes at one configuration cannot know: further modes, and with a known M_b how the arm moved.
    """
    kappa = identified.model.order // 4
    seen = sensor_matrix(config, kappa) if identified.model.order == 4 * kappa else None
    if seen is None or angles.shape != (2,) or np.linalg.matrix_rank(seen[0]) < 2 * kappa:
        return block_interval.unknown(Status.UNOBSERVABLE)
    theta = working_point(config, angles)
    known = config.payload.known_coupling
    empty = blocks(config.arm, theta, kappa=kappa)

    def mass_of(Ac: Array, Bc: Array) -> Array:
        return masses(config.arm, empty, Ac, Bc, known)

    def doubts_of(Ac: Array, Bc: Array, mass: float) -> list[tuple[float, float]]:
        excess = _excess(config, theta, kappa, mass_of, mass)
        moved = [0.0]
        for turn in np.arccos(swept):  # the blocks depend on the angle between the links alone
            there = blocks(config.arm, np.array([0.0, turn]), kappa=kappa)
            moved.append(float(masses(config.arm, there, Ac, Bc, known)) - mass)
        return [(min(0.0, -2.0 * excess), max(0.0, -2.0 * excess)), (min(moved), max(moved))]

    return block_interval.payload(identified, *seen, mass_of, doubts_of)


def sweep(config: IdentifierParameters, before: Array, rows: Rows) -> Array:
    """Return the smallest and largest cosine between the links (2,), after more rows.

    Kept only where it matters: M_b is taken from the arm (it varies with that cosine) and the arm moves.
    """
    payload = config.payload
    if (config.payload_method != 'block' or not payload.known_coupling or payload.dynamics == 'linear'
            or rows.angles.shape[1] != 2):
        return before
    theta = np.array([chords(config.arm, angles) for angles in rows.angles])
    cosines = np.concatenate([before, np.cos(theta[:, 1] - theta[:, 0])])
    return np.array([cosines.min(), cosines.max()])


def _excess(config: IdentifierParameters, theta: Array, kappa: int, mass_of: Callable[[Array, Array], Array],
            read: float) -> float:
    """Return how much of the mass that was read is none, by the modes that the model has not [kg]."""
    excess = 0.0
    if config.arm.modes <= kappa:
        return excess
    for _ in range(block_truncation.STEPS):
        payload = max(read - excess, 0.0)
        model = block_truncation.truncated(config, theta, payload, kappa)
        if model is None:
            return 0.0
        excess = float(mass_of(*model)) - payload
    return excess


def working_point(config: IdentifierParameters, angles: Array) -> Array:
    """Return the chord angles (2,) that a model belongs to: measured ones, or where a linear plant stays."""
    given = config.payload.working_point
    if config.payload.dynamics == 'linear' and len(given) == 2:
        return np.array(given, dtype=np.float64)
    return chords(config.arm, angles)


def masses(arm: ArmParameters, empty: Blocks, Ac: Array, Bc: Array, known_mb: bool) -> Array:
    """Return the payload [kg] of each model of a stack, Ac: (..., 4 kappa, 4 kappa), Bc: (..., 4 kappa, 2).

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
    L1, L2 = arm.link_length
    return np.asarray(trace / (L1 ** 2 + L2 ** 2))  # eq. (52)


def _transpose(stack: NDArray[Any]) -> Array:
    return np.swapaxes(stack, -1, -2)
