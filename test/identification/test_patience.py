"""How long a fit may take: a time at high sample rates, told by the stamps, the same live and replayed."""

from __future__ import annotations

import numpy as np
import pytest
from linear_arm import configuration, random_system, record, run, start
from test_rpbsid import same

from flexmanip_ros.identification import batch_fit, recursive_fit, rpbsid
from flexmanip_ros.numerics.background import Request
from flexmanip_ros.samples.sample_log import log_of

COUNT = 1300
CONFIG = configuration(1, 2, order=2, past_window=4, future_window=2)


def due(rate: float, count: int) -> int:
    """Samples from the request of a fit after ``count`` of them to its result."""
    refined = recursive_fit.start(0)._replace(end=count)
    return recursive_fit.result_delay(CONFIG, refined, round((count - 1) * 1e9 / rate))


@pytest.mark.parametrize('count', [256, 512, 1024, 2048])
def test_a_fit_has_a_quarter_of_its_samples_up_to_1_khz(count: int) -> None:
    assert due(1000.0, count) == due(100.0, count) == max(128, count // 4)


@pytest.mark.parametrize('rate', [2000.0, 4000.0, 10000.0])
def test_at_any_rate_a_fit_has_a_tenth_of_a_second_and_more_for_many_samples(rate: float) -> None:
    for count in (256, 512, 1024, 2048):
        samples = due(rate, count)
        assert samples % recursive_fit.CHUNK == 0
        assert samples / rate >= max(0.1, 2e-4 * count)
        assert samples / rate <= max(0.1, 2e-4 * count, 0.25 * count / rate) + recursive_fit.CHUNK / rate


@pytest.mark.parametrize('decimation', [1, 2])
def test_stamps_in_any_grouping_give_the_same_bits(decimation: int) -> None:
    rng = np.random.default_rng(3)
    u, y = record(random_system(2, 1, 2, rng), COUNT * decimation, 0.0, rng)
    y = y + 0.1 * np.std(y, axis=0) * rng.standard_normal(y.shape)
    stamps = 1_700_000_000_000_000_000 + 250_000 * np.arange(len(u)) // decimation
    config = configuration(1, 2, order=2, past_window=4, future_window=2, decimation=decimation)
    states = []
    for size in (1, 7, len(u)):
        parts = start(config)
        for k in range(0, len(u), size):
            parts = parts.feed(u[k:k + size], y[k:k + size], stamps[k:k + size])
        states.append(rpbsid.finish(parts.state))
    assert same(states[0], states[2])
    assert same(states[1], states[2])


def test_a_fit_at_4_khz_is_awaited_for_a_tenth_of_a_second() -> None:
    rng = np.random.default_rng(3)
    u, y = record(random_system(2, 1, 2, rng), 300, 0.0, rng)
    refined = run(CONFIG, u, y, 250_000 * np.arange(300)).state.refined
    assert refined is not None
    assert refined.request is not None
    assert 256 + 400 <= refined.due <= 256 + 464


@pytest.mark.parametrize(('rate', 'samples'), [
    (100.0, 64), (1000.0, 64), (2000.0, 128), (4000.0, 192), (10000.0, 192)])
def test_a_block_has_a_twentieth_of_a_second_and_is_over_before_the_next(
        rate: float, samples: int) -> None:
    stamps = np.round(np.arange(1024) * 1e9 / rate).astype(np.int64)
    rows = log_of(np.zeros((1024, 1)), np.zeros((1024, 2)), stamp_ns=stamps).rows(0, 1024)
    refined = recursive_fit.start(0)._replace(end=1024, seen=768)
    asked = recursive_fit.ask_block(CONFIG, refined, rows)
    assert asked.due - asked.end == samples < batch_fit.BLOCK


class Noting:
    """Solves requests when their results are wanted, and notes the lengths of the fits of whole stretches."""

    def __init__(self) -> None:
        self.fits: list[int] = []

    def start(self, request: Request) -> None:
        if isinstance(request, recursive_fit.FitRequest) and request.R is not None:
            self.fits.append(len(request.rows))

    def result(self, request: Request) -> object:
        return request.solve()


@pytest.mark.parametrize(('rate', 'fits'), [
    (1000.0, [256, 512, 1024, 2048]), (4000.0, [256, 2048]), (5500.0, [256, 1024, 2176])])
def test_the_last_fit_of_a_stretch_is_not_missed_while_another_is_under_way(rate: float, fits: list[int]) -> None:
    rng = np.random.default_rng(3)
    u, y = record(random_system(2, 1, 2, rng), 4300, 0.0, rng)
    y = y + 0.1 * np.std(y, axis=0) * rng.standard_normal(y.shape)
    background = Noting()
    start(CONFIG).feed(u, y, np.round(np.arange(4300) * 1e9 / rate).astype(np.int64), background)
    assert background.fits == fits


def test_neither_a_gap_nor_a_refused_sample_ends_the_pause_after_fits_that_failed() -> None:
    rng = np.random.default_rng(3)
    u, y = rng.standard_normal((3000, 1)), rng.standard_normal((3000, 2))  # outputs that no input explains
    y[2900, 0] = np.nan
    state = run(CONFIG, u, y, 1_000_000 * np.arange(3000)).state
    for paused in (state, rpbsid.window_restart(CONFIG, state)):
        assert paused.refined is not None
        assert paused.refined.total == 439 - recursive_fit.PAUSE  # it began at row 2560; the refused one does not count
    assert rpbsid.restart(CONFIG, state).refined == recursive_fit.start(3000)


def test_a_block_is_no_first_fit() -> None:
    rows = log_of(np.zeros((1024, 1)), np.zeros((1024, 2)), stamp_ns=1_000_000 * np.arange(1024)).rows(0, 1024)
    refined = recursive_fit.start(0)._replace(end=1024, seen=768)
    assert not recursive_fit.is_first_under_way(recursive_fit.ask_block(CONFIG, refined, rows))
    first = recursive_fit.start(0)._replace(end=256)
    asked = recursive_fit.ask_fit(CONFIG, first, rows.between(0, 256), np.zeros((1, 1)), np.ones(3))
    assert recursive_fit.is_first_under_way(asked)
