"""Mass matrix and momentum of the arm, and its linear vibration model at a working point (paper eqs. 12-23)."""

import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy

from flexmanip_ros.arm.equations_of_motion import assemble, elastic, inertial_forces
from flexmanip_ros.arm.manipulator import (
    Manipulator,
    Workspace,
    manipulator,
    payload_array,
    pinned_frequencies,
    workspace,
)
from flexmanip_ros.errors import ModelError
from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.types import Array

MORE_SINES = 4
"""Sines of each link beyond the shape functions, with which the modes that are left out are computed. Two of them give
the root of the energy of a response to 10 %, six to 2 %."""
INSTANTS = 1000
"""Instants of a step response, within a period of the slowest link: on the default arm 34 in a period of what the model
lacks. An undamped response is followed no longer than that."""
STEP = 1e-4
"""Step of the coordinates [rad, m] from which the stiffness by gravity follows, to 1e-8 of it."""
SAGS, SETTLED = 10, 1e-6
"""Most Newton steps to the equilibrium of a clamped arm under gravity, and the step [rad, m] that is the last. A sag of
3 % of the length takes four. An arm that sags by its length has no equilibrium that this model describes."""


def mass_matrix(arm: Manipulator, payload: Array, q: Array) -> Array:
    """Return M(q), (n, n); the translation of a floating base is eliminated by conservation of momentum."""
    work, q = workspace(arm), np.asarray(q, float)
    inertial_forces(arm, payload, q, np.zeros_like(q), work)
    lower = np.tril(work.M)
    return lower + np.tril(lower, -1).T


def gravity_forces(arm: Manipulator, payload: Array, q: Array) -> Array:
    """Return the generalized forces (n,) that hold q against gravity; zero where the base floats."""
    return _assembled(arm, payload, q).E


def momentum(arm: Manipulator, payload: Array, q: Array) -> tuple[Array, float]:
    """Return P (2, n), P q' the linear momentum where the base does not translate, and the total mass [kg]."""
    work = _assembled(arm, payload, q)
    return work.P, float(work.F[2])


def _assembled(arm: Manipulator, payload: Array, q: Array) -> Workspace:
    work, q = workspace(arm), np.asarray(q, float)
    assemble(arm, payload, q, np.zeros_like(q), work.M, work.E, work)
    return work


def first_order(M: Array, K: Array, D: Array, B: Array) -> tuple[Array, Array]:
    """Return (A (2n, 2n), B (2n, r)) of x = [q; q'] with M q'' + D q' + K q = B u."""
    n, r = B.shape
    rows = scipy.linalg.cho_solve(scipy.linalg.cho_factor(M), np.hstack([-K, -D, B]))
    A = np.block([[np.zeros((n, n)), np.eye(n)], [rows[:, :2 * n]]])
    return A, np.vstack([np.zeros((n, r)), rows[:, 2 * n:]])


class Blocks(NamedTuple):
    """Mass, stiffness, damping and input matrices with q = [theta; eta], k modes a link (paper eqs. 12-14).

    Ma: (L, L), Mb: (L, L k), Mc, Kc, Dc: (L k, L k), B_theta: (L, L), B_eta: (L k, L), in SI units.
    """

    Ma: Array
    Mb: Array
    Mc: Array
    Kc: Array
    Dc: Array
    B_theta: Array
    B_eta: Array


def blocks(arm: ArmParameters, theta: Array, payload: float | Array = 0.0, kappa: int | None = None) -> Blocks:
    """Return the block matrices at chord angles theta (L,) [rad], eta = 0.

    payload: a point mass [kg], or the inertial parameters (4,) of a body. The shape functions are the arm's
    own, or kappa sines a link. A floating base counts as fixed; ``floating_blocks`` lets it float.
    Raises ModelError when theta or the payload is not finite or kappa is below 1.
    """
    return floating_blocks(replace(arm, base_mass=0.0) if arm.base_mass else arm, theta, payload, kappa)


