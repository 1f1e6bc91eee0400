"""Prediction-error (maximum-likelihood) fit of the innovation form, started from the subspace model."""

import math
from typing import NamedTuple

import numpy as np

from flexmanip_ros.errors import ModelError
from flexmanip_ros.identification.pbsid import pbsid
from flexmanip_ros.identification.realization import to_continuous, to_discrete
from flexmanip_ros.numerics.compiled import library
from flexmanip_ros.types import Array, StateSpace

GATHERED = 64
"""Number of samples whose derivatives J are gathered for one product J' J. At 4 outputs and 52 parameters J takes
100 kB, which fits the second-level cache of a core."""


@library
def innovation(u: Array, y: Array, C: Array, D: Array, x: Array, e: Array) -> bool:
    """Fill e (m,) = y - C x - D u; inputs beyond the columns of D have no direct term.

    A row that was not measured is NaN: its e is 0. Return whether it is one.
    """
    absent = bool(y[0] != y[0])
    for o in range(e.size):
        if absent:
            e[o] = 0.0
            continue
        total = y[o]
        for i in range(x.size):
            total -= C[o, i] * x[i]
        for i in range(D.shape[1]):
            total -= D[o, i] * u[i]
        e[o] = total
    return absent


@library
def following(u: Array, A: Array, B: Array, K: Array, x: Array, e: Array, after: Array) -> None:
    """Fill after (n,) = A x + B u + K e."""
    for i in range(x.size):
        total = 0.0
        for j in range(x.size):
            total += A[i, j] * x[j]
        for j in range(u.size):
            total += B[i, j] * u[j]
        for j in range(e.size):
            total += K[i, j] * e[j]
        after[i] = total


@library
def linearize(
    U: Array, Y: Array, A: Array, B: Array, C: Array, D: Array, K: Array, x: Array, whiten: Array,
    free_system: int, free_gain: int, free_output: int, free_direct: int,
    N: Array, g: Array, X: Array,
) -> None:
    """Run the predictor x+ = A x + B u + K e, e = y - C x - D u over (L, r), (L, m), and its derivatives.

    A row of Y that is NaN was not measured, and adds nothing to N and g.

    Parameters in order: A, B row-major if free_system, K if free_gain, C if free_output, D if free_direct, then x at
    the start. whiten: (m, m), whiten' whiten = inverse innovation covariance. On return x is the state after the last
    sample, N (d, d) += J' J and g (d,) += J' e with J the derivatives of the whitened predictions, and X (n, d) =
    dx/dparameters, started at [0 I] by the caller. J is gathered for ``GATHERED`` samples, so J' J is one product by
    the BLAS library.
    """
    n, r, m, direct = A.shape[0], B.shape[1], C.shape[0], D.shape[1]
    d = N.shape[0]
    at_b = n * n
    at_k = at_b + n * r if free_system else 0
    at_c = at_k + (n * m if free_gain else 0)
    at_d = at_c + (m * n if free_output else 0)
    closed, seen = A - K @ C, whiten @ C
    J, residuals = np.empty((GATHERED * m, d)), np.empty(GATHERED * m)
    e, after, moved = np.empty(m), np.empty(n), np.empty((n, d))
    filled = 0
    for k in range(U.shape[0]):
        absent = innovation(U[k], Y[k], C, D, x, e)  # the prediction goes on without such a row
        for o in range(0 if absent else m):
            row = J[filled + o]
            for j in range(d):
                row[j] = 0.0
            for i in range(n):
                for j in range(d):
                    row[j] += seen[o, i] * X[i, j]
            residuals[filled + o] = 0.0
            for q in range(m):
                w = whiten[o, q]
                residuals[filled + o] += w * e[q]
                if free_output:
                    for i in range(n):
                        row[at_c + q * n + i] += w * x[i]
                if free_direct:
                    for i in range(direct):
                        row[at_d + q * direct + i] += w * U[k, i]
        filled += 0 if absent else m
        if filled == GATHERED * m or (filled and k == U.shape[0] - 1):
            part = J[:filled]
            N += np.dot(part.T, part)
            g += np.dot(part.T, residuals[:filled])
            filled = 0
        for i in range(n):
            for j in range(d):
                moved[i, j] = 0.0
            for q in range(n):
                a = A[i, q] if absent else closed[i, q]
                for j in range(d):
                    moved[i, j] += a * X[q, j]
            if free_system:
                for j in range(n):
                    moved[i, i * n + j] += x[j]
                for j in range(r):
                    moved[i, at_b + i * r + j] += U[k, j]
            if free_gain:
                for j in range(m):
                    moved[i, at_k + i * m + j] += e[j]
            for o in range(0 if absent else m):
                if free_output:
                    for j in range(n):
                        moved[i, at_c + o * n + j] -= K[i, o] * x[j]
                if free_direct:
                    for j in range(direct):
                        moved[i, at_d + o * direct + j] -= K[i, o] * U[k, j]
        following(U[k], A, B, K, x, e, after)
        for i in range(n):
            x[i] = after[i]
            for j in range(d):
                X[i, j] = moved[i, j]


