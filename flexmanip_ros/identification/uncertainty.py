"""First-order uncertainty: the covariance of the VARX parameters propagated to (A, B, C, D, K) and to the modes."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from flexmanip_ros.errors import ModelError
from flexmanip_ros.identification.moments import Realized, solved
from flexmanip_ros.types import Array, Mode, StateSpace, Status

NEARLY_SINGULAR = 1e-12
"""Relative size of a diagonal entry of the QR factor of the state's regressors at which they count as dependent."""


class AnyConfiguration(Protocol):
    """A model that is a function of the configuration."""

    def at(self, angles: Array) -> Identified:
        """Return the model at measured angles (2,) [rad]."""


class Identified(NamedTuple):
    """A model with its uncertainty and status."""

    model: StateSpace
    """In JointState units. The state is y or [y; dy/dt]; else it is balanced, and the spread takes that basis as
    exact."""
    spread: Array
    """(k, s): the covariance of [A, B, C, D, K], each row-major, one after another, is spread @ spread.T;
    (k, 0) where none is known."""
    singular_values: Array
    excitation: float
    condition: float
    innovation_power: float
    status: Status
    refined: bool = False
    """Whether the model is a prediction-error fit, not a subspace model."""
    samples: float = 0.0
    """Effective number of samples behind the model."""
    constant: Array | None = None
    """(n,) constant of the state's equation: offsets of sensors, bends under gravity; None counts as 0. It is no part
    of the spread."""
    configurations: AnyConfiguration | None = None
    """The model of every configuration, where ``model`` is that at one configuration."""
    reason: str = ''
    """What gave the model its status, with numbers; empty where the status says it all."""

    def at(self, angles: Array) -> Identified:
        """Return the model at other measured angles (2,) [rad]. Raises ModelError where it does not depend on them."""
        if self.configurations is None:
            raise ModelError('the model holds at one configuration only',
                             'name the angles, displacements as outputs and twice as many states')
        return self.configurations.at(np.asarray(angles, dtype=np.float64))


class Tangent(NamedTuple):
    """Directions in which the model varies: (s, ...) stacks of dA, dB, dC, dD, dK."""

    A: Array
    B: Array
    C: Array
    D: Array
    K: Array

    def flat(self) -> Array:
        """(k, s) spread of [A, B, C, D, K]."""
        rows = [part.transpose(1, 2, 0).reshape(-1, part.shape[0]) for part in self]
        return np.ascontiguousarray(np.concatenate(rows))


def tangent(R: Array, realized: Realized, r: int, deviation: Array) -> Tangent:
    """Propagate dXi = deviation' Omega regression^-T, where Omega has independent standard normal entries.

    deviation: (m, m), deviation' deviation = covariance of the innovations x sum of squared weights / sum of weights.
    """
    A, T, Xi = realized.A, realized.T, realized.Xi
    n, past = T.shape
    m = Xi.shape[0]
    width = r + m
    d = realized.regression.shape[0]
    f = realized.S.shape[1] // m
    known, alone = _dual(np.hstack([realized.state, R[:, past:past + r]]), n)
    Q = R[:, :past + r].T @ known  # (past + r, n + r)
    Qz, Qu = Q[:past], Q[past:]
    later = np.zeros_like(Qz)
    later[:past - width] = Qz[width:]
    later[past - width:past - m] += Qu
    later[past - m:] += Xi @ Qz + realized.xi_u @ Qu
    Pz, direct = (Qz, Q) if d > past else ((R[:, :past].T @ alone),) * 2
    newest = np.zeros((past, m))
    newest[past - m:] = np.eye(m)
    lifted = [i * width for i in range(f)]
    ab, cd, k = 2 * f + 1, f + 1, f
    rights = np.zeros((d, ab * (n + r) + cd * direct.shape[1] + k * m))
    at = 0
    for X, up in (
            *((later, up) for up in lifted), *((Qz, up) for up in lifted), (Q[:d] if d > past else Qz, 0),
            (direct, 0), *((Pz, up) for up in lifted), *((newest, up) for up in lifted)):
        rights[:X.shape[0] - up, at:at + X.shape[1]] = X[up:]
        at += X.shape[1]
    found = solved(realized.regression, rights, trans=1)
    ends = np.cumsum([ab * (n + r), cd * direct.shape[1]])
    select = [realized.S[:, i * m:(i + 1) * m] @ deviation.T for i in range(f)]
    dAB = _combine([*select, *[-A @ s for s in select], T[:, past - m:] @ deviation.T], found[:, :ends[0]])
    dCD = _combine([deviation.T, *[-realized.C @ s for s in select]], found[:, ends[0]:ends[1]])
    dK = _combine(select, found[:, ends[1]:])
    dD = dCD[:, :, n:] if d > past else np.zeros((dCD.shape[0], m, r))
    return Tangent(dAB[:, :, :n], dAB[:, :, n:], dCD[:, :, :n], dD, dK)


