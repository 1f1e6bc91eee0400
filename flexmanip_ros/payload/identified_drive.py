"""How strongly the torques drive chosen modes of an identified model, with standard deviations."""

from __future__ import annotations

import numpy as np

from flexmanip_ros.identification.modes import REAL
from flexmanip_ros.identification.uncertainty import Identified
from flexmanip_ros.types import Array


def drive(identified: Identified, chosen: Array, rows: Array, rates: Array, weights: Array
          ) -> tuple[Array, Array]:
    """Return a sum over modes and outputs of (what an output sees of a mode) x (what an input does to it).

    chosen: indices into ``modal.modes``; rows: (k,) outputs, displacements or (rates: (k,) bool)
    their rates; weights: (k, r) of the outputs in the sum of each input. Returns sums (r,) and standard
    deviations (r,), to first order and without the share of the pole's own frequency.

    A mode of unit mass, seen with c and driven with b, has the residue c b / (2 j omega) at its pole in a
    displacement, c b / 2 in a rate. Raises numpy.linalg.LinAlgError when the poles are not distinct.
    """
    model = identified.model
    n, r, m = model.order, model.B.shape[1], model.C.shape[0]
    poles, V = np.linalg.eig(model.A)
    W = np.linalg.inv(V)
    order = np.flatnonzero((poles.imag > 0.0) & (np.angle(poles) >= REAL))
    picked = order[np.argsort(np.angle(poles[order]))][chosen]
    s = np.log(poles[picked]) / model.dt
    # a torque that is held drives a pole by (exp(s dt) - 1) / s
    factor = np.where(rates[:, None], 2.0, 2.0j * np.abs(s)) * s / (poles[picked] - 1.0)
    C, B = model.C[rows] @ V, W @ model.B  # what each pole shows, and how it is driven
    gap = poles[:, None] - poles[picked]
    gap[picked, np.arange(picked.size)] = np.inf
    seen = weights.T @ (factor * C[:, picked])  # (r, picked)
    value = np.array([(seen[i] @ B[picked, i]).real for i in range(r)])
    gradient = np.zeros((r, n * (n + r + m)))
    for i in range(r):
        scaled = weights[:, i, None] * factor  # (k, picked)
        # along dA the vectors of a pole turn towards those of the others, by 1 / gap
        G = np.zeros((n, n), dtype=complex)
        G[:, picked] = (C.T @ scaled) / -gap * B[picked, i]
        G[picked] += (B[:, i, None] / -gap * seen[i]).T
        parts = gradient[i]
        parts[:n * n] = (W.T @ G @ V.T).real.ravel()
        parts[n * n:n * (n + r)].reshape(n, r)[:, i] = (seen[i] @ W[picked]).real
        parts[n * (n + r):].reshape(m, n)[rows] = (scaled * B[picked, i] @ V[:, picked].T).real
    return value, np.asarray(np.linalg.norm(gradient @ identified.spread[:gradient.shape[1]], axis=1))
