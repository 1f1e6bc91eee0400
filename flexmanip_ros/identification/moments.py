"""Predictor-based subspace identification from one triangular factor of the data's second moments.

Every signal of the method is linear in phi(k) = [z(k); u(k); y(k)], so its least-squares problems need the moments of
phi only. Let R be upper triangular with R'R = sum of weight(k) phi(k) phi(k)'. Then signals s(k) = M phi(k) have the
moments (R M')' (R M'), so R M' takes the place of their data matrix. The recursive solution equals the batch solution
with the same weights to round-off: no state comes from an earlier estimate of the parameters.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from flexmanip_ros.identification.pbsid import observability_controllability, open_loop_weight
from flexmanip_ros.types import Array

RIDGE = 1e-8
"""Relative ridge that selects the solution of least norm where the data leave a direction undetermined."""


class Realized(NamedTuple):
    """A model of scaled signals in the basis of the state x = T z, with the quantities that its uncertainty needs."""

    A: Array
    B: Array
    C: Array
    D: Array
    K: Array
    Xi: Array
    """(m, p (r + m)) VARX parameters."""
    xi_u: Array
    """(m, r) direct term of the VARX."""
    S: Array
    """(n, f m) selection of the state: x = S (observability of the predictor x controllability) z."""
    T: Array
    """(n, p (r + m)) = S x predictor observability x controllability."""
    state: Array
    """(q, n) R T', whose columns have the moments of x."""
    residual: Array
    """(m, m) square root E with E'E = innovation moments."""
    regression: Array
    """(d, d) upper triangular factor of the regressors' moments, ridge included."""
    singular_values: Array
    neglected: Array
    """(m,) innovation variance due to the limited order, relative to that of the VARX (0: none)."""


def triangle(tall: Array) -> Array:
    """Upper triangular R with R'R = tall' tall."""
    R: Array = np.linalg.qr(tall, mode='r')  # type: ignore[assignment]
    return R


def solved(upper: Array, target: Array, trans: int = 0) -> Array:
    """X with upper X = target (trans 1: upper' X). (d, d), (d, k); raises LinAlgError where singular."""
    X, info = scipy.linalg.lapack.dtrtrs(upper, target, trans=trans)
    if info:
        raise np.linalg.LinAlgError('the factor of the regressors is singular')
    return np.asarray(X)


def regress(regressor: Array, target: Array) -> Array:
    """Least-squares solution M (k, d) of least norm of regressor M' = target. regressor: (q, d), target: (q, k)."""
    return np.asarray(np.linalg.lstsq(regressor, target, rcond=1e-13)[0].T, dtype=np.float64)


def solve_regressor(R: Array, d: int, m: int) -> tuple[Array, Array]:
    """VARX parameters (m, d) and the factor (d, d) of the regressors' moments that gave them."""
    head = R[:d, :d]
    size = np.sqrt(np.einsum('ij,ij->j', head, head))
    size[size == 0.0] = 1.0
    diagonal = np.abs(np.diag(head)) / size
    target = R[:d, -m:]
    if d and diagonal.min() < RIDGE:
        stacked = np.zeros((2 * d, d + m))
        stacked[:d, :d] = head
        stacked[:d, d:] = target
        stacked[d:, :d] = np.diag(RIDGE * size)
        folded = triangle(stacked)
        head, target = folded[:d, :d], folded[:d, d:]
    return solved(head, target).T, head


def row_whitening(
    data: Array, head: Array, residual: Array, power: float, f: int, width: int,
) -> Array:
    """(f m, f m) weight that gives equal size to the errors of the rows of G z from the VARX parameters.

    Row block i of G z is Xi times the window shifted by i samples and filled with zeros. Such windows do not occur in
    the data, which determine Xi poorly for them: without the weight the later rows spoil the state. data: (past, past),
    data'data = moments of z; head: factor that gave Xi; residual: (m, m) root of the innovations' moments; power: root
    of the outputs' moments, for a lower bound on the residual.
    """
    past, m, d = data.shape[0], residual.shape[0], head.shape[0]
    moved = np.zeros((f, d, past))
    for i in range(f):
        moved[i, i * width:past] = data.T[:past - i * width]
    loose = solved(head, moved.transpose(1, 0, 2).reshape(d, -1), trans=1)
    loose = loose.reshape(d, f, past).transpose(1, 0, 2).reshape(f, -1)
    rows = triangle(loose.T)
    noise = triangle(np.vstack([residual, RIDGE * power * np.eye(m)]))
    outer = np.linalg.inv(rows + RIDGE * np.abs(rows).max() * np.eye(f)).T
    inner = np.linalg.inv(noise).T
    return np.asarray((outer[:, None, :, None] * inner[None, :, None, :]).reshape(f * m, f * m))


