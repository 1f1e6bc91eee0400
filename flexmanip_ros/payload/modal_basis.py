"""From an identified model to the basis of the modal coordinates [eta; eta'], in continuous time (eq. 44)."""

from __future__ import annotations

import numpy as np

from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload.signals import Quantity, signals
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
