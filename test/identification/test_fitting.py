"""The long work of the refinement: wherever and whenever it is done, the numbers are the same."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_arm import Run, configuration, random_system, record, start
from scipy.signal import cont2discrete, dlsim
from test_rpbsid import same

from flexmanip_ros.identification import decimation, rpbsid, validation
from flexmanip_ros.numerics.background import Request
from flexmanip_ros.samples.sample_log import log_of
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
    run = start(CONFIG)
    for k in range(COUNT):
        run = run.feed(u[k:k + 1], y[k:k + 1])
    return rpbsid.finish(run.state)


@given(st.lists(st.integers(1, 200), min_size=1, max_size=12))
@settings(max_examples=15, deadline=None)
def test_silence_and_refused_samples_in_any_grouping_give_the_same_bits(sizes: list[int]):
    u, y = signals()
    run, at, turn = start(CONFIG), 0, 0
    while at < COUNT:
        size = sizes[turn % len(sizes)]
        run = run.feed(u[at:at + size], y[at:at + size])
        at, turn = at + size, turn + 1
    assert same(rpbsid.finish(run.state), stepped())


class Choosing:
    """Solves some requests when they are started, the others when their result is wanted."""

    def __init__(self, at_once: list[bool]) -> None:
        self.at_once, self.started, self.taken = at_once, 0, 0
        self.results: dict[Request, object] = {}

    def start(self, request: Request) -> None:
        if self.at_once[self.started % len(self.at_once)]:
            self.results[request] = request.solve()
        self.started += 1

    def result(self, request: Request) -> object:
        self.taken += 1
        return self.results.pop(request) if request in self.results else request.solve()


@given(st.lists(st.booleans(), min_size=1, max_size=20))
@settings(max_examples=10, deadline=None)
def test_a_fit_made_at_once_or_when_its_turn_comes_gives_the_same_bits(at_once: list[bool]):
    u, y = signals()
    run, background = start(CONFIG), Choosing(at_once)
    for k in range(0, COUNT, 10):
        run = run.feed(u[k:k + 10], y[k:k + 10], background=background)
    assert same(rpbsid.finish(run.state, background), stepped())
    assert background.started == background.taken > 3


def test_no_step_does_the_work_it_asks_for():
    run = fed(256)
    refined = run.state.refined
    assert refined is not None
    assert refined.request is not None
    assert refined.due - 256 == 128, 'half of the samples of the first fit'
    assert refined.recursion is None


def test_a_restart_drops_the_fit_under_way():
    run = fed(260)
    assert run.state.refined is not None
    assert run.state.refined.request is not None
    restarted = rpbsid.restart(CONFIG, run.state)
    assert restarted.refined is not None
    assert restarted.refined.request is None


def fed(count: int) -> Run:
    u, y = signals()
    return start(CONFIG).feed(u[:count], y[:count])


@pytest.mark.parametrize('seed', [0, 3])
def test_the_gain_of_a_refined_model_predicts_no_worse_than_its_simulation_from_a_state_that_is_not_known(seed: int):
    """A resonance of 3 Hz, 13 s, at 20 of 200 samples a second. Its sensor noise needs no K."""
    rng, rate, count, turn = np.random.default_rng(seed), 200, 4000, 6.0 * np.pi
    plant = cont2discrete(tuple(np.array(M) for M in (
        [[0.0, 1.0], [-turn ** 2, -0.04 * turn]], [[0.0], [turn ** 2]], [[1.0, 0.0]], [[0.0]])), 1.0 / rate)
    u = np.repeat(rng.choice([-1.0, 1.0], count // 20), 20)[:, None]
    _, y, _ = dlsim(plant, u)
    y += 0.01 * y.std() * rng.standard_normal(y.shape)
    config = configuration(1, 1, order=3, past_window=20, future_window=20, direct_feedthrough=True, decimation=10,
                           refinement='output_error')
    state = rpbsid.advance(config, rpbsid.init(config), log_of(
        u, y, stamp_ns=(np.arange(count) * (10 ** 9 // rate)).astype(np.int64)).rows(0, 2700))
    found = rpbsid.identified(config, rpbsid.finish(state), 1.0 / rate)
    assert found is not None
    assert found.refined
    kept, _ = decimation.whole(np.hstack([u, y]), config.decimation)
    U, Y = kept[:, :1], kept[:, 1:]
    predicted, simulated = (np.var((Y - validation.predict(replace(found.model, K=K), U, Y, np.zeros(3)))[60:])
                            for K in (found.model.K, np.zeros((3, 1))))
    assert predicted <= 1.05 * simulated
