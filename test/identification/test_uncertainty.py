from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from linear_arm import benchmark, configuration, identified, random_system, record, run

from flexmanip_ros.identification.model_output import based, from_factor
from flexmanip_ros.identification.moments import realize_orders
from flexmanip_ros.identification.uncertainty import Tangent, modes, tangent
from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.types import StateSpace, Status


@pytest.mark.parametrize(
    ('n', 'm', 'feedthrough'), [(3, 3, False), (4, 2, False), (2, 2, True), (4, 1, False)])
def test_tangent_is_the_derivative_with_respect_to_the_regression(n, m, feedthrough):
    rng = np.random.default_rng(n + m)
    u, y = record(random_system(n, 2, m, rng), 4000, 1e-6, rng)
    config = configuration(2, m, order=n, past_window=20, future_window=5, direct_feedthrough=feedthrough,
                           refinement='none', regularization=[1e-8] * 3)
    state = run(config, u, y).state
    realized, R, _ = from_factor(config, state.memory[0], state.scale)
    assert realized is not None
    along = tangent(R, realized, 2, np.eye(m))
    d = realized.regression.shape[0]
    poles = np.linalg.eigvals(realized.A)
    worst = 0.0
    for _ in range(3):
        omega = rng.standard_normal(m * d)
        # dXi = Omega regression^-T, put into the moments as regression dXi' under the outputs' columns
        change = np.zeros_like(R)
        change[:d, -m:] = omega.reshape(m, d).T
        step = 1e-7 * np.abs(R[:d, -m:]).max()
        both = [realize_orders(R + sign * step * change, 2, m, (n,), 5, feedthrough=feedthrough, weighted=True)[0]
                for sign in (1.0, -1.0)]
        shift = [np.array([np.linalg.eigvals(b.A)[np.argmin(np.abs(np.linalg.eigvals(b.A) - pole))]
                           for pole in poles]) for b in both if b is not None]
        numeric = (shift[0] - shift[1]) / (2 * step)
        values, right = np.linalg.eig(realized.A)
        left = np.linalg.inv(right)
        analytic = np.array([left[i] @ np.tensordot(omega, along.A, 1) @ right[:, i] for i in range(n)])
        order = [int(np.argmin(np.abs(values - pole))) for pole in poles]
        size = max(np.abs(numeric).max(), 1e-6)
        worst = max(worst, float(np.abs(numeric - analytic[order]).max() / size))
    assert worst < 0.05  # what is left is the misfit of the noisy regression, of second order


def test_change_of_basis_carries_the_tangent():
    rng = np.random.default_rng(11)
    system = random_system(4, 1, 2, rng)
    system = dataclasses.replace(system, A=np.eye(4) + 0.05 * (system.A - np.eye(4)))
    base = tuple(np.zeros((1, *getattr(system, name).shape)) for name in 'ABCDK')
    for part in base[:3]:
        part[:] = rng.standard_normal(part.shape)
    moved, along, _ = based(system, Tangent(*base))
    assert along is not None
    assert np.allclose(moved.C, [[1, 0, 0, 0], [0, 1, 0, 0]], atol=1e-9)
    step = 1e-6
    shifted = []
    for sign in (1, -1):
        other = StateSpace(*(getattr(system, name) + sign * step * part[0]
                             for name, part in zip('ABCDK', base, strict=True)), dt=system.dt)
        shifted.append(based(other, None)[0])
    for name in 'ABC':
        numeric = (getattr(shifted[0], name) - getattr(shifted[1], name)) / (2 * step)
        assert np.allclose(numeric, getattr(along, name)[0], atol=1e-4 * (1 + np.abs(numeric).max())), name


