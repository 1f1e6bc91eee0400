"""Whether the frequencies of an arm drift along a stretch that a fit takes for that of one model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy
from numba import njit

from flexmanip_ros.identification.prediction_error import (
    Fit,
    Structure,
    covariance_root,
    derivatives,
    following,
    innovation,
)
from flexmanip_ros.types import Array


@njit(cache=True, nogil=True)
def sway(U: Array, Y: Array, A: Array, B: Array, C: Array, D: Array, turns: Array, x: Array, X: Array,
         E: Array, S: Array) -> None:
    """Simulate x+ = A x + B u, and its derivatives by rates at which A moves along ``turns`` (g, n, n).

    Fills residuals E (L, m) = Y - y and S (g, L, m), the derivative of y where A(t) = A + w(t) turn and w
    goes from -1/2 to 1/2 over the stretch. x (n,) is the state at the start, and on return at the end; X
    (g, n) is its derivative there, zero at first.
    """
    length, n = U.shape[0], A.shape[0]
    after, silent = np.empty(n), np.zeros((n, 0))
    nothing = np.empty(0)
    still = np.zeros((n, U.shape[1]))
    for t in range(length):
        w = (t - 0.5 * (length - 1)) / length
        innovation(U[t], Y[t], C, D, x, E[t])
        for g in range(turns.shape[0]):
            for o in range(C.shape[0]):
                total = 0.0
                for i in range(n):
                    total += C[o, i] * X[g, i]
                S[g, t, o] = total
            following(U[t], A, still, silent, X[g], nothing, after)
            for i in range(n):
                total = after[i]
                for j in range(n):
                    total += w * turns[g, i, j] * x[j]
                X[g, i] = total
        following(U[t], A, B, silent, x, nothing, after)
        for i in range(n):
            x[i] = after[i]


SURPRISE = 4.0
"""Standard deviations beyond which a drift is no chance."""
PERIODS = 5.0
"""Of a mode in the stretch at least: over few of them, whatever else the model lacks looks like a drift."""
APART = 1e-4
"""Share of what a drift does that the parameters of the fit must not be able to do as well."""
MOST_SKEW = 1e8
"""Condition of the eigenvectors of an A that is as good as defective."""


class Drift(NamedTuple):
    """What the residuals say of a steady drift, in the coordinates of the fit and the state at the end.

    ahead: (k,) from the fit to the arm at the end of the stretch; rate: (k,) further in as much time again.
    """

    ahead: Array
    rate: Array


def turns(A: Array, least: float = 0.0) -> Array:
    """Return dA (g, n, n) by the angle that each oscillation turns in a step [rad]; none of a defective A.

    least: angle [rad] below which an oscillation is left out.
    """
    values, vectors = np.linalg.eig(A)
    if not np.linalg.cond(vectors) < MOST_SKEW:
        return np.zeros((0, *A.shape))
    left = np.linalg.solve(vectors, np.eye(len(A)))
    chosen = np.flatnonzero((values.imag > 0.0) & (np.angle(values) >= least))
    return np.array([2.0 * np.real(1j * values[i] * np.outer(vectors[:, i], left[i])) for i in chosen]
                    ).reshape(-1, *A.shape)


def drift_of(U: Array, Y: Array, fit: Fit, structure: Structure, widening: float = 1.0) -> Drift | None:
    """Return the drift of a fit, see ``drifting``; None, too, where the numbers do not allow to tell."""
    try:
        return drifting(U, Y, fit, structure, widening)
    except np.linalg.LinAlgError:  # the fit itself is sound
        return None


def drifting(U: Array, Y: Array, fit: Fit, structure: Structure, widening: float = 1.0) -> Drift | None:
    """Return the drift of a fit with K = 0 to U (N, r), Y (N, m), None where it may be chance.

    widening: factor on standard deviations from what else is wrong with the residuals.
    """
    theta = fit.theta
    if theta.K.any():  # then the prediction rests on the outputs too
        return None
    n = theta.A.shape[0]
    moving = turns(theta.A, 2.0 * np.pi * PERIODS / len(U))
    if not len(moving):
        return None
    end, X = theta.x.copy(), np.zeros((len(moving), n))
    E, S = np.empty(Y.shape), np.empty((len(moving), *Y.shape))
    sway(U, Y, *theta[:4], moving, end, X, E, S)
    absent = np.isnan(Y[:, 0])
    E[absent], S[:, absent] = 0.0, 0.0
    lower = np.linalg.cholesky(fit.covariance)
    e, *s = (scipy.linalg.solve_triangular(lower, part.T, lower=True, check_finite=False).ravel() for part in (E, *S))
    own = np.array(s)
    # what the parameters of the fit can take up: derivatives of the prediction against those by the drift
    shared = np.array([_gradient(U, Y - E + part, fit, structure) for part in S]).T
    root = covariance_root(fit.information)
    taken = root.T @ shared
    information = own @ own.T - taken.T @ taken
    gradient = own @ e - taken.T @ (root.T @ _gradient(U, Y, fit, structure))
    if not np.all(np.isfinite(information)) or not np.all(np.isfinite(gradient)):
        return None
    apart = np.diag(information) > APART * np.sum(own ** 2, axis=1)
    rho = np.zeros(len(moving))
    rho[apart] = _beyond_chance(information[np.ix_(apart, apart)], gradient[apart], SURPRISE * widening ** 2)
    if not rho.any():
        return None
    k = fit.directions.shape[1]
    flat = np.zeros(fit.directions.shape[0])
    flat[:n * n] = np.einsum('g,gij->ij', rho, moving).ravel()
    rate = fit.directions.T @ flat  # a change of basis in it is dropped; the state's share of that is small
    other = root @ (taken @ rho)
    ahead = 0.5 * rate - other
    ahead[k - n:] = X.T @ rho - fit.arrival @ other
    return Drift(ahead, rate)


def _beyond_chance(information: Array, gradient: Array, least: float) -> Array:
    """Return rates (g,) of this information (g, g) and gradient: 0, and left out, where it may be chance."""
    left = np.arange(len(gradient))
    rates = np.zeros(len(gradient))
    while left.size:
        root = covariance_root(information[np.ix_(left, left)])
        rho = root @ (root.T @ gradient[left])
        deviations = np.abs(rho) / np.linalg.norm(root, axis=1)
        if deviations.min() > least:
            rates[left] = rho
            break
        left = np.delete(left, deviations.argmin())
    return rates


def _gradient(U: Array, Y: Array, fit: Fit, structure: Structure) -> Array:
    return derivatives(U, Y, fit.theta, structure, fit.covariance, fit.directions)[1]