@library
def residual_moments(
    U: Array, Y: Array, A: Array, B: Array, C: Array, D: Array, K: Array, x: Array, moments: Array,
) -> None:
    """Run the predictor only: moments (m, m) += e e', x (n,) becomes the state after the last sample."""
    n, m = A.shape[0], C.shape[0]
    e = np.empty(m)
    after = np.empty(n)
    for k in range(U.shape[0]):
        innovation(U[k], Y[k], C, D, x, e)
        following(U[k], A, B, K, x, e, after)
        for i in range(n):
            x[i] = after[i]
        for o in range(m):
            for i in range(m):
                moments[o, i] += e[o] * e[i]


@library
def condition(H: Array, root: Array, gradient: Array, step: Array) -> None:
    """Update in square-root form: root (k, k) <- root L^-T with L L' = I + H, step = (I + H)^-1 gradient.

    H: (k, k) symmetric, whose upper triangle is overwritten with L^T; gradient, step: (k,). The loops are written out
    because a routine of the LAPACK library would start threads. The inner ones run along rows, without sums.
    """
    k = H.shape[0]
    for i in range(k):
        H[i, i] += 1.0
    for j in range(k):
        H[j, j] = math.sqrt(max(H[j, j], 1.0))  # I + H is never below I
        for t in range(j + 1, k):
            H[j, t] /= H[j, j]
        for i in range(j + 1, k):
            size = H[j, i]
            for t in range(i, k):
                H[i, t] -= size * H[j, t]
    for i in range(k):
        step[i] = gradient[i]
    for i in range(k):
        step[i] /= H[i, i]
        for t in range(i + 1, k):
            step[t] -= H[i, t] * step[i]
    for i in range(k - 1, -1, -1):
        total = step[i]
        for q in range(i + 1, k):
            total -= H[i, q] * step[q]
        step[i] = total / H[i, i]
    for row in range(root.shape[0]):
        for i in range(k):
            root[row, i] /= H[i, i]
            size = root[row, i]
            for t in range(i + 1, k):
                root[row, t] -= size * H[i, t]


DAMPING = 1e-9
"""First Levenberg-Marquardt damping, relative to the diagonal of the information."""