def _dual(known: Array, n: int) -> tuple[Array, Array]:
    """Transposed pseudo-inverses (q, k), (q, n) of known (q, k) and of its first n columns."""
    basis, factor = np.linalg.qr(known)
    size = np.abs(np.diag(factor))
    if not size.min() > NEARLY_SINGULAR * size.max():
        unit = np.eye(known.shape[0])
        whole, part = (np.linalg.lstsq(X, unit, rcond=NEARLY_SINGULAR)[0].T for X in (known, known[:, :n]))
        return np.asarray(whole, dtype=np.float64), np.asarray(part, dtype=np.float64)
    return solved(factor, basis.T).T, solved(factor[:n, :n], basis[:, :n].T).T


def _combine(left: list[Array], right: Array) -> Array:
    """Sum over t of left_t Omega right_t, for each Omega with a single entry of 1: (s, rows, columns).

    right: (d, terms x columns).
    """
    d = right.shape[0]
    rows, a = left[0].shape
    terms = right.reshape(d, len(left), -1)
    columns = terms.shape[2]
    joint = np.stack(left).reshape(len(left), -1).T @ terms.transpose(1, 0, 2).reshape(len(left), -1)
    return joint.reshape(rows, a, d, columns).transpose(1, 2, 0, 3).reshape(a * d, rows, columns)


def move(model: StateSpace, along: Tangent, W: Array, dW: Array | None) -> Tangent:
    """Transform a tangent to the state W x; dW (s, n, n): variation of W with the model (None: W is constant)."""
    back = np.asarray(np.linalg.inv(W), dtype=np.float64)
    # the directions are the last axis: few large products instead of many small ones
    parts = (along.A, along.B, along.C, along.K)
    dA, dB, dC, dK = (np.ascontiguousarray(part.transpose(1, 2, 0)) for part in parts)
    dA, dB, dC, dK = _after(_before(W, dA), back), _before(W, dB), _after(dC, back), _before(W, dK)
    if dW is not None:
        turned = np.ascontiguousarray(dW.transpose(1, 2, 0))
        turn = _after(turned, back)
        moved = W @ model.A @ back
        dA += _after(turn, moved) - _before(moved, turn)
        dB += _after(turned, model.B)
        dC -= _before(model.C @ back, turn)
        dK += _after(turned, model.K)
    dA, dB, dC, dK = (part.transpose(2, 0, 1) for part in (dA, dB, dC, dK))
    return Tangent(dA, dB, dC, along.D, dK)


def _before(M: Array, X: Array) -> Array:
    """M X for each of the s directions, X: (rows, columns, s)."""
    return np.asarray((M @ X.reshape(X.shape[0], -1)).reshape(M.shape[0], *X.shape[1:]))


def _after(X: Array, M: Array) -> Array:
    """X M for each of the s directions, X: (rows, columns, s)."""
    return np.asarray(np.matmul(M.T, X))


def known_basis_tangent(model: StateSpace, along: Tangent) -> Array | None:
    """Derivatives dW (s, n, n) of the basis from ``realization.known_output_basis`` along the tangent."""
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


REAL = 1e-9
"""A pole whose angle [rad per sample] is below this does not oscillate."""


def modes(identified: Identified) -> tuple[Mode, ...]:
    """Oscillations of the identified model by rising frequency, with first-order standard deviations (nan: unknown)."""
    A, dt = identified.model.A, identified.model.dt
    n = A.shape[0]
    values, right = np.linalg.eig(A)
    found = []
    spread = identified.spread[:n * n]
    for index in np.flatnonzero(values.imag > 0.0):
        pole = values[index]
        if abs(np.angle(pole)) < REAL or abs(pole) == 0.0:
            continue
        s = np.log(pole) / dt
        left = np.linalg.solve(right.T, np.eye(n)[index])
        sensitivity = np.outer(left, right[:, index]).ravel()
        change = sensitivity @ spread / (pole * dt)
        frequency = s.imag / (2.0 * np.pi)
        damping = -s.real / abs(s)
        dampings = -(change.real * s.imag - change.imag * s.real) * s.imag / abs(s) ** 3
        std = float(np.linalg.norm(change.imag)) / (2.0 * np.pi) if spread.size else float('nan')
        damping_std = float(np.linalg.norm(dampings)) if spread.size else float('nan')
        found.append(Mode(float(frequency), float(damping), std, damping_std))
    return tuple(sorted(found))
