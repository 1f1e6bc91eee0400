"""The closed forms at a working point: frequencies, blocks, discretization."""

from __future__ import annotations

import numpy as np
import pytest

from flexmanip_ros.arm import linearization, manipulator
from flexmanip_ros.errors import ModelError
from flexmanip_ros.parameters import ArmParameters

POINT = np.radians([60.0, 45.0])
TABLE = {
    (1, 0.0): (5.75934, 6.89945), (1, 20.0): (5.63428, 6.55037), (1, 100.0): (5.55577, 6.24486),
    (5, 0.0): (5.75720, 6.89350), (5, 20.0): (5.63383, 6.54451), (5, 100.0): (5.55572, 6.24113),
}
HEAVY = ArmParameters(hub_inertia=(1.0, 2.0), joint_inertia=0.5, tip_inertia=0.3)


@pytest.mark.parametrize(('kappa', 'payload'), TABLE)
def test_frequencies_of_the_reference_arm(kappa: int, payload: float) -> None:
    Ac, _ = linearization.vibration_model(ArmParameters(), POINT, payload, kappa)
    assert linearization.frequencies(Ac)[:2] == pytest.approx(TABLE[kappa, payload], abs=1e-5)


@pytest.mark.parametrize('arm', [ArmParameters(), HEAVY, ArmParameters(torque_convention='paper')])
@pytest.mark.parametrize('kappa', [1, 2, 5])
def test_blocks_are_the_nonlinear_matrices_without_bending(arm: ArmParameters, kappa: int) -> None:
    b = linearization.blocks(arm, POINT, 20.0, kappa)
    full = manipulator.manipulator(arm, kappa)
    q = np.concatenate([POINT, np.zeros(2 * kappa)])
    M = linearization.mass_matrix(full, manipulator.payload_array(20.0), q)
    assert np.allclose(M, np.block([[b.Ma, b.Mb], [b.Mb.T, b.Mc]]), rtol=1e-13, atol=1e-12)
    assert np.array_equal(np.diag(full.stiffness[2:]), b.Kc)
    assert np.array_equal(full.torque, np.vstack([b.B_theta, b.B_eta]))


def test_vibration_model_eliminates_the_chords() -> None:
    b = linearization.blocks(HEAVY, POINT, 20.0, 2)
    Ac, Bc = linearization.vibration_model(HEAVY, POINT, 20.0, 2)
    M = np.block([[b.Ma, b.Mb], [b.Mb.T, b.Mc]])
    eta, tau = np.array([1e-3, 2e-3, -1e-3, 3e-3]), np.array([3.0, -2.0])
    force = np.concatenate([b.B_theta @ tau, b.B_eta @ tau - b.Kc @ eta])
    expected = np.linalg.solve(M, force)[2:]
    assert (Ac @ np.concatenate([eta, np.zeros(4)]) + Bc @ tau)[4:] == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize('model', ['stiffness', 'modal'])
def test_damping_ratio_is_that_of_the_first_pinned_mode(model: str) -> None:
    arm = ArmParameters(damping_ratio=0.02, damping_model=model)
    constants = manipulator.manipulator(arm, 3)
    D, K = constants.damping[2:], constants.stiffness[2:]
    mass = np.repeat(np.array(arm.linear_density) * np.array(arm.link_length) / 2, 3)
    ratios = D / (2 * np.sqrt(K * mass))
    growth = np.array([1, 4, 9]) if model == 'stiffness' else np.ones(3)
    assert ratios == pytest.approx(0.02 * np.tile(growth, 2), rel=1e-12)


def test_discretization_is_exact_under_a_held_input() -> None:
    Ac, Bc = linearization.vibration_model(ArmParameters(damping_ratio=0.01), POINT, 20.0, 1)
    A, B = linearization.discretize(Ac, Bc, 0.01)
    fine_A, fine_B = linearization.discretize(Ac, Bc, 0.001)
    x = fine = np.zeros(4)
    u = np.array([10.0, -5.0])
    for _ in range(10):
        fine = fine_A @ fine + fine_B @ u
    x = A @ x + B @ u
    assert x == pytest.approx(fine, rel=1e-10)


@pytest.mark.parametrize(('theta', 'payload', 'kappa', 'word'), [
    ((0.0, float('nan')), 0.0, 1, 'angles'), ((0.0,), 0.0, 1, 'angles'),
    ((0.0, 0.0), -1.0, 1, 'payload'), ((0.0, 0.0), 0.0, 0, 'kappa')])
def test_bad_input_is_named(theta: tuple[float, ...], payload: float, kappa: int, word: str) -> None:
    with pytest.raises(ModelError, match=word):
        linearization.blocks(ArmParameters(), np.array(theta), payload, kappa)


def test_a_sample_time_of_zero_is_refused() -> None:
    with pytest.raises(ModelError, match='sample time'):
        linearization.discretize(np.zeros((2, 2)), np.zeros((2, 1)), 0.0)


@pytest.mark.parametrize('inertia', [0.0, 2.0])
def test_the_default_shape_functions_are_converged(inertia: float) -> None:
    """Torque to encoder at 1, 3 and 10 Hz, to bend at 1 and 3 Hz, and two frequencies, against nine sines a link."""
    payload = manipulator.payload_array(20.0, inertia)
    q, found = np.radians([60.0, 45.0]), []
    for modes in (ArmParameters().modes, 9):
        arm = manipulator.manipulator(ArmParameters(modes=modes))
        M = linearization.mass_matrix(arm, payload, np.append(q, np.zeros(2 * arm.kappa)))
        K = np.diag(arm.stiffness)
        response = [arm.output @ np.linalg.solve(K - (2 * np.pi * f) ** 2 * M, arm.torque)
                    for f in (1.0, 3.0, 10.0)]
        squares = np.sort(np.linalg.eigvals(np.linalg.solve(M, K)).real)
        found.append((np.array(response), np.sqrt(squares[2:4])))
    (ours, frequencies), (converged, exact) = found
    assert ours[:, :2] == pytest.approx(converged[:, :2], rel=3e-3)
    assert ours[:2, 2:] == pytest.approx(converged[:2, 2:], rel=2e-4)
    assert frequencies == pytest.approx(exact, rel=5e-5)