@pytest.mark.parametrize('feedthrough', [True, False])
@pytest.mark.parametrize('estimator', ['factor', 'paper'])
def test_deviations_of_A_and_B_are_the_scatter_of_many_runs(estimator, feedthrough):
    config = configuration(1, 2, order=2, past_window=6, future_window=4, estimator=estimator, refinement='none',
                           forgetting='constant', forgetting_factor=[0.9995] * 3, regularization=[1e-6] * 3,
                           direct_feedthrough=feedthrough)
    system = random_system(2, 1, 2, np.random.default_rng(0))
    records = [record(system, 2000, 0.05, np.random.default_rng(seed)) for seed in range(40)]
    found = [identified(config, run(config, u, y).state, 0.01) for u, y in records]
    scatter = np.std([np.append(one.model.A, one.model.B) for one in found], axis=0)
    claimed = np.median([np.linalg.norm(one.spread[:6], axis=1) for one in found], axis=0)
    np.testing.assert_allclose(claimed / scatter, 1.0, atol=0.5)


@pytest.mark.parametrize('factor', [1, 5])
def test_deviations_of_a_decimated_model_are_the_scatter_of_many_runs(factor):
    study = benchmark('identification_coverage')
    arm = ArmParameters(torque_convention='paper', damping_ratio=0.01, modes=1)
    u, clean, _ = study.clean_response(arm)
    config = configuration(2, 4, order=4, decimation=factor)
    values, deviations = [], []
    for seed in range(30):
        noise = np.random.default_rng(seed).standard_normal(clean.shape)
        found = identified(config, run(config, u, clean + 0.01 * clean.std(axis=0) * noise).state, study.DT)
        both = modes(found)
        values.append([(one.frequency_hz, one.damping_ratio) for one in both])
        deviations.append([(one.frequency_std_hz, one.damping_ratio_std) for one in both])
    claimed = np.median(deviations, axis=0) / np.std(values, axis=0)
    assert np.mean(claimed) == pytest.approx(1.0, abs=0.13)  # 30 runs tell each of the four to 13 %


@pytest.mark.parametrize(('noise', 'status'), [(0.3, Status.TRACKING), (3.0, Status.POORLY_EXCITED)])  # 44 %, 9 %
@pytest.mark.parametrize('estimator', ['factor', 'paper'])
def test_a_model_that_explains_more_than_a_tenth_is_not_poorly_excited(estimator, noise, status):
    config = configuration(1, 1, order=2, past_window=6, future_window=4, estimator=estimator, refinement='none',
                           forgetting='constant', forgetting_factor=[0.9995] * 3)
    u, y = record(random_system(2, 1, 1, np.random.default_rng(1)), 4000, noise, np.random.default_rng(3))
    found = identified(config, run(config, u, y).state, 0.01)
    assert found.status is status


def test_intervals_cover_at_40_and_20_db_and_are_as_wide_as_the_bound():
    study = benchmark('identification_coverage')
    for snr_db in (40.0, 20.0):
        row = study.study(8, snr_db)
        assert min(row['coverage_percent']) >= 60.0, row  # 8 runs: less than 1 in 1000 by chance
        assert np.all(np.abs(row['bias'][:4]) < 1.5 * np.array(row['scatter'][:4])), row
        np.testing.assert_allclose(row['claimed_over_bound'], 1.0, atol=0.02 if snr_db == 40.0 else 0.1)


def test_modes_of_a_known_model():
    dt, w, zeta = 1e-3, 2 * np.pi * 6.0, 0.02
    s = complex(-zeta * w, w * np.sqrt(1 - zeta ** 2))
    pole = np.exp(s * dt)
    A = np.array([[pole.real, pole.imag], [-pole.imag, pole.real]])
    rng = np.random.default_rng(0)
    u, y = record(random_system(2, 1, 2, rng), 500, 0.05, rng)
    config = configuration(1, 2, order=2, past_window=4, future_window=2)
    found = identified(config, run(config, u, y).state, dt)
    (mode,) = modes(found._replace(model=dataclasses.replace(found.model, A=A)))
    assert mode.frequency_hz == pytest.approx(6.0 * np.sqrt(1 - zeta ** 2))
    assert mode.damping_ratio == pytest.approx(zeta)
    assert mode.frequency_std_hz > 0
