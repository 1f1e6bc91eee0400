"""The stationary gain of a model's predictor, from the residuals of its regression."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from flexmanip_ros.identification.moments import riccati_gain


@given(st.integers(1, 8), st.integers(1, 6), st.floats(0.5, 1.05), st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_the_gain_is_where_the_kalman_filter_comes_to_rest(n: int, m: int, radius: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    C = rng.standard_normal((m, n))
    noise = rng.standard_normal((60, n + m)) @ rng.standard_normal((n + m, n + m))
    K = riccati_gain(A, C, noise[:, :n], noise[:, n:], np.full((n, m), np.nan))
    assert np.abs(np.linalg.eigvals(A - K @ C)).max() < 1.0
    joint = noise.T @ noise
    Q, S, R = joint[:n, :n], joint[:n, n:], joint[n:, n:]
    P = Q.copy()
    for _ in range(2000):
        gain = np.linalg.solve(C @ P @ C.T + R, (A @ P @ C.T + S).T).T
        P = A @ P @ A.T + Q - gain @ (A @ P @ C.T + S).T
        P = (P + P.T) / 2  # rounding would pull it apart
    np.testing.assert_allclose(K, gain, rtol=0.0, atol=1e-6 * max(np.abs(gain).max(), 1e-3))


def test_residuals_that_are_all_zero_leave_the_regressed_gain() -> None:
    A, C, regressed = np.array([[1.1]]), np.array([[1.0]]), np.array([[0.4]])
    found = riccati_gain(A, C, np.zeros((5, 1)), np.zeros((5, 1)), regressed)
    assert np.all(np.isfinite(found))


def test_a_sensor_that_repeats_another_gives_a_finite_gain() -> None:
    rng = np.random.default_rng(1)
    one = rng.standard_normal((50, 1))
    found = riccati_gain(np.array([[0.9]]), np.ones((2, 1)), rng.standard_normal((50, 1)), np.hstack([one, one]),
                         np.zeros((1, 2)))
    assert np.all(np.isfinite(found))
