"""The noise that a fit assumes, and the residuals beyond chance for which its model is given up."""

from dataclasses import replace

import numpy as np
import pytest
from recording import ARM, BENDS, config, event, record, run

from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload import gauss_newton, measurement_update, structured
from flexmanip_ros.types import Status

SAMPLES, SENSORS = 600, 4
VARIANCE = np.array([1e-8, 4e-10, 1.0, 3e-6])


def judged(rng: np.random.Generator) -> mem.FilterState:
    """A fit to white noise whose variances are known from other samples of it."""
    m = mem.memory(4, SENSORS, 2)
    m.counts[[mem.MEASURED, mem.SEEN]] = SAMPLES
    m.noise[:, mem.LEVEL] = np.inf
    differences = np.diff(rng.standard_normal((SAMPLES + 4, SENSORS)), n=4, axis=0)
    m.noise[:, mem.WHITE] = VARIANCE * np.mean(differences ** 2, axis=0) / 70
    m.noise[:, mem.EFFECTIVE] = m.noise[:, mem.WHITE]
    m.noise[:, mem.FIT] = VARIANCE * np.sum(rng.standard_normal((SAMPLES, SENSORS)) ** 2, axis=0)
    gauss_newton.judge_residuals(m)
    return m


def test_residuals_that_are_white_noise_exceed_it_by_one_deviation_of_chance() -> None:
    rng = np.random.default_rng(0)
    excess = np.array([judged(rng).score[mem.EXCESS] for _ in range(1000)])
    assert abs(np.mean(excess)) < 0.2
    assert np.std(excess) == pytest.approx(1.0, abs=0.1)


def test_the_noise_assumed_before_any_innovation_is_hardly_ever_below_the_true_one() -> None:
    rng = np.random.default_rng(1)
    below = [measurement_update.most_white(row, SAMPLES) < true
             for _ in range(250) for row, true in zip(judged(rng).noise, VARIANCE, strict=True)]
    assert np.mean(below) < 0.005


def test_a_sensor_that_showed_more_than_white_noise_before_an_event_may_show_it_after() -> None:
    m = judged(np.random.default_rng(2))
    m.noise[:, mem.FIT] *= 3.0
    gauss_newton.judge_residuals(m)
    assert m.score[mem.EXCESS] > 20.0
    m.noise[:, mem.EFFECTIVE] = 3.0 * VARIANCE
    m.counts[mem.BLOCKS] = 40
    gauss_newton.judge_residuals(m)
    assert abs(m.score[mem.EXCESS]) < 5.0


def test_the_simplest_arm_is_given_up_below_twice_the_noise_and_the_payload_is_known() -> None:
    # at 30 dB a bend that reads 0.2 mm too little leaves less than twice the noise, but more than chance
    arm = replace(ARM, bend_offset=(-2e-4, 0.0))
    caught = event(2.0)
    samples = record(3.5, (caught,), outputs=BENDS, arm=arm, payload=8.0, snr_db=30.0)
    settings = config(outputs=BENDS)
    empty = run(settings, samples.between(0, samples.log.row_at(caught.stamp_ns, 0)))
    assert empty.refits == 1
    found = structured.estimate(settings, run(settings, samples, (caught,)))
    assert found.status is Status.TRACKING
    assert found.lower < 8.0 < found.upper
    assert found.mass == pytest.approx(8.0, rel=0.03)