def floating_blocks(arm: ArmParameters, theta: Array, payload: float | Array = 0.0, kappa: int | None = None) -> Blocks:
    """Return the matrices of ``blocks`` with a floating base, where the arm has one; theta is relative to the base.

    The angle phi of the base is cyclic: no stiffness acts on it, and with chord angles theta + phi it turns the whole
    arm. Its equation is solved for phi'' and substituted into the others. The result is as exact as they are while the
    whole turns slowly.
    """
    theta, payload = _checked(arm, theta, payload)
    own = manipulator(arm, kappa)
    L, n = len(theta), len(theta) * (1 + own.kappa)
    M, B = mass_matrix(own, payload, np.append(theta, np.zeros(own.stiffness.size - L))), own.torque
    if own.floating:
        turn = np.eye(n + 1)
        turn[:L, n] = 1.0
        M, B = turn.T @ M @ turn, turn.T @ B
        share = M[:n, n] / M[n, n]
        M, B = M[:n, :n] - np.outer(share, M[n, :n]), B[:n] - np.outer(share, B[n])
    return Blocks(M[:L, :L], M[:L, L:], M[L:, L:], np.diag(own.stiffness[L:n]), np.diag(own.damping[L:n]), B[:L], B[L:])


def vibration_model(
    arm: ArmParameters, theta: Array, payload: float | Array = 0.0, kappa: int | None = None,
) -> tuple[Array, Array]:
    """Return (Ac (2 L k, 2 L k), Bc (2 L k, L)) of x = [eta; eta'], damped, chords and base free (paper eqs. 19-21)."""
    b = floating_blocks(arm, theta, payload, kappa)
    h = len(b.Mc)
    solved = scipy.linalg.cho_solve(scipy.linalg.cho_factor(b.Ma), np.hstack([b.Mb, b.B_theta]))
    return first_order(b.Mc - b.Mb.T @ solved[:, :h], b.Kc, b.Dc, b.B_eta - b.Mb.T @ solved[:, h:])


def bending_frequencies(
    arm: ArmParameters, theta: Array, payload: float | Array = 0.0, *, locked: bool = False,
) -> Array:
    """Damped frequencies [Hz] of the arm's bending modes, rising, at chord angles theta (L,) [rad].

    As ``vibration_model``, with the joints' viscous friction and with the stiffness by gravity, where constant torques
    hold the arm. Swings of the whole arm under gravity are left out: bending holds less than half of their energy.
    locked: the joints keep their angles at theta without bending, and the arm sags under gravity; else it does not.
    Empty where such an arm finds no equilibrium.
    """
    b, own = floating_blocks(arm, theta, payload), manipulator(arm)
    L, n = len(theta), len(theta) + len(b.Mc)
    M, K, D = np.block([[b.Ma, b.Mb], [b.Mb.T, b.Mc]]), *np.zeros((2, n, n))
    K[L:, L:], D[L:, L:], K_bending = b.Kc, b.Dc, np.append(np.zeros(L), np.diag(b.Kc))
    torque = np.vstack([b.B_theta, b.B_eta])
    D += (torque * own.viscous) @ torque.T
    free = scipy.linalg.null_space(own.output[:L, :n]) if locked else np.eye(n)
    if any(arm.gravity):
        q, body, work = np.append(theta, np.zeros(n - L)), _checked(arm, theta, payload)[1], workspace(own)

        def force(q: Array) -> Array:
            elastic(own, q, work)
            return gravity_forces(own, body, q) + work.elastic

        def stiffness(q: Array) -> Array:
            return np.column_stack([force(q + step) - force(q - step) for step in STEP * np.eye(n)]) / (2.0 * STEP)

        sag, steps = np.full(n, np.inf if locked else 0.0), 0
        while np.abs(sag).max() > SETTLED:
            if steps == SAGS:
                return np.zeros(0)
            sag, steps = free @ np.linalg.solve(free.T @ stiffness(q) @ free, free.T @ force(q)), steps + 1
            q = q - sag
        M, K = mass_matrix(own, body, q), stiffness(q)
    M, K, D = (free.T @ part @ free for part in (M, K, D))
    poles, vectors = np.linalg.eig(first_order(M, K, D, np.zeros((len(M), 0)))[0])
    x = vectors[:len(M)]
    kinetic = np.abs(poles) ** 2 * np.sum(x.conj() * (M @ x), axis=0).real
    bends = (K_bending @ np.abs(free @ x) ** 2 > 0.5 * kinetic) | locked
    return np.sort(poles.imag[bends & (poles.imag > 0)]) / (2 * np.pi)


