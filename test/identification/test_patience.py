"""How long a fit may take: a time at high sample rates, told by the stamps, the same live and replayed."""

from __future__ import annotations

import numpy as np
import pytest
from linear_arm import configuration, random_system, record
from test_rpbsid import same

from flexmanip_ros.identification import batch_fit, recursive_fit, rpbsid

COUNT = 1300
CONFIG = configuration(1, 2, order=2, past_window=4, future_window=2)


def due(rate: float, count: int) -> int:
    """Samples from the question after ``count`` of them to its answer."""
    refined = recursive_fit.start(3)._replace(total=count)
    return recursive_fit.patience(refined, round((count - 1) * 1e9 / rate))


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
        state = rpbsid.init(config)
        for k in range(0, len(u), size):
            state = rpbsid.advance(config, state, u[k:k + size], y[k:k + size], stamps[k:k + size])
        states.append(rpbsid.finish(config, state))
    assert same(states[0], states[2])
    assert same(states[1], states[2])


def test_a_fit_at_4_khz_is_awaited_for_a_tenth_of_a_second() -> None:
    rng = np.random.default_rng(3)
    u, y = record(random_system(2, 1, 2, rng), 300, 0.0, rng)
    state = rpbsid.advance(CONFIG, rpbsid.init(CONFIG), u, y, 250_000 * np.arange(300))
    pending = rpbsid.job(state)
    assert pending is not None
    assert 256 + 400 <= pending[1] + 300 <= 256 + 464


@pytest.mark.parametrize(('rate', 'samples'), [
    (100.0, 64), (1000.0, 64), (2000.0, 128), (4000.0, 192), (10000.0, 192)])
def test_a_block_has_a_twentieth_of_a_second_and_is_over_before_the_next(
        rate: float, samples: int) -> None:
    refined = recursive_fit.start(3)._replace(total=1024, chunks=(np.zeros((recursive_fit.CHUNK, 3)),) * 4)
    asked = recursive_fit.ask_block(refined, round(1023 * 1e9 / rate))
    assert asked.due - asked.total == samples < batch_fit.BLOCK
