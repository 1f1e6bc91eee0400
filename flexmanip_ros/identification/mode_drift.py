"""Score test for a drift of the arm's frequencies along a stretch that was fitted with one constant model."""

from typing import NamedTuple

import numpy as np
import scipy

from flexmanip_ros.identification.prediction_check import MOST_SKEW
from flexmanip_ros.identification.prediction_error import (
    Fit,
    Structure,
    covariance_root,
    derivatives,
    following,
    innovation,
)
from flexmanip_ros.numerics.compiled import library
from flexmanip_ros.types import Array


@library
def sway(U: Array, Y: Array, A: Array, B: Array, C: Array, D: Array, turns: Array, x: Array, X: Array,
         E: Array, S: Array) -> None:
    """Simulate x+ = A x + B u, y = C x + D u, and the derivatives by drifts of A along ``turns`` (g, n, n).

    Drift g is A(t) = A + rate w(t) turns[g], where w goes from -1/2 to 1/2 over the stretch. Fills the residuals E
    (L, m) = Y - y and S (g, L, m), the derivative of y by the rate of each drift. x (n,) is the state at the start, and
    on return at the end; X (g, n) is its derivative by the rates, zero at first.
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
"""Number of standard deviations above which a drift rate does not count as chance."""
PERIODS = 5.0
"""Least number of periods of a mode in the stretch. Over fewer periods any other error of the model looks like a
drift."""
APART = 1e-4
"""Least share of the information on a drift rate that is left after the parameters of the fit have taken up theirs."""


class Drift(NamedTuple):
    """A steady drift estimated from the residuals, in the coordinates of the fit and the state at the end.

    ahead: (k,) step from the fit to the arm at the end of the stretch; rate: (k,) step of the arm in a time as long as
    the stretch.
    """

    ahead: Array
    rate: Array


def turns(A: Array, least: float = 0.0) -> Array:
    """Return the derivative of A (g, n, n) by the angle of each oscillating pole [rad]; g = 0 for a defective A.

    least: angle [rad] below which a pole is left out.
    """
    values, vectors = np.linalg.eig(A)
    if not np.linalg.cond(vectors) < MOST_SKEW:
        return np.zeros((0, *A.shape))
    left = np.linalg.solve(vectors, np.eye(len(A)))
    chosen = np.flatnonzero((values.imag > 0.0) & (np.angle(values) >= least))
    return np.array([2.0 * np.real(1j * values[i] * np.outer(vectors[:, i], left[i])) for i in chosen]
                    ).reshape(-1, *A.shape)


def drifting(U: Array, Y: Array, fit: Fit, structure: Structure, widening: float = 1.0) -> Drift | None:
    """Return the drift of a fit with K = 0 to U (N, r), Y (N, m); None where it may be chance.

    widening: factor on standard deviations from other errors of the residuals, see ``batch_fit``; its square multiplies
    the limit ``SURPRISE``.
    """
    theta = fit.theta
    if theta.K.any():  # with a gain the prediction depends on the outputs too
        return None
    n = theta.A.shape[0]
    moving = turns(theta.A, 2.0 * np.pi * PERIODS / len(U))
    if not len(moving):
        return None
    end, X = theta.x.copy(), np.zeros((len(moving), n))
    E, S = np.empty(Y.shape), np.empty((len(moving), *Y.shape))
    sway(U, Y, *theta[:4], moving, end, X, E, S)
    S[:, np.isnan(Y[:, 0])] = 0.0  # such rows were not measured
    lower = np.linalg.cholesky(fit.covariance)
    e, *s = (scipy.linalg.solve_triangular(lower, part.T, lower=True, check_finite=False).ravel() for part in (E, *S))
    own = np.array(s)
    # products of the derivatives by the drift rates with those by the parameters of the fit, which can take up a part
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
    rate = fit.directions.T @ flat  # drops the part that changes the basis; the state's share of it is small
    other = root @ (taken @ rho)
    ahead = 0.5 * rate - other
    ahead[k - n:] = X.T @ rho - fit.arrival @ other
    return Drift(ahead, rate)


def _beyond_chance(information: Array, gradient: Array, least: float) -> Array:
    """Return the drift rates (g,) from information (g, g) and gradient (g,); rates within chance are 0 and left out."""
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
