"""What the modes beyond kappa add to the outputs, quasi-statically.

A moment at a root makes curvature there, which a few sines lack: the slope phi_j'(0) eta_j falls only
with 1 / j^2. The modes left out follow their loads without inertia of their own, eta_j = Q_j / K_j, so
their sum over j > kappa is a constant flexibility times the loads: moments at the ends of each link
(joint torques less what hubs and bodies take for their own turning) and the inertial load of the chords'
accelerations, rho (x theta_i'' + n_i . P_i''), P_i the root of link i.
"""

from __future__ import annotations

import numpy as np

from flexmanip_ros.parameters.arm import ArmParameters
from flexmanip_ros.plant import linearization
from flexmanip_ros.plant.output_kernel import Slopes
from flexmanip_ros.types import Array

TERMS = 4000
"""Modes summed; the slowest sums go on with 1 / j^2 and are closed by their known total."""


def slopes(arm: ArmParameters, kappa: int) -> Slopes:
    """Precompute the correction of an arm with kappa modes; inactive when switched off."""
    return Slopes(
        active=arm.slope_correction, flexibility=flexibility(arm, kappa),
        moments=_moments(arm), hubs=np.array([
            arm.hub_inertia[0], arm.joint_inertia, arm.hub_inertia[1], arm.tip_inertia]))


def flexibility(arm: ArmParameters, kappa: int) -> Array:
    """Outputs (4) by loads (7), summed over the modes beyond kappa.

    Outputs joint1, joint2 [rad], link1_bend, link2_bend [m]; loads: moments [N m] at root and tip of
    link 1, root and tip of link 2, then -theta1'', -theta2'' [rad/s^2] and -n2 . P'' [m/s^2].
    """
    L, EI = np.array(arm.link_length), np.array(arm.bending_stiffness)
    root, tip = (f(arm, TERMS) for f in (linearization.root_slopes, linearization.tip_slopes))
    stiffness = linearization.stiffness(arm, TERMS).reshape(2, TERMS)
    j = np.arange(1, TERMS + 1)
    bend = np.sin(np.pi * j * np.array(arm.sensor_position)[:, None])
    mass = np.array(arm.linear_density) * L
    rigid = -(mass * L)[:, None] * np.where(j % 2, -1.0, 1.0) / (j * np.pi)
    mean = mass[:, None] * (1 - np.where(j % 2, -1.0, 1.0)) / (j * np.pi)
    ends = np.stack([root, tip])
    # shape (output: root slope, tip slope, bend; load: root moment, tip moment, turning, base; link)
    left = slice(kappa, None)
    F = np.zeros((3, 4, 2))
    for o, out in enumerate((root, tip, bend)):
        for i, load in enumerate((root, tip, rigid, mean)):
            F[o, i] = np.sum((out * load / stiffness)[:, left], axis=1)
    # slopes under end moments: the static beam less the modes kept (3 EI / L and 6 EI / L)
    total = np.array([[1 / 3, -1 / 6], [-1 / 6, 1 / 3]])
    kept = np.einsum('oij,lij,ij->oli', ends[:, :, :kappa], ends[:, :, :kappa], 1 / stiffness[:, :kappa])
    F[:2, :2] = total[:, :, None] * (L / EI) - kept
    R = np.zeros((4, 7))
    for output, rows in ((0, F[0]), (2, F[2])):
        R[output, [0, 1, 4]] = rows[[0, 1, 2], 0]
    for output, rows in ((1, F[0]), (3, F[2])):
        R[output, [2, 3, 5, 6]] = rows[:, 1]
    R[1, [0, 1, 4]] = -F[1, [0, 1, 2], 0]
    if arm.angle_convention == 'chord':
        R[:2] = 0.0
    return R


def _moments(arm: ArmParameters) -> Array:
    """End moments (root 1, tip 1, root 2, tip 2) by the two joint torques, (4, 2)."""
    if arm.torque_convention == 'paper':
        return np.zeros((4, 2))
    return np.array([[1.0, 0.0], [0.0, -1.0], [0.0, 1.0], [0.0, 0.0]])
