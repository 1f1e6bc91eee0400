"""Changes of basis and of time: similarity, balancing, discrete to continuous (paper section 3.2)."""

from dataclasses import replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from flexmanip_ros.errors import ModelError
from flexmanip_ros.identification.moments import triangle
from flexmanip_ros.types import Array, StateSpace

WORST_BASIS = 1e10
"""Largest condition number (after scaling) of a transformation that is used."""


def transform(model: StateSpace, W: Array) -> StateSpace:
    """The same system with the state W x. W: (n, n), invertible (eq. 44)."""
    back = np.asarray(np.linalg.solve(W.T, np.vstack([W @ model.A, model.C]).T).T, dtype=np.float64)
    n = model.order
    return StateSpace(back[:n], W @ model.B, back[n:], model.D, W @ model.K, model.dt)


def to_continuous(A: Array, B: Array, dt: float) -> tuple[Array, Array]:
    """Ac (n, n) [1/s] and Bc (n, r) whose response to inputs held over dt [s] is (A, B).

    Ac comes from the eigenvectors of A, and Bc from B = Ac^-1 (A - I) Bc. Where these are ill conditioned, both come
    from the matrix logarithm of [[A, B], [0, I]], which does not always give the same bits twice. Raises ModelError
    where no real logarithm exists (a pole at zero or on the negative real axis).
    """
    n, r = B.shape
    if not np.all(np.isfinite(A)) or _outside_log(np.linalg.eigvals(A)):
        raise ModelError(
            'the model has a pole that no continuous system has', 'lower the order or the sample time')
    Ac, held = continuous_state_matrix(A, dt), A - np.eye(n)
    if Ac is not None and np.linalg.cond(held) < WORST_BASIS:
        return Ac, np.asarray(np.linalg.solve(held, Ac @ B), dtype=np.float64)
    joint = np.zeros((n + r, n + r))
    joint[:n, :n], joint[:n, n:], joint[n:, n:] = A, B, np.eye(r)
    log = np.real(scipy.linalg.logm(joint)) / dt
    return log[:n, :n], log[:n, n:]


def _outside_log(poles: NDArray[Any]) -> bool:
    """Whether a pole has no real logarithm: at zero, to the digits of a pole at 1, or on the negative real axis."""
    negative = (np.abs(poles.imag) < 1e-12 * np.abs(poles)) & (poles.real <= 0.0)
    return bool(np.any(negative | (np.abs(poles) < 1e-12)))


def to_discrete(Ac: Array, Bc: Array, dt: float) -> tuple[Array, Array]:
    """A (n, n), B (n, r) of (Ac, Bc) with inputs held over dt [s]."""
    n, r = Bc.shape
    joint = np.zeros((n + r, n + r))
    joint[:n, :n], joint[:n, n:] = Ac, Bc
    power = scipy.linalg.expm(joint * dt)
    return power[:n, :n], power[:n, n:]


def continuous_state_matrix(A: Array, dt: float) -> Array | None:
    """log(A) / dt by eigenvectors, fast; None where it is not real or the eigenvectors are unusable."""
    poles, vectors = np.linalg.eig(A)
    if _outside_log(poles) or np.linalg.cond(vectors) > WORST_BASIS:
        return None
    return np.asarray(np.real(np.linalg.solve(vectors.T, (vectors * np.log(poles)).T).T) / dt)


def stabilized(A: Array) -> Array:
    """A (n, n) with every pole outside the unit circle moved onto it along its radius."""
    values, vectors = np.linalg.eig(A)
    radius = np.abs(values)
    if np.all(radius <= 1.0):
        return A
    if np.linalg.cond(vectors) > WORST_BASIS:
        return np.asarray(A / radius.max(), dtype=np.float64)
    inside = values / np.maximum(radius, 1.0) * (1.0 - 1e-12)
    return np.asarray(np.real(np.linalg.solve(vectors.T, (vectors * inside).T).T), dtype=np.float64)


def lightly_damped(A: Array, most: float) -> Array:
    """A (n, n) with the damping ratio of every oscillation limited to ``most``; its angle per sample is kept.

    A itself where no damping ratio exceeds ``most``.
    """
    values, vectors = np.linalg.eig(A)
    angle = np.abs(np.angle(values))
    slow = np.exp(-most / np.sqrt(1.0 - most ** 2) * angle)
    radius = np.abs(values)
    damped = (angle > 1e-9) & (angle < np.pi - 1e-9) & (radius < slow)
    if not damped.any() or np.linalg.cond(vectors) > WORST_BASIS:
        return A
    moved = values * np.where(damped, slow / np.where(radius > 0.0, radius, 1.0), 1.0)
    return np.asarray(np.real(np.linalg.solve(vectors.T, (vectors * moved).T).T), dtype=np.float64)


