from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from linear_arm import configuration, identified, random_system, record, run, sorted_poles, start

from flexmanip_ros.errors import SignalError
from flexmanip_ros.identification import rpbsid, validation
from flexmanip_ros.identification.factor import FILLED, REJECTED, USED
from flexmanip_ros.identification.pbsid import pbsid
from flexmanip_ros.identification.realization import markov
from flexmanip_ros.samples.sample_log import SampleLog, log_of
from flexmanip_ros.types import Status

ESTIMATORS = [
    {'estimator': 'factor'}, {'estimator': 'factor', 'state_basis': 'fixed', 'direct_feedthrough': True},
    {'estimator': 'paper'}, {'estimator': 'paper', 'state_basis': 'tracked', 'direct_feedthrough': True},
]


def arrays(state: rpbsid.RpbsidState) -> list[np.ndarray]:
    return list(flat(state))


def flat(item: object) -> Iterator[np.ndarray]:
    if isinstance(item, (tuple, list)):
        for part in item:
            yield from flat(part)
    elif isinstance(item, SampleLog):
        yield item.rows(item.start, item.end).u_y
    elif item is not None:
        yield np.asarray(item)


def same(a: rpbsid.RpbsidState, b: rpbsid.RpbsidState) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(arrays(a), arrays(b), strict=True))


@pytest.mark.parametrize('choice', ESTIMATORS)
def test_steps_and_one_advance_give_the_same_bits(choice):
    count = 1100 if choice == {'estimator': 'factor'} else 60
    rng = np.random.default_rng(1)
    config = configuration(2, 3, order=3, past_window=4, future_window=3, **choice)
    u, y = record(random_system(3, 2, 3, rng), count, 0.1, rng)
    stepped = start(config)
    for k in range(count):
        before = stepped.state.owned()
        after = stepped.feed(u[k:k + 1], y[k:k + 1])
        assert same(before, stepped.state), 'a step leaves the state it was given as it was'
        stepped = after
    finished = (rpbsid.finish(one.state) for one in (stepped, run(config, u, y)))
    assert same(*finished)


@pytest.mark.parametrize(('n', 'r', 'm'), [(3, 2, 2), (4, 1, 3), (2, 2, 1), (5, 3, 5)])
@pytest.mark.parametrize('beta', [1.0, 0.995])
def test_recursion_equals_batch(n, r, m, beta):
    rng = np.random.default_rng(n)
    u, y = record(random_system(n, r, m, rng), 800, 0.05, rng)
    config = configuration(
        r, m, order=n, past_window=7, future_window=5, forgetting_factor=[beta] * 3, forgetting='constant',
        regularization=[1e-12] * 3, state_basis='fixed', kalman_gain='regression')
    found = identified(config, run(config, u, y).state, 0.01)
    batch, _ = pbsid(u, y, n=n, p=7, f=5, dt=0.01, weighted=True, fixed=True, forgetting=beta)
    assert np.abs(sorted_poles(found.model.A) - sorted_poles(batch.A)).max() < 1e-5
    size = np.abs(markov(batch, 10)).max()
    assert np.abs(markov(found.model, 10) - markov(batch, 10)).max() < 1e-5 * size


@given(st.lists(st.floats(-10.0, 10.0), min_size=5, max_size=5))
@example([0.0, 1.5, 0.0, 0.0, 0.0])  # of an input alone: from the fit without a constant, one does not pay
@settings(max_examples=4)
def test_offsets_of_sensors_and_torques_change_no_model(offsets: list[float]):
    """offsets: of two inputs and three outputs, in units of their deviations."""
    rng = np.random.default_rng(6)
    u, y = record(random_system(3, 2, 3, rng), 600, 0.0, rng)
    y = y + 0.05 * np.std(y, axis=0) * rng.standard_normal(y.shape)
    size = np.concatenate([u.std(axis=0), y.std(axis=0)]) * offsets
    config = configuration(2, 3, order=3, past_window=6, future_window=3)
    plain, moved = (
        identified(config, rpbsid.finish(run(config, u + du, y + dy).state), 0.01)
        for du, dy in ((0.0, 0.0), (size[:2], size[2:])))
    response = markov(plain.model, 10)
    assert np.abs(markov(moved.model, 10) - response).max() < 2e-3 * np.abs(response).max()  # a parameter more
    wider, U = validation.affine(moved.model, moved.constant, u + size[:2])
    rest = (y + size[2:] - validation.simulate(wider, U))[100:]  # from any first state, which dies out
    assert np.all(rest.std(axis=0) < 0.1 * y.std(axis=0))
    assert np.all(np.abs(rest.mean(axis=0)) < 0.02 * y.std(axis=0))


