"""Figures that judge estimates."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import binom

from flexmanip_ros.studies.results import coverage, relative_error_percent, score


def _row(mass: float, true: float = 20.0, *, covered: bool = True, error: str = '') -> dict[str, object]:
    return {'payload_mass_kg': mass, 'payload_true_kg': true, 'covered': covered, 'error': error,
            'error_percent': 100.0 * abs(mass - true) / true, 'us_per_sample': 10.0}


def test_the_mean_relative_error_leaves_out_what_is_not_there():
    assert relative_error_percent(np.array([18.0, np.nan, 22.0]), 20.0) == pytest.approx(10.0)
    assert math.isnan(relative_error_percent(np.array([np.nan]), 20.0))
    assert math.isnan(relative_error_percent(np.array([1.0]), 0.0))


@pytest.mark.parametrize(('hits', 'runs'), [(95, 100), (0, 10), (10, 10), (1, 1)])
def test_the_interval_of_a_coverage_has_its_probability_in_the_tails(hits, runs):
    share, low, high = coverage(hits, runs)
    assert share == pytest.approx(100.0 * hits / runs)
    if hits:
        assert binom.sf(hits - 1, runs, low / 100.0) == pytest.approx(0.025)
    if hits < runs:
        assert binom.cdf(hits, runs, high / 100.0) == pytest.approx(0.025)


def test_failed_runs_are_counted_and_left_out():
    made = score([_row(20.2), _row(19.8, covered=False), _row(0.0, error='broken')])
    assert (made.runs, made.failed) == (3, 1)
    assert made.mean_error_percent == pytest.approx(1.0)
    assert made.rms_error_percent == pytest.approx(1.0)
    assert made.bias_kg == pytest.approx(0.0)
    assert made.coverage_percent == pytest.approx(50.0)


def test_a_study_without_any_payload_has_no_score_and_no_crash():
    made = score([{'error': ''}, {'error': 'x'}])
    assert (made.runs, made.failed) == (2, 1)
    assert math.isnan(made.mean_error_percent)
    assert math.isnan(score([]).coverage_percent)