def slowest(model: StateSpace, count: int, most: float) -> StateSpace | None:
    """Return a model of the ``count`` slowest oscillations with a damping ratio up to ``most``; None if not so many.

    Each oscillation has two states, the real and the imaginary part of its modal coordinate. The other modes are left
    out.
    """
    values, right = np.linalg.eig(model.A)
    if np.linalg.cond(right) > WORST_BASIS:
        return None
    logs = np.log(np.where(values == 0.0, 1e-300, values + 0j))
    light = [k for k in np.argsort(logs.imag) if logs[k].imag > 1e-9 and -logs[k].real <= most * abs(logs[k])][:count]
    if len(light) < count:
        return None
    left = np.linalg.inv(right)[light]
    shapes = 2.0 * (model.C @ right[:, light])
    A = np.zeros((2 * count, 2 * count))
    for i, pole in enumerate(values[light]):
        A[2 * i:2 * i + 2, 2 * i:2 * i + 2] = [[pole.real, -pole.imag], [pole.imag, pole.real]]
    B, K = (np.stack([(left @ X).real, (left @ X).imag], axis=1).reshape(2 * count, -1) for X in (model.B, model.K))
    C = np.stack([shapes.real, -shapes.imag], axis=2).reshape(len(shapes), -1)
    return replace(model, A=A, B=B, C=C, K=K)


def known_output_basis(model: StateSpace) -> Array | None:
    """W (n, n) that transforms the model to the basis in which C is known, or None.

    With as many outputs as states: x = y, W = C. With half as many (displacements only): x = [y; dy/dt], W = [C; C Ac],
    where Ac = log(A) / dt is computed first (docs/identification.md).
    """
    m, n = model.C.shape
    if m == n:
        W = model.C
    elif 2 * m == n:
        Ac = continuous_state_matrix(model.A, model.dt)
        if Ac is None:
            return None
        W = np.vstack([model.C, model.C @ Ac])
    else:
        return None
    size = np.linalg.norm(W, axis=1)
    if not np.all(size > 0.0) or np.linalg.cond(W / size[:, None]) > WORST_BASIS:
        return None
    return W


def balancing(model: StateSpace) -> Array:
    """W (n, n) that makes the observability and controllability Gramians over 10 n steps equal and diagonal.

    With a finite horizon they also exist for marginal and unstable models. The sign of each state makes its first
    sizeable entry of C positive, so the basis changes smoothly with the model.
    """
    n = model.order
    inputs = np.hstack([model.B, model.K]) if np.linalg.norm(model.B) > 0 else model.K
    reach, seen = [inputs], [model.C]
    for _ in range(10 * n - 1):
        reach.append(model.A @ reach[-1])
        seen.append(seen[-1] @ model.A)
    Lc = triangle(np.hstack(reach).T).T
    Lo = triangle(np.vstack(seen)).T
    left, values, _ = np.linalg.svd(Lo.T @ Lc)
    if values[-1] <= 1e-13 * values[0]:
        return np.eye(n)
    W = (left / np.sqrt(values)).T @ Lo.T
    C = np.linalg.solve(W.T, model.C.T).T
    first = np.argmax(np.abs(C) > 0.1 * np.abs(C).max(axis=0), axis=0)
    sign = np.where(C[first, np.arange(n)] < 0.0, -1.0, 1.0)
    return np.asarray(sign[:, None] * W)


def markov(model: StateSpace, count: int) -> Array:
    """(count, m, r): impulse response D, C B, C A B, ..."""
    out = np.empty((count, *model.D.shape))
    out[0], state = model.D, model.B
    for k in range(1, count):
        out[k] = model.C @ state
        state = model.A @ state
    return out


def suggested_order(singular_values: Array) -> int:
    """Return the order after which the singular values fall most steeply (0: unknown)."""
    values = singular_values[singular_values > 1e-12 * max(singular_values, default=0.0)]
    if values.size < 2:
        return int(values.size)
    return int(np.argmax(values[:-1] / values[1:])) + 1
