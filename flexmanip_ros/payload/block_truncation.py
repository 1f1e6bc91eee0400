"""What the block extraction reads too much because the arm has more modes than the identified model.

A model of order 4 kappa shows the lowest 2 kappa vibrations of the arm as its sensors see them. The
extraction takes them for those of an arm that has no others: exact for an arm of kappa modes, below a per
cent off for one of more, and tens of per cent where the torques bend the links as well.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flexmanip_ros.arm.linearization import vibration_model
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload.modal_basis import sensor_matrix
from flexmanip_ros.types import Array

STEPS = 3
"""Of the search for the payload that would be read as the one that was."""


def truncated(config: IdentifierParameters, theta: Array, payload: float, kappa: int
              ) -> tuple[Array, Array] | None:
    """Return (Ac, Bc) of the lowest 2 kappa vibrations of the undamped arm, as if it had kappa modes.

    theta: (2,) chord angles; payload [kg]. None where the outputs do not see the modes.
    """
    few, all_modes = sensor_matrix(config, kappa), sensor_matrix(config, config.arm.modes)
    if few is None or all_modes is None:
        return None
    Ac, Bc = vibration_model(replace(config.arm, damping_ratio=0.0), theta, payload, config.arm.modes)
    h = Ac.shape[0] // 2
    squares, shapes = np.linalg.eig(-Ac[h:, :h])
    lowest = np.argsort(squares.real)[:2 * kappa]
    shapes = shapes.real
    pushed = np.linalg.solve(shapes, Bc[h:])[lowest]
    # the same displacements at the sensors, in the coordinates of kappa modes
    P = np.linalg.lstsq(few[0], all_modes[0] @ shapes[:, lowest], rcond=None)[0]
    n = 2 * kappa
    A, B = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, Bc.shape[1]))
    A[:n, n:] = np.eye(n)
    A[n:, :n] = -np.linalg.solve(P.T, (P * squares.real[lowest]).T).T
    B[n:] = P @ pushed
    return A, B
