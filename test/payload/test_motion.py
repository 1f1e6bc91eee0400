"""The structured estimator's step of the motion against a fine, independent integration."""

from __future__ import annotations

import numpy as np
import pytest

from flexmanip_ros.parameters import IdentifierParameters, configure
from flexmanip_ros.payload import process_model
from flexmanip_ros.payload.structured_model import motion

SHORT = {
    'arm.link_length': [1.0, 0.8], 'arm.linear_density': [1.0, 0.8], 'arm.bending_stiffness': [120.0, 60.0],
    'arm.joint_mass': 1.5, 'arm.tip_mass': 0.8}
TORQUE = np.array([2.0, -0.8])


@pytest.fixture
def arm():
    return motion(configure(IdentifierParameters, SHORT))


def bent(arm, n: int) -> np.ndarray:
    """A bent arm in motion, holding something."""
    rng = np.random.default_rng(0)
    x = np.zeros(2 * n + arm.G.shape[1])
    x[:2], x[n:n + 2] = (1.0, 0.6), (0.3, -0.4)
    x[2:n] = rng.normal(size=n - 2) * np.tile([5e-3, 5e-4, 1e-4], 2)
    x[n + 2:2 * n] = rng.normal(size=n - 2) * np.tile([0.5, 0.2, 0.1], 2)
    process_model.set_parameters(arm, x, True)
    return x


def fine(arm, x: np.ndarray, n: int, duration: float, steps: int) -> np.ndarray:
    """Runge and Kutta with steps so small that they count as exact."""
    def slope(state):
        qdd = np.zeros(n)
        assert process_model.accelerate(arm, state[:n].copy(), state[n:].copy(), TORQUE, qdd)
        return np.concatenate([state[n:], qdd])

    state, h = x[:2 * n].copy(), duration / steps
    for _ in range(steps):
        a = slope(state)
        b = slope(state + h / 2 * a)
        c = slope(state + h / 2 * b)
        state = state + h / 6 * (a + 2 * b + 2 * c + slope(state + h * c))
    return state


def error(arm, x: np.ndarray, exact: np.ndarray, n: int, duration: float, h: float) -> float:
    state = x.copy()
    for _ in range(round(duration / h)):
        assert process_model.exponential_step(arm, state, TORQUE, h, True)
    return float(np.abs(state[:n] - exact[:n]).max())


def test_a_step_of_one_sample_is_exact_to_a_hundredth_of_the_sensors_and_of_third_order(arm):
    n = arm.q.size
    x = bent(arm, n)
    exact = fine(arm, x, n, 0.02, 1000)
    coarse, halved = (error(arm, x, exact, n, 0.02, h) for h in (1e-3, 5e-4))
    assert coarse < 1e-7  # of bends of 5e-3 m
    assert halved < coarse / 6


def test_the_linearisation_is_the_derivative_of_the_motion(arm):
    n = arm.q.size
    x = bent(arm, n)
    qdd, low, high = np.zeros(n), np.zeros(n), np.zeros(n)
    assert process_model.linearize(arm, x[:n].copy(), x[n:2 * n].copy(), TORQUE, qdd, True)
    dq, dqd = arm.dq.copy(), arm.dqd.copy()
    for i in range(2 * n):
        up, down = x[:2 * n].copy(), x[:2 * n].copy()
        up[i] += 1e-6
        down[i] -= 1e-6
        process_model.accelerate(arm, up[:n].copy(), up[n:].copy(), TORQUE, high)
        process_model.accelerate(arm, down[:n].copy(), down[n:].copy(), TORQUE, low)
        given = dq[:, i] if i < n else dqd[:, i - n]
        np.testing.assert_allclose((high - low) / 2e-6, given, rtol=1e-5, atol=1e-6 * np.abs(given).max())


def test_the_derivatives_by_stiffness_and_unevenness_are_those_of_the_motion(arm):
    n = arm.q.size
    x = bent(arm, n)
    qdd, low, high = np.zeros(n), np.zeros(n), np.zeros(n)
    assert process_model.linearize(arm, x[:n].copy(), x[n:2 * n].copy(), TORQUE, qdd, True)
    G = arm.G.copy()
    for c in range(G.shape[1]):
        up, down = x.copy(), x.copy()
        up[2 * n + c] += 1e-5
        down[2 * n + c] -= 1e-5
        for state, acceleration in ((up, high), (down, low)):
            process_model.set_parameters(arm, state, True)
            process_model.accelerate(arm, x[:n].copy(), x[n:2 * n].copy(), TORQUE, acceleration)
        np.testing.assert_allclose((high - low) / 2e-5, G[:, c], rtol=1e-4, atol=1e-6 * np.abs(G).max())
