"""Natural modes of the arm for a payload, and the modes and modal participation that the identified model has."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from flexmanip_ros.arm.linearization import Blocks, blocks
from flexmanip_ros.identification.uncertainty import REAL, Identified
from flexmanip_ros.parameters import ArmParameters, IdentifierParameters
from flexmanip_ros.payload.structured_model import Quantity, signals
from flexmanip_ros.types import Array


def sensor_matrix(config: IdentifierParameters, kappa: int) -> tuple[Array, tuple[bool, ...]] | None:
    """Return S (m, 2 kappa), the modal coordinates each output sees, and which outputs are rates.

    None when an output is no bend of the arm: a joint angle has a rigid part that the blocks leave out.
    """
    known = signals(config)
    if known is None or not known.torques:
        return None
    S = np.zeros((len(known.outputs), 2 * kappa))
    for row, role in enumerate(known.outputs):
        if role.quantity not in (Quantity.BEND, Quantity.BEND_RATE):
            return None
        modes = np.arange(1, kappa + 1)
        fraction = config.arm.sensor_position[role.link]
        S[row, role.link * kappa:(role.link + 1) * kappa] = np.sin(modes * np.pi * fraction)
    return S, tuple(role.quantity is Quantity.BEND_RATE for role in known.outputs)


def to_modal(Ac: Array, Bc: Array, C: Array, S: Array, rates: tuple[bool, ...]) -> tuple[Array, Array]:
    """Return (Ac, Bc) with the state [eta; eta'] from continuous models in any basis.

    Ac: (..., n, n), Bc: (..., n, r), C: (..., m, n), S: (m, n / 2). A displacement without its rate among the
    outputs is completed by C Ac, in continuous time, where that is known to read the rates (a discrete
    C A is not: it depends on the payload). Raises numpy.linalg.LinAlgError when that fixes no basis.
    """
    h = S.shape[1]
    is_rate = np.array(rates, dtype=bool)
    known = np.zeros((S.shape[0], 2 * h))
    known[~is_rate, :h] = S[~is_rate]
    known[is_rate, h:] = S[is_rate]
    seen = np.broadcast_to(C, (*Ac.shape[:-2], *C.shape[-2:]))
    alone = [row for row in np.flatnonzero(~is_rate)
             if not any(np.allclose(S[row], S[other]) for other in np.flatnonzero(is_rate))]
    if alone:
        derived = np.zeros((len(alone), 2 * h))
        derived[:, h:] = S[alone]
        known = np.vstack([known, derived])
        seen = np.concatenate([seen, C[..., alone, :] @ Ac], axis=-2)
    if np.linalg.matrix_rank(known) < 2 * h:
        raise np.linalg.LinAlgError('the outputs do not see every modal coordinate')
    # eq. (44): seen = known T, so T = known^+ seen takes the identified state to [eta; eta']
    T = np.linalg.pinv(known) @ seen
    Ac_modal = np.swapaxes(np.linalg.solve(np.swapaxes(T, -1, -2), np.swapaxes(T @ Ac, -1, -2)), -1, -2)
    return Ac_modal, T @ Bc


class Parts(NamedTuple):
    """Of the arm's mass matrix still + c turned + m (held + c held_turned) + J rotary, (n, n) each.

    c = cos(theta2 - theta1); m, J: mass and rotary inertia of the payload; n = 2 + 2 kappa; torque: (n, 2);
    stiffness: (2 kappa,); bend: (2, 2 kappa), what the bend sensors see of the modal coordinates.
    """

    still: Array
    turned: Array
    held: Array
    held_turned: Array
    rotary: Array
    torque: Array
    stiffness: Array
    bend: Array


class ArmModes(NamedTuple):
    """Undamped modes with the chords free.

    frequency: (j, 2 kappa) [Hz], rising; drive: (j, 2, 2, 2), how much each bend sensor is accelerated in
    each of the lowest two modes by each torque [m/s^2 per N m].
    """

    frequency: Array
    drive: Array


def arm_modes(arm: ArmParameters, cosine: Array, mass: Array, inertia: Array, stiffness: Array) -> ArmModes:
    """Return the modes; cosine, mass [kg], inertia [kg m^2]: (j,), stiffness: (j, 2 kappa) on nominal.

    Raises numpy.linalg.LinAlgError when a mass matrix is singular.
    """
    parts = _parts(arm)
    c, m, J = (values[:, None, None] for values in (cosine, mass, inertia))
    M = parts.still + c * parts.turned + m * (parts.held + c * parts.held_turned) + J * parts.rotary
    rigid, coupling = M[:, :2, :2], M[:, :2, 2:]
    torque = np.broadcast_to(parts.torque, (len(M), *parts.torque.shape))
    solved = np.linalg.solve(rigid, np.concatenate([coupling, torque[:, :2]], axis=2))
    # chords follow without a force of their own: eqs. (19)-(21)
    bent = np.swapaxes(coupling, 1, 2) @ solved
    h = parts.stiffness.size
    root = np.sqrt(parts.stiffness * stiffness)
    # K is diagonal: eigenvalues of K^-1/2 Mt K^-1/2 are 1 / omega^2
    slowness, U = np.linalg.eigh((M[:, 2:, 2:] - bent[:, :, :h]) / (root[:, :, None] * root[:, None, :]))
    slowness, U = slowness[:, ::-1], U[:, :, ::-1]
    shapes = U / root[:, :, None] / np.sqrt(slowness)[:, None, :]  # of unit modal mass
    lowest = shapes[:, :, :2]
    driven = np.swapaxes(lowest, 1, 2) @ (torque[:, 2:] - bent[:, :, h:])
    drive = (parts.bend @ lowest)[..., None] * driven[:, None]
    return ArmModes(1.0 / np.sqrt(slowness) / (2.0 * np.pi), drive)


@lru_cache(maxsize=8)
def _parts(arm: ArmParameters) -> Parts:
    """Constants of an arm; never written to."""
    folded, straight = np.array([0.0, np.pi / 2]), np.zeros(2)
    still, held = _mass(blocks(arm, folded)), _mass(blocks(arm, folded, 1.0))
    turned, held_turned = _mass(blocks(arm, straight)), _mass(blocks(arm, straight, 1.0))
    rotary = _mass(blocks(replace(arm, tip_inertia=arm.tip_inertia + 1.0), folded)) - still
    nominal = blocks(arm, straight)
    j = np.pi * np.arange(1, arm.modes + 1)
    bend = np.zeros((2, 2 * arm.modes))
    for link, place in enumerate(arm.sensor_position):
        bend[link, link * arm.modes:(link + 1) * arm.modes] = np.sin(j * place)
    return Parts(
        still=still, turned=turned - still, held=held - still,
        held_turned=(held_turned - turned) - (held - still), rotary=rotary,
        torque=np.vstack([nominal.B_theta, nominal.B_eta]), stiffness=np.diag(nominal.Kc).copy(), bend=bend)


def _mass(parts: Blocks) -> Array:
    return np.asarray(np.block([[parts.Ma, parts.Mb], [parts.Mb.T, parts.Mc]]))


def modal_participation(identified: Identified, chosen: Array, rows: Array, rates: Array, weights: Array
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