class Theta(NamedTuple):
    """Model and state at the start of a stretch; scaled signals.

    D: (m, r); B: (n, r), or (n, r + 1), whose last column multiplies an input of ones. This constant stands for offsets
    of sensors, and for bends under gravity.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    K: Array
    x: Array

    def matrices(self) -> tuple[Array, Array, Array, Array, Array]:
        """Return A, B, C, D, K in the one memory order that the kernels are compiled for."""
        A, B, C, D, K = (np.ascontiguousarray(part) for part in self[:5])
        return A, B, C, D, K


class Structure(NamedTuple):
    """Which matrices a fit varies; those held keep their values.

    free_output False holds C, which then fixes the basis; free_direct False holds D; free_gain False holds K; only_gain
    holds everything but K and the state.
    """

    free_output: bool
    free_direct: bool
    free_gain: bool
    only_gain: bool = False

    def names(self) -> str:
        """Return the letters of the parts that vary, in the order of the kernel."""
        if self.only_gain:
            return 'Kx'
        free = {'K': self.free_gain, 'C': self.free_output, 'D': self.free_direct}
        return ''.join(name for name in 'ABKCDx' if free.get(name, True))


class Fit(NamedTuple):
    """Result of a descent.

    directions: (d, k) orthonormal coordinates that varied; information: (k, k) in these coordinates; arrival: (n, k)
    derivative of the state after the stretch; end: (n,) that state; covariance: (m, m) of the innovations; cost: log
    det, see ``score``.
    """

    theta: Theta
    directions: Array
    information: Array
    arrival: Array
    end: Array
    covariance: Array
    cost: float


def pack(theta: Theta, structure: Structure) -> Array:
    """(d,) parameters in the order of the kernel."""
    return np.concatenate([getattr(theta, name).ravel() for name in structure.names()])


def moved(theta: Theta, step: Array, structure: Structure) -> Theta:
    """Theta plus a step (d,)."""
    new, at = {}, 0
    for name in structure.names():
        part = getattr(theta, name)
        new[name] = part + step[at:at + part.size].reshape(part.shape)
        at += part.size
    return theta._replace(**new)


def directions(theta: Theta, structure: Structure) -> Array:
    """(d, k) orthonormal coordinates of the parameters that vary, without the directions that only change the basis."""
    n = theta.A.shape[0]
    d = pack(theta, structure).size
    chosen = np.eye(d - n)
    if structure.free_output and not structure.only_gain:
        orbit = []
        for i in range(n):
            for j in range(n):
                E = np.zeros((n, n))
                E[i, j] = 1.0
                turned = Theta(E @ theta.A - theta.A @ E, E @ theta.B, -theta.C @ E, 0.0 * theta.D,
                               E @ theta.K, theta.x)
                orbit.append(pack(turned, structure)[:d - n])
        left, values, _ = np.linalg.svd(np.array(orbit).T, full_matrices=True)
        chosen = left[:, int(np.sum(values > 1e-10 * values[0])):]
    both = np.zeros((d, chosen.shape[1] + n))
    both[:d - n, :chosen.shape[1]] = chosen
    both[d - n:, chosen.shape[1]:] = np.eye(n)
    return both


def run(U: Array, Y: Array, theta: Theta) -> tuple[Array, Array]:
    """Innovation covariance (m, m) over the stretch, and the state (n,) after it."""
    m = Y.shape[1]
    moments, end = np.zeros((m, m)), theta.x.copy()
    residual_moments(U, Y, *theta.matrices(), end, moments)
    covariance = moments / measured(Y)
    if not np.all(np.isfinite(covariance)):
        return covariance, end
    return covariance + 1e-14 * max(np.trace(covariance), 1e-300) * np.eye(m), end


def measured(Y: Array) -> int:
    """Return the number of rows of Y (N, m) that were measured, at least 1."""
    return max(len(Y) - int(np.isnan(Y[:, 0]).sum()), 1)


def score(U: Array, Y: Array, theta: Theta) -> tuple[float, Array]:
    """Log det of the innovation covariance (infinite when the predictor diverges), and the covariance."""
    covariance, _ = run(U, Y, theta)
    if not np.all(np.isfinite(covariance)):
        return np.inf, covariance
    return float(np.linalg.slogdet(covariance)[1]), covariance


def derivatives(
    U: Array, Y: Array, theta: Theta, structure: Structure, covariance: Array, P: Array,
    before: Array | None = None,
) -> tuple[Array, Array, Array, Array]:
    """Information (k, k), gradient (k,), arrival (n, k) and end state (n,), see ``Fit``.

    before: (n, k) derivative of the state at the start of the stretch; None: [0 I], that state is itself a parameter.
    """
    n, d = theta.A.shape[0], P.shape[0]
    N, g = np.zeros((d, d)), np.zeros(d)
    X = np.zeros((n, d))
    X[:, d - n:] = np.eye(n)
    if before is not None:
        X = before @ P.T  # P has orthonormal columns
    end = theta.x.copy()
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    free = structure.names()
    linearize(U, Y, *theta.matrices(), end, whiten, int('A' in free), int('K' in free), int('C' in free),
              int('D' in free), N, g, X)
    return P.T @ N @ P, P.T @ g, X @ P, end


def forgets(theta: Theta, count: int) -> bool:
    """Whether the predictor A - K C forgets a state error in ``count`` samples: spectral radius < 1 - 1 / count."""
    if not all(np.all(np.isfinite(part)) for part in theta):
        return False
    return float(np.abs(np.linalg.eigvals(theta.A - theta.K @ theta.C)).max()) < 1.0 - 1.0 / count


def descend(U: Array, Y: Array, theta: Theta, structure: Structure, iterations: int) -> Fit | None:
    """Minimize log det of the innovation covariance over U (N, r), Y (N, m) by damped Gauss-Newton steps.

    None where a number is not finite. Stops when the likelihood gains less than a hundredth of its own standard
    deviation.
    """
    cost, covariance = score(U, Y, theta)
    if not np.isfinite(cost):
        return None
    damping = DAMPING
    P = directions(theta, structure)
    for _ in range(iterations):
        information, gradient, _, _ = derivatives(U, Y, theta, structure, covariance, P)
        if not np.all(np.isfinite(information)):
            return None
        size = np.sqrt(np.diag(information))
        size[size == 0.0] = 1.0
        scaled = information / np.outer(size, size)
        gain = -1.0
        for _ in range(6):
            step = np.linalg.solve(scaled + damping * np.eye(len(size)), gradient / size) / size
            trial = moved(theta, P @ step, structure)
            steady = not structure.free_gain or forgets(trial, len(U))
            trial_cost, trial_covariance = score(U, Y, trial) if steady else (np.inf, covariance)
            gain = cost - trial_cost
            if gain > 0.0:
                break
            damping *= 100.0
        if not gain > 0.0:
            break
        theta, cost, covariance = trial, trial_cost, trial_covariance
        damping = max(0.1 * damping, 1e-12)
        if len(U) * gain < 0.01:
            break
    P = directions(theta, structure)
    count = measured(Y)
    free = covariance * count / max(count - P.shape[1] / Y.shape[1], 0.2 * count)
    information, _, arrival, end = derivatives(U, Y, theta, structure, free, P)
    if not np.all(np.isfinite(information)):
        return None
    return Fit(theta, P, information, arrival, end, free, cost)


def covariance_root(information: Array) -> Array:
    """S with S S' = information^-1; directions without information have a large finite variance."""
    size = np.sqrt(np.diag(information))
    size[size == 0.0] = 1.0
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    values = np.maximum(values, 1e-11 * max(float(values[-1]), 1e-300))
    return np.asarray((vectors / np.sqrt(values)) / size[:, None])


