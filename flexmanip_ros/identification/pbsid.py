"""Batch predictor-based subspace identification: the reference for the recursion.

It works on the data matrices (paper eqs. 22-37 with all samples at once) and shares no arithmetic with the factor of
``moments.py``: the states are computed sample by sample, and the matrices are regressed on them.
"""

from __future__ import annotations

import numpy as np

from flexmanip_ros.errors import ModelError
from flexmanip_ros.identification.varx import observability_controllability, past_windows
from flexmanip_ros.types import Array, StateSpace


def pbsid(
    U: Array, Y: Array, *, n: int, p: int, f: int, dt: float,
    weighted: bool = True, fixed: bool = False, forgetting: float = 1.0, regularization: float = 0.0,
) -> tuple[StateSpace, Array]:
    """Identify from inputs U (N, r) and outputs Y (N, m) of one record without gaps.

    forgetting: weight of a sample relative to the next one; regularization: ridge on the VARX parameters; fixed: S =
    [I 0], otherwise the leading singular vectors. Returns the model, in the basis of its state, and the singular
    values.
    Raises ModelError when the record is shorter than the window or carries fewer than n states.
    """
    r, m = U.shape[1], Y.shape[1]
    windows = past_windows(U, Y, p)
    z = windows[:-1]
    count = z.shape[0]
    if count < n + r + m + 1:
        raise ModelError(f'{U.shape[0]} samples are too few for a past window of {p}', 'give a longer record')
    root = np.sqrt(forgetting) ** np.arange(count - 1, -1, -1.0)[:, None]
    u, y = U[p:], Y[p:]
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
    following = windows @ (S @ G).T
    x = following[:-1]
    C = np.linalg.lstsq(root * x, root * y, rcond=None)[0].T
    e = y - x @ C.T
    known = np.hstack([x, u, e])
    ABK = np.linalg.lstsq(root * known, root * following[1:], rcond=None)[0].T
    return StateSpace(ABK[:, :n], ABK[:, n:n + r], C, np.zeros((m, r)), ABK[:, n + r:], dt), values
