"""From VARX parameters to observability x controllability (paper eqs. 26-35), and the batch identification by them.

The batch identification is a first guess of the fits, and the reference for the recursion. It works on the data
matrices (paper eqs. 22-37 with all samples at once) and shares no arithmetic with the factor of ``moments.py``: the
states are computed sample by sample, and the matrices are regressed on them.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from flexmanip_ros.errors import ModelError
from flexmanip_ros.numerics.compiled import library
from flexmanip_ros.types import Array, StateSpace


@library
def unfold(Xi: Array, r: int, G: Array) -> None:
    """Add to each block row i of G (f m, q) the rows j < i times the coefficients of output j in Xi (m, past)."""
    m, past = Xi.shape
    width = r + m
    for i in range(G.shape[0] // m):
        for j in range(i):
            at = past - (i - j) * width + r
            for o in range(m):
                for k in range(m):
                    a = Xi[o, at + k]
                    for q in range(G.shape[1]):
                        G[i * m + o, q] += a * G[j * m + k, q]


def observability_controllability(Xi: Array, f: int, r: int, weighted: bool) -> Array:
    """(f m, p (r + m)): predictions of the next f outputs for inputs (and innovations) at rest.

    weighted False: future outputs count as zero (observability of the predictor, A - K C); True: they are replaced by
    their own predictions (observability of the system, A).
    """
    m, past = Xi.shape
    G = np.zeros((f * m, past))
    for i in range(f):
        G[i * m:(i + 1) * m, i * (r + m):] = Xi[:, :max(past - i * (r + m), 0)]
    if weighted:
        unfold(np.ascontiguousarray(Xi), r, G)
    return G


def open_loop_weight(Xi: Array, f: int, r: int) -> Array:
    """(f m, f m) lower triangular L with observability of the system = L x observability of the predictor."""
    L = np.eye(f * Xi.shape[0])
    unfold(np.ascontiguousarray(Xi), r, L)
    return L


def pbsid(
    U: Array, Y: Array, *, n: int, p: int, f: int, dt: float,
    weighted: bool = True, fixed: bool = False, forgetting: float = 1.0, regularization: float = 0.0,
    centred: bool = False,
) -> tuple[StateSpace, Array]:
    """Identify from inputs U (N, r) and outputs Y (N, m) of one record without gaps.

    forgetting: weight of a sample relative to the next one; regularization: ridge on the VARX parameters; fixed: S =
    [I 0], otherwise the leading singular vectors; centred: every regression has an intercept. Returns the model, in the
    basis of its state, and the singular values.
    Raises ModelError when the record is shorter than the window or carries fewer than n states.
    """
    r, m, count = U.shape[1], Y.shape[1], len(U) - p
    if count < n + r + m + 1:
        raise ModelError(f'{len(U)} samples are too few for a past window of {p}', 'give a longer record')
    # row k holds [u; y] of samples k to k + p - 1 (eqs. 24-25), the last one of those after which nothing follows
    windows = sliding_window_view(np.hstack([U, Y]), p, axis=0).transpose(0, 2, 1).reshape(count + 1, -1)
    root = np.sqrt(forgetting) ** np.arange(count - 1, -1, -1.0)[:, None]
    weights = (root / np.linalg.norm(root)) ** 2

    def about(signal: Array) -> Array:
        return signal - np.sum(weights * signal, axis=0) if centred else signal

    z, u, y = about(windows[:-1]), about(U[p:]), about(Y[p:])
    d = z.shape[1]
    stacked = np.vstack([root * z, np.sqrt(regularization) * np.eye(d)])
    target = np.vstack([root * y, np.zeros((d, m))])
    Xi = np.linalg.lstsq(stacked, target, rcond=1e-12)[0].T
    G = observability_controllability(Xi, f, r, weighted)
    left, values, _ = np.linalg.svd(G @ (root * z).T, full_matrices=False)
    if values.size < n or values[n - 1] <= 1e-14 * values[0]:
        raise ModelError(
            f'the record carries fewer than {n} states', 'lower the order or excite the plant more')
    S = np.eye(n, f * m) if fixed else (left[:, :n] / np.sqrt(values[:n])).T
    states = windows @ (S @ G).T
    x, following = about(states[:-1]), about(states[1:])
    C = np.linalg.lstsq(root * x, root * y, rcond=None)[0].T
    e = y - x @ C.T
    known = np.hstack([x, u, e])
    ABK = np.linalg.lstsq(root * known, root * following, rcond=None)[0].T
    return StateSpace(ABK[:, :n], ABK[:, n:n + r], C, np.zeros((m, r)), ABK[:, n + r:], dt), values
