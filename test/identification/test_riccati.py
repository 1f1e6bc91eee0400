"""The stationary gain by doubling is that of the library's Riccati solver."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are

from flexmanip_ros.identification.riccati_kernel import gain


@given(st.integers(1, 8), st.integers(1, 6), st.floats(0.5, 1.05), st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_gain_by_doubling_is_that_of_the_library(n: int, m: int, radius: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    C = rng.standard_normal((m, n))
    noise = rng.standard_normal((60, n + m)) @ rng.standard_normal((n + m, n + m))
    joint = noise.T @ noise / 60
    Q, S, R = (np.ascontiguousarray(part) for part in (joint[:n, :n], joint[:n, n:], joint[n:, n:]))
    K = np.empty((n, m))
    if not gain(A, C, Q, S, R, 1e-6, K):  # left to the library
        return
    P = solve_discrete_are(A.T, C.T, Q, R, s=S)
    known = np.linalg.solve(C @ P @ C.T + R, (A @ P @ C.T + S).T).T
    np.testing.assert_allclose(K, known, rtol=0.0, atol=1e-8 * np.abs(known).max())
    assert np.abs(np.linalg.eigvals(A - K @ C)).max() < 1.0


def test_an_unstable_mode_without_noise_is_left_to_the_library() -> None:
    A, C = np.array([[1.1]]), np.array([[1.0]])
    K = np.empty((1, 1))
    assert not gain(A, C, np.zeros((1, 1)), np.zeros((1, 1)), np.ones((1, 1)), 1e-6, K)


def test_a_sensor_that_repeats_another_is_left_to_the_library() -> None:
    A, C, R = np.array([[0.9]]), np.ones((2, 1)), np.ones((2, 2))
    assert not gain(A, C, np.ones((1, 1)), np.zeros((1, 2)), R, 1e-6, np.empty((1, 2)))
