"""The long work of the refinement: wherever and whenever it is done, the numbers are the same."""

from __future__ import annotations

from functools import cache

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_arm import configuration, random_system, record
from test_rpbsid import same

from flexmanip_ros.identification import fitting, rpbsid
from flexmanip_ros.types import Array

COUNT = 1500
CONFIG = configuration(1, 2, order=2, past_window=4, future_window=2)


@cache
def signals() -> tuple[Array, Array]:
    """A noisy record that stands still for a while and holds numbers that are none."""
    rng = np.random.default_rng(8)
    u, y = record(random_system(2, 1, 2, rng), COUNT, 0.0, rng)
    y = y + 0.1 * np.std(y, axis=0) * rng.standard_normal(y.shape)
    u[800:930], y[800:930] = u[800], y[800]
    y[1300, 1] = np.nan
    y[1301, 0] = np.inf
    return u, y


@cache
def stepped() -> rpbsid.RpbsidState:
    u, y = signals()
    state = rpbsid.init(CONFIG)
    for k in range(COUNT):
        state = rpbsid.step(CONFIG, state, u[k], y[k])
    return rpbsid.finish(CONFIG, state)


@given(st.lists(st.integers(1, 200), min_size=1, max_size=12))
@settings(max_examples=15, deadline=None)
def test_silence_and_refused_samples_in_any_grouping_give_the_same_bits(sizes: list[int]):
    u, y = signals()
    state, at, turn = rpbsid.init(CONFIG), 0, 0
    while at < COUNT:
        size = sizes[turn % len(sizes)]
        state = rpbsid.advance(CONFIG, state, u[at:at + size], y[at:at + size])
        at, turn = at + size, turn + 1
    assert same(rpbsid.finish(CONFIG, state), stepped())


@given(st.lists(st.booleans(), min_size=1, max_size=20))
@settings(max_examples=10, deadline=None)
def test_a_fit_made_elsewhere_or_when_its_turn_comes_gives_the_same_bits(helped: list[bool]):
    u, y = signals()
    state, made = rpbsid.init(CONFIG), 0
    for k in range(0, COUNT, 10):
        state = rpbsid.advance(CONFIG, state, u[k:k + 10], y[k:k + 10])
        pending = rpbsid.job(state)
        if pending is not None and helped[made % len(helped)]:
            state = rpbsid.answered(state, pending[0], fitting.solve(CONFIG, pending[0]))
            assert rpbsid.job(state) is None
            made += 1
    assert same(rpbsid.finish(CONFIG, state), stepped())


def test_no_step_does_the_work_it_asks_for():
    u, y = signals()
    state = rpbsid.advance(CONFIG, rpbsid.init(CONFIG), u[:256], y[:256])
    pending = rpbsid.job(state)
    assert pending is not None
    assert pending[1] == 128, 'half of the samples of the first fit'
    assert state.refined is not None
    assert state.refined.recursion is None


def test_an_answer_that_comes_after_an_event_is_ignored():
    u, y = signals()
    state = rpbsid.advance(CONFIG, rpbsid.init(CONFIG), u[:260], y[:260])
    pending = rpbsid.job(state)
    assert pending is not None
    restarted = rpbsid.restart(CONFIG, state)
    assert rpbsid.job(restarted) is None
    assert same(rpbsid.answered(restarted, pending[0], fitting.solve(CONFIG, pending[0])), restarted)
