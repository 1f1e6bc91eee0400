"""Frequencies and damping ratios of a model, with standard deviations (paper eq. 43)."""

from __future__ import annotations

import numpy as np

from flexmanip_ros.identification.uncertainty import Identified
from flexmanip_ros.types import Array, Mode

REAL = 1e-9
"""A pole whose angle [rad per sample] is below this does not oscillate."""


def poles(A: Array) -> tuple[Array, Array, Array]:
    """Eigenvalues (n,), right (n, n) and left (n, n) eigenvectors with left' right = I."""
    values, right = np.linalg.eig(A)
    return values, right, np.linalg.inv(right).conj().T


def modes(identified: Identified) -> tuple[Mode, ...]:
    """Oscillations of the identified model, rising frequency; deviations to first order (nan: unknown)."""
    A, dt = identified.model.A, identified.model.dt
    n = A.shape[0]
    values, right = np.linalg.eig(A)
    found = []
    spread = identified.spread[:n * n]
    for index in np.flatnonzero(values.imag > 0.0):
        pole = values[index]
        if abs(np.angle(pole)) < REAL or abs(pole) == 0.0:
            continue
        s = np.log(pole) / dt
        left = np.linalg.solve(right.T, np.eye(n)[index])
        sensitivity = np.outer(left, right[:, index]).ravel()
        change = sensitivity @ spread / (pole * dt)
        frequency = s.imag / (2.0 * np.pi)
        damping = -s.real / abs(s)
        dampings = -(change.real * s.imag - change.imag * s.real) * s.imag / abs(s) ** 3
        std = float(np.linalg.norm(change.imag)) / (2.0 * np.pi) if spread.size else float('nan')
        damping_std = float(np.linalg.norm(dampings)) if spread.size else float('nan')
        found.append(Mode(float(frequency), float(damping), std, damping_std))
    return tuple(sorted(found))
