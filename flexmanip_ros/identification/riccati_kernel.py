"""Compiled kernel of the stationary Kalman filter: its Riccati equation by structure-preserving doubling.

A model is read from the moments while a message waits: the library's way by generalized eigenvectors takes
ten times as long at the sizes of a model, nearly all of it between its calls.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from flexmanip_ros.types import Array

STEPS = 30
"""Doublings, of 2^30 samples; a filter that needs more is left to the library."""
CONVERGED = 1e-15
"""Relative change of the solution at the last doubling."""


@njit(cache=True)
def eliminate(M: Array, B: Array) -> bool:
    """Overwrite B (n, k) with M^-1 B by elimination with row exchanges; M (n, n) is lost. False: singular."""
    n, k = B.shape
    for i in range(n):
        best = i
        for j in range(i + 1, n):
            if abs(M[j, i]) > abs(M[best, i]):
                best = j
        if not abs(M[best, i]) > 0.0:
            return False
        if best != i:
            for j in range(n):
                M[i, j], M[best, j] = M[best, j], M[i, j]
            for j in range(k):
                B[i, j], B[best, j] = B[best, j], B[i, j]
        for j in range(i + 1, n):
            a = M[j, i] / M[i, i]
            if a != 0.0:
                for q in range(i + 1, n):
                    M[j, q] -= a * M[i, q]
                for q in range(k):
                    B[j, q] -= a * B[i, q]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            a = M[i, j]
            for q in range(k):
                B[i, q] -= a * B[j, q]
        for q in range(k):
            B[i, q] /= M[i, i]
    return True


@njit(cache=True)
def multiply(X: Array, Y: Array, out: Array) -> None:
    """Fill out with X Y."""
    for i in range(X.shape[0]):
        for j in range(Y.shape[1]):
            out[i, j] = 0.0
        for q in range(X.shape[1]):
            a = X[i, q]
            for j in range(Y.shape[1]):
                out[i, j] += a * Y[q, j]


@njit(cache=True)
def doubled(A: Array, G: Array, H: Array) -> bool:
    """Let H (n, n) become the X with X = A' X (I + G X)^-1 A + H; A, G (n, n) are lost. False: it does not.

    A <- A W A, G <- G + A W G A', H <- H + A' H W A with W = (I + G H)^-1, where after k steps H is that of
    2^k samples.
    """
    n = A.shape[0]
    W, right = np.empty((n, n)), np.empty((n, 2 * n))
    WA, WG, first, second = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    for _ in range(STEPS):
        multiply(G, H, W)
        for i in range(n):
            W[i, i] += 1.0
        right[:, :n] = A
        right[:, n:] = G
        if not eliminate(W, right):
            return False
        WA[:] = right[:, :n]
        WG[:] = right[:, n:]
        multiply(H, WA, first)
        multiply(A.T, first, second)
        change = size = 0.0
        for i in range(n):
            for j in range(i + 1):
                more = 0.5 * (second[i, j] + second[j, i])
                H[i, j] += more
                H[j, i] = H[i, j]
            change = max(change, abs(second[i, i]))
            size = max(size, abs(H[i, i]))
        if not np.isfinite(size):
            return False
        multiply(A, WG, first)
        multiply(first, A.T, second)
        for i in range(n):
            for j in range(n):
                G[i, j] += 0.5 * (second[i, j] + second[j, i])
        multiply(A, WA, first)
        A[:] = first
        largest = 0.0
        for i in range(n):
            for j in range(n):
                largest = max(largest, abs(A[i, j]))
        if change <= CONVERGED * size and largest < 1.0:  # it is a power of the closed loop, which is stable
            return True
    return False


@njit(cache=True)
def gain(A: Array, C: Array, Q: Array, S: Array, R: Array, worst: float, K: Array) -> bool:
    """Fill K (n, m) of the stationary filter for noise of covariances Q (n, n), S (n, m), R (m, m).

    False: an output knows all but the share ``worst`` of another's noise, or the doubling does not converge.
    """
    n, m = S.shape
    right = np.empty((m, 2 * n))
    right[:, :n] = C
    right[:, n:] = S.T
    L = R.copy()
    for i in range(m):
        if not R[i, i] > 0.0:
            return False
    for i in range(m):  # pivots of the factor of R with a unit diagonal
        for j in range(i + 1):
            total = R[i, j] / np.sqrt(R[i, i] * R[j, j])
            for q in range(j):
                total -= L[i, q] * L[j, q]
            if i == j:
                if not total > worst:
                    return False
                L[i, i] = np.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    if not eliminate(R.copy(), right):
        return False
    F, G, H = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    multiply(S, right[:, :n], F)
    for i in range(n):
        for j in range(n):
            F[i, j] = A[i, j] - F[i, j]
    multiply(C.T, right[:, :n], G)
    multiply(S, right[:, n:], H)
    for i in range(n):
        for j in range(i + 1):
            H[i, j] = Q[i, j] - 0.5 * (H[i, j] + H[j, i])
            H[j, i] = H[i, j]
            G[i, j] = 0.5 * (G[i, j] + G[j, i])
            G[j, i] = G[i, j]
    if not doubled(F.T.copy(), G, H):
        return False
    PC, E, B = np.empty((n, m)), np.empty((m, m)), np.empty((m, n))
    multiply(H, C.T, PC)
    multiply(C, PC, E)
    multiply(A, PC, K)
    for i in range(m):
        for j in range(m):
            E[i, j] += R[i, j]
        for j in range(n):
            B[i, j] = K[j, i] + S[j, i]
    if not eliminate(E.T.copy(), B):
        return False
    K[:] = B.T
    return bool(np.all(np.isfinite(K)))
