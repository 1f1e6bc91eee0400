"""From VARX parameters to observability x controllability (paper eqs. 26-35).

A regressor z stacks the past window as blocks [u; y], oldest first; Xi is (m, p (r + m)).
"""

from __future__ import annotations

import numpy as np

from flexmanip_ros.identification.varx_kernel import open_loop, predictions
from flexmanip_ros.types import Array


def shifted(Xi: Array, block: int, width: int) -> Array:
    """Xi acting on the window that starts ``block`` samples later, zero where the past is not known yet.

    Xi: (m, p width) -> (m, p width); eqs. (33)-(34), one block row.
    """
    if block == 0:
        return Xi
    moved = np.zeros_like(Xi)
    moved[:, block * width:] = Xi[:, :-block * width]
    return moved


def observability_controllability(Xi: Array, f: int, r: int, weighted: bool) -> Array:
    """(f m, p (r + m)): predictions of the next f outputs for inputs (and innovations) at rest.

    weighted False: outputs that have not come yet count as zero (observability of the predictor, A - K C);
    True: they are replaced by their own predictions (observability of the system, A).
    """
    G = np.empty((f * Xi.shape[0], Xi.shape[1]))
    predictions(np.ascontiguousarray(Xi), f, r, weighted, G)
    return G


def open_loop_weight(Xi: Array, f: int, r: int) -> Array:
    """(f m, f m) lower triangular L with observability of the system = L x observability of the predictor."""
    L = np.eye(f * Xi.shape[0])
    open_loop(np.ascontiguousarray(Xi), f, r, L)
    return L
