"""Modes of the arm that the structured estimator has learned, for many configurations at once."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from flexmanip_ros.arm.linearization import Blocks, blocks
from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.types import Array


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
