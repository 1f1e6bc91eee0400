"""The nonlinear equations: structure, conservation, derivatives."""

from __future__ import annotations

from collections.abc import Callable

import mechanics
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexmanip_ros.arm import linearization
from flexmanip_ros.arm import manipulator as m
from flexmanip_ros.arm.equations_of_motion import acceleration
from flexmanip_ros.arm.jacobian import complete_jacobian, force_jacobian
from flexmanip_ros.errors import ModelError
from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.types import Array

ARM = ArmParameters(hub_inertia=(1.0, 2.0), joint_inertia=0.5, tip_inertia=0.3, damping_ratio=0.01)
PAYLOADS = {'point': m.payload_array(20.0), 'body': m.payload_array(20.0, 1.5, (0.2, -0.1))}


def arm_of(kappa: int, shortening: bool) -> m.Manipulator:
    return m.manipulator(ArmParameters(
        hub_inertia=ARM.hub_inertia, joint_inertia=0.5, tip_inertia=0.3, damping_ratio=0.01,
        shortening=shortening), kappa)


def state(kappa: int, seed: int = 0) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    q, qd = rng.normal(size=(2, 2 + 2 * kappa))
    q[2:] *= 0.3  # bending far beyond any real one, so that every term shows
    return q, qd


def slope(f: Callable[[float], Array], h: float = 1e-4) -> Array:
    return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)


every_arm = pytest.mark.parametrize('shortening', [False, True])
every_kappa = pytest.mark.parametrize('kappa', [1, 3])
every_payload = pytest.mark.parametrize('payload', PAYLOADS.values(), ids=PAYLOADS)


@every_arm
@every_kappa
@every_payload
def test_mass_matrix_is_symmetric_and_positive(shortening: bool, kappa: int, payload: Array) -> None:
    q, _ = state(kappa)
    M = linearization.mass_matrix(arm_of(kappa, shortening), payload, q)
    assert np.array_equal(M, M.T)
    assert np.linalg.eigvalsh(M).min() > 0


@every_arm
@every_kappa
@every_payload
def test_mass_rate_minus_twice_coriolis_is_skew(shortening: bool, kappa: int, payload: Array) -> None:
    arm = arm_of(kappa, shortening)
    q, qd = state(kappa)
    rate = slope(lambda h: linearization.mass_matrix(arm, payload, q + h * qd))
    C = mechanics.coriolis_matrix(arm, payload, q, qd)
    left = rate - 2 * C
    assert np.abs(left + left.T).max() < 1e-8 * np.abs(rate).max()
    assert C @ qd == pytest.approx(mechanics.bias(arm, payload, q, qd), rel=1e-12, abs=1e-12)


@every_arm
@every_kappa
@every_payload
def test_bias_is_that_of_the_christoffel_symbols(shortening: bool, kappa: int, payload: Array) -> None:
    arm = arm_of(kappa, shortening)
    q, qd = state(kappa)
    dM = np.array([slope(lambda h, e=e: linearization.mass_matrix(arm, payload, q + h * e)) for e in np.eye(q.size)])
    expected = np.einsum('kij,k,j->i', dM, qd, qd) - np.einsum('kij,i,j->k', dM, qd, qd) / 2
    bias = mechanics.bias(arm, payload, q, qd)
    assert np.abs(bias - expected).max() < 1e-8 * np.abs(bias).max()


@every_arm
@every_kappa
@every_payload
def test_derivatives_of_the_acceleration(shortening: bool, kappa: int, payload: Array) -> None:
    arm = arm_of(kappa, shortening)
    q, qd = state(kappa, 1)
    n = q.size
    tau, qdd = np.array([3.0, -2.0]), np.empty(n)
    dq, dqd, dp, flow = np.empty((n, n)), np.empty((n, n)), np.empty((n, 4)), np.empty((n, 2 * n))
    work = m.workspace(arm)
    assert acceleration(arm, payload, q, qd, tau, qdd, work)
    force_jacobian(arm, payload, q, qd, qdd, dq, dqd, dp, work)
    complete_jacobian(arm, q, qd, dq, dqd, flow, work)
    assert np.array_equal(qdd, mechanics.accelerations(arm, payload, q, qd, tau))

    expected = {
        'q': [slope(lambda h, e=e: mechanics.accelerations(arm, payload, q + h * e, qd, tau)) for e in np.eye(n)],
        'qd': [slope(lambda h, e=e: mechanics.accelerations(arm, payload, q, qd + h * e, tau)) for e in np.eye(n)],
        'payload': [
            slope(lambda h, e=e: mechanics.accelerations(arm, payload + h * e, q, qd, tau)) for e in np.eye(4)],
    }
    by_payload = -np.linalg.solve(linearization.mass_matrix(arm, payload, q), dp)
    for name, got in (('q', flow[:, :n]), ('qd', flow[:, n:]), ('payload', by_payload)):
        want = np.array(expected[name]).T
        assert np.abs(got - want).max() < 1e-7 * np.abs(want).max(), name


@given(turn=st.floats(-10, 10), seed=st.integers(0, 100))
@settings(max_examples=25, deadline=None)
def test_turning_everything_changes_nothing(turn: float, seed: int) -> None:
    arm = arm_of(2, True)
    q, qd = state(2, seed)
    turned = q + turn * np.array([1, 1, 0, 0, 0, 0])
    tau = np.array([1.0, 2.0])
    expected = mechanics.accelerations(arm, PAYLOADS['body'], q, qd, tau)
    got = mechanics.accelerations(arm, PAYLOADS['body'], turned, qd, tau)
    assert got == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_a_mirrored_arm_moves_mirrored() -> None:
    arm = arm_of(3, True)
    q, qd = state(3)
    tau = np.array([1.0, -2.0])
    payload, mirrored = m.payload_array(5.0, 0.1, (0.1, 0.2)), m.payload_array(5.0, 0.1, (0.1, -0.2))
    expected = -mechanics.accelerations(arm, payload, q, qd, tau)
    assert mechanics.accelerations(arm, mirrored, -q, -qd, -tau) == pytest.approx(expected, rel=1e-9)


def test_without_bending_shortening_changes_only_second_order() -> None:
    q, _ = state(3)
    small = q.copy()
    small[2:] *= 1e-5
    payload = PAYLOADS['point']
    plain, short = (linearization.mass_matrix(arm_of(3, s), payload, small) for s in (False, True))
    assert np.abs(plain - short).max() < 1e-4 * np.abs(plain).max()
    assert not np.allclose(plain, short, rtol=1e-9)


@pytest.mark.parametrize('bad', [(-1.0, 0.0), (1.0, -0.1), (float('nan'), 0.0)])
def test_an_impossible_payload_is_refused(bad: tuple[float, float]) -> None:
    with pytest.raises(ModelError, match='payload'):
        m.payload_array(*bad)


def test_numbers_that_are_not_finite_are_an_error_not_a_result() -> None:
    bad = mechanics.accelerations(arm_of(1, True), PAYLOADS['point'], np.full(4, np.nan), np.zeros(4), np.zeros(2))
    assert np.isnan(bad).all()
    with pytest.raises(ModelError, match='kappa'):
        m.manipulator(ArmParameters(), 0)