def test_estimators_agree_on_long_clean_records():
    rng = np.random.default_rng(5)
    system = random_system(3, 2, 3, rng)
    u, y = record(system, 4000, 1e-3, rng)
    for choice in ESTIMATORS:
        config = configuration(
            2, 3, order=3, past_window=8, future_window=4, forgetting_factor=[0.999] * 3, **choice)
        found = identified(config, run(config, u, y).state, 0.01)
        assert np.abs(sorted_poles(found.model.A) - sorted_poles(system.A)).max() < 5e-3, choice


@pytest.mark.parametrize('choice', ESTIMATORS)
def test_no_regressor_straddles_a_gap(choice):
    rng = np.random.default_rng(2)
    config = configuration(1, 1, order=1, past_window=3, future_window=2, **choice)
    whole = run(config, *rng.standard_normal((2, 20, 1)))
    gap = whole._replace(state=rpbsid.window_restart(config, whole.state))
    used = gap.state.counts[USED]
    for k in range(3):
        gap = gap.feed(*rng.standard_normal((2, 1, 1)))
        assert gap.state.counts[USED] == used, k
    assert gap.feed(*rng.standard_normal((2, 1, 1))).state.counts[USED] == used + 1


@pytest.mark.parametrize('choice', ESTIMATORS)
def test_restart_keeps_the_parameters_and_drops_the_confidence(choice):
    rng = np.random.default_rng(3)
    system = random_system(3, 2, 3, rng)
    u, y = record(system, 2000, 0.05, rng)
    config = configuration(2, 3, order=3, past_window=6, future_window=3, forgetting_factor=[1.0] * 3,
                           regularization=[1e-2] * 3, **choice)
    whole = run(config, u, y)
    state = whole.state
    before = identified(config, state, 0.01)
    restarted = rpbsid.restart(config, state)
    assert restarted.counts[USED] == 0
    assert restarted.counts[FILLED] == 0
    assert rpbsid.identified(config, restarted, 0.01) is None
    after = identified(config, whole._replace(state=restarted).feed(u[:40], y[:40]).state, 0.01)
    assert np.linalg.norm(after.spread) > 1.3 * np.linalg.norm(before.spread)
    kept = dataclasses.replace(config, restart_on_event=False)
    assert rpbsid.restart(kept, state).counts[USED] == state.counts[USED]


def test_sample_that_is_not_finite_is_refused_and_breaks_the_window():
    config = configuration(1, 1, order=1, past_window=3, future_window=1)
    whole = run(config, *np.random.default_rng(0).standard_normal((2, 20, 1)))
    state, bad = whole.state, whole.feed(np.array([[np.nan]]), np.array([[1.0]])).state
    assert bad.counts[REJECTED] == 1
    assert bad.counts[FILLED] == 0
    assert np.array_equal(bad.memory[0], state.memory[0])


def test_samples_of_the_wrong_size_are_an_error():
    config = configuration(2, 1, order=1, past_window=3, future_window=1)
    with pytest.raises(SignalError, match='2 inputs and 1 outputs'):
        rpbsid.advance(config, rpbsid.init(config), log_of(np.zeros((1, 1)), np.zeros((1, 1))).rows(0, 1))


@pytest.mark.parametrize(('order', 'status'), [(2, Status.ORDER_TOO_LOW), (4, Status.TRACKING)])
def test_a_model_that_leaves_dynamics_out_says_so(order, status):
    rng = np.random.default_rng(5)
    u, y = record(random_system(4, 2, 2, rng), 3000, 0.1, rng)
    config = configuration(2, 2, order=order, refinement='none')
    found = identified(config, run(config, u, y).state, 0.01)
    assert found.status is status