def riccati_gain(A: Array, C: Array, process: Array, measurement: Array, fallback: Array) -> Array:
    """K (n, m) of the stationary Kalman filter: K = (A P C' + S) (C P C' + R)^-1, P from the Riccati equation.

    process: (q, n) residuals of the state, measurement: (q, m) residuals of the outputs; their second moments are
    Q, S and R. fallback: (n, m) returned where the equation has no stabilizing solution.
    """
    floor = RIDGE ** 2 * max(np.trace(measurement.T @ measurement), 1e-300)
    R = measurement.T @ measurement + floor * np.eye(C.shape[0])
    scale = np.trace(R)
    Q, S = process.T @ process / scale, process.T @ measurement / scale
    try:
        P = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R / scale, s=S)
        gain: Array = np.linalg.solve(C @ P @ C.T + R / scale, (A @ P @ C.T + S).T).T
    except (np.linalg.LinAlgError, ValueError):
        return fallback
    return gain if np.all(np.isfinite(gain)) else fallback


def realize_orders(
    R: Array, r: int, m: int, orders: Sequence[int], f: int, *, feedthrough: bool, weighted: bool,
    fixed: bool = False, riccati: bool = False,
) -> list[Realized | None]:
    """Models of several orders n from the factor R (q, q) of [z; u; y]; None where the moments have a rank below n.

    All share one regression and one decomposition. fixed: S = [I 0], so the state is the first n rows of (observability
    x controllability) z; otherwise S holds the leading n left singular vectors of the whitened product of that matrix
    with the data. riccati: the gain K solves the Riccati equation of the residuals, which makes the predictor stable;
    otherwise K is regressed like A and B.
    """
    width = r + m
    past = R.shape[0] - width
    d = past + r if feedthrough else past
    solution, head = solve_regressor(R, d, m)
    Xi, xi_u = solution[:, :past], solution[:, past:] if feedthrough else np.zeros((m, r))
    G = observability_controllability(Xi, f, r, weighted)
    tail = R[d:, past + r:]
    residual = triangle(tail) if tail.shape[0] > m else tail
    if fixed:
        whiten = np.eye(f * m)
    else:
        power = float(np.linalg.norm(R[:, past + r:]))
        whiten = row_whitening(R[:past, :past], head, residual, power, f, width)
    left, values, _ = np.linalg.svd(whiten @ (G @ R[:past, :past].T), full_matrices=False)
    weight = open_loop_weight(Xi, f, r) if weighted else np.eye(f * m)
    own = observability_controllability(Xi, f, r, False) if weighted else G
    found: list[Realized | None] = []
    for n in orders:
        if not np.all(np.isfinite(values)) or values.size < n or values[n - 1] <= 1e-14 * values[0]:
            found.append(None)
            continue
        S = np.eye(n, f * m) if fixed else (left[:, :n] / np.sqrt(values[:n])).T @ whiten
        if weighted:
            S = S @ weight
        T = S @ own
        state = R[:, :past] @ T.T
        u, y = R[:, past:past + r], R[:, past + r:]
        output = np.hstack([state, u]) if feedthrough else state
        CD = regress(output, y)
        innovation = y - output @ CD.T
        following = R[:, width:] @ T.T
        ABK = regress(np.hstack([state, u, innovation]), following)
        K = ABK[:, n + r:]
        if riccati:
            rest = following - np.hstack([state, u]) @ ABK[:, :n + r].T
            K = riccati_gain(ABK[:, :n], CD[:, :n], rest, innovation, K)
        D = CD[:, n:] if feedthrough else np.zeros((m, r))
        most = np.einsum('ij,ij->j', residual, residual)
        extra = np.einsum('ij,ij->j', innovation, innovation) - most
        found.append(Realized(
            A=ABK[:, :n], B=ABK[:, n:n + r], C=CD[:, :n], D=D, K=K, Xi=Xi, xi_u=xi_u, S=S, T=T,
            state=state, residual=residual, regression=head, singular_values=values,
            neglected=np.divide(np.maximum(extra, 0.0), most, out=np.zeros(m), where=most > 0.0),
        ))
    return found
