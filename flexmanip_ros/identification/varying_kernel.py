"""Compiled parts of the parameter-varying model: low-pass filter, and simulation with its derivatives."""

import math

import numpy as np

from flexmanip_ros.numerics.compiled import library
from flexmanip_ros.types import Array

TERMS = 6
"""Number of terms in the exponential series of a step. At 0.3 rad a step the terms left out are 1e-7 of the series."""

LARGEST = 30.0
"""Largest |zeta| that is told apart: there k is 0 or 1 to 1e-13. A trial step of a fit may lead anywhere, and at k = 1
the functions are infinite."""


@library
def low_pass(rows: Array, Ad: Array, Bd: Array, Cd: Array, state: Array, every: int, out: Array) -> None:
    """Run the columns of rows (N, w) through one filter of state (f, w); keep the last one of each ``every`` rows.

    Ad (f, f), Bd (f,): the filter; Cd (d, f): its output and the derivatives of the output. Fills out (d, N // every,
    w). All columns pass the same filter, so linear relations between them are preserved.
    """
    order, width = state.shape
    after = np.empty(order)
    for t in range(rows.shape[0]):
        for j in range(width):
            for i in range(order):
                total = Bd[i] * rows[t, j]
                for q in range(order):
                    total += Ad[i, q] * state[q, j]
                after[i] = total
            for i in range(order):
                state[i, j] = after[i]
        if (t + 1) % every == 0:
            k = t // every
            for d in range(Cd.shape[0]):
                for j in range(width):
                    value = 0.0
                    for i in range(order):
                        value += Cd[d, i] * state[i, j]
                    out[d, k, j] = value


@library
def simulate_block(U: Array, slope: Array, P: Array, bend: Array, V: Array, Y: Array, turn: Array, dt: float, G: Array,
                   G1: Array, H: Array, H1: Array, D: Array, E: Array, Q: Array, x: Array, whiten: Array, J: Array,
                   residual: Array, moments: Array, X: Array) -> None:
    """Simulate w'' = -(G + turn G1) w - D w' + (H + turn H1) u + Q p, y = w + E v over N steps, with its derivatives.

    U (N, r): u at the begin of each step; slope (N, r): change of u in the step; P, bend (N, d): the same of p; V (N,
    q): v; Y (N, h): measured y; turn (N,): change of the configuration, by which G1 and H1 are derivatives; x (2h,):
    [w; w'], on return at the end. The l local parameters are G, G1, H, H1, D, E, Q row by row, then x at the begin. X
    (2h, l): derivative of the state by them, [0 I] at the begin. J (N h, l) += the whitened derivative of y, residual
    (N h,) += the whitened e = Y - y; moments (h, h) += e e' of the unwhitened e.
    """
    h, r = H.shape
    d, q, width = P.shape[1], V.shape[1], X.shape[1]
    at_g1, at_h = h * h, 2 * h * h
    at_h1 = at_h + h * r
    at_d = at_h1 + h * r
    at_e = at_d + h * h
    at_q = at_e + h * q
    e, t, t_next = np.empty(h), np.empty(2 * h), np.empty(2 * h)
    T, T_next = np.empty((2 * h, width)), np.empty((2 * h, width))
    Gs, Hs = np.empty((h, h)), np.empty((h, r))
    for k in range(U.shape[0]):
        for o in range(h):
            total = Y[k, o] - x[o]
            for i in range(q):
                total -= E[o, i] * V[k, i]
            e[o] = total
        for o in range(h):
            row = k * h + o
            for p in range(h):
                w = whiten[o, p]
                residual[row] += w * e[p]
                for j in range(width):
                    J[row, j] += w * X[p, j]
                for i in range(q):
                    J[row, at_e + p * q + i] += w * V[k, i]
                moments[o, p] += e[o] * e[p]
        for a in range(h):
            for b in range(h):
                Gs[a, b] = G[a, b] + turn[k] * G1[a, b]
            for b in range(r):
                Hs[a, b] = H[a, b] + turn[k] * H1[a, b]
        for i in range(2 * h):
            t[i] = x[i]
            for j in range(width):
                T[i, j] = X[i, j]
        for order in range(1, TERMS + 1):  # x(t + dt) = sum of t_j, t_j = dt / j A t_{j-1}
            f = dt / order
            for a in range(h):
                t_next[a] = f * t[h + a]
                total = 0.0
                for b in range(h):
                    total -= Gs[a, b] * t[b] + D[a, b] * t[h + b]
                if order <= 2:
                    for b in range(r):
                        total += Hs[a, b] * (U[k, b] if order == 1 else slope[k, b])
                    for b in range(d):
                        total += Q[a, b] * (P[k, b] if order == 1 else bend[k, b])
                t_next[h + a] = f * total
                for j in range(width):
                    T_next[a, j] = f * T[h + a, j]
                    total = 0.0
                    for b in range(h):
                        total -= Gs[a, b] * T[b, j] + D[a, b] * T[h + b, j]
                    T_next[h + a, j] = f * total
                for b in range(h):
                    T_next[h + a, a * h + b] -= f * t[b]
                    T_next[h + a, at_g1 + a * h + b] -= f * turn[k] * t[b]
                    T_next[h + a, at_d + a * h + b] -= f * t[h + b]
                if order <= 2:
                    for b in range(r):
                        v = U[k, b] if order == 1 else slope[k, b]
                        T_next[h + a, at_h + a * r + b] += f * v
                        T_next[h + a, at_h1 + a * r + b] += f * turn[k] * v
                    for b in range(d):
                        T_next[h + a, at_q + a * d + b] += f * (P[k, b] if order == 1 else bend[k, b])
            for i in range(2 * h):
                x[i] += t_next[i]
                t[i] = t_next[i]
                for j in range(width):
                    X[i, j] += T_next[i, j]
                    T[i, j] = T_next[i, j]


def basis(c: float, zeta: float) -> tuple[Array, Array, Array, Array]:
    """Functions of the configuration (3,): 1, c / (1 - k c^2), c^2 / (1 - k c^2); derivatives by c, by zeta, by both.

    k = 1 / (1 + exp(-zeta)), between 0 and 1. The mass matrix of two links is affine in c = cos(theta2 - theta1), and c
    couples one coordinate of link 1 with those of link 2. So the inverse of the mass matrix is exactly linear in these
    three functions, for any number of modes.
    """
    k = 1.0 / (1.0 + math.exp(-min(max(zeta, -LARGEST), LARGEST)))
    dk, below = k * (1.0 - k), 1.0 - k * c * c
    value = np.array([1.0, c / below, c * c / below])
    by_c = np.array([0.0, (1.0 + k * c * c) / below ** 2, 2.0 * c / below ** 2])
    by_zeta = np.array([0.0, dk * c ** 3 / below ** 2, dk * c ** 4 / below ** 2])
    by_both = np.array([0.0, dk * c * c * (3.0 + k * c * c) / below ** 3, 4.0 * dk * c ** 3 / below ** 3])
    return value, by_c, by_zeta, by_both
