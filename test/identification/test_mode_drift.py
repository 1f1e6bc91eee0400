"""Frequencies that drift along a stretch are told from its residuals, and the bands reach that far."""

from __future__ import annotations

import numpy as np
import pytest
from linear_arm import benchmark
from numpy.typing import NDArray

from flexmanip_ros.identification.mode_drift import Drift, drifting, sway, turns
from flexmanip_ros.identification.prediction_error import Fit, Structure, Theta, descend, moved

Array = NDArray[np.float64]
HELD = Structure(free_output=False, free_direct=False, free_gain=False)
COUNT, DT = 2048, 1e-3
FREQUENCIES = np.array([5.7, 6.7])
BASIS = np.array([[1.0, 0.3, -0.2, 0.5], [-0.4, 1.2, 0.6, 0.1], [0.2, -0.7, 0.9, 0.4], [0.5, 0.1, 0.3, -1.1]])


def model(frequencies: Array) -> Array:
    """A (..., 4, 4) of two oscillations (..., 2) [Hz], lightly damped."""
    angles, blocks = 2.0 * np.pi * DT * frequencies, np.zeros((*frequencies.shape[:-1], 4, 4))
    for k in range(2):
        c, s = np.cos(angles[..., k]), np.sin(angles[..., k])
        blocks[..., 2 * k:2 * k + 2, 2 * k:2 * k + 2] = 0.9995 * np.stack([c, -s, s, c], -1).reshape(*c.shape, 2, 2)
    return np.asarray(BASIS @ blocks @ np.linalg.inv(BASIS))


def stretch(drift: Array, noise: float, seed: int = 0) -> tuple[Array, Array]:
    """Inputs (N, 2) and outputs (N, 4) while the frequencies go by ``drift`` (2,) [Hz] in all."""
    rng = np.random.default_rng(seed)
    B = 0.05 * rng.standard_normal((4, 2))
    U = np.repeat(rng.standard_normal((COUNT // 16, 2)), 16, axis=0)
    Y, x = np.empty((COUNT, 4)), np.zeros(4)
    weights = (np.arange(COUNT) - 0.5 * (COUNT - 1)) / COUNT
    for t, A in enumerate(model(FREQUENCIES + weights[:, None] * drift)):
        Y[t] = x
        x = A @ x + B @ U[t]
    return U, Y + noise * Y.std() * rng.standard_normal(Y.shape)


def fitted(U: Array, Y: Array) -> Fit:
    none = np.zeros((4, 2))
    begin = Theta(model(FREQUENCIES), none, np.eye(4), none, np.zeros((4, 4)), np.zeros(4))
    fit = descend(U, Y, begin, HELD, 30)
    assert fit is not None
    return fit


def frequencies(A: Array) -> Array:
    angles = np.angle(np.linalg.eigvals(A))
    return np.sort(angles[angles > 0.0]) / (2.0 * np.pi * DT)


def found(drift: Array, noise: float, seed: int = 0) -> tuple[Fit, Drift | None]:
    U, Y = stretch(drift, noise, seed)
    fit = fitted(U, Y)
    return fit, drifting(U, Y, fit, HELD)


def test_a_turn_moves_the_angle_of_its_own_mode_alone() -> None:
    A, step = model(FREQUENCIES), 1e-6
    for dA in turns(A):
        change = (frequencies(A + step * dA) - frequencies(A)) * 2.0 * np.pi * DT / step
        assert np.sort(np.abs(change)) == pytest.approx([0.0, 1.0], abs=1e-4)
    assert len(turns(np.array([[0.9, 1.0], [0.0, 0.9]]))) == 0  # no oscillation, and defective
    assert len(turns(np.diag([0.9, 0.5]))) == 0


def test_the_derivative_by_a_drift_is_that_of_a_model_that_drifts() -> None:
    U, Y = stretch(np.zeros(2), 0.0)
    A, rng = model(FREQUENCIES), np.random.default_rng(1)
    B, C, D = rng.standard_normal((4, 2)), np.eye(4), rng.standard_normal((4, 2))
    start = rng.standard_normal(4)
    moving = turns(A)

    def simulated(rho: Array) -> Array:
        x, y = start, np.empty((COUNT, 4))
        for t in range(COUNT):
            y[t] = C @ x + D @ U[t]
            weight = (t - 0.5 * (COUNT - 1)) / COUNT
            x = (A + weight * np.einsum('g,gij->ij', rho, moving)) @ x + B @ U[t]
        return y

    end, X = start.copy(), np.zeros((2, 4))
    E, S = np.empty((COUNT, 4)), np.empty((2, COUNT, 4))
    sway(U, Y, A, B, C, D, moving, end, X, E, S)
    assert np.abs(Y - simulated(np.zeros(2)) - E).max() < 1e-9
    step = 1e-6
    for g in range(2):
        rho = step * np.eye(2)[g]
        numeric = (simulated(rho) - simulated(-rho)) / (2.0 * step)
        assert S[g] == pytest.approx(numeric, abs=1e-5 * np.abs(numeric).max())


@pytest.mark.parametrize('noise', [1e-3, 1e-2, 0.1])
def test_a_steady_drift_is_found_and_leads_to_the_end_of_the_stretch(noise: float) -> None:
    drift = np.array([0.0, -0.06])
    fit, told = found(drift, noise)
    assert told is not None
    rate = frequencies(moved(fit.theta, fit.directions @ told.rate, HELD).A) - frequencies(fit.theta.A)
    assert rate == pytest.approx(drift, abs=0.003 + 0.05 * noise)
    end = FREQUENCIES + 0.5 * drift
    ahead = moved(fit.theta, fit.directions @ told.ahead, HELD)
    assert frequencies(ahead.A) == pytest.approx(end, abs=0.001 + 0.05 * noise)
    assert np.abs(frequencies(fit.theta.A) - end).max() > 0.01  # the fit alone is of earlier


def test_an_arm_that_stays_has_none() -> None:
    assert all(found(np.zeros(2), 0.01, seed)[1] is None for seed in range(10))


def test_the_bands_of_a_moving_arm_reach_to_where_it_is() -> None:
    """Without the drift 75 % of the bands of f2 reach to the frequency of now; those of the last half second all do."""
    study = benchmark('identification_moving_arm')
    rows = np.vstack([study.readings(mass, degrees, 1, angles=()) for mass, degrees in (
        (20.0, (60.0, 45.0)), (50.0, (0.0, 0.0)))])
    for errors in (rows[:, 1:3], rows[:, 3:5]):  # lately, now
        inside = np.abs(errors) < 1.96 * rows[:, 5:]
        assert np.all(inside.mean(axis=0) > 0.8)
    assert np.all(np.median(rows[:, 5:], axis=0) < 0.005)
