"""Compiled kernels of the VARX parameters: dozens of small products for each model that is read."""

from __future__ import annotations

from numba import njit

from flexmanip_ros.types import Array


@njit(cache=True)
def predictions(Xi: Array, f: int, r: int, weighted: bool, G: Array) -> None:
    """Fill G (f m, past): Xi (m, past) on windows shifted by 0..f - 1 samples, see ``varx``."""
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
    """Turn L (f m, f m), the identity, into the weight from predictor to system, see ``varx``."""
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
