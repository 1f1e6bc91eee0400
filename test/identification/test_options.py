from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from linear_arm import (
    benchmark,
    configuration,
    identified,
    random_system,
    record,
    run,
    shared_data,
    sorted_poles,
    start,
)

from flexmanip_ros.identification import decimation, recursive_fit, rpbsid, validation
from flexmanip_ros.identification.factor import REJECTED, USED
from flexmanip_ros.identification.prediction_check import MOST_ROWS
from flexmanip_ros.identification.realization import stabilized, suggested_order, to_continuous, to_discrete
from flexmanip_ros.samples.sample_log import log_of


def test_stable_model_has_no_pole_outside_the_circle():
    rng = np.random.default_rng(1)
    A = rng.standard_normal((6, 6))
    assert np.abs(np.linalg.eigvals(A)).max() > 1.0
    values = np.linalg.eigvals(stabilized(A))
    assert np.abs(values).max() <= 1.0
    inside = 0.5 * A / np.abs(np.linalg.eigvals(A)).max()
    assert np.array_equal(stabilized(inside), inside)


def test_stable_model_is_published_when_asked_for():
    rng = np.random.default_rng(2)
    u, y = np.zeros((2, 300, 1))
    u[:] = rng.standard_normal(u.shape)
    for k in range(2, 300):
        y[k] = 1.81 * y[k - 1] - 0.808 * y[k - 2] + u[k - 1]  # poles 1.01 and 0.8
    for stable in (False, True):
        config = configuration(
            1, 1, order=2, past_window=6, future_window=4, stable_model=stable, refinement='none',
            regularization=[1e-9] * 3)
        found = identified(config, run(config, u, y).state, 0.01)
        assert (np.abs(np.linalg.eigvals(found.model.A)).max() <= 1.0) == stable


def test_suggested_order_is_the_order_of_the_plant():
    rng = np.random.default_rng(3)
    for n in (2, 4):
        u, y = record(random_system(n, 2, 2, rng), 4000, 1e-3, rng)
        config = configuration(2, 2, order=3, past_window=8, future_window=6, refinement='none')
        found = identified(config, run(config, u, y).state, 0.01)
        assert suggested_order(found.singular_values) == n


def test_decimated_identification_finds_the_slow_poles():
    study = benchmark('identification_paper_settings')
    u, y = study.response(20.0, (60.0, 45.0), 'paper', 40.0, 0, capture=0, samples=3000)
    config = configuration(2, 4, order=4, decimation=8, direct_feedthrough=True, regularization=[1e-6] * 3)
    state = run(config, u, y).state
    found = identified(config, state, 1e-3)
    assert found.model.dt == pytest.approx(8e-3)
    hertz = np.sort(np.abs(np.angle(np.linalg.eigvals(found.model.A)))[::2]) / (2 * np.pi * 8e-3)
    assert np.allclose(hertz, [5.63428, 6.55037], rtol=2e-3)
    stepped = start(config)
    for k in range(400):
        stepped = stepped.feed(u[k:k + 1], y[k:k + 1])
    assert np.array_equal(stepped.state.memory[0], run(config, u[:400], y[:400]).state.memory[0])


def test_a_decimated_log_is_bounded_and_marks_where_the_filter_began_anew():
    rng = np.random.default_rng(6)
    config = configuration(1, 1, order=2, past_window=4, future_window=3, decimation=2, refinement='none')
    stepped = start(config)
    for _ in range(12):
        stepped = stepped.feed(rng.standard_normal((1000, 1)), rng.standard_normal((1000, 1)))
    log = stepped.state.decimated
    assert log is not None
    assert log.end - log.start <= MOST_ROWS + 500
    restarted = stepped._replace(state=rpbsid.window_restart(config, stepped.state))
    after = restarted.feed(rng.standard_normal((5, 1)), rng.standard_normal((5, 1))).feed(
        rng.standard_normal((200, 1)), rng.standard_normal((200, 1))).state.decimated
    assert after is not None
    assert np.flatnonzero(after.rows(after.start, after.end).gap).tolist() == [log.end - after.start]
    judged = rpbsid.latest(config, stepped.state, 0, 0.001)
    assert judged is not None
    assert len(judged) == 750  # 1.5 s
    assert rpbsid.latest(replace(config, decimation=1), start(replace(config, decimation=1)).state, 0, 0.001) is None