def discretize(Ac: Array, Bc: Array, dt: float) -> tuple[Array, Array]:
    """Exact step of dt seconds with the input held: exp([[Ac, Bc], [0, 0]] dt) gives (A, B)."""
    n, r = Bc.shape
    if not (np.isfinite(dt) and dt > 0):
        raise ModelError(f'the sample time is {dt}', 'give a positive number of seconds')
    stacked = np.zeros((n + r, n + r))
    stacked[:n, :n], stacked[:n, n:] = Ac, Bc
    step = scipy.linalg.expm(stacked * dt)
    return step[:n, :n], step[:n, n:]


class OmittedModes(NamedTuple):
    """Response to a step of 1 N m of each torque of the modes that the shape functions leave out."""

    variance: Array
    """(2, 2 L, L) V at the step: of deflections (joint angles, bends) [rad^2 or m^2], then of their rates."""
    duration: float
    """Time constant T of its exponential decay [s]."""
    frequency: float
    """Angular frequency w [rad/s]."""


def omitted_modes(arm: ArmParameters, theta: Array) -> OmittedModes:
    """Return what modal truncation adds to the outputs after a step of a torque, at chord angles theta (L,) [rad].

    A torque step excites all modes of the arm. With ``MORE_SINES`` the response of output i to torque j differs by
    e_ij(t). A vibration with angular frequency w and variance V_ij exp(-t / T) has the same energy, mean instant and
    mean square rate: V_ij = int e_ij^2 dt / T; T and w^2 are the means over the outputs of int t e^2 dt / int e^2 dt
    and int e'^2 dt / int e^2 dt. V is zero with sines alone: that is the arm of the paper, which has no other modes.
    Raises ModelError when theta is not finite.
    """
    L = len(arm.link_length)
    if arm.shape_functions != 'component_modes':
        return OmittedModes(np.zeros((2, 2 * L, L)), 1.0, 0.0)
    dt = 1.0 / (INSTANTS * min(pinned_frequencies(arm)))
    finer = copy.copy(arm)
    object.__setattr__(finer, 'modes', arm.modes + MORE_SINES)  # also beyond the largest number that may be given
    square = (step_response(finer, theta, dt) - step_response(arm, theta, dt)) ** 2
    energy, instants = square.sum(axis=0) * dt, dt * np.arange(1, INSTANTS + 1)
    by_output = energy.sum(axis=2)
    duration = float(np.mean(dt * (instants @ square[:, 0].sum(axis=2)) / by_output[0]))
    return OmittedModes(energy / duration, duration, float(np.sqrt(np.mean(by_output[1] / by_output[0]))))


def step_response(arm: ArmParameters, theta: Array, dt: float) -> Array:
    """Return the outputs and their rates (INSTANTS, 2, 2 L, L) every dt [s] after a step of 1 N m of each torque."""
    b = floating_blocks(arm, theta)
    L, n = len(theta), len(theta) + len(b.Mc)
    K, D = np.zeros((2, n, n))
    K[L:, L:], D[L:, L:] = b.Kc, b.Dc
    A, B = discretize(*first_order(np.block([[b.Ma, b.Mb], [b.Mb.T, b.Mc]]), K, D, np.vstack([b.B_theta, b.B_eta])), dt)
    output = manipulator(arm).output[:, :n]
    x = np.empty((INSTANTS, *B.shape))
    x[0], known = B, 1
    while known < INSTANTS:  # from k to k + m samples after the step: x(k + m) = A^m x(k) + x(m)
        more = min(known, INSTANTS - known)
        x[known:known + more] = A @ x[:more] + x[known - 1]
        A, known = A @ A, known + more
    return np.stack([output @ x[:, :n], output @ x[:, n:]], axis=1)


def frequencies(Ac: Array) -> Array:
    """Damped frequencies [Hz] of a continuous model, rising, one for each oscillating pair."""
    poles = np.linalg.eigvals(Ac)
    return np.sort(poles.imag[poles.imag > 0]) / (2 * np.pi)


def _checked(arm: ArmParameters, theta: Array, payload: float | Array) -> tuple[Array, Array]:
    theta, links = np.asarray(theta, dtype=np.float64), len(arm.link_length)
    if theta.shape != (links,) or not np.all(np.isfinite(theta)):
        raise ModelError(f'the chord angles are {theta!r}', f'give {links} finite angles in rad')
    body = payload_array(float(payload)) if np.ndim(payload) == 0 else np.asarray(payload, dtype=np.float64)
    if body.shape != (4,) or not np.all(np.isfinite(body)) or body[0] < 0:
        raise ModelError(f'the payload is {payload}', 'give a mass of zero or more in kg, or the four parameters of a '
                         'body')
    return theta, body
