"""The equations of motion against an independent Lagrangian, differentiated automatically."""

from __future__ import annotations

import lagrangian
import mechanics
import numpy as np
import pytest

from flexmanip_ros.arm import linearization, manipulator
from flexmanip_ros.parameters import ArmParameters

BODIES = {'point': (20.0, 0.0, 0.0, 0.0), 'body': (20.0, 1.5, 0.2, -0.1)}


@pytest.mark.parametrize('body', BODIES.values(), ids=BODIES)
@pytest.mark.parametrize('shortening', [False, True])
@pytest.mark.parametrize('kappa', [1, 3])
def test_equations_of_motion_follow_from_the_lagrangian(
    kappa: int, shortening: bool, body: tuple[float, float, float, float],
) -> None:
    parameters = ArmParameters(
        link_length=(3.0, 2.0), linear_density=(5.0, 4.0), bending_stiffness=(5000.0, 3000.0),
        hub_inertia=(1.0, 2.0), joint_inertia=0.5, tip_inertia=0.3, shortening=shortening)
    derived = lagrangian.forces(parameters, kappa, body)
    arm = manipulator.manipulator(parameters, kappa, points=40)
    payload = manipulator.payload_array(body[0], body[1], body[2:])
    rng = np.random.default_rng(kappa)
    for _ in range(3):
        q, qd, qdd = rng.normal(size=(3, 2 + 2 * kappa))
        q[2:] *= 0.2  # bends of 20 cm, so that each term counts
        ours = (linearization.mass_matrix(arm, payload, q) @ qdd + mechanics.bias(arm, payload, q, qd)
                + mechanics.elastic_forces(arm, q))
        assert ours == pytest.approx(lagrangian.evaluate(derived, q, qd, qdd), rel=1e-9, abs=1e-8)


@pytest.mark.parametrize('shortening', [False, True])
def test_torques_work_on_the_tangents(shortening: bool) -> None:
    """Generalized forces are the derivatives of the joints' own angles, the tangents' asin(w')."""
    arm = manipulator.manipulator(ArmParameters(shortening=shortening), 3)
    rng = np.random.default_rng(1)
    q = rng.normal(size=8) * 0.02

    def angles(q: np.ndarray) -> np.ndarray:
        slopes = np.array([arm.root_slope[0] @ q[2:5], arm.tip_slope[0] @ q[2:5], arm.root_slope[1] @ q[5:]])
        root1, tip1, root2 = slopes + slopes**3 / 6 if shortening else slopes
        return np.array([q[0] + root1, q[1] + root2 - q[0] - tip1])

    h = 1e-5
    expected = [(angles(q + h * e) - angles(q - h * e)) / (2 * h) for e in np.eye(8)]
    assert mechanics.torque_at(arm, q) == pytest.approx(np.array(expected), rel=1e-8, abs=1e-9)


def test_torques_do_the_work_of_their_joint_angles() -> None:
    """Virtual work: tau1 turns link 1's root, tau2 link 2's root against link 1's tip."""
    arm = manipulator.manipulator(ArmParameters(), 3)
    assert np.allclose(arm.torque.T, arm.output[:2], rtol=1e-12)
