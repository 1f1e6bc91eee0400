"""Linearization where the arm moves, accelerates and bends."""

from __future__ import annotations

import numpy as np
import pytest

from flexmanip_ros.arm import dynamics, linearization, manipulator
from flexmanip_ros.errors import ModelError
from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.types import Array

PARAMETERS = ArmParameters(shape_functions='sines', modes=2, damping_ratio=0.01, hub_inertia=(0.3, 0.2))
ARM = manipulator.manipulator(PARAMETERS)
PAYLOAD = manipulator.payload_array(20.0, 0.5, (0.1, 0.2))
TAU = np.array([30.0, -20.0])


def moving() -> tuple[Array, Array]:
    rng = np.random.default_rng(3)
    q, qd = rng.normal(size=(2, 6))
    q[2:] *= 0.1
    return q, qd


def test_state_space_is_the_derivative_of_the_motion() -> None:
    q, qd = moving()
    A, B = linearization.linearize(ARM, PAYLOAD, q, qd, TAU).state_space()
    h = 1e-5

    def motion(x: Array, tau: Array) -> Array:
        return np.concatenate([x[6:], dynamics.accelerations(ARM, PAYLOAD, x[:6], x[6:], tau)])

    x = np.concatenate([q, qd])
    for matrix, f, start in ((A, lambda x: motion(x, TAU), x), (B, lambda tau: motion(x, tau), TAU)):
        for c, e in enumerate(np.eye(start.size)):
            slope = (8 * (f(start + h * e) - f(start - h * e))
                     - (f(start + 2 * h * e) - f(start - 2 * h * e))) / (12 * h)
            assert matrix[:, c] == pytest.approx(slope, rel=1e-6, abs=1e-6 * np.abs(matrix).max())


def test_each_term_is_the_derivative_it_names() -> None:
    q, qd = moving()
    point = linearization.linearize(ARM, PAYLOAD, q, qd, TAU)
    h = 1e-6
    for c, e in enumerate(np.eye(6)):
        def slope(f: object, e: Array = e) -> Array:
            return (f(h * e) - f(-h * e)) / (2 * h)

        C_E = slope(lambda d: dynamics.bias(ARM, PAYLOAD, q, qd + d))
        K_E = slope(lambda d: dynamics.bias(ARM, PAYLOAD, q + d, qd))
        K_M = slope(lambda d: dynamics.mass_matrix(ARM, PAYLOAD, q + d) @ point.acceleration)
        K = slope(lambda d: dynamics.elastic_forces(ARM, q + d) - dynamics.torque_at(ARM, q + d) @ TAU)
        for got, want in ((point.C_E, C_E), (point.K_E, K_E), (point.K_M, K_M), (point.K, K)):
            assert got[:, c] == pytest.approx(want, rel=1e-5, abs=1e-6 * max(np.abs(got).max(), 1.0))


def test_at_rest_without_bending_it_is_the_papers() -> None:
    q = np.concatenate([np.radians([60.0, 45.0]), np.zeros(4)])
    full = linearization.linearize(ARM, PAYLOAD, q, np.zeros(6), np.zeros(2))
    simple = linearization.linearize(ARM, PAYLOAD, q, np.zeros(6), np.zeros(2), simplified=True)
    for a, b in zip(full.state_space(), simple.state_space(), strict=True):
        assert np.allclose(a, b, atol=1e-9)


def test_the_simplified_form_has_the_blocks_vibration_model_inside() -> None:
    point = manipulator.payload_array(20.0)
    q = np.concatenate([np.radians([60.0, 45.0]), np.full(4, 0.01)])
    A, _ = linearization.linearize(ARM, point, q, np.ones(6), TAU, simplified=True).state_space()
    Ac, _ = linearization.vibration_model(PARAMETERS, q[:2], 20.0)
    assert np.allclose(A[8:][:, [2, 3, 4, 5, 8, 9, 10, 11]], Ac[4:], atol=1e-8)


def test_motion_changes_the_frequencies_which_the_paper_drops() -> None:
    q = np.concatenate([np.radians([60.0, 45.0]), np.zeros(4)])
    fast = np.array([2.0, 2.0, 0, 0, 0, 0])  # turning as one, 2 rad/s
    full = linearization.linearize(ARM, PAYLOAD, q, fast, np.zeros(2)).state_space()[0]
    simple = linearization.linearize(ARM, PAYLOAD, q, fast, np.zeros(2), simplified=True).state_space()[0]
    a, b = (linearization.frequencies(matrix)[-4:] for matrix in (full, simple))
    assert not np.allclose(a, b, rtol=1e-4)


def test_a_working_point_of_the_wrong_size_is_refused() -> None:
    with pytest.raises(ModelError, match='working point'):
        linearization.linearize(ARM, PAYLOAD, np.zeros(4), np.zeros(6), TAU)
