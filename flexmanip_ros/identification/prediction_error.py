"""Prediction-error (maximum-likelihood) fit of the innovation form, started from the subspace model.

With a short past window the subspace model is biased where the noise is on the sensors alone: its predictor
has no time to average. The fit has no window: it runs the model over the stretch and descends on the
determinant of its innovation covariance. Unidentifiable directions (changes of basis) are left out by
moving only orthogonally to them (data-driven local coordinates).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flexmanip_ros.identification.prediction_error_kernel import linearize, residual_moments
from flexmanip_ros.types import Array

DAMPING = 1e-9
"""First Levenberg-Marquardt damping, relative to the diagonal of the information."""


class Theta(NamedTuple):
    """Model and state at the start of a stretch; scaled signals."""

    A: Array
    B: Array
    C: Array
    D: Array
    K: Array
    x: Array


class Structure(NamedTuple):
    """What may vary.

    free_output False holds C (the basis is fixed by it), free_gain False holds K, only_gain holds everything
    but K and the state.
    """

    free_output: bool
    free_direct: bool
    free_gain: bool
    only_gain: bool = False

    def names(self) -> str:
        """Return the parts that vary, in the order of the kernel."""
        if self.only_gain:
            return 'Kx'
        free = {'K': self.free_gain, 'C': self.free_output, 'D': self.free_direct}
        return ''.join(name for name in 'ABKCDx' if free.get(name, True))


class Fit(NamedTuple):
    """Result of a descent.

    directions: (d, k) coordinates that varied, information: (k, k) in them, arrival: (n, k) derivative of
    the state after the stretch, end: (n,) that state, covariance: (m, m) of the innovations, cost: log det.
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
    """(d, k) orthonormal coordinates: all of the parameters but changes of basis and what is held."""
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
    residual_moments(U, Y, *theta[:5], end, moments)
    covariance = moments / len(U)
    if not np.all(np.isfinite(covariance)):
        return covariance, end
    return covariance + 1e-14 * max(np.trace(covariance), 1e-300) * np.eye(m), end


def score(U: Array, Y: Array, theta: Theta) -> tuple[float, Array]:
    """Log det of the innovation covariance (infinite when the predictor runs away), and the covariance."""
    covariance, _ = run(U, Y, theta)
    if not np.all(np.isfinite(covariance)):
        return np.inf, covariance
    return float(np.linalg.slogdet(covariance)[1]), covariance


def derivatives(
    U: Array, Y: Array, theta: Theta, structure: Structure, covariance: Array, P: Array,
    before: Array | None = None,
) -> tuple[Array, Array, Array, Array, Array]:
    """Information (k, k), gradient (k,), innovation moments (m, m), arrival (n, k) and end state (n,).

    before: (n, k) derivative of the state at the start of the stretch, [0 I] when it is itself a parameter.
    """
    n, m = theta.A.shape[0], Y.shape[1]
    d = P.shape[0]
    N, g, moments = np.zeros((d, d)), np.zeros(d), np.zeros((m, m))
    X = np.zeros((n, d))
    X[:, d - n:] = np.eye(n)
    if before is not None:
        X = before @ P.T  # P has orthonormal columns
    end = theta.x.copy()
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    free = structure.names()
    linearize(U, Y, *theta[:5], end, whiten, int('A' in free), int('K' in free), int('C' in free),
              int('D' in free), N, g, moments, X)
    N = N + np.triu(N, 1).T
    return P.T @ N @ P, P.T @ g, moments, X @ P, end


def forgets(theta: Theta, count: int) -> bool:
    """Whether the predictor A - K C has let go of a state error after ``count`` samples."""
    if not all(np.all(np.isfinite(part)) for part in theta):
        return False
    return float(np.abs(np.linalg.eigvals(theta.A - theta.K @ theta.C)).max()) < 1.0 - 1.0 / count


def descend(U: Array, Y: Array, theta: Theta, structure: Structure, iterations: int) -> Fit | None:
    """Gauss-Newton on the innovation covariance over U (N, r), Y (N, m); None where it cannot start.

    Stops when the likelihood gains less than a hundredth of its own standard deviation.
    """
    cost, covariance = score(U, Y, theta)
    if not np.isfinite(cost):
        return None
    damping = DAMPING
    P = directions(theta, structure)
    for _ in range(iterations):
        information, gradient, _, _, _ = derivatives(U, Y, theta, structure, covariance, P)
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
    free = covariance * len(U) / max(len(U) - P.shape[1] / Y.shape[1], 0.2 * len(U))
    information, _, _, arrival, end = derivatives(U, Y, theta, structure, free, P)
    if not np.all(np.isfinite(information)):
        return None
    return Fit(theta, P, information, arrival, end, free, cost)


def covariance_root(information: Array) -> Array:
    """S with S S' = information^-1, directions without information at a large finite size."""
    size = np.sqrt(np.diag(information))
    size[size == 0.0] = 1.0
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    values = np.maximum(values, 1e-11 * max(float(values[-1]), 1e-300))
    root: Array = (vectors / np.sqrt(values)) / size[:, None]
    return root
