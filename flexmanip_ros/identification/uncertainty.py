"""First-order uncertainty of the model: the spread of the VARX parameters carried to (A, B, C, D, K).

The model is a function of the VARX parameters Xi whose covariance is (innovation covariance) x (inverse
information). Where the noise-free relation A T z = T z_next holds, the fluctuations of the moments
themselves drop out to first order, and any selection S of the state gives the same system up to
similarity; so S and the moments are held and only Xi varies.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from flexmanip_ros.identification.moments import Realized
from flexmanip_ros.types import Array, StateSpace, Status


class Identified(NamedTuple):
    """A model and what it is worth."""

    model: StateSpace
    """In JointState units, in the published basis."""
    spread: Array
    """(k, s): the covariance of [A, B, C, D, K], each row-major, one after another, is spread @ spread.T;
    (k, 0) where none is known."""
    singular_values: Array
    excitation: float
    condition: float
    innovation_power: float
    status: Status
    innovation_covariance: Array
    """(m, m) covariance of the innovations, in JointState units."""
    refined: bool = False
    """A prediction-error fit, not the subspace model it began with."""
    known_basis: bool = False
    """The state is y, or [y; dy/dt]; otherwise it is balanced and the spread holds that basis still."""
    samples: float = 0.0
    """Effective number of samples behind the model."""


class Tangent(NamedTuple):
    """Directions in which the model varies: (s, ...) stacks of dA, dB, dC, dD, dK."""

    A: Array
    B: Array
    C: Array
    D: Array
    K: Array

    def flat(self) -> Array:
        """(k, s) spread of [A, B, C, D, K]."""
        return np.hstack([part.reshape(part.shape[0], -1) for part in self]).T


def variance(identified: Identified, **gradients: Array) -> float:
    """Variance of a scalar g of the model; A=, B=, C=, D=, K= are dg/dA, dg/dB, ... (same shapes)."""
    model = identified.model
    parts = []
    for name in 'ABCDK':
        shape = getattr(model, name).shape
        parts.append(np.asarray(gradients.pop(name, np.zeros(shape)), dtype=float).reshape(-1))
    if gradients:
        raise TypeError(f'unknown matrices {sorted(gradients)}')
    along = identified.spread.T @ np.concatenate(parts)
    return float(along @ along) if along.size else float('nan')


def _lift(Q: Array, block: int, width: int) -> Array:
    """Rows of Q moved up by ``block`` windows; the rest is zero."""
    if block == 0:
        return Q
    moved = np.zeros_like(Q)
    moved[:-block * width] = Q[block * width:]
    return moved


def tangent(R: Array, realized: Realized, r: int, deviation: Array) -> Tangent:
    """Propagate dXi = deviation' Omega regression^-T, Omega unit normal.

    deviation: (m, m), deviation' deviation = covariance of the innovations, effective memory included.
    """
    A, T, Xi = realized.A, realized.T, realized.Xi
    n, past = T.shape
    m = Xi.shape[0]
    width = r + m
    d = realized.regression.shape[0]
    f = realized.S.shape[1] // m
    joint = R[:, :past + r]
    known = np.hstack([realized.state, R[:, past:past + r]])
    Q = joint.T @ np.linalg.lstsq(known, np.eye(R.shape[0]), rcond=1e-12)[0].T  # (past + r, n + r)
    Qz, Qu = Q[:past], Q[past:]
    later = _lift(Qz, 1, width)
    later[past - width:past - m] += Qu
    later[past - m:] += Xi @ Qz + realized.xi_u @ Qu
    if d > past:
        Pz, direct = Qz, Q
    else:
        Pz = R[:, :past].T @ np.linalg.lstsq(realized.state, np.eye(R.shape[0]), rcond=1e-12)[0].T
        direct = Pz
    newest = np.zeros((past, m))
    newest[past - m:] = np.eye(m)
    select = [realized.S[:, i * m:(i + 1) * m] @ deviation.T for i in range(f)]
    Ty = T[:, past - m:] @ deviation.T
    ab = _combine(
        [*select, *[-A @ s for s in select], Ty],
        [*[_lift(later, i, width) for i in range(f)], *[_lift(Qz, i, width) for i in range(f)],
         Q[:d] if d > past else Qz], realized.regression)
    cd = _combine(
        [deviation.T, *[-realized.C @ s for s in select]],
        [direct, *[_lift(Pz, i, width) for i in range(f)]], realized.regression)
    dK = _combine(select, [_lift(newest, i, width) for i in range(f)], realized.regression)
    dD = cd[:, :, n:] if d > past else np.zeros((cd.shape[0], m, r))
    return Tangent(ab[:, :, :n], ab[:, :, n:], cd[:, :, :n], dD, dK)


def _combine(left: list[Array], right: list[Array], regression: Array) -> Array:
    """Sum over t of left_t Omega (regression^-T right_t), for every unit Omega: (s, rows, columns)."""
    d = regression.shape[0]
    rows, a = left[0].shape
    columns = right[0].shape[1]
    tall = np.zeros((len(right), d, columns))
    for t, Q in enumerate(right):
        tall[t, :Q.shape[0]] = Q
    flat = tall.transpose(1, 0, 2).reshape(d, -1)
    solved = solve_triangular(regression, flat, trans='T', check_finite=False).reshape(d, len(right), columns)
    lefts = np.stack(left).reshape(len(left), -1)
    joint: Array = lefts.T @ solved.transpose(1, 0, 2).reshape(len(right), -1)
    return np.asarray(joint.reshape(rows, a, d, columns).transpose(1, 2, 0, 3).reshape(a * d, rows, columns))


def move(model: StateSpace, along: Tangent, W: Array, dW: Array | None) -> Tangent:
    """Carry a tangent to the state W x, W varying by dW (s, n, n) with the model (None: held still)."""
    back = np.linalg.inv(W)
    dA, dB, dC, dK = W @ along.A @ back, W @ along.B, along.C @ back, W @ along.K
    if dW is not None:
        turn = dW @ back
        moved = W @ model.A @ back
        dA = dA + turn @ moved - moved @ turn
        dB = dB + dW @ model.B
        dC = dC - (model.C @ back) @ turn
        dK = dK + dW @ model.K
    return Tangent(dA, dB, dC, along.D, dK)


def known_basis_tangent(model: StateSpace, along: Tangent) -> Array | None:
    """Derivatives dW (s, n, n) of ``realization.known_output_basis``."""
    m, n = model.C.shape
    if m == n:
        return along.C
    values, V = np.linalg.eig(model.A)
    logs = np.log(values)
    gap = values[:, None] - values[None, :]
    close = np.abs(gap) < 1e-12
    slope = (logs[:, None] - logs[None, :]) / np.where(close, 1.0, gap)
    divided = np.where(close, 1.0 / values[:, None], slope)
    U = np.linalg.inv(V)
    Ac = np.real(V @ (logs[:, None] * U)) / model.dt
    dAc = np.real(V @ (divided * (U @ along.A @ V)) @ U) / model.dt
    return np.concatenate([along.C, along.C @ Ac + model.C @ dAc], axis=1)
