"""Starting points of a prediction-error fit: the subspace model, and one from means over a stretch."""

from __future__ import annotations

import numpy as np

from flexmanip_ros.errors import ModelError
from flexmanip_ros.identification.pbsid import pbsid
from flexmanip_ros.identification.prediction_error import Structure, Theta
from flexmanip_ros.identification.realization import to_continuous, to_discrete
from flexmanip_ros.types import Array, StateSpace

ROWS, PAST, RIDGE = 128, 8, 1e-3
"""Means over the stretch, their past window, and the ridge on them, of a start for slow modes."""


def candidate(model: StateSpace, feedthrough: bool) -> tuple[Theta, Structure]:
    """Starting point from a model of scaled signals, C held when it can fix the basis."""
    n, m = model.A.shape[0], model.C.shape[0]
    theta = Theta(model.A, model.B, model.C, model.D, model.K, np.zeros(n))
    if n == m and np.linalg.cond(model.C) < 1e6:
        W = model.C
        A = np.asarray(np.linalg.solve(W.T, (W @ model.A).T).T, dtype=np.float64)
        theta = Theta(A, W @ model.B, np.eye(n), model.D, W @ model.K, np.zeros(n))
        return _dense(theta), Structure(False, feedthrough, False)
    return _dense(theta), Structure(True, feedthrough, False)


def averaged(U: Array, Y: Array, n: int) -> StateSpace | None:
    """Model of order n from the means over many samples (N, r), (N, m): a short past that reaches far back.

    Its own past is as many samples as the window of the recursion, and yet sees whole periods of slow modes.
    """
    every = len(U) // ROWS
    if every < 2:
        return None
    u, y = (X[:every * ROWS].reshape(ROWS, every, -1).mean(axis=1) for X in (U, Y))
    try:
        model, _ = pbsid(u, y, n=n, p=PAST, f=PAST, dt=float(every), regularization=RIDGE)
        A, B = to_discrete(*to_continuous(model.A, model.B, float(every)), 1.0)
    except (ModelError, np.linalg.LinAlgError):
        return None
    found = StateSpace(A, B, model.C, np.zeros_like(model.D), np.zeros((n, Y.shape[1])), 1.0)
    return found if all(np.all(np.isfinite(part)) for part in (A, B, model.C)) else None


def _dense(theta: Theta) -> Theta:
    return Theta(*(np.ascontiguousarray(part) for part in theta))
