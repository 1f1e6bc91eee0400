"""A model is TRACKING only if models held back have predicted what came after them."""

from __future__ import annotations

import numpy as np
import pytest
from linear_arm import Run, configuration, identified, start

from flexmanip_ros.identification import held_back, rpbsid
from flexmanip_ros.identification.held_back import LONGEST, STRETCH_NS
from flexmanip_ros.identification.uncertainty import Identified
from flexmanip_ros.identification.validation import simulate
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.types import Array, StateSpace, Status

MS = 1_000_000
CONFIG = configuration(1, 2, order=2, past_window=6, future_window=4, refinement='none')


def signals(count: int, turned_from: int | None = None) -> tuple[Array, Array]:
    """A machine with a mode of 5 Hz, driven by steps, whose outputs have another sign from a sample on."""
    rng = np.random.default_rng(4)
    pole = np.exp((-0.1 + 1j) * 2.0 * np.pi * 5.0 * 1e-3)
    A = np.array([[pole.real, -pole.imag], [pole.imag, pole.real]])
    u = np.repeat(rng.standard_normal(count // 50 + 1), 50)[:count, None]
    y = simulate(StateSpace(A, np.ones((2, 1)), np.eye(2), np.zeros((2, 1)), np.zeros((2, 2)), 1e-3), u)
    if turned_from is not None:
        y[turned_from:] *= -1.0
    return u, y + 0.01 * np.std(y, axis=0) * rng.standard_normal(y.shape)


def fed(config: IdentifierParameters, u: Array, y: Array, stamps: Array | None = None) -> Run:
    stamps = MS * np.arange(len(u)) if stamps is None else stamps
    run = start(config)
    for k in range(0, len(u), 250):
        run = run.feed(u[k:k + 250], y[k:k + 250], stamps[k:k + 250])
    return run


def held(run: Run) -> held_back.HeldBack:
    found = rpbsid.finish(run.state).held
    assert found is not None
    return found


def said(run: Run, early: bool = False) -> Status:
    found = identified(run.config, run.state, 1e-3)
    return held_back.judged(found._replace(status=Status.TRACKING), held(run), run.config.outputs, early).status


@pytest.mark.parametrize('choice', [{}, {'decimation': 2}, {'estimator': 'paper'}])
def test_models_held_back_predict_a_linear_machine(choice: dict[str, object]) -> None:
    run = fed(configuration(1, 2, order=2, past_window=6, future_window=4, refinement='none', **choice), *signals(4000))
    share = held(run).total
    assert share is not None
    assert np.all(share[0] < 0.3 * share[1])
    assert said(run) is Status.TRACKING


def test_a_model_whose_forerunner_missed_what_followed_is_not_tracking() -> None:
    run = fed(CONFIG, *signals(4000, 3000))
    assert said(run) is Status.INCONSISTENT
    assert said(run, early=True) is Status.WARMING_UP


def test_the_reason_names_the_output() -> None:
    run = fed(CONFIG, *signals(4000, 3000))
    found = identified(run.config, run.state, 1e-3)
    verdict = held_back.judged(found._replace(status=Status.TRACKING), held(run), run.config.outputs, early=False)
    assert verdict.reason == 'models of earlier samples missed over half of what out0/position did next'


def test_a_refined_model_is_judged_by_other_samples_than_those_of_its_fit_anyway() -> None:
    run = fed(CONFIG, *signals(4000, 3000))
    found = identified(run.config, run.state, 1e-3)
    refined = found._replace(status=Status.TRACKING, refined=True)
    assert held_back.judged(refined, held(run), run.config.outputs, early=False) is refined


def test_a_whole_stretch_must_have_been_predicted_first() -> None:
    u, y = signals(1500)
    seen = [(count, said(fed(CONFIG, u[:count], y[:count]), early=True)) for count in range(50, 1500, 50)]
    first = next(count for count, status in seen if status is Status.TRACKING)
    assert {status for count, status in seen if count < first} == {Status.WARMING_UP}
    assert {status for count, status in seen if count >= first} == {Status.TRACKING}
    assert first * MS > STRETCH_NS


def test_a_gap_ends_a_stretch() -> None:
    u, y = signals(2100)
    run = fed(CONFIG, u[:2000], y[:2000], MS * np.arange(2000))
    before = run.state.held
    assert before is not None
    state = rpbsid.window_restart(CONFIG, run.state)
    after = run._replace(state=state).feed(u[2000:], y[2000:], MS * np.arange(5000, 5100)).state.held
    assert after is not None
    assert after.start == after.begin == 2000
    assert after.request is not None
    assert after.request.rows.until == 2000


def test_stretches_count_as_long_as_their_samples_are_remembered() -> None:
    u, y = signals(9000)
    whole, short = (held(fed(configuration(
        1, 2, order=2, past_window=6, future_window=4, refinement='none', forgetting='constant',
        forgetting_factor=[factor] * 3), u, y)).total for factor in (1.0, 0.999))
    assert whole is not None
    assert short is not None
    assert np.all(whole[1] > 8.5)
    assert np.all(short[1] < 1.5)  # the memory is of 1 s


def test_a_machine_at_rest_counts_neither_for_nor_against_a_model() -> None:
    u, y = signals(4000)
    u[2000:], y[2000:] = u[1999], y[1999]
    resting, moving = (held(fed(CONFIG, u[:count], y[:count])).total for count in (4000, 2000))
    assert resting is not None
    assert moving is not None
    assert np.all(resting[1] < moving[1] + 1e-9 * STRETCH_NS)


def test_a_machine_at_rest_whose_sensors_are_noisy_has_predicted_nothing() -> None:
    u, y = signals(1000)
    rng = np.random.default_rng(1)
    u = np.vstack([1e-3 * rng.standard_normal((3000, 1)), u])
    y = np.vstack([0.01 * np.std(y, axis=0) * rng.standard_normal((3000, 2)), y])
    for count in (3000, 3100, 3200):  # it moves from 3000 on
        run = fed(CONFIG, u[:count], y[:count])
        assert held_back.misses(held(run)) is None
        assert said(run) is Status.WARMING_UP


def test_an_event_begins_anew() -> None:
    run = fed(CONFIG, *signals(2000))
    assert rpbsid.restart(CONFIG, run.state).held == held_back.HeldBack()


def test_the_samples_kept_are_bounded_where_the_stamps_stand_still() -> None:
    run = fed(CONFIG, *signals(4000), np.zeros(4000, dtype=np.int64))
    assert run.state.cursor - rpbsid.first_needed(run.state) <= 2 * LONGEST


def test_where_nobody_asks_for_a_status_no_model_is_held_back() -> None:
    run = start(CONFIG)
    run = run._replace(state=run.state._replace(held=None)).feed(*signals(1000))
    assert run.state.held is None
    found = rpbsid.identified(CONFIG, run.state, 1e-3)
    assert isinstance(found, Identified)
    assert held_back.judged(found, None, CONFIG.outputs, early=False) is found