ROWS, PAST, RIDGE = 128, 8, 1e-3
"""Settings of ``averaged``: number of means over the stretch, past window in means, and ridge on the VARX
parameters."""


def candidate(model: StateSpace, feedthrough: bool, means: tuple[Array, Array] | None) -> tuple[Theta, Structure]:
    """Starting point from a model of scaled signals; C is held at I where it is square and well conditioned.

    means: of inputs (r,) and outputs (m,), for a model of signals about their means. It gets a constant, and its
    state shifted by s, where C s is the mean of y - D u.
    """
    n, m = model.A.shape[0], model.C.shape[0]
    shift, B = np.zeros(n), model.B
    if means is not None:
        u, y = means
        shift = np.asarray(np.linalg.lstsq(model.C, y - model.D @ u, rcond=None)[0], dtype=np.float64)
        B = np.column_stack([B, shift - model.A @ shift - B @ u])
    theta = Theta(model.A, B, model.C, model.D, model.K, shift)
    holds_output = n == m and bool(np.linalg.cond(model.C) < 1e6)
    if holds_output:
        W = model.C
        A = np.asarray(np.linalg.solve(W.T, (W @ model.A).T).T, dtype=np.float64)
        theta = Theta(A, W @ B, np.eye(n), model.D, W @ model.K, W @ shift)
    dense = Theta(*(np.ascontiguousarray(part) for part in theta))
    return dense, Structure(free_output=not holds_output, free_direct=feedthrough, free_gain=False)


def averaged(U: Array, Y: Array, n: int, centred: bool) -> StateSpace | None:
    """Batch model of order n, with slow modes, from means over many samples of U (N, r), Y (N, m); None where it fails.

    Its past window is ``PAST`` means long, and so spans whole periods of slow modes. centred: see ``pbsid``.
    """
    every = len(U) // ROWS
    if every < 2:
        return None
    u, y = (X[:every * ROWS].reshape(ROWS, every, -1).mean(axis=1) for X in (U, Y))
    try:
        model, _ = pbsid(u, y, n=n, p=PAST, f=PAST, dt=float(every), regularization=RIDGE, centred=centred)
        A, B = to_discrete(*to_continuous(model.A, model.B, float(every)), 1.0)
    except (ModelError, np.linalg.LinAlgError):
        return None
    found = StateSpace(A, B, model.C, np.zeros_like(model.D), np.zeros((n, Y.shape[1])), 1.0)
    return found if all(np.all(np.isfinite(part)) for part in (A, B, model.C)) else None
