from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_arm import configuration, random_system, record, run, sorted_poles

from flexmanip_ros.identification import prediction_check, rpbsid
from flexmanip_ros.identification.factor import REJECTED, USED

MODES = [{'forgetting': 'innovation'}, {'forgetting': 'excitation'}, {'forgetting': 'constant'},
         {'estimator': 'paper', 'forgetting': 'excitation'}, {'estimator': 'paper', 'forgetting': 'constant'}]


def identified(config, state):
    found = rpbsid.identified(config, state, 0.01)
    assert found is not None
    for part in (found.model.A, found.model.B, found.model.C, found.model.K, found.spread):
        assert np.all(np.isfinite(part))
    return found


@pytest.mark.parametrize('mode', MODES)
@pytest.mark.parametrize('quiet', ['silence', 'constant', 'noise'])
def test_a_minute_without_excitation_costs_nothing(mode, quiet):
    rng = np.random.default_rng(4)
    system = random_system(3, 2, 3, rng)
    u, y = record(system, 3000, 1e-2, rng)
    config = configuration(2, 3, order=3, past_window=5, future_window=3, **mode)
    before = run(config, u, y)
    count = 60_000
    gain = system.C @ np.linalg.solve(np.eye(3) - system.A, system.B)
    level = {'silence': 0.0, 'constant': 1.0, 'noise': 0.0}[quiet] * np.array([0.5, -0.3])
    hush = 1e-3 * rng.standard_normal((count, 3)) if quiet == 'noise' else 0.0
    rest = np.tile(level, (count, 1)), np.tile(gain @ level, (count, 1)) + hush
    after = before.feed(*rest)
    state = after.state
    assert all(np.all(np.isfinite(array)) for array in state.memory)
    if quiet == 'silence' or mode.get('forgetting') != 'constant':
        found = identified(config, state)
        assert np.abs(sorted_poles(found.model.A) - sorted_poles(system.A)).max() < 0.05
    u, y = record(system, 500, 1e-2, rng)
    found = identified(config, after._replace(state=rpbsid.window_restart(config, state)).feed(u, y).state)
    assert np.abs(sorted_poles(found.model.A) - sorted_poles(system.A)).max() < 0.05


@settings(max_examples=12, deadline=None)
@given(st.floats(-60, 60), st.floats(-60, 60), st.floats(-60, 60))
def test_units_of_the_signals_do_not_matter(a, b, c):
    rng = np.random.default_rng(6)
    system = random_system(2, 1, 2, rng)
    u, y = record(system, 600, 1e-2, rng)
    su, sy = 10.0 ** a, 10.0 ** np.array([b, c])
    config = configuration(1, 2, order=2, past_window=4, future_window=2)
    plain = identified(config, run(config, u, y).state)
    scaled = identified(config, run(config, u * su, y * sy).state)
    assert np.abs(sorted_poles(plain.model.A) - sorted_poles(scaled.model.A)).max() < 1e-6
    assert np.allclose(plain.model.B, scaled.model.B * su / sy[:, None], rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize('size', [1e-300, 1e-12, 1e12, 1e150])
@pytest.mark.parametrize('estimator', ['factor', 'paper'])
def test_huge_and_tiny_signals_stay_finite(size, estimator):
    rng = np.random.default_rng(7)
    config = configuration(1, 1, order=2, past_window=4, future_window=3, estimator=estimator)
    state = run(config, *(size * rng.standard_normal((2, 300, 1)))).state
    assert state.counts[USED] == 296
    assert all(np.all(np.isfinite(array)) for array in state.memory)


def test_a_signal_that_explodes_is_refused_not_believed():
    rng = np.random.default_rng(8)
    config = configuration(1, 1, order=1, past_window=3, future_window=2)
    u, y = rng.standard_normal((2, 100, 1))
    whole = run(config, u, y)
    assert np.array_equal(whole.feed(u * 1e200, y * 1e200).state.memory[0], whole.state.memory[0])


def test_factor_stays_triangular_with_a_positive_information_matrix():
    rng = np.random.default_rng(9)
    config = configuration(2, 2, order=2, past_window=5, future_window=2, forgetting='constant')
    state = run(config, *rng.standard_normal((2, 5000, 2))).state
    R = state.memory[0]
    assert np.array_equal(R, np.triu(R))
    assert np.all(np.diag(R)[:-2] > 0)


@pytest.mark.parametrize('choice', [{'estimator': 'factor'}, {'estimator': 'paper'}])
@pytest.mark.parametrize('count', [1, 2])
def test_a_sensor_that_is_mad_for_a_moment_changes_nothing_that_was_learnt(choice, count):
    rng = np.random.default_rng(3)
    u, y = record(random_system(2, 1, 2, rng), 1200, 0.01, rng)
    config = configuration(1, 2, order=2, past_window=4, future_window=2, **choice)
    wild = y.copy()
    wild[700:700 + count, 1] = 1e4 * np.abs(y[:, 1]).max()
    good, bad = (identified(config, run(config, u, data).state)
                 for data in (y, wild))
    near = np.abs(sorted_poles(good.model.A) - sorted_poles(bad.model.A)).max()
    assert near < 0.02


def test_signals_that_grow_for_good_are_followed_after_two_samples():
    rng = np.random.default_rng(4)
    u, y = record(random_system(2, 1, 2, rng), 1200, 0.01, rng)
    config = configuration(1, 2, order=2, past_window=4, future_window=2)
    half = run(config, u[:600], y[:600])
    grown = half.feed(1e3 * u[600:], 1e3 * y[600:]).state
    assert grown.counts[REJECTED] == 2
    assert grown.counts[USED] > half.state.counts[USED] + 580


def test_the_white_noise_of_a_sensor_is_known_to_the_deviation_that_is_assumed():
    rng = np.random.default_rng(0)
    found = np.concatenate([prediction_check.white_noise(rng.standard_normal((1000, 200))) for _ in range(10)])
    assert found.mean() == pytest.approx(1.0, abs=0.01)
    assert np.std(found) * np.sqrt(1000.0) == pytest.approx(prediction_check.MEDIAN_SPREAD, rel=0.04)
