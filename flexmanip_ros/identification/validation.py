"""Scores of a fixed model on data that it was not identified from."""

import math
from dataclasses import replace

import numpy as np

from flexmanip_ros.identification.realization import markov
from flexmanip_ros.numerics.compiled import library
from flexmanip_ros.types import Array, StateSpace

TIME_CONSTANTS = 10.0
"""Length of the record for ``state_at_end`` in time constants of the slowest pole. In this time a state decays to
e^-10, or 5e-5, of itself, or grows by the inverse."""
ROWS_A_STATE = 10
"""Least number of samples for each state in that record: with fewer the state fits the noise."""
QUICKEST = 1e-3
"""Lower bound on the modulus of the slowest pole, for its time constant."""


def affine(model: StateSpace, constant: Array | None, U: Array) -> tuple[StateSpace, Array]:
    """Return the model with a further input of ones for its constant (n,), if any, and U (N, r) with that input."""
    if constant is None:
        return model, U
    wider = replace(model, B=np.column_stack([model.B, constant]), D=np.column_stack([model.D, np.zeros(len(model.D))]))
    return wider, np.column_stack([U, np.ones(len(U))])


def vaf(y: Array, yhat: Array) -> Array:
    """Variance accounted for, one per output [%]: 100 (1 - var(y - yhat) / var(y)), not below 0.

    y, yhat: (N, m). An output that does not vary has no score (nan).
    """
    spread = np.var(y, axis=0)
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        score = 100.0 * (1.0 - np.var(y - yhat, axis=0) / spread)
    score = np.where(np.isfinite(score), score, np.where(spread > 0.0, 0.0, np.nan))
    return np.maximum(score, 0.0)


@library
def _run(A: Array, V: Array, X: Array) -> None:
    """Fill X (N + 1, n), whose first row is given, by x+ = A x + v with V (N, n)."""
    for k in range(V.shape[0]):
        for i in range(A.shape[0]):
            value = V[k, i]
            for j in range(A.shape[1]):
                value += A[i, j] * X[k, j]
            X[k + 1, i] = value


def _states(model: StateSpace, U: Array, Y: Array | None, x0: Array | None) -> Array:
    """States (N + 1, n) from x0 on; with outputs Y (N, m) those of the innovation form (eqs. 22-23)."""
    A, V = model.A, U @ model.B.T
    if Y is not None:
        A, V = A - model.K @ model.C, V + (Y - U @ model.D.T) @ model.K.T
    X = np.zeros((len(U) + 1, model.order))
    X[0] = 0.0 if x0 is None else x0
    _run(np.ascontiguousarray(A), V, X)
    return X


def _outputs(model: StateSpace, U: Array, X: Array) -> Array:
    return np.asarray(X[:-1] @ model.C.T + U @ model.D.T)


def simulate(model: StateSpace, U: Array, x0: Array | None = None) -> Array:
    """Outputs (N, m) for inputs U (N, r) from state x0 (n,) (zero by default); no measured output is used."""
    return _outputs(model, U, _states(model, U, None, x0))


def predict(model: StateSpace, U: Array, Y: Array, x0: Array | None = None) -> Array:
    """One-step predictions (N, m) of outputs Y (N, m) by the innovation form."""
    return _outputs(model, U, _states(model, U, Y, x0))


def predict_ahead(model: StateSpace, U: Array, Y: Array, steps: int, x0: Array | None = None) -> Array:
    """Predictions (N - steps + 1, m) of outputs Y (N, m), each ``steps`` >= 1 samples after the last output it uses.

    Row k predicts Y[k + steps - 1] from the state after the outputs before k, and from all inputs U (N, r).
    """
    m, count = model.C.shape[0], U.shape[0] - steps + 1
    if count < 1:
        return np.zeros((0, m))
    X = _states(model, U, Y, x0)[:count]
    response = markov(model, steps)
    ahead = X @ (model.C @ np.linalg.matrix_power(model.A, steps - 1)).T
    for o in range(m):
        for i in range(U.shape[1]):
            ahead[:, o] += np.convolve(U[:, i], response[:, o, i], mode='valid')
    return np.asarray(ahead, dtype=np.float64)


def state_at_end(model: StateSpace, U: Array, Y: Array) -> Array:
    """State (n,) one step after the last sample of a record, for the initial state that fits the record best.

    Least squares gives the initial state of a simulation through (U, Y); the result is the simulated state at the end.
    The record is cut to its last samples (``TIME_CONSTANTS``), over which the problem stays well conditioned.
    """
    n = model.order
    A, B, C, D = model.A, model.B, model.C, model.D
    rate = abs(math.log(float(np.abs(np.linalg.eigvals(A)).max(initial=QUICKEST))))
    stretch = U.shape[0]
    if rate > 0.0:
        stretch = min(stretch, max(ROWS_A_STATE * n, int(TIME_CONSTANTS / rate)))
    U, Y = U[U.shape[0] - stretch:], Y[Y.shape[0] - stretch:]
    forced, power = np.zeros(n), np.eye(n)
    rows, target = [], []
    for u, y in zip(U, Y, strict=True):
        rows.append(C @ power)
        target.append(y - C @ forced - D @ u)
        forced = A @ forced + B @ u
        power = A @ power
    x0 = np.linalg.lstsq(np.vstack(rows), np.concatenate(target), rcond=None)[0] if rows else np.zeros(n)
    return np.asarray(power @ x0 + forced)