@pytest.mark.parametrize('size', [1, 7, 400])
def test_a_decimated_sample_is_missing_where_the_instant_that_it_describes_is(size: int):
    missing, seen = np.zeros(400, dtype=np.int64), []
    missing[200:212] = np.arange(1, 13)
    state = decimation.start(4, 1)
    for k in range(0, 400, size):
        part = missing[k:k + size]
        state, _, _, absent = decimation.decimate(state, np.zeros((len(part), 1)), part, 4)
        seen.append(absent)
    _, described = decimation.whole(np.zeros((400, 1)), 4)
    assert np.array_equal(np.concatenate(seen), missing[described])


def test_a_lost_sample_is_no_outlier():
    rng = np.random.default_rng(8)
    u, y = record(random_system(2, 1, 2, rng), 300, 0.01, rng)
    lost = np.zeros(300, dtype=np.int64)
    lost[[100, 150]] = 1
    for estimator in ('paper', 'factor'):
        config = configuration(1, 2, order=2, past_window=4, future_window=2, refinement='none', estimator=estimator)
        state = rpbsid.advance(config, rpbsid.init(config), log_of(u, y, missing=lost).rows(0, 300))
        assert state.counts[REJECTED] == 0
        assert state.counts[USED] == 300 - 4 - 2 - 8  # two windows of four begin again


def test_continuous_and_discrete_are_inverse():
    rng = np.random.default_rng(4)
    Ac, Bc = rng.standard_normal((4, 4)), rng.standard_normal((4, 2))
    A, B = to_discrete(Ac, Bc, 0.05)
    back = to_continuous(A, B, 0.05)
    assert np.allclose(back[0], Ac)
    assert np.allclose(back[1], Bc)


def test_state_at_end_continues_the_record():
    rng = np.random.default_rng(5)
    system = random_system(4, 2, 1, rng)
    u, y = record(system, 300, 0.0, rng)
    x = validation.state_at_end(system, u[:200], y[:200])
    assert np.allclose(validation.simulate(system, u[200:], x), y[200:], atol=1e-8)
    assert validation.vaf(y, y + 1.0) == pytest.approx(100.0)


@pytest.mark.parametrize(('order', 'future'), [(4, 5), (6, 10)])
def test_measured_arm_is_simulated_to_98_percent(order, future):
    shared_data('daisy_robot_arm')
    study = benchmark('identification_measured_arms')
    u, y = study.record('daisy_robot_arm', 1)
    scores = study.ours(u, y, 512, {'order': order, 'future_window': future})
    assert scores['simulation'][0] >= 98.0
    assert scores['prediction'][0] >= 98.0


def test_long_fit_recursion_tracks_and_an_event_restarts_it():
    rng = np.random.default_rng(6)
    system = random_system(2, 1, 2, rng)
    u, y = record(system, 3500, 0.0, rng)
    y = y + 0.1 * np.std(y, axis=0) * rng.standard_normal(y.shape)
    config = configuration(1, 2, order=2, past_window=4, future_window=2)
    whole = run(config, u, y)
    state = whole.state
    assert state.refined is not None
    assert not state.refined.batch
    assert state.refined.recursion is not None
    assert state.refined.recursion.weight > 3000
    found = identified(config, state, 0.01)
    assert np.abs(sorted_poles(found.model.A) - sorted_poles(system.A)).max() < 0.01
    gap = whole._replace(state=rpbsid.window_restart(config, state)).feed(u[:600], y[:600]).state
    assert gap.refined is not None
    assert gap.refined.recursion is not None
    found = identified(config, gap, 0.01)
    assert np.abs(sorted_poles(found.model.A) - sorted_poles(system.A)).max() < 0.01
    restarted = rpbsid.restart(config, state)
    assert restarted.refined is not None
    assert restarted.refined.recursion is None


def test_a_fit_is_published_however_long_the_machine_runs():
    rng = np.random.default_rng(6)
    u, y = record(random_system(2, 1, 2, rng), 3000, 0.0, rng)
    y = y + 0.1 * np.std(y, axis=0) * rng.standard_normal(y.shape)
    config = configuration(1, 2, order=2, past_window=4, future_window=2)
    state = run(config, u, y).state.owned()
    assert state.refined is not None
    assert state.refined.recursion is not None
    state.counts[USED] = 3_600_000  # an hour at 1 kHz, in which the weight of the fit has reached its limit
    for weight, refined in ((recursive_fit.MEMORY, True), (0.1 * recursive_fit.MEMORY, False)):
        fit = state.refined._replace(recursion=state.refined.recursion._replace(weight=weight))
        found = identified(config, state._replace(refined=fit), 0.01)
        assert found.refined == refined
