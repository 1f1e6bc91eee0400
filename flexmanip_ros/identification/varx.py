"""From VARX parameters to observability x controllability (paper eqs. 26-35), and the regressors of a record."""

from __future__ import annotations

import numpy as np
from numba import njit

from flexmanip_ros.types import Array


def past_windows(U: Array, Y: Array, p: int) -> Array:
    """(N - p + 1, p (r + m)): row k holds [u; y] of samples k..k+p-1, oldest first (eqs. 24-25).

    The last row is the window after the last sample.
    """
    joint = np.hstack([U, Y])
    count = max(joint.shape[0] - p + 1, 0)
    columns = [joint[i:i + count] for i in range(p)]
    return np.hstack(columns) if columns else np.zeros((count, 0))


@njit(cache=True)
def predictions(Xi: Array, f: int, r: int, weighted: bool, G: Array) -> None:
    """Fill G (f m, past) from Xi (m, past), shifted by 0..f - 1 samples; see ``observability_controllability``."""
    m, past = Xi.shape
    width = r + m
    for i in range(f):
        for o in range(m):
            for q in range(i * width):
                G[i * m + o, q] = 0.0
            for q in range(i * width, past):
                G[i * m + o, q] = Xi[o, q - i * width]
        if weighted:
            for j in range(i):
                at = past - (i - j) * width + r
                for o in range(m):
                    for k in range(m):
                        a = Xi[o, at + k]
                        for q in range(past):
                            G[i * m + o, q] += a * G[j * m + k, q]


@njit(cache=True)
def open_loop(Xi: Array, f: int, r: int, L: Array) -> None:
    """Turn L (f m, f m), at first the identity, into the result of ``open_loop_weight``."""
    m, past = Xi.shape
    width = r + m
    for i in range(f):
        for j in range(i):
            at = past - (i - j) * width + r
            for o in range(m):
                for k in range(m):
                    a = Xi[o, at + k]
                    for q in range((j + 1) * m):
                        L[i * m + o, q] += a * L[j * m + k, q]


def observability_controllability(Xi: Array, f: int, r: int, weighted: bool) -> Array:
    """(f m, p (r + m)): predictions of the next f outputs for inputs (and innovations) at rest.

    weighted False: future outputs count as zero (observability of the predictor, A - K C); True: they are replaced by
    their own predictions (observability of the system, A).
    """
    G = np.empty((f * Xi.shape[0], Xi.shape[1]))
    predictions(np.ascontiguousarray(Xi), f, r, weighted, G)
    return G


def open_loop_weight(Xi: Array, f: int, r: int) -> Array:
    """(f m, f m) lower triangular L with observability of the system = L x observability of the predictor."""
    L = np.eye(f * Xi.shape[0])
    open_loop(np.ascontiguousarray(Xi), f, r, L)
    return L
