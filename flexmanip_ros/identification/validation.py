"""Scores of a model held still, on data it has not seen."""

from __future__ import annotations

import numpy as np
from numba import njit

from flexmanip_ros.identification.realization import markov
from flexmanip_ros.types import Array, StateSpace


def vaf(y: Array, yhat: Array) -> Array:
    """Variance accounted for, one per output [%]: 100 (1 - var(y - yhat) / var(y)), not below 0.

    y, yhat: (N, m). An output that does not vary has no score (nan).
    """
    spread = np.var(y, axis=0)
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        score = 100.0 * (1.0 - np.var(y - yhat, axis=0) / spread)
    score = np.where(np.isfinite(score), score, np.where(spread > 0.0, 0.0, np.nan))
    return np.maximum(score, 0.0)


@njit(cache=True)
def _run(
    A: Array, B: Array, C: Array, D: Array, K: Array, U: Array, Y: Array, x: Array,
) -> tuple[Array, Array]:
    out = np.zeros((U.shape[0], C.shape[0]))
    for k in range(U.shape[0]):
        out[k] = C @ x + D @ U[k]
        x = A @ x + B @ U[k] + K @ (Y[k] - out[k])
    return out, x


def _filter(model: StateSpace, U: Array, Y: Array, x: Array) -> Array:
    A, B, C, D, K = (np.ascontiguousarray(a) for a in (model.A, model.B, model.C, model.D, model.K))
    return _run(A, B, C, D, K, np.ascontiguousarray(U), np.ascontiguousarray(Y), x)[0]


def simulate(model: StateSpace, U: Array, x0: Array | None = None) -> Array:
    """Outputs (N, m) for inputs U (N, r) from state x0 (n,) (zero by default); no measured output is used."""
    m, n = model.C.shape
    x = np.zeros(n) if x0 is None else np.array(x0, dtype=float)
    blind = StateSpace(model.A, model.B, model.C, model.D, np.zeros((n, m)), model.dt)
    return _filter(blind, U, np.zeros((U.shape[0], m)), x)


def predict(model: StateSpace, U: Array, Y: Array, x0: Array | None = None) -> Array:
    """One-step predictions (N, m) of outputs Y (N, m) by the innovation form (eqs. 22-23)."""
    x = np.zeros(model.order) if x0 is None else np.array(x0, dtype=float)
    return _filter(model, U, Y, x)


@njit(cache=True)
def _states(A: Array, B: Array, C: Array, D: Array, K: Array, U: Array, Y: Array, x: Array) -> Array:
    out = np.zeros((U.shape[0] + 1, A.shape[0]))
    for k in range(U.shape[0]):
        out[k] = x
        x = A @ x + B @ U[k] + K @ (Y[k] - C @ x - D @ U[k])
    out[U.shape[0]] = x
    return out


def predict_ahead(model: StateSpace, U: Array, Y: Array, steps: int, x0: Array | None = None) -> Array:
    """Predictions (N - steps + 1, m) of outputs Y (N, m), ``steps`` >= 1 ahead of the last output that each uses.

    Row k predicts Y[k + steps - 1] from the state that the outputs before k give, and from all inputs U (N, r).
    """
    m, n = model.C.shape
    count = U.shape[0] - steps + 1
    if count < 1:
        return np.zeros((0, m))
    x = np.zeros(n) if x0 is None else np.array(x0, dtype=float)
    A, B, C, D, K, inputs, outputs = (
        np.ascontiguousarray(a) for a in (model.A, model.B, model.C, model.D, model.K, U, Y))
    X = _states(A, B, C, D, K, inputs, outputs, x)[:count]
    response = markov(model, steps)
    ahead = X @ (model.C @ np.linalg.matrix_power(model.A, steps - 1)).T
    for o in range(m):
        for i in range(U.shape[1]):
            ahead[:, o] += np.convolve(U[:, i], response[:, o, i], mode='valid')
    return np.asarray(ahead, dtype=np.float64)


def state_at_end(model: StateSpace, U: Array, Y: Array) -> Array:
    """State (n,) one step after the last sample of a record, from which the record follows best.

    Least squares over the initial state of a free run through (U, Y), then that run's state at the end.
    It is done over the stretch in which the model's own dynamics stay well conditioned.
    """
    n = model.order
    A, B, C, D = model.A, model.B, model.C, model.D
    radius = float(np.abs(np.linalg.eigvals(A)).max(initial=1e-3))
    stretch = U.shape[0]
    if abs(np.log(max(radius, 1e-3))) > 0.0:
        stretch = min(stretch, max(10 * n, int(10.0 / abs(np.log(max(radius, 1e-3))))))
    U, Y = U[U.shape[0] - stretch:], Y[Y.shape[0] - stretch:]
    forced, power = np.zeros(n), np.eye(n)
    rows, target = [], []
    for u, y in zip(U, Y, strict=True):
        rows.append(C @ power)
        target.append(y - C @ forced - D @ u)
        forced = A @ forced + B @ u
        power = A @ power
    x0 = np.linalg.lstsq(np.vstack(rows), np.concatenate(target), rcond=None)[0] if rows else np.zeros(n)
    end: Array = power @ x0 + forced
    return end
