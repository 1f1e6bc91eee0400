"""What the modes beyond kappa add to the outputs, quasi-statically.

A moment at a root makes curvature there, which a few sines lack: the slope phi_j'(0) eta_j falls only
with 1 / j^2. The modes left out follow their loads without inertia of their own, eta_j = Q_j / K_j, so
their sum over j > kappa is a constant flexibility times the loads: moments at the ends of each link
(joint torques less what hubs and bodies take for their own turning) and the inertial load of the chords'
accelerations, rho (x theta_i'' + n_i . P_i''), P_i the root of link i.
"""

from __future__ import annotations

import numpy as np

from flexmanip_ros.arm import linearization
from flexmanip_ros.arm.outputs import Slopes
from flexmanip_ros.arm.shape_functions import output_matrix
from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.types import Array

TERMS = 4000
"""Modes summed; the slowest sums go on with 1 / j^2 and are closed by their known total."""


def slopes(arm: ArmParameters, kappa: int) -> Slopes:
    """Precompute the correction of an arm with kappa modes; inactive when switched off."""
    return Slopes(
        active=arm.slope_correction, flexibility=flexibility(arm, kappa), moments=_moments(arm),
        hubs=np.array([arm.hub_inertia[0], arm.joint_inertia, arm.hub_inertia[1], arm.tip_inertia]),
        step=np.zeros((0, 2, 2)), start=np.zeros((0, 2)), end=np.zeros((0, 2)), load=np.zeros((0, 7)),
        output=np.zeros((4, 0)))


def flexibility(arm: ArmParameters, kappa: int) -> Array:
    """Outputs (4) by loads (7), summed over the modes beyond kappa.

    Outputs joint1, joint2 [rad], link1_bend, link2_bend [m]; loads: moments [N m] at root and tip of
    link 1, root and tip of link 2, then -theta1'', -theta2'' [rad/s^2] and -n2 . P'' [m/s^2].
    """
    L, EI = np.array(arm.link_length), np.array(arm.bending_stiffness)
    ends = np.stack([f(arm, TERMS) for f in (linearization.root_slopes, linearization.tip_slopes)])
    stiffness = linearization.stiffness(arm, TERMS)
    C = output_matrix(arm, *ends)[:, 2:]
    beyond = np.tile(np.arange(TERMS) >= kappa, 2)
    R: Array = (C / stiffness * beyond) @ load_weights(arm, TERMS)
    # slopes by end moments fall with 1 / j^2 only: the static beam (L / 3 EI, L / 6 EI) less the modes kept
    total = np.array([[1 / 3, -1 / 6], [-1 / 6, 1 / 3]])
    if arm.angle_convention == 'encoder':
        kept = stiffness.reshape(2, TERMS)[:, :kappa]
        few = ends[:, :, :kappa]
        bent = [total * L[i] / EI[i] - (few[:, i] / kept[i]) @ few[:, i].T for i in range(2)]
        R[0, :2] = bent[0][0]
        R[1, :2] = -bent[0][1]
        R[1, 2:4] = bent[1][0]
    return R


def load_weights(arm: ArmParameters, modes: int) -> Array:
    """Generalized forces of the modal coordinates by the seven loads, (2 modes, 7), see ``flexibility``."""
    root, tip = linearization.root_slopes(arm, modes), linearization.tip_slopes(arm, modes)
    mass = np.array(arm.linear_density) * np.array(arm.link_length)
    j = np.arange(1, modes + 1)
    sign = np.where(j % 2, -1.0, 1.0)
    rigid = -(mass * np.array(arm.link_length))[:, None] * sign / (j * np.pi)
    W = np.zeros((2 * modes, 7))
    W[:modes, [0, 1, 4]] = np.column_stack([root[0], tip[0], rigid[0]])
    W[modes:, [2, 3, 5, 6]] = np.column_stack([
        root[1], tip[1], rigid[1], mass[1] * (1 - sign) / (j * np.pi)])
    return W


def _moments(arm: ArmParameters) -> Array:
    """End moments (root 1, tip 1, root 2, tip 2) by the two joint torques, (4, 2)."""
    if arm.torque_convention == 'paper':
        return np.zeros((4, 2))
    return np.array([[1.0, 0.0], [0.0, -1.0], [0.0, 1.0], [0.0, 0.0]])
