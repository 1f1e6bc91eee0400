"""Compiled simulation of a model whose frequencies drift along a stretch."""

from __future__ import annotations

import numpy as np
from numba import njit

from flexmanip_ros.identification.prediction_error_kernel import following, innovation
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
                after[i] = total
            X[g] = after
        following(U[t], A, B, silent, x, nothing, after)
        x[:] = after
